"""Dense depth of keyframes with known cameras, and how far it can be trusted.

Each frame is matched with a few neighbours; what its neighbours found for the same surface confirms it. The
confidence follows from the expected relative error of depth: how far the match travels in the image as depth changes
(nothing in the sky and at the epipole, by itself), how well it correlates, and how many neighbours agree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, pixel_rays
from vggt_motion.inference.sfm import parallel, stereo
from vggt_motion.inference.sfm.images import GreyImage

Array = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]

MAX_NEIGHBOURS = 4
_NEEDED_NEIGHBOURS = 3  # that agree, for full confidence: two of them can err alike
_REACH = 6  # keyframes to either side that are considered as neighbours
_BEST_PARALLAX_PX = 8.0  # at the lattice: enough to see depth, little enough to look alike
_PARALLAX_LOG_WIDTH = 0.9
_MIN_HYPOTHESES, _MAX_HYPOTHESES = 24, 80
_MATCH_SIGMA_PX = 0.2  # of a good match at the lattice
_HALF_RELATIVE_SIGMA = 0.04  # expected relative error at which confidence is one half
_AGREEING_RELATIVE = 0.03  # depths of two frames that agree differ at most by so much and twice their expected error
_LOW_CORRELATION, _HIGH_CORRELATION = 0.5, 0.9


@dataclass(frozen=True)
class DepthMap:
    """Depth (H, W) float32 along the optical axis, 0 where unknown, and confidence (H, W) float32 in [0, 1]."""

    depth: Map
    confidence: Map


@dataclass(frozen=True)
class SparseDepth:
    """What the structure knows of a frame: points (N, 3) in its camera frame, submap units."""

    points_camera: Array


def dense_depth(
    grey: Mapping[int, GreyImage],
    camera_from_submap: Mapping[int, Array],
    sparse: Mapping[int, SparseDepth],
    intrinsics: Intrinsics,
    usable: npt.NDArray[np.bool_],
) -> dict[int, DepthMap]:
    """Depth and confidence of every frame.

    Args:
        grey: position -> image (H, W) at the lattice of ``intrinsics``.
        camera_from_submap: position -> (4, 4) pose, the same keys.
        sparse: position -> the points that it sees, the same keys.
        intrinsics: of the lattice.
        usable: (H, W), False on pixels never to be used.
    """
    positions = sorted(grey)
    images = {position: grey[position].astype(np.float32) for position in positions}
    nearest = _nearest_inverse_depths(sparse)
    neighbours = {
        position: _neighbours(position, positions, camera_from_submap, sparse[position], intrinsics)
        for position in positions
    }

    def match(position: int) -> stereo.Stereo:
        views = [
            stereo.View(images[other], camera_from_submap[other] @ se3.inverse(camera_from_submap[position]))
            for other in neighbours[position]
        ]
        count = _hypotheses(views, sparse[position], intrinsics, nearest[position])
        return stereo.match(images[position], views, intrinsics, nearest[position], count)

    matchable = [position for position in positions if neighbours[position]]
    matched = dict(zip(matchable, parallel.each(match, matchable), strict=True))
    sigma = {position: _relative_sigma(matched[position]) for position in matched}
    rays = pixel_rays(intrinsics)
    camera = np.array(
        [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, intrinsics.k1, intrinsics.k2], dtype=np.float64
    )
    nothing = np.zeros(usable.shape, dtype=np.float32)
    maps = {}
    for position in positions:
        if position not in matched:
            maps[position] = DepthMap(nothing, nothing)
            continue
        others = [other for other in neighbours[position] if other in matched]
        confirmed = np.zeros(usable.shape, dtype=np.float32)
        for other in others:
            other_from_this = camera_from_submap[other] @ se3.inverse(camera_from_submap[position])
            confirmed += agreement(
                matched[position].inverse_depth, sigma[position], matched[other].inverse_depth, sigma[other],
                other_from_this, rays, camera,
                _AGREEING_RELATIVE,
            )  # fmt: skip
        maps[position] = _judged(matched[position], sigma[position], confirmed, len(others), usable)
    return maps


def _judged(
    found: stereo.Stereo, sigma: Map, confirmed: Map, neighbour_count: int, usable: npt.NDArray[np.bool_]
) -> DepthMap:
    certainty = 1.0 / (1.0 + (sigma / _HALF_RELATIVE_SIGMA) ** 2)
    likeness = np.clip((found.correlation - _LOW_CORRELATION) / (_HIGH_CORRELATION - _LOW_CORRELATION), 0.0, 1.0)
    needed = max(min(_NEEDED_NEIGHBOURS, neighbour_count), 1)
    confidence = certainty * likeness * np.clip(confirmed / needed, 0.0, 1.0)
    known = usable & (found.inverse_depth > 0.0) & (confidence > 1e-3)
    depth = np.where(known, 1.0 / np.maximum(found.inverse_depth, 1e-12), 0.0)
    return DepthMap(depth.astype(np.float32), np.where(known, confidence, 0.0).astype(np.float32))


def _relative_sigma(found: stereo.Stereo) -> Map:
    """Expected relative error of depth (H, W), from the travel of the match and the sharpness of its correlation."""
    mismatch = np.clip(1.0 - found.correlation, 0.02, 1.0)
    sharpness = np.maximum(found.curvature, 1e-3)
    sigma_px = np.sqrt(_MATCH_SIGMA_PX**2 + 0.1 * mismatch / sharpness)
    return np.asarray(sigma_px / np.maximum(found.travel_px, 1e-4), dtype=np.float32)


def _neighbours(
    position: int,
    positions: Sequence[int],
    camera_from_submap: Mapping[int, Array],
    sparse: SparseDepth,
    intrinsics: Intrinsics,
) -> list[int]:
    """Frames to match with: those whose view differs enough to see depth and little enough to look alike."""
    index = positions.index(position)
    scored = []
    for other in positions[max(index - _REACH, 0) : index + _REACH + 1]:
        if other == position:
            continue
        moved, parallax = _parallax_px(
            camera_from_submap[other] @ se3.inverse(camera_from_submap[position]), sparse, intrinsics
        )
        if moved.size == 0 or parallax < 0.3:
            continue
        visible = float(moved.mean())
        score = visible * math.exp(-0.5 * (math.log(parallax / _BEST_PARALLAX_PX) / _PARALLAX_LOG_WIDTH) ** 2)
        scored.append((-score, abs(other - position), other))
    return [other for _, _, other in sorted(scored)[:MAX_NEIGHBOURS]]


def _parallax_px(
    other_from_this: Array, sparse: SparseDepth, intrinsics: Intrinsics
) -> tuple[npt.NDArray[np.bool_], float]:
    """Which points the other frame sees, and the median movement in pixels that its translation causes."""
    points = sparse.points_camera
    if len(points) == 0:
        return np.zeros(0, dtype=np.bool_), 0.0
    turned = points @ other_from_this[:3, :3].T
    moved = turned + other_from_this[:3, 3]
    front = (turned[:, 2] > 1e-9) & (moved[:, 2] > 1e-9)
    a = turned[:, :2] / np.where(front, turned[:, 2], 1.0)[:, None]
    b = moved[:, :2] / np.where(front, moved[:, 2], 1.0)[:, None]
    u, v = b[:, 0] * intrinsics.fx + intrinsics.cx, b[:, 1] * intrinsics.fy + intrinsics.cy
    seen = front & (u >= 0) & (v >= 0) & (u < intrinsics.width_px) & (v < intrinsics.height_px)
    if not seen.any():
        return seen, 0.0
    return seen, float(np.median(np.linalg.norm(b[seen] - a[seen], axis=1)) * intrinsics.fx)


def _nearest_inverse_depths(sparse: Mapping[int, SparseDepth]) -> dict[int, float]:
    """Per frame, the inverse depth beyond which next to nothing lies."""
    inverse = {p: 1.0 / s.points_camera[:, 2][s.points_camera[:, 2] > 1e-9] for p, s in sparse.items()}
    everything = np.concatenate(list(inverse.values())) if inverse else np.zeros(0)
    typical = float(np.percentile(everything, 98.0)) if len(everything) else 1.0
    return {p: 1.4 * (float(np.percentile(v, 98.0)) if len(v) >= 20 else typical) for p, v in inverse.items()}


def _hypotheses(views: Sequence[stereo.View], sparse: SparseDepth, intrinsics: Intrinsics, nearest: float) -> int:
    """As many as make a step about one pixel of the half-size sweep, where the points are."""
    travel = []
    z = sparse.points_camera[:, 2]
    points = sparse.points_camera[z > 1e-9]
    for view in views:
        rotation, translation = view.view_from_reference[:3, :3], view.view_from_reference[:3, 3]
        rays = points / points[:, 2:]
        near = rays @ rotation.T + translation * (1.0 / points[:, 2:] + 0.01 * nearest)
        far = rays @ rotation.T + translation / points[:, 2:]
        front = (near[:, 2] > 0.05) & (far[:, 2] > 0.05)
        if front.any():
            a, b = near[front, :2] / near[front, 2:], far[front, :2] / far[front, 2:]
            travel.append(float(np.percentile(np.linalg.norm(a - b, axis=1), 75.0)) * intrinsics.fx / 0.01)
    wanted = 0.5 * max(travel) if travel else 0.0
    return int(min(max(wanted, _MIN_HYPOTHESES), _MAX_HYPOTHESES))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def agreement(inverse_depth, sigma, other_inverse_depth, other_sigma, other_from_this, rays, camera, tolerance):  # type: ignore[no-untyped-def]
    """1 where the other frame's depth of the same surface agrees (H, W), else 0."""
    height, width = inverse_depth.shape
    r, t = other_from_this[:3, :3], other_from_this[:3, 3]
    out = np.zeros((height, width), dtype=np.float32)
    for i in range(height):
        for j in range(width):
            w = inverse_depth[i, j]
            if w <= 0.0:
                continue
            x, y = rays[i, j, 0], rays[i, j, 1]
            px = r[0, 0] * x + r[0, 1] * y + r[0, 2] + w * t[0]
            py = r[1, 0] * x + r[1, 1] * y + r[1, 2] + w * t[1]
            pz = r[2, 0] * x + r[2, 1] * y + r[2, 2] + w * t[2]
            if pz < 0.05:
                continue
            a, b = px / pz, py / pz
            square = a * a + b * b
            factor = 1.0 + camera[4] * square + camera[5] * square * square
            u = math.floor(camera[0] * a * factor + camera[2] + 0.5)
            v = math.floor(camera[1] * b * factor + camera[3] + 0.5)
            if u < 0 or v < 0 or u >= width or v >= height:
                continue
            # depth of the surface in the other frame, from here and from there
            ratio = other_inverse_depth[v, u] * pz / w
            if abs(ratio - 1.0) < tolerance + 2.0 * min(max(sigma[i, j], other_sigma[v, u]), 0.1):
                out[i, j] = 1.0
    return out
