"""One register job from encoded depth to a constraint: what a registration worker runs in its child process."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vggt_motion.bus.depth import decode_depth
from vggt_motion.config import RegistrationConfig
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.records import Constraint, ConstraintKind, FrameGeometry, RegisterTask, RegistrationSpec
from vggt_motion.registration.anchors import AnchorView, SharedFrame, register


def register_submaps(
    task: RegisterTask, depths: Sequence[bytes], config: RegistrationConfig
) -> tuple[Constraint, tuple[bytes, ...]]:
    """Estimate the constraint of one pair of submaps.

    Args:
        task: what to register.
        depths: encoded depth of ``in_i`` and ``in_j`` of each of ``task.shared``, in turn.
        config: anchors, masks and robust estimation.

    Returns:
        The record of the constraint stream, which has no payloads.
    """
    shared = [
        SharedFrame(frame.in_i.keyframe_id, _view(frame.in_i, depths[2 * k]), _view(frame.in_j, depths[2 * k + 1]))
        for k, frame in enumerate(task.shared)
    ]
    return register(task.spec, shared, config, fix_scale=task.fix_scale), ()


def load_kernels(config: RegistrationConfig) -> None:
    """Compile or load the kernels by registering a toy pair, so that the first job does not wait for it."""
    camera = Intrinsics.centred(60.0, 64, 48)
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
    depth = (4.0 + 0.05 * u + np.sin(0.7 * v)).astype(np.float32)
    shared = []
    for k in range(3):
        view = AnchorView(depth, np.ones_like(depth), camera, se3.make(np.eye(3), np.array([0.5 * k, 0.0, 0.0])))
        shared.append(SharedFrame(str(k), view, view))
    spec = RegistrationSpec(0, 1, 1, 1, ConstraintKind.ADJACENT, tuple(frame.keyframe_id for frame in shared))
    register(spec, shared, config)


def _view(frame: FrameGeometry, encoded_depth: bytes) -> AnchorView:
    depth, confidence = decode_depth(encoded_depth)
    return AnchorView(depth, confidence, frame.intrinsics, frame.submap_from_camera)
