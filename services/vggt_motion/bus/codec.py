"""Records and calls to bytes and back: the only place where dataclasses and protobuf messages meet.

Whatever is malformed, out of bounds, of a wrong length or of a newer schema ends as :class:`CodecError` with one line
that names the field. Fields that this version does not know are skipped, as protobuf does: adding a field keeps the
version.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, Final, TypeAlias, TypeVar

from google.protobuf.message import DecodeError, EncodeError, Message

from vggt_motion.bus import calls
from vggt_motion.bus.depth import MEDIA_TYPE as DEPTH_MEDIA_TYPE
from vggt_motion.bus.depth import decode_depth, encode_depth
from vggt_motion.bus.scan import check_structure
from vggt_motion.bus.schema import (
    Array,
    Choice,
    FieldError,
    Flag,
    Many,
    OptionalText,
    Plan,
    Raw,
    Real,
    Rule,
    Sub,
    Table,
    Text,
    Whole,
)
from vggt_motion.errors import CodecError, RefusalCode
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import (
    BlobRef,
    Constraint,
    ConstraintKind,
    DepthCodec,
    DoneOutcome,
    DropReason,
    EdgeReport,
    Event,
    EventKind,
    FocalHint,
    FrameEntry,
    FrameGeometry,
    GraphUpdate,
    HealthReport,
    Job,
    JobCount,
    JobKind,
    JobReport,
    JobState,
    Keyframe,
    Lease,
    LedgerStatus,
    LogEntry,
    MotionState,
    PredictTask,
    RegisterTask,
    RegistrationAttempt,
    RegistrationSpec,
    ScaleKind,
    Segment,
    SharedGeometry,
    Stream,
    StreamPosition,
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
    jobs_pb2,
    keyframe_pb2,
    ledger_pb2,
    segment_pb2,
    submap_pb2,
)

__all__ = [
    "DEPTH_MEDIA_TYPE",
    "MAX_BLOB_BYTES",
    "SCHEMA_VERSION",
    "STREAM_RECORDS",
    "Record",
    "blob_ref",
    "blob_refs",
    "decode",
    "decode_depth",
    "encode",
    "encode_depth",
    "encoding_of",
    "identity_digest",
    "payload_type",
    "record_class",
]

SCHEMA_VERSION: Final = 1
MAX_BLOB_BYTES: Final = 128 * 2**20
STREAM_RECORDS: Final[dict[Stream, type[Any]]] = {
    Stream.KEYFRAME: Keyframe,
    Stream.SEGMENT: Segment,
    Stream.SUBMAP: SubmapGeometry,
    Stream.CONSTRAINT: Constraint,
    Stream.GRAPH: GraphUpdate,
    Stream.EVENT: Event,
}

Record: TypeAlias = Keyframe | Segment | SubmapGeometry | Constraint | GraphUpdate | Event
"""What a stream of the log may hold."""

_Message = TypeVar("_Message")

_MAX_RECORD_BYTES = 32 * 2**20
_MAX_TASK_BYTES = 2**22
_MAX_CALL_BYTES = 512 * 2**20  # with all blobs; Zenoh drops messages above 1 GiB without a word
_MAX_COUNT = 2**32 - 1
_MAX_INDEX = 2**53
_ORTHONORMAL_TOLERANCE = 1e-5

_SHA256 = Text(64, 64, re.compile("[0-9a-f]{64}"), "64 lower-case hexadecimal digits")
_IDENTIFIER = Text(256, 1, re.compile("[!-~]+"), "an identifier of printable ASCII without blanks")
_NAME = Text(64, 1, re.compile("[A-Za-z0-9_.-]+"), "a name of letters, digits, '_', '.' and '-'")
_LINE = Text()
_LINES = Text(max_chars=2**16, many_lines=True)
_INDEX = Whole(0, _MAX_INDEX)
_COUNT = Whole(0, _MAX_COUNT)
_REVISION = Whole(1, _MAX_COUNT)
_TIME_NS = Whole(-(2**62), 2**62)
_SIDE_PX = Whole(1, 2**15)
_NUMBER = Real()
_RATIO = Real(0.0, 1.0)
_POSITIVE = Real(low=5e-324)
_KEYFRAME_IDS = Many(_IDENTIFIER, 4096)
_IDENTITY = Raw(32, 32)


def _rotation_problem(values: list[float]) -> str | None:
    a, b, c = values[0:3], values[3:6], values[6:9]
    for row, other, expected in ((a, a, 1.0), (b, b, 1.0), (c, c, 1.0), (a, b, 0.0), (a, c, 0.0), (b, c, 0.0)):
        dot = row[0] * other[0] + row[1] * other[1] + row[2] * other[2]
        if not abs(dot - expected) <= _ORTHONORMAL_TOLERANCE:
            return "is not a rotation: rows are not orthonormal"
    determinant = (
        a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    return None if determinant > 0.0 else "is not a rotation: it mirrors"


def _rigid_problem(values: list[float]) -> str | None:
    if values[12:] != [0.0, 0.0, 0.0, 1.0]:
        return "must have the last row 0 0 0 1"
    return _rotation_problem(values[0:3] + values[4:7] + values[8:11])


def _information_problem(values: list[float]) -> str | None:
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


def _keyframe_problem(record: Keyframe) -> str | None:
    return "zero_motion_copy_of: is the keyframe itself" if record.zero_motion_copy_of == record.keyframe_id else None


def _frame_entry_problem(record: FrameEntry) -> str | None:
    if record.is_keyframe == (record.drop_reason is not None):
        return "drop_reason: a keyframe has none, every other frame has one"
    return None


def _segment_problem(record: Segment) -> str | None:
    if not _unique(record.base_keyframe_ids, record.overlap_keyframe_ids):
        return "base_keyframe_ids: a keyframe is listed twice"
    indices = [frame.frame_index for frame in record.frames]
    if any(later <= earlier for earlier, later in itertools.pairwise(indices)):
        return "frames: frame_index must increase"
    return None


def _submap_spec_problem(record: SubmapSpec) -> str | None:
    ids = set(record.keyframe_ids)
    if not _unique(record.overlap_keyframe_ids, record.base_keyframe_ids, record.loop_keyframe_ids):
        return "base_keyframe_ids: a keyframe is listed twice"
    for copy, original in record.zero_motion_copies:
        if copy == original or copy not in ids or original not in ids:
            return "zero_motion_copies: must be pairs of keyframes of this submap"
    return None


def _submap_problem(record: SubmapGeometry) -> str | None:
    ids = tuple(frame.keyframe_id for frame in record.frames)
    if not _unique(ids) or not set(ids) <= set(record.spec.keyframe_ids):
        return "frames: each must be of a keyframe of the spec, once"
    if (record.verdict is SubmapVerdict.FAILED) != (not record.frames):
        return "frames: must be empty if and only if the verdict is failed"
    return None


def _predict_task_problem(record: PredictTask) -> str | None:
    if tuple(keyframe.keyframe_id for keyframe in record.keyframes) != record.spec.keyframe_ids:
        return "keyframes: must be those of the spec, in its order"
    return None


def _registration_problem(record: RegistrationSpec) -> str | None:
    return "j: is the same submap as i" if record.i == record.j else None


def _constraint_problem(record: Constraint) -> str | None:
    if record.accepted and not (math.isfinite(record.inlier_ratio) and math.isfinite(record.median_relative_residual)):
        return "inlier_ratio: an accepted constraint needs finite inlier_ratio and median_relative_residual"
    return None


def _graph_problem(record: GraphUpdate) -> str | None:
    if len({pose.submap_index for pose in record.poses}) != len(record.poses):
        return "poses: a submap is listed twice"
    return None


class _Pair(Rule):
    """``zero_motion_copies`` are pairs in the record and small messages on the wire."""

    def __init__(self) -> None:
        self.names = ("copy_keyframe_id", "original_keyframe_id")

    def extend(self, container: Any, values: Any) -> None:
        for value in values:
            if not isinstance(value, tuple) or len(value) != 2:
                raise FieldError("must be pairs")
            container.add(**{name: _IDENTIFIER.check(entry) for name, entry in zip(self.names, value, strict=True)})

    def collect(self, container: Any) -> list[Any]:
        return [tuple(_IDENTIFIER.check(getattr(entry, name)) for name in self.names) for entry in container]


def _plan(record: type[Any], message: type[Message], max_bytes: int = 2**16, **options: Any) -> Plan:
    rules: dict[str, Rule] = options.pop("rules")
    return Plan(record, message, rules, max_bytes=max_bytes, **options)


_BLOB_REF = _plan(
    BlobRef,
    common_pb2.BlobRef,
    rules={
        "sha256": _SHA256,
        "size_bytes": Whole(0, MAX_BLOB_BYTES),
        "media_type": Text(127, 3, re.compile(r"[a-z0-9.+-]+/[a-z0-9.+-]+"), "a media type"),
    },
)
_SIM3 = _plan(
    Sim3,
    common_pb2.Sim3,
    rules={"rotation": Array((3, 3), _rotation_problem), "translation": Array((3,)), "scale": _POSITIVE},
)
_INTRINSICS = _plan(
    Intrinsics,
    common_pb2.Intrinsics,
    rules={
        "fx": _POSITIVE,
        "fy": _POSITIVE,
        "cx": _NUMBER,
        "cy": _NUMBER,
        "width_px": _SIDE_PX,
        "height_px": _SIDE_PX,
        "k1": _NUMBER,
    },
)
_OPTIONAL_BLOB = Sub(_BLOB_REF, optional=True)
_MOTION_STATE = Choice(MotionState, keyframe_pb2.MotionState)

_KEYFRAME = _plan(
    Keyframe,
    keyframe_pb2.Keyframe,
    rules={
        "camera": _NAME,
        "epoch": _INDEX,
        "frame_index": _INDEX,
        "capture_time_ns": _TIME_NS,
        "state": _MOTION_STATE,
        "width_px": _SIDE_PX,
        "height_px": _SIDE_PX,
        "image": Sub(_BLOB_REF),
        "zero_motion_copy_of": OptionalText(_IDENTIFIER),
    },
    test=_keyframe_problem,
)
_FRAME_ENTRY = _plan(
    FrameEntry,
    segment_pb2.FrameEntry,
    rules={
        "frame_index": _INDEX,
        "capture_time_ns": _TIME_NS,
        "state": _MOTION_STATE,
        "is_keyframe": Flag(),
        "drop_reason": Choice(DropReason, segment_pb2.DropReason, none_if_unspecified=True),
    },
    test=_frame_entry_problem,
)
_SEGMENT = _plan(
    Segment,
    segment_pb2.Segment,
    rules={
        "index": _INDEX,
        "camera": _NAME,
        "epoch": _INDEX,
        "base_keyframe_ids": Many(_IDENTIFIER, 4096, 1),
        "overlap_keyframe_ids": _KEYFRAME_IDS,
        "frames": Many(Sub(_FRAME_ENTRY), 2**18),
        "closed_by": _NAME,
        "ego_mask": _OPTIONAL_BLOB,
    },
    test=_segment_problem,
    max_bytes=_MAX_RECORD_BYTES,
)
_FOCAL_HINT = _plan(
    FocalHint,
    submap_pb2.FocalHint,
    rules={
        "focal_over_width": _POSITIVE,
        "relative_sigma": Real(0.0, allow_infinite=True),
        "radial_k1": _NUMBER,
        "is_fixed": Flag(),
    },
)
_SUBMAP_SPEC = _plan(
    SubmapSpec,
    submap_pb2.SubmapSpec,
    rules={
        "submap_index": _INDEX,
        "revision": _REVISION,
        "overlap_keyframe_ids": _KEYFRAME_IDS,
        "base_keyframe_ids": Many(_IDENTIFIER, 4096, 1),
        "loop_keyframe_ids": _KEYFRAME_IDS,
        "zero_motion_copies": Many(_Pair(), 4096),
        "focal_hint": Sub(_FOCAL_HINT, optional=True),
        "ego_mask": _OPTIONAL_BLOB,
        "part": Choice(SubmapPart, submap_pb2.SubmapPart, none_if_unspecified=True),
    },
    test=_submap_spec_problem,
    max_bytes=2**22,
)
_FRAME_GEOMETRY = _plan(
    FrameGeometry,
    submap_pb2.FrameGeometry,
    rules={
        "keyframe_id": _IDENTIFIER,
        "intrinsics": Sub(_INTRINSICS),
        "submap_from_camera": Array((4, 4), _rigid_problem),
        "depth": Sub(_BLOB_REF),
        "codec": Choice(DepthCodec, submap_pb2.DepthCodec),
    },
)
_CANNOT_TELL = Real(0.0, allow_nan=True, allow_infinite=True)
_SUBMAP_QUALITY = _plan(
    SubmapQuality,
    submap_pb2.SubmapQuality,
    rules={
        "registered_frame_count": _COUNT,
        "mean_reprojection_error_px": _CANNOT_TELL,
        "track_inlier_ratio": Real(0.0, 1.0, allow_nan=True),
        "median_parallax_deg": _CANNOT_TELL,
        "focal_over_width": Real(0.0, allow_nan=True),
        "focal_relative_sigma": _CANNOT_TELL,
        "radial_k1": Real(allow_nan=True),
        "attempts": Many(_LINE, 256),
    },
)
_SUBMAP = _plan(
    SubmapGeometry,
    submap_pb2.SubmapGeometry,
    rules={
        "spec": Sub(_SUBMAP_SPEC),
        "verdict": Choice(SubmapVerdict, submap_pb2.SubmapVerdict),
        "reason": _LINE,
        "scale_kind": Choice(ScaleKind, submap_pb2.ScaleKind),
        "model": _LINE,
        "frames": Many(Sub(_FRAME_GEOMETRY), 4096),
        "quality": Sub(_SUBMAP_QUALITY),
        "stage_seconds": Table(Real(0.0)),
    },
    test=_submap_problem,
    informative=("stage_seconds",),
    max_bytes=2**23,
)
_CONSTRAINT_KIND = Choice(ConstraintKind, constraint_pb2.ConstraintKind)
_REGISTRATION_SPEC = _plan(
    RegistrationSpec,
    constraint_pb2.RegistrationSpec,
    rules={
        "i": _INDEX,
        "j": _INDEX,
        "i_revision": _REVISION,
        "j_revision": _REVISION,
        "kind": _CONSTRAINT_KIND,
        "shared_keyframe_ids": _KEYFRAME_IDS,
    },
    test=_registration_problem,
    max_bytes=2**21,
)
_REGISTRATION_ATTEMPT = _plan(
    RegistrationAttempt,
    constraint_pb2.RegistrationAttempt,
    rules={
        "anchor": _NAME,
        "keyframe_ids": _KEYFRAME_IDS,
        "point_count": _INDEX,
        "inlier_ratio": Real(0.0, 1.0, allow_nan=True),
        "median_relative_residual": _CANNOT_TELL,
        "outcome": _LINE,
    },
)
_CONSTRAINT = _plan(
    Constraint,
    constraint_pb2.Constraint,
    rules={
        "spec": Sub(_REGISTRATION_SPEC),
        "accepted": Flag(),
        "reason": _LINE,
        "j_from_i": Sub(_SIM3),
        "inlier_ratio": Real(0.0, 1.0, allow_nan=True),
        "median_relative_residual": _CANNOT_TELL,
        "information": Array((7, 7), _information_problem),
        "point_count": _INDEX,
        "attempts": Many(Sub(_REGISTRATION_ATTEMPT), 64),
    },
    test=_constraint_problem,
    max_bytes=2**23,
)
_PREDICT_TASK = _plan(
    PredictTask,
    submap_pb2.PredictTask,
    rules={"spec": Sub(_SUBMAP_SPEC), "keyframes": Many(Sub(_KEYFRAME), 4096, 1)},
    test=_predict_task_problem,
    max_bytes=_MAX_TASK_BYTES,
)
_SHARED_GEOMETRY = _plan(
    SharedGeometry,
    constraint_pb2.SharedGeometry,
    rules={"in_i": Sub(_FRAME_GEOMETRY), "in_j": Sub(_FRAME_GEOMETRY)},
)
_REGISTER_TASK = _plan(
    RegisterTask,
    constraint_pb2.RegisterTask,
    rules={"spec": Sub(_REGISTRATION_SPEC), "shared": Many(Sub(_SHARED_GEOMETRY), 4096), "fix_scale": Flag()},
    max_bytes=_MAX_TASK_BYTES,
)
_SUBMAP_POSE = _plan(
    SubmapPose,
    graph_pb2.SubmapPose,
    rules={
        "submap_index": _INDEX,
        "submap_revision": _REVISION,
        "component": _INDEX,
        "world_from_submap": Sub(_SIM3),
    },
)
_EDGE_REPORT = _plan(
    EdgeReport,
    graph_pb2.EdgeReport,
    rules={
        "constraint_id": _IDENTIFIER,
        "weighted_residual": Real(0.0),
        "is_used": Flag(),
        "robust_weight": _RATIO,
    },
)
_GRAPH = _plan(
    GraphUpdate,
    graph_pb2.GraphUpdate,
    rules={
        "revision": _INDEX,
        "is_final": Flag(),
        "poses": Many(Sub(_SUBMAP_POSE), 2**17),
        "edges": Many(Sub(_EDGE_REPORT), 2**18),
        "breaks": Many(_LINE, 2**17),
        "final_cost": Real(0.0),
    },
    test=_graph_problem,
    max_bytes=_MAX_RECORD_BYTES,
)
_EVENT = _plan(
    Event,
    event_pb2.Event,
    rules={
        "event_id": _IDENTIFIER,
        "kind": Choice(EventKind, event_pb2.EventKind),
        "message": _LINE,
        "time_ns": _TIME_NS,
        "detail": Table(_LINES),
    },
    informative=("time_ns",),
    max_bytes=2**20,
)
_HEALTH = _plan(
    HealthReport,
    health_pb2.HealthReport,
    rules={
        "service": _NAME,
        "instance": _NAME,
        "time_ns": _TIME_NS,
        "state": _NAME,
        "detail": _LINE,
        "resident_bytes": _INDEX,
        "counters": Table(_NUMBER),
    },
)

_PAYLOAD_TYPE = Text(128, 1, re.compile(r"[A-Za-z_][A-Za-z0-9_.]*"), "the full name of a message")
_JOB_KIND = Choice(JobKind, jobs_pb2.JobKind)
_JOB = _plan(
    Job,
    jobs_pb2.Job,
    rules={
        "job_id": _IDENTIFIER,
        "kind": _JOB_KIND,
        "payload": Raw(_MAX_TASK_BYTES),
        "payload_type": _PAYLOAD_TYPE,
        "priority": Whole(-(2**31), 2**31 - 1),
        "model": _LINE,
    },
    max_bytes=2**23,
)
_LEASE = _plan(
    Lease,
    jobs_pb2.Lease,
    rules={"job": Sub(_JOB), "lease_id": _IDENTIFIER, "attempt": _REVISION, "duration_s": Real(0.0)},
    max_bytes=2**23,
)
_JOB_REPORT = _plan(
    JobReport,
    jobs_pb2.JobReport,
    rules={
        "job_id": _IDENTIFIER,
        "kind": _JOB_KIND,
        "state": Choice(JobState, jobs_pb2.JobState),
        "failure_count": _COUNT,
        "lost_lease_count": _COUNT,
        "worker": _LINE,
        "last_reason": _LINE,
        "last_traceback": _LINES,
    },
    max_bytes=2**20,
)
_LOG_ENTRY = _plan(
    LogEntry,
    ledger_pb2.LogEntry,
    rules={
        "stream": _NAME,
        "sequence": _INDEX,
        "record_id": _IDENTIFIER,
        "payload_type": _PAYLOAD_TYPE,
        "payload": Raw(_MAX_RECORD_BYTES),
        "append_time_ns": _TIME_NS,
    },
    max_bytes=2 * _MAX_RECORD_BYTES,
)
_STREAM_POSITION = _plan(StreamPosition, ledger_pb2.StreamPosition, rules={"stream": _NAME, "next_sequence": _INDEX})
_JOB_COUNT = _plan(JobCount, ledger_pb2.JobCount, rules={"kind": _NAME, "state": _NAME, "count": _INDEX})
_LEDGER_STATUS = _plan(
    LedgerStatus,
    ledger_pb2.LedgerStatus,
    rules={
        "positions": Many(Sub(_STREAM_POSITION), 256),
        "job_counts": Many(Sub(_JOB_COUNT), 256),
        "stored_bytes": Whole(0, 2**63),
        "free_bytes": Whole(0, 2**63),
        "is_accepting": Flag(),
        "detail": _LINE,
        "refused_request_count": _INDEX,
    },
)
_APPEND_REQUEST = _plan(
    calls.AppendRequest,
    ledger_pb2.AppendRequest,
    rules={
        "stream": _NAME,
        "record_id": _IDENTIFIER,
        "payload_type": _PAYLOAD_TYPE,
        "payload": Raw(_MAX_RECORD_BYTES),
        "identity_sha256": _IDENTITY,
        "blobs": Many(Raw(MAX_BLOB_BYTES), 8192),
        "blob_refs": Many(Sub(_BLOB_REF), 8192),
    },
    max_bytes=_MAX_CALL_BYTES,
)

_PLANS: Final[tuple[Plan, ...]] = (
    _BLOB_REF,
    _KEYFRAME,
    _SEGMENT,
    _SUBMAP_SPEC,
    _SUBMAP,
    _PREDICT_TASK,
    _REGISTRATION_SPEC,
    _REGISTER_TASK,
    _CONSTRAINT,
    _GRAPH,
    _EVENT,
    _HEALTH,
    _JOB,
    _LEASE,
    _JOB_REPORT,
    _LOG_ENTRY,
    _LEDGER_STATUS,
    _APPEND_REQUEST,
    _plan(
        calls.Refusal,
        ledger_pb2.Refusal,
        rules={"code": Choice(RefusalCode, ledger_pb2.RefusalCode), "message": _LINE},
    ),
    _plan(calls.AppendReply, ledger_pb2.AppendReply, rules={"sequence": _INDEX, "was_known": Flag()}),
    _plan(
        calls.ReadRequest,
        ledger_pb2.ReadRequest,
        rules={"stream": _NAME, "from_sequence": _INDEX, "limit": _COUNT},
    ),
    _plan(
        calls.ReadReply,
        ledger_pb2.ReadReply,
        rules={"entries": Many(Sub(_LOG_ENTRY), 2**17), "next_sequence": _INDEX},
        max_bytes=_MAX_CALL_BYTES,
    ),
    _plan(calls.StatusRequest, ledger_pb2.StatusRequest, rules={}),
    _plan(
        calls.SubmitRequest,
        jobs_pb2.SubmitRequest,
        rules={"jobs": Many(Sub(_JOB), 2**16)},
        max_bytes=2 * _MAX_RECORD_BYTES,
    ),
    _plan(calls.SubmitReply, jobs_pb2.SubmitReply, rules={"new_count": _COUNT, "known_count": _COUNT}),
    _plan(
        calls.ClaimRequest,
        jobs_pb2.ClaimRequest,
        rules={
            "kinds": Many(_JOB_KIND, 16, 1),
            "models": Many(_LINE, 256),
            "worker": Text(129, 3, re.compile("[A-Za-z0-9_.-]+/[A-Za-z0-9_.-]+"), "service/instance"),
            "wait_s": Real(0.0, 3600.0),
            "claim_id": _IDENTIFIER,
        },
    ),
    _plan(
        calls.ClaimReply,
        jobs_pb2.ClaimReply,
        rules={"lease": Sub(_LEASE, optional=True)},
        max_bytes=2**23,
    ),
    _plan(calls.HeartbeatRequest, jobs_pb2.HeartbeatRequest, rules={"lease_id": _IDENTIFIER}),
    _plan(calls.HeartbeatReply, jobs_pb2.HeartbeatReply, rules={"is_valid": Flag()}),
    _plan(
        calls.DoneRequest,
        jobs_pb2.DoneRequest,
        rules={"job_id": _IDENTIFIER, "lease_id": _IDENTIFIER, "result": Sub(_APPEND_REQUEST)},
        max_bytes=_MAX_CALL_BYTES,
    ),
    _plan(
        calls.DoneReply,
        jobs_pb2.DoneReply,
        rules={"outcome": Choice(DoneOutcome, jobs_pb2.DoneOutcome), "sequence": _INDEX},
    ),
    _plan(
        calls.FailRequest,
        jobs_pb2.FailRequest,
        rules={
            "job_id": _IDENTIFIER,
            "lease_id": _IDENTIFIER,
            "reason": _LINE,
            "traceback": _LINES,
            "is_permanent": Flag(),
        },
        max_bytes=2**20,
    ),
    _plan(calls.FailReply, jobs_pb2.FailReply, rules={"is_counted": Flag()}),
    _plan(
        calls.ReportsRequest,
        jobs_pb2.ReportsRequest,
        rules={
            "state": Choice(JobState, jobs_pb2.JobState, none_if_unspecified=True),
            "after_job_id": Text(256, 0, re.compile("[!-~]*"), "a job id"),
            "limit": _COUNT,
        },
    ),
    _plan(
        calls.ReportsReply,
        jobs_pb2.ReportsReply,
        rules={"reports": Many(Sub(_JOB_REPORT), 2**16)},
        max_bytes=_MAX_CALL_BYTES,
    ),
    _plan(
        calls.CancelRequest,
        jobs_pb2.CancelRequest,
        rules={"job_ids": Many(_IDENTIFIER, 2**16)},
        max_bytes=_MAX_RECORD_BYTES,
    ),
    _plan(calls.CancelReply, jobs_pb2.CancelReply, rules={"cancelled_count": _COUNT}),
)
_BY_CLASS: Final = {plan.record: plan for plan in _PLANS}
_BY_NAME: Final = {plan.full_name: plan.record for plan in _PLANS}
_VERSIONED: Final = {plan.record for plan in _PLANS if "schema_version" in plan.message.DESCRIPTOR.fields_by_name}


def encode(record: Any) -> bytes:
    """Serialise a record of ``records.py`` or a call of ``bus/calls.py``; equal records give equal bytes.

    Raises:
        CodecError: a value breaks a rule of the wire; the message names the field.
    """
    plan = _plan_of(type(record))
    return _serialise(_message(plan, record), plan)


def decode(cls: type[_Message], payload: bytes) -> _Message:
    """Parse and check a record or call; the inverse of :func:`encode`.

    Raises:
        CodecError: one line that names the type and the field that is wrong.
    """
    plan = _plan_of(cls)
    if len(payload) > plan.max_bytes:
        raise CodecError(f"{plan.full_name}: {len(payload)} bytes are more than the allowed {plan.max_bytes}")
    check_structure(payload, plan.message.DESCRIPTOR)
    message = plan.message()
    try:
        message.ParseFromString(payload)
    except (DecodeError, ValueError) as error:
        raise CodecError(f"{plan.full_name}: not a valid message: {_one_line(error)}") from None
    if cls in _VERSIONED:
        version = message.schema_version  # type: ignore[attr-defined]
        if version != SCHEMA_VERSION:
            problem = "is missing" if version == 0 else f"{version} is newer than the known {SCHEMA_VERSION}"
            raise CodecError(f"{plan.full_name}: schema_version {problem}")
    try:
        record: _Message = plan.read(message)
    except FieldError as error:
        raise _codec_error(plan, error) from None
    return record


def payload_type(cls: type[Any]) -> str:
    """Full name of the message of a class: ``vggt_motion.v1.Keyframe``."""
    return _plan_of(cls).full_name


def encoding_of(cls: type[Any]) -> str:
    """Zenoh encoding of a class: ``application/protobuf;vggt_motion.v1.Keyframe``."""
    return f"application/protobuf;{payload_type(cls)}"


def record_class(name: str) -> type[Any]:
    """The class of a message by its full name; the inverse of :func:`payload_type`.

    Raises:
        CodecError: this version does not know the name.
    """
    if name not in _BY_NAME:
        raise CodecError(f"message type '{name:.128}' is not known here")
    return _BY_NAME[name]


def identity_digest(record: Any) -> bytes:
    """SHA-256 over the record's type and its canonical bytes without informative fields (wall clock, durations).

    Two records with one id are the same record if and only if their digests are equal: this is what the ledger
    compares, to which payloads are opaque.
    """
    plan = _plan_of(type(record))
    message = _message(plan, record)
    for name in plan.informative:
        message.ClearField(name)
    return hashlib.sha256(plan.full_name.encode() + b"\0" + _serialise(message, plan)).digest()


def blob_ref(content: bytes, media_type: str) -> BlobRef:
    """Reference to bytes that are about to be stored."""
    return BlobRef(hashlib.sha256(content).hexdigest(), len(content), media_type)


def blob_refs(record: Any) -> tuple[BlobRef, ...]:
    """Every blob that a record refers to, once, in order of appearance."""
    return tuple(dict.fromkeys(_walk_blob_refs(record)))


def _walk_blob_refs(value: Any) -> Iterator[BlobRef]:
    if isinstance(value, BlobRef):
        yield value
    elif isinstance(value, tuple):
        for entry in value:
            yield from _walk_blob_refs(entry)
    elif is_dataclass(value):
        for entry in fields(value):
            yield from _walk_blob_refs(getattr(value, entry.name))


def _plan_of(cls: type[Any]) -> Plan:
    if cls not in _BY_CLASS:
        raise TypeError(f"{cls.__name__} is not a message of the wire")
    return _BY_CLASS[cls]


def _message(plan: Plan, record: Any) -> Message:
    message = plan.message()
    try:
        plan.fill(message, record)
    except FieldError as error:
        raise _codec_error(plan, error) from None
    if plan.record in _VERSIONED:
        message.schema_version = SCHEMA_VERSION  # type: ignore[attr-defined]
    return message


def _serialise(message: Message, plan: Plan) -> bytes:
    try:
        payload = message.SerializeToString(deterministic=True)
    except (EncodeError, ValueError) as error:
        raise CodecError(f"{plan.full_name}: cannot be serialised: {_one_line(error)}") from None
    if len(payload) > plan.max_bytes:
        raise CodecError(f"{plan.full_name}: {len(payload)} bytes are more than the allowed {plan.max_bytes}")
    return payload


def _codec_error(plan: Plan, error: FieldError) -> CodecError:
    place = ".".join([plan.full_name, *error.path]).replace(".[", "[")
    return CodecError(f"{place}: {error.problem}")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
