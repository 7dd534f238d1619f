"""Plane-sweep stereo of one reference frame against neighbours at any known poses.

Every hypothesis is an inverse depth ``w``; a pixel with ray ``r`` is seen by a neighbour at ``[R | t]`` in the
direction ``R r + w t``. That stays exact next to the epipole of a forward motion, where rectification breaks down.
Likeness is the zero-mean normalised correlation of small windows. A coarse sweep over all hypotheses, smoothed by
semi-global matching (Hirschmueller, 2008), finds the right mode; windows warped by the depth map itself then find the
sub-pixel depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numba
import numpy as np
import numpy.typing as npt

from vggt_motion.geometry.projection import Intrinsics, pixel_rays

Array = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]

_RADIUS_PX = 2  # of the correlation window
_NOISE_VARIANCE = 6.0  # grey levels squared, added to the variance of a window: flat windows correlate with nothing
_SMALL_STEP_PENALTY = 0.08
_LARGE_STEP_PENALTY = 0.5
_UNSEEN_COST = 1.0  # of a hypothesis that no neighbour sees
_FINE = ((2, 0.5), (1, 0.25))  # hypotheses on each side, and their spacing in coarse steps


@dataclass(frozen=True)
class View:
    """A neighbour: image (H, W) float32 at the reference's lattice, and ``view_from_reference`` (4, 4)."""

    image: Map
    view_from_reference: Array


@dataclass(frozen=True)
class Stereo:
    """Result of one reference frame."""

    inverse_depth: Map  # (H, W), along the optical axis, >= 0
    correlation: Map  # (H, W) mean of the better half of the neighbours, -1 where none sees the pixel
    curvature: Map  # (H, W) of the correlation per square pixel of travel, >= 0: how sharp the match is
    travel_px: Map  # (H, W) movement of the match per relative change of depth, in the neighbour that sees most of it


def match(
    reference: Map, views: list[View], intrinsics: Intrinsics, nearest_inverse_depth: float, hypotheses: int
) -> Stereo:
    """Inverse depth of every pixel.

    Args:
        reference: (H, W) float32 grey image.
        views: at least one neighbour.
        intrinsics: of the lattice (H, W), shared by all.
        nearest_inverse_depth: the sweep goes from 0 to here.
        hypotheses: number of steps of the sweep.
    """
    height, width = reference.shape
    rotations = np.stack([view.view_from_reference[:3, :3] for view in views])
    translations = np.stack([view.view_from_reference[:3, 3] for view in views])
    # 1. coarse sweep at half the resolution
    half_width, half_height = max(width // 2, 8), max(height // 2, 8)
    half = intrinsics.resized(half_width, half_height)
    step = nearest_inverse_depth / (hypotheses - 1)
    cost = sweep_cost(
        _halved(reference, half_width, half_height),
        np.stack([_halved(view.image, half_width, half_height) for view in views]),
        rotations,
        translations,
        pixel_rays(half).astype(np.float32),
        _camera(half),
        np.arange(hypotheses) * step,
    )
    coarse = winner(semi_global(cost, _SMALL_STEP_PENALTY, _LARGE_STEP_PENALTY))
    # 2. refinement with windows that follow the depth map
    level = _enlarged(coarse, width, height)
    sources = np.stack([view.image for view in views])
    rays = pixel_rays(intrinsics).astype(np.float32)
    camera = _camera(intrinsics)
    correlation = np.empty_like(reference)
    curvature = np.empty_like(reference)
    for reach, spacing in _FINE:
        level, correlation, curvature = refine(
            reference, sources, rotations, translations, rays, camera, level, np.float32(step), reach,
            np.float32(spacing),
        )  # fmt: skip
    travel = travel_of(rotations, translations, rays, camera, level * np.float32(step), height, width)
    # curvature was per square step: a step moves the match by travel times its share of the inverse depth
    per_step = travel / np.maximum(level, 0.25)
    return Stereo(level * np.float32(step), correlation, curvature / np.maximum(per_step, 1e-3) ** 2, travel)


def _camera(intrinsics: Intrinsics) -> npt.NDArray[np.float32]:
    return np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, intrinsics.k1], dtype=np.float32)


def _halved(image: Map, width: int, height: int) -> Map:
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32)


