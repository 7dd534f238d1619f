from vggt_motion.v1 import common_pb2 as _common_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class RefusalCode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    REFUSAL_CODE_UNSPECIFIED: _ClassVar[RefusalCode]
    REFUSAL_CODE_INVALID: _ClassVar[RefusalCode]
    REFUSAL_CODE_CONFLICT: _ClassVar[RefusalCode]
    REFUSAL_CODE_DISK_FULL: _ClassVar[RefusalCode]
    REFUSAL_CODE_UNKNOWN: _ClassVar[RefusalCode]
    REFUSAL_CODE_GONE: _ClassVar[RefusalCode]
    REFUSAL_CODE_UNAVAILABLE: _ClassVar[RefusalCode]
    REFUSAL_CODE_INTERNAL: _ClassVar[RefusalCode]
REFUSAL_CODE_UNSPECIFIED: RefusalCode
REFUSAL_CODE_INVALID: RefusalCode
REFUSAL_CODE_CONFLICT: RefusalCode
REFUSAL_CODE_DISK_FULL: RefusalCode
REFUSAL_CODE_UNKNOWN: RefusalCode
REFUSAL_CODE_GONE: RefusalCode
REFUSAL_CODE_UNAVAILABLE: RefusalCode
REFUSAL_CODE_INTERNAL: RefusalCode

class Refusal(_message.Message):
    __slots__ = ("schema_version", "code", "message")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    CODE_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    code: RefusalCode
    message: str
    def __init__(self, schema_version: _Optional[int] = ..., code: _Optional[_Union[RefusalCode, str]] = ..., message: _Optional[str] = ...) -> None: ...

class AppendRequest(_message.Message):
    __slots__ = ("schema_version", "stream", "record_id", "payload_type", "payload", "identity_sha256", "blobs", "blob_refs")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    STREAM_FIELD_NUMBER: _ClassVar[int]
    RECORD_ID_FIELD_NUMBER: _ClassVar[int]
    PAYLOAD_TYPE_FIELD_NUMBER: _ClassVar[int]
    PAYLOAD_FIELD_NUMBER: _ClassVar[int]
    IDENTITY_SHA256_FIELD_NUMBER: _ClassVar[int]
    BLOBS_FIELD_NUMBER: _ClassVar[int]
    BLOB_REFS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    stream: str
    record_id: str
    payload_type: str
    payload: bytes
    identity_sha256: bytes
    blobs: _containers.RepeatedScalarFieldContainer[bytes]
    blob_refs: _containers.RepeatedCompositeFieldContainer[_common_pb2.BlobRef]
    def __init__(self, schema_version: _Optional[int] = ..., stream: _Optional[str] = ..., record_id: _Optional[str] = ..., payload_type: _Optional[str] = ..., payload: _Optional[bytes] = ..., identity_sha256: _Optional[bytes] = ..., blobs: _Optional[_Iterable[bytes]] = ..., blob_refs: _Optional[_Iterable[_Union[_common_pb2.BlobRef, _Mapping]]] = ...) -> None: ...

class AppendReply(_message.Message):
    __slots__ = ("schema_version", "sequence", "was_known")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    WAS_KNOWN_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    sequence: int
    was_known: bool
    def __init__(self, schema_version: _Optional[int] = ..., sequence: _Optional[int] = ..., was_known: bool = ...) -> None: ...

class LogEntry(_message.Message):
    __slots__ = ("schema_version", "stream", "sequence", "record_id", "payload_type", "payload", "append_time_ns")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    STREAM_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    RECORD_ID_FIELD_NUMBER: _ClassVar[int]
    PAYLOAD_TYPE_FIELD_NUMBER: _ClassVar[int]
    PAYLOAD_FIELD_NUMBER: _ClassVar[int]
    APPEND_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    stream: str
    sequence: int
    record_id: str
    payload_type: str
    payload: bytes
    append_time_ns: int
    def __init__(self, schema_version: _Optional[int] = ..., stream: _Optional[str] = ..., sequence: _Optional[int] = ..., record_id: _Optional[str] = ..., payload_type: _Optional[str] = ..., payload: _Optional[bytes] = ..., append_time_ns: _Optional[int] = ...) -> None: ...

