"""A submap grown frame by frame: two-view geometry for a seed, resection against the points known so far for the rest.

An essential matrix alone confuses sideways motion with rotation where the field of view is narrow, and a chain of them
inherits every such mistake. Points that three and more frames agree on do not: so the seed is the triple of neighbours
whose points fit best, and every further frame is placed by the points that it shares with those before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numba
import numpy as np
import numpy.typing as npt

from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import undistort_rays
from vggt_motion.inference.sfm import bundle, parallel
from vggt_motion.inference.sfm.bundle import Calibration, Observations, Scene
from vggt_motion.inference.sfm.triangulation import triangulate

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

_EPIPOLAR_PX = 0.5  # wider, and sideways motion passes for rotation
_MIN_PAIR_POINTS = 12
_MIN_RESECTION_POINTS = 10
_MIN_RESECTION_INLIERS = 8
_INLIER_PX = 3.0
_SEED_CANDIDATES = 6
_MAX_COST_RATIO = 3.0  # of poses of one frame that are weighed against each other
_SAME_ROTATION_TRACE = 3.0 - math.radians(0.3) ** 2  # of relative rotations closer than 0.3 degrees
_CAPPED_PX = 2.0
# Kernels in pixels: from far away, where the motion is a guess; from nearby, or outliers would pull a good one off
WIDE_TO_NARROW = np.array([16.0, 16.0, 16.0, 8.0, 8.0, 4.0, 4.0, 2.0, 2.0, 1.0, 1.0, 1.0])
_NARROW = np.array([2.0, 2.0, 2.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
_HELD = Calibration((False, False, False, False), (0.0, 0.0, 0.0, 0.0), (math.inf, math.inf, math.inf, math.inf))


@dataclass(frozen=True)
class Grown:
    """A first scene and which frames have a place in it."""

    scene: Scene
    registered: Mask  # (F,)


@dataclass(frozen=True)
class _Pair:
    b_from_a: Array  # (4, 4), unit translation
    inlier_count: int
    score: float  # larger is a better seed


def grow(observations: Observations, frame_count: int, camera: Scene, calibration: Calibration) -> Grown | None:
    """Place as many frames as possible.

    Args:
        observations: of all frames, in time order.
        frame_count: number of frames.
        camera: its shared camera is the start; its poses and points are ignored.
        calibration: of the focal length, which follows the frames as soon as they turn.

    Returns:
        None where no two neighbouring frames have a geometry.
    """
    rays = rays_of(observations, camera)
    found = parallel.each(lambda a: _pair(observations, rays, a, camera.focal_px), range(frame_count - 1))
    pairs = {a: pair for a, pair in enumerate(found) if pair is not None}
    if not pairs:
        return None
    growing = _best_seed(observations, pairs, frame_count, camera)
    while growing is not None and not growing.registered.all():
        placed = _place_next(growing, observations, pairs)
        if placed is None:
            break
        growing = placed
        count = int(growing.registered.sum())
        if count % 3 == 0 or growing.registered.all():
            growing = settle(growing, observations, calibration, iterations=5, robust_px=1.0)
    return growing


def rays_of(observations: Observations, camera: Scene) -> Array:
    """Normalised coordinates (O, 2) without distortion of all observations."""
    x = (observations.pixel[:, 0] - camera.principal_u) / camera.focal_px
    y = (observations.pixel[:, 1] - camera.principal_v) / camera.focal_px
    return np.stack(undistort_rays(x, y, camera.radial_k1, camera.radial_shape * camera.radial_k1**2), axis=1)


def settle(
    growing: Grown, observations: Observations, calibration: Calibration, iterations: int, robust_px: float
) -> Grown:
    """Triangulate everything that the registered frames see, and adjust; the focal length too where they turn."""
    scene, seen = retriangulate(growing.scene, observations, growing.registered, robust_px, 6.0 * robust_px)
    if len(seen.frame) == 0:
        return growing
    turns = growing.registered.sum() > 3 and not bundle.looks_one_way(scene.rotations[growing.registered])
    follows = replace(calibration, free=(calibration.free[0] and bool(turns), False, False, False))
    fixed = int(np.argmax(growing.registered))
    adjusted = bundle.adjust(scene, seen, follows, robust_px, 1.0, iterations, 1e-4, fixed)
    return Grown(adjusted.scene, growing.registered)


def retriangulate(
    scene: Scene, observations: Observations, registered: Mask, robust_px: float, gate_px: float
) -> tuple[Scene, Observations]:
    """New points for the scene's cameras, and the observations in registered frames that fit them."""
    seen = observations.subset(registered[observations.frame])
    points, valid = triangulate(
        scene.rotations,
        scene.translations,
        rays_of(seen, scene),
        seen.start,
        seen.frame,
        robust_px / scene.focal_px,
    )
    scene = replace(scene, points=points)
    fits = valid[seen.point] & (np.linalg.norm(bundle.residuals(scene, seen), axis=1) < gate_px)
    often = np.bincount(seen.point[fits], minlength=len(points)) >= 2
    return scene, seen.subset(fits & often[seen.point])


