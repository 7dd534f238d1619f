"""The predictor contract (DESIGN 3.4) and the registry of predictors.

A predictor takes the keyframes of one submap and returns depth, confidence, intrinsics and poses, in whatever unit it
likes. It is pure: the same images and hints give the same result, bit for bit where it says so.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vggt_motion.config import InferenceConfig
from vggt_motion.errors import ConfigurationError
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


# name -> "module:factory"; a factory takes the ``inference`` section of the configuration. Modules are imported only
# when chosen.
_REGISTRY: dict[str, str] = {
    "sfm": "vggt_motion.inference.sfm.predictor:create",
    "vggt": "vggt_motion.inference.vggt:create",
    "pi3": "vggt_motion.inference.pi3:create",
    "pi3x": "vggt_motion.inference.pi3:create_x",
    "depth_anything_3": "vggt_motion.inference.depth_anything:create",
    "map_anything": "vggt_motion.inference.map_anything:create",
    "recorded": "vggt_motion.inference.recorded:create",
}
AUTO = "auto"


def predictor_names() -> tuple[str, ...]:
    """Names that the configuration accepts for ``inference.predictor``."""
    return (*_REGISTRY, AUTO)


def choose_predictor(config: InferenceConfig) -> tuple[str, str]:
    """The predictor that ``inference.predictor`` means on this machine, and why, in one line.

    ``auto`` is ``vggt`` where torch, an accelerator and the weights are there, else ``sfm``. Nothing is downloaded.
    Whoever starts a run decides once and writes the name into its configuration, so that all workers offer the same.
    """
    if config.predictor != AUTO:
        return config.predictor, "chosen by the configuration"
    availability = importlib.import_module("vggt_motion.inference.vggt").availability
    is_there, reason = availability(config.vggt)
    return ("vggt", reason) if is_there else ("sfm", f"no vggt here: {reason}")


def create_predictor(name: str, config: InferenceConfig) -> Predictor:
    """Build a predictor by name, ``auto`` included; with a sky model configured its results have no depth in the sky.

    Raises:
        ConfigurationError: the name is unknown.
        MissingDependencyError: the predictor's packages or weights are absent; the message says what to install.
    """
    if name == AUTO:
        name, _ = choose_predictor(config.model_copy(update={"predictor": AUTO}))
    if name not in _REGISTRY:
        raise ConfigurationError(f"unknown predictor '{name}': known are {', '.join(predictor_names())}")
    module_name, factory = _REGISTRY[name].split(":")
    predictor: Predictor = getattr(importlib.import_module(module_name), factory)(config)
    if config.sky.model is not None:
        sky = importlib.import_module("vggt_motion.inference.sky")
        predictor = sky.SkyMasking(predictor, sky.create_segmenter(config.sky))
    return predictor
