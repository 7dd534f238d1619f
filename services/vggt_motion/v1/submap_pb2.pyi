from vggt_motion.v1 import common_pb2 as _common_pb2
from vggt_motion.v1 import keyframe_pb2 as _keyframe_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ScaleKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SCALE_KIND_UNSPECIFIED: _ClassVar[ScaleKind]
    SCALE_KIND_RELATIVE: _ClassVar[ScaleKind]
    SCALE_KIND_METRIC: _ClassVar[ScaleKind]

class SubmapVerdict(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SUBMAP_VERDICT_UNSPECIFIED: _ClassVar[SubmapVerdict]
    SUBMAP_VERDICT_GOOD: _ClassVar[SubmapVerdict]
    SUBMAP_VERDICT_LOW_QUALITY: _ClassVar[SubmapVerdict]
    SUBMAP_VERDICT_ROTATION_ONLY: _ClassVar[SubmapVerdict]
    SUBMAP_VERDICT_FAILED: _ClassVar[SubmapVerdict]

class DepthCodec(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DEPTH_CODEC_UNSPECIFIED: _ClassVar[DepthCodec]
    DEPTH_CODEC_F16_SHUFFLE_ZSTD: _ClassVar[DepthCodec]

class SubmapPart(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SUBMAP_PART_UNSPECIFIED: _ClassVar[SubmapPart]
    SUBMAP_PART_FIRST_HALF: _ClassVar[SubmapPart]
    SUBMAP_PART_SECOND_HALF: _ClassVar[SubmapPart]
SCALE_KIND_UNSPECIFIED: ScaleKind
SCALE_KIND_RELATIVE: ScaleKind
SCALE_KIND_METRIC: ScaleKind
SUBMAP_VERDICT_UNSPECIFIED: SubmapVerdict
SUBMAP_VERDICT_GOOD: SubmapVerdict
SUBMAP_VERDICT_LOW_QUALITY: SubmapVerdict
SUBMAP_VERDICT_ROTATION_ONLY: SubmapVerdict
SUBMAP_VERDICT_FAILED: SubmapVerdict
DEPTH_CODEC_UNSPECIFIED: DepthCodec
DEPTH_CODEC_F16_SHUFFLE_ZSTD: DepthCodec
SUBMAP_PART_UNSPECIFIED: SubmapPart
SUBMAP_PART_FIRST_HALF: SubmapPart
SUBMAP_PART_SECOND_HALF: SubmapPart

class FocalHint(_message.Message):
    __slots__ = ("focal_over_width", "relative_sigma", "radial_k1", "is_fixed", "intrinsics", "radial_shape")
    FOCAL_OVER_WIDTH_FIELD_NUMBER: _ClassVar[int]
    RELATIVE_SIGMA_FIELD_NUMBER: _ClassVar[int]
    RADIAL_K1_FIELD_NUMBER: _ClassVar[int]
    IS_FIXED_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    RADIAL_SHAPE_FIELD_NUMBER: _ClassVar[int]
    focal_over_width: float
    relative_sigma: float
    radial_k1: float
    is_fixed: bool
    intrinsics: _common_pb2.Intrinsics
    radial_shape: float
    def __init__(self, focal_over_width: _Optional[float] = ..., relative_sigma: _Optional[float] = ..., radial_k1: _Optional[float] = ..., is_fixed: bool = ..., intrinsics: _Optional[_Union[_common_pb2.Intrinsics, _Mapping]] = ..., radial_shape: _Optional[float] = ...) -> None: ...

class ZeroMotionCopy(_message.Message):
    __slots__ = ("copy_keyframe_id", "original_keyframe_id")
    COPY_KEYFRAME_ID_FIELD_NUMBER: _ClassVar[int]
    ORIGINAL_KEYFRAME_ID_FIELD_NUMBER: _ClassVar[int]
    copy_keyframe_id: str
    original_keyframe_id: str
    def __init__(self, copy_keyframe_id: _Optional[str] = ..., original_keyframe_id: _Optional[str] = ...) -> None: ...

class SubmapSpec(_message.Message):
    __slots__ = ("schema_version", "submap_index", "revision", "overlap_keyframe_ids", "base_keyframe_ids", "loop_keyframe_ids", "zero_motion_copies", "focal_hint", "ego_mask", "part")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    SUBMAP_INDEX_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    OVERLAP_KEYFRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    BASE_KEYFRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    LOOP_KEYFRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    ZERO_MOTION_COPIES_FIELD_NUMBER: _ClassVar[int]
    FOCAL_HINT_FIELD_NUMBER: _ClassVar[int]
    EGO_MASK_FIELD_NUMBER: _ClassVar[int]
    PART_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    submap_index: int
    revision: int
    overlap_keyframe_ids: _containers.RepeatedScalarFieldContainer[str]
    base_keyframe_ids: _containers.RepeatedScalarFieldContainer[str]
    loop_keyframe_ids: _containers.RepeatedScalarFieldContainer[str]
    zero_motion_copies: _containers.RepeatedCompositeFieldContainer[ZeroMotionCopy]
    focal_hint: FocalHint
    ego_mask: _common_pb2.BlobRef
    part: SubmapPart
    def __init__(self, schema_version: _Optional[int] = ..., submap_index: _Optional[int] = ..., revision: _Optional[int] = ..., overlap_keyframe_ids: _Optional[_Iterable[str]] = ..., base_keyframe_ids: _Optional[_Iterable[str]] = ..., loop_keyframe_ids: _Optional[_Iterable[str]] = ..., zero_motion_copies: _Optional[_Iterable[_Union[ZeroMotionCopy, _Mapping]]] = ..., focal_hint: _Optional[_Union[FocalHint, _Mapping]] = ..., ego_mask: _Optional[_Union[_common_pb2.BlobRef, _Mapping]] = ..., part: _Optional[_Union[SubmapPart, str]] = ...) -> None: ...

class FrameGeometry(_message.Message):
    __slots__ = ("keyframe_id", "intrinsics", "submap_from_camera", "depth", "codec")
    KEYFRAME_ID_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    SUBMAP_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    CODEC_FIELD_NUMBER: _ClassVar[int]
    keyframe_id: str
    intrinsics: _common_pb2.Intrinsics
    submap_from_camera: _containers.RepeatedScalarFieldContainer[float]
    depth: _common_pb2.BlobRef
    codec: DepthCodec
    def __init__(self, keyframe_id: _Optional[str] = ..., intrinsics: _Optional[_Union[_common_pb2.Intrinsics, _Mapping]] = ..., submap_from_camera: _Optional[_Iterable[float]] = ..., depth: _Optional[_Union[_common_pb2.BlobRef, _Mapping]] = ..., codec: _Optional[_Union[DepthCodec, str]] = ...) -> None: ...

class SubmapQuality(_message.Message):
    __slots__ = ("registered_frame_count", "mean_reprojection_error_px", "track_inlier_ratio", "median_parallax_deg", "focal_over_width", "focal_relative_sigma", "radial_k1", "attempts", "radial_shape")
    REGISTERED_FRAME_COUNT_FIELD_NUMBER: _ClassVar[int]
    MEAN_REPROJECTION_ERROR_PX_FIELD_NUMBER: _ClassVar[int]
    TRACK_INLIER_RATIO_FIELD_NUMBER: _ClassVar[int]
    MEDIAN_PARALLAX_DEG_FIELD_NUMBER: _ClassVar[int]
    FOCAL_OVER_WIDTH_FIELD_NUMBER: _ClassVar[int]
    FOCAL_RELATIVE_SIGMA_FIELD_NUMBER: _ClassVar[int]
    RADIAL_K1_FIELD_NUMBER: _ClassVar[int]
    ATTEMPTS_FIELD_NUMBER: _ClassVar[int]
    RADIAL_SHAPE_FIELD_NUMBER: _ClassVar[int]
    registered_frame_count: int
    mean_reprojection_error_px: float
    track_inlier_ratio: float
    median_parallax_deg: float
    focal_over_width: float
    focal_relative_sigma: float
    radial_k1: float
    attempts: _containers.RepeatedScalarFieldContainer[str]
    radial_shape: float
    def __init__(self, registered_frame_count: _Optional[int] = ..., mean_reprojection_error_px: _Optional[float] = ..., track_inlier_ratio: _Optional[float] = ..., median_parallax_deg: _Optional[float] = ..., focal_over_width: _Optional[float] = ..., focal_relative_sigma: _Optional[float] = ..., radial_k1: _Optional[float] = ..., attempts: _Optional[_Iterable[str]] = ..., radial_shape: _Optional[float] = ...) -> None: ...

class SubmapGeometry(_message.Message):
    __slots__ = ("schema_version", "spec", "verdict", "reason", "scale_kind", "model", "frames", "quality", "stage_seconds")
    class StageSecondsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    SPEC_FIELD_NUMBER: _ClassVar[int]
    VERDICT_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    SCALE_KIND_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    QUALITY_FIELD_NUMBER: _ClassVar[int]
    STAGE_SECONDS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    spec: SubmapSpec
    verdict: SubmapVerdict
    reason: str
    scale_kind: ScaleKind
    model: str
    frames: _containers.RepeatedCompositeFieldContainer[FrameGeometry]
    quality: SubmapQuality
    stage_seconds: _containers.ScalarMap[str, float]
    def __init__(self, schema_version: _Optional[int] = ..., spec: _Optional[_Union[SubmapSpec, _Mapping]] = ..., verdict: _Optional[_Union[SubmapVerdict, str]] = ..., reason: _Optional[str] = ..., scale_kind: _Optional[_Union[ScaleKind, str]] = ..., model: _Optional[str] = ..., frames: _Optional[_Iterable[_Union[FrameGeometry, _Mapping]]] = ..., quality: _Optional[_Union[SubmapQuality, _Mapping]] = ..., stage_seconds: _Optional[_Mapping[str, float]] = ...) -> None: ...

class PredictTask(_message.Message):
    __slots__ = ("schema_version", "spec", "keyframes")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    SPEC_FIELD_NUMBER: _ClassVar[int]
    KEYFRAMES_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    spec: SubmapSpec
    keyframes: _containers.RepeatedCompositeFieldContainer[_keyframe_pb2.Keyframe]
    def __init__(self, schema_version: _Optional[int] = ..., spec: _Optional[_Union[SubmapSpec, _Mapping]] = ..., keyframes: _Optional[_Iterable[_Union[_keyframe_pb2.Keyframe, _Mapping]]] = ...) -> None: ...
