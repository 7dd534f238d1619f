"""Bundle adjustment of one submap: Levenberg-Marquardt on the reduced camera system, one self-calibrated camera.

Triggs et al., "Bundle Adjustment - A Modern Synthesis" (2000): points are eliminated by the Schur complement, outliers
are held down by a Cauchy kernel. A submap is small (tens of frames, a few thousand points), so the reduced system is
dense and its own Cholesky factorisation here makes the result independent of any library's threads. The same system
gives the uncertainty of the focal length, which no black-box solver would tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

_MIN_DEPTH = 1e-6
_BEHIND_PX = 50.0  # a point behind its camera costs as much as one that is seen so far off
_DIMENSIONS_OF_CAMERA = 6  # rotation, translation
_MAX_LOG_FOCAL_STEP = 0.3  # further off the linearisation says nothing, and the focal length may run away for good
_ALIGNED = 0.97  # length of the mean of unit optical axes above which they look one way
_SHARED = 4  # logarithm of the focal length, radial coefficient, principal point u and v


@dataclass(frozen=True)
class Scene:
    """Cameras, points and the shared camera model; the unit is arbitrary."""

    rotations: Array  # (F, 3, 3) camera_from_submap
    translations: Array  # (F, 3)
    points: Array  # (P, 3) in the submap frame
    focal_px: float
    radial_k1: float = 0.0
    principal_u: float = 0.0  # pixels, relative to where the observations have their origin
    principal_v: float = 0.0
    radial_shape: float = 0.0  # k2 is this times k1 squared: one coefficient, and the way in which lenses bend

    @property
    def shared(self) -> Array:
        """The shared camera as the adjustment sees it: (log focal, k1, principal u and v), and the shape, held."""
        return np.array(
            [math.log(self.focal_px), self.radial_k1, self.principal_u, self.principal_v, self.radial_shape]
        )


@dataclass(frozen=True)
class Observations:
    """Which point is seen where, sorted by point. Pixels are relative to the nominal principal point."""

    start: Index  # (P + 1,): observations of point p are start[p] to start[p + 1]
    frame: Index  # (O,)
    pixel: Array  # (O, 2)

    @staticmethod
    def build(point: Index, frame: Index, pixel: Array, point_count: int) -> Observations:
        """Sort by point, then frame."""
        order = np.lexsort((frame, point))
        start = np.searchsorted(point[order], np.arange(point_count + 1)).astype(np.int64)
        sorted_pixel = np.ascontiguousarray(pixel[order], dtype=np.float64)
        return Observations(start, frame[order].astype(np.int64), sorted_pixel)

    @property
    def point(self) -> Index:
        """(O,) index of the point of each observation."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))

    def subset(self, keep: npt.NDArray[np.bool_]) -> Observations:
        """Some of the observations; points keep their index, even without any."""
        start = np.concatenate([[0], np.cumsum(keep)])[self.start].astype(np.int64)
        return Observations(start, self.frame[keep], self.pixel[keep])


@dataclass(frozen=True)
class Calibration:
    """What may change about the shared camera, and Gaussian priors; the order is that of :attr:`Scene.shared`."""

    free: tuple[bool, bool, bool, bool]
    mean: tuple[float, float, float, float]
    sigma: tuple[float, float, float, float]  # inf: no prior

    def information(self, pixel_sigma: float) -> Array:
        """(4,) weight of the priors beside observations of that standard deviation."""
        sigma = np.array(self.sigma)
        return np.where(np.isfinite(sigma), (pixel_sigma / np.maximum(sigma, 1e-9)) ** 2, 0.0)


@dataclass(frozen=True)
class Adjusted:
    """Result of an adjustment."""

    scene: Scene
    cost: float  # robust, in square pixels, priors included


