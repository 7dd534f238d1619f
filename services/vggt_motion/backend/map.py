"""The dense map: confident points of every keyframe, posed by the optimised graph, thinned by voxels (DESIGN 3.7).

Frames are taken one at a time, so that memory is bounded by the number of points that are kept, not by the length of
the drive. Each keyframe counts once, through its home submap: what overlaps show twice is not mapped twice.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from plyfile import PlyData, PlyElement

from vggt_motion.config import BackendConfig
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, pixel_rays
from vggt_motion.geometry.sim3 import Sim3

Array = npt.NDArray[np.float64]

_CELL_BITS = 21  # cells per axis and sign in a packed 64-bit voxel key
_GROWTH = 2.0**0.5  # surfaces: the number of voxels halves
_MERGE_POINTS = 1_000_000


@dataclass(frozen=True)
class MapFrame:
    """One keyframe, as its home submap sees it."""

    keyframe_id: str
    depth: npt.NDArray[np.float32]  # (H, W) along the optical axis, submap units, 0 where unknown
    confidence: npt.NDArray[np.float32]  # (H, W) in [0, 1]
    intrinsics: Intrinsics  # of that lattice
    world_from_submap: Sim3
    submap_from_camera: Array  # (4, 4)
    image: npt.NDArray[np.uint8]  # (h, w, 3) RGB, any size


@dataclass(frozen=True)
class PointMap:
    """Coloured points in the world."""

    points: npt.NDArray[np.float32]  # (N, 3) world units
    colors: npt.NDArray[np.uint8]  # (N, 3) RGB
    voxel: float  # edge of the voxels, world units; 0 = not thinned by voxels
    source_point_count: int  # confident pixels that went in

    def write_ply(self, path: Path) -> None:
        """Write a binary PLY (x, y, z float; red, green, blue uchar), complete or not at all."""
        vertices = np.empty(
            len(self.points),
            dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")],
        )
        for axis, name in enumerate(("x", "y", "z")):
            vertices[name] = self.points[:, axis]
        for channel, name in enumerate(("red", "green", "blue")):
            vertices[name] = self.colors[:, channel]
        partial = path.with_name(path.name + ".part")
        with partial.open("wb") as file:
            PlyData([PlyElement.describe(vertices, "vertex")], text=False, byte_order="<").write(file)
        os.replace(partial, path)  # noqa: PTH105 - replaces atomically on every system


def build_map(frames: Iterable[MapFrame], config: BackendConfig, *, step: float, scale: float = 1.0) -> PointMap:
    """Gather the map.

    Args:
        frames: keyframes in a fixed order, each in its home submap; a keyframe that comes again is passed over.
        config: confidence threshold, voxel edge as a share of ``step``, greatest number of points.
        step: median distance between successive keyframes, world units.
        scale: world units per unit of the graph (``Trajectory.scale``).

    Returns:
        At most ``map_max_points`` points. With voxels, each is the mean of what fell into its voxel, and voxels grow
        until the map fits; without, a fixed pseudo-random choice is kept.
    """
    edge = config.map_voxel_over_step * step
    cloud: _Voxels | _Sample = _Voxels(edge, config.map_max_points) if edge > 0.0 else _Sample(config.map_max_points)
    seen: set[str] = set()
    count = 0
    for frame in frames:
        if frame.keyframe_id in seen:
            continue
        seen.add(frame.keyframe_id)
        points, colors = _confident_points(frame, config.map_confidence)
        count += len(points)
        cloud.add(scale * points, colors)
    points, colors = cloud.result()
    return PointMap(points.astype(np.float32), colors, cloud.edge, count)


def _confident_points(frame: MapFrame, threshold: float) -> tuple[Array, npt.NDArray[np.uint8]]:
    """World points (N, 3), before the trajectory's scale, and colours (N, 3) of the trusted pixels of one frame."""
    depth = frame.depth
    with np.errstate(invalid="ignore"):
        mask = (depth > 0.0) & np.isfinite(depth) & (frame.confidence > 0.0) & (frame.confidence >= threshold)
    points = pixel_rays(frame.intrinsics)[mask] * depth[mask].astype(np.float64)[:, None]
    world = frame.world_from_submap.act(se3.act(frame.submap_from_camera, points))
    # the depth lattice covers the whole image: nearest pixel of the image to each cell's centre
    rows, columns = np.nonzero(mask)
    height, width = frame.image.shape[:2]
    v = np.minimum(((rows + 0.5) * height / depth.shape[0]).astype(np.intp), height - 1)
    u = np.minimum(((columns + 0.5) * width / depth.shape[1]).astype(np.intp), width - 1)
    return world, frame.image[v, u]


