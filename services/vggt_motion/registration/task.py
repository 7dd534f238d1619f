"""One register job from encoded depth to a constraint: what a registration worker runs in its child process."""

from __future__ import annotations

from collections.abc import Sequence

from vggt_motion.bus.depth import decode_depth
from vggt_motion.config import RegistrationConfig
from vggt_motion.records import Constraint, FrameGeometry, RegisterTask
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


def _view(frame: FrameGeometry, encoded_depth: bytes) -> AnchorView:
    depth, confidence = decode_depth(encoded_depth)
    return AnchorView(depth, confidence, frame.intrinsics, frame.submap_from_camera)
