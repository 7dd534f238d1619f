"""The camera model: pinhole with two radial coefficients, on the lattice of the image that was recorded.

OpenCV axes (x right, y down, z forward). Pixel centres lie at whole numbers: the top left pixel is (0, 0). With the
normalised ray ``(x, y) = (X/Z, Y/Z)`` and ``r2 = x*x + y*y`` a point is seen at
``u = fx * x * (1 + k1 * r2 + k2 * r2 * r2) + cx``, and ``v`` likewise (OpenCV's k1 and k2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

_UNDISTORT_ITERATIONS = 12
_UNDISTORT_TOLERANCE = 1e-9  # Newton squares it: what is left after such a step is rounding


@dataclass(frozen=True)
class Intrinsics:
    """Focal lengths, principal point and size of the image in pixels; ``k1`` and ``k2`` have no unit."""

    fx: float
    fy: float
    cx: float
    cy: float
    width_px: int
    height_px: int
    k1: float = 0.0
    k2: float = 0.0

    @staticmethod
    def centred(focal_px: float, width_px: int, height_px: int, k1: float = 0.0) -> Intrinsics:
        """Square pixels and the principal point in the middle of the image."""
        return Intrinsics(focal_px, focal_px, 0.5 * (width_px - 1), 0.5 * (height_px - 1), width_px, height_px, k1)

    def resized(self, width_px: int, height_px: int) -> Intrinsics:
        """The same camera on the image resized to ``width_px`` x ``height_px`` (pixel areas aligned, as cv2.resize)."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return Intrinsics(
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            width_px,
            height_px,
            self.k1,
            self.k2,
        )

    def matrix(self) -> npt.NDArray[np.float64]:
        """The (3, 3) pinhole matrix, without distortion."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


def fold_radius(k1: float, k2: float = 0.0) -> float:
    """Radius ``|(x, y)|`` past which the model folds back, as barrel distortion can; inf where it never does."""
    # the smallest positive square of a radius at which the slope 1 + 3 k1 s + 5 k2 s^2 is 0
    if k2 == 0.0:
        return 1.0 / math.sqrt(-3.0 * k1) if k1 < 0.0 else math.inf
    under_root = 9.0 * k1 * k1 - 20.0 * k2
    if under_root < 0.0:
        return math.inf
    roots = [(-3.0 * k1 + sign * math.sqrt(under_root)) / (10.0 * k2) for sign in (-1.0, 1.0)]
    return math.sqrt(min((root for root in roots if root > 0.0), default=math.inf))


def undistort_rays(
    x: npt.NDArray[np.float64], y: npt.NDArray[np.float64], k1: float, k2: float = 0.0
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Normalised coordinates without distortion from distorted ones, by Newton's method on the radius.

    What lies beyond the image of :func:`fold_radius` has no ray and gets that radius.
    """
    if k1 == 0.0 and k2 == 0.0:
        return x, y
    distorted_radius = np.hypot(x, y)
    radius = distorted_radius.copy()
    fold = fold_radius(k1, k2)
    for _ in range(_UNDISTORT_ITERATIONS):
        square = k1 * radius * radius
        fourth = k2 * radius * radius * radius * radius
        slope = np.maximum(1.0 + 3.0 * square + 5.0 * fourth, 0.1)
        step = (radius * (1.0 + square + fourth) - distorted_radius) / slope
        radius = np.clip(radius - step, 0.0, fold)
        if np.abs(step).max(initial=0.0) < _UNDISTORT_TOLERANCE:
            break
    factor = np.where(distorted_radius > 1e-12, radius / np.maximum(distorted_radius, 1e-12), 1.0)
    return x * factor, y * factor


def pixel_rays(intrinsics: Intrinsics) -> npt.NDArray[np.float64]:
    """Rays (H, W, 3) of all pixels in the camera frame, scaled so that z is 1."""
    u, v = np.meshgrid(
        np.arange(intrinsics.width_px, dtype=np.float64), np.arange(intrinsics.height_px, dtype=np.float64)
    )
    x, y = undistort_rays(
        (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, intrinsics.k1, intrinsics.k2
    )
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def unproject(depth: npt.NDArray[np.floating], intrinsics: Intrinsics) -> npt.NDArray[np.float64]:
    """Point map (H, W, 3) in the camera frame of a depth map (H, W) along the optical axis, same unit."""
    return pixel_rays(intrinsics) * np.asarray(depth, dtype=np.float64)[..., None]


def project(points_camera: npt.NDArray[np.floating], intrinsics: Intrinsics) -> npt.NDArray[np.float64]:
    """Pixels (..., 2) of points (..., 3) in the camera frame; NaN where the point is not in front of the camera."""
    points = np.asarray(points_camera, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
        x, y = points[..., 0] / z, points[..., 1] / z
        square = x * x + y * y
        factor = 1.0 + intrinsics.k1 * square + intrinsics.k2 * square * square
    return np.stack([intrinsics.fx * x * factor + intrinsics.cx, intrinsics.fy * y * factor + intrinsics.cy], axis=-1)
