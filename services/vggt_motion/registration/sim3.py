"""Robust Sim(3) between two point maps of the same pixels (paper eq. 10, DESIGN 3.5).

Iteratively re-weighted closed form: Huber weights on residuals relative to depth, then the weighted alignment of
Umeyama, until it stands still. Depth-relative residuals have no unit, so that the Huber width and the inlier radius
hold for any submap scale, and far points, whose errors are large, cannot rule.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vggt_motion.config import RegistrationConfig
from vggt_motion.errors import RegistrationError
from vggt_motion.geometry import se3, umeyama
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.registration.uncertainty import about, require_determined

Array = npt.NDArray[np.float64]

_CONVERGED = 1e-5  # radians, typical depths, logarithm of scale: a hundredth of what an edge is worth
# A part of the points finds the weights nearly as well as all of them, which then need few passes.
_COARSE_STRIDE, _COARSE_CONVERGED, _COARSE_MIN_POINTS = 5, 1e-3, 10_000
_MEDIAN_POINTS = 16_384  # know the median to one part in a hundred of the spread
# The norm of a vector of three unit normal components has this median: the root of that of chi-squared.
_MEDIAN_OF_NORM = 1.5382
# Float16 depth on the wire is worth 5e-4; no estimate may claim to be better than about that.
_SIGMA_FLOOR = 5e-4
# Neighbouring pixels err together: an anchor image is worth about this many independent points. Measured on KITTI,
# where points against cameras weigh best so (see cameras.py).
_INDEPENDENT_POINTS_PER_FRAME = 500.0
# Beyond these standard deviations (radians, typical depths, logarithm of scale) the points determine no transform.
_MAX_SIGMA = np.array([0.05] * 3 + [0.1] * 3 + [0.1])


@dataclass(frozen=True)
class PointPairs:
    """Corresponding points of both submaps, all usable, by coordinate."""

    in_i: npt.NDArray[np.float32]  # (3, N)
    in_j: npt.NDArray[np.float32]  # (3, N)
    weight: npt.NDArray[np.float32]  # (N,), positive
    inverse_depth: npt.NDArray[np.float32]  # (N,), units of j; the unit of the residuals
    frame_count: int  # images they come from

    def __len__(self) -> int:
        return len(self.weight)


@dataclass(frozen=True)
class Sim3Estimate:
    """What the points say of ``j_from_i``."""

    j_from_i: Sim3
    inlier_ratio: float  # share of the valid points within ``inlier_relative``
    median_relative_residual: float
    information: Array  # (7, 7): rotation, translation, log-scale; left perturbation exp(xi) @ j_from_i, frame j
    centre: Array  # (3,) middle of the points, frame j
    typical_depth: float  # harmonic mean depth, units of frame j
    point_count: int  # valid points
    iterations: int  # passes over all points


def estimate_sim3(
    points_i: npt.NDArray[np.floating],
    points_j: npt.NDArray[np.floating],
    weights: npt.NDArray[np.floating],
    depth_j: npt.NDArray[np.floating],
    start: Sim3,
    config: RegistrationConfig,
    *,
    fix_scale: bool = False,
    frame_count: int = 1,
) -> Sim3Estimate:
    """Estimate the similarity that takes points of submap i to submap j.

    Args:
        points_i: (N, 3) in frame i. Points that are not finite, or of no weight or depth, are left out.
        points_j: (N, 3) in frame j, the same pixels.
        weights: (N,), not negative.
        depth_j: (N,) depth of each pixel along the optical axis, units of frame j; the unit of its residual.
        start: where the weights start; it must be robust itself, or the first fit is lost to outliers.
        config: loss, scale rule, inlier radius, iterations, fewest points.
        fix_scale: both sides are metric: keep the scale 1 (SE(3)); only the first six rows of the information count
            then.
        frame_count: images that the points come from; neighbouring pixels err together, so that it is images and not
            pixels that make an estimate more certain.

    Raises:
        RegistrationError: the input does not determine the transform.
    """
    from vggt_motion.registration import kernels  # importing numba takes longer than registering a pair

    count = len(points_i)
    if not (points_i.shape == points_j.shape == (count, 3) and weights.shape == depth_j.shape == (count,)):
        raise ValueError(f"shapes: {points_i.shape}, {points_j.shape}, {weights.shape}, {depth_j.shape}")
    pairs = PointPairs(*kernels.gather(points_i, points_j, weights, depth_j), frame_count)
    return estimate_from_pairs(pairs, start, config, fix_scale=fix_scale)


def estimate_from_pairs(
    pairs: PointPairs, start: Sim3, config: RegistrationConfig, *, fix_scale: bool = False
) -> Sim3Estimate:
    """:func:`estimate_sim3` for points that are prepared already."""
    from vggt_motion.registration import kernels

    if len(pairs) < max(config.min_points, 3):
        raise RegistrationError(f"{len(pairs)} valid points, at least {config.min_points} are needed")
    x, y, w, unit = pairs.in_i, pairs.in_j, pairs.weight, pairs.inverse_depth
    origin_x, origin_y = (points.mean(axis=1, dtype=np.float64) for points in (x, y))
    typical = float(1.0 / unit.mean(dtype=np.float64))
    is_relative = config.residual == "depth_relative"
    loss_unit = unit if is_relative else np.ones_like(unit)
    huber = config.huber_relative if is_relative else config.huber_absolute
    rule: umeyama.ScaleRule = "fixed" if fix_scale else config.scale_rule
    current = Sim3(start.rotation, start.translation, 1.0) if fix_scale else start

    def improve(transform: Sim3, stride: int, converged: float) -> tuple[Sim3, int]:
        iterations, step = 0, np.inf
        while step >= converged and iterations < config.max_iterations:
            sums = kernels.accumulate(x, y, w, loss_unit, _affine(transform), huber, origin_x, origin_y, stride)
            following = umeyama.solve(_moments(sums, origin_x, origin_y), rule)
            step = _step(following, transform, origin_y, typical)
            transform, iterations = following, iterations + 1
        return transform, iterations

    if len(pairs) >= _COARSE_MIN_POINTS:
        current, _ = improve(current, _COARSE_STRIDE, _COARSE_CONVERGED)
    current, iterations = improve(current, 1, _CONVERGED)
    centre = current.act(origin_x)
    residuals, second = kernels.score(x, y, w, unit, _affine(current), config.huber_relative, centre)
    median = _median(residuals)
    sigma = max(median / _MEDIAN_OF_NORM, _SIGMA_FLOOR)
    independent = min(_INDEPENDENT_POINTS_PER_FRAME * pairs.frame_count, len(pairs)) / float(w.sum(dtype=np.float64))
    information = about(_normal_equations(second) * independent / sigma**2, -centre)
    require_determined(information, centre, typical, _MAX_SIGMA, fix_scale=fix_scale)
    return Sim3Estimate(
        current,
        float(np.mean(residuals <= config.inlier_relative)),
        median,
        information,
        centre,
        typical,
        len(pairs),
        iterations,
    )


def residual_statistics(pairs: PointPairs, j_from_i: Sim3, config: RegistrationConfig) -> tuple[float, float]:
    """Inlier ratio and median depth-relative residual under any transform."""
    from vggt_motion.registration import kernels

    x, y, w, unit = pairs.in_i, pairs.in_j, pairs.weight, pairs.inverse_depth
    residuals, _ = kernels.score(x, y, w, unit, _affine(j_from_i), config.huber_relative, np.zeros(3))
    return float(np.mean(residuals <= config.inlier_relative)), _median(residuals)


def _median(values: npt.NDArray[np.float32]) -> float:
    """Median of values (N,), of an even choice of them where they are many."""
    return float(np.median(values[:: max(1, len(values) // _MEDIAN_POINTS)]))


def _affine(transform: Sim3) -> Array:
    return np.ascontiguousarray(transform.matrix()[:3])


def _moments(sums: Array, origin_x: Array, origin_y: Array) -> umeyama.Moments:
    total = float(sums[0])
    if not total > 0.0:
        raise RegistrationError("no point agrees with the start")
    dx, dy = sums[1:4] / total, sums[4:7] / total
    return umeyama.Moments(
        total,
        origin_x + dx,
        origin_y + dy,
        sums[7:16].reshape(3, 3) / total - np.outer(dy, dx),
        float(sums[16]) / total - float(dx @ dx),
        float(sums[17]) / total - float(dy @ dy),
    )


def _step(following: Sim3, current: Sim3, centre: Array, typical_depth: float) -> float:
    """How far the transform moved, without unit: radians, typical depths, logarithm of scale."""
    change = following @ current.inverse()
    moved = np.linalg.norm(change.act(centre) - centre) / typical_depth
    return float(np.linalg.norm(se3.so3_log(change.rotation)) + moved + abs(np.log(change.scale)))


def _normal_equations(sums: Array) -> Array:
    """``sum of w J^T J`` (7, 7) with ``J = [-skew(p), I, p]``, the derivative of ``exp(xi) p``."""
    total, first = float(sums[0]), sums[1:4]
    second = np.array([[sums[4], sums[5], sums[6]], [sums[5], sums[7], sums[8]], [sums[6], sums[8], sums[9]]])
    trace = float(np.trace(second))
    out = np.zeros((7, 7))
    out[:3, :3] = trace * np.eye(3) - second
    out[:3, 3:6] = se3.skew(first)
    out[3:6, :3] = out[:3, 3:6].T
    out[3:6, 3:6] = total * np.eye(3)
    out[3:6, 6] = out[6, 3:6] = first
    out[6, 6] = trace
    return out