def _shared(observations: Observations, a: int, b: int) -> tuple[Index, Index]:
    """Rows of the observations of the points that both frames see."""
    in_a, in_b = np.flatnonzero(observations.frame == a), np.flatnonzero(observations.frame == b)
    point = observations.point
    _, at_a, at_b = np.intersect1d(point[in_a], point[in_b], assume_unique=True, return_indices=True)
    return in_a[at_a], in_b[at_b]


def _pair(observations: Observations, rays: Array, a: int, focal_px: float) -> _Pair | None:
    rows_a, rows_b = _shared(observations, a, a + 1)
    if len(rows_a) < _MIN_PAIR_POINTS:
        return None
    rays_a, rays_b = rays[rows_a], rays[rows_b]
    cv2.setRNGSeed(0)  # the generator is the library's own and remembers earlier calls
    threshold = _EPIPOLAR_PX / focal_px
    try:
        essential, mask = cv2.findEssentialMat(
            rays_a, rays_b, np.eye(3), method=cv2.USAC_ACCURATE, prob=0.999, threshold=threshold
        )
    except cv2.error:  # its local optimisation can end without a model, which it then asserts on
        essential, mask = cv2.findEssentialMat(
            rays_a, rays_b, np.eye(3), method=cv2.RANSAC, prob=0.999, threshold=threshold
        )
    if essential is None or essential.shape != (3, 3):
        return None
    agreeing = mask.ravel() > 0
    parts = cv2.decomposeEssentialMat(essential)
    first, second, translation = (np.asarray(part, dtype=np.float64) for part in parts)
    best: tuple[int, Array, Mask] | None = None
    for rotation in (first, second):
        for direction in (translation.ravel(), -translation.ravel()):
            depth_a, depth_b = two_view_depths(rays_a, rays_b, rotation, direction)
            front = agreeing & (depth_a > 0.0) & (depth_b > 0.0)
            if best is None or front.sum() > best[0]:
                best = (int(front.sum()), se3.make(rotation, direction), front)
    if best is None or best[0] < _MIN_RESECTION_INLIERS:
        return None
    moved = rotation_residual(rays_a[best[2]], rays_b[best[2]], best[1][:3, :3]) * focal_px
    return _Pair(best[1], best[0], best[0] * float(np.clip(np.median(moved), 0.1, 20.0)))


def rotation_residual(rays_a: Array, rays_b: Array, b_from_a: Array) -> Array:
    """What a rotation alone leaves unexplained (N,), in normalised coordinates: the parallax."""
    turned = np.column_stack([rays_a, np.ones(len(rays_a))]) @ b_from_a.T
    depth = np.maximum(turned[:, 2:], 1e-3)
    return np.asarray(np.linalg.norm(turned[:, :2] / depth - rays_b, axis=1))


def two_view_depths(rays_a: Array, rays_b: Array, rotation: Array, translation: Array) -> tuple[Array, Array]:
    """Depths along the optical axes of both views (N,), by least squares over the two rays."""
    ray_a = np.column_stack([rays_a, np.ones(len(rays_a))]) @ rotation.T
    ray_b = np.column_stack([rays_b, np.ones(len(rays_b))])
    aa, bb, ab = (ray_a * ray_a).sum(axis=1), (ray_b * ray_b).sum(axis=1), (ray_a * ray_b).sum(axis=1)
    at, bt = ray_a @ translation, ray_b @ translation
    determinant = np.maximum(aa * bb - ab * ab, 1e-15)
    return (ab * bt - bb * at) / determinant, (aa * bt - ab * at) / determinant


def _best_seed(observations: Observations, pairs: dict[int, _Pair], frame_count: int, camera: Scene) -> Grown | None:
    """The neighbours that start best: three where possible, judged by how many of their observations fit."""

    def started(a: int) -> tuple[float, Grown]:
        rotations, translations = np.tile(np.eye(3), (frame_count, 1, 1)), np.zeros((frame_count, 3))
        rotations[a + 1], translations[a + 1] = pairs[a].b_from_a[:3, :3], pairs[a].b_from_a[:3, 3]
        registered = np.zeros(frame_count, dtype=np.bool_)
        registered[[a, a + 1]] = True
        scene = replace(camera, rotations=rotations, translations=translations, points=np.zeros((0, 3)))
        growing = settle(Grown(scene, registered), observations, _HELD, iterations=10, robust_px=1.0)
        for _ in range(2):
            placed = _place_next(growing, observations, pairs)
            if placed is not None:
                growing = settle(placed, observations, _HELD, iterations=10, robust_px=1.0)
        among = observations.subset(growing.registered[observations.frame])
        repeated = among.subset((np.diff(among.start) >= min(3, int(growing.registered.sum())))[among.point])
        errors = np.linalg.norm(bundle.residuals(growing.scene, repeated), axis=1)
        return float((1.0 / (1.0 + errors**2)).sum()) * int(growing.registered.sum()), growing

    candidates = sorted(pairs, key=lambda key: -pairs[key].score)[:_SEED_CANDIDATES]
    return max(parallel.each(started, candidates), key=lambda start: start[0], default=(0.0, None))[1]


