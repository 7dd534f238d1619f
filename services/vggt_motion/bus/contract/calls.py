"""Plans of the job queue, of the ledger's answers and of every call."""

from __future__ import annotations

import re
from typing import Final

from vggt_motion.bus import calls
from vggt_motion.bus.contract.records import BLOB_REF
from vggt_motion.bus.contract.values import (
    COUNT,
    IDENTIFIER,
    IDENTITY,
    INDEX,
    LINE,
    LINES,
    MAX_BLOB_BYTES,
    MAX_BLOBS_PER_REQUEST,
    MAX_CALL_BYTES,
    MAX_RECORD_BYTES,
    MAX_REQUESTS_PER_BUNDLE,
    MAX_TASK_BYTES,
    NAME,
    REVISION,
    SHA256,
    TIME_NS,
    plan,
)
from vggt_motion.bus.schema import Choice, Flag, Many, Plan, Raw, Real, Sub, Text, Whole
from vggt_motion.errors import RefusalCode
from vggt_motion.records import (
    DoneOutcome,
    Job,
    JobCount,
    JobKind,
    JobReport,
    JobState,
    Lease,
    LedgerStatus,
    LogEntry,
    StreamPosition,
)
from vggt_motion.v1 import bundle_pb2, jobs_pb2, ledger_pb2, parcel_pb2

_PAYLOAD_TYPE = Text(128, 1, re.compile(r"[A-Za-z_][A-Za-z0-9_.]*"), "the full name of a message")
_JOB_KIND = Choice(JobKind, jobs_pb2.JobKind)
_JOB = plan(
    Job,
    jobs_pb2.Job,
    rules={
        "job_id": IDENTIFIER,
        "kind": _JOB_KIND,
        "payload": Raw(MAX_TASK_BYTES),
        "payload_type": _PAYLOAD_TYPE,
        "priority": Whole(-(2**31), 2**31 - 1),
        "model": LINE,
    },
    max_bytes=2**23,
)
_LEASE = plan(
    Lease,
    jobs_pb2.Lease,
    rules={"job": Sub(_JOB), "lease_id": IDENTIFIER, "attempt": REVISION, "duration_s": Real(0.0)},
    max_bytes=2**23,
)
_JOB_REPORT = plan(
    JobReport,
    jobs_pb2.JobReport,
    rules={
        "job_id": IDENTIFIER,
        "kind": _JOB_KIND,
        "state": Choice(JobState, jobs_pb2.JobState),
        "failure_count": COUNT,
        "lost_lease_count": COUNT,
        "worker": LINE,
        "last_reason": LINE,
        "last_traceback": LINES,
    },
    max_bytes=2**20,
)
_LOG_ENTRY = plan(
    LogEntry,
    ledger_pb2.LogEntry,
    rules={
        "stream": NAME,
        "sequence": INDEX,
        "record_id": IDENTIFIER,
        "payload_type": _PAYLOAD_TYPE,
        "payload": Raw(MAX_RECORD_BYTES),
        "append_time_ns": TIME_NS,
    },
    max_bytes=2 * MAX_RECORD_BYTES,
)
_STREAM_POSITION = plan(StreamPosition, ledger_pb2.StreamPosition, rules={"stream": NAME, "next_sequence": INDEX})
_JOB_COUNT = plan(JobCount, ledger_pb2.JobCount, rules={"kind": NAME, "state": NAME, "count": INDEX})
_LEDGER_STATUS = plan(
    LedgerStatus,
    ledger_pb2.LedgerStatus,
    rules={
        "positions": Many(Sub(_STREAM_POSITION), 256),
        "job_counts": Many(Sub(_JOB_COUNT), 256),
        "stored_bytes": Whole(0, 2**63),
        "free_bytes": Whole(0, 2**63),
        "is_accepting": Flag(),
        "detail": LINE,
        "refused_request_count": INDEX,
        "ledger_id": Text(64, 0, re.compile("[0-9a-f]*"), "hexadecimal digits"),
    },
)
_APPEND_REQUEST = plan(
    calls.AppendRequest,
    ledger_pb2.AppendRequest,
    rules={
        "stream": NAME,
        "record_id": IDENTIFIER,
        "payload_type": _PAYLOAD_TYPE,
        "payload": Raw(MAX_RECORD_BYTES),
        "identity_sha256": IDENTITY,
        "blobs": Many(Raw(MAX_BLOB_BYTES), 8192),
        "blob_refs": Many(Sub(BLOB_REF), 8192),
    },
    bulk="blobs",
    max_bytes=MAX_CALL_BYTES,
)

_REFUSAL = plan(
    calls.Refusal,
    ledger_pb2.Refusal,
    rules={"code": Choice(RefusalCode, ledger_pb2.RefusalCode), "message": LINE},
)
_BUNDLED_ANSWER = plan(
    calls.BundledAnswer,
    bundle_pb2.BundledAnswer,
    rules={"payload": Raw(MAX_RECORD_BYTES), "refusal": Sub(_REFUSAL, optional=True)},
)

