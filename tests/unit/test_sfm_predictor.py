"""The predictor as its callers see it, on the repository's real excerpt and on input that cannot be solved."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from vggt_motion.config import InferenceConfig
from vggt_motion.errors import MissingDependencyError
from vggt_motion.inference.predictor import KeyframeImage, Prediction, PredictionHints
from vggt_motion.inference.registry import create_predictor
from vggt_motion.inference.sfm import library
from vggt_motion.records import SubmapVerdict


def keyframes(images: list[npt.NDArray[np.uint8]]) -> list[KeyframeImage]:
    return [KeyframeImage(f"front/0/{index:08d}", index * 100_000_000, image) for index, image in enumerate(images)]


def predict(images: list[npt.NDArray[np.uint8]], **hints: object) -> Prediction:
    return create_predictor("sfm", InferenceConfig()).predict(keyframes(images), PredictionHints(**hints))  # type: ignore[arg-type]


def noise(seed: int, height: int = 120, width: int = 320) -> npt.NDArray[np.uint8]:
    values = np.random.default_rng(seed).integers(0, 255, (height // 4, width // 4, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def test_identical_images_are_a_camera_that_did_not_move() -> None:
    prediction = predict([noise(0)] * 4)
    assert prediction.verdict is SubmapVerdict.ROTATION_ONLY
    assert [frame.position for frame in prediction.frames] == [0, 1, 2, 3]
    for frame in prediction.frames:
        np.testing.assert_allclose(frame.submap_from_camera, np.eye(4), atol=1e-9)
        assert not frame.confidence.any()


def test_a_stop_alone_gives_one_pose_to_both_ends() -> None:
    prediction = predict([noise(0), noise(0)], zero_motion_copies={1: 0})
    assert prediction.verdict is SubmapVerdict.ROTATION_ONLY
    assert len(prediction.frames) == 2


@pytest.mark.parametrize(
    "images",
    [
        [],
        [noise(0)],
        [np.zeros((120, 320, 3), np.uint8)] * 3,
        [noise(seed) for seed in range(3)],
        [noise(0, 8, 8)] * 3,
        [noise(0), noise(0, 120, 300)],
    ],
    ids=["none", "one", "black", "unrelated", "tiny", "sizes"],
)
def test_input_without_geometry_fails_with_a_reason(images: list[npt.NDArray[np.uint8]]) -> None:
    prediction = predict(images)
    assert prediction.verdict is SubmapVerdict.FAILED
    assert prediction.reason and "\n" not in prediction.reason
    assert prediction.frames == ()


def test_missing_pycolmap_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MissingDependencyError, match=r"pycolmap.*ARM"):
        library.load_pycolmap()