def _place_next(growing: Grown, observations: Observations, pairs: dict[int, _Pair]) -> Grown | None:
    """Register the neighbouring frame that sees most of the known points; None where none can be placed."""
    scene, registered = growing.scene, growing.registered
    rays = rays_of(observations, scene)
    known = _known_points(growing, observations)
    candidates = []
    for frame in range(len(registered)):
        near = [other for other in (frame - 1, frame + 1) if 0 <= other < len(registered) and registered[other]]
        if not registered[frame] and near:
            rows = np.flatnonzero(observations.frame == frame)
            rows = rows[known[observations.point[rows]]]
            if len(rows) >= _MIN_RESECTION_POINTS:
                candidates.append((len(rows), frame, near[0], rows))
    for _, frame, neighbour, rows in sorted(candidates, key=lambda entry: (-entry[0], entry[1])):
        points, pixels = scene.points[observations.point[rows]], observations.pixel[rows]
        placings = [
            refine_pose(rotation, translation, points, pixels, scene.shared, widths)
            for rotation, translation in _guesses(growing, pairs, frame, neighbour, rays[rows], points)
            for widths in (WIDE_TO_NARROW, _NARROW)
        ]
        more = registered.copy()
        more[frame] = True
        placed = []
        for _, rotation, translation in _distinct(placings):
            rotations, translations = scene.rotations.copy(), scene.translations.copy()
            rotations[frame], translations[frame] = rotation, translation
            moved = replace(scene, rotations=rotations, translations=translations)
            only = observations.subset(np.isin(np.arange(len(observations.frame)), rows))
            if (np.linalg.norm(bundle.residuals(moved, only), axis=1) < _INLIER_PX).sum() >= _MIN_RESECTION_INLIERS:
                placed.append(Grown(moved, more))
        if len(placed) == 1:
            scene, _ = retriangulate(placed[0].scene, observations, more, 1.0, 6.0)
            return Grown(scene, more)
        if placed:
            # points that few frames have seen give way to a wrong pose: let all of them have their say
            settled = [settle(one, observations, _HELD, iterations=8, robust_px=1.0) for one in placed]
            return min(settled, key=lambda one: _misfit(one, observations))
    return None


def _distinct(placings: list[tuple[float, Array, Array]]) -> list[tuple[float, Array, Array]]:
    """Refined poses that differ in rotation, best first; those that fit far worse than the best are left out."""
    kept: list[tuple[float, Array, Array]] = []
    for placing in sorted(placings, key=lambda entry: entry[0]):
        if kept and placing[0] > _MAX_COST_RATIO * kept[0][0]:
            break
        if all(np.trace(placing[1].T @ other[1]) < _SAME_ROTATION_TRACE for other in kept):
            kept.append(placing)
    return kept


def _misfit(growing: Grown, observations: Observations) -> float:
    """Mean capped square error of all that the registered frames see."""
    seen = observations.subset(growing.registered[observations.frame])
    errors = np.linalg.norm(bundle.residuals(growing.scene, seen), axis=1)
    return float((np.minimum(errors, _CAPPED_PX) ** 2).mean())


def _known_points(growing: Grown, observations: Observations) -> Mask:
    """Points (P,) that at least two registered frames see where they are."""
    if len(growing.scene.points) == 0:
        return np.zeros(len(observations.start) - 1, dtype=np.bool_)
    seen = observations.subset(growing.registered[observations.frame])
    fits = np.linalg.norm(bundle.residuals(growing.scene, seen), axis=1) < _INLIER_PX
    return np.asarray(np.bincount(seen.point[fits], minlength=len(seen.start) - 1) >= 2)


