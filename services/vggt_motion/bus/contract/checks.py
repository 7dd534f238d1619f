"""What the fields of a record must be together; each check returns the problem in words, or None."""

from __future__ import annotations

import itertools
import math

from vggt_motion.records import (
    Constraint,
    FrameEntry,
    GraphUpdate,
    Keyframe,
    PredictTask,
    RegistrationSpec,
    Segment,
    SubmapGeometry,
    SubmapSpec,
    SubmapVerdict,
)

_ORTHONORMAL_TOLERANCE = 1e-5


def rotation_problem(values: list[float]) -> str | None:
    """Nine values, row by row, are a proper rotation (to 1e-5)."""
    a0, a1, a2, b0, b1, b2, c0, c1, c2 = values
    # Written out: it is done for each pose of each record in each process that reads it.
    if not (
        abs(a0 * a0 + a1 * a1 + a2 * a2 - 1.0) <= _ORTHONORMAL_TOLERANCE
        and abs(b0 * b0 + b1 * b1 + b2 * b2 - 1.0) <= _ORTHONORMAL_TOLERANCE
        and abs(c0 * c0 + c1 * c1 + c2 * c2 - 1.0) <= _ORTHONORMAL_TOLERANCE
        and abs(a0 * b0 + a1 * b1 + a2 * b2) <= _ORTHONORMAL_TOLERANCE
        and abs(a0 * c0 + a1 * c1 + a2 * c2) <= _ORTHONORMAL_TOLERANCE
        and abs(b0 * c0 + b1 * c1 + b2 * c2) <= _ORTHONORMAL_TOLERANCE
    ):
        return "is not a rotation: rows are not orthonormal"
    determinant = a0 * (b1 * c2 - b2 * c1) - a1 * (b0 * c2 - b2 * c0) + a2 * (b0 * c1 - b1 * c0)
    return None if determinant > 0.0 else "is not a rotation: it mirrors"


def rigid_problem(values: list[float]) -> str | None:
    """Sixteen values, row by row, are a rotation and a translation."""
    if values[12:] != [0.0, 0.0, 0.0, 1.0]:
        return "must have the last row 0 0 0 1"
    return rotation_problem(values[0:3] + values[4:7] + values[8:11])


def information_problem(values: list[float]) -> str | None:
    """Forty-nine values, row by row, are a symmetric matrix without a negative diagonal."""
    tolerance = 1e-6 * max(map(abs, values))
    for row in range(7):
        if values[8 * row] < 0.0:
            return "has a negative diagonal"
        if any(abs(values[7 * row + column] - values[7 * column + row]) > tolerance for column in range(row)):
            return "is not symmetric"
    return None


def _unique(*groups: tuple[str, ...]) -> bool:
    flat = [entry for group in groups for entry in group]
    return len(set(flat)) == len(flat)


def keyframe_problem(record: Keyframe) -> str | None:
    """A copy is of another keyframe."""
    return "zero_motion_copy_of: is the keyframe itself" if record.zero_motion_copy_of == record.keyframe_id else None


def frame_entry_problem(record: FrameEntry) -> str | None:
    """Every frame but a keyframe says why it was dropped."""
    if record.is_keyframe == (record.drop_reason is not None):
        return "drop_reason: a keyframe has none, every other frame has one"
    return None


def segment_problem(record: Segment) -> str | None:
    """Each keyframe is listed once, and frames come in order."""
    if not _unique(record.base_keyframe_ids, record.overlap_keyframe_ids):
        return "base_keyframe_ids: a keyframe is listed twice"
    indices = [frame.frame_index for frame in record.frames]
    if any(later <= earlier for earlier, later in itertools.pairwise(indices)):
        return "frames: frame_index must increase"
    return None


def submap_spec_problem(record: SubmapSpec) -> str | None:
    """Each keyframe has one role, and copies are within the submap."""
    ids = set(record.keyframe_ids)
    if not _unique(record.overlap_keyframe_ids, record.base_keyframe_ids, record.loop_keyframe_ids):
        return "base_keyframe_ids: a keyframe is listed twice"
    for copy, original in record.zero_motion_copies:
        if copy == original or copy not in ids or original not in ids:
            return "zero_motion_copies: must be pairs of keyframes of this submap"
    return None


def submap_problem(record: SubmapGeometry) -> str | None:
    """Frames are of the spec, and there are none if and only if the prediction failed."""
    ids = tuple(frame.keyframe_id for frame in record.frames)
    if not _unique(ids) or not set(ids) <= set(record.spec.keyframe_ids):
        return "frames: each must be of a keyframe of the spec, once"
    if (record.verdict is SubmapVerdict.FAILED) != (not record.frames):
        return "frames: must be empty if and only if the verdict is failed"
    return None


def predict_task_problem(record: PredictTask) -> str | None:
    """The keyframes that travel with the task are those of the spec."""
    if tuple(keyframe.keyframe_id for keyframe in record.keyframes) != record.spec.keyframe_ids:
        return "keyframes: must be those of the spec, in its order"
    return None


def registration_problem(record: RegistrationSpec) -> str | None:
    """Two submaps are registered, not one with itself."""
    return "j: is the same submap as i" if record.i == record.j else None


def constraint_problem(record: Constraint) -> str | None:
    """What is accepted has finite statistics."""
    if record.accepted and not (math.isfinite(record.inlier_ratio) and math.isfinite(record.median_relative_residual)):
        return "inlier_ratio: an accepted constraint needs finite inlier_ratio and median_relative_residual"
    return None


def graph_problem(record: GraphUpdate) -> str | None:
    """Each submap has one pose."""
    if len({pose.submap_index for pose in record.poses}) != len(record.poses):
        return "poses: a submap is listed twice"
    return None
