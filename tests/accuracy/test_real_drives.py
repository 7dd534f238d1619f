"""The whole method in one process on real sequences, against their ground truth or what is known of the road."""

from __future__ import annotations

import functools
import itertools
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))  # the hard sequences are made there

import derived_sequences

from vggt_motion.config import Config
from vggt_motion.evaluation import metrics
from vggt_motion.evaluation.offline import OfflineRun, run_offline
from vggt_motion.evaluation.trajectory_io import read_kitti
from vggt_motion.geometry.track import PoseTrack

pytestmark = pytest.mark.data

Array = npt.NDArray[np.float64]


@functools.cache
def run_of(location: str) -> OfflineRun:
    return run_offline(location, Config())


def track_of(data_dir: Path, name: str) -> PoseTrack:
    """All frames of a sequence; none may be missing, and the chain may not break."""
    run = run_of(str(data_dir / name))
    graph = run.state.latest_graph()
    assert graph is not None
    assert graph.breaks == ()
    assert all(constraint.accepted for constraint in run.state.constraints.values())
    return run.trajectory.track("all")


@pytest.mark.parametrize(
    ("name", "ate_m"),
    [
        ("kitti_06_first51", 0.10),
        ("kitti_01_first51", 0.25),
        pytest.param("kitti_00_first200", 0.45, marks=pytest.mark.slow),
        pytest.param("redkitchen_first400", 0.05, marks=pytest.mark.slow),
    ],
)
def test_a_sequence_is_as_accurate_as_it_was(data_dir: Path, name: str, ate_m: float) -> None:
    track = track_of(data_dir, name)
    poses = read_kitti(data_dir / name / "poses.txt").world_from_camera
    assert len(track) == len(poses)
    outcome = metrics.evaluate(PoseTrack(track.times_ns, poses), track)
    assert outcome.ate_sim3.position_m.rmse < ate_m


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "ate_m"),
    [
        ("kitti_01 unrectified k1=-0.3", 0.20),
        ("kitti_01 through KITTI's own lens", 0.20),
        ("kitti_00 through KITTI's own lens", 0.50),
    ],
)
def test_turns_through_a_lens_that_nobody_rectified_are_as_accurate(
    data_dir: Path, tmp_path: Path, name: str, ate_m: float
) -> None:
    folder = derived_sequences.write(name, data_dir, tmp_path)
    track = track_of(folder.parent, folder.name)
    poses = read_kitti(folder / "poses.txt").world_from_camera
    assert len(track) == len(poses)
    assert metrics.evaluate(PoseTrack(track.times_ns, poses), track).ate_sim3.position_m.rmse < ate_m


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["kitti_06 behind a truck", "kitti_06, a truck for a while", "kitti_06 nearing a truck"]
)
def test_a_truck_that_fills_half_of_the_view_neither_breaks_nor_bends_the_drive(
    data_dir: Path, tmp_path: Path, name: str
) -> None:
    folder = derived_sequences.write(name, data_dir, tmp_path)
    track = track_of(folder.parent, folder.name)
    poses = read_kitti(folder / "poses.txt").world_from_camera
    assert len(track) == len(poses)
    assert metrics.evaluate(PoseTrack(track.times_ns, poses), track).ate_sim3.position_m.rmse < 0.25


def speeds_of(track: PoseTrack) -> tuple[Array, Array]:
    """Positions (N, 3) and speeds (N - 1,) in medians."""
    positions = track.world_from_camera[:, :3, 3]
    seconds = np.diff(np.asarray(track.times_ns)) / 1e9
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / seconds
    return positions, speeds / np.median(speeds)


@pytest.mark.slow
def test_a_straight_motorway_is_straight_and_driven_steadily(data_dir: Path) -> None:
    positions, speeds = speeds_of(track_of(data_dir, "video/highway_straight.mp4"))
    path = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    centred = positions - positions.mean(axis=0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    aside = np.linalg.norm(centred - np.outer(centred @ direction, direction), axis=1)
    assert aside.max() < 0.005 * path
    # a car on a motorway changes its speed by a few percent in nine seconds; a wrong scale of a submap shows as a jump
    assert speeds.min() > 0.9
    assert speeds.max() < 1.1
    assert np.abs(np.diff(speeds)).max() < 0.08


@pytest.mark.slow
def test_slowing_down_towards_lights_is_smooth(data_dir: Path) -> None:
    _, speeds = speeds_of(track_of(data_dir, "kitti_raw_road_91"))
    assert np.abs(np.diff(speeds)).max() < 0.15
    # the driver brakes late and steadily: a submap of a wrong scale would be a step in this
    by_second = [speeds[k : k + 10].mean() for k in range(0, len(speeds), 10)]
    assert by_second[0] > 0.95
    assert all(later < earlier + 0.05 for earlier, later in itertools.pairwise(by_second))
    assert by_second[-1] < 0.8