def adjust(
    scene: Scene,
    observations: Observations,
    calibration: Calibration,
    robust_px: float,
    pixel_sigma: float,
    max_iterations: int,
    tolerance: float = 1e-6,
    fixed_frame: int = 0,
) -> Adjusted:
    """Refine points, shared camera and all cameras that see anything, but one, which is the gauge.

    Args:
        scene: start.
        observations: of the scene's points; points without any are left where they are.
        calibration: of the shared camera.
        robust_px: width of the Cauchy kernel.
        pixel_sigma: standard deviation of a good observation, by which priors are weighed.
        max_iterations: at most so many accepted or refused steps.
        tolerance: relative decrease of the cost that ends the work.
        fixed_frame: the camera that stays.
    """
    rotations, translations = scene.rotations.copy(), scene.translations.copy()
    points = scene.points.copy()
    shared = scene.shared
    mean, information = np.array(calibration.mean), calibration.information(pixel_sigma)
    free = np.array(calibration.free)
    damping, was_accepted = 1e-3, True
    slot = _slots(observations, len(rotations), fixed_frame)
    axis = _stretch_axis(rotations[np.unique(observations.frame)]) if calibration.free[0] else np.zeros(3)
    centre = -rotations[fixed_frame].T @ translations[fixed_frame]
    cost = _cost(rotations, translations, points, shared, observations, robust_px, mean, information)
    for _ in range(max_iterations):
        system, gradient, elimination, shared_elimination, point_step = _reduce(
            rotations, translations, points, shared, observations.start, observations.frame, observations.pixel,
            robust_px, damping, free, mean, information, axis, centre, slot,
        )  # fmt: skip
        solvable, step = solve_positive(system, gradient)
        if not solvable or abs(step[-_SHARED]) > _MAX_LOG_FOCAL_STEP:
            damping *= 10.0
            if damping > 1e8:
                break
            continue
        moved_points = _back_substitute(
            points, step, observations.start, observations.frame, elimination, shared_elimination, point_step,
            axis, centre, slot,
        )  # fmt: skip
        moved_rotations, moved_translations = _move_cameras(rotations, translations, step, axis, centre, slot)
        moved_shared = shared.copy()
        moved_shared[:_SHARED] += step[-_SHARED:]
        moved_cost = _cost(
            moved_rotations, moved_translations, moved_points, moved_shared, observations, robust_px, mean, information
        )
        if moved_cost < cost:
            decrease = cost - moved_cost
            rotations, translations, points, shared = moved_rotations, moved_translations, moved_points, moved_shared
            cost = moved_cost
            damping = max(damping / 5.0, 1e-9) if was_accepted else damping
            was_accepted = True
            if decrease < tolerance * cost:
                break
        else:
            was_accepted = False
            damping *= 5.0
            if damping > 1e8:
                break
    adjusted = Scene(rotations, translations, points, math.exp(shared[0]), *(float(value) for value in shared[1:]))
    return Adjusted(adjusted, float(cost))


def shared_information(
    scene: Scene, observations: Observations, calibration: Calibration, robust_px: float, fixed_frame: int = 0
) -> Array:
    """Information (4, 4) of the shared camera from the observations alone, per square pixel of noise variance.

    Cameras and points are eliminated; the scale of the scene, which nothing can see, is held.

    Rows and columns of what is not refined are 0.
    """
    shared = scene.shared
    free = np.array(calibration.free)
    nothing = np.zeros(_SHARED)
    slot = _slots(observations, len(scene.rotations), fixed_frame)
    system, _, _, _, _ = _reduce(
        scene.rotations, scene.translations, scene.points, shared, observations.start, observations.frame,
        observations.pixel, robust_px, 1e-9, free, nothing, nothing, np.zeros(3), np.zeros(3), slot,
    )  # fmt: skip
    cameras = len(system) - _SHARED
    # what a change of scale about the first camera's centre does to the translations
    centre = -scene.rotations[fixed_frame].T @ scene.translations[fixed_frame]
    gauge = np.zeros(cameras)
    gauge.reshape(-1, _DIMENSIONS_OF_CAMERA)[:, 3:] = (scene.translations + scene.rotations @ centre)[slot >= 0]
    norm = float(np.linalg.norm(gauge))
    block = system[:cameras, :cameras].copy()
    if norm > 0.0:
        block += np.outer(gauge, gauge) * (np.trace(block) / max(cameras, 1) / norm**2)
    cross = system[:cameras, cameras:]
    information = system[cameras:, cameras:].copy()
    columns = []
    for k in range(_SHARED):
        solvable, column = solve_positive(block, np.ascontiguousarray(cross[:, k]))
        columns.append(column if solvable else np.full(cameras, np.nan))
    information -= cross.T @ np.stack(columns, axis=1)
    information[~free] = 0.0
    information[:, ~free] = 0.0
    return np.asarray(information)


