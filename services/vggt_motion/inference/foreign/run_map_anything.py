"""Runs MapAnything (Keetha et al., 2025) in an environment that has its package. Needs numpy and torch besides."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

_MEAN = (0.485, 0.456, 0.406)
_DEVIATION = (0.229, 0.224, 0.225)
_OUTPUTS = ("depth_z", "ray_directions", "camera_poses", "conf", "mask")


def load(options: dict[str, str]) -> Callable[[Any], dict[str, Any]]:
    """The network of ``options["model"]`` on ``options["device"]``."""
    import numpy as np
    import torch

    models = importlib.import_module("mapanything.models")
    network = models.MapAnything.from_pretrained(options["model"]).to(options["device"]).eval()
    normalisation = getattr(getattr(network, "encoder", None), "data_norm_type", "dinov2")
    mean, deviation = (torch.tensor(values).view(3, 1, 1) for values in (_MEAN, _DEVIATION))

    def predict(images: Any) -> dict[str, Any]:
        batch = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255.0
        views = [
            {"img": ((image - mean) / deviation)[None].to(options["device"]), "data_norm_type": [normalisation]}
            for image in batch
        ]
        results = network.infer(
            views, memory_efficient_inference=True, use_amp=options["device"] != "cpu", apply_mask=True, mask_edges=True
        )
        arrays = {}
        for name in _OUTPUTS:
            if all(name in result for result in results):
                arrays[name] = np.stack([result[name][0].detach().float().cpu().numpy() for result in results])
        return arrays

    return predict
