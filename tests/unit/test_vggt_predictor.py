"""VGGT behind the predictor contract, and the choice that ``auto`` makes."""

from __future__ import annotations

import importlib.util
import math
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'vggt-motion[torch]'")

from rule_weights import TINY, fixture_dir, rule_weights  # noqa: E402
from vggt_motion.backend import planner  # noqa: E402
from vggt_motion.backend.state import LogState  # noqa: E402
from vggt_motion.bus import codec  # noqa: E402
from vggt_motion.config import InferenceConfig, VggtConfig, load_config  # noqa: E402
from vggt_motion.errors import ConfigurationError, InputError, MissingDependencyError, PredictionError  # noqa: E402
from vggt_motion.geometry import se3  # noqa: E402
from vggt_motion.inference import task, vggt  # noqa: E402
from vggt_motion.inference.lattice import fit_width  # noqa: E402
from vggt_motion.inference.predictor import KeyframeImage, PredictionHints  # noqa: E402
from vggt_motion.inference.registry import choose_predictor, create_predictor, predictor_names  # noqa: E402
from vggt_motion.inference.vggt import device as devices  # noqa: E402
from vggt_motion.inference.vggt import predictor as module  # noqa: E402
from vggt_motion.inference.vggt.model import Vggt  # noqa: E402
from vggt_motion.records import (  # noqa: E402
    BlobRef,
    Event,
    EventKind,
    Keyframe,
    MotionState,
    PredictTask,
    RegisterTask,
    ScaleKind,
    Segment,
    SubmapGeometry,
    SubmapSpec,
    SubmapVerdict,
)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with torch.device("meta"):
        shapes = {name: tuple(value.shape) for name, value in Vggt(TINY).state_dict().items()}
    path = tmp_path_factory.mktemp("weights") / "tiny.pt"
    torch.save({name: torch.from_numpy(value) for name, value in rule_weights(shapes).items()}, path)
    return path


def settings(weights: Path, **changes: object) -> InferenceConfig:
    values = {"model": str(weights), "device": "cpu", "width_px": 140, **changes}
    return InferenceConfig(predictor="vggt", vggt=VggtConfig.model_validate(values))


def keyframes(count: int, width: int = 320, height: int = 200, seed: int = 0) -> list[KeyframeImage]:
    pixels = np.random.default_rng(seed).integers(0, 256, (count, height, width, 3), dtype=np.uint8)
    return [KeyframeImage(f"front/0/{index:08d}", index, image) for index, image in enumerate(pixels)]


