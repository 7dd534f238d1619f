"""The predictors ``pi3`` and ``pi3x`` (Wang et al., 2025: pi-cubed), run from the user's own copy of their package.

They return points in each camera's frame, camera-to-world poses and confidence as a logit. Both are taken as relative:
Pi3X knows metres only approximately, and what differs from submap to submap must stay free in the registration.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

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
_MAX_PIXELS = 255_000  # the network's own limit
_INSTALL = (
    "in an environment of its own: pip install git+https://github.com/yyfz/Pi3 (weights CC BY-NC 4.0 or BSD, see "
    "https://huggingface.co/yyfz233), then name its interpreter in inference.{name}.python"
)


def create(config: InferenceConfig) -> Predictor:
    """The predictor ``pi3``.

    Raises:
        MissingDependencyError: the package is not in the environment named by ``inference.pi3.python``.
        InputError: its weights cannot be loaded.
    """
    process = ForeignProcess("pi3", "run_pi3.py", config.pi3, _INSTALL.format(name="pi3"), variant="pi3")
    return ForeignPredictor("pi3", f"pi3 {config.pi3.model}", process, _lattice, to_prediction)


def create_x(config: InferenceConfig) -> Predictor:
    """The predictor ``pi3x``; raises as :func:`create`."""
    process = ForeignProcess("pi3x", "run_pi3.py", config.pi3x, _INSTALL.format(name="pi3x"), variant="pi3x")
    return ForeignPredictor("pi3x", f"pi3x {config.pi3x.model}", process, _lattice, to_prediction)


def to_prediction(
    lattice: Lattice, hints: PredictionHints, arrays: Arrays, label: str, stage_seconds: dict[str, float]
) -> Prediction:
    """Normalise the network's outputs.

    Args:
        lattice: of the images that it saw.
        hints: of the submap.
        arrays: ``local_points`` (S, h, w, 3) in each camera's frame, ``camera_poses`` (S, 4, 4) world_from_camera,
            ``conf`` (S, h, w, 1) logits.
        label: model name.
        stage_seconds: time per part.

    Raises:
        MissingOutputError: an array is absent or of another form.
    """
    points = array_of(arrays, "local_points", 4)
    poses = array_of(arrays, "camera_poses", 3)
    logits = array_of(arrays, "conf", 4)[..., 0]
    if not len(points) == len(poses) == len(logits) or points.shape[:3] != logits.shape:
        raise MissingOutputError(f"the network returned {points.shape} points for {logits.shape} confidences")
    confidence = _logistic(logits)
    depth = points[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        rays = points[..., :2] / np.where(depth > 0, depth, np.nan)[..., None]
    pinhole = np.stack([fit_pinhole(*pair) for pair in zip(rays, confidence, strict=True)])
    return lattices.assemble(
        lattice,
        hints,
        depth,
        confidence,
        pinhole,
        poses,
        scale_kind=ScaleKind.RELATIVE,
        model=label,
        stage_seconds=stage_seconds,
    )


def _lattice(width_px: int, height_px: int) -> Lattice:
    return lattices.fit_area(width_px, height_px, _MAX_PIXELS, _PATCH_PX)


def _logistic(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * x)))
