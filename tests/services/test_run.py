"""The main job as a user runs it: all processes on loopback, on the sample that the repository ships."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pycolmap
import pytest
from plyfile import PlyData

from vggt_motion.config import load_config
from vggt_motion.evaluation import metrics
from vggt_motion.evaluation.offline import run_offline
from vggt_motion.evaluation.trajectory_io import read_kitti, read_tum

pytestmark = pytest.mark.timeout(400)
RESULTS = (
    "trajectory_keyframes.tum",
    "trajectory_frames.tum",
    "trajectory_frames.kitti",
    "trajectory_frames.csv",
    "map.ply",
    "run.mcap",
    "report.html",
    "config.yaml",
    "metrics.json",
)


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "vggt_motion", *arguments]


def vggt_motion(*arguments: str, timeout_s: float = 300.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*arguments), capture_output=True, text=True, timeout=timeout_s, check=False)


def run(source: Path, out: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return vggt_motion("run", str(source), "--out", str(out), "--set", "gateway.port=0", *arguments)


def assert_one_clear_line(done: subprocess.CompletedProcess[str], exit_code: int, *words: str) -> None:
    assert done.returncode == exit_code, done.stderr
    assert "Traceback" not in done.stderr
    line = done.stderr.strip().splitlines()[-1]
    for word in words:
        assert word in line


def assert_no_orphan(out: Path) -> None:
    """No process of the run is left: each has the folder on its command line."""
    end = time.monotonic() + 5.0
    while True:
        left = [
            p.info["cmdline"] for p in psutil.process_iter(["cmdline"]) if str(out) in " ".join(p.info["cmdline"] or ())
        ]
        if not left:
            return
        assert time.monotonic() < end, left
        time.sleep(0.1)


@pytest.fixture(scope="module")
def sample(sample_dir: Path) -> Path:
    return sample_dir / "kitti_06_first51"


@pytest.fixture(scope="module")
def finished(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    out = tmp_path_factory.mktemp("run") / "out"
    done = run(sample, out, "--ground-truth", str(sample / "poses.txt"))
    assert done.returncode == 0, done.stderr
    return out, done


def load(out: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((out / "metrics.json").read_text())
    return loaded


def test_the_trajectory_is_that_of_the_drive(finished: tuple[Path, Any], sample: Path) -> None:
    out, _ = finished
    truth = read_kitti(sample / "poses.txt", sample / "times.txt")
    estimate = read_tum(out / "trajectory_frames.tum")
    assert len(estimate) == len(truth) == 51
    errors = metrics.evaluate(truth, estimate)
    assert errors.ate_sim3.position_m.rmse < 0.3
    assert load(out)["ground_truth"]["ate_rmse_m"] == pytest.approx(errors.ate_sim3.position_m.rmse, rel=1e-3)


def test_every_file_is_there_and_opens(finished: tuple[Path, Any]) -> None:
    out, done = finished
    assert {path.name for path in out.iterdir()} >= set(RESULTS)
    assert "ATE" in done.stderr
    assert load(out)["is_complete"]
    assert load_config(out / "config.yaml").gateway.port == 0
    vertices = PlyData.read(out / "map.ply")["vertex"]
    assert len(vertices) > 10_000
    assert len(read_kitti(out / "trajectory_frames.kitti")) == 51
    doctor = subprocess.run(
        [str(Path(sys.executable).parent / "pymcap-cli"), "doctor", str(out / "run.mcap")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert doctor.returncode == 0, doctor.stdout + doctor.stderr
    assert_no_orphan(out)


def test_the_processes_compute_what_the_pure_method_does(finished: tuple[Path, Any], sample: Path) -> None:
    out, _ = finished
    offline = run_offline(str(sample), load_config()).trajectory.track("all")
    estimate = read_tum(out / "trajectory_frames.tum")
    np.testing.assert_array_equal(estimate.times_ns, offline.times_ns)
    np.testing.assert_allclose(estimate.positions, offline.positions, atol=1e-8)


def test_a_finished_run_is_exported(finished: tuple[Path, Any], tmp_path: Path) -> None:
    out, _ = finished
    for form, name in (("tum", "trajectory_frames.tum"), ("kitti", "trajectory_frames.kitti"), ("ply", "map.ply")):
        done = vggt_motion("export", str(out), "--format", form, "--out", str(tmp_path / name))
        assert done.returncode == 0, done.stderr
        assert (tmp_path / name).read_bytes() == (out / name).read_bytes()
    done = vggt_motion("export", str(out), "--out", str(tmp_path / "colmap"), "--undistort")
    assert done.returncode == 0, done.stderr
    keyframes = len(read_tum(out / "trajectory_keyframes.tum"))
    model = pycolmap.Reconstruction(str(tmp_path / "colmap" / "sparse" / "0"))
    assert model.num_images() == keyframes and model.num_points3D() > 5_000
    assert model.compute_mean_track_length() > 2.0
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-3
    for image in model.images.values():
        shape = cv2.imread(str(tmp_path / "colmap" / "images" / image.name)).shape
        camera = model.cameras[image.camera_id]
        assert (camera.width, camera.height) == (shape[1], shape[0]) and camera.model.name == "PINHOLE"
    assert_one_clear_line(vggt_motion("export", str(tmp_path / "nothing")), 1, "no ledger")
    assert_one_clear_line(vggt_motion("export", str(out), "--format", "las"), 2, "las")
    assert_one_clear_line(vggt_motion("export", str(out), "--component", "7"), 2, "its parts are 0")


def test_three_workers_give_the_same_trajectory(finished: tuple[Path, Any], sample: Path, tmp_path: Path) -> None:
    out, _ = finished
    done = run(
        sample, tmp_path / "out", "--set", "run.inference_workers=3", "--set", "run.registration_workers=2",
        "--set", "recorder.enabled=false",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for name in ("trajectory_frames.tum", "trajectory_keyframes.tum"):
        assert (tmp_path / "out" / name).read_text() == (out / name).read_text()


def test_the_recording_gives_the_same_trajectory(finished: tuple[Path, Any], tmp_path: Path) -> None:
    out, _ = finished
    done = run(out / "run.mcap", tmp_path / "out", "--set", "recorder.enabled=false")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "trajectory_frames.tum").read_text() == (out / "trajectory_frames.tum").read_text()


def test_a_finished_run_prints_its_summary_again(finished: tuple[Path, Any], sample: Path) -> None:
    out, _ = finished
    before = (out / "metrics.json").stat().st_mtime_ns
    done = run(sample, out, "--ground-truth", str(sample / "poses.txt"))
    assert done.returncode == 0
    assert "finished already" in done.stderr and "ATE" in done.stderr
    assert (out / "metrics.json").stat().st_mtime_ns == before


def test_a_folder_of_another_run_is_refused(finished: tuple[Path, Any], sample: Path) -> None:
    out, _ = finished
    done = run(sample, out, "--stride", "2")
    assert_one_clear_line(done, 2, str(out), "another source", "--fresh")


def test_ctrl_c_keeps_what_was_done_and_the_next_run_continues(
    finished: tuple[Path, Any], sample: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = command("run", str(sample), "--out", str(out), "--set", "gateway.port=0")
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 240
    log = out / "logs" / "inference.log"
    while not (log.exists() and "job done" in log.read_text()):
        assert time.monotonic() < end and process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    metrics_so_far = load(out)
    assert not metrics_so_far["is_complete"] and metrics_so_far["exit_code"] == 130
    # What was solved by then has poses: the first submap alone holds a dozen keyframes.
    assert len(read_tum(out / "trajectory_keyframes.tum")) >= 10
    assert_no_orphan(out)
    done = run(sample, out)
    assert done.returncode == 0, done.stderr
    assert (out / "trajectory_frames.tum").read_text() == (finished[0] / "trajectory_frames.tum").read_text()


@pytest.fixture
def frames(sample: Path, tmp_path: Path) -> Path:
    """A folder with the first eight images of the sample."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for image in sorted(sample.rglob("*.jpg"))[:8]:
        shutil.copy(image, folder)
    return folder


