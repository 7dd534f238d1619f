"""The camera that a user knows, as a hint: before any running estimate, and never refined (DESIGN 3.4)."""

from __future__ import annotations

from vggt_motion.config import InferenceConfig
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.records import FocalHint


def given_hint(config: InferenceConfig, width_px: int, height_px: int) -> FocalHint | None:
    """The hint of a configured camera for images of that size, None where nothing was given."""
    known = config.intrinsics
    if known is not None:
        fy = known.fy if known.fy is not None else known.fx
        camera = Intrinsics(known.fx, fy, known.cx, known.cy, width_px, height_px, known.k1)
        return FocalHint(known.fx / width_px, 0.0, known.k1, is_fixed=True, intrinsics=camera)
    if config.focal_over_width is not None:
        return FocalHint(config.focal_over_width, 0.0, config.radial_k1 or 0.0, is_fixed=True)
    return None


def is_given(config: InferenceConfig) -> bool:
    """Whether the user knows the focal length, so that no submap tells anything about it."""
    return config.intrinsics is not None or config.focal_over_width is not None