class _Voxels:
    """Running means per voxel; voxels grow when there are too many."""

    def __init__(self, edge: float, capacity: int) -> None:
        self.edge = edge
        self._capacity = capacity
        self._sums = np.zeros((0, 7))  # x, y, z, red, green, blue, count
        self._pending: list[Array] = []
        self._pending_count = 0

    def add(self, points: Array, colors: npt.NDArray[np.uint8]) -> None:
        """Take in points (N, 3) with colours (N, 3)."""
        block = np.concatenate([points, colors.astype(np.float64), np.ones((len(points), 1))], axis=1)
        self._pending.append(block)
        self._pending_count += len(block)
        if self._pending_count >= _MERGE_POINTS:
            self._merge()

    def result(self) -> tuple[Array, npt.NDArray[np.uint8]]:
        """Mean points (M, 3) and colours (M, 3), in order of their voxels."""
        self._merge()
        means = self._sums[:, :6] / self._sums[:, 6:]
        return means[:, :3], np.rint(means[:, 3:]).clip(0, 255).astype(np.uint8)

    def _merge(self) -> None:
        if self._pending:
            self._sums = self._pool(np.concatenate([self._sums, *self._pending]))
            self._pending, self._pending_count = [], 0
        while len(self._sums) > self._capacity:
            self.edge *= _GROWTH
            self._sums = self._pool(self._sums)

    def _pool(self, sums: Array) -> Array:
        """Add up the rows that fall into one voxel; rows outside the addressable range are dropped."""
        cells = np.floor(sums[:, :3] / sums[:, 6:] / self.edge)
        limit = 2 ** (_CELL_BITS - 1)
        inside = np.isfinite(cells).all(axis=1) & (np.abs(cells) < limit).all(axis=1)
        sums, offset = sums[inside], cells[inside].astype(np.int64) + limit
        keys = (offset[:, 0] << 2 * _CELL_BITS) | (offset[:, 1] << _CELL_BITS) | offset[:, 2]
        order = np.argsort(keys, kind="stable")
        keys, sums = keys[order], sums[order]
        if len(keys) == 0:
            return sums
        starts = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
        return np.add.reduceat(sums, starts, axis=0)


class _Sample:
    """A choice of points that depends on their running number alone, as a hash decides."""

    def __init__(self, capacity: int) -> None:
        self.edge = 0.0
        self._capacity = capacity
        self._count = 0
        self._numbers = np.zeros(0, dtype=np.uint64)
        self._points = np.zeros((0, 3))
        self._colors = np.zeros((0, 3), dtype=np.uint8)

    def add(self, points: Array, colors: npt.NDArray[np.uint8]) -> None:
        """Take in points (N, 3) with colours (N, 3)."""
        numbers = np.arange(self._count, self._count + len(points), dtype=np.uint64)
        self._count += len(points)
        self._numbers = np.concatenate([self._numbers, numbers])
        self._points = np.concatenate([self._points, points])
        self._colors = np.concatenate([self._colors, colors])
        if len(self._numbers) > self._capacity:
            chosen = np.sort(np.argsort(_mix(self._numbers), kind="stable")[: self._capacity])
            self._numbers, self._points, self._colors = (
                self._numbers[chosen],
                self._points[chosen],
                self._colors[chosen],
            )

    def result(self) -> tuple[Array, npt.NDArray[np.uint8]]:
        """The kept points (M, 3) and colours (M, 3), in order of arrival."""
        return self._points, self._colors


def _mix(numbers: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Finaliser of splitmix64 (Steele et al., 2014): spreads running numbers evenly."""
    z = numbers + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
