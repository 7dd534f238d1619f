"""Is there any parallax? The rotation-only model of a submap, kept when nothing else can be known."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vggt_motion.geometry.se3 import nearest_rotation

Array = npt.NDArray[np.float64]
Pair = tuple[int, int]

_FOCAL_GRID = (0.9, 0.4, 0.6, 1.3, 2.0, 3.0)  # focal length / image width, the likeliest first
_HOPELESS_PX = 10.0  # no other focal length brings such residuals down to nothing
_TELLING_TURN_DEG = 10.0
_ITERATIONS = 8
_WINDOW_STEPS = 3  # over which a slow motion shows
_MIN_MATCHES = 12


@dataclass(frozen=True)
class RotationFit:
    """How well a rotating, not moving camera explains the matches."""

    camera_from_submap: dict[int, Array]  # position -> (3, 3) rotation, chained over neighbours
    focal_px: float
    residual_px: float  # upper quartile over the pairs of their median residual

    @property
    def shows_focal(self) -> bool:
        """Whether the camera turned far enough for the focal length to mean anything."""
        first = self.camera_from_submap[min(self.camera_from_submap)]
        cosines = [0.5 * (np.trace(first.T @ rotation) - 1.0) for rotation in self.camera_from_submap.values()]
        return bool(min(cosines) < math.cos(math.radians(_TELLING_TURN_DEG)))


def fit_rotation(points_a: Array, points_b: Array, focal_px: float) -> tuple[Array, Array]:
    """Robust rotation ``b_from_a`` (3, 3) and residuals (N,) in pixels.

    Points (N, 2) are in pixels relative to the principal point.
    """
    rays_a = _rays(points_a, focal_px)
    rays_b = _rays(points_b, focal_px)
    weights = np.ones(len(rays_a))
    rotation = np.eye(3)
    residuals = np.zeros(len(rays_a))
    for _ in range(_ITERATIONS):
        rotation = nearest_rotation((rays_b * weights[:, None]).T @ rays_a)
        residuals = _residuals(rays_a @ rotation.T, points_b, focal_px)
        scale = max(float(np.median(residuals)), 0.05)
        weights = 1.0 / (1.0 + (residuals / (2.0 * scale)) ** 2)
    return rotation, residuals


def fit_rotations(
    matched: Mapping[Pair, tuple[Array, Array]], positions: Sequence[int], focal_px: float | None, width_px: int
) -> RotationFit | None:
    """Explain the matches of a submap by rotations alone.

    Args:
        matched: pair -> matched points (N, 2) of both images in pixels relative to the principal point.
        positions: the frames in time order.
        focal_px: None where unknown; the best of a grid is then taken.
        width_px: image width, the unit of the grid.

    Returns:
        None where the frames are not connected.
    """
    usable = {pair: points for pair, points in matched.items() if len(points[0]) >= _MIN_MATCHES}
    focals = [focal_px] if focal_px is not None else [value * width_px for value in _FOCAL_GRID]
    best: RotationFit | None = None
    for focal in focals:
        fits = {pair: fit_rotation(points[0], points[1], focal) for pair, points in usable.items()}
        rotations = _chain({pair: rotation for pair, (rotation, _) in fits.items()}, positions)
        if rotations is None:
            return None
        medians = [float(np.median(residuals)) for _, residuals in fits.values()]
        residual = float(np.percentile(medians, 75)) if medians else 0.0
        if best is None or residual < best.residual_px:
            best = RotationFit(rotations, focal, residual)
        if residual > _HOPELESS_PX:
            break
    return best


def extend(
    camera_from_submap: Mapping[int, Array],
    matched: Mapping[Pair, tuple[Array, Array]],
    positions: Sequence[int],
    focal_px: float,
    max_residual_px: float,
) -> dict[int, Array]:
    """Poses of frames that only turned against a neighbour of known pose: they stand where it stands.

    Args:
        camera_from_submap: (4, 4) of the frames that are known.
        matched: as for :func:`fit_rotations`.
        positions: all frames in time order.
        focal_px: of the matched points.
        max_residual_px: median residual up to which a rotation explains the matches.

    Returns:
        (4, 4) of the frames that were added.
    """
    known = dict(camera_from_submap)
    for order in (list(positions), list(positions)[::-1]):
        for before, position in itertools.pairwise(order):
            if position in known or before not in known:
                continue
            pair = (min(before, position), max(before, position))
            points = matched.get(pair)
            if points is None or len(points[0]) < _MIN_MATCHES:
                continue
            b_from_a, residuals = fit_rotation(points[0], points[1], focal_px)
            if float(np.median(residuals)) >= max_residual_px:
                continue
            turn = np.eye(4)
            turn[:3, :3] = b_from_a if before < position else b_from_a.T
            known[position] = turn @ known[before]
    return {position: pose for position, pose in known.items() if position not in camera_from_submap}


@dataclass(frozen=True)
class Part:
    """A stretch of a submap; neighbours share the frame at their border."""

    positions: tuple[int, ...]
    is_turning: bool  # on the spot


def split(
    matched: Mapping[Pair, tuple[Array, Array]], positions: Sequence[int], focal_px: float, max_residual_px: float
) -> list[Part]:
    """Part the frames where the camera moved from those where it only turned, and far enough to lose what it saw.

    Arguments as for :func:`extend`.
    """
    count = len(positions)
    is_turning = [False] * (count - 1)
    judged_by = [0] * (count - 1)  # steps of the widest window that says anything about a step
    turns = np.zeros(count - 1)
    for reach in range(min(_WINDOW_STEPS, count - 1), 0, -1):
        for first in range(count - reach):
            points = matched.get((positions[first], positions[first + reach]))
            if points is None or len(points[0]) < _MIN_MATCHES:
                continue
            b_from_a, residuals = fit_rotation(points[0], points[1], focal_px)
            if reach == 1:
                turns[first] = math.degrees(math.acos(float(np.clip(0.5 * (np.trace(b_from_a) - 1.0), -1.0, 1.0))))
            for step in range(first, first + reach):
                if judged_by[step] in (0, reach):
                    judged_by[step] = reach
                    is_turning[step] = is_turning[step] or float(np.median(residuals)) < max_residual_px
    parts: list[Part] = []
    begin = 0
    for turning, group in itertools.groupby(range(count - 1), key=lambda step: is_turning[step]):
        end = max(group) + 1
        far = turning and float(turns[begin:end].sum()) > _TELLING_TURN_DEG
        if parts and parts[-1].is_turning == far:
            begin = positions.index(parts.pop().positions[0])
        parts.append(Part(tuple(positions[begin : end + 1]), far))
        begin = end
    return parts


def _chain(b_from_a: Mapping[Pair, Array], positions: Sequence[int]) -> dict[int, Array] | None:
    """Rotations ``camera_from_first`` of all positions over the nearest available pairs."""
    rotations = {positions[0]: np.eye(3)}
    for position in positions[1:]:
        for previous in sorted((p for p in rotations), key=lambda p: abs(position - p)):
            if (previous, position) in b_from_a:
                rotations[position] = b_from_a[previous, position] @ rotations[previous]
                break
        else:
            return None
    return rotations


def _rays(points: Array, focal_px: float) -> Array:
    rays = np.column_stack([points / focal_px, np.ones(len(points))])
    unit: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit


def _residuals(rays: Array, points: Array, focal_px: float) -> Array:
    depth = np.where(rays[:, 2] > 1e-3, rays[:, 2], 1e-3)
    residuals: Array = np.linalg.norm(rays[:, :2] / depth[:, None] * focal_px - points, axis=1)
    return residuals