def residuals(scene: Scene, observations: Observations) -> Array:
    """Reprojection residuals (O, 2) in pixels; far off where a point is behind its camera."""
    points = scene.points[observations.point]
    frame = observations.frame
    camera = np.einsum("oij,oj->oi", scene.rotations[frame], points) + scene.translations[frame]
    z = camera[:, 2]
    safe = np.where(z > _MIN_DEPTH, z, 1.0)
    x, y = camera[:, 0] / safe, camera[:, 1] / safe
    factor = scene.focal_px * radial_factor(scene, x * x + y * y)
    out = np.stack([x * factor + scene.principal_u, y * factor + scene.principal_v], axis=1) - observations.pixel
    out[z <= _MIN_DEPTH] = 1e3
    return np.asarray(out)


def radial_factor(scene: Scene, square: Array) -> Array:
    """What the lens makes of normalised coordinates whose squared radius is ``square``: they are multiplied by it."""
    bent = scene.radial_k1 * square
    return np.asarray(1.0 + bent + scene.radial_shape * bent * bent)


def looks_one_way(rotations: Array) -> bool:
    """Whether the optical axes of cameras (F, 3, 3) are so alike that the focal length trades against depth."""
    return bool(np.linalg.norm(rotations[:, 2, :].sum(axis=0)) >= _ALIGNED * len(rotations))


def _slots(observations: Observations, frame_count: int, fixed_frame: int) -> Index:
    """Place of each camera among the unknowns, -1 for the fixed one and for those that see nothing."""
    seen = np.zeros(frame_count, dtype=np.bool_)
    seen[observations.frame] = True
    seen[fixed_frame] = False
    return np.where(seen, np.cumsum(seen) - 1, -1)


def _stretch_axis(rotations: Array) -> Array:
    """Mean optical axis in the submap frame, or zero where the cameras look in too many directions.

    Cameras that look one way see a longer focal length and a scene stretched along their axis as nearly the same
    images. The valley is curved in the coordinates of points and cameras, so that steps along it would have to be tiny;
    with the stretch as part of the focal length it is straight.
    """
    if not looks_one_way(rotations):
        return np.zeros(3)
    axis = rotations[:, 2, :].sum(axis=0)
    return np.asarray(axis / np.linalg.norm(axis))


