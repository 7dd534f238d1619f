"""The one place that imports pycolmap, after cv2: the other order crashes inside cv2."""

from __future__ import annotations

import platform
from types import ModuleType

import cv2  # noqa: F401  -- must come before pycolmap

from vggt_motion.errors import MissingDependencyError


def load_pycolmap() -> ModuleType:
    """The pycolmap module.

    Raises:
        MissingDependencyError: it is not installed, or its library cannot be loaded.
    """
    try:
        import pycolmap
    except ImportError as error:
        is_arm_linux = platform.machine() in ("aarch64", "arm64") and platform.system() == "Linux"
        advice = (
            "run the inference service on x86-64 or build it from source" if is_arm_linux else "pip install pycolmap"
        )
        raise MissingDependencyError(
            f"predictor 'sfm' needs the package pycolmap, which cannot be imported ({error}): {advice}; "
            "64-bit ARM Linux has no wheel"
        ) from error
    module: ModuleType = pycolmap
    return module
