from vggt_motion.v1 import common_pb2 as _common_pb2
from vggt_motion.v1 import keyframe_pb2 as _keyframe_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class DropReason(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DROP_REASON_UNSPECIFIED: _ClassVar[DropReason]
    DROP_REASON_STATIC: _ClassVar[DropReason]
    DROP_REASON_LOW_PARALLAX: _ClassVar[DropReason]
    DROP_REASON_STRATEGY: _ClassVar[DropReason]
DROP_REASON_UNSPECIFIED: DropReason
DROP_REASON_STATIC: DropReason
DROP_REASON_LOW_PARALLAX: DropReason
DROP_REASON_STRATEGY: DropReason

class FrameEntry(_message.Message):
    __slots__ = ("frame_index", "capture_time_ns", "state", "is_keyframe", "drop_reason")
    FRAME_INDEX_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    IS_KEYFRAME_FIELD_NUMBER: _ClassVar[int]
    DROP_REASON_FIELD_NUMBER: _ClassVar[int]
    frame_index: int
    capture_time_ns: int
    state: _keyframe_pb2.MotionState
    is_keyframe: bool
    drop_reason: DropReason
    def __init__(self, frame_index: _Optional[int] = ..., capture_time_ns: _Optional[int] = ..., state: _Optional[_Union[_keyframe_pb2.MotionState, str]] = ..., is_keyframe: bool = ..., drop_reason: _Optional[_Union[DropReason, str]] = ...) -> None: ...

class Segment(_message.Message):
    __slots__ = ("schema_version", "index", "camera", "epoch", "base_keyframe_ids", "overlap_keyframe_ids", "frames", "closed_by", "ego_mask")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    INDEX_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    BASE_KEYFRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    OVERLAP_KEYFRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    CLOSED_BY_FIELD_NUMBER: _ClassVar[int]
    EGO_MASK_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    index: int
    camera: str
    epoch: int
    base_keyframe_ids: _containers.RepeatedScalarFieldContainer[str]
    overlap_keyframe_ids: _containers.RepeatedScalarFieldContainer[str]
    frames: _containers.RepeatedCompositeFieldContainer[FrameEntry]
    closed_by: str
    ego_mask: _common_pb2.BlobRef
    def __init__(self, schema_version: _Optional[int] = ..., index: _Optional[int] = ..., camera: _Optional[str] = ..., epoch: _Optional[int] = ..., base_keyframe_ids: _Optional[_Iterable[str]] = ..., overlap_keyframe_ids: _Optional[_Iterable[str]] = ..., frames: _Optional[_Iterable[_Union[FrameEntry, _Mapping]]] = ..., closed_by: _Optional[str] = ..., ego_mask: _Optional[_Union[_common_pb2.BlobRef, _Mapping]] = ...) -> None: ...
