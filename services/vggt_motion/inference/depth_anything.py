"""The predictor ``depth_anything_3`` (Lin et al., 2025), run from its PyPI package in an environment of its own.

The package pins numpy below 2, moviepy 1.0.3, xformers and more, which cannot be installed beside us. It returns depth,
world-to-camera poses, confidence above 1 and, from its nested models, metres and sky. To sky it gives the largest depth
and high confidence, so the sky has to be taken out here.
"""

from __future__ import annotations

import numpy as np

from vggt_motion.config import InferenceConfig
from vggt_motion.geometry import se3
from vggt_motion.inference import lattice as lattices
from vggt_motion.inference.foreign.process import (
    Arrays,
    ForeignPredictor,
    ForeignProcess,
    MissingOutputError,
    array_of,
)
from vggt_motion.inference.lattice import Lattice
from vggt_motion.inference.predictor import Prediction, PredictionHints, Predictor
from vggt_motion.records import ScaleKind

_INSTALL = (
    "its pins need an environment of its own: python -m venv da3 && da3/bin/pip install depth-anything-3, then "
    "inference.depth_anything_3.python=da3/bin/python (weights CC BY-NC 4.0 or Apache-2.0, see "
    "https://huggingface.co/depth-anything)"
)


def create(config: InferenceConfig) -> Predictor:
    """The predictor ``depth_anything_3``.

    Raises:
        MissingDependencyError: the package is not in the environment named by ``inference.depth_anything_3.python``.
        InputError: its weights cannot be loaded.
    """
    settings = config.depth_anything_3
    process = ForeignProcess("depth_anything_3", "run_depth_anything_3.py", settings, _INSTALL)
    # The package resizes the images itself and cuts nothing off.
    return ForeignPredictor(
        "depth_anything_3", f"depth_anything_3 {settings.model}", process, lambda width, height: None, to_prediction
    )


def to_prediction(
    lattice: Lattice, hints: PredictionHints, arrays: Arrays, label: str, stage_seconds: dict[str, float]
) -> Prediction:
    """Normalise the package's outputs.

    Args:
        lattice: of the depth maps.
        hints: of the submap.
        arrays: ``depth`` (S, h, w), ``extrinsics`` (S, 3, 4) or (S, 4, 4) camera_from_world, ``intrinsics`` (S, 3, 3)
            of the depth maps, ``is_metric`` (1,), and where the model has them ``conf`` (S, h, w) above 1 and ``sky``
            (S, h, w).
        label: model name.
        stage_seconds: time per part.

    Raises:
        MissingOutputError: an array is absent or of another form, as poses are from the monocular models.
    """
    depth = array_of(arrays, "depth", 3)
    cameras = array_of(arrays, "extrinsics", 3)
    pinhole = array_of(arrays, "intrinsics", 3)
    if cameras.shape[1:] not in ((3, 4), (4, 4)) or not len(depth) == len(cameras) == len(pinhole):
        raise MissingOutputError(f"the network returned {cameras.shape} extrinsics for {depth.shape} depths")
    confidence = np.ones_like(depth)
    if "conf" in arrays:
        with np.errstate(divide="ignore", invalid="ignore"):
            confidence = 1.0 - 1.0 / np.maximum(array_of(arrays, "conf", 3), 1.0)
    poses = np.stack([se3.inverse(camera) for camera in cameras])
    is_metric = bool(np.asarray(arrays.get("is_metric", np.zeros(1))).any())
    return lattices.assemble(
        lattice,
        hints,
        depth,
        confidence,
        pinhole,
        poses,
        scale_kind=ScaleKind.METRIC if is_metric else ScaleKind.RELATIVE,
        model=label,
        stage_seconds=stage_seconds,
        sky=np.asarray(arrays["sky"], dtype=np.bool_) if "sky" in arrays else None,
    )
