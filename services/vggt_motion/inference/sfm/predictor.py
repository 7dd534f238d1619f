"""The predictor `sfm`: self-calibrating structure from motion and dense depth, without weights or GPU (DESIGN 3.4)."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.config import InferenceConfig
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, undistort_rays
from vggt_motion.inference.given import given_hint
from vggt_motion.inference.predictor import KeyframeImage, PredictedFrame, Prediction, PredictionHints
from vggt_motion.inference.sfm import companions, globalmap, images, relocate, rotation, structure, tracks, verdict
from vggt_motion.inference.sfm import depth as dense
from vggt_motion.inference.sfm.bundle import Scene
from vggt_motion.inference.sfm.focal import CameraPrior
from vggt_motion.inference.sfm.library import load_pycolmap
from vggt_motion.records import FocalHint, ScaleKind, SubmapQuality, SubmapVerdict

Array = npt.NDArray[np.float64]
Pair = tuple[int, int]

_MODEL = "sfm"
_MAX_DISAGREEMENT = 0.03  # of the path, between solutions found in different ways
_MAX_FOCAL_DEVIATIONS = 3.0  # between such solutions, in standard deviations
_MIN_MATCHES = 12
_MATCH_REACH = 4  # keyframes that are matched with each other at most so far apart
_STILL_PX = 1.0  # matches that a rotation explains this well carry no parallax
_TURNING_PX = 0.4  # the same within a submap whose camera is known: as little as tracking errs
_FALLBACK_FOCAL_OVER_WIDTH = 0.9
_DOUBTFUL_CONFIDENCE = 0.6  # of a doubtful submap: only its best points are left to the map
_PART_RELATIVE_SIGMA = 0.01  # of the focal length that the whole submap saw, for its parts
_COMPANION = "something that moves along fills the view"
_NO_DEPTH = "the camera did not move enough to see any depth"
_MAX_VANISHED = 0.35  # share of the image that may lose its points over a step while the camera only turns
# What fits of one part of the image over what fits of another: 0.8 to 1.3 where a structure holds for both; 0.2 to 0.7
# beside a truck that was taken for the scene
_FITS_AS_WELL = 0.75
_SURE_SHARE = 0.55  # of the tracks of a step; beside a truck a wrong length of one step can have half of them
_REST_MOVES_PX = 2.0  # more than any rotation explains
_MIN_SIDE_PX = 48  # smaller images have no room for windows and pyramids


def create(config: InferenceConfig) -> SfmPredictor:
    """The predictor of a configuration, its kernels compiled or loaded.

    Raises:
        MissingDependencyError: pycolmap is not installed.
    """
    load_pycolmap()
    _warm_up()
    return SfmPredictor(config)


@functools.cache
def _warm_up() -> None:
    """Solve a toy submap, so that compilation is part of the start and not of the first submap's time."""
    blocks = np.random.default_rng(0).integers(40, 216, (40, 80)).astype(np.uint8)
    texture = np.asarray(cv2.resize(blocks, (640, 320), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    keyframes = []
    for k in range(4):
        # a camera that moves sideways past two walls, the lower one nearer
        rows = [texture[:64, 4 * k : 4 * k + 256], texture[64:128, 9 * k : 9 * k + 256]]
        keyframes.append(KeyframeImage(f"warm/0/{k:08d}", k, np.repeat(np.vstack(rows)[..., None], 3, axis=2)))
    hint = FocalHint(1.0, 0.0, is_fixed=False)
    SfmPredictor(InferenceConfig()).predict(keyframes, PredictionHints(focal=hint))


class SfmPredictor:
    """Predicts one submap at a time; no result depends on what was predicted before."""

    name = _MODEL

    def __init__(self, config: InferenceConfig) -> None:
        self._config = config

    def predict(self, images: Sequence[KeyframeImage], hints: PredictionHints) -> Prediction:
        """See :class:`vggt_motion.inference.predictor.Predictor`."""
        return _Submap(self._config, images, hints).predict()


class _Submap:
    """One prediction on its way."""

    def __init__(self, config: InferenceConfig, keyframes: Sequence[KeyframeImage], hints: PredictionHints) -> None:
        self._config = config
        self._keyframes = keyframes
        self._hints = hints
        height, width = keyframes[0].pixels.shape[:2] if keyframes else (1, 1)
        self._hint = given_hint(config, width, height) or hints.focal
        self._seconds: dict[str, float] = {}
        self._attempts: list[str] = []

    def predict(self) -> Prediction:
        # 1. which frames carry information of their own
        others = {*self._hints.zero_motion_copies, *self._hints.loop_positions}
        originals = [p for p in range(len(self._keyframes)) if p not in others]
        if len(self._keyframes) < 2 or not originals:
            return self._failed("a submap needs at least two keyframes")
        if len({image.pixels.shape for image in self._keyframes}) != 1:
            return self._failed("the keyframes differ in size")
        if min(self._keyframes[0].pixels.shape[:2]) < _MIN_SIDE_PX:
            return self._failed(f"the keyframes are smaller than {_MIN_SIDE_PX} px")
        # 2. correspondences
        started = time.perf_counter()
        known = self._hint.intrinsics if self._hint is not None else None
        if known is not None and not (0.0 <= known.cx < known.width_px and 0.0 <= known.cy < known.height_px):
            return self._failed(f"the given principal point lies outside of {known.width_px} x {known.height_px} px")
        working = self._working()
        if len(originals) == 1:
            over_width = self._hint.focal_over_width if self._hint is not None else _FALLBACK_FOCAL_OVER_WIDTH
            standing = rotation.RotationFit({originals[0]: np.eye(3)}, over_width * working.width_px, 0.0)
            return self._rotation_only(standing, working)
        followed = tracks.follow(working, originals)
        self._seconds["tracks_s"] = time.perf_counter() - started
        # 3. is there parallax at all
        started = time.perf_counter()
        matched = _matched(followed, originals, self._assumed_camera(working))
        if all(len(pair[0]) < _MIN_MATCHES for pair in matched.values()):
            return self._failed("too few correspondences between the keyframes: no texture, or no common view")
        focal_px = self._hint.focal_over_width * working.width_px if self._hint is not None else None
        turned = rotation.fit_rotations(matched, originals, focal_px, working.width_px)
        self._seconds["rotation_s"] = time.perf_counter() - started
        companion = companions.find(followed, originals, working)
        solved: structure.Structure | None = None
        doubt = ""
        if turned is not None and turned.residual_px < _STILL_PX:
            started = time.perf_counter()
            if companion is not None:
                working, solved, doubt = self._beside(companion, turned.focal_px, originals, working)
            if solved is None:
                if tracks.vanished_share(followed, originals, working.width_px) < _MAX_VANISHED:
                    return self._rotation_only(turned, working)
                return self._failed(f"{_COMPANION}, and beside it no scene was found")
        else:
            # 4. structure
            started = time.perf_counter()
            first, attempts = structure.solve(followed, originals, working, self._prior())
            self._attempts.extend(attempts)
            if companion is not None and first is not None:
                working, solved, doubt = self._without_companion(companion, first, followed, originals, working)
            if solved is None:
                joined = self._solve_in_parts(first, followed, originals, working) if first is not None else None
                if joined is not None:
                    return replace(joined, stage_seconds=self._seconds | {"parts_s": time.perf_counter() - started})
                solved, more = self._solve(first, originals, working)
                doubt = "; ".join(part for part in (doubt, more) if part)
        self._seconds["structure_s"] = time.perf_counter() - started
        if solved is None:
            return self._failed("structure from motion found no scene that the keyframes agree on")
        judgement, reason = verdict.judge(solved, len(originals))
        if judgement is SubmapVerdict.FAILED:
            return self._failed(reason)
        if doubt:
            judgement, reason = SubmapVerdict.LOW_QUALITY, "; ".join(part for part in (reason, doubt) if part)
        # 5. depth, and the frames in which the camera only turned
        started = time.perf_counter()
        frames = self._frames(solved, working)
        turned_frames = [] if working.hidden else self._turned_frames(frames, followed, originals, solved, working)
        self._seconds["depth_s"] = time.perf_counter() - started
        if turned_frames:
            frames = tuple(sorted((*frames, *turned_frames), key=lambda frame: frame.position))
            doubt = f"{len(turned_frames)} keyframes are known by rotation alone"
            judgement, reason = SubmapVerdict.LOW_QUALITY, "; ".join(part for part in (reason, doubt) if part)
        return self._prediction(frames, judgement, reason, self._quality(solved, len(frames), working))

    def _without_companion(
        self,
        companion: companions.Companion,
        first: structure.Structure,
        followed: tracks.Tracks,
        originals: Sequence[int],
        working: images.WorkingImages,
    ) -> tuple[images.WorkingImages, structure.Structure | None, str]:
        """Whether a structure is that of the scene, where part of the image moves as one piece.

        Returns:
            the images with what is hidden in them; the structure of the rest, None where the first one stays; and what
            speaks against whichever it is.
        """
        own, rest = first.share_that_fits(followed, companion.points), first.share_that_fits(followed, companion.others)
        self._attempts.append(f"a part of the image moves as one: {own:.0%} of it fit, {rest:.0%} of the rest")
        if rest >= _FITS_AS_WELL * own:
            hides = own < _FITS_AS_WELL * rest
            return (replace(working, hidden=companion.hidden) if hides else working), None, ""
        beside, solved, doubt = self._beside(companion, first.scene.focal_px, originals, working)
        if solved is None:
            return working, None, f"{_COMPANION}, and beside it no scene was found" if own > rest else ""
        return beside, solved, doubt

    def _beside(
        self,
        companion: companions.Companion,
        focal_px: float,
        originals: Sequence[int],
        working: images.WorkingImages,
    ) -> tuple[images.WorkingImages, structure.Structure | None, str]:
        """The images without the companion, and the structure of what is left; None where that is not a scene."""
        beside = replace(working, hidden=companions.followed_on(companion, originals, working).hidden)
        # little of the images is left: both ways together have tracks enough to carry the scale
        followed = tracks.follow(beside, originals).joined(tracks.match(beside, originals, reach=2))
        matched = _matched(followed, originals, self._assumed_camera(working))
        turned = rotation.fit_rotations(matched, originals, focal_px, working.width_px)
        if turned is not None and turned.residual_px < _REST_MOVES_PX:
            return working, None, ""  # so does the rest: far away, or the camera turned
        if companions.is_flat(followed, originals):
            return working, None, ""  # itself an object that passes
        first, attempts = structure.solve(followed, originals, beside, self._prior())
        self._attempts.extend(f"beside what moves along, {attempt}" for attempt in attempts)
        solved, doubt = self._solve(first, originals, beside)
        if solved is None or verdict.judge(solved, len(originals))[0] is SubmapVerdict.FAILED:
            return working, None, ""
        if solved.weakest_share < _SURE_SHARE:
            doubt = "; ".join(
                part for part in (doubt, f"{_COMPANION}, and over one step little beside it fits") if part
            )
        return beside, solved, doubt

    def _solve(
        self,
        solved: structure.Structure | None,
        originals: Sequence[int],
        working: images.WorkingImages,
    ) -> tuple[structure.Structure | None, str]:
        """The structure, and what speaks against it beside its own quality.

        Where the fast way leaves doubts, matched features are tried as well, grown and mapped all at once: ways that
        have little in common but the images, so that their agreement means something.
        """
        prior, count = self._prior(), len(originals)
        if solved is not None and verdict.is_convincing(solved, count):
            return solved, ""
        candidates = [solved]
        matched = tracks.match(working, originals)
        again, attempts = structure.solve(matched, originals, working, prior)
        self._attempts.extend(f"matched features, {attempt}" for attempt in attempts)
        candidates.append(again)
        if count > 2 and (again is None or not verdict.is_convincing(again, count)):
            candidates.append(self._mapped(matched, originals, working, prior))
        found = [candidate for candidate in candidates if candidate is not None]
        if not found:
            return None, ""
        found.sort(key=lambda candidate: verdict.rank(candidate, count), reverse=True)
        if len(found) > 1 and not verdict.is_convincing(found[0], count):
            others = [(verdict.disagreement(o, found[0]), verdict.focal_deviations(o, found[0]), o) for o in found[1:]]
            alike = [other for other in others if other[0] <= _MAX_DISAGREEMENT]
            if not alike:
                return found[0], f"ways to solve it disagree by {min(apart for apart, _, _ in others):.0%} of the path"
            # a turn that is bent the other way has nearly the same path, through another lens
            if min(deviations for _, deviations, _ in alike) > _MAX_FOCAL_DEVIATIONS:
                focals = f"{found[0].focal_over_width:.2f} and {alike[0][2].focal_over_width:.2f} image widths"
                return found[0], f"ways to solve it disagree on the focal length, {focals}"
        return found[0], ""

    def _solve_in_parts(
        self,
        solved: structure.Structure,
        followed: tracks.Tracks,
        originals: Sequence[int],
        working: images.WorkingImages,
    ) -> Prediction | None:
        """Solve driving and turning on the spot apart, where the submap holds both; None where it does not.

        While the camera only turns nothing carries the scale from what leaves the view to what comes into it, though a
        bundle adjustment finds some. What comes after is put where the camera stands, in the unit of its own steps.
        """
        camera = _intrinsics(solved.scene, working)
        parts = rotation.split(_matched(followed, originals, camera), originals, camera.fx, _TURNING_PX)
        if not any(part.is_turning for part in parts):
            return None
        hint = self._hint
        if hint is None or not hint.is_fixed:
            scene = solved.scene
            hint = FocalHint(
                solved.focal_over_width, _PART_RELATIVE_SIGMA, scene.radial_k1, radial_shape=scene.radial_shape
            )
        placed: dict[int, PredictedFrame] = {}
        qualities = []
        for part in parts:
            inner = _Submap(
                self._config, [self._keyframes[p] for p in part.positions], PredictionHints(hint, self._hints.ego_mask)
            )
            found = inner.predict_turning() if part.is_turning else inner.predict()
            kind = "turning on the spot" if part.is_turning else "moving"
            name = f"keyframes {part.positions[0]} to {part.positions[-1]}, {kind}"
            self._attempts.extend(f"{name}: {line}" for line in (found.verdict.value, *found.quality.attempts))
            frames = {part.positions[frame.position]: frame for frame in found.frames}
            border = part.positions[0]
            if placed and (border not in frames or border not in placed):
                break
            joined_from_part = np.eye(4)
            if placed:
                joined_from_part = placed[border].submap_from_camera @ se3.inverse(frames[border].submap_from_camera)
            for position, frame in frames.items():
                pose = joined_from_part @ frame.submap_from_camera
                moved = replace(frame, position=position, submap_from_camera=pose)
                if position not in placed or not placed[position].confidence.any():
                    placed[position] = moved
            if not part.is_turning:
                qualities.append(found.quality)
        if not placed:
            return None
        everywhere = tuple(
            replace(placed[original], position=position)
            for position in range(len(self._keyframes))
            if (original := self._original(position)) in placed
        )
        if not qualities:
            return self._prediction(everywhere, SubmapVerdict.ROTATION_ONLY, _NO_DEPTH, found.quality)
        quality = SubmapQuality(
            registered_frame_count=len(everywhere),
            mean_reprojection_error_px=float(np.nanmax([q.mean_reprojection_error_px for q in qualities])),
            track_inlier_ratio=min(q.track_inlier_ratio for q in qualities),
            median_parallax_deg=float(np.nanmin([q.median_parallax_deg for q in qualities])),
            focal_over_width=hint.focal_over_width,
            focal_relative_sigma=math.inf,
            radial_k1=hint.radial_k1,
            attempts=tuple(self._attempts),
            radial_shape=hint.radial_shape,
        )
        reason = "the camera turned on the spot: the scale after it is carried over, not measured"
        return self._prediction(everywhere, SubmapVerdict.LOW_QUALITY, reason, quality)

    def predict_turning(self) -> Prediction:
        """The prediction for a camera that is known to have turned on the spot."""
        working = self._working()
        originals = range(len(self._keyframes))
        camera = self._assumed_camera(working)
        matched = _matched(tracks.follow(working, originals), originals, camera)
        turned = rotation.fit_rotations(matched, originals, camera.fx, working.width_px)
        if turned is None:
            return self._failed("the keyframes of a turn are not connected")
        return self._rotation_only(turned, working)

    def _mapped(
        self, matched: tracks.Tracks, originals: Sequence[int], working: images.WorkingImages, prior: CameraPrior
    ) -> structure.Structure | None:
        """The structure from poses of global mapping."""
        known = prior.focal_over_width if prior.focal_over_width is not None else _FALLBACK_FOCAL_OVER_WIDTH
        placed = globalmap.place(
            matched,
            originals,
            working.width_px,
            working.height_px,
            known * working.width_px,
            prior.principal_px(working.width_px),
            prior.is_sure,
            self._config.sfm.seed,
        )
        mapped, outcome = None, "no model"
        if placed is not None:
            mapped, outcome = structure.solve_from(matched, originals, working, prior, placed)
        self._attempts.append(f"matched features, global mapping: {outcome}")
        return mapped

    def _prior(self) -> CameraPrior:
        hint = self._hint
        if hint is None:
            return CameraPrior()
        known = hint.intrinsics
        if known is None:
            return CameraPrior(
                hint.focal_over_width,
                hint.relative_sigma,
                hint.radial_k1,
                hint.is_fixed,
                radial_shape=hint.radial_shape,
            )
        # the working images have square pixels of the width of the recorded ones
        principal = (
            (known.cx - 0.5 * (known.width_px - 1)) / known.width_px,
            (known.cy - 0.5 * (known.height_px - 1)) * known.fx / known.fy / known.width_px,
        )
        return CameraPrior(hint.focal_over_width, hint.relative_sigma, hint.radial_k1, hint.is_fixed, principal)

    def _working(self) -> images.WorkingImages:
        known = self._hint.intrinsics if self._hint is not None else None
        aspect = known.fx / known.fy if known is not None else 1.0
        return images.prepare(self._keyframes, self._hints.ego_mask, self._config.sfm.width_px, aspect)

    def _assumed_camera(self, working: images.WorkingImages, focal_over_width: float | None = None) -> Intrinsics:
        """The camera of the working images before anything is solved, its focal length guessed where none is known."""
        prior = self._prior()
        assumed = focal_over_width or prior.focal_over_width or _FALLBACK_FOCAL_OVER_WIDTH
        u, v = prior.principal_px(working.width_px)
        middle = Intrinsics.centred(assumed * working.width_px, working.width_px, working.height_px, prior.radial_k1)
        k2 = prior.radial_shape * prior.radial_k1**2
        return replace(middle, cx=middle.cx + u, cy=middle.cy + v, k2=k2)

    def _frames(self, solved: structure.Structure, working: images.WorkingImages) -> tuple[PredictedFrame, ...]:
        width, height = images.fitted_size(working.width_px, working.height_px, self._config.sfm.depth_width_px)
        intrinsics = _intrinsics(solved.scene, working).resized(width, height)
        poses = solved.camera_from_submap()
        registered = sorted(poses)
        grey = {position: images.reduce_image(working.grey[position], width, height) for position in registered}
        usable = images.usable_pixels(self._hints.ego_mask, width, height)
        sparse = _sparse(solved)
        maps = dense.dense_depth(grey, poses, sparse, intrinsics, usable)
        maps.update({p: _without_hidden(maps[p], working.hidden[p]) for p in registered if p in working.hidden})
        loops = [p for p in sorted(self._hints.loop_positions) if p not in self._hints.zero_motion_copies]
        if loops:
            located = relocate.locate(working, loops, poses, maps, _intrinsics(solved.scene, working), solved.scene)
            self._attempts.extend(_loop_outcome(position, located.get(position)) for position in loops)
            for loop, found in located.items():
                grey[loop] = images.reduce_image(working.grey[loop], width, height)
                poses[loop] = found.camera_from_submap
                sparse[loop] = dense.SparseDepth(found.points_camera)
                group = (loop, *found.neighbours[: dense.MAX_NEIGHBOURS])
                nearby = dense.dense_depth(
                    {p: grey[p] for p in group},
                    {p: poses[p] for p in group},
                    {p: sparse[p] for p in group},
                    intrinsics,
                    usable,
                )
                maps[loop] = nearby[loop]
        frames = []
        for position in range(len(self._keyframes)):
            original = self._original(position)
            if original in maps:
                frames.append(
                    PredictedFrame(
                        position=position,
                        depth=maps[original].depth,
                        confidence=maps[original].confidence,
                        intrinsics=intrinsics,
                        submap_from_camera=se3.inverse(poses[original]),
                    )
                )
        return tuple(frames)

    def _turned_frames(
        self,
        frames: Sequence[PredictedFrame],
        followed: tracks.Tracks,
        originals: Sequence[int],
        solved: structure.Structure,
        working: images.WorkingImages,
    ) -> list[PredictedFrame]:
        """Frames that the structure does not hold because the camera turned on the spot: pose, but no depth."""
        camera = _intrinsics(solved.scene, working)
        matched = _matched(followed, originals, camera)
        extended = rotation.extend(solved.camera_from_submap(), matched, originals, camera.fx, _STILL_PX)
        if not extended:
            return []
        self._attempts.append(f"rotation alone: {len(extended)} more keyframes, from their neighbours")
        sample = frames[0]
        nothing = np.zeros_like(sample.depth)
        return [
            PredictedFrame(
                position, nothing, nothing, sample.intrinsics, se3.inverse(extended[self._original(position)])
            )
            for position in range(len(self._keyframes))
            if self._original(position) in extended
        ]

    def _original(self, position: int) -> int:
        """The keyframe whose pose a keyframe shares: itself, or the other end of a stop."""
        copies = self._hints.zero_motion_copies
        for _ in range(len(copies)):
            position = copies.get(position, position)
        return position

    def _quality(self, solved: structure.Structure, frame_count: int, working: images.WorkingImages) -> SubmapQuality:
        return SubmapQuality(
            registered_frame_count=frame_count,
            mean_reprojection_error_px=solved.reprojection_px,
            track_inlier_ratio=solved.explained,
            median_parallax_deg=solved.median_parallax_deg,
            focal_over_width=solved.focal_over_width,
            focal_relative_sigma=solved.focal_relative_sigma,
            radial_k1=solved.scene.radial_k1,
            attempts=tuple(self._attempts),
            radial_shape=solved.scene.radial_shape,
        )

    def _rotation_only(self, turned: rotation.RotationFit, working: images.WorkingImages) -> Prediction:
        width, height = images.fitted_size(working.width_px, working.height_px, self._config.sfm.depth_width_px)
        if self._hint is not None:
            over_width = self._hint.focal_over_width
        else:
            over_width = turned.focal_px / working.width_px if turned.shows_focal else _FALLBACK_FOCAL_OVER_WIDTH
        intrinsics = self._assumed_camera(working, over_width).resized(width, height)
        nothing = np.zeros((height, width), dtype=np.float32)
        frames = []
        for position in range(len(self._keyframes)):
            original = self._original(position)
            if original not in turned.camera_from_submap:
                continue  # a loop keyframe: without depth it cannot be placed
            camera_from_submap = turned.camera_from_submap[original]
            frames.append(
                PredictedFrame(position, nothing, nothing, intrinsics, se3.make(camera_from_submap.T, np.zeros(3)))
            )
        self._attempts.append(f"rotation alone: explains the matches to {turned.residual_px:.2f} px")
        quality = SubmapQuality(
            registered_frame_count=len(frames),
            mean_reprojection_error_px=turned.residual_px,
            track_inlier_ratio=1.0,
            median_parallax_deg=0.0,
            focal_over_width=over_width,
            focal_relative_sigma=math.inf,
            radial_k1=intrinsics.k1,
            attempts=tuple(self._attempts),
            radial_shape=self._prior().radial_shape,
        )
        return self._prediction(tuple(frames), SubmapVerdict.ROTATION_ONLY, _NO_DEPTH, quality)

    def _failed(self, reason: str) -> Prediction:
        over_width = self._hint.focal_over_width if self._hint is not None else _FALLBACK_FOCAL_OVER_WIDTH
        quality = SubmapQuality(0, math.nan, 0.0, math.nan, over_width, math.inf, 0.0, tuple(self._attempts))
        return self._prediction((), SubmapVerdict.FAILED, reason, quality)

    def _prediction(
        self, frames: tuple[PredictedFrame, ...], judgement: SubmapVerdict, reason: str, quality: SubmapQuality
    ) -> Prediction:
        if judgement is SubmapVerdict.LOW_QUALITY:
            frames = tuple(replace(f, confidence=_DOUBTFUL_CONFIDENCE * f.confidence) for f in frames)
        return Prediction(frames, judgement, reason, ScaleKind.RELATIVE, _MODEL, quality, dict(self._seconds))


def _loop_outcome(position: int, located: relocate.Located | None) -> str:
    if located is None:
        return f"loop keyframe {position}: not found again"
    return f"loop keyframe {position}: found again, {located.inlier_share:.0%} of the matches agree"


def _matched(followed: tracks.Tracks, positions: Sequence[int], camera: Intrinsics) -> dict[Pair, tuple[Array, Array]]:
    """Pairs of frames not far apart -> the points that both see, as a camera without distortion would see them.

    Pixels are relative to the principal point.
    """

    def straight(pixel: Array) -> Array:
        x, y = (pixel[:, 0] - camera.cx) / camera.fx, (pixel[:, 1] - camera.cy) / camera.fy
        return camera.fx * np.stack(undistort_rays(x, y, camera.k1, camera.k2), axis=1)

    matched = {}
    for index, a in enumerate(positions):
        for b in positions[index + 1 : index + 1 + _MATCH_REACH]:
            _, at_a, at_b = followed.between(a, b)
            matched[a, b] = (straight(at_a), straight(at_b))
    return matched


def _without_hidden(found: dense.DepthMap, hidden: npt.NDArray[np.bool_]) -> dense.DepthMap:
    """No depth where something hides the scene."""
    height, width = found.depth.shape
    share = cv2.resize(hidden.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    seen = np.asarray(share <= 0.0, dtype=np.float32)
    return dense.DepthMap(found.depth * seen, found.confidence * seen)


def _intrinsics(scene: Scene, working: images.WorkingImages) -> Intrinsics:
    return Intrinsics(
        fx=scene.focal_px,
        fy=scene.focal_px,
        cx=0.5 * (working.width_px - 1) + scene.principal_u,
        cy=0.5 * (working.height_px - 1) + scene.principal_v,
        width_px=working.width_px,
        height_px=working.height_px,
        k1=scene.radial_k1,
        k2=scene.radial_shape * scene.radial_k1**2,
    )


def _sparse(solved: structure.Structure) -> dict[int, dense.SparseDepth]:
    """Per registered frame, the points that it sees, in its camera frame."""
    seen_points = solved.scene.points[solved.observations.point]
    sparse = {}
    for index in np.flatnonzero(solved.registered):
        seen = seen_points[solved.observations.frame == index]
        sparse[solved.positions[index]] = dense.SparseDepth(
            seen @ solved.scene.rotations[index].T + solved.scene.translations[index]
        )
    return sparse
