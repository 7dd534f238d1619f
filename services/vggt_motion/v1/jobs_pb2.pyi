from vggt_motion.v1 import ledger_pb2 as _ledger_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class JobKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    JOB_KIND_UNSPECIFIED: _ClassVar[JobKind]
    JOB_KIND_DESCRIBE: _ClassVar[JobKind]
    JOB_KIND_PREDICT: _ClassVar[JobKind]
    JOB_KIND_REGISTER: _ClassVar[JobKind]

class JobState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    JOB_STATE_UNSPECIFIED: _ClassVar[JobState]
    JOB_STATE_OPEN: _ClassVar[JobState]
    JOB_STATE_LEASED: _ClassVar[JobState]
    JOB_STATE_DONE: _ClassVar[JobState]
    JOB_STATE_DEAD: _ClassVar[JobState]
    JOB_STATE_CANCELLED: _ClassVar[JobState]

class DoneOutcome(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DONE_OUTCOME_UNSPECIFIED: _ClassVar[DoneOutcome]
    DONE_OUTCOME_COMMITTED: _ClassVar[DoneOutcome]
    DONE_OUTCOME_ALREADY_DONE: _ClassVar[DoneOutcome]
    DONE_OUTCOME_DROPPED: _ClassVar[DoneOutcome]
JOB_KIND_UNSPECIFIED: JobKind
JOB_KIND_DESCRIBE: JobKind
JOB_KIND_PREDICT: JobKind
JOB_KIND_REGISTER: JobKind
JOB_STATE_UNSPECIFIED: JobState
JOB_STATE_OPEN: JobState
JOB_STATE_LEASED: JobState
JOB_STATE_DONE: JobState
JOB_STATE_DEAD: JobState
JOB_STATE_CANCELLED: JobState
DONE_OUTCOME_UNSPECIFIED: DoneOutcome
DONE_OUTCOME_COMMITTED: DoneOutcome
DONE_OUTCOME_ALREADY_DONE: DoneOutcome
DONE_OUTCOME_DROPPED: DoneOutcome

class Job(_message.Message):
    __slots__ = ("schema_version", "job_id", "kind", "payload", "payload_type", "priority", "model")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    JOB_ID_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    PAYLOAD_FIELD_NUMBER: _ClassVar[int]
    PAYLOAD_TYPE_FIELD_NUMBER: _ClassVar[int]
    PRIORITY_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    job_id: str
    kind: JobKind
    payload: bytes
    payload_type: str
    priority: int
    model: str
    def __init__(self, schema_version: _Optional[int] = ..., job_id: _Optional[str] = ..., kind: _Optional[_Union[JobKind, str]] = ..., payload: _Optional[bytes] = ..., payload_type: _Optional[str] = ..., priority: _Optional[int] = ..., model: _Optional[str] = ...) -> None: ...

class Lease(_message.Message):
    __slots__ = ("schema_version", "job", "lease_id", "attempt", "duration_s")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    JOB_FIELD_NUMBER: _ClassVar[int]
    LEASE_ID_FIELD_NUMBER: _ClassVar[int]
    ATTEMPT_FIELD_NUMBER: _ClassVar[int]
    DURATION_S_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    job: Job
    lease_id: str
    attempt: int
    duration_s: float
    def __init__(self, schema_version: _Optional[int] = ..., job: _Optional[_Union[Job, _Mapping]] = ..., lease_id: _Optional[str] = ..., attempt: _Optional[int] = ..., duration_s: _Optional[float] = ...) -> None: ...

class JobReport(_message.Message):
    __slots__ = ("schema_version", "job_id", "kind", "state", "failure_count", "lost_lease_count", "worker", "last_reason", "last_traceback")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    JOB_ID_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    FAILURE_COUNT_FIELD_NUMBER: _ClassVar[int]
    LOST_LEASE_COUNT_FIELD_NUMBER: _ClassVar[int]
    WORKER_FIELD_NUMBER: _ClassVar[int]
    LAST_REASON_FIELD_NUMBER: _ClassVar[int]
    LAST_TRACEBACK_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    job_id: str
    kind: JobKind
    state: JobState
    failure_count: int
    lost_lease_count: int
    worker: str
    last_reason: str
    last_traceback: str
    def __init__(self, schema_version: _Optional[int] = ..., job_id: _Optional[str] = ..., kind: _Optional[_Union[JobKind, str]] = ..., state: _Optional[_Union[JobState, str]] = ..., failure_count: _Optional[int] = ..., lost_lease_count: _Optional[int] = ..., worker: _Optional[str] = ..., last_reason: _Optional[str] = ..., last_traceback: _Optional[str] = ...) -> None: ...

class SubmitRequest(_message.Message):
    __slots__ = ("schema_version", "jobs")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    JOBS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    jobs: _containers.RepeatedCompositeFieldContainer[Job]
    def __init__(self, schema_version: _Optional[int] = ..., jobs: _Optional[_Iterable[_Union[Job, _Mapping]]] = ...) -> None: ...

class SubmitReply(_message.Message):
    __slots__ = ("schema_version", "new_count", "known_count")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    NEW_COUNT_FIELD_NUMBER: _ClassVar[int]
    KNOWN_COUNT_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    new_count: int
    known_count: int
    def __init__(self, schema_version: _Optional[int] = ..., new_count: _Optional[int] = ..., known_count: _Optional[int] = ...) -> None: ...

class ClaimRequest(_message.Message):
    __slots__ = ("schema_version", "kinds", "models", "worker", "wait_s", "claim_id")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    KINDS_FIELD_NUMBER: _ClassVar[int]
    MODELS_FIELD_NUMBER: _ClassVar[int]
    WORKER_FIELD_NUMBER: _ClassVar[int]
    WAIT_S_FIELD_NUMBER: _ClassVar[int]
    CLAIM_ID_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    kinds: _containers.RepeatedScalarFieldContainer[JobKind]
    models: _containers.RepeatedScalarFieldContainer[str]
    worker: str
    wait_s: float
    claim_id: str
    def __init__(self, schema_version: _Optional[int] = ..., kinds: _Optional[_Iterable[_Union[JobKind, str]]] = ..., models: _Optional[_Iterable[str]] = ..., worker: _Optional[str] = ..., wait_s: _Optional[float] = ..., claim_id: _Optional[str] = ...) -> None: ...

class ClaimReply(_message.Message):
    __slots__ = ("schema_version", "lease")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    LEASE_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    lease: Lease
    def __init__(self, schema_version: _Optional[int] = ..., lease: _Optional[_Union[Lease, _Mapping]] = ...) -> None: ...

class HeartbeatRequest(_message.Message):
    __slots__ = ("schema_version", "lease_id")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    LEASE_ID_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    lease_id: str
    def __init__(self, schema_version: _Optional[int] = ..., lease_id: _Optional[str] = ...) -> None: ...

class HeartbeatReply(_message.Message):
    __slots__ = ("schema_version", "is_valid")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    IS_VALID_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    is_valid: bool
    def __init__(self, schema_version: _Optional[int] = ..., is_valid: bool = ...) -> None: ...

class DoneRequest(_message.Message):
    __slots__ = ("schema_version", "job_id", "lease_id", "result")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    JOB_ID_FIELD_NUMBER: _ClassVar[int]
    LEASE_ID_FIELD_NUMBER: _ClassVar[int]
    RESULT_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    job_id: str
    lease_id: str
    result: _ledger_pb2.AppendRequest
    def __init__(self, schema_version: _Optional[int] = ..., job_id: _Optional[str] = ..., lease_id: _Optional[str] = ..., result: _Optional[_Union[_ledger_pb2.AppendRequest, _Mapping]] = ...) -> None: ...

class DoneReply(_message.Message):
    __slots__ = ("schema_version", "outcome", "sequence")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    OUTCOME_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    outcome: DoneOutcome
    sequence: int
    def __init__(self, schema_version: _Optional[int] = ..., outcome: _Optional[_Union[DoneOutcome, str]] = ..., sequence: _Optional[int] = ...) -> None: ...

class FailRequest(_message.Message):
    __slots__ = ("schema_version", "job_id", "lease_id", "reason", "traceback", "is_permanent")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    JOB_ID_FIELD_NUMBER: _ClassVar[int]
    LEASE_ID_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    TRACEBACK_FIELD_NUMBER: _ClassVar[int]
    IS_PERMANENT_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    job_id: str
    lease_id: str
    reason: str
    traceback: str
    is_permanent: bool
    def __init__(self, schema_version: _Optional[int] = ..., job_id: _Optional[str] = ..., lease_id: _Optional[str] = ..., reason: _Optional[str] = ..., traceback: _Optional[str] = ..., is_permanent: bool = ...) -> None: ...

class FailReply(_message.Message):
    __slots__ = ("schema_version", "is_counted")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    IS_COUNTED_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    is_counted: bool
    def __init__(self, schema_version: _Optional[int] = ..., is_counted: bool = ...) -> None: ...

class ReportsRequest(_message.Message):
    __slots__ = ("schema_version", "state", "after_job_id", "limit")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    AFTER_JOB_ID_FIELD_NUMBER: _ClassVar[int]
    LIMIT_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    state: JobState
    after_job_id: str
    limit: int
    def __init__(self, schema_version: _Optional[int] = ..., state: _Optional[_Union[JobState, str]] = ..., after_job_id: _Optional[str] = ..., limit: _Optional[int] = ...) -> None: ...

class ReportsReply(_message.Message):
    __slots__ = ("schema_version", "reports")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    REPORTS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    reports: _containers.RepeatedCompositeFieldContainer[JobReport]
    def __init__(self, schema_version: _Optional[int] = ..., reports: _Optional[_Iterable[_Union[JobReport, _Mapping]]] = ...) -> None: ...

class CancelRequest(_message.Message):
    __slots__ = ("schema_version", "job_ids")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    JOB_IDS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    job_ids: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, schema_version: _Optional[int] = ..., job_ids: _Optional[_Iterable[str]] = ...) -> None: ...

class CancelReply(_message.Message):
    __slots__ = ("schema_version", "cancelled_count")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    CANCELLED_COUNT_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    cancelled_count: int
    def __init__(self, schema_version: _Optional[int] = ..., cancelled_count: _Optional[int] = ...) -> None: ...
