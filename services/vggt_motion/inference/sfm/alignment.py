"""Tracks measured again once the scene is known: small patches aligned with the view of each point that is largest.

A chain of small steps drifts, and is lost where a point grows quickly. With cameras and depths at hand each point is
looked for where it should be, as it should look there (scaled and turned), in every frame near its track; alignment is
inverse compositional (Baker and Matthews, "Lucas-Kanade 20 Years On", 2004) on patches of normalised brightness.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np
import numpy.typing as npt

from vggt_motion.inference.sfm.bundle import Observations, Scene
from vggt_motion.inference.sfm.images import GreyImage

_RADIUS_PX = 4
_REACH = 3  # frames before and after a track in which its point is looked for
_ITERATIONS = 8
_CONVERGED_PX = 0.01
_MAX_SHIFT_PX = 2.5
_MIN_CORRELATION = 0.85
_MIN_SCALE = 0.4  # of the patch in the other frame; below it too little is left of it
_BORDER_PX = 2.0


def remeasure(
    scene: Scene,
    observations: Observations,
    fitting: Observations,
    registered: npt.NDArray[np.bool_],
    images: Sequence[GreyImage],
    usable: npt.NDArray[np.bool_],
) -> Observations:
    """Observations of the scene's points measured again; points that do not fit keep the ones they had.

    Args:
        scene: cameras and points.
        observations: all of them, in pixels relative to the middle of the image.
        fitting: the ones that fit the scene.
        registered: (F,) which cameras are placed.
        images: one per frame, (H, W).
        usable: (H, W), False where nothing may be seen.
    """
    point, frame, pixel = measure(
        scene.rotations, scene.translations, scene.points, scene.shared,
        fitting.start, fitting.frame, fitting.pixel, registered, np.stack(images), usable,
    )  # fmt: skip
    measured = np.zeros(len(observations.start) - 1, dtype=np.bool_)
    measured[point] = True
    kept = ~measured[observations.point]
    return Observations.build(
        np.concatenate([observations.point[kept], point]),
        np.concatenate([observations.frame[kept], frame]),
        np.concatenate([observations.pixel[kept], pixel]),
        len(observations.start) - 1,
    )


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _sample(image, u, v):  # type: ignore[no-untyped-def]
    x, y = int(u), int(v)
    s, t = u - x, v - y
    top = image[y, x] + s * (np.float64(image[y, x + 1]) - image[y, x])
    bottom = image[y + 1, x] + s * (np.float64(image[y + 1, x + 1]) - image[y + 1, x])
    return top + t * (bottom - top)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _place(rotation, translation, shared, x, y, z):  # type: ignore[no-untyped-def]
    """Pixel relative to the middle of the image, and depth, of a point."""
    px = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
    py = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
    pz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
    if pz <= 1e-6:
        return 0.0, 0.0, pz
    a, b = px / pz, py / pz
    bent = shared[1] * (a * a + b * b)
    factor = math.exp(shared[0]) * (1.0 + bent + shared[4] * bent * bent)
    return factor * a + shared[2], factor * b + shared[3], pz


@numba.njit(cache=True, nogil=True, error_model="numpy")
def measure(rotations, translations, points, shared, start, frame, pixel, registered, images, usable):  # type: ignore[no-untyped-def]
    """Observations (point, frame, pixel) of every point that two frames see, in the order of points and frames."""
    count = len(start) - 1
    frames, height, width = images.shape
    middle_u, middle_v = 0.5 * (width - 1), 0.5 * (height - 1)
    side = 2 * _RADIUS_PX + 1
    capacity = 0
    for p in range(count):
        if start[p + 1] - start[p] >= 2:
            capacity += min(frame[start[p + 1] - 1] - frame[start[p]] + 1 + 2 * _REACH, frames)
    out_point = np.empty(capacity, dtype=np.int64)
    out_frame = np.empty(capacity, dtype=np.int64)
    out_pixel = np.empty((capacity, 2))
    used = 0
    template = np.empty((side, side))
    gradient_u = np.empty((side, side))
    gradient_v = np.empty((side, side))
    current = np.empty((side, side))
    margin = _RADIUS_PX + _BORDER_PX
    for p in range(count):
        first, last = start[p], start[p + 1]
        if last - first < 2:
            continue
        # the frame in which the point is seen largest holds the template
        reference, nearest = -1, 1e300
        for o in range(first, last):
            _, _, depth = _place(
                rotations[frame[o]], translations[frame[o]], shared, points[p, 0], points[p, 1], points[p, 2]
            )
            u, v = pixel[o, 0] + middle_u, pixel[o, 1] + middle_v
            inside = margin <= u < width - 1 - margin and margin <= v < height - 1 - margin
            if inside and 1e-6 < depth < nearest:
                reference, nearest = o, depth
        if reference < 0:
            continue
        home = frame[reference]
        centre_u, centre_v = pixel[reference, 0] + middle_u, pixel[reference, 1] + middle_v
        mean = 0.0
        for i in range(side):
            for j in range(side):
                u, v = centre_u + j - _RADIUS_PX, centre_v + i - _RADIUS_PX
                template[i, j] = _sample(images[home], u, v)
                gradient_u[i, j] = 0.5 * (_sample(images[home], u + 1, v) - _sample(images[home], u - 1, v))
                gradient_v[i, j] = 0.5 * (_sample(images[home], u, v + 1) - _sample(images[home], u, v - 1))
                mean += template[i, j]
        mean /= side * side
        spread = huu = huv = hvv = 0.0
        for i in range(side):
            for j in range(side):
                spread += (template[i, j] - mean) ** 2
                huu += gradient_u[i, j] ** 2
                huv += gradient_u[i, j] * gradient_v[i, j]
                hvv += gradient_v[i, j] ** 2
        determinant = huu * hvv - huv * huv
        if spread < 1.0 or determinant < 1e-6 * (huu + hvv) ** 2:
            continue
        # two points beside the template's centre, at the same depth, show how the patch is scaled and turned elsewhere
        base_x, base_y, base_z = _camera_point(rotations[home], translations[home], points[p])
        beside = base_z / math.exp(shared[0])
        right = _world_point(rotations[home], translations[home], base_x + beside, base_y, base_z)
        below = _world_point(rotations[home], translations[home], base_x, base_y + beside, base_z)
        begin = max(frame[first] - _REACH, 0)
        end = min(frame[last - 1] + _REACH, frames - 1)
        o = first
        for f in range(begin, end + 1):
            while o < last and frame[o] < f:
                o += 1
            if f == home:
                out_point[used], out_frame[used] = p, f
                out_pixel[used, 0], out_pixel[used, 1] = pixel[reference, 0], pixel[reference, 1]
                used += 1
                continue
            if not registered[f]:
                continue
            u0, v0, z0 = _place(rotations[f], translations[f], shared, points[p, 0], points[p, 1], points[p, 2])
            ur, vr, zr = _place(rotations[f], translations[f], shared, right[0], right[1], right[2])
            ub, vb, zb = _place(rotations[f], translations[f], shared, below[0], below[1], below[2])
            if min(z0, zr, zb) <= 1e-6:
                continue
            a, b, c, d = ur - u0, ub - u0, vr - v0, vb - v0
            size = math.sqrt(abs(a * d - b * c))
            if not (_MIN_SCALE < size < 1.0 / _MIN_SCALE):
                continue
            u, v = u0 + middle_u, v0 + middle_v
            if o < last and frame[o] == f:
                u, v = pixel[o, 0] + middle_u, pixel[o, 1] + middle_v
            begin_u, begin_v = u, v
            reach_u, reach_v = (abs(a) + abs(b)) * _RADIUS_PX + 1.0, (abs(c) + abs(d)) * _RADIUS_PX + 1.0
            correlation = -1.0
            done = False
            for _ in range(_ITERATIONS):
                if not (reach_u <= u < width - 1 - reach_u and reach_v <= v < height - 1 - reach_v):
                    correlation = -1.0
                    break
                other_mean = 0.0
                for i in range(side):
                    for j in range(side):
                        x, y = j - _RADIUS_PX, i - _RADIUS_PX
                        current[i, j] = _sample(images[f], u + a * x + b * y, v + c * x + d * y)
                        other_mean += current[i, j]
                other_mean /= side * side
                other_spread = product = 0.0
                for i in range(side):
                    for j in range(side):
                        other_spread += (current[i, j] - other_mean) ** 2
                        product += (current[i, j] - other_mean) * (template[i, j] - mean)
                correlation = product / math.sqrt(max(other_spread * spread, 1e-12))
                if done:
                    break
                gain = math.sqrt(spread / max(other_spread, 1e-9))
                gu = gv = 0.0
                for i in range(side):
                    for j in range(side):
                        difference = gain * (current[i, j] - other_mean) - (template[i, j] - mean)
                        gu += gradient_u[i, j] * difference
                        gv += gradient_v[i, j] * difference
                su = (hvv * gu - huv * gv) / determinant
                sv = (huu * gv - huv * gu) / determinant
                u -= a * su + b * sv
                v -= c * su + d * sv
                if abs(u - begin_u) > _MAX_SHIFT_PX or abs(v - begin_v) > _MAX_SHIFT_PX:
                    correlation = -1.0
                    break
                done = su * su + sv * sv < _CONVERGED_PX**2
            if correlation < _MIN_CORRELATION or not usable[int(v + 0.5), int(u + 0.5)]:
                continue
            out_point[used], out_frame[used] = p, f
            out_pixel[used, 0], out_pixel[used, 1] = u - middle_u, v - middle_v
            used += 1
    return out_point[:used], out_frame[:used], out_pixel[:used]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _camera_point(rotation, translation, point):  # type: ignore[no-untyped-def]
    x = rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2] + translation[0]
    y = rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2] + translation[1]
    z = rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2] + translation[2]
    return x, y, z


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _world_point(rotation, translation, x, y, z):  # type: ignore[no-untyped-def]
    dx, dy, dz = x - translation[0], y - translation[1], z - translation[2]
    return (
        rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz,
        rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz,
        rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz,
    )
