"""Sky: the mask from a probability map, the segmenter through onnxruntime, and what it does to a prediction."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vggt_motion.config import InferenceConfig, SkyConfig
from vggt_motion.errors import InputError, MissingDependencyError, PredictionError
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.inference import registry
from vggt_motion.inference.predictor import KeyframeImage, PredictedFrame, Prediction, PredictionHints
from vggt_motion.inference.sky import NoSky, OnnxSky, SkyMasking, create_segmenter, sky_from_probability
from vggt_motion.records import ScaleKind, SubmapQuality, SubmapVerdict

_IMAGENET_MEAN = np.array([0.485, 0.456, 0.406])
_IMAGENET_DEVIATION = np.array([0.229, 0.224, 0.225])


def field(number: int, value: int | bytes | str) -> bytes:
    """One field of a protobuf message."""

    def varint(count: int) -> bytes:
        head = b""
        while count > 127:
            head += bytes([count & 127 | 128])
            count >>= 7
        return head + bytes([count])

    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


def onnx_model(weight: Sequence[float], bias: float, *, activation: str = "Sigmoid", side: int = 320) -> bytes:
    """A network of one 1x1 convolution and an activation, in the format of ONNX (onnx.proto3), written by hand."""

    def tensor(name: str, values: npt.NDArray[np.float32]) -> bytes:
        return (
            b"".join(field(1, size) for size in values.shape)
            + field(2, 1)
            + field(8, name)
            + field(9, values.tobytes())
        )

    def value_info(name: str, channels: int) -> bytes:
        shape = b"".join(field(1, field(1, size)) for size in (1, channels, side, side))
        return field(1, name) + field(2, field(1, field(1, 1) + field(2, shape)))

    convolution = b"".join(field(1, name) for name in ("image", "weight", "bias")) + field(2, "raw") + field(4, "Conv")
    graph = (
        field(1, convolution)
        + field(1, field(1, "raw") + field(2, "sky") + field(4, activation))
        + field(2, "segmenter")
        + field(5, tensor("weight", np.array(weight, np.float32).reshape(1, 3, 1, 1)))
        + field(5, tensor("bias", np.array([bias], np.float32)))
        + field(11, value_info("image", 3))
        + field(12, value_info("sky", 1))
    )
    return field(1, 8) + field(8, field(2, 13)) + field(7, graph)


@pytest.fixture
def blue_is_sky(tmp_path: Path) -> Path:
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed: pip install 'vggt-motion[sky]'")
    path = tmp_path / "skyseg.onnx"
    path.write_bytes(onnx_model([-4.0, 0.0, 4.0], -2.0))
    return path


def half_sky(height: int = 120, width: int = 200) -> npt.NDArray[np.uint8]:
    pixels = np.full((height, width, 3), (120, 110, 100), np.uint8)
    pixels[: height // 2] = (60, 140, 250)
    return pixels


class TestMask:
    def test_clear_sky_is_found(self) -> None:
        probability = np.full((10, 10), 0.02, np.float32)
        probability[:4] = 0.98
        mask = sky_from_probability(probability)
        assert mask[:4].all()
        assert not mask[4:].any()

    def test_noise_without_sky_is_not_stretched_to_sky(self) -> None:
        probability = np.random.default_rng(0).uniform(0.0, 0.05, (10, 10)).astype(np.float32)
        stretched = (probability - probability.min()) / (probability.max() - probability.min())
        assert (stretched >= 32 / 255).mean() > 0.5, "what the stretch alone would make of it"
        assert not sky_from_probability(probability).any()

    def test_sky_all_over(self) -> None:
        assert sky_from_probability(np.full((4, 4), 0.9, np.float32)).all()
        assert sky_from_probability(np.linspace(0.6, 1.0, 16, dtype=np.float32).reshape(4, 4)).all()

    def test_the_threshold_is_on_the_stretched_map(self) -> None:
        probability = np.array([[0.1, 0.1 + 0.8 * 31 / 255, 0.1 + 0.8 * 33 / 255, 0.9]], np.float32)
        assert sky_from_probability(probability).tolist() == [[False, False, True, True]]

    @given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
    def test_more_probable_is_never_less_sky(self, seed: int, low: float, high: float) -> None:
        low, high = sorted((low, high))
        probability = np.random.default_rng(seed).uniform(low, high, (5, 7)).astype(np.float32)
        mask = sky_from_probability(probability)
        if mask.any() and not mask.all():
            assert probability[mask].min() > probability[~mask].max()


class TestSegmenter:
    def test_finds_the_blue_half_on_another_lattice(self, blue_is_sky: Path) -> None:
        mask = OnnxSky(blue_is_sky, 32 / 255, 0.5).sky(half_sky(), 50, 40)
        assert mask.shape == (40, 50)
        assert mask[:19].all()
        assert not mask[21:].any()

    def test_input_is_normalised_as_the_peers_do(self, tmp_path: Path, blue_is_sky: Path) -> None:
        colour = np.array([200, 100, 50])
        normalised = (colour / 255 - _IMAGENET_MEAN) / _IMAGENET_DEVIATION
        # A network that answers 0.5 exactly where the three normalised channels sum to what they should.
        path = tmp_path / "probe.onnx"
        path.write_bytes(onnx_model([1.0, 1.0, 1.0], -float(normalised.sum())))
        pixels = np.full((30, 30, 3), colour, np.uint8)
        assert OnnxSky(path, 0.5, 0.4999).sky(pixels, 8, 8).any()
        assert not OnnxSky(path, 0.5, 0.5001).sky(pixels, 8, 8).any()

    def test_grey_image_has_no_sky(self, blue_is_sky: Path) -> None:
        pixels = np.random.default_rng(1).integers(0, 256, (120, 200, 1), np.uint8).repeat(3, axis=2)
        assert not OnnxSky(blue_is_sky, 32 / 255, 0.5).sky(pixels, 50, 40).any()

    def test_a_network_that_returns_no_probability(self, tmp_path: Path, blue_is_sky: Path) -> None:
        path = tmp_path / "logits.onnx"
        path.write_bytes(onnx_model([-4.0, 0.0, 4.0], -2.0, activation="Identity"))
        with pytest.raises(PredictionError, match=r"logits.onnx does not return one probability map"):
            OnnxSky(path, 32 / 255, 0.5).sky(half_sky(), 50, 40)

    def test_a_network_of_another_size(self, tmp_path: Path, blue_is_sky: Path) -> None:
        path = tmp_path / "large.onnx"
        path.write_bytes(onnx_model([-4.0, 0.0, 4.0], -2.0, side=640))
        with pytest.raises(PredictionError, match=r"large.onnx failed"):
            OnnxSky(path, 32 / 255, 0.5).sky(half_sky(), 50, 40)

    def test_what_is_missing_is_said(self, tmp_path: Path, blue_is_sky: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        with pytest.raises(InputError, match=r"no sky model at .*gone.onnx"):
            create_segmenter(SkyConfig(model=tmp_path / "gone.onnx"))
        damaged = tmp_path / "damaged.onnx"
        damaged.write_bytes(b"not a network")
        with pytest.raises(InputError, match=r"cannot read sky model damaged.onnx") as caught:
            create_segmenter(SkyConfig(model=damaged))
        assert "\n" not in str(caught.value)
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        with pytest.raises(MissingDependencyError, match=r"pip install 'vggt-motion\[sky\]'"):
            create_segmenter(SkyConfig(model=blue_is_sky))

    def test_none_is_the_default(self) -> None:
        segmenter = create_segmenter(SkyConfig())
        assert isinstance(segmenter, NoSky)
        mask = segmenter.sky(half_sky(), 50, 40)
        assert mask.shape == (40, 50)
        assert not mask.any()


class Flat:
    """A predictor that sees depth 3 everywhere."""

    name = "flat"

    def predict(self, images: Sequence[KeyframeImage], hints: PredictionHints) -> Prediction:
        ones = np.ones((40, 50), np.float32)
        frames = tuple(
            PredictedFrame(position, 3 * ones, ones, Intrinsics.centred(40.0, 50, 40), np.eye(4))
            for position in range(1, len(images))  # the first is not registered
        )
        nan = float("nan")
        quality = SubmapQuality(len(frames), nan, nan, nan, 0.8, nan)
        return Prediction(frames, SubmapVerdict.GOOD, "", ScaleKind.RELATIVE, "flat", quality, {})


def test_a_masked_prediction_has_no_depth_in_the_sky(blue_is_sky: Path) -> None:
    images = [KeyframeImage("a", 0, half_sky()[::-1]), KeyframeImage("b", 1, half_sky())]
    masked = SkyMasking(Flat(), OnnxSky(blue_is_sky, 32 / 255, 0.5)).predict(images, PredictionHints())
    (frame,) = masked.frames
    assert not frame.depth[:19].any()
    assert not frame.confidence[:19].any()
    assert (frame.depth[21:] == 3).all()
    assert frame.depth.dtype == frame.confidence.dtype == np.float32


def test_the_configuration_wraps_any_predictor(blue_is_sky: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry._REGISTRY, "flat", f"{__name__}:create_flat")
    assert isinstance(registry.create_predictor("flat", InferenceConfig()), Flat)
    wrapped = registry.create_predictor("flat", InferenceConfig(sky=SkyConfig(model=blue_is_sky)))
    assert isinstance(wrapped, SkyMasking)
    assert wrapped.name == "flat"


def create_flat(config: InferenceConfig) -> Flat:
    return Flat()