def _cost(
    rotations: Array, translations: Array, points: Array, shared: Array, observations: Observations, robust_px: float,
    mean: Array, information: Array,
) -> float:  # fmt: skip
    data = _data_cost(
        rotations, translations, points, shared, observations.start, observations.frame, observations.pixel, robust_px
    )
    return float(data) + float((information * (shared[:_SHARED] - mean) ** 2).sum())


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _data_cost(rotations, translations, points, shared, start, frame, pixel, robust_px):  # type: ignore[no-untyped-def]
    focal, k1, shape = math.exp(shared[0]), shared[1], shared[4]
    width = robust_px * robust_px
    behind = width * math.log(1.0 + _BEHIND_PX**2 / width)
    cost = 0.0
    for p in range(len(start) - 1):
        for o in range(start[p], start[p + 1]):
            r, t = rotations[frame[o]], translations[frame[o]]
            x = r[0, 0] * points[p, 0] + r[0, 1] * points[p, 1] + r[0, 2] * points[p, 2] + t[0]
            y = r[1, 0] * points[p, 0] + r[1, 1] * points[p, 1] + r[1, 2] * points[p, 2] + t[1]
            z = r[2, 0] * points[p, 0] + r[2, 1] * points[p, 1] + r[2, 2] * points[p, 2] + t[2]
            if z <= _MIN_DEPTH:
                cost += behind
                continue
            a, b = x / z, y / z
            bent = k1 * (a * a + b * b)
            factor = focal * (1.0 + bent + shape * bent * bent)
            du, dv = factor * a + shared[2] - pixel[o, 0], factor * b + shared[3] - pixel[o, 1]
            cost += width * math.log(1.0 + (du * du + dv * dv) / width)
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reduce(  # type: ignore[no-untyped-def]
    rotations,
    translations,
    points,
    shared,
    start,
    frame,
    pixel,
    robust_px,
    damping,
    free,
    mean,
    information,
    axis,
    centre,
    slot,
):
    """Reduced camera system and its right hand side.

    Unknowns: six of each camera that has a slot, in the order of frames, then the shared ones. Also returns what the
    back substitution needs: rows ``W V^-1`` of the camera of each observation (O, 6, 3) and of the shared camera per
    point (P, 4, 3), and ``V^-1 g`` per point (P, 3). A change of the logarithm of the focal length by ``s`` is meant to
    stretch the scene by ``exp(s)`` along ``axis`` (zero: not at all) about ``centre``.

    All derivatives of an observation follow from the two rows ``along`` by the point in the camera: the translation
    moves it as it is, the rotation through the cross product with the turned point ``R X``, the point through ``R``. So
    their products follow from the one matrix ``along^T along``.
    """
    size = _DIMENSIONS_OF_CAMERA * (slot.max() + 1) + _SHARED
    base = size - _SHARED
    focal, k1, shape = math.exp(shared[0]), shared[1], shared[4]
    width = robust_px * robust_px
    system = np.zeros((size, size))
    right = np.zeros(size)
    elimination = np.zeros((len(frame), 6, 3))
    shared_elimination = np.zeros((len(points), _SHARED, 3))
    point_step = np.zeros((len(points), 3))
    any_free = free[0] or free[1] or free[2] or free[3]
    longest = 0
    for p in range(len(start) - 1):
        longest = max(longest, start[p + 1] - start[p])
    # per observation of the point: the slot of its camera, its row, and the six rows of its coupling by column
    slots, rows = np.zeros(longest, dtype=np.int64), np.zeros(longest, dtype=np.int64)
    c0, c1, c2 = np.zeros(6 * longest), np.zeros(6 * longest), np.zeros(6 * longest)
    p0, p1, p2 = np.zeros(6 * longest), np.zeros(6 * longest), np.zeros(6 * longest)
    shared_coupling = np.zeros((_SHARED, 3))
    on_shared = np.zeros((_SHARED, 2))  # derivative of the pixel
    q = np.zeros((_SHARED, 3))
    for p in range(len(start) - 1):
        first, last = start[p], start[p + 1]
        if first == last:
            continue
        v00 = v01 = v02 = v11 = v12 = v22 = g0 = g1 = g2 = 0.0
        shared_coupling[:] = 0.0
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        used = 0
        for o in range(first, last):
            f = frame[o]
            r00, r01, r02 = rotations[f, 0, 0], rotations[f, 0, 1], rotations[f, 0, 2]
            r10, r11, r12 = rotations[f, 1, 0], rotations[f, 1, 1], rotations[f, 1, 2]
            r20, r21, r22 = rotations[f, 2, 0], rotations[f, 2, 1], rotations[f, 2, 2]
            rx = r00 * x + r01 * y + r02 * z
            ry = r10 * x + r11 * y + r12 * z
            rz = r20 * x + r21 * y + r22 * z
            depth = rz + translations[f, 2]
            if depth <= _MIN_DEPTH:
                continue
            inverse_depth = 1.0 / depth
            a, b = (rx + translations[f, 0]) * inverse_depth, (ry + translations[f, 1]) * inverse_depth
            square = a * a + b * b
            bent = k1 * square
            radial = 1.0 + bent + shape * bent * bent
            slope = 1.0 + 2.0 * shape * bent  # of the factor by what is bent
            by_square = 2.0 * focal * k1 * slope
            du, dv = focal * radial * a + shared[2] - pixel[o, 0], focal * radial * b + shared[3] - pixel[o, 1]
            weight = 1.0 / (1.0 + (du * du + dv * dv) / width)
            # derivative of the pixel by the normalised ray, then by the point in the camera
            aa, ab, bb = focal * radial + by_square * a * a, by_square * a * b, focal * radial + by_square * b * b
            a00, a01, a02 = aa * inverse_depth, ab * inverse_depth, -(aa * a + ab * b) * inverse_depth
            a10, a11, a12 = a01, bb * inverse_depth, -(ab * a + bb * b) * inverse_depth
            w00, w01, w02, w10, w11, w12 = (
                weight * a00,
                weight * a01,
                weight * a02,
                weight * a10,
                weight * a11,
                weight * a12,
            )
            m00, m01, m02 = w00 * a00 + w10 * a10, w00 * a01 + w10 * a11, w00 * a02 + w10 * a12
            m11, m12, m22 = w01 * a01 + w11 * a11, w01 * a02 + w11 * a12, w02 * a02 + w12 * a12
            t0, t1, t2 = w00 * du + w10 * dv, w01 * du + w11 * dv, w02 * du + w12 * dv
            # coupling of translation and point, M R
            b00, b01, b02 = (
                m00 * r00 + m01 * r10 + m02 * r20,
                m00 * r01 + m01 * r11 + m02 * r21,
                m00 * r02 + m01 * r12 + m02 * r22,
            )
            b10, b11, b12 = (
                m01 * r00 + m11 * r10 + m12 * r20,
                m01 * r01 + m11 * r11 + m12 * r21,
                m01 * r02 + m11 * r12 + m12 * r22,
            )
            b20, b21, b22 = (
                m02 * r00 + m12 * r10 + m22 * r20,
                m02 * r01 + m12 * r11 + m22 * r21,
                m02 * r02 + m12 * r12 + m22 * r22,
            )
            v00 += r00 * b00 + r10 * b10 + r20 * b20
            v01 += r00 * b01 + r10 * b11 + r20 * b21
            v02 += r00 * b02 + r10 * b12 + r20 * b22
            v11 += r01 * b01 + r11 * b11 + r21 * b21
            v12 += r01 * b02 + r11 * b12 + r21 * b22
            v22 += r02 * b02 + r12 * b12 + r22 * b22
            g0 += r00 * t0 + r10 * t1 + r20 * t2
            g1 += r01 * t0 + r11 * t1 + r21 * t2
            g2 += r02 * t0 + r12 * t1 + r22 * t2
            if any_free:
                factor = focal * radial
                on_shared[0, 0], on_shared[0, 1] = factor * a, factor * b
                # what the stretch moves in this camera: R e (e . (X - c)), with X - c = R^T (R X + t)
                ex = r00 * axis[0] + r01 * axis[1] + r02 * axis[2]
                ey = r10 * axis[0] + r11 * axis[1] + r12 * axis[2]
                ez = r20 * axis[0] + r21 * axis[1] + r22 * axis[2]
                reach = ex * (rx + translations[f, 0]) + ey * (ry + translations[f, 1]) + ez * depth
                on_shared[0, 0] += reach * (a00 * ex + a01 * ey + a02 * ez)
                on_shared[0, 1] += reach * (a10 * ex + a11 * ey + a12 * ez)
                on_shared[1, 0], on_shared[1, 1] = focal * square * slope * a, focal * square * slope * b
                on_shared[2, 0], on_shared[3, 1] = 1.0, 1.0
                for k in range(_SHARED):
                    if not free[k]:
                        on_shared[k, 0] = on_shared[k, 1] = 0.0
                    s0, s1 = on_shared[k, 0], on_shared[k, 1]
                    right[base + k] -= weight * (s0 * du + s1 * dv)
                    q[k, 0], q[k, 1], q[k, 2] = w00 * s0 + w10 * s1, w01 * s0 + w11 * s1, w02 * s0 + w12 * s1
                    shared_coupling[k, 0] += r00 * q[k, 0] + r10 * q[k, 1] + r20 * q[k, 2]
                    shared_coupling[k, 1] += r01 * q[k, 0] + r11 * q[k, 1] + r21 * q[k, 2]
                    shared_coupling[k, 2] += r02 * q[k, 0] + r12 * q[k, 1] + r22 * q[k, 2]
                for k in range(_SHARED):
                    for j in range(k, _SHARED):
                        system[base + k, base + j] += weight * (
                            on_shared[k, 0] * on_shared[j, 0] + on_shared[k, 1] * on_shared[j, 1]
                        )
            if slot[f] < 0:
                continue
            at = _DIMENSIONS_OF_CAMERA * slot[f]
            right[at] -= ry * t2 - rz * t1
            right[at + 1] -= rz * t0 - rx * t2
            right[at + 2] -= rx * t1 - ry * t0
            right[at + 3] -= t0
            right[at + 4] -= t1
            right[at + 5] -= t2
            # rotation and translation, r x M
            h00, h01, h02 = ry * m02 - rz * m01, ry * m12 - rz * m11, ry * m22 - rz * m12
            h10, h11, h12 = rz * m00 - rx * m02, rz * m01 - rx * m12, rz * m02 - rx * m22
            h20, h21, h22 = rx * m01 - ry * m00, rx * m11 - ry * m01, rx * m12 - ry * m02
            system[at, at] += ry * h02 - rz * h01
            system[at, at + 1] += rz * h00 - rx * h02
            system[at, at + 2] += rx * h01 - ry * h00
            system[at + 1, at + 1] += rz * h10 - rx * h12
            system[at + 1, at + 2] += rx * h11 - ry * h10
            system[at + 2, at + 2] += rx * h21 - ry * h20
            system[at, at + 3] += h00
            system[at, at + 4] += h01
            system[at, at + 5] += h02
            system[at + 1, at + 3] += h10
            system[at + 1, at + 4] += h11
            system[at + 1, at + 5] += h12
            system[at + 2, at + 3] += h20
            system[at + 2, at + 4] += h21
            system[at + 2, at + 5] += h22
            system[at + 3, at + 3] += m00
            system[at + 3, at + 4] += m01
            system[at + 3, at + 5] += m02
            system[at + 4, at + 4] += m11
            system[at + 4, at + 5] += m12
            system[at + 5, at + 5] += m22
            if any_free:
                for k in range(_SHARED):
                    q0, q1, q2 = q[k, 0], q[k, 1], q[k, 2]
                    system[at, base + k] += ry * q2 - rz * q1
                    system[at + 1, base + k] += rz * q0 - rx * q2
                    system[at + 2, base + k] += rx * q1 - ry * q0
                    system[at + 3, base + k] += q0
                    system[at + 4, base + k] += q1
                    system[at + 5, base + k] += q2
            k = 6 * used
            c0[k], c1[k], c2[k] = ry * b20 - rz * b10, ry * b21 - rz * b11, ry * b22 - rz * b12
            c0[k + 1], c1[k + 1], c2[k + 1] = rz * b00 - rx * b20, rz * b01 - rx * b21, rz * b02 - rx * b22
            c0[k + 2], c1[k + 2], c2[k + 2] = rx * b10 - ry * b00, rx * b11 - ry * b01, rx * b12 - ry * b02
            c0[k + 3], c1[k + 3], c2[k + 3] = b00, b01, b02
            c0[k + 4], c1[k + 4], c2[k + 4] = b10, b11, b12
            c0[k + 5], c1[k + 5], c2[k + 5] = b20, b21, b22
            slots[used], rows[used] = slot[f], o
            used += 1
        trace = v00 + v11 + v22
        if trace <= 0.0:
            continue
        v00 += damping * v00 + 1e-12 * trace
        v11 += damping * v11 + 1e-12 * trace
        v22 += damping * v22 + 1e-12 * trace
        i00, i01, i02, i11, i12, i22 = _inverse_symmetric(v00, v01, v02, v11, v12, v22)
        s0, s1, s2 = i00 * g0 + i01 * g1 + i02 * g2, i01 * g0 + i11 * g1 + i12 * g2, i02 * g0 + i12 * g1 + i22 * g2
        point_step[p, 0], point_step[p, 1], point_step[p, 2] = s0, s1, s2
        for k in range(6 * used):
            d0, d1, d2 = c0[k], c1[k], c2[k]
            p0[k] = d0 * i00 + d1 * i01 + d2 * i02
            p1[k] = d0 * i01 + d1 * i11 + d2 * i12
            p2[k] = d0 * i02 + d1 * i12 + d2 * i22
        if any_free:
            for k in range(_SHARED):
                d0, d1, d2 = shared_coupling[k, 0], shared_coupling[k, 1], shared_coupling[k, 2]
                e0 = d0 * i00 + d1 * i01 + d2 * i02
                e1 = d0 * i01 + d1 * i11 + d2 * i12
                e2 = d0 * i02 + d1 * i12 + d2 * i22
                shared_elimination[p, k, 0], shared_elimination[p, k, 1], shared_elimination[p, k, 2] = e0, e1, e2
                right[base + k] += e0 * g0 + e1 * g1 + e2 * g2
                for j in range(k, _SHARED):
                    system[base + k, base + j] -= (
                        e0 * shared_coupling[j, 0] + e1 * shared_coupling[j, 1] + e2 * shared_coupling[j, 2]
                    )
        for n in range(used):
            at = _DIMENSIONS_OF_CAMERA * slots[n]
            for i in range(6):
                k = 6 * n + i
                d0, d1, d2 = p0[k], p1[k], p2[k]
                elimination[rows[n], i, 0], elimination[rows[n], i, 1], elimination[rows[n], i, 2] = d0, d1, d2
                right[at + i] += d0 * g0 + d1 * g1 + d2 * g2
                if any_free:
                    for j in range(_SHARED):
                        system[at + i, base + j] -= (
                            d0 * shared_coupling[j, 0] + d1 * shared_coupling[j, 1] + d2 * shared_coupling[j, 2]
                        )
            # blocks above the diagonal only: frames rise along a track; cameras that follow each other in one go
            m = n
            while m < used:
                end = m + 1
                while end < used and slots[end] == slots[end - 1] + 1:
                    end += 1
                count = 6 * (end - m)
                e0, e1, e2 = c0[6 * m : 6 * m + count], c1[6 * m : 6 * m + count], c2[6 * m : 6 * m + count]
                column = _DIMENSIONS_OF_CAMERA * slots[m]
                for i in range(6):
                    d0, d1, d2 = p0[6 * n + i], p1[6 * n + i], p2[6 * n + i]
                    row = system[at + i, column : column + count]
                    for j in range(count):
                        row[j] -= d0 * e0[j] + d1 * e1[j] + d2 * e2[j]
                m = end
    for k in range(_SHARED):
        system[base + k, base + k] += information[k]
        right[base + k] -= information[k] * (shared[k] - mean[k])
        if not free[k]:
            system[base + k, base + k] = 1.0
            right[base + k] = 0.0
    for i in range(size):
        for j in range(i):
            system[i, j] = system[j, i]
    for i in range(size):
        system[i, i] += damping * system[i, i] + 1e-12
    return system, right, elimination, shared_elimination, point_step


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _inverse_symmetric(m00, m01, m02, m11, m12, m22):  # type: ignore[no-untyped-def]
    """Upper triangle of the inverse of a symmetric 3x3 matrix."""
    i00, i01, i02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
    i11, i12, i22 = m00 * m22 - m02 * m02, m01 * m02 - m00 * m12, m00 * m11 - m01 * m01
    scale = 1.0 / (m00 * i00 + m01 * i01 + m02 * i02)
    return i00 * scale, i01 * scale, i02 * scale, i11 * scale, i12 * scale, i22 * scale


