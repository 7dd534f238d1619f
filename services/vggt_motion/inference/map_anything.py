"""The predictor ``map_anything`` (Keetha et al., 2025), run from the user's own copy of its package.

It returns, per view, depth along the axis in metres, rays, camera-to-world poses, confidence above 1 and a validity
mask.
"""

from __future__ import annotations

import numpy as np

from vggt_motion.config import InferenceConfig
from vggt_motion.inference import lattice as lattices
from vggt_motion.inference.foreign.process import (
    Arrays,
    ForeignPredictor,
    ForeignProcess,
    MissingOutputError,
    array_of,
    fit_pinhole,
)
from vggt_motion.inference.lattice import Lattice
from vggt_motion.inference.predictor import Prediction, PredictionHints, Predictor
from vggt_motion.records import ScaleKind

_PATCH_PX = 14
_MAX_PIXELS = 518 * 518
_INSTALL = (
    "in an environment of its own: pip install git+https://github.com/facebookresearch/map-anything (weights "
    "Apache-2.0 or CC BY-NC 4.0, see https://huggingface.co/facebook/map-anything-apache), then name its interpreter "
    "in inference.map_anything.python"
)


def create(config: InferenceConfig) -> Predictor:
    """The predictor ``map_anything``.

    Raises:
        MissingDependencyError: the package is not in the environment named by ``inference.map_anything.python``.
        InputError: its weights cannot be loaded.
    """
    settings = config.map_anything
    process = ForeignProcess("map_anything", "run_map_anything.py", settings, _INSTALL)
    return ForeignPredictor("map_anything", f"map_anything {settings.model}", process, _lattice, to_prediction)


def to_prediction(
    lattice: Lattice, hints: PredictionHints, arrays: Arrays, label: str, stage_seconds: dict[str, float]
) -> Prediction:
    """Normalise the network's outputs.

    Intrinsics are fitted to its rays rather than taken from it, so that they hold on our pixel lattice by construction.

    Args:
        lattice: of the images that it saw.
        hints: of the submap.
        arrays: ``depth_z`` (S, h, w, 1) metres, ``ray_directions`` (S, h, w, 3), ``camera_poses`` (S, 4, 4)
            world_from_camera, ``conf`` (S, h, w) above 1, and if given ``mask`` (S, h, w, 1), not zero where valid.
        label: model name.
        stage_seconds: time per part.

    Raises:
        MissingOutputError: an array is absent or of another form.
    """
    depth = array_of(arrays, "depth_z", 4)[..., 0]
    directions = array_of(arrays, "ray_directions", 4)
    poses = array_of(arrays, "camera_poses", 3)
    raw_confidence = array_of(arrays, "conf", 3)
    if directions.shape[:3] != depth.shape or raw_confidence.shape != depth.shape or len(poses) != len(depth):
        raise MissingOutputError(f"the network returned {directions.shape} rays for {depth.shape} depths")
    with np.errstate(divide="ignore", invalid="ignore"):
        confidence = 1.0 - 1.0 / np.maximum(raw_confidence, 1.0)
        rays = directions[..., :2] / np.where(directions[..., 2:] > 0, directions[..., 2:], np.nan)
    if "mask" in arrays:
        depth = np.where(array_of(arrays, "mask", 4)[..., 0] > 0.5, depth, 0.0)
    pinhole = np.stack([fit_pinhole(ray, np.ones(ray.shape[:2])) for ray in rays])
    return lattices.assemble(
        lattice,
        hints,
        depth,
        confidence,
        pinhole,
        poses,
        scale_kind=ScaleKind.METRIC,
        model=label,
        stage_seconds=stage_seconds,
    )


def _lattice(width_px: int, height_px: int) -> Lattice:
    scale = min(1.0, (518 / max(width_px, height_px)) ** 2)
    return lattices.fit_area(width_px, height_px, min(_MAX_PIXELS, int(width_px * height_px * scale)), _PATCH_PX)
