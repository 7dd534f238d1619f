"""Sky: pixels without a surface, kept out of depth and confidence (DESIGN 3.4).

The segmenter is the one that the peers use, ``skyseg.onnx``, a U-2-Net (Qin et al., 2020), run through onnxruntime; the
user brings the file. Without one nothing is masked. Predictors that see sky themselves mask it themselves.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.config import SkyConfig
from vggt_motion.errors import InputError, MissingDependencyError, PredictionError
from vggt_motion.inference.predictor import (
    BatchPredictor,
    KeyframeImage,
    PredictedFrame,
    Prediction,
    PredictionHints,
    Predictor,
)

_SIDE_PX = 320
_IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], dtype=np.float32)
_IMAGENET_DEVIATION = np.array([0.229, 0.224, 0.225], dtype=np.float32)
_PROBABILITY_SLACK = 1e-3


class SkySegmenter(Protocol):
    """Finds sky."""

    def sky(self, pixels: npt.NDArray[np.uint8], width_px: int, height_px: int) -> npt.NDArray[np.bool_]:
        """Sky mask (height_px, width_px) of an RGB image (H, W, 3), True where there is no surface."""
        ...


class NoSky:
    """Sees no sky anywhere."""

    def sky(self, pixels: npt.NDArray[np.uint8], width_px: int, height_px: int) -> npt.NDArray[np.bool_]:
        """All False."""
        return np.zeros((height_px, width_px), dtype=np.bool_)


class OnnxSky:
    """The peers' segmenter."""

    def __init__(self, file: Path, threshold: float, min_peak: float) -> None:
        """Load the network.

        Raises:
            InputError: no such file, or it is not the segmenter.
            MissingDependencyError: onnxruntime is absent.
        """
        if not file.is_file():
            raise InputError(f"no sky model at {file}: inference.sky.model must name a skyseg.onnx file")
        if importlib.util.find_spec("onnxruntime") is None:
            raise MissingDependencyError("inference.sky.model needs onnxruntime: pip install 'vggt-motion[sky]'")
        runtime = importlib.import_module("onnxruntime")
        try:
            self._session: Any = runtime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
        # The runtime's exceptions come from compiled code and share no root.
        except Exception as error:
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise InputError(f"cannot read sky model {file.name}: {reason}") from error
        inputs = self._session.get_inputs()
        if len(inputs) != 1 or len(inputs[0].shape) != 4:
            raise InputError(f"sky model {file.name} does not take one image (1, 3, {_SIDE_PX}, {_SIDE_PX})")
        self._input = inputs[0].name
        self._name = file.name
        self._threshold = threshold
        self._min_peak = min_peak

    def sky(self, pixels: npt.NDArray[np.uint8], width_px: int, height_px: int) -> npt.NDArray[np.bool_]:
        """See :class:`SkySegmenter`.

        Raises:
            PredictionError: the network does not return a probability map.
        """
        small = cv2.resize(pixels, (_SIDE_PX, _SIDE_PX), interpolation=cv2.INTER_LINEAR).astype(np.float32) / 255.0
        batch = ((small - _IMAGENET_MEAN) / _IMAGENET_DEVIATION).transpose(2, 0, 1)[None].astype(np.float32)
        try:
            raw = np.asarray(self._session.run(None, {self._input: batch})[0], dtype=np.float32).squeeze()
        except Exception as error:
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise PredictionError(f"sky model {self._name} failed: {reason}") from error
        if raw.ndim != 2 or not (raw.min() >= -_PROBABILITY_SLACK and raw.max() <= 1.0 + _PROBABILITY_SLACK):
            raise PredictionError(f"sky model {self._name} does not return one probability map")
        resized = cv2.resize(raw, (width_px, height_px), interpolation=cv2.INTER_LINEAR)
        return sky_from_probability(np.asarray(resized, dtype=np.float32), self._threshold, self._min_peak)


def sky_from_probability(
    probability: npt.NDArray[np.float32], threshold: float = 32 / 255, min_peak: float = 0.5
) -> npt.NDArray[np.bool_]:
    """Sky mask from the segmenter's raw map (H, W) in [0, 1].

    The peers stretch each map to its own minimum and maximum and take everything from 32 of 255 up. Where there is sky
    the stretch changes little. Where there is none it blows noise up to sky, so a frame whose peak stays below
    ``min_peak`` has none; and one that is sky all over has no minimum to stretch from.
    """
    low, high = float(probability.min()), float(probability.max())
    if high < min_peak:
        return np.zeros(probability.shape, dtype=np.bool_)
    if low >= min_peak:
        return np.ones(probability.shape, dtype=np.bool_)
    return np.asarray((probability - low) / (high - low) >= threshold)


def create_segmenter(config: SkyConfig) -> SkySegmenter:
    """The segmenter that the configuration names, or the one that sees no sky."""
    return NoSky() if config.model is None else OnnxSky(config.model, config.threshold, config.min_peak)


class SkyMasking:
    """A predictor whose results have no depth in the sky."""

    def __init__(self, predictor: Predictor, segmenter: SkySegmenter) -> None:
        """Wrap ``predictor``."""
        self.name = predictor.name
        self._predictor = predictor
        self._segmenter = segmenter
        self.batch_limit = predictor.batch_limit if isinstance(predictor, BatchPredictor) else 1

    def predict(self, images: Sequence[KeyframeImage], hints: PredictionHints) -> Prediction:
        """Predict and mask; see the contract."""
        return self._without_sky(self._predictor.predict(images, hints), images)

    def predict_many(
        self, requests: Sequence[tuple[Sequence[KeyframeImage], PredictionHints]]
    ) -> tuple[Prediction, ...]:
        """Predict and mask several submaps; see the contract."""
        if not isinstance(self._predictor, BatchPredictor):
            return tuple(self.predict(images, hints) for images, hints in requests)
        predictions = self._predictor.predict_many(requests)
        return tuple(
            self._without_sky(prediction, images) for prediction, (images, _) in zip(predictions, requests, strict=True)
        )

    def _without_sky(self, prediction: Prediction, images: Sequence[KeyframeImage]) -> Prediction:
        frames = tuple(self._masked(frame, images[frame.position]) for frame in prediction.frames)
        return replace(prediction, frames=frames)

    def _masked(self, frame: PredictedFrame, image: KeyframeImage) -> PredictedFrame:
        height, width = frame.depth.shape
        surface = ~self._segmenter.sky(image.pixels, width, height)
        return replace(frame, depth=frame.depth * surface, confidence=frame.confidence * surface)
