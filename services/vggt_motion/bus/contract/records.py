"""Plans of the records in the log, of the tasks of the workers, and of what they are made of."""

from __future__ import annotations

import re
from typing import Any, Final

from vggt_motion.bus.contract import checks
from vggt_motion.bus.contract.values import (
    COUNT,
    IDENTIFIER,
    INDEX,
    KEYFRAME_IDS,
    LINE,
    LINES,
    MAX_BLOB_BYTES,
    MAX_RECORD_BYTES,
    MAX_TASK_BYTES,
    NAME,
    NUMBER,
    POSITIVE,
    RATIO,
    REVISION,
    SHA256,
    SIDE_PX,
    TIME_NS,
    plan,
)
from vggt_motion.bus.schema import (
    Array,
    Choice,
    FieldError,
    Flag,
    Many,
    OptionalText,
    Plan,
    Real,
    Rule,
    Sub,
    Table,
    Text,
    Whole,
)
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import (
    BlobRef,
    Constraint,
    ConstraintKind,
    DepthCodec,
    DropReason,
    EdgeReport,
    Event,
    EventKind,
    FocalHint,
    FrameEntry,
    FrameGeometry,
    GraphUpdate,
    HealthReport,
    Keyframe,
    MotionState,
    PredictTask,
    RegisterTask,
    RegistrationAttempt,
    RegistrationSpec,
    ScaleKind,
    Segment,
    SharedGeometry,
    SubmapGeometry,
    SubmapPart,
    SubmapPose,
    SubmapQuality,
    SubmapSpec,
    SubmapVerdict,
)
from vggt_motion.v1 import (
    common_pb2,
    constraint_pb2,
    event_pb2,
    graph_pb2,
    health_pb2,
    keyframe_pb2,
    segment_pb2,
    submap_pb2,
)


class _Pair(Rule):
    """``zero_motion_copies`` are pairs in the record and small messages on the wire."""

    def __init__(self) -> None:
        self.names = ("copy_keyframe_id", "original_keyframe_id")

    def extend(self, container: Any, values: Any) -> None:
        for value in values:
            if not isinstance(value, tuple) or len(value) != 2:
                raise FieldError("must be pairs")
            container.add(**{name: IDENTIFIER.check(entry) for name, entry in zip(self.names, value, strict=True)})

    def collect(self, container: Any) -> list[Any]:
        return [tuple(IDENTIFIER.check(getattr(entry, name)) for name in self.names) for entry in container]


BLOB_REF = plan(
    BlobRef,
    common_pb2.BlobRef,
    rules={
        "sha256": SHA256,
        "size_bytes": Whole(0, MAX_BLOB_BYTES),
        "media_type": Text(127, 3, re.compile(r"[a-z0-9.+-]+/[a-z0-9.+-]+"), "a media type"),
    },
)
_SIM3 = plan(
    Sim3,
    common_pb2.Sim3,
    rules={"rotation": Array((3, 3), checks.rotation_problem), "translation": Array((3,)), "scale": POSITIVE},
)
_INTRINSICS = plan(
    Intrinsics,
    common_pb2.Intrinsics,
    rules={
        "fx": POSITIVE,
        "fy": POSITIVE,
        "cx": NUMBER,
        "cy": NUMBER,
        "width_px": SIDE_PX,
        "height_px": SIDE_PX,
        "k1": NUMBER,
        "k2": NUMBER,
    },
)
_OPTIONAL_BLOB = Sub(BLOB_REF, optional=True)
_MOTION_STATE = Choice(MotionState, keyframe_pb2.MotionState)

