"""Dense depth of keyframes with known cameras: a plane sweep over inverse depth, checked between frames.

Every hypothesis is a plane parallel to the image; with camera ``s`` at ``[R | t]`` from the reference, the pixel with
ray ``r`` and inverse depth ``d`` is seen at the direction ``R r + d t``, so that a sweep costs one scaled addition per
pixel and stays exact next to the epipole of a forward motion, where rectification breaks down.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, pixel_rays, project
from vggt_motion.inference.sfm.images import GreyImage

Array = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]

_HYPOTHESES = 64
_WINDOW_PX = 5
_MAX_NEIGHBOURS = 4
_TEXTURE_VARIANCE = 4.0  # grey levels squared: below it a window has no texture to match
_MATCH_SIGMA_PX = 0.25  # standard deviation of a good match at the depth lattice
_GOOD_RELATIVE_SIGMA = 0.05  # relative depth error at which confidence is one half
_CONSISTENT_RELATIVE = 0.05  # relative inverse depth difference of two frames that agree


@dataclass(frozen=True)
class DepthMap:
    """Depth (H, W) float32 along the optical axis, 0 where unknown, and confidence (H, W) float32 in [0, 1]."""

    depth: Map
    confidence: Map


@dataclass(frozen=True)
class _Sweep:
    inverse_depth: Map  # (H, W), 0 where unknown
    score: Map  # (H, W) mean correlation of the chosen hypothesis
    relative_sigma: Map  # (H, W)


def dense_depth(
    grey: Mapping[int, GreyImage],
    camera_from_submap: Mapping[int, Array],
    nearest_inverse_depth: Mapping[int, float],
    intrinsics: Intrinsics,
    usable: npt.NDArray[np.bool_],
) -> dict[int, DepthMap]:
    """Depth and confidence of every frame.

    Args:
        grey: position -> image (H, W) at the lattice of ``intrinsics``.
        camera_from_submap: position -> (4, 4) pose, the same keys.
        nearest_inverse_depth: position -> largest inverse depth worth looking at, in submap units.
        intrinsics: of the lattice.
        usable: (H, W), False on pixels never to be used.
    """
    positions = sorted(grey)
    rays = pixel_rays(intrinsics)
    images = {position: grey[position].astype(np.float32) for position in positions}
    neighbours = {position: _neighbours(position, positions, camera_from_submap) for position in positions}
    sweeps = {
        position: _sweep(
            images[position],
            [images[other] for other in neighbours[position]],
            [camera_from_submap[other] @ se3.inverse(camera_from_submap[position]) for other in neighbours[position]],
            nearest_inverse_depth[position],
            intrinsics,
            rays,
            usable,
        )
        for position in positions
    }
    return {
        position: _confidence(position, sweeps, neighbours[position], camera_from_submap, intrinsics, rays, usable)
        for position in positions
    }


def _neighbours(position: int, positions: Sequence[int], camera_from_submap: Mapping[int, Array]) -> list[int]:
    """Frames to match with: the nearest in time on both sides that stand somewhere else."""

    def centre(key: int) -> Array:
        pose = camera_from_submap[key]
        return np.asarray(-pose[:3, :3].T @ pose[:3, 3])

    steps = [float(np.linalg.norm(centre(a) - centre(b))) for a, b in itertools.pairwise(positions)]
    minimum = 0.2 * float(np.median(steps)) if steps else 0.0
    others = [p for p in positions if p != position and np.linalg.norm(centre(p) - centre(position)) > minimum]
    return sorted(others, key=lambda other: (abs(other - position), other))[:_MAX_NEIGHBOURS]


def _sweep(
    reference: Map,
    sources: Sequence[Map],
    source_from_reference: Sequence[Array],
    nearest_inverse_depth: float,
    intrinsics: Intrinsics,
    rays: Array,
    usable: npt.NDArray[np.bool_],
) -> _Sweep:
    height, width = reference.shape
    window = (_WINDOW_PX, _WINDOW_PX)
    step = nearest_inverse_depth / (_HYPOTHESES - 1)
    mean = cv2.boxFilter(reference, -1, window)
    variance = np.maximum(cv2.boxFilter(reference * reference, -1, window) - mean * mean, 0.0)
    volume = np.full((len(sources), _HYPOTHESES, height, width), -1.0, dtype=np.float32)
    directions = [
        np.einsum("ij,hwj->hwi", transform[:3, :3], rays).astype(np.float32) for transform in source_from_reference
    ]
    for n, source in enumerate(sources):
        offset = source_from_reference[n][:3, 3]
        for k in range(_HYPOTHESES):
            u, v = _project(directions[n], offset * (k * step), intrinsics)
            warped = cv2.remap(source, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-1e4)
            warped_mean = cv2.boxFilter(warped, -1, window)
            warped_variance = cv2.boxFilter(warped * warped, -1, window) - warped_mean * warped_mean
            product = cv2.boxFilter(warped * reference, -1, window) - warped_mean * mean
            correlation = product / np.sqrt(
                np.maximum(warped_variance, _TEXTURE_VARIANCE) * np.maximum(variance, _TEXTURE_VARIANCE)
            )
            volume[n, k] = np.where((warped_mean >= 0.0) & (warped_variance < 1e5), correlation, -1.0)
    # the better half of the neighbours: the other half may be occluded or out of view
    kept = (len(sources) + 1) // 2
    score = np.sort(volume, axis=0)[-kept:].mean(axis=0)
    best = score[1:-1].argmax(axis=0) + 1
    rows, columns = np.indices((height, width))
    below, top, above = score[best - 1, rows, columns], score[best, rows, columns], score[best + 1, rows, columns]
    curvature = 2.0 * top - below - above
    shift = np.clip(np.where(curvature > 1e-6, 0.5 * (above - below) / np.maximum(curvature, 1e-6), 0.0), -0.5, 0.5)
    inverse_depth = ((best + shift) * step).astype(np.float32)
    # movement of the match per relative change of depth, in the neighbour that sees most of it
    travel = np.zeros((height, width), dtype=np.float32)
    for n in range(len(sources)):
        offset = source_from_reference[n][:3, 3].astype(np.float32)
        u0, v0 = _project(directions[n], offset * 0.95 * inverse_depth[..., None], intrinsics)
        u1, v1 = _project(directions[n], offset * 1.05 * inverse_depth[..., None], intrinsics)
        inside = (u0 >= 0) & (u0 <= width - 1) & (v0 >= 0) & (v0 <= height - 1)
        travel = np.maximum(travel, np.where(inside, np.hypot(u1 - u0, v1 - v0) / 0.1, 0.0))
    relative_sigma = _MATCH_SIGMA_PX / np.maximum(travel, 1e-6)
    known = usable & (variance > _TEXTURE_VARIANCE) & (top > 0.0)
    return _Sweep(
        np.where(known, inverse_depth, 0.0).astype(np.float32),
        top.astype(np.float32),
        relative_sigma.astype(np.float32),
    )


def _project(directions: Map, offset: npt.NDArray[np.floating], intrinsics: Intrinsics) -> tuple[Map, Map]:
    """Pixels (u, v) of ``directions + offset``; far outside where behind the camera."""
    moved = directions + offset.astype(np.float32)
    z = moved[..., 2]
    inverse = np.where(z > 1e-3, 1.0 / np.maximum(z, 1e-3), 0.0).astype(np.float32)
    x, y = moved[..., 0] * inverse, moved[..., 1] * inverse
    factor = 1.0 + intrinsics.k1 * (x * x + y * y)
    u = np.where(z > 1e-3, intrinsics.fx * x * factor + intrinsics.cx, -1e4)
    v = np.where(z > 1e-3, intrinsics.fy * y * factor + intrinsics.cy, -1e4)
    return u.astype(np.float32), v.astype(np.float32)


def _confidence(
    position: int,
    sweeps: Mapping[int, _Sweep],
    neighbours: Sequence[int],
    camera_from_submap: Mapping[int, Array],
    intrinsics: Intrinsics,
    rays: Array,
    usable: npt.NDArray[np.bool_],
) -> DepthMap:
    """Confidence from expected relative error, correlation, and agreement with the depth of the neighbours."""
    own = sweeps[position]
    known = own.inverse_depth > 0.0
    depth = np.where(known, 1.0 / np.maximum(own.inverse_depth, 1e-9), 0.0)
    points = rays * depth[..., None]
    agreeing = np.zeros(depth.shape, dtype=np.float32)
    for other in neighbours:
        moved = se3.act(camera_from_submap[other] @ se3.inverse(camera_from_submap[position]), points)
        pixels = project(moved, intrinsics)
        u = np.nan_to_num(pixels[..., 0], nan=-1e4).astype(np.float32)
        v = np.nan_to_num(pixels[..., 1], nan=-1e4).astype(np.float32)
        seen = cv2.remap(
            sweeps[other].inverse_depth, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            difference = np.abs(seen * moved[..., 2] - 1.0)
        agreeing += (seen > 0.0) & (difference < _CONSISTENT_RELATIVE + 2.0 * own.relative_sigma)
    certainty = 1.0 / (1.0 + (own.relative_sigma / _GOOD_RELATIVE_SIGMA) ** 2)
    likeness = np.clip((own.score - 0.4) / 0.5, 0.0, 1.0)
    agreement = np.clip(agreeing / max(min(2, len(neighbours)), 1), 0.0, 1.0)
    confidence = np.where(known & usable, certainty * likeness * agreement, 0.0)
    return DepthMap(np.where(usable, depth, 0.0).astype(np.float32), np.clip(confidence, 0.0, 1.0).astype(np.float32))
