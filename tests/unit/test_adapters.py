"""Foreign networks behind the predictor contract: conventions on synthetic outputs, and the isolating process."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vggt_motion.config import ForeignConfig, InferenceConfig
from vggt_motion.errors import InputError, MissingDependencyError, PredictionError
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import unproject
from vggt_motion.inference import depth_anything, map_anything, pi3
from vggt_motion.inference.foreign import child
from vggt_motion.inference.foreign.process import ForeignPredictor, ForeignProcess, MissingOutputError, fit_pinhole
from vggt_motion.inference.lattice import Lattice
from vggt_motion.inference.predictor import KeyframeImage, Prediction, PredictionHints
from vggt_motion.inference.registry import create_predictor
from vggt_motion.records import ScaleKind, SubmapVerdict

Array = npt.NDArray[np.float64]
WIDTH, HEIGHT, COUNT = 56, 42, 3
FX, FY, CX, CY = 50.0, 48.0, 27.0, 21.5


class Scene:
    """A slanted wall seen by three cameras, in every convention that the networks use."""

    def __init__(self) -> None:
        v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
        rays = np.stack([(u - CX) / FX, (v - CY) / FY, np.ones_like(u)], axis=-1)
        self.poses = np.stack(
            [se3.exp(np.array([0.02 * i, -0.1 * i, 0.01, 0.5 * i, 0.1, 0.3 * i])) for i in range(COUNT)]
        )  # world_from_camera
        normal, offset = np.array([0.1, 0.2, 1.0]), 6.0  # normal . x = offset in the world
        self.depth = np.empty((COUNT, HEIGHT, WIDTH))
        for index, pose in enumerate(self.poses):
            self.depth[index] = (offset - normal @ pose[:3, 3]) / (rays @ (pose[:3, :3].T @ normal))
        self.local_points = rays * self.depth[..., None]
        self.directions = np.broadcast_to(rays / np.linalg.norm(rays, axis=-1, keepdims=True), (COUNT, *rays.shape))
        self.logits = np.random.default_rng(0).normal(size=self.depth.shape)
        self.confidence = 1 / (1 + np.exp(-self.logits))
        self.pinhole = np.tile(np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]]), (COUNT, 1, 1))
        self.sky = np.zeros(self.depth.shape, bool)
        self.sky[:, :5] = True
        self.world_points = np.stack(
            [se3.act(pose, points) for pose, points in zip(self.poses, self.local_points, strict=True)]
        )


SCENE = Scene()
LATTICE = Lattice(WIDTH, HEIGHT, WIDTH, HEIGHT)
OUTPUTS: dict[str, dict[str, npt.NDArray[Any]]] = {
    "pi3": {
        "local_points": SCENE.local_points.astype(np.float32),
        "camera_poses": SCENE.poses,
        "conf": SCENE.logits[..., None],
    },
    "depth_anything_3": {
        "depth": SCENE.depth.astype(np.float32),
        "extrinsics": np.stack([se3.inverse(pose)[:3] for pose in SCENE.poses]),
        "intrinsics": SCENE.pinhole,
        "conf": 1 + np.exp(SCENE.logits),
        "is_metric": np.array([True]),
    },
    "map_anything": {
        "depth_z": SCENE.depth[..., None].astype(np.float32),
        "ray_directions": SCENE.directions,
        "camera_poses": SCENE.poses,
        "conf": 1 + np.exp(SCENE.logits),
        "mask": np.ones((*SCENE.depth.shape, 1)),
    },
}
CONVERT: dict[str, Callable[..., Prediction]] = {
    "pi3": pi3.to_prediction,
    "depth_anything_3": depth_anything.to_prediction,
    "map_anything": map_anything.to_prediction,
}


def convert(name: str, hints: PredictionHints | None = None, **changes: npt.NDArray[Any] | None) -> Prediction:
    arrays = {key: value for key, value in {**OUTPUTS[name], **changes}.items() if value is not None}
    return CONVERT[name](LATTICE, hints or PredictionHints(), arrays, f"{name} test", {"network": 1.0})


class TestConventions:
    @pytest.mark.parametrize("name", OUTPUTS)
    def test_all_see_the_same_wall(self, name: str) -> None:
        prediction = convert(name)
        assert prediction.verdict is SubmapVerdict.GOOD
        assert prediction.model == f"{name} test"
        assert len(prediction.frames) == COUNT
        for frame, expected, confidence in zip(prediction.frames, SCENE.world_points, SCENE.confidence, strict=True):
            points = se3.act(frame.submap_from_camera, unproject(frame.depth, frame.intrinsics))
            np.testing.assert_allclose(points, expected, atol=1e-4)
            np.testing.assert_allclose(frame.confidence, confidence, atol=1e-6)

    def test_units(self) -> None:
        assert convert("pi3").scale_kind is ScaleKind.RELATIVE
        assert convert("map_anything").scale_kind is ScaleKind.METRIC
        assert convert("depth_anything_3").scale_kind is ScaleKind.METRIC
        assert convert("depth_anything_3", is_metric=np.array([False])).scale_kind is ScaleKind.RELATIVE
        assert convert("depth_anything_3", is_metric=None).scale_kind is ScaleKind.RELATIVE

    def test_extrinsics_of_either_shape(self) -> None:
        four = np.stack([se3.inverse(pose) for pose in SCENE.poses])
        for a, b in zip(
            convert("depth_anything_3").frames, convert("depth_anything_3", extrinsics=four).frames, strict=True
        ):
            np.testing.assert_array_equal(a.submap_from_camera, b.submap_from_camera)

    def test_sky_that_the_network_saw_is_used(self) -> None:
        for frame in convert("depth_anything_3", sky=SCENE.sky).frames:
            assert not frame.depth[:5].any()
            assert not frame.confidence[:5].any()
            assert frame.depth[5:].all()

    def test_masked_points_are_unknown(self) -> None:
        for frame in convert("map_anything", mask=~SCENE.sky[..., None]).frames:
            assert not frame.depth[:5].any()
            assert frame.depth[5:].all()

    def test_points_behind_the_camera_are_unknown(self) -> None:
        points = SCENE.local_points.copy()
        points[:, :5] *= -1
        for frame in convert("pi3", local_points=points).frames:
            assert not frame.depth[:5].any()
            assert frame.intrinsics.fx == pytest.approx(FX, rel=1e-3)

    def test_no_confidence_means_all_alike(self) -> None:
        for frame in convert("depth_anything_3", conf=None).frames:
            assert (frame.confidence == 1).all()

    def test_both_ends_of_a_stop_share_one_pose(self) -> None:
        frames = convert("pi3", PredictionHints(zero_motion_copies={2: 1})).frames
        np.testing.assert_array_equal(frames[2].submap_from_camera, frames[1].submap_from_camera)

    @pytest.mark.parametrize(
        ("name", "changes"),
        [
            ("pi3", {"conf": None}),
            ("pi3", {"conf": SCENE.logits}),
            ("pi3", {"camera_poses": SCENE.poses[:2]}),
            ("depth_anything_3", {"extrinsics": None}),  # a monocular model
            ("depth_anything_3", {"extrinsics": SCENE.poses[:, :, :3]}),
            ("map_anything", {"ray_directions": SCENE.directions[:, :10]}),
            ("map_anything", {"depth_z": SCENE.depth}),
        ],
    )
    def test_other_forms_are_named(self, name: str, changes: dict[str, Any]) -> None:
        with pytest.raises(MissingOutputError, match="the network returned"):
            convert(name, **changes)


class TestFitPinhole:
    @given(
        st.floats(20, 2000), st.floats(20, 2000), st.floats(-20, 100), st.floats(-20, 100), st.integers(0, 2**32 - 1)
    )
    def test_recovers_the_camera_despite_outliers(self, fx: float, fy: float, cx: float, cy: float, seed: int) -> None:
        random = np.random.default_rng(seed)
        v, u = np.mgrid[0:30, 0:40].astype(np.float64)
        rays = np.stack([(u - cx) / fx, (v - cy) / fy], axis=-1)
        matrix = fit_pinhole(rays, np.ones((30, 40)))
        np.testing.assert_allclose(matrix, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], rtol=1e-6, atol=1e-6)
        rays[random.random((30, 40)) < 0.02] = np.nan
        matrix = fit_pinhole(rays, np.ones((30, 40)))
        np.testing.assert_allclose(matrix, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], rtol=1e-6, atol=1e-6)

    def test_bad_rays_with_low_weight_do_not_matter(self) -> None:
        v, u = np.mgrid[0:30, 0:40].astype(np.float64)
        rays = np.stack([(u - 20) / 50, (v - 15) / 50], axis=-1)
        rays[:4] = 3.0
        weights = np.ones((30, 40))
        weights[:4] = 1e-6
        np.testing.assert_allclose(fit_pinhole(rays, weights)[0, 0], 50, rtol=1e-3)

    def test_rays_that_do_not_determine_it(self) -> None:
        assert not np.isfinite(fit_pinhole(np.zeros((4, 5, 2)), np.ones((4, 5)))).all()
        assert not np.isfinite(fit_pinhole(np.ones((4, 5, 2)), np.zeros((4, 5)))).all()


class TestMessages:
    @given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 5), max_size=4))
    def test_round_trip(self, seed: int, shape: list[int]) -> None:
        random = np.random.default_rng(seed)
        arrays = {
            "a": random.random(shape).astype(np.float32),
            "b": random.integers(0, 256, (3, 2), dtype=np.uint8)[:, ::-1],
            "c": np.array([True, False]),
        }
        stream = io.BytesIO()
        child.write_message(stream, {"x": "1"}, arrays)
        stream.seek(0)
        message = child.read_message(stream)
        assert message is not None
        assert message[0] == {"x": "1"}
        for name, array in arrays.items():
            assert message[1][name].dtype == array.dtype
            np.testing.assert_array_equal(message[1][name], array)
        assert child.read_message(stream) is None

    @given(st.binary(min_size=1, max_size=200))
    def test_noise_is_refused(self, data: bytes) -> None:
        with pytest.raises(child.MessageError):
            child.read_message(io.BytesIO(data))

    @pytest.mark.parametrize(
        "head",
        [
            {"fields": {}, "arrays": [["a", "object", [1]]]},
            {"fields": {}, "arrays": [["a", "float32", [-1]]]},
            {"fields": {}, "arrays": [["a", "float32", [2**40]]]},
            {"fields": {}, "arrays": [["a", "float32", [4]]]},
            {"fields": [], "arrays": []},
            {},
        ],
    )
    def test_hostile_heads_are_refused(self, head: dict[str, Any]) -> None:
        text = json.dumps(head).encode()
        with pytest.raises(child.MessageError):
            child.read_message(io.BytesIO(len(text).to_bytes(4, "little") + text + b"\x00" * 7))


# Packages of the documented form that see a wall at depth 4 in every image: what is tested is the way there and back.
FAKE_PACKAGES = {
    "pi3/models/pi3.py": """
        import torch

        class Pi3(torch.nn.Module):
            @classmethod
            def from_pretrained(cls, name):
                print("a package that prints")
                if name != "yyfz233/Pi3":
                    raise OSError(f"{name} is not a repository\\nsecond line")
                return cls()

            def forward(self, imgs):
                b, n, _, h, w = imgs.shape
                assert imgs.min() >= 0 and imgs.max() <= 1 and h % 14 == 0 and w % 14 == 0
                v, u = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
                points = torch.stack([(u - w / 2) / w, (v - h / 2) / w, torch.ones_like(u)], -1).float() * 4
                poses = torch.eye(4).repeat(b, n, 1, 1)
                poses[..., 0, 3] = torch.arange(n)
                return {"local_points": points.expand(b, n, h, w, 3), "camera_poses": poses,
                        "conf": imgs.mean(2)[..., None], "points": None}
        """,
    "depth_anything_3/api.py": """
        import numpy, torch
        from types import SimpleNamespace

        class DepthAnything3(torch.nn.Module):
            @classmethod
            def from_pretrained(cls, name):
                return cls()

            def inference(self, image):
                n = len(image)
                assert image[0].dtype == numpy.uint8 and image[0].shape[2] == 3
                extrinsics = numpy.tile(numpy.eye(4, dtype="f4")[:3], (n, 1, 1))
                extrinsics[:, 0, 3] = -numpy.arange(n)
                intrinsics = numpy.tile(numpy.array([[84, 0, 42], [0, 84, 21], [0, 0, 1]], "f4"), (n, 1, 1))
                depth = numpy.full((n, 42, 84), 4, "f4")
                return SimpleNamespace(depth=depth, conf=depth, extrinsics=extrinsics, intrinsics=intrinsics, sky=None,
                                       is_metric=1)
        """,
    "mapanything/models.py": """
        import torch

        class MapAnything(torch.nn.Module):
            @classmethod
            def from_pretrained(cls, name):
                return cls()

            def infer(self, views, memory_efficient_inference, use_amp, apply_mask, mask_edges):
                results = []
                for index, view in enumerate(views):
                    assert view["data_norm_type"] == ["dinov2"]
                    _, _, h, w = view["img"].shape
                    v, u = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
                    rays = torch.stack([(u - w / 2) / w, (v - h / 2) / w, torch.ones_like(u)], -1).float()[None]
                    pose = torch.eye(4)[None]
                    pose[:, 0, 3] = index
                    results.append({
                        "depth_z": torch.full((1, h, w, 1), 4.0), "camera_poses": pose,
                        "conf": torch.full((1, h, w), 4.0),
                        "ray_directions": rays / rays.norm(dim=-1, keepdim=True),
                        "mask": torch.ones(1, h, w, 1, dtype=torch.bool),
                    })
                return results
        """,
}


@pytest.fixture
def fake_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch", reason="torch is not installed: pip install 'vggt-motion[torch]'")
    for name, text in FAKE_PACKAGES.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(textwrap.dedent(text))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


def keyframes(count: int = 3) -> list[KeyframeImage]:
    pixels = np.random.default_rng(0).integers(0, 256, (count, 100, 200, 3), dtype=np.uint8)
    return [KeyframeImage(f"front/0/{index:08d}", index, image) for index, image in enumerate(pixels)]


class TestThroughTheProcess:
    @pytest.mark.parametrize("name", ["pi3", "depth_anything_3", "map_anything"])
    def test_there_and_back(self, name: str, fake_packages: None) -> None:
        predictor = create_predictor(name, InferenceConfig())
        assert isinstance(predictor, ForeignPredictor)
        try:
            prediction = predictor.predict(keyframes(), PredictionHints())
        finally:
            predictor.close()
        assert prediction.verdict is SubmapVerdict.GOOD, prediction.reason
        assert prediction.model.startswith(name)
        assert len(prediction.frames) == 3
        for index, frame in enumerate(prediction.frames):
            np.testing.assert_allclose(frame.depth, 4.0)
            np.testing.assert_allclose(frame.submap_from_camera[:3, 3], [index, 0, 0], atol=1e-6)
            assert frame.intrinsics.fx == pytest.approx(frame.intrinsics.width_px, rel=1e-4)
            assert (frame.intrinsics.height_px, frame.intrinsics.width_px) == frame.depth.shape
            assert ((frame.confidence > 0) & (frame.confidence < 1)).all()
        assert prediction.stage_seconds["network"] > 0

    @pytest.mark.parametrize("name", ["pi3", "pi3x", "depth_anything_3", "map_anything"])
    def test_what_is_missing_is_said(self, name: str) -> None:
        with pytest.raises(MissingDependencyError, match=rf"'{name}' is not in .*pip.* install") as caught:
            create_predictor(name, InferenceConfig())
        assert f"inference.{name}.python" in str(caught.value)
        assert "\n" not in str(caught.value)

    def test_no_interpreter(self, tmp_path: Path) -> None:
        config = InferenceConfig(pi3=ForeignConfig(model="m", python=tmp_path / "python"))
        with pytest.raises(MissingDependencyError, match=r"inference.pi3.python: no interpreter at"):
            create_predictor("pi3", config)

    def test_weights_that_are_not_there(self, fake_packages: None) -> None:
        config = InferenceConfig(pi3=ForeignConfig(model="other"))
        with pytest.raises(InputError, match=r"cannot load 'other': OSError: other is not a repository second line"):
            create_predictor("pi3", config)

    def test_sizes_that_differ_do_not_raise(self, fake_packages: None) -> None:
        predictor = create_predictor("depth_anything_3", InferenceConfig())
        assert isinstance(predictor, ForeignPredictor)
        assert predictor.predict([], PredictionHints()).verdict is SubmapVerdict.FAILED
        predictor.close()


RUNNER = """
import os, sys, time
def load(options):
    def predict(images):
        first = int(images.flat[0])
        if first == 1:
            raise ValueError("hard\\ninput")
        if first == 2:
            os._exit(7)
        if first == 3:
            time.sleep(60)
        print("noise on standard output")
        return {"sum": images.sum(axis=(1, 2, 3)).astype("float64")}
    return predict
