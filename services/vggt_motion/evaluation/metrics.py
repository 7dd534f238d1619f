"""Trajectory errors against ground truth: ATE, drift, KITTI's relative errors, RPE.

The definitions are those of the TUM benchmark (Sturm et al., IROS 2012) and of KITTI's odometry devkit (Geiger et
al., CVPR 2012); evo computes the same ATE and RPE, which the tests check.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from vggt_motion.errors import InputError, RegistrationError
from vggt_motion.geometry import umeyama
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.geometry.track import PoseTrack

Array = npt.NDArray[np.float64]
Alignment = Literal["sim3", "se3", "scale", "none"]

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
_KITTI_STEP_FRAMES = 10
_NS = 1e9


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of an error over the frames or pairs; the unit is that of the field that holds them."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    count: int

    @staticmethod
    def of(errors: Array) -> ErrorStatistics:
        """Of errors (N,), N > 0."""
        return ErrorStatistics(
            float(np.sqrt(np.mean(errors**2))),
            float(errors.mean()),
            float(np.median(errors)),
            float(errors.std()),
            float(errors.min()),
            float(errors.max()),
            len(errors),
        )


@dataclass(frozen=True)
class AbsoluteError:
    """Absolute trajectory error after one alignment."""

    alignment: Alignment
    position_m: ErrorStatistics
    drift_ate_percent: float  # RMSE over the length of the reference, what the paper prints as drift
    reference_from_estimate: Sim3


@dataclass(frozen=True)
class RelativeError:
    """Relative pose error over pairs of a fixed distance in frames."""

    delta_frames: int
    translation_m: ErrorStatistics
    rotation_deg: ErrorStatistics


@dataclass(frozen=True)
class KittiError:
    """KITTI's relative errors, averaged over all sub-sequences of 100 to 800 m; NaN where the drive is shorter."""

    t_rel_percent: float
    r_rel_deg_per_100m: float
    sequence_count: int


@dataclass(frozen=True)
class TrajectoryMetrics:
    """Everything that is reported of one estimate."""

    matched_count: int
    estimate_count: int
    reference_length_m: float  # through the matched poses
    ate_sim3: AbsoluteError
    ate_se3: AbsoluteError
    ate_scale: AbsoluteError
    kitti: KittiError  # after Sim(3) alignment
    rpe: RelativeError  # after Sim(3) alignment, between successive matched poses


