"""The registry of predictors: names of the configuration, the choice of ``auto``, and how each is built."""

from __future__ import annotations

import importlib

from vggt_motion.config import InferenceConfig
from vggt_motion.errors import ConfigurationError
from vggt_motion.inference.predictor import Predictor

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
# The networks have no input for a focal length. "auto" may be "sfm" on the machine of one worker or another.
_TAKING_FOCAL_HINTS = frozenset({"sfm", "recorded", AUTO})


def predictor_names() -> tuple[str, ...]:
    """Names that the configuration accepts for ``inference.predictor``."""
    return (*_REGISTRY, AUTO)


def takes_focal_hints(name: str) -> bool:
    """Whether a predictor of that name makes use of what is known of the focal length."""
    return name in _TAKING_FOCAL_HINTS


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
