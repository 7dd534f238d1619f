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

Array = npt.NDArray[np.float64]

_CONVERGED = 1e-7
# The norm of a 3-vector of unit normal components has this median (square root of the chi-squared median with 3
# degrees).
_MEDIAN_OF_NORM = 1.5382
# Float16 depth on the wire is worth 5e-4; no estimate may claim to be better than about that.
_SIGMA_FLOOR = 5e-4
# Neighbouring pixels err together: an anchor image is worth about this many independent points. Measured on KITTI,
# where points against cameras weigh best so (see cameras.py).
_INDEPENDENT_POINTS_PER_FRAME = 500.0
# Beyond these standard deviations (radians, typical depths, logarithm of scale) the points do not determine a
# transform.
MAX_SIGMA = np.array([0.05] * 3 + [0.1] * 3 + [0.1])
# Below this ratio of the extreme eigenvalues of the normal equations, all parts in one unit, something is not seen at
# all.
_SINGULAR = 1e-9


@dataclass(frozen=True)
class Sim3Estimate:
    """What the points say of ``j_from_i``."""

    j_from_i: Sim3
    inlier_ratio: float  # share of the valid points within ``inlier_relative``
    median_relative_residual: float
    information: Array  # (7, 7): rotation, translation, log-scale; left perturbation exp(xi) @ j_from_i, frame j
    centre: Array  # (3,) middle of the points, frame j
    typical_depth: float  # median depth, units of frame j
    point_count: int  # valid points
    iterations: int


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
        config: Huber width, inlier radius, iterations, fewest points.
        fix_scale: both sides are metric: keep the scale 1 (SE(3)); the information of the log-scale is then that of a
            constraint that holds it.
        frame_count: images that the points come from; neighbouring pixels err together, so that it is images and not
            pixels that make an estimate more certain.

    Raises:
        RegistrationError: the input does not determine the transform.
    """
    from vggt_motion.registration import kernels  # importing numba takes longer than registering a pair

    x, y, w, unit = _valid(points_i, points_j, weights, depth_j, config)
    is_relative = config.residual == "depth_relative"
    ones = np.ones_like(unit)
    loss_unit = unit if is_relative else ones
    huber = config.huber_relative if is_relative else config.huber_absolute
    rule: umeyama.ScaleRule = "fixed" if fix_scale else config.scale_rule
    current = Sim3(start.rotation, start.translation, 1.0) if fix_scale else start
    origin_x = x.mean(axis=0, dtype=np.float64)
    origin_y = y.mean(axis=0, dtype=np.float64)
    typical = float(1.0 / np.median(unit))
    iterations, step = 0, np.inf
    while step >= _CONVERGED and iterations < config.max_iterations:
        sums = kernels.accumulate(x, y, w, loss_unit, _affine(current), huber, np.inf, origin_x, origin_y)
        following = umeyama.solve(_moments(sums, origin_x, origin_y), rule)
        step = _step(following, current, origin_y, typical)
        current, iterations = following, iterations + 1
    centre = current.act(origin_x)
    residuals, sums = kernels.score(x, y, w, unit, _affine(current), config.huber_relative, np.inf, centre)
    median = float(np.median(residuals))
    sigma = max(median / _MEDIAN_OF_NORM, _SIGMA_FLOOR)
    independent = min(_INDEPENDENT_POINTS_PER_FRAME * frame_count, len(x)) / len(x)
    normal = _normal_equations(sums / float(w.mean(dtype=np.float64))) * independent / sigma**2
    require_determined(about(normal, -centre), centre, typical, MAX_SIGMA, fix_scale=fix_scale)
    return Sim3Estimate(
        current,
        float(np.mean(residuals <= config.inlier_relative)),
        median,
        about(normal, -centre),
        centre,
        typical,
        len(x),
        iterations,
    )


def residual_statistics(
    points_i: npt.NDArray[np.floating],
    points_j: npt.NDArray[np.floating],
    depth_j: npt.NDArray[np.floating],
    j_from_i: Sim3,
    config: RegistrationConfig,
) -> tuple[float, float]:
    """Inlier ratio and median depth-relative residual of valid points under any transform."""
    relative = np.linalg.norm(j_from_i.act(points_i) - points_j, axis=1) / depth_j
    return float(np.mean(relative <= config.inlier_relative)), float(np.median(relative))


def _valid(
    points_i: npt.NDArray[np.floating],
    points_j: npt.NDArray[np.floating],
    weights: npt.NDArray[np.floating],
    depth_j: npt.NDArray[np.floating],
    config: RegistrationConfig,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """The usable points, their weights and inverse depths, contiguous float32."""
    count = len(points_i)
    if (
        points_i.shape != (count, 3)
        or points_j.shape != (count, 3)
        or weights.shape != (count,)
        or depth_j.shape != (count,)
    ):
        raise ValueError(f"shapes do not fit: {points_i.shape}, {points_j.shape}, {weights.shape}, {depth_j.shape}")
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        x, y = (np.ascontiguousarray(points, dtype=np.float32) for points in (points_i, points_j))
        w, depth = weights.astype(np.float32), depth_j.astype(np.float32)
        # a sum is not finite if and only if a term is not, short of overflow, which is as unusable
        valid = np.isfinite(x.sum(axis=1) + y.sum(axis=1) + w + depth) & (w > 0.0) & (depth > 0.0)
        inverse = 1.0 / depth
    usable = int(np.count_nonzero(valid))
    if usable < config.min_points:
        raise RegistrationError(f"{usable} valid points, at least {config.min_points} are needed")
    if usable == count:
        return x, y, w, inverse
    return x[valid], y[valid], w[valid], inverse[valid]


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


def uncertainty(information: Array, centre: Array, typical_depth: float, *, fix_scale: bool) -> Array:
    """Standard deviations (7,) of rotation (rad), translation (typical depths) and log-scale about a point of frame j.

    Args:
        information: (7, 7) of a left perturbation in frame j.
        centre: (3,) point about which the parts are told apart, the middle of the points.
        typical_depth: unit of the translation.
        fix_scale: the log-scale is known.

    Raises:
        RegistrationError: some part is not determined at all.
    """
    covariance = _covariance(about(information, centre), typical_depth, fix_scale=fix_scale)
    return np.sqrt(np.diag(covariance))


def require_determined(
    information: Array, centre: Array, typical_depth: float, limit: Array, *, fix_scale: bool
) -> None:
    """Refuse a transform of which some part is guessed; arguments as of :func:`uncertainty`, ``limit`` in its units.

    Raises:
        RegistrationError: names the part.
    """
    sigma = uncertainty(information, centre, typical_depth, fix_scale=fix_scale)
    worst = int(np.argmax(sigma / limit))
    if sigma[worst] > limit[worst]:
        part = ("rotation", "translation", "scale")[worst // 3]
        amount = f"{np.degrees(sigma[worst]):.1f} degrees" if worst < 3 else f"{100 * sigma[worst]:.0f} %"
        raise RegistrationError(f"the {part} is uncertain by {amount}")


def with_floor(information: Array, centre: Array, typical_depth: float, floor: Array, *, fix_scale: bool) -> Array:
    """The information (7, 7) after independent errors of standard deviations ``floor`` (7,) are added.

    Arguments as of :func:`uncertainty`; the floor is in its units, about its centre.
    """
    covariance = _covariance(about(information, centre), typical_depth, fix_scale=fix_scale) + np.diag(floor**2)
    unit = _units(typical_depth)
    return about(np.linalg.inv(covariance) / np.outer(unit, unit), -centre)


def about(information: Array, centre: Array) -> Array:
    """Information (7, 7) of the perturbation about ``centre`` instead of about the origin of the frame."""
    to_origin = Sim3(np.eye(3), centre, 1.0).adjoint()
    return np.asarray(to_origin.T @ information @ to_origin, dtype=np.float64)


def _units(typical_depth: float) -> Array:
    return np.array([1.0] * 3 + [typical_depth] * 3 + [1.0])


def _covariance(centred: Array, typical_depth: float, *, fix_scale: bool) -> Array:
    size = 6 if fix_scale else 7
    unit = _units(typical_depth)
    scaled = (centred * np.outer(unit, unit))[:size, :size]
    eigenvalues, vectors = np.linalg.eigh(scaled)
    if not np.isfinite(eigenvalues).all() or eigenvalues[0] <= _SINGULAR * eigenvalues[-1]:
        raise RegistrationError("the points do not determine the transform")
    out = np.zeros((7, 7))
    out[:size, :size] = (vectors / eigenvalues) @ vectors.T
    return out
