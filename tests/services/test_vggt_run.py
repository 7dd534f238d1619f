"""The whole pipeline with VGGT and weights made by rule: the trajectory means nothing, every stage and size is real."""

from __future__ import annotations

import html
import json
import sqlite3
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'vggt-motion[torch]'")

from rule_weights import rule_weights  # noqa: E402
from vggt_motion.bus import codec  # noqa: E402
from vggt_motion.config import InferenceConfig, VggtConfig  # noqa: E402
from vggt_motion.evaluation.trajectory_io import read_tum  # noqa: E402
from vggt_motion.geometry import se3  # noqa: E402
from vggt_motion.inference.predictor import KeyframeImage, PredictionHints  # noqa: E402
from vggt_motion.inference.registry import create_predictor  # noqa: E402
from vggt_motion.inference.vggt.architecture import SMALL  # noqa: E402
from vggt_motion.inference.vggt.model import Vggt  # noqa: E402
from vggt_motion.ledger.directory import stored_blob  # noqa: E402
from vggt_motion.records import SubmapGeometry, SubmapVerdict  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with torch.device("meta"):
        shapes = {name: tuple(value.shape) for name, value in Vggt(SMALL).state_dict().items()}
    path = tmp_path_factory.mktemp("weights") / "small.pt"
    torch.save({name: torch.from_numpy(value) for name, value in rule_weights(shapes).items()}, path)
    return path


def submaps(out: Path) -> list[SubmapGeometry]:
    with sqlite3.connect(f"file:{out / 'ledger' / 'ledger.db'}?mode=ro", uri=True) as database:
        rows = database.execute("SELECT payload FROM records WHERE stream = 'submap' ORDER BY sequence").fetchall()
    database.close()
    return [codec.decode(SubmapGeometry, payload) for (payload,) in rows]


def blob(out: Path, sha256: str) -> bytes:
    return stored_blob(out / "ledger", sha256)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_every_stage_runs(weights: Path, sample_dir: Path, tmp_path: Path, dtype: str) -> None:
    sample, out = sample_dir / "kitti_06_first51", tmp_path / "out"
    values = {"model": weights, "device": "cpu", "dtype": dtype, "cpu_threads": 1}
    command = [sys.executable, "-m", "vggt_motion", "run", str(sample), "--out", str(out), "--set", "gateway.port=0"]
    for setting in ("inference.predictor=vggt", *(f"inference.vggt.{name}={value}" for name, value in values.items())):
        command += ["--set", setting]
    done = subprocess.run(command, capture_output=True, text=True, timeout=800, check=False)
    assert done.returncode == 0, done.stderr
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["is_complete"]
    assert metrics["frame_count"] == 51
    assert metrics["dead_job_count"] == 0
    assert metrics["submaps"] == {"good": metrics["segment_count"]}
    assert metrics["focal_over_width"] > 0.0
    trajectory = read_tum(out / "trajectory_frames.tum")
    assert np.isfinite(trajectory.positions).all()
    for name in ("map.ply", "run.mcap", "report.html", "trajectory_frames.kitti"):
        assert (out / name).stat().st_size > 0

    geometries = submaps(out)
    assert all(geometry.verdict is SubmapVerdict.GOOD for geometry in geometries)
    assert {geometry.model for geometry in geometries} == {f"vggt small {dtype}"}
    assert {(geometry.spec.revision, geometry.spec.focal_hint) for geometry in geometries} == {(1, None)}
    assert len(geometries) == metrics["segment_count"], "no submap is predicted twice"
    for geometry in geometries:
        assert [frame.keyframe_id for frame in geometry.frames] == list(geometry.spec.keyframe_ids)
        assert {(frame.intrinsics.width_px, frame.intrinsics.height_px) for frame in geometry.frames} == {(518, 154)}

    # What came through the processes and the codec is what the predictor returns in this process.
    geometry = min(geometries, key=lambda one: len(one.frames))
    images = []
    for keyframe_id in geometry.spec.keyframe_ids:
        file = sorted(sample.rglob("*.jpg"))[int(keyframe_id.rsplit("/", 1)[1])]
        pixels = cv2.cvtColor(cv2.imread(str(file), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        images.append(KeyframeImage(keyframe_id, 0, np.asarray(pixels, dtype=np.uint8)))
    config = InferenceConfig(vggt=VggtConfig.model_validate(values | {"model": str(weights)}))
    threads = torch.get_num_threads()
    try:
        direct = create_predictor("vggt", config).predict(images, PredictionHints())
    finally:
        torch.set_num_threads(threads)
    # In the log a submap's frame is that of its first camera, whatever the network chose.
    first_from_network = se3.inverse(direct.frames[0].submap_from_camera)
    for sent, frame in zip(geometry.frames, direct.frames, strict=True):
        depth, confidence = codec.decode_depth(blob(out, sent.depth.sha256))
        np.testing.assert_allclose(depth, frame.depth, rtol=1e-3)
        np.testing.assert_allclose(confidence, frame.confidence, atol=1 / 255)
        np.testing.assert_allclose(sent.submap_from_camera, first_from_network @ frame.submap_from_camera, atol=1e-6)


def test_auto_says_what_it_chose_and_why(sample_dir: Path, tmp_path: Path) -> None:
    sample, out = sample_dir / "kitti_06_first51", tmp_path / "out"
    command = [sys.executable, "-m", "vggt_motion", "run", str(sample), "--out", str(out), "--end", "12"]
    for setting in ("gateway.port=0", "inference.predictor=auto", "inference.vggt.model=nobody/has-these"):
        command += ["--set", setting]
    done = subprocess.run(command, capture_output=True, text=True, timeout=800, check=False)
    assert done.returncode == 0, done.stderr
    reason = "no vggt here: weights 'nobody/has-these' are not on this machine"
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["predictor"], metrics["predictor_reason"]) == ("sfm", reason)
    assert html.escape(reason) in (out / "report.html").read_text()
