"""Anchor-driven registration of two submaps (paper section 3.2, DESIGN 3.5).

Both submaps hold point maps of the same images, so that a pixel is its own correspondence. The context-balanced
middle of the overlap is tried first; what fails there is tried on wider anchors up to the whole overlap, and every
attempt is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vggt_motion.config import RegistrationConfig
from vggt_motion.errors import RegistrationError
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, fold_radius
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import Constraint, ConstraintKind, RegistrationAttempt, RegistrationSpec
from vggt_motion.registration.cameras import align as align_cameras
from vggt_motion.registration.cameras import fuse, mean_rotation, witnesses
from vggt_motion.registration.sim3 import PointPairs, estimate_from_pairs, residual_statistics
from vggt_motion.registration.uncertainty import require_determined, with_floor

Array = npt.NDArray[np.float64]

_WINDOWS: dict[str, int | None] = {"window1": 1, "window3": 3, "window5": 5, "full": None}
# Depth triangulated over a baseline a hundred times shorter hangs on a disparity of a few pixels.
_MAX_DEPTH_OVER_BASELINE = 100.0
_MIN_BASELINE_FRAMES = 3
# Standard deviation of the valid pixels' rays across their main direction; below it they lie along a line in the image.
_MIN_RAY_SPREAD = 0.01
# Width of the middle 80 % of log-depth; below it the depth map is a constant, as of a predictor that saw nothing.
_MIN_LOG_DEPTH_SPREAD = 0.02
_STATISTIC_PIXELS = 16_384  # enough for the quantiles behind a refusal, and for the start
# Points and cameras of the same submaps that differ by more contradict each other, as in a mirrored submap.
_MAX_DISAGREEMENT_RAD = 0.2
# Beyond these standard deviations (radians, typical depths, logarithm of scale) a part of the transform is guessed.
_MAX_SIGMA = np.array([0.02] * 3 + [0.05] * 3 + [0.05])
# Residual of a camera centre, in baselines, at which it still counts as an inlier when the cameras stand alone.
_MAX_CAMERA_RESIDUAL = 0.1
# However well its anchor fits, an edge between two submaps is no better than the submaps are rigid. Standard
# deviations per axis (radians, typical depths, logarithm of scale) of adjacent edges of the predictor "sfm" against
# ground truth on KITTI 00 and 06.
_SUBMAP_SIGMA = np.array([0.007] * 3 + [0.02] * 3 + [0.02])


# An edge to a submap without translations: rotations as far apart as this still agree, and its standard deviations
# (radians, units of the submap, logarithm of scale) say that position and scale are an assumption.
_MAX_ROTATION_DISAGREEMENT_DEG = 2.0
_CARRIED_SIGMA = np.array([0.01] * 3 + [0.5] * 3 + [0.5])


@dataclass(frozen=True)
class AnchorView:
    """One keyframe as one submap sees it."""

    depth: npt.NDArray[np.float32]  # (H, W) along the optical axis, submap units, 0 where unknown
    confidence: npt.NDArray[np.float32]  # (H, W) in [0, 1], 0 where unknown or sky
    intrinsics: Intrinsics  # of that lattice
    submap_from_camera: Array  # (4, 4)


@dataclass(frozen=True)
class SharedFrame:
    """One keyframe as both submaps see it."""

    keyframe_id: str
    in_i: AnchorView
    in_j: AnchorView


def register(
    spec: RegistrationSpec,
    shared: Sequence[SharedFrame],
    config: RegistrationConfig,
    *,
    fix_scale: bool = False,
) -> Constraint:
    """Align submap i to submap j by the keyframes that both contain.

    Args:
        spec: which pair, and the keyframes W that both contain.
        shared: those of W that are registered on both sides, in time order.
        config: anchor to begin with, masks, robust estimation, acceptance.
        fix_scale: both sides are metric: SE(3).

    Returns:
        The constraint; refused, with a reason, where no anchor gives a trustworthy transform. Never raises for hard
        input.
    """
    attempts: list[RegistrationAttempt] = []
    for name, frames, estimate_by in _ladder(spec, shared, config.anchor):
        ids = tuple(frame.keyframe_id for frame in frames)
        try:
            found = estimate_by(frames, shared, config, fix_scale)
        except RegistrationError as error:
            attempts.append(RegistrationAttempt(name, ids, 0, 0.0, float("nan"), str(error)))
            continue
        is_accepted = found.inlier_ratio >= config.min_inlier_ratio
        outcome = f"inlier ratio {found.inlier_ratio:.2f} is below {config.min_inlier_ratio:.2f}"
        attempts.append(
            RegistrationAttempt(
                *(name, ids, found.count, found.inlier_ratio, found.median_relative_residual),
                "accepted" if is_accepted else outcome,
            )
        )
        if is_accepted:
            return Constraint(
                spec=spec,
                accepted=True,
                reason="",
                j_from_i=found.j_from_i,
                inlier_ratio=found.inlier_ratio,
                median_relative_residual=found.median_relative_residual,
                information=found.information,
                point_count=found.count,
                attempts=tuple(attempts),
            )
    reason = "; ".join(f"{attempt.anchor}: {attempt.outcome}" for attempt in attempts)
    return Constraint(
        spec=spec,
        accepted=False,
        reason=reason or "no keyframe is registered in both submaps",
        j_from_i=Sim3.identity(),
        inlier_ratio=max((attempt.inlier_ratio for attempt in attempts), default=0.0),
        median_relative_residual=float("nan"),
        information=np.zeros((7, 7)),
        point_count=0,
        attempts=tuple(attempts),
    )


@dataclass(frozen=True)
class _Found:
    """What one anchor gives."""

    j_from_i: Sim3
    information: Array  # (7, 7), floor included
    inlier_ratio: float
    median_relative_residual: float
    count: int  # of points, or of cameras


_Estimator = Callable[[Sequence[SharedFrame], Sequence[SharedFrame], RegistrationConfig, bool], _Found]


def _ladder(
    spec: RegistrationSpec, shared: Sequence[SharedFrame], first: str
) -> list[tuple[str, tuple[SharedFrame, ...], _Estimator]]:
    """Anchors from the configured one to the whole overlap, each set of frames once; then the cameras alone.

    The cameras are for adjacent submaps only: there a refusal breaks the trajectory, while a loop can be done without.
    """
    place = {keyframe_id: position for position, keyframe_id in enumerate(spec.shared_keyframe_ids)}
    middle = len(spec.shared_keyframe_ids) // 2
    # where the middle frame itself is not registered on both sides, the nearest one takes its place
    nearest = sorted(shared, key=lambda frame: (abs(place[frame.keyframe_id] - middle), place[frame.keyframe_id]))
    names = list(_WINDOWS)
    ladder: list[tuple[str, tuple[SharedFrame, ...], _Estimator]] = []
    for name in names[names.index(first) :]:
        size = _WINDOWS[name]
        chosen = tuple(sorted(nearest[:size], key=lambda frame: place[frame.keyframe_id]))
        if chosen and (not ladder or len(chosen) > len(ladder[-1][1])):
            ladder.append((name, chosen, _by_points))
    if ladder and spec.kind is ConstraintKind.ADJACENT:
        ladder.append(("cameras", tuple(shared), _by_cameras))
        ladder.append(("rotation", tuple(shared), _by_rotation))
    return ladder


def _by_points(
    frames: Sequence[SharedFrame], shared: Sequence[SharedFrame], config: RegistrationConfig, fix_scale: bool
) -> _Found:
    """Align by the point maps of the anchor, with all shared cameras as witnesses."""
    # 1. pixels that both sides trust
    masks = [_valid_pixels(frame, config) for frame in frames]
    depth_i = np.concatenate([frame.in_i.depth[mask] for frame, mask in zip(frames, masks, strict=True)])
    depth_j = np.concatenate([frame.in_j.depth[mask] for frame, mask in zip(frames, masks, strict=True)])
    if len(depth_i) < config.min_points:
        raise RegistrationError(f"{len(depth_i)} valid pixels, at least {config.min_points} are needed")
    thinned = slice(None, None, max(1, len(depth_i) // _STATISTIC_PIXELS))
    depth_i, depth_j = depth_i[thinned], depth_j[thinned]
    _check_depths(depth_i, depth_j, shared)
    # 2. a robust start: rotation of the shared cameras, median depth ratio
    scale = 1.0 if fix_scale else float(np.median(depth_j / depth_i))
    in_i, in_j = ([getattr(f, side).submap_from_camera for f in shared] for side in ("in_i", "in_j"))
    rotation = mean_rotation(np.array(in_i), np.array(in_j))
    start = _start(frames, rotation, scale)
    # 3. the same pixel is the same point
    pairs = _point_pairs(frames, masks, scale)
    estimate = estimate_from_pairs(pairs, start, config, fix_scale=fix_scale)
    # 4. the cameras are witnesses too
    turned = float(np.linalg.norm(se3.so3_log(estimate.j_from_i.rotation @ rotation.T)))
    if turned > _MAX_DISAGREEMENT_RAD:
        raise RegistrationError(f"points and cameras disagree by {np.degrees(turned):.0f} degrees")
    cameras = witnesses(in_i, in_j, estimate.typical_depth)
    fused, information = fuse(estimate.j_from_i, estimate.information, cameras, fix_scale=fix_scale)
    require_determined(information, estimate.centre, estimate.typical_depth, _MAX_SIGMA, fix_scale=fix_scale)
    inlier_ratio, median = residual_statistics(pairs, fused, config)
    information = with_floor(information, estimate.centre, estimate.typical_depth, _SUBMAP_SIGMA, fix_scale=fix_scale)
    return _Found(fused, information, inlier_ratio, median, estimate.point_count)


def _by_cameras(
    frames: Sequence[SharedFrame], _shared: Sequence[SharedFrame], _config: RegistrationConfig, fix_scale: bool
) -> _Found:
    """Align by the shared cameras alone, where the submaps agree on them although they do not on the points."""
    in_i, in_j = ([getattr(f, side).submap_from_camera for f in frames] for side in ("in_i", "in_j"))
    transform, information = align_cameras(in_i, in_j, fix_scale=fix_scale)
    centres_i, centres_j = (np.array([pose[:3, 3] for pose in poses]) for poses in (in_i, in_j))
    middle = centres_j.mean(axis=0)
    baseline = float(np.linalg.norm(centres_j - middle, axis=1).max())
    relative = np.linalg.norm(transform.act(centres_i) - centres_j, axis=1) / baseline
    information = with_floor(information, middle, baseline, 2.0 * _SUBMAP_SIGMA, fix_scale=fix_scale)
    inlier_ratio = float(np.mean(relative <= _MAX_CAMERA_RESIDUAL))
    return _Found(transform, information, inlier_ratio, float(np.median(relative)), len(frames))


def _by_rotation(
    frames: Sequence[SharedFrame], _shared: Sequence[SharedFrame], _config: RegistrationConfig, fix_scale: bool
) -> _Found:
    """Align where one side knows rotations only: the camera stands where it last was, and the unit is carried over."""
    if not any(all(_has_turned_only(frames, side)) for side in ("in_i", "in_j")):
        raise RegistrationError("both submaps know translations")
    in_i, in_j = (np.array([getattr(f, side).submap_from_camera for f in frames]) for side in ("in_i", "in_j"))
    rotation = mean_rotation(in_i, in_j)
    traces = np.einsum("ab,kbc,kac->k", rotation, in_i[:, :3, :3], in_j[:, :3, :3])
    agreeing = np.degrees(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0))) <= _MAX_ROTATION_DISAGREEMENT_DEG
    # the last shared frame, because what follows goes on from there
    centre_j = in_j[-1, :3, 3]
    transform = Sim3(rotation, centre_j - rotation @ in_i[-1, :3, 3], 1.0)
    information = with_floor(1e12 * np.eye(7), centre_j, 1.0, _CARRIED_SIGMA, fix_scale=fix_scale)
    return _Found(transform, information, float(agreeing.mean()), 0.0, len(frames))


def _has_turned_only(frames: Sequence[SharedFrame], side: str) -> list[bool]:
    """Per shared frame, whether this submap holds it without any depth, where it holds the first one."""
    first: AnchorView = getattr(frames[0], side)
    views: list[AnchorView] = [getattr(frame, side) for frame in frames]
    return [
        not view.confidence.any()
        and np.allclose(view.submap_from_camera[:3, 3], first.submap_from_camera[:3, 3], rtol=0.0, atol=1e-9)
        for view in views
    ]


def _valid_pixels(frame: SharedFrame, config: RegistrationConfig) -> npt.NDArray[np.bool_]:
    """Pixels (H, W) that both sides know and trust (paper eq. 9); sky has no confidence."""
    if frame.in_i.depth.shape != frame.in_j.depth.shape:
        raise RegistrationError(f"the point maps of {frame.keyframe_id} have different sizes")
    with np.errstate(invalid="ignore"):
        confidence = np.minimum(frame.in_i.confidence, frame.in_j.confidence)
        known = (confidence > 0.0) & (frame.in_i.depth > 0.0) & (frame.in_j.depth > 0.0)
    known &= np.isfinite(frame.in_i.depth) & np.isfinite(frame.in_j.depth) & np.isfinite(confidence)
    return known & (confidence >= _threshold(confidence[known], config))


def _threshold(confidence: npt.NDArray[np.float32], config: RegistrationConfig) -> float:
    """The lowest confidence to use, from those of all known pixels of an anchor."""
    if confidence.size == 0:
        return 1.0
    match config.confidence_mode:
        case "quantile":
            return float(np.quantile(confidence, min(config.confidence_value, 1.0)))
        case "mean_coef":
            return config.confidence_value * float(confidence.mean(dtype=np.float64))
        case "median_coef":
            return config.confidence_value * float(np.median(confidence))
        case "absolute":
            return config.confidence_value


def _check_depths(
    depth_i: npt.NDArray[np.float32], depth_j: npt.NDArray[np.float32], shared: Sequence[SharedFrame]
) -> None:
    """Refuse depths that give a consistent but worthless transform.

    Raises:
        RegistrationError: all depths are one, or all points are so far away that their depth is not seen.
    """
    for depth in (depth_i, depth_j):
        low, high = np.quantile(depth, [0.1, 0.9])
        if float(np.log(high / low)) < _MIN_LOG_DEPTH_SPREAD:
            raise RegistrationError("all points are at one depth")
    if len(shared) >= _MIN_BASELINE_FRAMES:
        for side, depth in (("in_i", depth_i), ("in_j", depth_j)):
            centres = np.array([getattr(frame, side).submap_from_camera[:3, 3] for frame in shared])
            baseline = float(np.linalg.norm(centres - centres[0], axis=1).max())
            if float(np.median(depth)) > _MAX_DEPTH_OVER_BASELINE * baseline:
                raise RegistrationError(
                    "all points are far: the cameras of the overlap hardly move against their depth"
                )


def _point_pairs(frames: Sequence[SharedFrame], masks: Sequence[npt.NDArray[np.bool_]], scale: float) -> PointPairs:
    """The masked pixels of the anchor as corresponding points.

    The residual of a pixel is measured in the geometric mean of both depths. Both err: dividing by one of them would
    favour the points that this side happens to see too near, and pull the scale of every edge in the same direction.

    Raises:
        RegistrationError: the pixels lie along a line in the image, so that a plane seen edge-on is all there is.
    """
    from vggt_motion.registration import kernels  # importing numba takes longer than registering a pair

    parts, rays = [], np.zeros(5)
    for frame, mask in zip(frames, masks, strict=True):
        x, y, inverse_depth, sums = kernels.unproject_pair(
            np.ascontiguousarray(frame.in_i.depth, dtype=np.float32),
            np.ascontiguousarray(frame.in_j.depth, dtype=np.float32),
            mask,
            _camera(frame.in_i.intrinsics),
            _camera(frame.in_j.intrinsics),
            np.ascontiguousarray(frame.in_i.submap_from_camera, dtype=np.float64),
            np.ascontiguousarray(frame.in_j.submap_from_camera, dtype=np.float64),
            scale,
        )
        parts.append((x, y, inverse_depth))
        rays += sums
    count = sum(len(part[2]) for part in parts)
    mean = rays[:2] / count
    scatter = np.array([[rays[2], rays[3]], [rays[3], rays[4]]]) / count - np.outer(mean, mean)
    if float(np.linalg.eigvalsh(scatter)[0]) < _MIN_RAY_SPREAD**2:
        raise RegistrationError("the valid pixels lie along a line in the image")
    if len(parts) == 1:
        x, y, inverse_depth = parts[0]
    else:
        x, y = (np.concatenate([part[side] for part in parts], axis=1) for side in (0, 1))
        inverse_depth = np.concatenate([part[2] for part in parts])
    return PointPairs(x, y, np.ones(count, np.float32), inverse_depth, len(frames))


def _camera(intrinsics: Intrinsics) -> Array:
    """Focal lengths, principal point, k1, k2, and the radius at which a barrel distortion folds back."""
    known = intrinsics
    fold = fold_radius(known.k1, known.k2)
    return np.array([known.fx, known.fy, known.cx, known.cy, known.k1, known.k2, fold])


def _start(frames: Sequence[SharedFrame], rotation: Array, scale: float) -> Sim3:
    """Similarity of given rotation and scale that takes the anchors' camera centres onto each other, on average."""
    centre_i = np.mean([frame.in_i.submap_from_camera[:3, 3] for frame in frames], axis=0)
    centre_j = np.mean([frame.in_j.submap_from_camera[:3, 3] for frame in frames], axis=0)
    return Sim3(rotation, centre_j - scale * (rotation @ centre_i), scale)
