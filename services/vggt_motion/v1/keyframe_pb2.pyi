from vggt_motion.v1 import common_pb2 as _common_pb2
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class MotionState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    MOTION_STATE_UNSPECIFIED: _ClassVar[MotionState]
    MOTION_STATE_STATIC: _ClassVar[MotionState]
    MOTION_STATE_TURNING: _ClassVar[MotionState]
    MOTION_STATE_LINEAR: _ClassVar[MotionState]
MOTION_STATE_UNSPECIFIED: MotionState
MOTION_STATE_STATIC: MotionState
MOTION_STATE_TURNING: MotionState
MOTION_STATE_LINEAR: MotionState

class Keyframe(_message.Message):
    __slots__ = ("schema_version", "camera", "epoch", "frame_index", "capture_time_ns", "state", "width_px", "height_px", "image", "zero_motion_copy_of")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    FRAME_INDEX_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    WIDTH_PX_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_PX_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    ZERO_MOTION_COPY_OF_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    camera: str
    epoch: int
    frame_index: int
    capture_time_ns: int
    state: MotionState
    width_px: int
    height_px: int
    image: _common_pb2.BlobRef
    zero_motion_copy_of: str
    def __init__(self, schema_version: _Optional[int] = ..., camera: _Optional[str] = ..., epoch: _Optional[int] = ..., frame_index: _Optional[int] = ..., capture_time_ns: _Optional[int] = ..., state: _Optional[_Union[MotionState, str]] = ..., width_px: _Optional[int] = ..., height_px: _Optional[int] = ..., image: _Optional[_Union[_common_pb2.BlobRef, _Mapping]] = ..., zero_motion_copy_of: _Optional[str] = ...) -> None: ...
