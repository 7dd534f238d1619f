"""Network weights made by rule, so that independent implementations can be compared without trained weights.

The rule is the fixtures' (see the README beside them): each parameter is drawn from a generator seeded with its name.
"""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from vggt_motion.inference.vggt.architecture import VggtArchitecture

# A real VGGT network of 0.6 MB: everything is there, nothing is large.
TINY = VggtArchitecture(
    width=64,
    depth=4,
    heads=1,
    backbone_depth=1,
    dense_levels=(0, 1, 2, 3),
    dense_features=8,
    dense_channels=(8, 8, 16, 16),
    embedding_grid=5,
    camera_depth=1,
)
FIXTURES_VARIABLE = "VGGT_MOTION_FIXTURES"
_REPOSITORY = Path(__file__).resolve().parents[1]
_UPDATE_BIAS = (0.02, -0.01, 0.03, 0.01, 0.02, -0.02, 0.25, 0.25, 0.3)  # a plausible camera, not all at one place


def fixture_dir(name: str) -> Path:
    """Folder of reference outputs, or a skip that says how to provide it."""
    directory = Path(os.environ.get(FIXTURES_VARIABLE, _REPOSITORY.parent / "shared" / "fixtures")) / name
    if not directory.is_dir():
        pytest.skip(f"no reference outputs at {directory}: set {FIXTURES_VARIABLE}")
    return directory


def rule_weight(name: str, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """The weight of one parameter."""
    if name == "camera_head.pose_branch.fc2.bias":
        return np.array(_UPDATE_BIAS, dtype=np.float32)
    generator = np.random.RandomState(zlib.crc32(name.encode()) & 0xFFFFFFFF)
    noise = generator.standard_normal(shape).astype(np.float32)
    if not shape:
        return np.float32(1.0).reshape(())
    if len(shape) == 1:
        return 1.0 + 0.1 * noise if name.endswith((".weight", ".gamma")) else 0.1 * noise
    weight = noise / np.float32(math.sqrt(math.prod(shape[1:])))
    return np.float32(0.05) * weight if name == "camera_head.pose_branch.fc2.weight" else weight


def rule_weights(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, npt.NDArray[np.float32]]:
    """Weights of all parameters of a network."""
    return {name: rule_weight(name, tuple(shape)) for name, shape in shapes.items()}
