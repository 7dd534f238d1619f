"""The predictor `sfm`: self-calibrating structure from motion and dense depth, without weights or GPU (DESIGN 3.4)."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from vggt_motion.config import InferenceConfig
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, undistort_rays
from vggt_motion.inference.predictor import KeyframeImage, PredictedFrame, Prediction, PredictionHints
from vggt_motion.inference.sfm import depth as dense
from vggt_motion.inference.sfm import features, images, rotation, structure
from vggt_motion.inference.sfm.library import load_pycolmap
from vggt_motion.records import FocalHint, ScaleKind, SubmapQuality, SubmapVerdict

Array = npt.NDArray[np.float64]
Pair = tuple[int, int]

_MODEL = "sfm"
_MATCH_REACH = 4  # keyframes that are matched with each other at most so far apart
_STILL_PX = 0.75  # matches that a rotation explains this well carry no parallax
_GOOD_REPROJECTION_PX = 0.6
_FALLBACK_FOCAL_OVER_WIDTH = 0.9
_MIN_GOOD_FRAME_SHARE = 0.7


def create(config: InferenceConfig) -> SfmPredictor:
    """The predictor of a configuration.

    Raises:
        MissingDependencyError: pycolmap is not installed.
    """
    load_pycolmap()
    return SfmPredictor(config)


class SfmPredictor:
    """Predicts one submap at a time; holds no state between submaps."""

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
        self._hint = _effective_hint(config, hints.focal)
        self._seconds: dict[str, float] = {}
        self._attempts: list[str] = []

    def predict(self) -> Prediction:
        # 1. which frames carry information of their own
        originals = [p for p in range(len(self._keyframes)) if p not in self._hints.zero_motion_copies]
        if len(self._keyframes) < 2:
            return self._failed("a submap needs at least two keyframes")
        if len({image.pixels.shape for image in self._keyframes}) != 1:
            return self._failed("the keyframes differ in size")
        # 2. correspondences
        started = time.perf_counter()
        working = images.prepare(self._keyframes, self._hints.ego_mask, self._config.sfm.width_px)
        if len(originals) == 1:
            over_width = self._hint.focal_over_width if self._hint is not None else _FALLBACK_FOCAL_OVER_WIDTH
            standing = rotation.RotationFit({originals[0]: np.eye(3)}, over_width * working.width_px, 0.0)
            return self._rotation_only(standing, working)
        detected = {position: features.detect(working.grey[position], working.usable) for position in originals}
        matches = _match(detected, originals)
        points = {position: self._undistorted(detected[position].points, working) for position in originals}
        self._seconds["correspondences_s"] = time.perf_counter() - started
        # 3. is there parallax at all
        started = time.perf_counter()
        centre = np.array([0.5 * (working.width_px - 1), 0.5 * (working.height_px - 1)])
        relative = {
            (a, b): (points[a][rows[:, 0]] - centre, points[b][rows[:, 1]] - centre) for (a, b), rows in matches.items()
        }
        focal_px = self._hint.focal_over_width * working.width_px if self._hint is not None else None
        turned = rotation.fit_rotations(relative, originals, focal_px, working.width_px)
        self._seconds["rotation_s"] = time.perf_counter() - started
        if all(len(rows) < 12 for rows in matches.values()):
            return self._failed("too few correspondences between the keyframes: no texture, or no common view")
        if turned is not None and turned.residual_px < _STILL_PX:
            return self._rotation_only(turned, working)
        # 4. structure
        started = time.perf_counter()
        solved = self._solve(points, matches, working, focal_px)
        self._seconds["structure_s"] = time.perf_counter() - started
        if solved is None:
            return self._failed("structure from motion found no model of the keyframes")
        # 5. depth
        started = time.perf_counter()
        frames = self._frames(solved, working)
        self._seconds["depth_s"] = time.perf_counter() - started
        return self._judged(solved, frames, len(originals), working)

    def _undistorted(self, pixels: npt.NDArray[np.float32], working: images.WorkingImages) -> npt.NDArray[np.float32]:
        """Points (N, 2) as a camera without distortion would see them, by the hinted radial coefficient."""
        if self._hint is None or self._hint.radial_k1 == 0.0:
            return pixels
        camera = Intrinsics.centred(self._hint.focal_over_width * working.width_px, working.width_px, working.height_px)
        x = (pixels[:, 0].astype(np.float64) - camera.cx) / camera.fx
        y = (pixels[:, 1].astype(np.float64) - camera.cy) / camera.fy
        x, y = undistort_rays(x, y, self._hint.radial_k1)
        return np.stack([x * camera.fx + camera.cx, y * camera.fy + camera.cy], axis=1).astype(np.float32)

    def _solve(
        self,
        points: Mapping[int, npt.NDArray[np.float32]],
        matches: Mapping[Pair, npt.NDArray[np.int64]],
        working: images.WorkingImages,
        focal_px: float | None,
    ) -> structure.Structure | None:
        is_held = self._hint is not None and self._hint.is_fixed
        solved = structure.solve_global(
            points, matches, working.width_px, working.height_px, focal_px, is_held, self._config.sfm.seed
        )
        self._attempts.append(f"global mapping, focal {'held' if is_held else 'free'}: {_outcome(solved)}")
        if not is_held and self._hint is not None and not _agrees(solved, self._hint, working.width_px):
            # a straight submap cannot see its focal length: what the others saw is better than what it makes up
            retried = structure.solve_global(
                points, matches, working.width_px, working.height_px, focal_px, True, self._config.sfm.seed
            )
            self._attempts.append(f"global mapping, focal held at the hint: {_outcome(retried)}")
            solved = retried if retried is not None else solved
        return solved

    def _frames(self, solved: structure.Structure, working: images.WorkingImages) -> tuple[PredictedFrame, ...]:
        width, height = images.fitted_size(working.width_px, working.height_px, self._config.sfm.depth_width_px)
        intrinsics = self._intrinsics(solved.focal_px, working).resized(width, height)
        registered = sorted(solved.camera_from_submap)
        grey = {position: images.reduce_image(working.grey[position], width, height) for position in registered}
        usable = images.usable_pixels(self._hints.ego_mask, width, height)
        maps = dense.dense_depth(grey, solved.camera_from_submap, _nearest_inverse_depth(solved), intrinsics, usable)
        frames = []
        for position in range(len(self._keyframes)):
            original = self._hints.zero_motion_copies.get(position, position)
            if original in maps:
                frames.append(
                    PredictedFrame(
                        position=position,
                        depth=maps[original].depth,
                        confidence=maps[original].confidence,
                        intrinsics=intrinsics,
                        submap_from_camera=se3.inverse(solved.camera_from_submap[original]),
                    )
                )
        return tuple(frames)

    def _intrinsics(self, focal_px: float, working: images.WorkingImages) -> Intrinsics:
        k1 = self._hint.radial_k1 if self._hint is not None else 0.0
        return Intrinsics.centred(focal_px, working.width_px, working.height_px, k1)

    def _judged(
        self,
        solved: structure.Structure,
        frames: tuple[PredictedFrame, ...],
        original_count: int,
        working: images.WorkingImages,
    ) -> Prediction:
        reasons = []
        registered = len(solved.camera_from_submap)
        if registered < _MIN_GOOD_FRAME_SHARE * original_count:
            reasons.append(f"only {registered} of {original_count} keyframes were registered")
        if solved.reprojection_px > _GOOD_REPROJECTION_PX:
            reasons.append(f"mean reprojection error {solved.reprojection_px:.2f} px")
        verdict = SubmapVerdict.LOW_QUALITY if reasons else SubmapVerdict.GOOD
        is_held = self._hint is not None and self._hint.is_fixed
        quality = SubmapQuality(
            registered_frame_count=len(frames),
            mean_reprojection_error_px=solved.reprojection_px,
            track_inlier_ratio=solved.match_inlier_ratio,
            median_parallax_deg=solved.median_parallax_deg,
            focal_over_width=solved.focal_px / working.width_px,
            focal_relative_sigma=math.inf if is_held else 0.1,
            radial_k1=self._hint.radial_k1 if self._hint is not None else 0.0,
            attempts=tuple(self._attempts),
        )
        return self._prediction(frames, verdict, "; ".join(reasons), quality)

    def _rotation_only(self, turned: rotation.RotationFit, working: images.WorkingImages) -> Prediction:
        width, height = images.fitted_size(working.width_px, working.height_px, self._config.sfm.depth_width_px)
        over_width = self._hint.focal_over_width if self._hint is not None else turned.focal_px / working.width_px
        intrinsics = self._intrinsics(over_width * working.width_px, working).resized(width, height)
        nothing = np.zeros((height, width), dtype=np.float32)
        frames = []
        for position in range(len(self._keyframes)):
            original = self._hints.zero_motion_copies.get(position, position)
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
            radial_k1=self._hint.radial_k1 if self._hint is not None else 0.0,
            attempts=tuple(self._attempts),
        )
        return self._prediction(
            tuple(frames), SubmapVerdict.ROTATION_ONLY, "the camera did not move enough to see any depth", quality
        )

    def _failed(self, reason: str) -> Prediction:
        over_width = self._hint.focal_over_width if self._hint is not None else _FALLBACK_FOCAL_OVER_WIDTH
        quality = SubmapQuality(0, math.nan, 0.0, math.nan, over_width, math.inf, 0.0, tuple(self._attempts))
        return self._prediction((), SubmapVerdict.FAILED, reason, quality)

    def _prediction(
        self, frames: tuple[PredictedFrame, ...], verdict: SubmapVerdict, reason: str, quality: SubmapQuality
    ) -> Prediction:
        return Prediction(frames, verdict, reason, ScaleKind.RELATIVE, _MODEL, quality, dict(self._seconds))


def _effective_hint(config: InferenceConfig, hint: FocalHint | None) -> FocalHint | None:
    """The user's intrinsics, where given, before the running estimate."""
    if config.focal_over_width is not None:
        return FocalHint(config.focal_over_width, 0.0, config.radial_k1 or 0.0, is_fixed=True)
    return hint


