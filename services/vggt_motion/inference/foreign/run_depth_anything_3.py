"""Runs Depth Anything 3 (Lin et al., 2025) in an environment that has its package. Standard library and numpy only."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any


def load(options: dict[str, str]) -> Callable[[Any], dict[str, Any]]:
    """The network of ``options["model"]`` on ``options["device"]``."""
    import numpy as np

    api = importlib.import_module("depth_anything_3.api")
    network = api.DepthAnything3.from_pretrained(options["model"]).to(options["device"]).eval()

    def predict(images: Any) -> dict[str, Any]:
        result = network.inference(list(images))
        arrays = {"depth": np.asarray(result.depth, dtype=np.float32)}
        arrays["is_metric"] = np.asarray([bool(result.is_metric)])
        for name, dtype in (("conf", "float32"), ("extrinsics", "float64"), ("intrinsics", "float64"), ("sky", "bool")):
            value = getattr(result, name, None)
            if value is not None:
                arrays[name] = np.asarray(value, dtype=dtype)
        return arrays

    return predict
