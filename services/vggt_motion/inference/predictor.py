"""The predictor contract (DESIGN 3.4).

A predictor takes the keyframes of one submap and returns depth, confidence, intrinsics and poses, in whatever unit it
likes. It is pure: the same images and hints give the same result, bit for bit where it says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.records import FocalHint, ScaleKind, SubmapQuality, SubmapVerdict


@dataclass(frozen=True)
class KeyframeImage:
    """One decoded keyframe."""

    keyframe_id: str
    capture_time_ns: int
    pixels: npt.NDArray[np.uint8]  # (H, W, 3) RGB; a grey source has three equal channels


@dataclass(frozen=True)
class PredictionHints:
    """What is known beside the images."""

    focal: FocalHint | None = None
    ego_mask: npt.NDArray[np.bool_] | None = None  # (H, W), True = never use this pixel
    zero_motion_copies: Mapping[int, int] = field(default_factory=dict)  # position of copy -> position of original
    loop_positions: frozenset[int] = frozenset()  # positions of injected loop keyframes, far apart in time


@dataclass(frozen=True)
class PredictedFrame:
    """Geometry of one keyframe.

    ``depth`` (H, W) float32 along the optical axis, submap units, 0 where unknown; ``confidence`` (H, W) float32 in
    [0, 1], 0 where depth is unknown; ``intrinsics`` of that (H, W) lattice, which covers the whole image;
    ``submap_from_camera`` (4, 4) float64.
    """

    position: int  # in the sequence of images
    depth: npt.NDArray[np.float32]
    confidence: npt.NDArray[np.float32]
    intrinsics: Intrinsics
    submap_from_camera: npt.NDArray[np.float64]


@dataclass(frozen=True)
class Prediction:
    """Geometry of one submap; ``frames`` holds the registered frames only, in order of position."""

    frames: tuple[PredictedFrame, ...]
    verdict: SubmapVerdict
    reason: str  # one line; empty when good
    scale_kind: ScaleKind
    model: str
    quality: SubmapQuality
    stage_seconds: dict[str, float]


class Predictor(Protocol):
    """What every predictor offers."""

    name: str

    def predict(self, images: Sequence[KeyframeImage], hints: PredictionHints) -> Prediction:
        """Predict one submap.

        Never raises for hard input: a submap that cannot be solved comes back with verdict FAILED or ROTATION_ONLY and
        a reason.
        """
        ...


@runtime_checkable
class BatchPredictor(Predictor, Protocol):
    """A predictor that is faster on several submaps at a time, as a large GPU is."""

    batch_limit: int  # submaps that are worth predicting together at most; 1 = none

    def predict_many(
        self, requests: Sequence[tuple[Sequence[KeyframeImage], PredictionHints]]
    ) -> tuple[Prediction, ...]:
        """Predict several submaps; each result is that of :meth:`predict` up to rounding."""
        ...
