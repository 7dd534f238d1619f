"""Weighted closed-form alignment of two point sets (Umeyama, PAMI 1991; symmetric scale: Horn, JOSA A 1987).

Everything the solution needs is in second-order moments, so that a compiled kernel that passes once over the points
solves from the same few numbers as the reference here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from vggt_motion.errors import RegistrationError
from vggt_motion.geometry.sim3 import Sim3

Array = npt.NDArray[np.float64]
ScaleRule = Literal["least_squares", "symmetric", "fixed"]

# Below this ratio of second to first singular value of the cross-covariance the rotation about the main axis is noise.
_COLLINEAR_RATIO = 1e-7


@dataclass(frozen=True)
class Moments:
    """Weighted moments of corresponding points ``x`` (source) and ``y`` (target)."""

    weight: float  # sum of w
    mean_source: Array  # (3,)
    mean_target: Array  # (3,)
    cross: Array  # (3, 3): sum of w (y - mean_y) (x - mean_x)^T / weight
    variance_source: float  # sum of w |x - mean_x|^2 / weight
    variance_target: float


def moments(
    source: npt.NDArray[np.floating], target: npt.NDArray[np.floating], weights: npt.NDArray[np.floating]
) -> Moments:
    """Weighted moments of points (N, 3) and (N, 3) with weights (N,), not negative; accumulated in float64.

    Raises:
        RegistrationError: the weights sum to nothing, or something is not finite.
    """
    x, y, w = (np.asarray(array, dtype=np.float64) for array in (source, target, weights))
    total = float(w.sum())
    if not np.isfinite(total) or total <= 0.0:
        raise RegistrationError("no point has a positive weight")
    mean_x, mean_y = w @ x / total, w @ y / total
    dx, dy = x - mean_x, y - mean_y
    return Moments(
        total,
        mean_x,
        mean_y,
        (dy * w[:, None]).T @ dx / total,
        float(w @ np.einsum("ni,ni->n", dx, dx)) / total,
        float(w @ np.einsum("ni,ni->n", dy, dy)) / total,
    )


def solve(of: Moments, scale: ScaleRule = "least_squares", *, allow_line: bool = False) -> Sim3:
    """``target_from_source`` that minimises ``sum w |y - s R x - t|^2``.

    Args:
        of: moments of the correspondences.
        scale: ``least_squares`` is Umeyama's, which noise in the source pulls below the truth; ``symmetric`` is the
            ratio of the standard deviations, which treats both sides alike (the estimate of the inverse is the inverse
            of the estimate); ``fixed`` keeps 1, a rigid transform.
        allow_line: accept points on a line, and return any one of the rotations that fit them equally well.

    Raises:
        RegistrationError: all points coincide or lie on a line, so that a rotation is not determined.
    """
    if not (np.isfinite(of.cross).all() and of.variance_source > 0.0 and of.variance_target > 0.0):
        raise RegistrationError("points coincide or are not finite")
    u, singular, vt = np.linalg.svd(of.cross)
    if singular[0] <= 0.0 or (singular[1] <= _COLLINEAR_RATIO * singular[0] and not allow_line):
        raise RegistrationError("points lie on a line: the rotation about it is not determined")
    signs = np.array([1.0, 1.0, 1.0 if np.linalg.det(u) * np.linalg.det(vt) > 0.0 else -1.0])
    rotation = (u * signs) @ vt
    if scale == "fixed":
        factor = 1.0
    elif scale == "symmetric":
        factor = float(np.sqrt(of.variance_target / of.variance_source))
    else:
        factor = float(singular @ signs) / of.variance_source
    if not factor > 0.0:
        raise RegistrationError("the scale is not positive: the point sets do not correspond")
    return Sim3(rotation, of.mean_target - factor * (rotation @ of.mean_source), factor)


def align(
    source: npt.NDArray[np.floating],
    target: npt.NDArray[np.floating],
    weights: npt.NDArray[np.floating] | None = None,
    scale: ScaleRule = "least_squares",
) -> Sim3:
    """``target_from_source`` of corresponding points (N, 3); see :func:`moments` and :func:`solve`."""
    return solve(moments(source, target, np.ones(len(source)) if weights is None else weights), scale)