CALL_PLANS: Final[tuple[Plan, ...]] = (
    _JOB,
    _LEASE,
    _JOB_REPORT,
    _LOG_ENTRY,
    _LEDGER_STATUS,
    _APPEND_REQUEST,
    _REFUSAL,
    plan(
        calls.Bundle,
        bundle_pb2.Bundle,
        rules={"requests": Many(Raw(MAX_CALL_BYTES), MAX_REQUESTS_PER_BUNDLE, 1)},
        bulk="requests",
        max_bytes=MAX_CALL_BYTES,
    ),
    plan(
        calls.BundleReply,
        bundle_pb2.BundleReply,
        rules={"answers": Many(Sub(_BUNDLED_ANSWER), MAX_REQUESTS_PER_BUNDLE)},
        max_bytes=MAX_CALL_BYTES,
    ),
    plan(
        calls.Parcel,
        parcel_pb2.Parcel,
        rules={
            "folder_id": Text(32, 32, re.compile("[0-9a-f]{32}"), "32 lower-case hexadecimal digits"),
            "name": Text(64, 0, re.compile("[0-9a-z-]*"), "the name of a parcel"),
            "size_bytes": Whole(0, MAX_CALL_BYTES),
        },
        max_bytes=256,
    ),
    plan(calls.AppendReply, ledger_pb2.AppendReply, rules={"sequence": INDEX, "was_known": Flag()}),
    plan(
        calls.ReadRequest,
        ledger_pb2.ReadRequest,
        rules={"stream": NAME, "from_sequence": INDEX, "limit": COUNT},
    ),
    plan(
        calls.ReadReply,
        ledger_pb2.ReadReply,
        rules={"entries": Many(Sub(_LOG_ENTRY), 2**17), "next_sequence": INDEX},
        max_bytes=MAX_CALL_BYTES,
    ),
    plan(
        calls.BlobsRequest,
        ledger_pb2.BlobsRequest,
        rules={"sha256": Many(SHA256, MAX_BLOBS_PER_REQUEST, 1)},
    ),
    plan(
        calls.BlobsReply,
        ledger_pb2.BlobsReply,
        rules={"blobs": Many(Raw(MAX_BLOB_BYTES), MAX_BLOBS_PER_REQUEST, 1)},
        bulk="blobs",
        max_bytes=MAX_CALL_BYTES,
    ),
    plan(calls.StatusRequest, ledger_pb2.StatusRequest, rules={}),
    plan(
        calls.SubmitRequest,
        jobs_pb2.SubmitRequest,
        rules={"jobs": Many(Sub(_JOB), 2**16)},
        max_bytes=2 * MAX_RECORD_BYTES,
    ),
    plan(calls.SubmitReply, jobs_pb2.SubmitReply, rules={"new_count": COUNT, "known_count": COUNT}),
    plan(
        calls.ClaimRequest,
        jobs_pb2.ClaimRequest,
        rules={
            "kinds": Many(_JOB_KIND, 16, 1),
            "models": Many(LINE, 256),
            "worker": Text(129, 3, re.compile("[A-Za-z0-9_.-]+/[A-Za-z0-9_.-]+"), "service/instance"),
            "wait_s": Real(0.0, 3600.0),
            "claim_id": IDENTIFIER,
        },
    ),
    plan(
        calls.ClaimReply,
        jobs_pb2.ClaimReply,
        rules={"lease": Sub(_LEASE, optional=True)},
        max_bytes=2**23,
    ),
    plan(calls.HeartbeatRequest, jobs_pb2.HeartbeatRequest, rules={"lease_id": IDENTIFIER}),
    plan(calls.HeartbeatReply, jobs_pb2.HeartbeatReply, rules={"is_valid": Flag()}),
    plan(
        calls.DoneRequest,
        jobs_pb2.DoneRequest,
        rules={"job_id": IDENTIFIER, "lease_id": IDENTIFIER, "result": Sub(_APPEND_REQUEST)},
        bulk="result",
        max_bytes=MAX_CALL_BYTES,
    ),
    plan(
        calls.DoneReply,
        jobs_pb2.DoneReply,
        rules={"outcome": Choice(DoneOutcome, jobs_pb2.DoneOutcome), "sequence": INDEX},
    ),
    plan(
        calls.FailRequest,
        jobs_pb2.FailRequest,
        rules={
            "job_id": IDENTIFIER,
            "lease_id": IDENTIFIER,
            "reason": LINE,
            "traceback": LINES,
            "is_permanent": Flag(),
        },
        max_bytes=2**20,
    ),
    plan(calls.FailReply, jobs_pb2.FailReply, rules={"is_counted": Flag()}),
    plan(
        calls.ReportsRequest,
        jobs_pb2.ReportsRequest,
        rules={
            "state": Choice(JobState, jobs_pb2.JobState, none_if_unspecified=True),
            "after_job_id": Text(256, 0, re.compile("[!-~]*"), "a job id"),
            "limit": COUNT,
        },
    ),
    plan(
        calls.ReportsReply,
        jobs_pb2.ReportsReply,
        rules={"reports": Many(Sub(_JOB_REPORT), 2**16)},
        max_bytes=MAX_CALL_BYTES,
    ),
    plan(
        calls.CancelRequest,
        jobs_pb2.CancelRequest,
        rules={"job_ids": Many(IDENTIFIER, 2**16)},
        max_bytes=MAX_RECORD_BYTES,
    ),
    plan(calls.CancelReply, jobs_pb2.CancelReply, rules={"cancelled_count": COUNT}),
)