class ReadRequest(_message.Message):
    __slots__ = ("schema_version", "stream", "from_sequence", "limit")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    STREAM_FIELD_NUMBER: _ClassVar[int]
    FROM_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    LIMIT_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    stream: str
    from_sequence: int
    limit: int
    def __init__(self, schema_version: _Optional[int] = ..., stream: _Optional[str] = ..., from_sequence: _Optional[int] = ..., limit: _Optional[int] = ...) -> None: ...

class ReadReply(_message.Message):
    __slots__ = ("schema_version", "entries", "next_sequence")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    ENTRIES_FIELD_NUMBER: _ClassVar[int]
    NEXT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    entries: _containers.RepeatedCompositeFieldContainer[LogEntry]
    next_sequence: int
    def __init__(self, schema_version: _Optional[int] = ..., entries: _Optional[_Iterable[_Union[LogEntry, _Mapping]]] = ..., next_sequence: _Optional[int] = ...) -> None: ...

class BlobsRequest(_message.Message):
    __slots__ = ("schema_version", "sha256")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    sha256: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, schema_version: _Optional[int] = ..., sha256: _Optional[_Iterable[str]] = ...) -> None: ...

class BlobsReply(_message.Message):
    __slots__ = ("schema_version", "blobs")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    BLOBS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    blobs: _containers.RepeatedScalarFieldContainer[bytes]
    def __init__(self, schema_version: _Optional[int] = ..., blobs: _Optional[_Iterable[bytes]] = ...) -> None: ...

class StatusRequest(_message.Message):
    __slots__ = ("schema_version",)
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    def __init__(self, schema_version: _Optional[int] = ...) -> None: ...

class StreamPosition(_message.Message):
    __slots__ = ("stream", "next_sequence")
    STREAM_FIELD_NUMBER: _ClassVar[int]
    NEXT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    stream: str
    next_sequence: int
    def __init__(self, stream: _Optional[str] = ..., next_sequence: _Optional[int] = ...) -> None: ...

class JobCount(_message.Message):
    __slots__ = ("kind", "state", "count")
    KIND_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    kind: str
    state: str
    count: int
    def __init__(self, kind: _Optional[str] = ..., state: _Optional[str] = ..., count: _Optional[int] = ...) -> None: ...

class LedgerStatus(_message.Message):
    __slots__ = ("schema_version", "positions", "job_counts", "stored_bytes", "free_bytes", "is_accepting", "detail", "refused_request_count", "ledger_id")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    POSITIONS_FIELD_NUMBER: _ClassVar[int]
    JOB_COUNTS_FIELD_NUMBER: _ClassVar[int]
    STORED_BYTES_FIELD_NUMBER: _ClassVar[int]
    FREE_BYTES_FIELD_NUMBER: _ClassVar[int]
    IS_ACCEPTING_FIELD_NUMBER: _ClassVar[int]
    DETAIL_FIELD_NUMBER: _ClassVar[int]
    REFUSED_REQUEST_COUNT_FIELD_NUMBER: _ClassVar[int]
    LEDGER_ID_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    positions: _containers.RepeatedCompositeFieldContainer[StreamPosition]
    job_counts: _containers.RepeatedCompositeFieldContainer[JobCount]
    stored_bytes: int
    free_bytes: int
    is_accepting: bool
    detail: str
    refused_request_count: int
    ledger_id: str
    def __init__(self, schema_version: _Optional[int] = ..., positions: _Optional[_Iterable[_Union[StreamPosition, _Mapping]]] = ..., job_counts: _Optional[_Iterable[_Union[JobCount, _Mapping]]] = ..., stored_bytes: _Optional[int] = ..., free_bytes: _Optional[int] = ..., is_accepting: bool = ..., detail: _Optional[str] = ..., refused_request_count: _Optional[int] = ..., ledger_id: _Optional[str] = ...) -> None: ...