def _guesses(
    growing: Grown, pairs: dict[int, _Pair], frame: int, neighbour: int, rays: Array, points: Array
) -> list[tuple[Array, Array]]:
    """Start values for a frame's pose: the motion goes on as before, or as the two-view geometry says."""
    scene = growing.scene
    previous = se3.make(scene.rotations[neighbour], scene.translations[neighbour])
    guesses = [previous]
    beyond = 2 * neighbour - frame
    if 0 <= beyond < len(growing.registered) and growing.registered[beyond]:
        step = previous @ se3.inverse(se3.make(scene.rotations[beyond], scene.translations[beyond]))
        guesses.append(step @ previous)
    pair = pairs.get(min(frame, neighbour))
    if pair is not None:
        step = pair.b_from_a if frame > neighbour else se3.inverse(pair.b_from_a)
        turned = se3.make(step[:3, :3] @ previous[:3, :3], step[:3, :3] @ previous[:3, 3])
        guesses.append(turned)
        length = _step_length(turned, step[:3, 3], rays, points)
        if length is not None:
            guesses.append(se3.make(turned[:3, :3], turned[:3, 3] + length * step[:3, 3]))
    return [(guess[:3, :3].copy(), guess[:3, 3].copy()) for guess in guesses]


def _step_length(turned: Array, direction: Array, rays: Array, points: Array) -> float | None:
    """Length of the step that best brings known points onto their rays (median over the points)."""
    moved = se3.act(turned, points)
    ray = np.column_stack([rays, np.ones(len(rays))])
    across = np.cross(ray, direction)
    square = (across * across).sum(axis=1)
    useful = square > 1e-8
    if useful.sum() < 5:
        return None
    lengths = -(across[useful] * np.cross(ray[useful], moved[useful])).sum(axis=1) / square[useful]
    return float(np.median(lengths))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def refine_pose(rotation, translation, points, pixels, shared, widths):  # type: ignore[no-untyped-def]
    """Pose of one camera from known points, by iteratively re-weighted Gauss-Newton, a Cauchy kernel per iteration.

    Returns the robust cost at the last width, the rotation (3, 3) and the translation (3,).
    """
    focal, k1, shape = np.exp(shared[0]), shared[1], shared[4]
    r, t = rotation.copy(), translation.copy()
    cost = 0.0
    for iteration in range(len(widths) + 1):
        width = widths[min(iteration, len(widths) - 1)] ** 2
        h = np.zeros((6, 6))
        g = np.zeros(6)
        cost = 0.0
        j = np.zeros((2, 6))
        for p in range(len(points)):
            rx = r[0, 0] * points[p, 0] + r[0, 1] * points[p, 1] + r[0, 2] * points[p, 2]
            ry = r[1, 0] * points[p, 0] + r[1, 1] * points[p, 1] + r[1, 2] * points[p, 2]
            rz = r[2, 0] * points[p, 0] + r[2, 1] * points[p, 1] + r[2, 2] * points[p, 2]
            z = rz + t[2]
            if z <= 1e-6:
                cost += width * np.log(1.0 + 2500.0 / width)
                continue
            a, b = (rx + t[0]) / z, (ry + t[1]) / z
            bent = k1 * (a * a + b * b)
            radial = 1.0 + bent + shape * bent * bent
            by_square = 2.0 * focal * k1 * (1.0 + 2.0 * shape * bent)
            du = focal * radial * a + shared[2] - pixels[p, 0]
            dv = focal * radial * b + shared[3] - pixels[p, 1]
            e = du * du + dv * dv
            weight = 1.0 / (1.0 + e / width)
            cost += width * np.log(1.0 + e / width)
            aa, ab, bb = focal * radial + by_square * a * a, by_square * a * b, focal * radial + by_square * b * b
            j[0, 3], j[0, 4], j[0, 5] = aa / z, ab / z, -(aa * a + ab * b) / z
            j[1, 3], j[1, 4], j[1, 5] = ab / z, bb / z, -(ab * a + bb * b) / z
            for i in range(2):
                j[i, 0] = j[i, 5] * ry - j[i, 4] * rz
                j[i, 1] = j[i, 3] * rz - j[i, 5] * rx
                j[i, 2] = j[i, 4] * rx - j[i, 3] * ry
            for m in range(6):
                g[m] += weight * (j[0, m] * du + j[1, m] * dv)
                for n in range(6):
                    h[m, n] += weight * (j[0, m] * j[0, n] + j[1, m] * j[1, n])
        if iteration == len(widths):
            break
        for m in range(6):
            h[m, m] += 1e-6 * h[m, m] + 1e-12
        solvable, step = bundle.solve_positive(h, -g)
        if not solvable:
            break
        turn = bundle.rotation_of(step[0], step[1], step[2])
        turned = np.zeros((3, 3))
        for m in range(3):
            for n in range(3):
                turned[m, n] = turn[m, 0] * r[0, n] + turn[m, 1] * r[1, n] + turn[m, 2] * r[2, n]
            t[m] += step[3 + m]
        r = turned
    return cost, r, t
