"""Trajectory files: round trips, agreement with evo's readers, and malformed input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import given
from hypothesis import strategies as st

from vggt_motion.backend.trajectory import NO_COMPONENT, PoseOrigin, Trajectory, TrajectoryPose
from vggt_motion.errors import InputError
from vggt_motion.evaluation import trajectory_io
from vggt_motion.geometry import se3
from vggt_motion.geometry.track import PoseTrack
from vggt_motion.records import MotionState


def track(count: int = 20, seed: int = 0, start_ns: int = 1_700_000_000_123_456_789) -> PoseTrack:
    rng = np.random.default_rng(seed)
    poses = np.array([se3.make(se3.so3_exp(rng.normal(0, 1, 3)), rng.normal(0, 100, 3)) for _ in range(count)])
    return PoseTrack(start_ns + 33_333_333 * np.arange(count), poses)


def trajectory() -> Trajectory:
    source = track(5)
    frames = [
        TrajectoryPose("front", 1, n, int(t), MotionState.TURNING, n % 2 == 0, PoseOrigin.HOME, 3, pose)
        for n, (t, pose) in enumerate(zip(source.times_ns, source.world_from_camera, strict=True))
    ]
    frames[4] = replace(frames[4], origin=PoseOrigin.NONE, component=NO_COMPONENT, world_from_camera=None)
    return Trajectory(7, True, tuple(frames), 2.5)


def test_tum_round_trip_and_evo(tmp_path: Path) -> None:
    source, path = track(), tmp_path / "a.tum"
    path.write_text(trajectory_io.to_tum(source))
    back = trajectory_io.read_tum(path)
    np.testing.assert_array_equal(back.times_ns, source.times_ns)
    np.testing.assert_allclose(back.world_from_camera, source.world_from_camera, atol=1e-6)
    theirs = file_interface.read_tum_trajectory_file(str(path))
    np.testing.assert_allclose(np.array(theirs.poses_se3), source.world_from_camera, atol=1e-6)


def test_kitti_round_trip_and_evo(tmp_path: Path) -> None:
    source, path, times = track(), tmp_path / "a.kitti", tmp_path / "times.txt"
    path.write_text(trajectory_io.to_kitti(source))
    times.write_text("".join(f"{t / 1e9:.6e}\n" for t in range(0, 20 * 10**8, 10**8)))
    back = trajectory_io.read_kitti(path, times)
    np.testing.assert_array_equal(back.times_ns, np.arange(20) * 10**8)
    np.testing.assert_allclose(back.world_from_camera, source.world_from_camera, atol=1e-6)
    theirs = file_interface.read_kitti_poses_file(str(path))
    np.testing.assert_allclose(np.array(theirs.poses_se3), source.world_from_camera, atol=1e-6)


def assert_same(a: tuple[TrajectoryPose, ...], b: tuple[TrajectoryPose, ...], atol: float) -> None:
    assert [replace(x, world_from_camera=None) for x in a] == [replace(x, world_from_camera=None) for x in b]
    for x, y in zip(a, b, strict=True):
        assert (x.world_from_camera is None) == (y.world_from_camera is None)
        if x.world_from_camera is not None:
            np.testing.assert_allclose(x.world_from_camera, y.world_from_camera, atol=atol)


def test_csv_and_json_round_trip(tmp_path: Path) -> None:
    source = trajectory()
    (tmp_path / "a.csv").write_text(trajectory_io.to_csv(source))
    assert_same(trajectory_io.read_csv(tmp_path / "a.csv"), source.frames, 1e-6)
    (tmp_path / "a.json").write_text(trajectory_io.to_json(source))
    back = trajectory_io.read_json(tmp_path / "a.json")
    assert (back.graph_revision, back.is_final, back.scale) == (7, True, 2.5)
    assert_same(back.frames, source.frames, 0.0)


@pytest.mark.data
def test_real_ground_truth(data_dir: Path) -> None:
    folder = data_dir / "kitti_06_first51"
    back = trajectory_io.read_kitti(folder / "poses.txt", folder / "times.txt")
    assert len(back) == 51
    theirs = file_interface.read_kitti_poses_file(str(folder / "poses.txt"))
    np.testing.assert_allclose(back.world_from_camera, np.array(theirs.poses_se3), atol=1e-5)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("tum", "", "no pose"),
        ("tum", "# only a comment\n", "no pose"),
        ("tum", "1 2 3\n", ":1: 8 finite numbers"),
        ("tum", "0 0 0 0 0 0 0 1\n1 x 0 0 0 0 0 1\n", ":2:"),
        ("tum", "0 0 0 0 0 0 0 0\n", "quaternion"),
        ("tum", "nan 0 0 0 0 0 0 1\n", "finite"),
        ("kitti", "1 0 0 0 0 1 0 0 0 0 1\n", "12 finite numbers"),
        ("kitti", "2 0 0 0 0 1 0 0 0 0 1 0\n", "rotation"),
        ("csv", "a,b\n", "first line"),
        ("json", "[]", "not a trajectory"),
        ("json", "{", "not a trajectory"),
        ("json", '{"schema": "x"}', "schema"),
    ],
)
def test_malformed_files_are_named_with_the_line(tmp_path: Path, name: str, text: str, words: str) -> None:
    path = tmp_path / "bad"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        getattr(trajectory_io, f"read_{name}")(path)


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fuzz"
        path.write_bytes(data)
        for reader in (
            trajectory_io.read_tum,
            trajectory_io.read_kitti,
            trajectory_io.read_csv,
            trajectory_io.read_json,
        ):
            with pytest.raises(InputError):
                reader(path)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read"):
        trajectory_io.read_tum(tmp_path / "none")
