from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from vggt_motion.errors import InputError
from vggt_motion.evaluation import summary
from vggt_motion.evaluation.trajectory_io import to_kitti, to_tum
from vggt_motion.geometry import se3
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.geometry.track import PoseTrack


@pytest.fixture
def circle() -> PoseTrack:
    """Forty poses on a circle of 10 m radius, at 10 Hz."""
    angles = np.linspace(0.0, 1.5 * np.pi, 40)
    poses = np.array(
        [
            se3.make(se3.so3_exp(np.array([0.0, a, 0.0])), np.array([10 * np.cos(a), 0.1 * a, 10 * np.sin(a)]))
            for a in angles
        ]
    )
    return PoseTrack((np.arange(40) * 100_000_000).astype(np.int64), poses)


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_a_similar_trajectory_has_no_error_and_gives_back_the_scale(circle: PoseTrack, tmp_path: Path) -> None:
    moved = Sim3(se3.so3_exp(np.array([0.3, -0.2, 0.5])), np.array([5.0, -3.0, 2.0]), 0.25)
    other = PoseTrack(circle.times_ns, np.array([moved.act_pose(pose) for pose in circle.world_from_camera]))
    truth = write(tmp_path / "truth.kitti", to_kitti(circle))
    for name, text in (("a.tum", to_tum(other)), ("a.kitti", to_kitti(other))):
        estimate = write(tmp_path / name, text)
        if name.endswith("tum"):
            write(tmp_path / "times.txt", "".join(f"{t / 1e9}\n" for t in circle.times_ns))
        errors = summary.evaluate_files(estimate, truth)
        table = summary.error_table(errors)
        assert table["ate_rmse_m"] == pytest.approx(0.0, abs=1e-5)
        assert table["scale_reference_over_estimate"] == pytest.approx(4.0, rel=1e-5)
        assert table["matched_pose_count"] == 40


def test_what_the_drive_is_too_short_for_is_null(circle: PoseTrack, tmp_path: Path) -> None:
    truth = write(tmp_path / "truth.tum", to_tum(circle))
    errors = summary.evaluate_files(truth, truth)
    assert math.isnan(errors.kitti.t_rel_percent)
    assert json.loads(summary.to_json(errors))["t_rel_percent"] is None
    assert "drive too short" in summary.to_text(errors)


def test_files_that_cannot_be_compared(circle: PoseTrack, tmp_path: Path) -> None:
    kitti = write(tmp_path / "a.kitti", to_kitti(circle))
    short = write(tmp_path / "b.kitti", to_kitti(circle.subset(np.arange(5))))
    tum = write(tmp_path / "c.tum", to_tum(circle))
    rubbish = write(tmp_path / "d.txt", "what is this\n")
    for estimate, truth, words in (
        (kitti, short, "one line for each frame"),
        (tum, kitti, "times.txt"),
        (tmp_path / "absent", tum, "cannot read"),
        (rubbish, tum, "d.txt"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            summary.evaluate_files(estimate, truth)
        assert "\n" not in str(caught.value)