class TestPredict:
    def test_contract(self, weights: Path) -> None:
        prediction = create_predictor("vggt", settings(weights)).predict(keyframes(3), PredictionHints())
        assert prediction.verdict is SubmapVerdict.GOOD
        assert prediction.scale_kind is ScaleKind.RELATIVE
        assert prediction.model == "vggt tiny float32"
        assert [frame.position for frame in prediction.frames] == [0, 1, 2]
        for frame in prediction.frames:
            assert frame.depth.shape == frame.confidence.shape == (84, 140)
            assert frame.depth.dtype == frame.confidence.dtype == np.float32
            assert (frame.depth > 0).all()
            assert ((frame.confidence > 0) & (frame.confidence < 1)).all()
            assert (frame.intrinsics.width_px, frame.intrinsics.height_px) == (140, 84)
            rotation = frame.submap_from_camera[:3, :3]
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert prediction.quality.focal_over_width == pytest.approx(
            np.median([frame.intrinsics.fx / 140 for frame in prediction.frames])
        )
        assert {"prepare", "patch_embedding", "global_attention", "dense_head", "camera_head"} <= set(
            prediction.stage_seconds
        )

    def test_same_input_same_result(self, weights: Path) -> None:
        first, second = (
            create_predictor("vggt", settings(weights)).predict(keyframes(2), PredictionHints()) for _ in range(2)
        )
        for a, b in zip(first.frames, second.frames, strict=True):
            np.testing.assert_array_equal(a.depth, b.depth)
            np.testing.assert_array_equal(a.submap_from_camera, b.submap_from_camera)

    @pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
    def test_reduced_precision_is_close(self, weights: Path, dtype: str) -> None:
        images = keyframes(2)
        exact = create_predictor("vggt", settings(weights)).predict(images, PredictionHints())
        reduced = create_predictor("vggt", settings(weights, dtype=dtype)).predict(images, PredictionHints())
        assert reduced.model.endswith(dtype)
        for a, b in zip(exact.frames, reduced.frames, strict=True):
            assert not np.array_equal(a.depth, b.depth)
            np.testing.assert_allclose(a.depth, b.depth, rtol=0.05)
            np.testing.assert_allclose(a.submap_from_camera, b.submap_from_camera, atol=0.02)

    def test_many_equal_one_by_one(self, weights: Path) -> None:
        predictor = create_predictor("vggt", settings(weights, max_batch_submaps=2))
        assert isinstance(predictor, module.VggtPredictor)
        requests = [
            (keyframes(2, seed=1), PredictionHints()),
            (keyframes(3, seed=2), PredictionHints()),
            (keyframes(2, seed=3), PredictionHints(zero_motion_copies={1: 0})),
            ([], PredictionHints()),
            (keyframes(2, seed=4), PredictionHints()),
            (keyframes(2, 200, 320, seed=5), PredictionHints()),
        ]
        together = predictor.predict_many(requests)
        for prediction, (images, hints) in zip(together, requests, strict=True):
            alone = predictor.predict(images, hints)
            assert prediction.verdict is alone.verdict
            assert len(prediction.frames) == len(images)
            for a, b in zip(prediction.frames, alone.frames, strict=True):
                np.testing.assert_allclose(a.depth, b.depth, rtol=1e-4)
                np.testing.assert_allclose(a.submap_from_camera, b.submap_from_camera, atol=1e-4)

    def test_a_tall_image_is_covered(self, weights: Path) -> None:
        frame = create_predictor("vggt", settings(weights)).predict(keyframes(1, 90, 160), PredictionHints()).frames[0]
        assert frame.depth.shape == (252, 140)
        assert not frame.depth[:56].any()
        assert not frame.depth[196:].any()
        assert frame.depth[56:196].all()
        assert frame.intrinsics.cy == pytest.approx(126.0)

    def test_hard_input_does_not_raise(self, weights: Path) -> None:
        predictor = create_predictor("vggt", settings(weights))
        assert predictor.predict([], PredictionHints()).verdict is SubmapVerdict.FAILED
        mixed = predictor.predict(keyframes(1) + keyframes(1, 300), PredictionHints())
        assert mixed.verdict is SubmapVerdict.FAILED
        assert "300x200" in mixed.reason

    def test_a_broken_network_fails_with_a_reason(self, weights: Path) -> None:
        predictor = create_predictor("vggt", settings(weights))
        assert isinstance(predictor, module.VggtPredictor)
        predictor._model.camera_head.token_norm.weight.fill_(float("nan"))
        assert "not numbers" in predictor.predict(keyframes(1), PredictionHints()).reason

    def test_too_large_is_refused_before(self, weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        predictor = create_predictor("vggt", settings(weights))
        monkeypatch.setattr(module, "available_bytes", lambda device: 2**20)
        with pytest.raises(PredictionError, match=r"12 frames at 140x84 needs about .* GiB"):
            predictor.predict(keyframes(12), PredictionHints())

    def test_a_batch_shrinks_to_what_fits(self, weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        predictor = create_predictor("vggt", settings(weights, memory_reserve_bytes=0, frame_chunk=1))
        assert isinstance(predictor, module.VggtPredictor)
        enough = module.plan_pass(TINY, 4, (84, 140), torch.float32, 2**40, frame_chunk=1).required_bytes
        monkeypatch.setattr(module, "available_bytes", lambda device: enough)
        lattice = fit_width(320, 200, 140, 14)
        batches = [(batch, plan.required_bytes <= enough) for batch, plan in predictor._batches([5, 6, 7], 2, lattice)]
        assert batches == [([5, 6], True), ([7], True)]

    def test_out_of_memory_anyway_is_a_failed_job(self, weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        predictor = create_predictor("vggt", settings(weights))
        assert isinstance(predictor, module.VggtPredictor)

        def full(*_: object, **__: object) -> None:
            raise torch.OutOfMemoryError("CUDA out of memory")

        monkeypatch.setattr(predictor._model, "forward", full)
        with pytest.raises(PredictionError, match="out of memory on cpu with 1 submaps of 2 frames"):
            predictor.predict(keyframes(2), PredictionHints())

    def test_weights_that_do_not_fit(self, weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(module, "available_bytes", lambda device: 0)
        with pytest.raises(PredictionError, match=r"weights tiny.pt need"):
            create_predictor("vggt", settings(weights))


def test_a_submap_that_does_not_fit_fails_with_the_reason_and_is_split(
    weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the check before the pass, over the failed job, to its two halves, which fit and are registered."""
    values = {"model": weights, "device": "cpu", "width_px": 140, "memory_reserve_bytes": 0}
    assignments = ["inference.predictor=vggt", "frontend.overlap_keyframes=2"]
    config = load_config(assignments=assignments + [f"inference.vggt.{name}={value}" for name, value in values.items()])
    enough = module.plan_pass(TINY, 6, (84, 140), torch.float32, 2**40, frame_chunk=1).required_bytes
    monkeypatch.setattr(module, "available_bytes", lambda device: enough)
    blob = BlobRef("0" * 64, 1, "image/png")
    taken = [Keyframe("front", 0, i, i * 10**8, MotionState.LINEAR, 320, 200, blob) for i in range(8)]
    images = {
        keyframe.keyframe_id: cv2.imencode(".png", image.pixels)[1].tobytes()
        for keyframe, image in zip(taken, keyframes(8), strict=True)
    }
    state = LogState()
    state.apply(Segment(0, "front", 0, tuple(images), (), (), "budget"))
    for keyframe in taken:
        state.apply(keyframe)

    def predicted(job: planner.PlannedJob) -> SubmapGeometry:
        assert isinstance(job.task, PredictTask)
        return task.predict_submap(
            job.task, [images[keyframe.keyframe_id] for keyframe in job.task.keyframes], None, config.inference
        )[0]

    (whole,) = planner.next_jobs(state, config)
    with pytest.raises(PredictionError, match="a submap of 8 frames at 140x84 needs about") as caught:
        predicted(whole)
    detail = {"job_id": whole.job_id, "reason": str(caught.value)}
    state.apply(Event(f"job_dead/{whole.job_id}", EventKind.JOB_DEAD, str(caught.value), 0, detail))
    halves = planner.next_jobs(state, config)
    geometries = [predicted(job) for job in halves]
    assert [(geometry.verdict, len(geometry.frames)) for geometry in geometries] == [
        (SubmapVerdict.GOOD, 4),
        (SubmapVerdict.GOOD, 6),
    ]
    for geometry in geometries:
        state.apply(geometry)
    (registration,) = planner.next_jobs(state, config)
    assert isinstance(registration.task, RegisterTask)
    assert len(registration.task.shared) == 2
    task._predictor_of.cache_clear()


def test_jobs_together_equal_jobs_one_by_one(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = settings(weights)
    images = [cv2.imencode(".png", image.pixels)[1].tobytes() for image in keyframes(4)]
    blob = BlobRef("0" * 64, 1, "image/png")
    taken = [Keyframe("front", 0, i, i * 10**8, MotionState.LINEAR, 320, 200, blob) for i in range(4)]
    requests: list[tuple[PredictTask, list[bytes], bytes | None, InferenceConfig]] = []
    for index, part in enumerate((slice(0, 2), slice(2, 4), slice(0, 3))):
        spec = SubmapSpec(2 * index, 1, (), tuple(keyframe.keyframe_id for keyframe in taken[part]))
        requests.append((PredictTask(spec, tuple(taken[part])), images[part], None, config))
    assert task.load_predictor(config) == ("predictor vggt: chosen by the configuration", 1), "a CPU takes one"
    together = task.predict_submaps(requests)
    damaged = task.predict_submaps([requests[0], (requests[1][0], [images[2], b"no image"], None, config)])
    for outcome, request in zip([*together, damaged[0]], [*requests, requests[0]], strict=True):
        assert not isinstance(outcome, str)
        geometry, blobs = outcome
        alone, its_blobs = task.predict_submap(*request)
        assert geometry.spec == alone.spec and geometry.verdict is SubmapVerdict.GOOD
        for mine, other in zip(blobs, its_blobs, strict=True):
            np.testing.assert_allclose(codec.decode_depth(mine)[0], codec.decode_depth(other)[0], rtol=2e-3)
    assert damaged[1] == "keyframe front/0/00000003 is not a whole JPEG or PNG image"
    task._predictor_of.cache_clear()


class TestAgainstReference:
    def test_cameras(self) -> None:
        expected = np.load(fixture_dir("vggt") / "small_expected.npz")
        encodings = expected["pose_enc"].astype(np.float64)
        height, width = expected["depth"].shape[1:]
        np.testing.assert_allclose(
            module.pinhole_matrices(encodings, width, height), expected["intrinsic"], rtol=1e-4, atol=1e-4
        )
        for pose, camera_from_world in zip(
            module.submap_from_camera(encodings), expected["extrinsic_w2c"], strict=True
        ):
            np.testing.assert_allclose(se3.inverse(pose)[:3], camera_from_world, rtol=1e-4, atol=1e-4)

    def test_images_equal_pillows_bicubic(self, sample_dir: Path) -> None:
        image_module = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
        file = next(iter(sorted((sample_dir / "kitti_06_first51").rglob("*.jpg"))))
        with image_module.open(file) as opened:
            image = opened.convert("RGB")
        pixels = np.asarray(image)
        lattice = fit_width(image.width, image.height, 518, 14)
        expected = np.asarray(image.resize((lattice.width_px, lattice.height_px), image_module.Resampling.BICUBIC))
        found = module.network_images([KeyframeImage("a", 0, pixels)], lattice)[0].permute(1, 2, 0).numpy()
        assert found.shape == expected.shape
        difference = np.abs(found.astype(int) - expected.astype(int))
        assert difference.max() <= 1
        assert difference.mean() < 0.05


class TestConversions:
    def test_camera_from_world_is_inverted(self) -> None:
        turn = math.radians(30)
        encoding = np.array([[1.0, 2.0, 3.0, 0.0, 2 * math.sin(turn / 2), 0.0, 2 * math.cos(turn / 2), 1.0, 1.0]])
        pose = module.submap_from_camera(encoding)[0]
        rotation = se3.so3_exp(np.array([0.0, turn, 0.0]))
        np.testing.assert_allclose(pose[:3, :3], rotation.T, atol=1e-12)
        np.testing.assert_allclose(pose[:3, 3], -rotation.T @ [1.0, 2.0, 3.0], atol=1e-12)

    def test_a_right_angle_sees_half_the_width(self) -> None:
        encoding = np.array([[0, 0, 0, 0, 0, 0, 1, math.pi / 2, math.pi / 2]])
        matrix = module.pinhole_matrices(encoding, 518, 154)[0]
        np.testing.assert_allclose(matrix, [[259, 0, 259], [0, 77, 77], [0, 0, 1]])

    def test_confidence_is_the_logistic_function(self) -> None:
        x = np.array([-80.0, -3.0, 0.0, 2.5, 80.0], dtype=np.float32)
        found: npt.NDArray[np.float32] = module.unit_confidence((1 + np.exp(x)).astype(np.float32))
        np.testing.assert_allclose(found, 1 / (1 + np.exp(-x.astype(np.float64))), atol=1e-6)
        assert ((found >= 0) & (found <= 1)).all()

    def test_a_zero_quaternion_is_not_a_rotation(self) -> None:
        assert np.isnan(module.submap_from_camera(np.zeros((1, 9)))).all()


class TestDevice:
    def test_cpu_is_float32_unless_asked(self) -> None:
        cpu = devices.resolve_device("cpu")
        assert devices.resolve_dtype("auto", cpu) == torch.float32
        assert devices.resolve_dtype("bfloat16", cpu) == torch.bfloat16

    def test_absent_devices_are_named(self) -> None:
        if not torch.cuda.is_available():
            with pytest.raises(ConfigurationError, match="sees 0 CUDA devices"):
                devices.resolve_device("cuda")
        with pytest.raises(ConfigurationError, match=r"cuda:99"):
            devices.resolve_device("cuda:99")
        assert devices.accelerator_name("cuda:99") is None
        assert devices.accelerator_name("cpu") is None


class TestAuto:
    def test_a_named_predictor_is_kept(self) -> None:
        assert choose_predictor(InferenceConfig(predictor="sfm")) == ("sfm", "chosen by the configuration")
        assert "auto" in predictor_names()

    def test_without_torch(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        name, reason = choose_predictor(InferenceConfig(predictor="auto"))
        assert name == "sfm"
        assert "PyTorch is not installed" in reason

    def test_without_weights(self) -> None:
        config = InferenceConfig(predictor="auto", vggt=VggtConfig(model="nobody/has-these"))
        name, reason = choose_predictor(config)
        assert name == "sfm"
        assert "nobody/has-these" in reason
        name, reason = choose_predictor(InferenceConfig(predictor="auto", vggt=VggtConfig(model="gone.pt")))
        assert name == "sfm"
        assert "gone.pt" in reason

    def test_without_accelerator(self, weights: Path) -> None:
        name, reason = choose_predictor(settings(weights).model_copy(update={"predictor": "auto"}))
        assert name == "sfm"
        assert "no accelerator" in reason

    def test_with_everything(self, weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(devices, "accelerator_name", lambda name: "A Large GPU")
        config = settings(weights).model_copy(update={"predictor": "auto"})
        name, reason = choose_predictor(config)
        assert name == "vggt"
        assert "A Large GPU" in reason
        assert isinstance(create_predictor("auto", config), module.VggtPredictor)


class TestWhatIsMissingIsSaid:
    def test_torch(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        with pytest.raises(MissingDependencyError, match=r"pip install 'vggt-motion\[torch\]'"):
            create_predictor("vggt", InferenceConfig(predictor="vggt"))

    def test_weights(self) -> None:
        with pytest.raises(InputError, match=r"no VGGT weights at 'gone.pt'; weights: https"):
            create_predictor("vggt", InferenceConfig(predictor="vggt", vggt=VggtConfig(model="gone.pt")))

    def test_weights_of_something_else(self, tmp_path: Path) -> None:
        torch.save({"layer.weight": torch.zeros(3)}, tmp_path / "other.pt")
        with pytest.raises(InputError, match=r"other.pt: not a VGGT checkpoint: .*; weights: https"):
            create_predictor("vggt", settings(tmp_path / "other.pt"))
        (tmp_path / "text.pt").write_text("hello\n")
        with pytest.raises(InputError, match=r"text.pt: it is damaged, incomplete or no checkpoint"):
            create_predictor("vggt", settings(tmp_path / "text.pt"))

    def test_unknown_name(self) -> None:
        with pytest.raises(ConfigurationError, match=r"unknown predictor 'magic': known are sfm, vggt, .*auto"):
            create_predictor("magic", InferenceConfig())

    def test_nothing_else_imports_torch(self) -> None:
        code = (
            "import sys; import vggt_motion.inference.vggt, vggt_motion.inference.registry as p; "
            "from vggt_motion.config import InferenceConfig; p.choose_predictor(InferenceConfig(predictor='auto')); "
            "import vggt_motion.inference.sky; assert 'torch' not in sys.modules, 'torch was imported'"
        )
        subprocess.run([sys.executable, "-c", code], check=True)


def test_vggt_is_lazy() -> None:
    assert vggt.availability(VggtConfig(model="nobody/has-these"))[0] is False
