"""VGGT (Wang et al., CVPR 2025): our own implementation, for inference, in torch.

Importing this package does not import torch, an optional dependency; :func:`create` does, and :func:`availability` does
when weights are there.
"""

from __future__ import annotations

import importlib
import importlib.util

from vggt_motion.config import InferenceConfig, VggtConfig
from vggt_motion.errors import InputError, MissingDependencyError
from vggt_motion.inference.predictor import Predictor
from vggt_motion.inference.vggt.weights import find_weights

_INSTALL = "pip install 'vggt-motion[torch]'"


def create(config: InferenceConfig) -> Predictor:
    """The predictor ``vggt``.

    Raises:
        MissingDependencyError: torch is absent.
        InputError: the weights are absent or of another architecture, or the device does not exist.
    """
    if importlib.util.find_spec("torch") is None:
        raise MissingDependencyError(f"predictor 'vggt' needs PyTorch: {_INSTALL}")
    module = importlib.import_module("vggt_motion.inference.vggt.predictor")
    predictor: Predictor = module.load(config.vggt)
    return predictor


def availability(config: VggtConfig) -> tuple[bool, str]:
    """Whether VGGT would run here at a useful speed without downloading anything, and what there is or is not.

    Cheap reasons come first, so that a machine without torch or weights does not wait for an import.
    """
    if importlib.util.find_spec("torch") is None:
        return False, f"PyTorch is not installed ({_INSTALL})"
    try:
        weights = find_weights(config.model)
    except InputError as error:
        return False, str(error)
    if weights is None:
        return False, f"weights '{config.model}' are not on this machine"
    accelerator: str | None = importlib.import_module("vggt_motion.inference.vggt.device").accelerator_name(
        config.device
    )
    if accelerator is None:
        return False, "PyTorch sees no accelerator"
    return True, f"{accelerator} and weights '{config.model}' are there"