KEYFRAME = plan(
    Keyframe,
    keyframe_pb2.Keyframe,
    rules={
        "camera": NAME,
        "epoch": INDEX,
        "frame_index": INDEX,
        "capture_time_ns": TIME_NS,
        "state": _MOTION_STATE,
        "width_px": SIDE_PX,
        "height_px": SIDE_PX,
        "image": Sub(BLOB_REF),
        "zero_motion_copy_of": OptionalText(IDENTIFIER),
    },
    test=checks.keyframe_problem,
)
_FRAME_ENTRY = plan(
    FrameEntry,
    segment_pb2.FrameEntry,
    rules={
        "frame_index": INDEX,
        "capture_time_ns": TIME_NS,
        "state": _MOTION_STATE,
        "is_keyframe": Flag(),
        "drop_reason": Choice(DropReason, segment_pb2.DropReason, none_if_unspecified=True),
    },
    test=checks.frame_entry_problem,
)
SEGMENT = plan(
    Segment,
    segment_pb2.Segment,
    rules={
        "index": INDEX,
        "camera": NAME,
        "epoch": INDEX,
        "base_keyframe_ids": Many(IDENTIFIER, 4096, 1),
        "overlap_keyframe_ids": KEYFRAME_IDS,
        "frames": Many(Sub(_FRAME_ENTRY), 2**18),
        "closed_by": NAME,
        "ego_mask": _OPTIONAL_BLOB,
    },
    test=checks.segment_problem,
    max_bytes=MAX_RECORD_BYTES,
)
_FOCAL_HINT = plan(
    FocalHint,
    submap_pb2.FocalHint,
    rules={
        "focal_over_width": POSITIVE,
        "relative_sigma": Real(0.0, allow_infinite=True),
        "radial_k1": NUMBER,
        "is_fixed": Flag(),
        "intrinsics": Sub(_INTRINSICS, optional=True),
        "radial_shape": NUMBER,
    },
)
SUBMAP_SPEC = plan(
    SubmapSpec,
    submap_pb2.SubmapSpec,
    rules={
        "submap_index": INDEX,
        "revision": REVISION,
        "overlap_keyframe_ids": KEYFRAME_IDS,
        "base_keyframe_ids": Many(IDENTIFIER, 4096, 1),
        "loop_keyframe_ids": KEYFRAME_IDS,
        "zero_motion_copies": Many(_Pair(), 4096),
        "focal_hint": Sub(_FOCAL_HINT, optional=True),
        "ego_mask": _OPTIONAL_BLOB,
        "part": Choice(SubmapPart, submap_pb2.SubmapPart, none_if_unspecified=True),
    },
    test=checks.submap_spec_problem,
    max_bytes=2**22,
)
_FRAME_GEOMETRY = plan(
    FrameGeometry,
    submap_pb2.FrameGeometry,
    rules={
        "keyframe_id": IDENTIFIER,
        "intrinsics": Sub(_INTRINSICS),
        "submap_from_camera": Array((4, 4), checks.rigid_problem),
        "depth": Sub(BLOB_REF),
        "codec": Choice(DepthCodec, submap_pb2.DepthCodec),
    },
)
_CANNOT_TELL = Real(0.0, allow_nan=True, allow_infinite=True)
_SUBMAP_QUALITY = plan(
    SubmapQuality,
    submap_pb2.SubmapQuality,
    rules={
        "registered_frame_count": COUNT,
        "mean_reprojection_error_px": _CANNOT_TELL,
        "track_inlier_ratio": Real(0.0, 1.0, allow_nan=True),
        "median_parallax_deg": _CANNOT_TELL,
        "focal_over_width": Real(0.0, allow_nan=True),
        "focal_relative_sigma": _CANNOT_TELL,
        "radial_k1": Real(allow_nan=True),
        "attempts": Many(LINE, 256),
        "radial_shape": Real(allow_nan=True),
    },
)
SUBMAP = plan(
    SubmapGeometry,
    submap_pb2.SubmapGeometry,
    rules={
        "spec": Sub(SUBMAP_SPEC),
        "verdict": Choice(SubmapVerdict, submap_pb2.SubmapVerdict),
        "reason": LINE,
        "scale_kind": Choice(ScaleKind, submap_pb2.ScaleKind),
        "model": LINE,
        "frames": Many(Sub(_FRAME_GEOMETRY), 4096),
        "quality": Sub(_SUBMAP_QUALITY),
        "stage_seconds": Table(Real(0.0)),
    },
    test=checks.submap_problem,
    informative=("stage_seconds",),
    max_bytes=2**23,
)
_CONSTRAINT_KIND = Choice(ConstraintKind, constraint_pb2.ConstraintKind)
REGISTRATION_SPEC = plan(
    RegistrationSpec,
    constraint_pb2.RegistrationSpec,
    rules={
        "i": INDEX,
        "j": INDEX,
        "i_revision": REVISION,
        "j_revision": REVISION,
        "kind": _CONSTRAINT_KIND,
        "shared_keyframe_ids": KEYFRAME_IDS,
    },
    test=checks.registration_problem,
    max_bytes=2**21,
)
_REGISTRATION_ATTEMPT = plan(
    RegistrationAttempt,
    constraint_pb2.RegistrationAttempt,
    rules={
        "anchor": NAME,
        "keyframe_ids": KEYFRAME_IDS,
        "point_count": INDEX,
        "inlier_ratio": Real(0.0, 1.0, allow_nan=True),
        "median_relative_residual": _CANNOT_TELL,
        "outcome": LINE,
    },
)
CONSTRAINT = plan(
    Constraint,
    constraint_pb2.Constraint,
    rules={
        "spec": Sub(REGISTRATION_SPEC),
        "accepted": Flag(),
        "reason": LINE,
        "j_from_i": Sub(_SIM3),
        "inlier_ratio": Real(0.0, 1.0, allow_nan=True),
        "median_relative_residual": _CANNOT_TELL,
        "information": Array((7, 7), checks.information_problem),
        "point_count": INDEX,
        "attempts": Many(Sub(_REGISTRATION_ATTEMPT), 64),
    },
    test=checks.constraint_problem,
    max_bytes=2**23,
)
PREDICT_TASK = plan(
    PredictTask,
    submap_pb2.PredictTask,
    rules={"spec": Sub(SUBMAP_SPEC), "keyframes": Many(Sub(KEYFRAME), 4096, 1)},
    test=checks.predict_task_problem,
    max_bytes=MAX_TASK_BYTES,
)
_SHARED_GEOMETRY = plan(
    SharedGeometry,
    constraint_pb2.SharedGeometry,
    rules={"in_i": Sub(_FRAME_GEOMETRY), "in_j": Sub(_FRAME_GEOMETRY)},
)
REGISTER_TASK = plan(
    RegisterTask,
    constraint_pb2.RegisterTask,
    rules={"spec": Sub(REGISTRATION_SPEC), "shared": Many(Sub(_SHARED_GEOMETRY), 4096), "fix_scale": Flag()},
    max_bytes=MAX_TASK_BYTES,
)
_SUBMAP_POSE = plan(
    SubmapPose,
    graph_pb2.SubmapPose,
    rules={
        "submap_index": INDEX,
        "submap_revision": REVISION,
        "component": INDEX,
        "world_from_submap": Sub(_SIM3),
    },
)
_EDGE_REPORT = plan(
    EdgeReport,
    graph_pb2.EdgeReport,
    rules={
        "constraint_id": IDENTIFIER,
        "weighted_residual": Real(0.0, allow_nan=True),
        "is_used": Flag(),
        "robust_weight": RATIO,
    },
)
GRAPH = plan(
    GraphUpdate,
    graph_pb2.GraphUpdate,
    rules={
        "revision": INDEX,
        "is_final": Flag(),
        "poses": Many(Sub(_SUBMAP_POSE), 2**17),
        "edges": Many(Sub(_EDGE_REPORT), 2**18),
        "breaks": Many(LINE, 2**17),
        "final_cost": Real(0.0),
    },
    test=checks.graph_problem,
    max_bytes=MAX_RECORD_BYTES,
)
EVENT = plan(
    Event,
    event_pb2.Event,
    rules={
        "event_id": IDENTIFIER,
        "kind": Choice(EventKind, event_pb2.EventKind),
        "message": LINE,
        "time_ns": TIME_NS,
        "detail": Table(LINES),
    },
    informative=("time_ns",),
    max_bytes=2**20,
)
HEALTH = plan(
    HealthReport,
    health_pb2.HealthReport,
    rules={
        "service": NAME,
        "instance": NAME,
        "time_ns": TIME_NS,
        "state": NAME,
        "detail": LINE,
        "resident_bytes": INDEX,
        "counters": Table(NUMBER),
    },
)

RECORD_PLANS: Final[tuple[Plan, ...]] = (
    BLOB_REF,
    KEYFRAME,
    SEGMENT,
    SUBMAP_SPEC,
    SUBMAP,
    PREDICT_TASK,
    REGISTRATION_SPEC,
    REGISTER_TASK,
    CONSTRAINT,
    GRAPH,
    EVENT,
    HEALTH,
)
