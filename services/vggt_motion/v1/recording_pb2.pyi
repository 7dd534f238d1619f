from vggt_motion.v1 import common_pb2 as _common_pb2
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ImageHeader(_message.Message):
    __slots__ = ("schema_version", "epoch", "frame_index", "is_last", "is_accepted")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    FRAME_INDEX_FIELD_NUMBER: _ClassVar[int]
    IS_LAST_FIELD_NUMBER: _ClassVar[int]
    IS_ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    epoch: int
    frame_index: int
    is_last: bool
    is_accepted: bool
    def __init__(self, schema_version: _Optional[int] = ..., epoch: _Optional[int] = ..., frame_index: _Optional[int] = ..., is_last: bool = ..., is_accepted: bool = ...) -> None: ...

class Blob(_message.Message):
    __slots__ = ("schema_version", "ref", "data")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    REF_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    ref: _common_pb2.BlobRef
    data: bytes
    def __init__(self, schema_version: _Optional[int] = ..., ref: _Optional[_Union[_common_pb2.BlobRef, _Mapping]] = ..., data: _Optional[bytes] = ...) -> None: ...