"""


class TestProcess:
    @pytest.fixture
    def process(self, tmp_path: Path) -> Iterator[ForeignProcess]:
        (tmp_path / "runner.py").write_text(RUNNER)
        process = ForeignProcess(
            "test", str(tmp_path / "runner.py"), ForeignConfig(model="m", device="cpu"), "install it"
        )
        yield process
        process.close()

    @staticmethod
    def images(first: int) -> npt.NDArray[np.uint8]:
        pixels = np.full((2, 4, 5, 3), 5, np.uint8)
        pixels[0, 0, 0, 0] = first
        return pixels

    def test_answers_and_survives_an_error(self, process: ForeignProcess) -> None:
        with pytest.raises(PredictionError, match="ValueError: hard input"):
            process.predict(self.images(1))
        arrays, seconds = process.predict(self.images(5))
        np.testing.assert_array_equal(arrays["sum"], [300, 300])
        assert seconds > 0

    def test_is_started_again_after_it_died(self, process: ForeignProcess) -> None:
        with pytest.raises(PredictionError, match="ended with code 7"):
            process.predict(self.images(2))
        arrays, _ = process.predict(self.images(5))
        np.testing.assert_array_equal(arrays["sum"], [300, 300])

    def test_dies_with_its_parent_even_while_it_computes(self, tmp_path: Path) -> None:
        (tmp_path / "runner.py").write_text(RUNNER)
        parent = subprocess.Popen(
            [sys.executable, "-c", PARENT, str(tmp_path / "runner.py")], stdout=subprocess.PIPE, text=True
        )
        assert parent.stdout is not None
        grandchild = int(parent.stdout.readline())
        child_process = psutil.Process(grandchild)
        parent.kill()
        parent.wait()
        parent.stdout.close()
        for _ in range(300):
            try:
                if child_process.status() == psutil.STATUS_ZOMBIE:
                    return
            except psutil.NoSuchProcess:
                return
            time.sleep(0.1)
        child_process.kill()
        pytest.fail("the child outlived its parent")


PARENT = """
import sys, numpy
from vggt_motion.config import ForeignConfig
from vggt_motion.inference.foreign.process import ForeignProcess
process = ForeignProcess("test", sys.argv[1], ForeignConfig(model="m", device="cpu"), "")
print(process._process.pid, flush=True)
process.predict(numpy.full((1, 2, 2, 3), 3, "uint8"))
"""