def _match(detected: Mapping[int, features.Features], positions: Sequence[int]) -> dict[Pair, npt.NDArray[np.int64]]:
    return {
        (a, b): features.match(detected[a], detected[b])
        for index, a in enumerate(positions)
        for b in positions[index + 1 : index + 1 + _MATCH_REACH]
    }


def _agrees(solved: structure.Structure | None, hint: FocalHint, width_px: int) -> bool:
    """Whether a free focal length is within two standard deviations of the hint (at least 2%)."""
    if solved is None:
        return False
    difference = abs(math.log(solved.focal_px / (hint.focal_over_width * width_px)))
    return difference <= max(0.02, 2.0 * hint.relative_sigma)


def _outcome(solved: structure.Structure | None) -> str:
    if solved is None:
        return "no model"
    return f"{len(solved.camera_from_submap)} keyframes, {solved.reprojection_px:.2f} px"


def _nearest_inverse_depth(solved: structure.Structure) -> dict[int, float]:
    """Per frame, the inverse depth beyond which next to nothing lies, from the points that it sees."""
    nearest = {}
    everywhere = []
    for position, pose in solved.camera_from_submap.items():
        seen = solved.points[solved.observation_point[solved.observation_position == position]]
        z = se3.act(pose, seen)[:, 2] if len(seen) else np.zeros(0)
        inverse = 1.0 / z[z > 1e-9]
        everywhere.append(inverse)
        nearest[position] = float(np.percentile(inverse, 98.0)) if len(inverse) >= 20 else math.nan
    values = np.concatenate(everywhere)
    typical = float(np.percentile(values, 98.0)) if len(values) else 1.0
    return {p: 1.5 * (value if math.isfinite(value) else typical) for p, value in nearest.items()}
