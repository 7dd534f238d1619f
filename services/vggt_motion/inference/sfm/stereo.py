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
_SWEPT = 3  # neighbours, the first ones, of the coarse sweep; the others only help to refine
_UNSEEN_COST = 1.0  # of a hypothesis that no neighbour sees
_FINE = ((1, 0.5), (1, 0.25))  # hypotheses on each side, and their spacing in coarse steps


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
        views: one to four neighbours, the best ones first.
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
        np.stack([_halved(view.image, half_width, half_height) for view in views[:_SWEPT]]),
        rotations[:_SWEPT],
        translations[:_SWEPT],
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
    known = intrinsics
    return np.array([known.fx, known.fy, known.cx, known.cy, known.k1, known.k2], dtype=np.float32)


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
def _sums(first, second, third, fourth, fifth, padded):  # type: ignore[no-untyped-def]
    """Sums down the five rows of a window, with the border repeated at both ends: (W + 4,)."""
    width = len(first)
    inner = padded[2 : 2 + width]
    for j in range(width):
        inner[j] = first[j] + second[j] + third[j] + fourth[j] + fifth[j]
    padded[0] = padded[1] = padded[2]
    padded[width + 3] = padded[width + 2] = padded[width + 1]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _statistics(reference):  # type: ignore[no-untyped-def]
    """Mean and deviation (H, W) of each window, noise included."""
    height, width = reference.shape
    mean, deviation = np.empty_like(reference), np.empty_like(reference)
    square = reference * reference
    sums, squares = np.empty(width + 4, dtype=np.float32), np.empty(width + 4, dtype=np.float32)
    share = np.float32(1.0 / (2 * _RADIUS_PX + 1) ** 2)
    for i in range(height):
        a, b, d, e = max(i - 2, 0), max(i - 1, 0), min(i + 1, height - 1), min(i + 2, height - 1)
        _sums(reference[a], reference[b], reference[i], reference[d], reference[e], sums)
        _sums(square[a], square[b], square[i], square[d], square[e], squares)
        for j in range(width):
            m = (sums[j] + sums[j + 1] + sums[j + 2] + sums[j + 3] + sums[j + 4]) * share
            mm = (squares[j] + squares[j + 1] + squares[j + 2] + squares[j + 3] + squares[j + 4]) * share
            mean[i, j] = m
            deviation[i, j] = np.sqrt(max(mm - m * m, np.float32(0.0)) + np.float32(_NOISE_VARIANCE))
    return mean, deviation


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _warp_row(source, x, y, z, translation, camera, inverse_depth, columns, rows, warped, inside):  # type: ignore[no-untyped-def]
    """Bilinear samples of ``source`` where a row of pixels with their inverse depths is seen, border repeated.

    The coordinates are computed apart from the samples: that loop then runs on several pixels at once.
    """
    height, width = source.shape
    tx, ty, tz = translation[0], translation[1], translation[2]
    fx, fy, cx, cy, k1, k2 = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    last_u, last_v = np.float32(width - 1.001), np.float32(height - 1.001)
    end_u, end_v = np.float32(width) - half, np.float32(height) - half
    for j in range(len(x)):
        w = inverse_depth[j]
        pz = z[j] + w * tz
        front = pz > np.float32(0.05)
        scale = one / (pz if front else one)
        a, b = (x[j] + w * tx) * scale, (y[j] + w * ty) * scale
        square = a * a + b * b
        factor = one + square * (k1 + k2 * square)
        u, v = fx * a * factor + cx, fy * b * factor + cy
        inside[j] = one if front and u >= -half and v >= -half and u <= end_u and v <= end_v else zero
        columns[j] = min(max(u, zero), last_u)
        rows[j] = min(max(v, zero), last_v)
    flat = source.reshape(height * width)
    stride = np.uint32(width)
    for j in range(len(x)):
        u, v = columns[j], rows[j]
        c, r = np.int32(u), np.int32(v)
        s, t = u - np.float32(c), v - np.float32(r)
        at = np.uint32(r) * stride + np.uint32(c)
        top, bottom = flat[at], flat[at + stride]
        top += s * (flat[at + np.uint32(1)] - top)
        bottom += s * (flat[at + stride + np.uint32(1)] - bottom)
        warped[j] = top + t * (bottom - top)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _score(  # type: ignore[no-untyped-def]
    reference, mean, deviation, source, turned, translation, camera, inverse_depth, work, line, best, following, seen
):
    """Take the correlation with one neighbour into the best two of each pixel, and into how many there are.

    Work is done row by row, so that a window's rows are still in the nearest cache when they are needed.
    """
    height, width = reference.shape
    warped, square, product, inside = work[0], work[1], work[2], work[3]
    columns, rows, sums, squares, products = line[0], line[1], line[2], line[3], line[4]
    noise, share, lowest = np.float32(_NOISE_VARIANCE), np.float32(1.0 / (2 * _RADIUS_PX + 1) ** 2), np.float32(-1.0)
    zero, one = np.float32(0.0), np.float32(1.0)
    for k in range(height + _RADIUS_PX):
        if k < height:
            _warp_row(
                source,
                turned[0, k],
                turned[1, k],
                turned[2, k],
                translation,
                camera,
                inverse_depth[k],
                columns,
                rows,
                warped[k],
                inside[k],
            )
            w, r, ww, wr = warped[k], reference[k], square[k], product[k]
            for j in range(width):
                ww[j] = w[j] * w[j]
                wr[j] = w[j] * r[j]
        i = k - _RADIUS_PX
        if i < 0:
            continue
        a, b, d, e = max(i - 2, 0), max(i - 1, 0), min(i + 1, height - 1), min(i + 2, height - 1)
        _sums(warped[a], warped[b], warped[i], warped[d], warped[e], sums)
        _sums(square[a], square[b], square[i], square[d], square[e], squares)
        _sums(product[a], product[b], product[i], product[d], product[e], products)
        row_mean, row_deviation, row_inside = mean[i], deviation[i], inside[i]
        row_best, row_following, row_seen = best[i], following[i], seen[i]
        for j in range(width):
            m = (sums[j] + sums[j + 1] + sums[j + 2] + sums[j + 3] + sums[j + 4]) * share
            mm = (squares[j] + squares[j + 1] + squares[j + 2] + squares[j + 3] + squares[j + 4]) * share
            mr = (products[j] + products[j + 1] + products[j + 2] + products[j + 3] + products[j + 4]) * share
            variance = max(mm - m * m, zero) + noise
            value = (mr - m * row_mean[j]) / (row_deviation[j] * np.sqrt(variance))
            value = value if row_inside[j] > zero else lowest
            top = row_best[j]
            row_best[j] = max(top, value)
            row_following[j] = max(row_following[j], min(top, value))
            row_seen[j] += one if value > lowest else zero


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _combined(  # type: ignore[no-untyped-def]
    reference, mean, deviation, sources, turned, translations, camera, inverse_depth, work, line, best, following, seen
):
    """Mean correlation ``best`` (H, W) of the better half of the neighbours that see a pixel, -1 without any.

    The others may be occluded. There are four at most: the best one of up to two, the best two of three and four.
    """
    best[:] = np.float32(-1.0)
    following[:] = np.float32(-1.0)
    seen[:] = np.float32(0.0)
    for n in range(len(sources)):
        _score(
            reference, mean, deviation, sources[n], turned[n], translations[n], camera, inverse_depth, work, line,
            best, following, seen,
        )  # fmt: skip
    height, width = reference.shape
    for i in range(height):
        row_best, row_following, row_seen = best[i], following[i], seen[i]
        for j in range(width):
            both = np.float32(0.5) * (row_best[j] + row_following[j])
            row_best[j] = both if row_seen[j] > np.float32(2.5) else row_best[j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sweep_cost(reference, sources, rotations, translations, rays, camera, inverse_depths):  # type: ignore[no-untyped-def]
    """Cost volume (H, W, D) float32: one minus the correlation of the better half of the neighbours."""
    count = len(sources)
    height, width = reference.shape
    depths = len(inverse_depths)
    rotations32, translations32 = rotations.astype(np.float32), translations.astype(np.float32)
    mean, deviation = _statistics(reference)
    work, line = np.empty((4, height, width), dtype=np.float32), np.empty((5, width + 4), dtype=np.float32)
    plane = np.empty((height, width), dtype=np.float32)
    best, following, seen = np.empty_like(plane), np.empty_like(plane), np.empty_like(plane)
    volume = np.empty((height, width, depths), dtype=np.float32)
    turned = np.empty((count, 3, height, width), dtype=np.float32)
    for n in range(count):
        _turned(rotations32[n], rays, turned[n])
    for d in range(depths):
        plane[:] = np.float32(inverse_depths[d])
        _combined(
            reference,
            mean,
            deviation,
            sources,
            turned,
            translations32,
            camera,
            plane,
            work,
            line,
            best,
            following,
            seen,
        )
        for i in range(height):
            for j in range(width):
                score = best[i, j]
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
    mean, deviation = _statistics(reference)
    work, line = np.empty((4, height, width), dtype=np.float32), np.empty((5, width + 4), dtype=np.float32)
    inverse_depth = np.empty((height, width), dtype=np.float32)
    following, seen = np.empty_like(inverse_depth), np.empty_like(inverse_depth)
    combined = np.empty((2 * reach + 1, height, width), dtype=np.float32)
    turned = np.empty((count, 3, height, width), dtype=np.float32)
    for n in range(count):
        _turned(rotations32[n], rays, turned[n])
    for k in range(2 * reach + 1):
        shift = np.float32(k - reach) * spacing
        for i in range(height):
            for j in range(width):
                inverse_depth[i, j] = max(level[i, j] + shift, np.float32(0.0)) * step
        _combined(
            reference, mean, deviation, sources, turned, translations32, camera, inverse_depth, work, line,
            combined[k], following, seen,
        )  # fmt: skip
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
            bend = np.float32(2.0) * top - below - above
            shift = np.float32(best - middle)
            if best == middle and bend > np.float32(1e-6):
                shift = min(max(np.float32(0.5) * (above - below) / bend, np.float32(-0.5)), np.float32(0.5))
            out[i, j] = max(level[i, j] + (np.float32(middle - reach) + shift) * spacing, np.float32(0.0))
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
