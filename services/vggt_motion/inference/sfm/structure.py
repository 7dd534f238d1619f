"""Camera poses, points and the camera itself of one submap, from its tracks.

The submap is grown frame by frame from several guesses of the focal length, each result is adjusted with the camera
free within its priors, and the one that explains most observations is kept: a mirrored or bent scene leaves many
unexplained.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vggt_motion.inference.sfm import bundle, growth
from vggt_motion.inference.sfm.bundle import Calibration, Observations, Scene
from vggt_motion.inference.sfm.tracks import Tracks

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

# Errors of tracks are alike in neighbouring frames and pixels (drift, moving things, distortion beyond one
# coefficient): they carry less information than their scatter of 0.2 px suggests. With this deviation the focal lengths
# of the evaluation drives lie within their stated uncertainty.
PIXEL_SIGMA = 1.0
_TYPICAL_FOCAL_OVER_WIDTH = 0.85
_TYPICAL_FOCAL_LOG_SIGMA = 0.5
_PRINCIPAL_SIGMA_OVER_WIDTH = 0.012
_K1_SIGMA = 0.03
_UNKNOWN_STARTS = (0.65, 1.1, 1.8)  # focal length / image width to grow from where nothing is known
_LAST_USUAL_START = 1.5  # longer focal lengths are tried only where the others explain little
_SURE_RELATIVE_SIGMA = 0.1  # a hint at least this sure is the only start
_REGROW_RELATIVE = 0.12  # a focal length that moved so far is grown from once more
_GOOD_EXPLAINED = 0.75  # share of observations that fit: no further start is tried
_K1_GAIN = 0.05  # relative decrease of the cost for which a radial coefficient is believed
_CAPPED_PX = 20.0
_STAGES = (
    (2.0, 12.0, 15, 1e-4),
    (1.0, 5.0, 20, 1e-5),
    (0.5, 2.5, 60, 1e-6),
)  # kernel px, gate px, iterations, tolerance


@dataclass(frozen=True)
class CameraPrior:
    """What is known about the camera before the submap is looked at."""

    focal_over_width: float | None = None
    relative_sigma: float = math.inf
    radial_k1: float = 0.0
    is_fixed: bool = False


@dataclass(frozen=True)
class Structure:
    """A solved submap; pixels are those of the working images, relative to the middle of the image."""

    positions: tuple[int, ...]  # the frames of ``scene``, positions in the submap
    registered: npt.NDArray[np.bool_]  # (F,)
    scene: Scene
    observations: Observations  # the ones that fit
    explained: float  # share of all observations that fit
    reprojection_px: float  # mean length of the residuals that fit
    median_parallax_deg: float
    focal_relative_sigma: float  # as this submap alone sees it; inf where held
    cost: float  # capped robust cost of all observations, to compare solutions of the same tracks by

    def camera_from_submap(self) -> dict[int, Array]:
        """Position of each registered frame -> (4, 4)."""
        poses = {}
        for index in np.flatnonzero(self.registered):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = self.scene.rotations[index], self.scene.translations[index]
            poses[self.positions[index]] = pose
        return poses


def solve(
    tracks: Tracks, positions: Sequence[int], width_px: int, height_px: int, prior: CameraPrior
) -> tuple[Structure | None, list[str]]:
    """Solve a submap.

    Returns:
        the best solution, None where there is none; and one line for each way that was tried.
    """
    centre = np.array([0.5 * (width_px - 1), 0.5 * (height_px - 1)])
    index = np.full(max(positions) + 1, -1)
    index[list(positions)] = np.arange(len(positions))
    observations = Observations.build(tracks.point, index[tracks.frame], tracks.pixel - centre, tracks.count)
    best: Structure | None = None
    attempts = []
    for start in _starts(prior):
        if best is not None and best.explained > _GOOD_EXPLAINED and (_is_sure(prior) or start > _LAST_USUAL_START):
            break
        solved = _from_start(observations, positions, width_px, prior, start)
        attempts.append(f"grown from focal {start:.2f} widths: {_outcome(solved, width_px)}")
        best = _better(best, solved)
        if solved is None or solved is not best or not _is_worth_regrowing(solved, start, width_px, prior):
            continue
        moved = solved.scene.focal_px / width_px
        again = _from_start(observations, positions, width_px, prior, moved)
        attempts.append(f"grown from focal {moved:.2f} widths: {_outcome(again, width_px)}")
        best = _better(best, again)
    if best is not None and not prior.is_fixed:
        distorted = _adjusted(observations, best.registered, positions, best.scene, width_px, prior, refine_k1=True)
        if distorted is not None and distorted.cost < (1.0 - _K1_GAIN) * best.cost:
            attempts.append(f"with a radial coefficient: {_outcome(distorted, width_px)}")
            best = distorted
    return (_in_unit_steps(best) if best is not None else None), attempts


def _is_worth_regrowing(solved: Structure, start: float, width_px: int, prior: CameraPrior) -> bool:
    """Whether the focal length moved so far in a turn that the scene may have kept a bend from its start."""
    if prior.is_fixed or bundle.looks_one_way(solved.scene.rotations[solved.registered]):
        return False
    return abs(math.log(solved.scene.focal_px / width_px / start)) > _REGROW_RELATIVE


def _in_unit_steps(solved: Structure) -> Structure:
    """The same structure in the unit of the median step between its keyframes, which suits half-precision depth."""
    scene = solved.scene
    centres = -np.einsum("fji,fj->fi", scene.rotations, scene.translations)[solved.registered]
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    unit = float(np.median(steps)) if len(steps) and np.median(steps) > 0.0 else 1.0
    return replace(solved, scene=replace(scene, translations=scene.translations / unit, points=scene.points / unit))


def _is_sure(prior: CameraPrior) -> bool:
    return prior.is_fixed or prior.relative_sigma < _SURE_RELATIVE_SIGMA


def _starts(prior: CameraPrior) -> Iterator[float]:
    known = prior.focal_over_width
    if known is None:
        yield from _UNKNOWN_STARTS
        return
    yield known
    if not prior.is_fixed:
        yield from sorted(_UNKNOWN_STARTS, key=lambda start: (start > _LAST_USUAL_START, -abs(math.log(start / known))))


def _better(best: Structure | None, other: Structure | None) -> Structure | None:
    if best is None or other is None:
        return best or other
    return min(best, other, key=lambda solved: solved.cost)


def _outcome(solved: Structure | None, width_px: int) -> str:
    if solved is None:
        return "no structure"
    return (
        f"{int(solved.registered.sum())} keyframes, {solved.explained:.0%} of the observations fit to "
        f"{solved.reprojection_px:.2f} px, focal {solved.scene.focal_px / width_px:.3f}"
    )


def _from_start(
    observations: Observations, positions: Sequence[int], width_px: int, prior: CameraPrior, focal_over_width: float
) -> Structure | None:
    nothing = np.zeros((0, 3))
    camera = Scene(np.zeros((0, 3, 3)), nothing, nothing, focal_over_width * width_px, prior.radial_k1)
    grown = growth.grow(observations, len(positions), camera)
    if grown is None:
        return None
    return _adjusted(observations, grown.registered, positions, grown.scene, width_px, prior, refine_k1=False)


def _adjusted(
    observations: Observations,
    registered: npt.NDArray[np.bool_],
    positions: Sequence[int],
    scene: Scene,
    width_px: int,
    prior: CameraPrior,
    refine_k1: bool,
) -> Structure | None:
    calibration = _calibration(prior, width_px, refine_k1)
    fixed = int(np.argmax(registered))
    fitting = observations
    for robust_px, gate_px, iterations, tolerance in _STAGES:
        rays = growth.rays_of(observations, scene)
        scene, fitting = growth.retriangulate(scene, observations, rays, registered, robust_px, gate_px)
        if len(fitting.frame) < 4 * registered.sum():
            return None
        scene = bundle.adjust(scene, fitting, calibration, robust_px, PIXEL_SIGMA, iterations, tolerance, fixed).scene
    residuals = np.linalg.norm(bundle.residuals(scene, fitting), axis=1)
    everything = np.linalg.norm(bundle.residuals(scene, observations), axis=1)
    information, _ = bundle.shared_information(scene, fitting, calibration, _STAGES[-1][0], fixed)
    return Structure(
        positions=tuple(positions),
        registered=registered,
        scene=scene,
        observations=fitting,
        explained=len(fitting.frame) / max(len(observations.frame), 1),
        reprojection_px=float(residuals.mean()),
        median_parallax_deg=_median_parallax_deg(scene, fitting),
        focal_relative_sigma=_focal_sigma(information, calibration),
        cost=float(np.log1p(np.minimum(everything, _CAPPED_PX) ** 2).sum()),
    )


def _calibration(prior: CameraPrior, width_px: int, refine_k1: bool) -> Calibration:
    principal = _PRINCIPAL_SIGMA_OVER_WIDTH * width_px
    focal = prior.focal_over_width if prior.focal_over_width is not None else _TYPICAL_FOCAL_OVER_WIDTH
    sigma = min(max(prior.relative_sigma, 1e-4), _TYPICAL_FOCAL_LOG_SIGMA)
    return Calibration(
        free=(not prior.is_fixed, refine_k1, not prior.is_fixed, not prior.is_fixed),
        mean=(math.log(focal * width_px), prior.radial_k1, 0.0, 0.0),
        sigma=(sigma, _K1_SIGMA, principal, principal),
    )


def _focal_sigma(information: Array, calibration: Calibration) -> float:
    """Standard deviation of log focal from the observations; the other shared unknowns have their priors."""
    free = np.flatnonzero(calibration.free)
    if 0 not in free:
        return math.inf
    priors = np.array([0.0, *(1.0 / sigma**2 for sigma in calibration.sigma[1:])])
    block = information[np.ix_(free, free)] / PIXEL_SIGMA**2 + np.diag(priors[free])
    if not np.isfinite(block).all():
        return math.inf
    others = block[1:, 1:]
    reduced = float(block[0, 0] - block[0, 1:] @ np.linalg.solve(others, block[1:, 0]))
    return 1.0 / math.sqrt(reduced) if reduced > 1e-12 else math.inf


def _median_parallax_deg(scene: Scene, observations: Observations) -> float:
    """Median over the points of the angle between the rays of the first and the last frame that see each."""
    start = observations.start
    seen = np.flatnonzero(np.diff(start) >= 2)
    if len(seen) == 0:
        return 0.0
    centres = -np.einsum("fji,fj->fi", scene.rotations, scene.translations)
    first, last = observations.frame[start[seen]], observations.frame[start[seen + 1] - 1]
    ray_a, ray_b = scene.points[seen] - centres[first], scene.points[seen] - centres[last]
    norms = np.linalg.norm(ray_a, axis=1) * np.linalg.norm(ray_b, axis=1)
    cosine = (ray_a * ray_b).sum(axis=1) / np.maximum(norms, 1e-12)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))
