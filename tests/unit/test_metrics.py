"""Metrics against evo, and KITTI's relative errors against closed forms."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync as evo_sync
from evo.core.trajectory import PoseTrajectory3D

from vggt_motion.errors import InputError
from vggt_motion.evaluation import metrics, trajectory_io
from vggt_motion.geometry import se3, sim3
from vggt_motion.geometry.track import PoseTrack


def walk(seed: int, count: int = 120) -> PoseTrack:
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se3.exp(np.concatenate([rng.normal(0, 0.03, 3), rng.normal([0.1, 0, 1.5], 0.2)])))
    return PoseTrack(np.arange(count) * 100_000_000, np.array(poses))


def disturbed(reference: PoseTrack, seed: int) -> PoseTrack:
    """Noise on every pose, and another world in another scale."""
    rng = np.random.default_rng(seed)
    noisy = np.array([p @ se3.exp(rng.normal(0, [0.01] * 3 + [0.2] * 3)) for p in reference.world_from_camera])
    world = sim3.exp(rng.normal(0, [0.3, 0.3, 0.3, 10, 10, 10, 0.3]))
    return metrics.apply(world, PoseTrack(reference.times_ns, noisy))


def evo_of(track: PoseTrack) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(track.world_from_camera), timestamps=track.times_ns / 1e9)


TRACKS = [walk(seed) for seed in range(4)]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("alignment", ["sim3", "se3", "scale", "none"])
def test_ate_against_evo(seed: int, alignment: metrics.Alignment) -> None:
    reference = TRACKS[seed]
    estimate = disturbed(reference, seed)
    theirs_reference, theirs = evo_of(reference), evo_of(estimate)
    if alignment != "none":
        theirs.align(theirs_reference, correct_scale=alignment == "sim3", correct_only_scale=alignment == "scale")
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data((theirs_reference, theirs))
    expected = ape.get_all_statistics()
    ours = metrics.absolute_error(reference, estimate, alignment)
    for name in ("rmse", "mean", "median", "std", "min", "max"):
        assert getattr(ours.position_m, name) == pytest.approx(expected[name], rel=1e-6, abs=1e-6), name
    length = theirs_reference.path_length
    assert ours.drift_ate_percent == pytest.approx(100 * expected["rmse"] / length, rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("delta", [1, 10])
def test_rpe_against_evo(seed: int, delta: int) -> None:
    reference = TRACKS[seed]
    estimate = disturbed(reference, seed)
    ours = metrics.relative_error(reference, estimate, delta)
    for relation, statistics in (
        (evo_metrics.PoseRelation.translation_part, ours.translation_m),
        (evo_metrics.PoseRelation.rotation_angle_deg, ours.rotation_deg),
    ):
        rpe = evo_metrics.RPE(relation, delta=delta, delta_unit=evo_metrics.Unit.frames, all_pairs=True)
        rpe.process_data((evo_of(reference), evo_of(estimate)))
        expected = rpe.get_all_statistics()
        for name in ("rmse", "mean", "median", "std", "min", "max"):
            assert getattr(statistics, name) == pytest.approx(expected[name], rel=1e-6, abs=1e-6), name


@pytest.mark.data
@pytest.mark.parametrize("name", ["05", "07", "09"])
def test_real_roads_against_evo(data_dir: Path, name: str) -> None:
    reference = trajectory_io.read_kitti(data_dir / "kitti_trajectories" / f"{name}.txt")
    estimate = disturbed(reference, int(name))
    theirs_reference, theirs = evo_of(reference), copy.deepcopy(evo_of(estimate))
    theirs.align(theirs_reference, correct_scale=True)
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data((theirs_reference, theirs))
    ours = metrics.absolute_error(reference, estimate, "sim3")
    assert ours.position_m.rmse == pytest.approx(ape.get_all_statistics()["rmse"], abs=1e-6)
    assert reference.path_length() == pytest.approx(theirs_reference.path_length, abs=1e-6)


def test_association_against_evo() -> None:
    reference = walk(9)
    estimate = walk(9).subset(np.arange(3, 110, 4))
    estimate = PoseTrack(estimate.times_ns + 4_000_000, estimate.world_from_camera)
    in_reference, in_estimate = metrics.associate(reference, estimate, 0.01)
    a, b = evo_sync.associate_trajectories(evo_of(reference), evo_of(estimate), max_diff=0.01)
    np.testing.assert_allclose(reference.times_ns[in_reference] / 1e9, a.timestamps)
    np.testing.assert_allclose(estimate.times_ns[in_estimate] / 1e9, b.timestamps)


def test_association_is_one_to_one_and_bounded() -> None:
    reference = walk(1, 5)
    times = np.array([0, 4_000_000, 99_000_000, 150_000_000, 399_000_000])
    in_reference, in_estimate = metrics.associate(reference, PoseTrack(times, walk(2, 5).world_from_camera))
    assert in_reference.tolist() == [0, 1, 4] and in_estimate.tolist() == [0, 2, 4]
    with pytest.raises(InputError, match="no pose"):
        metrics.associate(reference, PoseTrack(times + 10**12, walk(2, 5).world_from_camera))


def straight(count: int = 1000, yaw_per_step: float = 0.0, step: float = 1.0) -> PoseTrack:
    poses = [np.eye(4)]
    motion = se3.make(se3.so3_exp(np.array([0.0, yaw_per_step, 0.0])), np.array([0.0, 0.0, step]))
    for _ in range(count - 1):
        poses.append(poses[-1] @ motion)
    return PoseTrack(np.arange(count) * 100_000_000, np.array(poses))


def test_kitti_error_of_a_wrong_scale_is_that_scale() -> None:
    # the devkit ends a sub-sequence at the first frame past the length: 101 m for 100 m, hence the 1 m in the
    # expectation
    result = metrics.kitti_error(straight(), straight(step=1.02))
    lengths = [
        length for start in range(0, 1000, 10) for length in metrics.KITTI_LENGTHS_M if start + length + 1 < 1000
    ]
    expected = np.mean([2.0 * (length + 1) / length for length in lengths])
    assert result.sequence_count == len(lengths)
    assert result.t_rel_percent == pytest.approx(expected, rel=1e-6)
    assert result.r_rel_deg_per_100m == pytest.approx(0.0, abs=1e-9)


def test_kitti_error_of_a_constant_yaw_drift() -> None:
    yaw = np.radians(0.01)
    result = metrics.kitti_error(straight(), straight(yaw_per_step=yaw))
    assert result.r_rel_deg_per_100m == pytest.approx(1.0, rel=0.02)


def test_a_short_drive_has_no_kitti_error() -> None:
    result = metrics.kitti_error(straight(60), straight(60))
    assert np.isnan(result.t_rel_percent) and result.sequence_count == 0


def test_evaluate_puts_it_together() -> None:
    reference = walk(3, 400)
    estimate = disturbed(reference, 3).subset(np.arange(0, 400, 2))
    result = metrics.evaluate(reference, estimate)
    assert (result.matched_count, result.estimate_count) == (200, 200)
    assert result.ate_sim3.position_m.rmse < result.ate_se3.position_m.rmse
    assert result.kitti.sequence_count > 0 and result.rpe.delta_frames == 1
    exact = metrics.evaluate(reference, metrics.apply(sim3.exp(np.full(7, 0.4)), reference))
    assert exact.ate_sim3.position_m.max < 1e-9 and exact.kitti.t_rel_percent < 1e-9


def test_degenerate_tracks_have_an_error_not_an_exception() -> None:
    line, still = straight(50), PoseTrack(np.arange(50) * 100_000_000, np.tile(np.eye(4), (50, 1, 1)))
    assert metrics.evaluate(line, straight(50, step=2.0)).ate_sim3.position_m.rmse == pytest.approx(0.0, abs=1e-9)
    spread = np.arange(50) - 24.5
    assert metrics.evaluate(line, still).ate_sim3.position_m.rmse == pytest.approx(np.sqrt(np.mean(spread**2)))
    assert np.isnan(metrics.evaluate(still, still).ate_sim3.drift_ate_percent)
    with pytest.raises(InputError):
        metrics.evaluate(line, still.subset(np.array([0])))