def _enlarged(level: Map, width: int, height: int) -> Map:
    """Interpolated on surfaces, nearest at steps between them."""
    near = cv2.resize(level, (width, height), interpolation=cv2.INTER_NEAREST)
    smooth = cv2.resize(level, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.where(np.abs(near - smooth) < 1.0, smooth, near), dtype=np.float32)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _seen_at(rotation, translation, camera, x, y, inverse_depth):  # type: ignore[no-untyped-def]
    px = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] + inverse_depth * translation[0]
    py = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] + inverse_depth * translation[1]
    pz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] + inverse_depth * translation[2]
    if pz < np.float32(0.05):
        return np.float32(-1e4), np.float32(-1e4)
    a, b = px / pz, py / pz
    factor = np.float32(1.0) + camera[4] * (a * a + b * b)
    return camera[0] * a * factor + camera[2], camera[1] * b * factor + camera[3]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turned(rotation, rays, out):  # type: ignore[no-untyped-def]
    """Rays (H, W, 2) in another camera, as planes (3, H, W)."""
    height, width, _ = rays.shape
    for i in range(height):
        for j in range(width):
            x, y = rays[i, j, 0], rays[i, j, 1]
            for k in range(3):
                out[k, i, j] = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _warp(source, turned, translation, camera, inverse_depth, columns, rows, warped, inside):  # type: ignore[no-untyped-def]
    """Bilinear samples of ``source`` where each pixel with its inverse depth is seen, border repeated.

    The coordinates of a row are computed apart from the samples: that loop then runs on several pixels at once.
    """
    height, width = source.shape
    tx, ty, tz = translation[0], translation[1], translation[2]
    fx, fy, cx, cy, k1 = camera[0], camera[1], camera[2], camera[3], camera[4]
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    last_u, last_v = np.float32(width - 1.001), np.float32(height - 1.001)
    end_u, end_v = np.float32(width) - half, np.float32(height) - half
    for i in range(height):
        for j in range(width):
            w = inverse_depth[i, j]
            pz = turned[2, i, j] + w * tz
            front = pz > np.float32(0.05)
            scale = one / (pz if front else one)
            a, b = (turned[0, i, j] + w * tx) * scale, (turned[1, i, j] + w * ty) * scale
            factor = one + k1 * (a * a + b * b)
            u, v = fx * a * factor + cx, fy * b * factor + cy
            inside[i, j] = front and u >= -half and v >= -half and u <= end_u and v <= end_v
            columns[j] = min(max(u, zero), last_u)
            rows[j] = min(max(v, zero), last_v)
        for j in range(width):
            u, v = columns[j], rows[j]
            x, y = np.int32(u), np.int32(v)
            s, t = u - np.float32(x), v - np.float32(y)
            top, bottom = source[y, x], source[y + 1, x]
            top += s * (source[y, x + 1] - top)
            bottom += s * (source[y + 1, x + 1] - bottom)
            warped[i, j] = top + t * (bottom - top)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _box(values, horizontal, out):  # type: ignore[no-untyped-def]
    """Mean over the window, with the border repeated."""
    height, width = values.shape
    scale = np.float32(1.0 / (2 * _RADIUS_PX + 1) ** 2)
    for i in range(height):
        total = np.float32(0.0)
        for k in range(-_RADIUS_PX, _RADIUS_PX + 1):
            total += values[i, min(max(k, 0), width - 1)]
        horizontal[i, 0] = total
        for j in range(1, width):
            total += values[i, min(j + _RADIUS_PX, width - 1)] - values[i, max(j - 1 - _RADIUS_PX, 0)]
            horizontal[i, j] = total
    for i in range(height):
        for j in range(width):
            total = np.float32(0.0)
            for k in range(-_RADIUS_PX, _RADIUS_PX + 1):
                total += horizontal[min(max(i + k, 0), height - 1), j]
            out[i, j] = total * scale


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _correlate(reference, mean, deviation, warped, inside, work, out):  # type: ignore[no-untyped-def]
    """Windowed correlation of two images; -1 where the pixel is not inside."""
    height, width = reference.shape
    product, horizontal, warped_mean, warped_square, cross = work[0], work[1], work[2], work[3], work[4]
    _box(warped, horizontal, warped_mean)
    for i in range(height):
        for j in range(width):
            product[i, j] = warped[i, j] * warped[i, j]
    _box(product, horizontal, warped_square)
    for i in range(height):
        for j in range(width):
            product[i, j] = warped[i, j] * reference[i, j]
    _box(product, horizontal, cross)
    noise = np.float32(_NOISE_VARIANCE)
    for i in range(height):
        for j in range(width):
            if inside[i, j]:
                variance = max(warped_square[i, j] - warped_mean[i, j] * warped_mean[i, j], np.float32(0.0)) + noise
                covariance = cross[i, j] - warped_mean[i, j] * mean[i, j]
                out[i, j] = covariance / (deviation[i, j] * math.sqrt(variance))
            else:
                out[i, j] = np.float32(-1.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _window_statistics(reference, work):  # type: ignore[no-untyped-def]
    height, width = reference.shape
    mean, square = np.empty_like(reference), np.empty_like(reference)
    _box(reference, work[1], mean)
    for i in range(height):
        for j in range(width):
            work[0, i, j] = reference[i, j] * reference[i, j]
    _box(work[0], work[1], square)
    for i in range(height):
        for j in range(width):
            variance = max(square[i, j] - mean[i, j] * mean[i, j], np.float32(0.0)) + np.float32(_NOISE_VARIANCE)
            square[i, j] = math.sqrt(variance)
    return mean, square


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _better_half(values, count):  # type: ignore[no-untyped-def]
    """Mean of the better half of the neighbours that see the pixel: the others may be occluded. -1 without any."""
    kept = 0
    for n in range(count):
        value = values[n]
        if value > np.float32(-1.0):
            k = kept
            while k > 0 and values[k - 1] < value:
                values[k] = values[k - 1]
                k -= 1
            values[k] = value
            kept += 1
    if kept == 0:
        return np.float32(-1.0)
    half = (kept + 1) // 2
    total = np.float32(0.0)
    for k in range(half):
        total += values[k]
    return total / np.float32(half)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sweep_cost(reference, sources, rotations, translations, rays, camera, inverse_depths):  # type: ignore[no-untyped-def]
    """Cost volume (H, W, D) float32: one minus the correlation of the better half of the neighbours."""
    count = len(sources)
    height, width = reference.shape
    depths = len(inverse_depths)
    rotations32, translations32 = rotations.astype(np.float32), translations.astype(np.float32)
    work = np.empty((5, height, width), dtype=np.float32)
    mean, deviation = _window_statistics(reference, work)
    plane = np.empty((height, width), dtype=np.float32)
    warped = np.empty((height, width), dtype=np.float32)
    inside = np.empty((height, width), dtype=np.bool_)
    scores = np.empty((count, height, width), dtype=np.float32)
    volume = np.empty((height, width, depths), dtype=np.float32)
    values = np.empty(count, dtype=np.float32)
    turned = np.empty((count, 3, height, width), dtype=np.float32)
    for n in range(count):
        _turned(rotations32[n], rays, turned[n])
    columns, rows = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    for d in range(depths):
        plane[:] = np.float32(inverse_depths[d])
        for n in range(count):
            _warp(sources[n], turned[n], translations32[n], camera, plane, columns, rows, warped, inside)
            _correlate(reference, mean, deviation, warped, inside, work, scores[n])
        for i in range(height):
            for j in range(width):
                for n in range(count):
                    values[n] = scores[n, i, j]
                score = _better_half(values, count)
                volume[i, j, d] = np.float32(1.0) - score if score > np.float32(-1.0) else np.float32(_UNSEEN_COST)
    return volume


@numba.njit(cache=True, nogil=True, error_model="numpy")
def semi_global(cost, small_penalty, large_penalty):  # type: ignore[no-untyped-def]
    """Costs (H, W, D) summed along paths from the left, right, top and bottom (Hirschmueller 2008, eq. 13)."""
    height, width, depths = cost.shape
    total = np.zeros((height, width, depths), dtype=np.float32)
    p1, p2 = np.float32(small_penalty), np.float32(large_penalty)
    for direction in range(4):
        lines = height if direction < 2 else width
        length = width if direction < 2 else height
        previous = np.zeros(depths, dtype=np.float32)
        current = np.zeros(depths, dtype=np.float32)
        for line in range(lines):
            smallest = np.float32(0.0)
            for step in range(length):
                along = step if direction % 2 == 0 else length - 1 - step
                i, j = (line, along) if direction < 2 else (along, line)
                following = np.float32(1e9)
                for d in range(depths):
                    value = cost[i, j, d]
                    if step > 0:
                        best = min(previous[d], smallest + p2)
                        if d > 0:
                            best = min(best, previous[d - 1] + p1)
                        if d < depths - 1:
                            best = min(best, previous[d + 1] + p1)
                        value += best - smallest
                    current[d] = value
                    total[i, j, d] += value
                    following = min(following, value)
                previous, current = current, previous
                smallest = following
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def winner(total):  # type: ignore[no-untyped-def]
    """Cheapest hypothesis (H, W) float32 of a volume (H, W, D), interpolated by a parabola."""
    height, width, depths = total.shape
    level = np.empty((height, width), dtype=np.float32)
    for i in range(height):
        for j in range(width):
            best = 0
            for d in range(1, depths):
                if total[i, j, d] < total[i, j, best]:
                    best = d
            shift = np.float32(0.0)
            if 0 < best < depths - 1:
                below, above = total[i, j, best - 1], total[i, j, best + 1]
                bend = below + above - 2 * total[i, j, best]
                if bend > np.float32(1e-6):
                    shift = np.float32(0.5) * (below - above) / bend
            level[i, j] = best + shift
    return level


@numba.njit(cache=True, nogil=True, error_model="numpy")
def refine(  # type: ignore[no-untyped-def]
    reference, sources, rotations, translations, rays, camera, level, step, reach, spacing
):
    """Best of ``2 * reach + 1`` depth maps around ``level`` (in steps of inverse depth), ``spacing`` apart.

    Returns the new level (H, W), its correlation (H, W) and the curvature of the correlation per square step (H, W).
    """
    count = len(sources)
    height, width = reference.shape
    rotations32, translations32 = rotations.astype(np.float32), translations.astype(np.float32)
    work = np.empty((5, height, width), dtype=np.float32)
    mean, deviation = _window_statistics(reference, work)
    inverse_depth = np.empty((height, width), dtype=np.float32)
    warped = np.empty((height, width), dtype=np.float32)
    inside = np.empty((height, width), dtype=np.bool_)
    scores = np.empty((count, height, width), dtype=np.float32)
    combined = np.empty((2 * reach + 1, height, width), dtype=np.float32)
    values = np.empty(count, dtype=np.float32)
    turned = np.empty((count, 3, height, width), dtype=np.float32)
    for n in range(count):
        _turned(rotations32[n], rays, turned[n])
    columns, rows = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    for k in range(2 * reach + 1):
        for i in range(height):
            for j in range(width):
                inverse_depth[i, j] = max(level[i, j] + (k - reach) * spacing, np.float32(0.0)) * step
        for n in range(count):
            _warp(sources[n], turned[n], translations32[n], camera, inverse_depth, columns, rows, warped, inside)
            _correlate(reference, mean, deviation, warped, inside, work, scores[n])
        for i in range(height):
            for j in range(width):
                for n in range(count):
                    values[n] = scores[n, i, j]
                combined[k, i, j] = _better_half(values, count)
    out = np.empty_like(level)
    correlation = np.empty_like(level)
    curvature = np.zeros_like(level)
    for i in range(height):
        for j in range(width):
            best = reach
            for k in range(2 * reach + 1):
                if combined[k, i, j] > combined[best, i, j]:
                    best = k
            middle = min(max(best, 1), 2 * reach - 1)
            below, top, above = combined[middle - 1, i, j], combined[middle, i, j], combined[middle + 1, i, j]
            bend = 2 * top - below - above
            shift = np.float32(best - middle)
            if best == middle and bend > np.float32(1e-6):
                shift = min(max(np.float32(0.5) * (above - below) / bend, np.float32(-0.5)), np.float32(0.5))
            out[i, j] = max(level[i, j] + (middle - reach + shift) * spacing, np.float32(0.0))
            correlation[i, j] = combined[best, i, j]
            curvature[i, j] = max(bend, np.float32(0.0)) / (spacing * spacing)
    return out, correlation, curvature


@numba.njit(cache=True, nogil=True, error_model="numpy")
def travel_of(rotations, translations, rays, camera, inverse_depth, height, width):  # type: ignore[no-untyped-def]
    """Movement in pixels of each match per relative change of its depth (H, W), in the neighbour that shows it best."""
    rotations32, translations32 = rotations.astype(np.float32), translations.astype(np.float32)
    out = np.zeros((height, width), dtype=np.float32)
    for n in range(len(rotations)):
        for i in range(height):
            for j in range(width):
                x, y, w = rays[i, j, 0], rays[i, j, 1], inverse_depth[i, j]
                u0, v0 = _seen_at(rotations32[n], translations32[n], camera, x, y, np.float32(0.95) * w)
                u1, v1 = _seen_at(rotations32[n], translations32[n], camera, x, y, np.float32(1.05) * w)
                if 0 <= u0 <= width - 1 and 0 <= v0 <= height - 1 and u1 > np.float32(-1e3):
                    moved = math.sqrt((u1 - u0) ** 2 + (v1 - v0) ** 2) / np.float32(0.1)
                    out[i, j] = max(out[i, j], moved)
    return out
