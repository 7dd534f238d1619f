"""Runs Pi3 or Pi3X (Wang et al., 2025) in an environment that has its package. Needs numpy and torch besides."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any


def load(options: dict[str, str]) -> Callable[[Any], dict[str, Any]]:
    """The network of ``options["model"]`` on ``options["device"]``; ``options["variant"]`` is ``pi3`` or ``pi3x``."""
    import numpy as np
    import torch

    variant = options["variant"]
    module = importlib.import_module(f"pi3.models.{variant}")
    network = getattr(module, "Pi3X" if variant == "pi3x" else "Pi3").from_pretrained(options["model"])
    if hasattr(network, "disable_multimodal"):
        network.disable_multimodal()  # conditions that we do not give
    device = torch.device(options["device"])
    network = network.to(device).eval()
    is_cuda = device.type == "cuda"
    dtype = torch.bfloat16 if is_cuda and torch.cuda.get_device_capability(device)[0] >= 8 else torch.float16

    def predict(images: Any) -> dict[str, Any]:
        batch = torch.from_numpy(images).permute(0, 3, 1, 2)[None].to(device).float() / 255.0
        with torch.no_grad(), torch.autocast(device.type, dtype=dtype, enabled=is_cuda):
            result = network(batch)
        arrays = {name: result[name][0].float().cpu().numpy() for name in ("local_points", "camera_poses", "conf")}
        return {name: np.asarray(array) for name, array in arrays.items()}

    return predict
