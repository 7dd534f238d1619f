"""Points from known cameras, robust against observations that belong elsewhere."""

from __future__ import annotations

import numba
import numpy as np

_ITERATIONS = 6


@numba.njit(cache=True, nogil=True, error_model="numpy")
def triangulate(rotations, translations, rays, start, frame, robust_angle):  # type: ignore[no-untyped-def]
    """Points (P, 3) nearest to their rays in angle, by re-weighted least squares with a Cauchy kernel, and a flag (P,).

    ``rotations`` (F, 3, 3) and ``translations`` (F, 3) are camera_from_submap, ``rays`` (O, 2) normalised coordinates
    without distortion, observations of point p are ``start[p]`` to ``start[p + 1]``. The flag is False where a point's
    rays are parallel or most of its weight lies behind the cameras.
    """
    count = len(start) - 1
    points = np.zeros((count, 3))
    valid = np.zeros(count, dtype=np.bool_)
    directions = np.empty((len(frame), 3))
    centres = np.empty((len(rotations), 3))
    for f in range(len(rotations)):
        for i in range(3):
            centres[f, i] = -(
                rotations[f, 0, i] * translations[f, 0]
                + rotations[f, 1, i] * translations[f, 1]
                + rotations[f, 2, i] * translations[f, 2]
            )
    for p in range(count):
        first, last = start[p], start[p + 1]
        if last - first < 2:
            continue
        for o in range(first, last):
            r = rotations[frame[o]]
            norm = np.sqrt(rays[o, 0] ** 2 + rays[o, 1] ** 2 + 1.0)
            for i in range(3):
                directions[o, i] = (r[0, i] * rays[o, 0] + r[1, i] * rays[o, 1] + r[2, i]) / norm
        ok = False
        x = np.zeros(3)
        for iteration in range(_ITERATIONS):
            m = np.zeros((3, 3))
            g = np.zeros(3)
            for o in range(first, last):
                d = directions[o]
                c = centres[frame[o]]
                weight = 1.0
                if iteration > 0:
                    y0, y1, y2 = x[0] - c[0], x[1] - c[1], x[2] - c[2]
                    distance = max(y0 * y0 + y1 * y1 + y2 * y2, 1e-12)
                    reach = y0 * d[0] + y1 * d[1] + y2 * d[2]
                    sine = max(distance - reach * reach, 0.0) / distance
                    if reach <= 0.0:
                        sine = 1.0
                    weight = 1.0 / (distance * (1.0 + sine / robust_angle**2))
                along = d[0] * c[0] + d[1] * c[1] + d[2] * c[2]
                for i in range(3):
                    g[i] += weight * (c[i] - d[i] * along)
                    for j in range(3):
                        m[i, j] -= weight * d[i] * d[j]
                    m[i, i] += weight
            c0 = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
            c1 = m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2]
            c2 = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
            determinant = m[0, 0] * c0 + m[0, 1] * c1 + m[0, 2] * c2
            trace = m[0, 0] + m[1, 1] + m[2, 2]
            ok = determinant > 1e-9 * trace**3
            if not ok:
                break
            x[0] = (
                c0 * g[0]
                + (m[0, 2] * m[2, 1] - m[0, 1] * m[2, 2]) * g[1]
                + (m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]) * g[2]
            ) / determinant
            x[1] = (
                c1 * g[0]
                + (m[0, 0] * m[2, 2] - m[0, 2] * m[2, 0]) * g[1]
                + (m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]) * g[2]
            ) / determinant
            x[2] = (
                c2 * g[0]
                + (m[0, 1] * m[2, 0] - m[0, 0] * m[2, 1]) * g[1]
                + (m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]) * g[2]
            ) / determinant
        if ok:
            in_front = 0
            for o in range(first, last):
                d = directions[o]
                c = centres[frame[o]]
                if (x[0] - c[0]) * d[0] + (x[1] - c[1]) * d[1] + (x[2] - c[2]) * d[2] > 0.0:
                    in_front += 1
            ok = in_front >= 2 and 2 * in_front > last - first
        points[p] = x
        valid[p] = ok
    return points, valid