def test_no_such_source(tmp_path: Path) -> None:
    assert_one_clear_line(run(tmp_path / "absent", tmp_path / "out"), 2, "absent")
    assert not (tmp_path / "out").exists()


def test_a_folder_without_images(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert_one_clear_line(run(tmp_path / "empty", tmp_path / "out"), 2, "empty")


def test_one_image(frames: Path, tmp_path: Path) -> None:
    for image in sorted(frames.iterdir())[1:]:
        image.unlink()
    assert_one_clear_line(run(frames, tmp_path / "out"), 2, "one")
    assert_no_orphan(tmp_path / "out")


def test_a_text_file_named_jpg(frames: Path, tmp_path: Path) -> None:
    first = min(frames.iterdir())
    first.write_text("not an image")
    assert_one_clear_line(run(frames, tmp_path / "out"), 2, first.name)
    assert_no_orphan(tmp_path / "out")


def test_a_size_change_ends_the_input_there(frames: Path, tmp_path: Path) -> None:
    last = max(frames.iterdir())
    cv2.imwrite(str(last), np.zeros((100, 100), np.uint8))
    done = run(frames, tmp_path / "out")
    assert_one_clear_line(done, 3, "100x100")
    assert load(tmp_path / "out")["frame_count"] == 7
    assert_no_orphan(tmp_path / "out")


def test_an_unwritable_folder(frames: Path) -> None:
    assert_one_clear_line(run(frames, Path("/proc/nowhere")), 2, "cannot create", "/proc/nowhere")


def test_a_taken_port(frames: Path, tmp_path: Path) -> None:
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = run(frames, tmp_path / "out", "--set", f"gateway.port={port}")
    assert_one_clear_line(done, 2, str(port), "gateway.port")


def test_no_process_outlives_a_killed_run(sample: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = command("run", str(sample), "--out", str(out), "--set", "gateway.port=0")
    process = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    end = time.monotonic() + 60
    while not (out / "logs" / "frontend.log").exists():
        assert time.monotonic() < end and process.poll() is None
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    end = time.monotonic() + 20
    while any(str(out) in " ".join(p.info["cmdline"] or ()) for p in psutil.process_iter(["cmdline"])):
        assert time.monotonic() < end, "processes outlived the run"
        time.sleep(0.1)
