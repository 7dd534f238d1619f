from vggt_motion.v1 import ledger_pb2 as _ledger_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Bundle(_message.Message):
    __slots__ = ("schema_version", "requests")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    REQUESTS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    requests: _containers.RepeatedScalarFieldContainer[bytes]
    def __init__(self, schema_version: _Optional[int] = ..., requests: _Optional[_Iterable[bytes]] = ...) -> None: ...

class BundledAnswer(_message.Message):
    __slots__ = ("payload", "refusal")
    PAYLOAD_FIELD_NUMBER: _ClassVar[int]
    REFUSAL_FIELD_NUMBER: _ClassVar[int]
    payload: bytes
    refusal: _ledger_pb2.Refusal
    def __init__(self, payload: _Optional[bytes] = ..., refusal: _Optional[_Union[_ledger_pb2.Refusal, _Mapping]] = ...) -> None: ...

class BundleReply(_message.Message):
    __slots__ = ("schema_version", "answers")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    ANSWERS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    answers: _containers.RepeatedCompositeFieldContainer[BundledAnswer]
    def __init__(self, schema_version: _Optional[int] = ..., answers: _Optional[_Iterable[_Union[BundledAnswer, _Mapping]]] = ...) -> None: ...