def associate(
    reference: PoseTrack, estimate: PoseTrack, max_difference_s: float = 0.01
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Match poses by time, one to one.

    Each estimated pose takes the nearest reference pose in time; where two want the same one, the nearer gets it.

    Returns:
        Indices into the reference and into the estimate, both (M,), in order of reference time.

    Raises:
        InputError: nothing matches.
    """
    order = np.argsort(reference.times_ns, kind="stable")
    times = reference.times_ns[order]
    if len(times) == 0 or len(estimate) == 0:
        raise InputError("a trajectory without poses has nothing to compare")
    right = np.searchsorted(times, estimate.times_ns).clip(0, len(times) - 1)
    left = (right - 1).clip(0)
    nearest = np.where(np.abs(times[left] - estimate.times_ns) <= np.abs(times[right] - estimate.times_ns), left, right)
    difference = np.abs(times[nearest] - estimate.times_ns)
    candidates = np.flatnonzero(difference <= max_difference_s * _NS)
    best: dict[int, int] = {}
    for index in candidates.tolist():
        rival = best.get(int(nearest[index]))
        if rival is None or difference[index] < difference[rival]:
            best[int(nearest[index])] = index
    if not best:
        raise InputError(f"no pose of the estimate is within {max_difference_s:g} s of one of the reference")
    places = np.array(sorted(best), dtype=np.intp)
    return order[places], np.array([best[place] for place in places.tolist()], dtype=np.intp)


def align(reference: PoseTrack, estimate: PoseTrack, alignment: Alignment) -> Sim3:
    """``reference_from_estimate`` of matched tracks, by their positions.

    ``scale`` corrects the scale alone, about the origin; where the positions coincide, so that there is no scale, it
    is 1.
    """
    if alignment == "none":
        return Sim3.identity()
    source, target = estimate.positions, reference.positions
    of = umeyama.moments(source, target, np.ones(len(source)))
    try:
        solution = umeyama.solve(of, "fixed" if alignment == "se3" else "least_squares", allow_line=True)
    except RegistrationError:
        solution = Sim3(np.eye(3), of.mean_target - of.mean_source, 1.0)
    return Sim3(scale=solution.scale) if alignment == "scale" else solution


def apply(reference_from_estimate: Sim3, estimate: PoseTrack) -> PoseTrack:
    """The estimate in the frame of the reference."""
    poses = estimate.world_from_camera.copy()
    poses[:, :3, :3] = reference_from_estimate.rotation @ poses[:, :3, :3]
    poses[:, :3, 3] = reference_from_estimate.act(estimate.positions)
    return PoseTrack(estimate.times_ns, poses)


def absolute_error(reference: PoseTrack, estimate: PoseTrack, alignment: Alignment = "sim3") -> AbsoluteError:
    """ATE of matched tracks: distance between positions after alignment."""
    transform = align(reference, estimate, alignment)
    errors = np.linalg.norm(transform.act(estimate.positions) - reference.positions, axis=1)
    statistics = ErrorStatistics.of(errors)
    length = reference.path_length()
    drift = 100.0 * statistics.rmse / length if length > 0.0 else float("nan")
    return AbsoluteError(alignment, statistics, drift, transform)


def relative_error(reference: PoseTrack, estimate: PoseTrack, delta_frames: int = 1) -> RelativeError:
    """RPE of matched tracks over all pairs ``(n, n + delta_frames)``.

    Raises:
        InputError: there is no such pair.
    """
    if len(reference) <= delta_frames or delta_frames < 1:
        raise InputError(f"{len(reference)} matched poses have no pair that is {delta_frames} frames apart")
    starts = np.arange(len(reference) - delta_frames)
    error = _pair_errors(reference, estimate, starts, starts + delta_frames)
    translation, rotation = np.linalg.norm(error[:, :3, 3], axis=1), np.degrees(_angles(error))
    return RelativeError(delta_frames, ErrorStatistics.of(translation), ErrorStatistics.of(rotation))


def kitti_error(reference: PoseTrack, estimate: PoseTrack, lengths_m: Sequence[float] = KITTI_LENGTHS_M) -> KittiError:
    """KITTI's t_rel and r_rel of matched tracks that are in one scale already (align first).

    As in the devkit: sub-sequences begin at every tenth frame and end at the first frame past the length on the
    reference; their errors are divided by the length and averaged over all lengths together.
    """
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(reference.positions, axis=0), axis=1))])
    first, last, length = [], [], []
    for start in range(0, len(reference), _KITTI_STEP_FRAMES):
        for wanted in lengths_m:
            end = int(np.searchsorted(travelled, travelled[start] + wanted, side="right"))
            if end < len(reference):
                first.append(start)
                last.append(end)
                length.append(wanted)
    if not first:
        return KittiError(float("nan"), float("nan"), 0)
    error = _pair_errors(reference, estimate, np.array(first), np.array(last))
    lengths = np.array(length)
    return KittiError(
        float(np.mean(100.0 * np.linalg.norm(error[:, :3, 3], axis=1) / lengths)),
        float(np.mean(100.0 * np.degrees(_angles(error)) / lengths)),
        len(lengths),
    )


def evaluate(reference: PoseTrack, estimate: PoseTrack, max_difference_s: float = 0.01) -> TrajectoryMetrics:
    """All metrics of an estimate, matched to the reference by time.

    Raises:
        InputError: fewer than two poses match.
    """
    in_reference, in_estimate = associate(reference, estimate, max_difference_s)
    if len(in_reference) < 2:
        raise InputError("only one pose of the estimate matches the reference in time")
    matched, other = reference.subset(in_reference), estimate.subset(in_estimate)
    sim3 = absolute_error(matched, other, "sim3")
    aligned = apply(sim3.reference_from_estimate, other)
    return TrajectoryMetrics(
        matched_count=len(matched),
        estimate_count=len(estimate),
        reference_length_m=matched.path_length(),
        ate_sim3=sim3,
        ate_se3=absolute_error(matched, other, "se3"),
        ate_scale=absolute_error(matched, other, "scale"),
        kitti=kitti_error(matched, aligned),
        rpe=relative_error(matched, aligned),
    )


def _pair_errors(
    reference: PoseTrack, estimate: PoseTrack, first: npt.NDArray[np.intp], last: npt.NDArray[np.intp]
) -> Array:
    """``inverse(reference motion) @ estimated motion`` (P, 4, 4) between the two poses of each pair."""
    if len(reference) != len(estimate):
        raise ValueError(f"tracks must be matched: {len(reference)} and {len(estimate)} poses")
    motion = _inverse(reference.world_from_camera[first]) @ reference.world_from_camera[last]
    estimated = _inverse(estimate.world_from_camera[first]) @ estimate.world_from_camera[last]
    return np.asarray(_inverse(motion) @ estimated, dtype=np.float64)


def _inverse(poses: Array) -> Array:
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    out[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    out[:, :3, 3] = -np.einsum("nij,nj->ni", out[:, :3, :3], poses[:, :3, 3])
    return out


def _angles(poses: Array) -> Array:
    """Rotation angles (P,) in radians; through sine and cosine, since the arc cosine alone loses small angles."""
    r = poses[:, :3, :3]
    axis = np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1)
    cosine = np.trace(r, axis1=1, axis2=2) - 1.0
    return np.asarray(np.arctan2(np.linalg.norm(axis, axis=1), cosine), dtype=np.float64)
