"""Camera poses, points and the camera itself of one submap, from its tracks.

The submap is grown frame by frame from several guesses of the focal length, each result is adjusted with the camera
free within its priors, and the one that explains most observations is kept: a mirrored or bent scene leaves many
unexplained.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vggt_motion.inference.sfm import alignment, bundle, focal, globalmap, growth, parallel
from vggt_motion.inference.sfm.bundle import Calibration, Observations, Scene
from vggt_motion.inference.sfm.focal import CameraPrior
from vggt_motion.inference.sfm.images import GreyImage, WorkingImages
from vggt_motion.inference.sfm.tracks import Tracks

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

_REGROW_RELATIVE = 0.05  # a focal length that moved so far is grown from once more
# Share of observations that fit, alone or with how well they fit, for which no further start is tried: cars that drive
# along let a wrong scene explain four fifths of them, but badly.
_MOST_EXPLAINED = 0.88
_GOOD_EXPLAINED = 0.75
_GOOD_REPROJECTION_PX = 0.5
_SAME_COST = 0.02  # relative difference of the costs of starts that ended alike
_MAX_K1 = 0.6  # beyond it a coefficient describes the scene, not a lens
_UNRECTIFIED_GAIN = 0.05  # relative decrease of the cost for which strong distortion is believed
# Focal length over width and coefficient of many lenses that nobody rectified: where a scene that is grown as if they
# were rectified ends nowhere near, this does
_UNRECTIFIED_START = (0.85, -0.36)
_MAX_REGROWN = 3
# k2 as a multiple of k1 squared. With one coefficient alone a strong lens is not described, and the focal length makes
# up for it: through the lens of KITTI's raw recordings turns come out 10 to 15 degrees wrong, with this shape 1.
# Calibrated lenses have 0.5 to 1.5, fisheyes 1.8
_LENS_SHAPE = 1.0
_CAPPED_PX = 1.5  # an observation that misses by more belongs to something else, however far it misses
_MIN_FRAME_OBSERVATIONS = 15
# kernel px, gate px, iterations, tolerance
_STAGES = ((2.0, 12.0, 15, 1e-3), (1.0, 5.0, 15, 1e-3), (0.5, 2.5, 25, 1e-5))
_POLISH = ((0.5, 2.5, 15, 1e-5), (0.3, 1.5, 60, 1e-6))


@dataclass(frozen=True)
class Structure:
    """A solved submap; pixels are those of the working images, relative to the middle of the image."""

    positions: tuple[int, ...]  # the frames of ``scene``, positions in the submap
    width_px: int
    registered: npt.NDArray[np.bool_]  # (F,)
    scene: Scene
    observations: Observations  # the ones that fit
    explained: float  # share of all observations that fit
    reprojection_px: float  # mean length of the residuals that fit
    median_parallax_deg: float
    focal_relative_sigma: float  # as this submap alone sees it; inf where held
    cost: float  # capped robust cost of all observations, to compare solutions of the same tracks by
    weakest_share: float  # least share, over steps between frames, of the points followed over it that fit in both
    weakest_link: int  # least number, over steps, of points that carry the scale: seen on both sides, twice on one

    @property
    def focal_over_width(self) -> float:
        """Focal length divided by the image width."""
        return self.scene.focal_px / self.width_px

    def camera_from_submap(self) -> dict[int, Array]:
        """Position of each registered frame -> (4, 4)."""
        poses = {}
        for index in np.flatnonzero(self.registered):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = self.scene.rotations[index], self.scene.translations[index]
            poses[self.positions[index]] = pose
        return poses

    def share_that_fits(self, tracks: Tracks, points: npt.NDArray[np.bool_]) -> float:
        """Share of the observations of some points (count,) of the tracks it was solved from that fit.

        Only points that three frames see count: two agree with anything along their epipolar line.
        """
        often = points & (np.bincount(tracks.point, minlength=tracks.count) >= 3)
        seen = int(np.count_nonzero(often[tracks.point]))
        return int(np.count_nonzero(often[self.observations.point])) / seen if seen else 0.0


def solve(
    tracks: Tracks, positions: Sequence[int], working: WorkingImages, prior: CameraPrior
) -> tuple[Structure | None, list[str]]:
    """Solve a submap.

    Args:
        tracks: through the frames at ``positions``.
        positions: the frames in time order.
        working: the images, by position.
        prior: of the camera.

    Returns:
        the best solution, None where there is none; and one line for each way that was tried.
    """
    width_px = working.width_px
    observations = _observations(tracks, positions, working)
    calibration = prior.calibration(width_px)

    def grown(start: float) -> list[tuple[float, Structure | None]]:
        solved = _from_start(observations, positions, width_px, prior, calibration, start)
        if solved is None or not _is_worth_regrowing(solved, start, prior):
            return [(start, solved)]
        moved = solved.focal_over_width
        return [(start, solved), (moved, _from_start(observations, positions, width_px, prior, calibration, moved))]

    starts = list(prior.starts())
    # where the focal length is not sure, two starts are tried at least
    at_once = 1 if prior.is_sure else sum(is_usual for _, is_usual in starts[:2])
    ways = parallel.each(grown, [start for start, _ in starts[:at_once]])
    for start, is_usual in starts[at_once:]:
        best = _best(ways)
        if best is not None and ((_is_convincing(best) and (prior.is_sure or not is_usual)) or _is_settled(ways)):
            break
        ways.append(grown(start))
    best = _best(ways)
    attempts = [f"grown from focal {start:.2f} widths: {_outcome(solved)}" for way in ways for start, solved in way]
    if best is None:
        return None, attempts
    deviations = abs(best.scene.radial_k1 - prior.radial_k1) / calibration.sigma[1]
    # where the camera is known and its lens not contradicted, another lens is not worth its time
    if not prior.is_fixed and best.registered.sum() > 2 and (not prior.is_sure or deviations > 1.0):
        wide = prior.calibration(width_px, is_unrectified=True)
        distorted = _adjusted(observations, best.registered, positions, width_px, best.scene, wide)
        contradicted = deviations > 2.0
        needed = (1.0 - _UNRECTIFIED_GAIN) * best.cost
        # a turn that was grown without its distortion can end so far off that no lens shows: it then fits badly
        shows = distorted is not None and (contradicted or distorted.cost < needed)
        if distorted is not None and (shows or not (prior.is_sure or _is_convincing(best))):
            likely = [(distorted.focal_over_width, distorted.scene.radial_k1)] if shows else []
            found, more = _regrown(distorted, [*likely, _UNRECTIFIED_START], observations, positions, prior, wide)
            attempts.extend(more)
            if found is not None and (contradicted or found.cost < needed):
                best, calibration = found, wide
    polished = _polished(best, observations, [working.grey[p] for p in positions], working.usable, calibration)
    attempts.append(f"measured again: {_outcome(polished)}")
    return _in_unit_steps(polished), attempts


def solve_from(
    tracks: Tracks, positions: Sequence[int], working: WorkingImages, prior: CameraPrior, placed: globalmap.Placed
) -> tuple[Structure | None, str]:
    """Solve a submap from poses that another method found; also one line about the outcome."""
    observations = _observations(tracks, positions, working)
    registered = np.array([position in placed.camera_from_submap for position in positions])
    poses = np.stack([placed.camera_from_submap.get(position, np.eye(4)) for position in positions])
    nothing = np.zeros((0, 3))
    scene = Scene(
        poses[:, :3, :3].copy(),
        poses[:, :3, 3].copy(),
        nothing,
        placed.focal_px,
        prior.radial_k1,
        *prior.principal_px(working.width_px),
        radial_shape=prior.radial_shape,
    )
    calibration = prior.calibration(working.width_px)
    solved = _adjusted(observations, registered, positions, working.width_px, scene, calibration)
    if solved is not None:
        images = [working.grey[p] for p in positions]
        solved = _in_unit_steps(_polished(solved, observations, images, working.usable, calibration))
    return solved, _outcome(solved)


def _regrown(
    distorted: Structure,
    likely: Sequence[tuple[float, float]],
    observations: Observations,
    positions: Sequence[int],
    prior: CameraPrior,
    wide: Calibration,
) -> tuple[Structure | None, list[str]]:
    """The scene grown again through likely lenses (focal length over width, k1); None where the best is no lens.

    Also one line for each way that was tried.

    One that was grown as if the images were rectified is bent, most of all in a turn, and keeps its bend in any
    adjustment: lens and focal length then end where the bend is least, not where they are right.
    """

    def grown(camera: _Camera) -> Structure | None:
        k1 = float(np.clip(camera.radial_k1, -_MAX_K1, _MAX_K1))
        through = replace(prior, radial_k1=k1, radial_shape=camera.radial_shape)
        return _from_start(observations, positions, distorted.width_px, through, wide, camera.focal_over_width)

    attempts = [f"with strong distortion: {_outcome(distorted)}"]
    starts = [_Camera(*camera, shape) for shape in _shapes(prior) for camera in likely]
    best = distorted if distorted.scene.radial_shape in _shapes(prior) else None
    for _ in range(_MAX_REGROWN):
        ways = parallel.each(grown, starts)
        attempts.extend(f"grown from {start}: {_outcome(way)}" for start, way in zip(starts, ways, strict=True))
        better = min((way for way in ways if way is not None), key=_lens_cost, default=None)
        if better is None or (best is not None and _lens_cost(better) >= _lens_cost(best)):
            break
        is_settled = best is not None and _lens_cost(better) > (1.0 - _SAME_COST) * _lens_cost(best)
        best = better
        starts = [_Camera(best.focal_over_width, best.scene.radial_k1, best.scene.radial_shape)]
        if is_settled:
            break
    return (best if best is not None and abs(best.scene.radial_k1) < _MAX_K1 else None), attempts


@dataclass(frozen=True)
class _Camera:
    """A camera to grow from."""

    focal_over_width: float
    radial_k1: float
    radial_shape: float

    def __str__(self) -> str:
        return f"focal {self.focal_over_width:.2f} widths, distortion {self.radial_k1:+.2f} ({self.radial_shape:.1f})"


def _shapes(prior: CameraPrior) -> tuple[float, ...]:
    """Shapes of the distortion that are worth trying: that of the lens, once it is known."""
    is_known = abs(prior.radial_k1) > 2.0 * focal.K1_SIGMA
    return (prior.radial_shape,) if is_known else (_LENS_SHAPE, 0.0)


def _lens_cost(solved: Structure) -> float:
    """The cost, where another shape than that of lenses must explain clearly more: the focal length makes up for it."""
    return solved.cost * (1.0 if solved.scene.radial_shape > 0.5 * _LENS_SHAPE else 1.0 + _UNRECTIFIED_GAIN)


def _observations(tracks: Tracks, positions: Sequence[int], working: WorkingImages) -> Observations:
    """Observations by index of the frame, relative to the middle of the image."""
    centre = np.array([0.5 * (working.width_px - 1), 0.5 * (working.height_px - 1)])
    index = np.full(max(positions) + 1, -1)
    index[list(positions)] = np.arange(len(positions))
    return Observations.build(tracks.point, index[tracks.frame], tracks.pixel - centre, tracks.count)


def _polished(
    solved: Structure,
    observations: Observations,
    images: Sequence[GreyImage],
    usable: npt.NDArray[np.bool_],
    calibration: Calibration,
) -> Structure:
    """The structure on observations that were measured again where the scene says that they should be."""
    scene, fitting = solved.scene, solved.observations
    fixed = int(np.argmax(solved.registered))
    for robust_px, gate_px, iterations, tolerance in _POLISH:
        again = alignment.remeasure(scene, observations, fitting, solved.registered, images, usable)
        refined, fits = growth.retriangulate(scene, again, solved.registered, robust_px, gate_px)
        if np.bincount(fits.frame, minlength=len(solved.registered))[solved.registered].min() < _MIN_FRAME_OBSERVATIONS:
            break
        scene = bundle.adjust(
            refined, fits, calibration, robust_px, focal.PIXEL_SIGMA, iterations, tolerance, fixed
        ).scene
        fitting = fits
    return replace(
        _described(scene, fitting, observations, solved.registered, solved.positions, solved.width_px, calibration),
        explained=solved.explained,
        cost=solved.cost,
        weakest_share=solved.weakest_share,
        weakest_link=solved.weakest_link,
    )


def _is_convincing(solved: Structure) -> bool:
    """Whether no further start is worth its time."""
    if solved.explained > _MOST_EXPLAINED:
        return True
    return solved.explained > _GOOD_EXPLAINED and solved.reprojection_px < _GOOD_REPROJECTION_PX


def _is_worth_regrowing(solved: Structure, start: float, prior: CameraPrior) -> bool:
    """Whether the focal length moved so far in a turn that the scene may have kept a bend from its start."""
    if prior.is_fixed or bundle.looks_one_way(solved.scene.rotations[solved.registered]):
        return False
    moved = solved.focal_over_width
    return focal.is_plausible(moved) and abs(math.log(moved / start)) > _REGROW_RELATIVE


def _in_unit_steps(solved: Structure) -> Structure:
    """The same structure in the unit of the median step between its keyframes, which suits half-precision depth."""
    scene = solved.scene
    centres = -np.einsum("fji,fj->fi", scene.rotations, scene.translations)[solved.registered]
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    unit = float(np.median(steps)) if len(steps) and np.median(steps) > 0.0 else 1.0
    return replace(solved, scene=replace(scene, translations=scene.translations / unit, points=scene.points / unit))


def _best(ways: Sequence[Sequence[tuple[float, Structure | None]]]) -> Structure | None:
    return min((solved for way in ways for _, solved in way if solved is not None), key=_cost_of, default=None)


def _is_settled(ways: Sequence[Sequence[tuple[float, Structure | None]]]) -> bool:
    """Whether the two best of the starts ended alike: a further one would end there too."""
    ends = sorted((solved for way in ways if (solved := _best([way])) is not None), key=_cost_of)
    if len(ends) < 2:
        return False
    first, second = ends[:2]
    return bool((first.registered == second.registered).all()) and second.cost < (1.0 + _SAME_COST) * first.cost


def _cost_of(solved: Structure) -> float:
    return solved.cost


def _outcome(solved: Structure | None) -> str:
    if solved is None:
        return "no structure"
    return (
        f"{int(solved.registered.sum())} keyframes, {solved.explained:.0%} of the observations fit to "
        f"{solved.reprojection_px:.2f} px, focal {solved.focal_over_width:.3f}"
    )


def _from_start(
    observations: Observations,
    positions: Sequence[int],
    width_px: int,
    prior: CameraPrior,
    calibration: Calibration,
    focal_over_width: float,
) -> Structure | None:
    nothing = np.zeros((0, 3))
    camera = Scene(
        np.zeros((0, 3, 3)),
        nothing,
        nothing,
        focal_over_width * width_px,
        prior.radial_k1,
        *prior.principal_px(width_px),
        radial_shape=prior.radial_shape,
    )
    grown = growth.grow(observations, len(positions), camera, calibration)
    if grown is None:
        return None
    return _adjusted(observations, grown.registered, positions, width_px, grown.scene, calibration)


def _adjusted(
    observations: Observations,
    registered: npt.NDArray[np.bool_],
    positions: Sequence[int],
    width_px: int,
    scene: Scene,
    calibration: Calibration,
) -> Structure | None:
    fixed = int(np.argmax(registered))
    fitting = observations
    for robust_px, gate_px, iterations, tolerance in _STAGES:
        scene, fitting = growth.retriangulate(scene, observations, registered, robust_px, gate_px)
        if len(fitting.frame) < 4 * registered.sum():
            return None
        scene = bundle.adjust(
            scene, fitting, calibration, robust_px, focal.PIXEL_SIGMA, iterations, tolerance, fixed
        ).scene
    return _described(scene, fitting, observations, registered, tuple(positions), width_px, calibration)


def _described(
    scene: Scene,
    fitting: Observations,
    observations: Observations,
    registered: npt.NDArray[np.bool_],
    positions: tuple[int, ...],
    width_px: int,
    calibration: Calibration,
) -> Structure:
    residuals = np.linalg.norm(bundle.residuals(scene, fitting), axis=1)
    still = residuals < _STAGES[-1][1]
    if not still.all():
        fitting, residuals = fitting.subset(still), residuals[still]
    everything = np.linalg.norm(bundle.residuals(scene, observations), axis=1)
    information = bundle.shared_information(scene, fitting, calibration, _STAGES[-1][0], int(np.argmax(registered)))
    weakest_share, weakest_link = _weakest(fitting, observations, registered)
    return Structure(
        positions=positions,
        width_px=width_px,
        registered=registered,
        scene=scene,
        observations=fitting,
        explained=len(fitting.frame) / max(len(observations.frame), 1),
        reprojection_px=float(residuals.mean()) if len(residuals) else math.inf,
        median_parallax_deg=_median_parallax_deg(scene, fitting),
        focal_relative_sigma=focal.relative_sigma(information, calibration),
        cost=float((np.minimum(everything, _CAPPED_PX) ** 2).sum()),
        weakest_share=weakest_share,
        weakest_link=weakest_link,
    )


def _weakest(fitting: Observations, observations: Observations, registered: npt.NDArray[np.bool_]) -> tuple[float, int]:
    """The weakest step of the chain: see :class:`Structure`."""
    frames = np.flatnonzero(registered)
    count = len(fitting.start) - 1
    seen = np.zeros((2, len(registered), count), dtype=np.bool_)
    for row, some in enumerate((fitting, observations)):
        seen[row, some.frame, some.point] = True
    fits = np.cumsum(seen[0], axis=0)
    shares, links = [1.0], []
    for a, b in itertools.pairwise(frames):
        followed = int((seen[1, a] & seen[1, b]).sum())
        if followed > 0:
            shares.append(int((seen[0, a] & seen[0, b]).sum()) / followed)
        before, after = fits[a], fits[-1] - fits[a]
        carries = (before >= 1) & (after >= 1) & (before + after >= 3)
        links.append(int(carries.sum()))
    return min(shares), min(links) if links else 0


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
