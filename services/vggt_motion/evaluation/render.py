"""Pictures of a point cloud by z-buffer splatting, in numpy: from above, and as a camera sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, project

BACKGROUND_RGB = (16, 20, 27)

_Image = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class PlanView:
    """A picture from above: the world's x-z plane, where x points right and z ahead of the first camera."""

    image: _Image  # (H, W, 3) RGB; row 0 is the far end (z_max), column 0 the left end (x_min)
    x_min: float
    x_max: float
    z_min: float
    z_max: float


def _splat(
    image: _Image,
    column: npt.NDArray[np.floating],
    row: npt.NDArray[np.floating],
    distance: npt.NDArray[np.floating],
    colors: _Image,
    radius_px: npt.NDArray[np.int64],
) -> None:
    """Draw points as squares of 2 r + 1 px, the nearest on top; equal distances are resolved by the order of points."""
    height, width = image.shape[:2]
    # Far to near, later points first: among writes to one pixel numpy keeps the last.
    order = np.lexsort((-np.arange(len(distance)), -distance))
    base_column, base_row = np.rint(column[order]).astype(np.int64), np.rint(row[order]).astype(np.int64)
    distance, colors, radius_px = distance[order], colors[order], radius_px[order]
    nearest = np.full(height * width, np.inf)
    owner = np.full(height * width, -1, np.int64)
    for reach in range(int(radius_px.max(initial=-1)) + 1):
        members = np.flatnonzero(radius_px >= reach)
        for dy, dx in _ring(reach):
            c, r = base_column[members] + dx, base_row[members] + dy
            inside = (c >= 0) & (c < width) & (r >= 0) & (r < height)
            candidate = np.full(height * width, -1, np.int64)
            candidate[(r * width + c)[inside]] = members[inside]
            hit = np.flatnonzero(candidate >= 0)
            hit = hit[distance[candidate[hit]] < nearest[hit]]
            owner[hit] = candidate[hit]
            nearest[hit] = distance[candidate[hit]]
    drawn = owner >= 0
    image.reshape(-1, 3)[drawn] = colors[owner[drawn]]


def _ring(reach: int) -> list[tuple[int, int]]:
    span = range(-reach, reach + 1)
    return [(dy, dx) for dy in span for dx in span if max(abs(dy), abs(dx)) == reach]


def plan_view(
    points: npt.NDArray[np.floating],
    colors: _Image,
    bounds: tuple[float, float, float, float],
    width_px: int = 1400,
    ceiling: float | None = None,
) -> PlanView:
    """The cloud from above, parallel projection along the world's y axis (down), the highest point on top.

    Args:
        points: (N, 3), world units, y down.
        colors: (N, 3) RGB.
        bounds: x_min, x_max, z_min, z_max of the picture, world units.
        width_px: width of the picture; the height follows from the bounds.
        ceiling: points with y below it (higher up than it) are left out, so that what spans the road does not hide it.
    """
    x_min, x_max, z_min, z_max = bounds
    px_per_unit = width_px / max(x_max - x_min, 1e-9)
    height_px = int(np.clip(round((z_max - z_min) * px_per_unit), 1, 8 * width_px))
    image = np.full((height_px, width_px, 3), BACKGROUND_RGB, np.uint8)
    keep = np.isfinite(points).all(axis=1)
    keep &= (points[:, 0] >= x_min) & (points[:, 0] <= x_max) & (points[:, 2] >= z_min) & (points[:, 2] <= z_max)
    if ceiling is not None:
        keep &= points[:, 1] >= ceiling
    kept = np.asarray(points[keep], np.float64)
    column = (kept[:, 0] - x_min) * px_per_unit - 0.5
    row = (z_max - kept[:, 2]) * px_per_unit - 0.5
    # A sparse cloud is drawn with larger dots, until they could cover the picture once.
    wanted_px = np.sqrt(height_px * width_px / max(len(kept), 1))
    radius = np.full(len(kept), int(np.clip(np.rint((wanted_px - 1.0) / 2.0), 0, 1)), np.int64)
    _splat(image, column, row, kept[:, 1], colors[keep], radius)
    return PlanView(image, x_min, x_max, z_min, z_max)


def camera_view(
    points: npt.NDArray[np.floating],
    colors: _Image,
    world_from_camera: npt.NDArray[np.float64],
    intrinsics: Intrinsics,
    point_size: float,
) -> _Image:
    """The cloud as a pinhole camera sees it: (H, W, 3) RGB of the size of ``intrinsics``.

    Args:
        points: (N, 3), world units.
        colors: (N, 3) RGB.
        world_from_camera: (4, 4).
        intrinsics: size and focal length of the picture.
        point_size: edge of a point, world units: near points cover more pixels.
    """
    image = np.full((intrinsics.height_px, intrinsics.width_px, 3), BACKGROUND_RGB, np.uint8)
    is_finite = np.isfinite(points).all(axis=1)
    points, colors = points[is_finite], colors[is_finite]
    in_camera = se3.act(se3.inverse(world_from_camera), np.asarray(points, np.float64))
    pixels = project(in_camera, intrinsics)
    radius_limit = 3
    keep = np.isfinite(pixels).all(axis=1) & (in_camera[:, 2] > point_size)
    keep &= (pixels[:, 0] > -radius_limit) & (pixels[:, 0] < intrinsics.width_px + radius_limit)
    keep &= (pixels[:, 1] > -radius_limit) & (pixels[:, 1] < intrinsics.height_px + radius_limit)
    depth, pixels = in_camera[keep, 2], pixels[keep]
    radius = np.clip(np.rint(0.5 * (intrinsics.fx * point_size / depth - 1.0)), 0, radius_limit).astype(np.int64)
    _splat(image, pixels[:, 0], pixels[:, 1], depth, colors[keep], radius)
    return image
