"""The calls of ledger and job queue, and what carries them, as frozen dataclasses: ``proto/vggt_motion/v1``."""

from __future__ import annotations

from dataclasses import dataclass

from vggt_motion.bus.wire import Pieces
from vggt_motion.errors import RefusalCode
from vggt_motion.records import BlobRef, DoneOutcome, Job, JobKind, JobReport, JobState, Lease, LogEntry


@dataclass(frozen=True)
class Refusal:
    """Payload of every error reply."""

    code: RefusalCode
    message: str  # one line


@dataclass(frozen=True)
class Parcel:
    """Attachment of requests and answers between processes of one machine: where the payload is."""

    folder_id: str
    name: str = ""  # of a file in the folder; empty: the payload is in the message
    size_bytes: int = 0


@dataclass(frozen=True)
class Bundle:
    """Several requests to one key in one message."""

    requests: tuple[bytes | memoryview | Pieces, ...]


@dataclass(frozen=True)
class BundledAnswer:
    """What became of one of them."""

    payload: bytes
    refusal: Refusal | None = None


@dataclass(frozen=True)
class BundleReply:
    """In the order of the bundle."""

    answers: tuple[BundledAnswer, ...]


@dataclass(frozen=True)
class AppendRequest:
    """``@rpc/ledger/append``: make a record durable with its new blobs; idempotent by (stream, record_id)."""

    stream: str
    record_id: str
    payload_type: str  # full name of the message in ``payload``
    payload: bytes
    identity_sha256: bytes  # equal for two payloads if and only if they are the same record
    blobs: tuple[bytes | memoryview, ...] = ()
    blob_refs: tuple[BlobRef, ...] = ()  # everything that the record refers to; each in ``blobs`` or stored already


@dataclass(frozen=True)
class AppendReply:
    """Acknowledgement of an append."""

    sequence: int
    was_known: bool


@dataclass(frozen=True)
class ReadRequest:
    """``@rpc/ledger/read``."""

    stream: str
    from_sequence: int
    limit: int = 0  # 0 = as many as the ledger likes


@dataclass(frozen=True)
class ReadReply:
    """Entries in order and without gap; empty only at the end of the stream."""

    entries: tuple[LogEntry, ...]
    next_sequence: int  # that the next new record of the stream will get


@dataclass(frozen=True)
class BlobsRequest:
    """``@rpc/ledger/blobs``."""

    sha256: tuple[str, ...]


@dataclass(frozen=True)
class BlobsReply:
    """The first of what was asked for, in order; at least one."""

    blobs: tuple[bytes | memoryview, ...]


@dataclass(frozen=True)
class StatusRequest:
    """``@rpc/ledger/status``."""


@dataclass(frozen=True)
class SubmitRequest:
    """``@rpc/jobs/submit``."""

    jobs: tuple[Job, ...]


@dataclass(frozen=True)
class SubmitReply:
    """How many jobs were new and how many known."""

    new_count: int
    known_count: int


@dataclass(frozen=True)
class ClaimRequest:
    """``@rpc/jobs/claim``: long poll."""

    kinds: tuple[JobKind, ...]
    models: tuple[str, ...]
    worker: str  # "{service}/{instance}": the lease ends with the liveliness token alive/{worker}
    wait_s: float
    claim_id: str  # repeated with the same id: the same lease, while it is valid


@dataclass(frozen=True)
class ClaimReply:
    """None: no job came in time."""

    lease: Lease | None


@dataclass(frozen=True)
class HeartbeatRequest:
    """``@rpc/jobs/heartbeat``."""

    lease_id: str


@dataclass(frozen=True)
class HeartbeatReply:
    """False: the lease is gone."""

    is_valid: bool


@dataclass(frozen=True)
class DoneRequest:
    """``@rpc/jobs/done``."""

    job_id: str
    lease_id: str
    result: AppendRequest


@dataclass(frozen=True)
class DoneReply:
    """What became of the result."""

    outcome: DoneOutcome
    sequence: int = 0  # of the record, when committed


@dataclass(frozen=True)
class FailRequest:
    """``@rpc/jobs/fail``."""

    job_id: str
    lease_id: str
    reason: str  # one line
    traceback: str
    is_permanent: bool = False


@dataclass(frozen=True)
class FailReply:
    """False: the lease was gone, nothing was counted."""

    is_counted: bool


@dataclass(frozen=True)
class ReportsRequest:
    """``@rpc/jobs/reports``, in order of job id."""

    state: JobState | None = None
    after_job_id: str = ""
    limit: int = 0  # 0 = as many as the ledger likes


@dataclass(frozen=True)
class ReportsReply:
    """A page of reports; empty only at the end."""

    reports: tuple[JobReport, ...]


@dataclass(frozen=True)
class CancelRequest:
    """``@rpc/jobs/cancel``."""

    job_ids: tuple[str, ...]


@dataclass(frozen=True)
class CancelReply:
    """How many jobs were cancelled by this call."""

    cancelled_count: int
