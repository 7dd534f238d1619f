from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class EventKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    EVENT_KIND_UNSPECIFIED: _ClassVar[EventKind]
    EVENT_KIND_SESSION_STARTED: _ClassVar[EventKind]
    EVENT_KIND_STREAM_ENDED: _ClassVar[EventKind]
    EVENT_KIND_JOB_DEAD: _ClassVar[EventKind]
    EVENT_KIND_WARNING: _ClassVar[EventKind]
    EVENT_KIND_RUN_ENDED: _ClassVar[EventKind]
EVENT_KIND_UNSPECIFIED: EventKind
EVENT_KIND_SESSION_STARTED: EventKind
EVENT_KIND_STREAM_ENDED: EventKind
EVENT_KIND_JOB_DEAD: EventKind
EVENT_KIND_WARNING: EventKind
EVENT_KIND_RUN_ENDED: EventKind

class Event(_message.Message):
    __slots__ = ("schema_version", "event_id", "kind", "message", "time_ns", "detail")
    class DetailEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    EVENT_ID_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    DETAIL_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    event_id: str
    kind: EventKind
    message: str
    time_ns: int
    detail: _containers.ScalarMap[str, str]
    def __init__(self, schema_version: _Optional[int] = ..., event_id: _Optional[str] = ..., kind: _Optional[_Union[EventKind, str]] = ..., message: _Optional[str] = ..., time_ns: _Optional[int] = ..., detail: _Optional[_Mapping[str, str]] = ...) -> None: ...
