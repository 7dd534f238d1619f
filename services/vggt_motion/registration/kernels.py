"""Compiled passes over the points of a registration (numba, cached on disk; the numpy reference is in the tests).

Sums run in the order of the points, without fast-math, so that equal input gives equal bits. Import this module only
where it is used: importing numba takes longer than registering a pair.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def accumulate(
    x: Points,
    y: Points,
    weight: Points,
    inverse_unit: Points,
    transform: Array,
    huber: float,
    cutoff: float,
    origin_x: Array,
    origin_y: Array,
) -> Array:
    """Raw moments (18,) of the correspondences under the robust weights at ``transform``.

    Args:
        x: (N, 3) points of the source frame.
        y: (N, 3) points of the target frame.
        weight: (N,) weights of the points.
        inverse_unit: (N,) residuals are multiplied by it before they meet ``huber`` and ``cutoff``.
        transform: (3, 4), scale times rotation and translation.
        huber: residual up to which the loss is quadratic.
        cutoff: residual from which a point has no weight at all.
        origin_x: (3,) subtracted from x, against cancellation.
        origin_y: (3,) subtracted from y.

    Returns:
        Sums of w, w dx (3), w dy (3), w dy dx^T (9, row-major), w |dx|^2, w |dy|^2.
    """
    a00, a01, a02, t0 = transform[0, 0], transform[0, 1], transform[0, 2], transform[0, 3]
    a10, a11, a12, t1 = transform[1, 0], transform[1, 1], transform[1, 2], transform[1, 3]
    a20, a21, a22, t2 = transform[2, 0], transform[2, 1], transform[2, 2], transform[2, 3]
    ox0, ox1, ox2 = origin_x[0], origin_x[1], origin_x[2]
    oy0, oy1, oy2 = origin_y[0], origin_y[1], origin_y[2]
    s = sx0 = sx1 = sx2 = sy0 = sy1 = sy2 = 0.0
    c00 = c01 = c02 = c10 = c11 = c12 = c20 = c21 = c22 = 0.0
    vx = vy = 0.0
    for n in range(x.shape[0]):
        x0, x1, x2 = np.float64(x[n, 0]), np.float64(x[n, 1]), np.float64(x[n, 2])
        y0, y1, y2 = np.float64(y[n, 0]), np.float64(y[n, 1]), np.float64(y[n, 2])
        e0 = a00 * x0 + a01 * x1 + a02 * x2 + t0 - y0
        e1 = a10 * x0 + a11 * x1 + a12 * x2 + t1 - y1
        e2 = a20 * x0 + a21 * x1 + a22 * x2 + t2 - y2
        unit = np.float64(inverse_unit[n])
        squared = (e0 * e0 + e1 * e1 + e2 * e2) * unit * unit
        if squared >= cutoff * cutoff:
            continue
        w = np.float64(weight[n]) * unit * unit
        if squared > huber * huber:
            w *= huber / np.sqrt(squared)
        x0 -= ox0
        x1 -= ox1
        x2 -= ox2
        y0 -= oy0
        y1 -= oy1
        y2 -= oy2
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


@numba.njit(cache=True, nogil=True)
def score(
    x: Points,
    y: Points,
    weight: Points,
    inverse_unit: Points,
    transform: Array,
    huber: float,
    cutoff: float,
    origin: Array,
) -> tuple[Array, Array]:
    """Residuals (N,) times ``inverse_unit``, and the sums (10,) of which the normal equations consist.

    The sums are, with the robust weight w and ``p`` the transformed point minus ``origin``: w, w p (3) and w p p^T
    (xx, xy, xz, yy, yz, zz).
    """
    a00, a01, a02, t0 = transform[0, 0], transform[0, 1], transform[0, 2], transform[0, 3]
    a10, a11, a12, t1 = transform[1, 0], transform[1, 1], transform[1, 2], transform[1, 3]
    a20, a21, a22, t2 = transform[2, 0], transform[2, 1], transform[2, 2], transform[2, 3]
    residuals = np.empty(x.shape[0])
    s = s0 = s1 = s2 = q00 = q01 = q02 = q11 = q12 = q22 = 0.0
    for n in range(x.shape[0]):
        x0, x1, x2 = np.float64(x[n, 0]), np.float64(x[n, 1]), np.float64(x[n, 2])
        p0 = a00 * x0 + a01 * x1 + a02 * x2 + t0
        p1 = a10 * x0 + a11 * x1 + a12 * x2 + t1
        p2 = a20 * x0 + a21 * x1 + a22 * x2 + t2
        e0, e1, e2 = p0 - y[n, 0], p1 - y[n, 1], p2 - y[n, 2]
        unit = np.float64(inverse_unit[n])
        residual = np.sqrt(e0 * e0 + e1 * e1 + e2 * e2) * unit
        residuals[n] = residual
        if residual >= cutoff:
            continue
        w = np.float64(weight[n]) * unit * unit
        if residual > huber:
            w *= huber / residual
        p0 -= origin[0]
        p1 -= origin[1]
        p2 -= origin[2]
        s += w
        s0 += w * p0
        s1 += w * p1
        s2 += w * p2
        q00 += w * p0 * p0
        q01 += w * p0 * p1
        q02 += w * p0 * p2
        q11 += w * p1 * p1
        q12 += w * p1 * p2
        q22 += w * p2 * p2
    return residuals, np.array([s, s0, s1, s2, q00, q01, q02, q11, q12, q22])