@numba.njit(cache=True, nogil=True, error_model="numpy")
def solve_positive(system, right):  # type: ignore[no-untyped-def]
    """Cholesky solution of a symmetric positive definite system, and whether it is one."""
    size = len(right)
    lower = np.zeros((size, size))
    for j in range(size):
        for i in range(j, size):
            value = system[i, j]
            for k in range(j):
                value -= lower[i, k] * lower[j, k]
            if i == j:
                if not value > 1e-14 * abs(system[j, j]):
                    return False, np.zeros(size)
                lower[j, j] = math.sqrt(value)
            else:
                lower[i, j] = value / lower[j, j]
    solution = right.copy()
    for i in range(size):
        for k in range(i):
            solution[i] -= lower[i, k] * solution[k]
        solution[i] /= lower[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            solution[i] -= lower[k, i] * solution[k]
        solution[i] /= lower[i, i]
    return True, solution


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _back_substitute(  # type: ignore[no-untyped-def]
    points, step, start, frame, elimination, shared_elimination, point_step, axis, centre, slot
):
    moved = points.copy()
    base = len(step) - _SHARED
    stretch = math.exp(step[base]) - 1.0
    for p in range(len(points)):
        if start[p] == start[p + 1]:
            continue
        reach = (
            axis[0] * (points[p, 0] - centre[0])
            + axis[1] * (points[p, 1] - centre[1])
            + axis[2] * (points[p, 2] - centre[2])
        )
        for j in range(3):
            moved[p, j] += stretch * reach * axis[j] - point_step[p, j]
        for i in range(_SHARED):
            for j in range(3):
                moved[p, j] -= shared_elimination[p, i, j] * step[base + i]
        for o in range(start[p], start[p + 1]):
            camera = _DIMENSIONS_OF_CAMERA * slot[frame[o]]
            if camera < 0:
                continue
            for i in range(6):
                for j in range(3):
                    moved[p, j] -= elimination[o, i, j] * step[camera + i]
    return moved


@numba.njit(cache=True, nogil=True, error_model="numpy")
def rotation_of(x, y, z):  # type: ignore[no-untyped-def]
    """Rotation matrix (3, 3) of a rotation vector in radians (Rodrigues)."""
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-9:
        s, c = 1.0, 0.5
    else:
        s, c = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    turn = np.empty((3, 3))
    turn[0, 0], turn[0, 1], turn[0, 2] = 1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
    turn[1, 0], turn[1, 1], turn[1, 2] = c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x
    turn[2, 0], turn[2, 1], turn[2, 2] = c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)
    return turn


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _move_cameras(rotations, translations, step, axis, origin, slot):  # type: ignore[no-untyped-def]
    moved_rotations, moved_translations = rotations.copy(), translations.copy()
    stretch = math.exp(step[len(step) - _SHARED]) - 1.0
    centre = np.empty(3)
    for f in range(len(rotations)):
        if slot[f] < 0:
            continue
        for i in range(3):
            centre[i] = (
                -(
                    rotations[f, 0, i] * translations[f, 0]
                    + rotations[f, 1, i] * translations[f, 1]
                    + rotations[f, 2, i] * translations[f, 2]
                )
                - origin[i]
            )
        reach = stretch * (axis[0] * centre[0] + axis[1] * centre[1] + axis[2] * centre[2])
        at = _DIMENSIONS_OF_CAMERA * slot[f]
        turn = rotation_of(step[at], step[at + 1], step[at + 2])
        for i in range(3):
            for j in range(3):
                moved_rotations[f, i, j] = (
                    turn[i, 0] * rotations[f, 0, j] + turn[i, 1] * rotations[f, 1, j] + turn[i, 2] * rotations[f, 2, j]
                )
        for i in range(3):
            moved = step[at + 3 + i] + translations[f, i]
            for j in range(3):
                moved -= rotations[f, i, j] * reach * axis[j]
            moved_translations[f, i] = moved
    return moved_rotations, moved_translations
