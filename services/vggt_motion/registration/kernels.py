"""Compiled passes over the points of a registration (numba, cached on disk; the numpy reference is in the tests).

Points are held by coordinate, (3, N) float32, and weights are found in blocks that stay in the cache, so that this
part runs on vector units; the sums run in the order of the points in float64, without fast-math, so that equal input
gives equal bits. Import this module only where it is used: importing numba takes longer than registering a pair.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]

# Neighbours in a row of pixels: a coarse pass takes every few blocks, and still all parts of the image.
_BLOCK = 128
_UNDISTORT_ITERATIONS = 12


@numba.njit(cache=True, nogil=True, error_model="numpy")
def unproject_pair(
    depth_i: Points,
    depth_j: Points,
    mask: npt.NDArray[np.bool_],
    camera_i: Array,
    camera_j: Array,
    i_from_camera: Array,
    j_from_camera: Array,
    scale: float,
) -> tuple[Points, Points, Points, Array]:
    """Correspondences of one image: its masked pixels as points of both submaps.

    Args:
        depth_i: (H, W) along the optical axis, submap i.
        depth_j: (H, W), submap j.
        mask: (H, W) pixels to use; both depths are positive and finite there.
        camera_i: fx, fy, cx, cy, k1, k2 and the radius at which the distortion folds (inf for none), in submap i.
        camera_j: the same of submap j.
        i_from_camera: (4, 4).
        j_from_camera: (4, 4).
        scale: units of j per unit of i, roughly.

    Returns:
        Points in i (3, M) and j (3, M); inverse of the geometric mean of both depths, units of j (M,); and the sums
        (5,) over the pixels of the rays of j: x, y, x x, x y, y y.
    """
    count = 0
    for v in range(mask.shape[0]):
        for u in range(mask.shape[1]):
            count += mask[v, u]
    x, y, inverse = np.empty((3, count), np.float32), np.empty((3, count), np.float32), np.empty(count, np.float32)
    rays = np.zeros(5)
    n = 0
    for v in range(mask.shape[0]):
        for u in range(mask.shape[1]):
            if not mask[v, u]:
                continue
            z_i, z_j = np.float64(depth_i[v, u]), np.float64(depth_j[v, u])
            rx, ry = _ray(u, v, camera_i)
            for axis in range(3):
                row = i_from_camera[axis]
                x[axis, n] = z_i * (row[0] * rx + row[1] * ry + row[2]) + row[3]
            rx, ry = _ray(u, v, camera_j)
            for axis in range(3):
                row = j_from_camera[axis]
                y[axis, n] = z_j * (row[0] * rx + row[1] * ry + row[2]) + row[3]
            inverse[n] = 1.0 / np.sqrt(scale * z_i * z_j)
            rays[0] += rx
            rays[1] += ry
            rays[2] += rx * rx
            rays[3] += rx * ry
            rays[4] += ry * ry
            n += 1
    return x, y, inverse, rays


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _ray(u: int, v: int, camera: Array) -> tuple[float, float]:
    """Normalised coordinates without distortion of a pixel, as ``geometry.projection.undistort_rays`` finds them."""
    x, y = (u - camera[2]) / camera[0], (v - camera[3]) / camera[1]
    k1, k2 = camera[4], camera[5]
    if k1 == 0.0 and k2 == 0.0:
        return x, y
    distorted = np.sqrt(x * x + y * y)
    if distorted <= 1e-12:
        return x, y
    radius = distorted
    for _ in range(_UNDISTORT_ITERATIONS):
        square, fourth = k1 * radius * radius, k2 * radius * radius * radius * radius
        slope = max(1.0 + 3.0 * square + 5.0 * fourth, 0.1)
        radius -= (radius * (1.0 + square + fourth) - distorted) / slope
        radius = min(max(radius, 0.0), camera[6])
    return x * radius / distorted, y * radius / distorted


@numba.njit(cache=True, nogil=True, error_model="numpy")
def gather(
    points_x: npt.NDArray[np.floating],
    points_y: npt.NDArray[np.floating],
    weight: npt.NDArray[np.floating],
    depth: npt.NDArray[np.floating],
) -> tuple[Points, Points, Points, Points]:
    """Keep the points that are finite and have a positive weight and depth.

    Args:
        points_x: (N, 3) points of the source frame.
        points_y: (N, 3) points of the target frame.
        weight: (N,).
        depth: (N,).

    Returns:
        Points x (3, M) and y (3, M), weights (M,) and inverse depths (M,).
        and weight.
    """
    count = points_x.shape[0]
    x, y = np.empty((3, count), np.float32), np.empty((3, count), np.float32)
    w, unit = np.empty(count, np.float32), np.empty(count, np.float32)
    kept = 0
    for n in range(count):
        x0, x1, x2 = np.float32(points_x[n, 0]), np.float32(points_x[n, 1]), np.float32(points_x[n, 2])
        y0, y1, y2 = np.float32(points_y[n, 0]), np.float32(points_y[n, 1]), np.float32(points_y[n, 2])
        weight_n = np.float32(weight[n])
        inverse = np.float32(1.0) / np.float32(depth[n])
        # a sum is finite only if all terms are, short of an overflow, which is as unusable
        if not (np.isfinite(x0 + x1 + x2 + y0 + y1 + y2 + weight_n + inverse) and weight_n > 0.0 and inverse > 0.0):
            continue
        x[0, kept], x[1, kept], x[2, kept] = x0, x1, x2
        y[0, kept], y[1, kept], y[2, kept] = y0, y1, y2
        w[kept], unit[kept] = weight_n, inverse
        kept += 1
    if kept < count:
        return x[:, :kept].copy(), y[:, :kept].copy(), w[:kept].copy(), unit[:kept].copy()
    return x, y, w, unit


@numba.njit(cache=True, nogil=True, error_model="numpy")
def accumulate(
    x: Points,
    y: Points,
    weight: Points,
    loss_unit: Points,
    transform: Array,
    huber: float,
    origin_x: Array,
    origin_y: Array,
    stride: int,
) -> Array:
    """Raw moments (18,) of the correspondences under the robust weights at ``transform``.

    Args:
        x: (3, N) points of the source frame.
        y: (3, N) points of the target frame.
        weight: (N,) weights of the points.
        loss_unit: (N,) residuals are multiplied by it before they meet ``huber``, and weights by its square.
        transform: (3, 4), scale times rotation and translation.
        huber: residual up to which the loss is quadratic.
        origin_x: (3,) subtracted from x, against cancellation.
        origin_y: (3,) subtracted from y.
        stride: 1 for all points; k to pass over one of k blocks of neighbouring points.

    Returns:
        Sums of w, w dx (3), w dy (3), w dy dx^T (9, row-major), w |dx|^2, w |dy|^2.
    """
    a = transform.astype(np.float32)
    a00, a01, a02, t0 = a[0, 0], a[0, 1], a[0, 2], a[0, 3]
    a10, a11, a12, t1 = a[1, 0], a[1, 1], a[1, 2], a[1, 3]
    a20, a21, a22, t2 = a[2, 0], a[2, 1], a[2, 2], a[2, 3]
    width, one, tiny = np.float32(huber), np.float32(1.0), np.float32(1e-30)
    ox0, ox1, ox2 = origin_x[0], origin_x[1], origin_x[2]
    oy0, oy1, oy2 = origin_y[0], origin_y[1], origin_y[2]
    x_0, x_1, x_2 = x[0], x[1], x[2]
    y_0, y_1, y_2 = y[0], y[1], y[2]
    s = sx0 = sx1 = sx2 = sy0 = sy1 = sy2 = 0.0
    c00 = c01 = c02 = c10 = c11 = c12 = c20 = c21 = c22 = 0.0
    vx = vy = 0.0
    robust = np.empty(_BLOCK, np.float32)
    for start in range(0, x.shape[1], _BLOCK * stride):
        size = min(_BLOCK, x.shape[1] - start)
        for k in range(size):
            n = start + k
            e0 = a00 * x_0[n] + a01 * x_1[n] + a02 * x_2[n] + t0 - y_0[n]
            e1 = a10 * x_0[n] + a11 * x_1[n] + a12 * x_2[n] + t1 - y_1[n]
            e2 = a20 * x_0[n] + a21 * x_1[n] + a22 * x_2[n] + t2 - y_2[n]
            unit = loss_unit[n]
            residual = np.sqrt(e0 * e0 + e1 * e1 + e2 * e2) * unit
            robust[k] = weight[n] * unit * unit * min(one, width / max(residual, tiny))
        for k in range(size):
            n = start + k
            w = np.float64(robust[k])
            x0, x1, x2 = x_0[n] - ox0, x_1[n] - ox1, x_2[n] - ox2
            y0, y1, y2 = y_0[n] - oy0, y_1[n] - oy1, y_2[n] - oy2
            wy0, wy1, wy2 = w * y0, w * y1, w * y2
            s += w
            sx0 += w * x0
            sx1 += w * x1
            sx2 += w * x2
            sy0 += wy0
            sy1 += wy1
            sy2 += wy2
            c00 += wy0 * x0
            c01 += wy0 * x1
            c02 += wy0 * x2
            c10 += wy1 * x0
            c11 += wy1 * x1
            c12 += wy1 * x2
            c20 += wy2 * x0
            c21 += wy2 * x1
            c22 += wy2 * x2
            vx += w * (x0 * x0 + x1 * x1 + x2 * x2)
            vy += wy0 * y0 + wy1 * y1 + wy2 * y2
    return np.array([s, sx0, sx1, sx2, sy0, sy1, sy2, c00, c01, c02, c10, c11, c12, c20, c21, c22, vx, vy])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def score(
    x: Points, y: Points, weight: Points, unit: Points, transform: Array, huber: float, origin: Array
) -> tuple[Points, Array]:
    """Residuals (N,) times ``unit``, and the sums (10,) of which the normal equations consist.

    Arguments as of :func:`accumulate`. The sums are, with the robust weight w and ``p`` the transformed point minus
    ``origin`` (3,): w, w p (3) and w p p^T (xx, xy, xz, yy, yz, zz).
    """
    a = transform.astype(np.float32)
    width, one, tiny = np.float32(huber), np.float32(1.0), np.float32(1e-30)
    residuals = np.empty(x.shape[1], np.float32)
    s = s0 = s1 = s2 = q00 = q01 = q02 = q11 = q12 = q22 = 0.0
    for n in range(x.shape[1]):
        p0 = a[0, 0] * x[0, n] + a[0, 1] * x[1, n] + a[0, 2] * x[2, n] + a[0, 3]
        p1 = a[1, 0] * x[0, n] + a[1, 1] * x[1, n] + a[1, 2] * x[2, n] + a[1, 3]
        p2 = a[2, 0] * x[0, n] + a[2, 1] * x[1, n] + a[2, 2] * x[2, n] + a[2, 3]
        e0, e1, e2 = p0 - y[0, n], p1 - y[1, n], p2 - y[2, n]
        residual = np.sqrt(e0 * e0 + e1 * e1 + e2 * e2) * unit[n]
        residuals[n] = residual
        w = np.float64(weight[n] * unit[n] * unit[n] * min(one, width / max(residual, tiny)))
        d0, d1, d2 = p0 - origin[0], p1 - origin[1], p2 - origin[2]
        s += w
        s0 += w * d0
        s1 += w * d1
        s2 += w * d2
        q00 += w * d0 * d0
        q01 += w * d0 * d1
        q02 += w * d0 * d2
        q11 += w * d1 * d1
        q12 += w * d1 * d2
        q22 += w * d2 * d2
    return residuals, np.array([s, s0, s1, s2, q00, q01, q02, q11, q12, q22])
