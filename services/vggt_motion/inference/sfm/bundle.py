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

    @property
    def shared(self) -> Array:
        """The shared camera as the adjustment sees it: (log focal, k1, principal u, principal v)."""
        return np.array([math.log(self.focal_px), self.radial_k1, self.principal_u, self.principal_v])


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
        system, gradient, elimination, point_step = _reduce(
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
            points, step, observations.start, observations.frame, elimination, point_step, axis, centre, slot
        )
        moved_rotations, moved_translations = _move_cameras(rotations, translations, step, axis, centre, slot)
        moved_shared = shared + step[-_SHARED:]
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
    system, _, _, _ = _reduce(
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
    factor = scene.focal_px * (1.0 + scene.radial_k1 * (x * x + y * y))
    out = np.stack([x * factor + scene.principal_u, y * factor + scene.principal_v], axis=1) - observations.pixel
    out[z <= _MIN_DEPTH] = 1e3
    return np.asarray(out)


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
    return float(data) + float((information * (shared - mean) ** 2).sum())


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _data_cost(rotations, translations, points, shared, start, frame, pixel, robust_px):  # type: ignore[no-untyped-def]
    focal, k1 = math.exp(shared[0]), shared[1]
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
            factor = focal * (1.0 + k1 * (a * a + b * b))
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

    Unknowns: six of each camera that has a slot, in the order of frames, then the shared ones. Also returns, per
    observation, the (10, 3) rows ``W V^-1`` (camera, then its share of the shared rows) and, per point, ``V^-1 g``, for
    the back substitution. A change of the logarithm of the focal length by ``s`` is meant to stretch the scene by
    ``exp(s)`` along ``axis`` (zero: not at all) about ``centre``.
    """
    size = _DIMENSIONS_OF_CAMERA * (slot.max() + 1) + _SHARED
    base = size - _SHARED
    focal, k1 = math.exp(shared[0]), shared[1]
    width = robust_px * robust_px
    system = np.zeros((size, size))
    right = np.zeros(size)
    elimination = np.zeros((len(frame), 6 + _SHARED, 3))
    point_step = np.zeros((len(points), 3))
    jacobian = np.zeros((2, 6 + _SHARED))
    jacobian[0, 8] = 1.0 if free[2] else 0.0
    jacobian[1, 9] = 1.0 if free[3] else 0.0
    on_point = np.zeros((2, 3))
    along = np.zeros((2, 3))
    longest = 0
    for p in range(len(start) - 1):
        longest = max(longest, start[p + 1] - start[p])
    coupling = np.zeros((longest, 6, 3))
    shared_coupling = np.zeros((_SHARED, 3))
    product = np.zeros((longest, 6, 3))
    shared_product = np.zeros((_SHARED, 3))
    for p in range(len(start) - 1):
        first, last = start[p], start[p + 1]
        if first == last:
            continue
        v = np.zeros((3, 3))
        g = np.zeros(3)
        shared_coupling[:] = 0.0
        for o in range(first, last):
            m = o - first
            coupling[m] = 0.0
            r, t = rotations[frame[o]], translations[frame[o]]
            rx = r[0, 0] * points[p, 0] + r[0, 1] * points[p, 1] + r[0, 2] * points[p, 2]
            ry = r[1, 0] * points[p, 0] + r[1, 1] * points[p, 1] + r[1, 2] * points[p, 2]
            rz = r[2, 0] * points[p, 0] + r[2, 1] * points[p, 1] + r[2, 2] * points[p, 2]
            z = rz + t[2]
            if z <= _MIN_DEPTH:
                continue
            a, b = (rx + t[0]) / z, (ry + t[1]) / z
            q = a * a + b * b
            radial = 1.0 + k1 * q
            du, dv = focal * radial * a + shared[2] - pixel[o, 0], focal * radial * b + shared[3] - pixel[o, 1]
            weight = 1.0 / (1.0 + (du * du + dv * dv) / width)
            # derivative of the pixel by the normalised ray, then by the point in the camera
            aa, ab, bb = focal * (radial + 2 * k1 * a * a), focal * 2 * k1 * a * b, focal * (radial + 2 * k1 * b * b)
            along[0, 0], along[0, 1], along[0, 2] = aa / z, ab / z, -(aa * a + ab * b) / z
            along[1, 0], along[1, 1], along[1, 2] = ab / z, bb / z, -(ab * a + bb * b) / z
            for i in range(2):
                jacobian[i, 0] = along[i, 2] * ry - along[i, 1] * rz
                jacobian[i, 1] = along[i, 0] * rz - along[i, 2] * rx
                jacobian[i, 2] = along[i, 1] * rx - along[i, 0] * ry
                jacobian[i, 3], jacobian[i, 4], jacobian[i, 5] = along[i, 0], along[i, 1], along[i, 2]
                for j in range(3):
                    on_point[i, j] = along[i, 0] * r[0, j] + along[i, 1] * r[1, j] + along[i, 2] * r[2, j]
            if free[0]:
                # what the stretch moves in this camera: R e (e . (X - c)), with X - c = R^T (R X + t)
                ex = r[0, 0] * axis[0] + r[0, 1] * axis[1] + r[0, 2] * axis[2]
                ey = r[1, 0] * axis[0] + r[1, 1] * axis[1] + r[1, 2] * axis[2]
                ez = r[2, 0] * axis[0] + r[2, 1] * axis[1] + r[2, 2] * axis[2]
                reach = ex * (rx + t[0]) + ey * (ry + t[1]) + ez * z
                for i in range(2):
                    jacobian[i, 6] = reach * (along[i, 0] * ex + along[i, 1] * ey + along[i, 2] * ez)
                jacobian[0, 6] += focal * radial * a
                jacobian[1, 6] += focal * radial * b
            else:
                jacobian[0, 6] = jacobian[1, 6] = 0.0
            jacobian[0, 7] = focal * q * a if free[1] else 0.0
            jacobian[1, 7] = focal * q * b if free[1] else 0.0
            for i in range(3):
                g[i] += weight * (on_point[0, i] * du + on_point[1, i] * dv)
                for j in range(3):
                    v[i, j] += weight * (on_point[0, i] * on_point[0, j] + on_point[1, i] * on_point[1, j])
            camera = _DIMENSIONS_OF_CAMERA * slot[frame[o]]
            for i in range(_SHARED):
                right[base + i] -= weight * (jacobian[0, 6 + i] * du + jacobian[1, 6 + i] * dv)
                for j in range(_SHARED):
                    system[base + i, base + j] += weight * (
                        jacobian[0, 6 + i] * jacobian[0, 6 + j] + jacobian[1, 6 + i] * jacobian[1, 6 + j]
                    )
                for j in range(3):
                    shared_coupling[i, j] += weight * (
                        jacobian[0, 6 + i] * on_point[0, j] + jacobian[1, 6 + i] * on_point[1, j]
                    )
            if camera < 0:
                continue
            for i in range(6):
                right[camera + i] -= weight * (jacobian[0, i] * du + jacobian[1, i] * dv)
                for j in range(6):
                    system[camera + i, camera + j] += weight * (
                        jacobian[0, i] * jacobian[0, j] + jacobian[1, i] * jacobian[1, j]
                    )
                for j in range(_SHARED):
                    system[camera + i, base + j] += weight * (
                        jacobian[0, i] * jacobian[0, 6 + j] + jacobian[1, i] * jacobian[1, 6 + j]
                    )
                for j in range(3):
                    coupling[m, i, j] = weight * (jacobian[0, i] * on_point[0, j] + jacobian[1, i] * on_point[1, j])
        trace = v[0, 0] + v[1, 1] + v[2, 2]
        if trace <= 0.0:
            continue
        for i in range(3):
            v[i, i] += damping * v[i, i] + 1e-12 * trace
        inverse = _inverse3(v)
        for i in range(3):
            point_step[p, i] = inverse[i, 0] * g[0] + inverse[i, 1] * g[1] + inverse[i, 2] * g[2]
        for i in range(_SHARED):
            for j in range(3):
                shared_product[i, j] = (
                    shared_coupling[i, 0] * inverse[0, j]
                    + shared_coupling[i, 1] * inverse[1, j]
                    + shared_coupling[i, 2] * inverse[2, j]
                )
            right[base + i] += shared_product[i, 0] * g[0] + shared_product[i, 1] * g[1] + shared_product[i, 2] * g[2]
            for j in range(3):
                elimination[first, 6 + i, j] = shared_product[i, j]
        for i in range(_SHARED):
            for j in range(_SHARED):
                system[base + i, base + j] -= (
                    shared_product[i, 0] * shared_coupling[j, 0]
                    + shared_product[i, 1] * shared_coupling[j, 1]
                    + shared_product[i, 2] * shared_coupling[j, 2]
                )
        for o in range(first, last):
            m = o - first
            camera = _DIMENSIONS_OF_CAMERA * slot[frame[o]]
            if camera < 0:
                continue
            for i in range(6):
                for j in range(3):
                    product[m, i, j] = (
                        coupling[m, i, 0] * inverse[0, j]
                        + coupling[m, i, 1] * inverse[1, j]
                        + coupling[m, i, 2] * inverse[2, j]
                    )
                    elimination[o, i, j] = product[m, i, j]
                right[camera + i] += product[m, i, 0] * g[0] + product[m, i, 1] * g[1] + product[m, i, 2] * g[2]
                for j in range(_SHARED):
                    system[camera + i, base + j] -= (
                        product[m, i, 0] * shared_coupling[j, 0]
                        + product[m, i, 1] * shared_coupling[j, 1]
                        + product[m, i, 2] * shared_coupling[j, 2]
                    )
            # blocks above the diagonal only: frames rise along a track
            for n in range(m + 1):
                other = _DIMENSIONS_OF_CAMERA * slot[frame[first + n]]
                if other < 0:
                    continue
                for i in range(6):
                    for j in range(6):
                        system[other + i, camera + j] -= (
                            product[n, i, 0] * coupling[m, j, 0]
                            + product[n, i, 1] * coupling[m, j, 1]
                            + product[n, i, 2] * coupling[m, j, 2]
                        )
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
    return system, right, elimination, point_step


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _inverse3(m):  # type: ignore[no-untyped-def]
    out = np.empty((3, 3))
    out[0, 0] = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
    out[0, 1] = m[0, 2] * m[2, 1] - m[0, 1] * m[2, 2]
    out[0, 2] = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    out[1, 0] = m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2]
    out[1, 1] = m[0, 0] * m[2, 2] - m[0, 2] * m[2, 0]
    out[1, 2] = m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]
    out[2, 0] = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
    out[2, 1] = m[0, 1] * m[2, 0] - m[0, 0] * m[2, 1]
    out[2, 2] = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    determinant = m[0, 0] * out[0, 0] + m[0, 1] * out[1, 0] + m[0, 2] * out[2, 0]
    return out / determinant


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
    points, step, start, frame, elimination, point_step, axis, centre, slot
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
                moved[p, j] -= elimination[start[p], 6 + i, j] * step[base + i]
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
