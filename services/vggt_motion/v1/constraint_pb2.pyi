from vggt_motion.v1 import common_pb2 as _common_pb2
from vggt_motion.v1 import submap_pb2 as _submap_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ConstraintKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CONSTRAINT_KIND_UNSPECIFIED: _ClassVar[ConstraintKind]
    CONSTRAINT_KIND_ADJACENT: _ClassVar[ConstraintKind]
    CONSTRAINT_KIND_LOOP: _ClassVar[ConstraintKind]
CONSTRAINT_KIND_UNSPECIFIED: ConstraintKind
CONSTRAINT_KIND_ADJACENT: ConstraintKind
CONSTRAINT_KIND_LOOP: ConstraintKind

class RegistrationSpec(_message.Message):
    __slots__ = ("schema_version", "i", "j", "i_revision", "j_revision", "kind", "shared_keyframe_ids")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    I_FIELD_NUMBER: _ClassVar[int]
    J_FIELD_NUMBER: _ClassVar[int]
    I_REVISION_FIELD_NUMBER: _ClassVar[int]
    J_REVISION_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    SHARED_KEYFRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    i: int
    j: int
    i_revision: int
    j_revision: int
    kind: ConstraintKind
    shared_keyframe_ids: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, schema_version: _Optional[int] = ..., i: _Optional[int] = ..., j: _Optional[int] = ..., i_revision: _Optional[int] = ..., j_revision: _Optional[int] = ..., kind: _Optional[_Union[ConstraintKind, str]] = ..., shared_keyframe_ids: _Optional[_Iterable[str]] = ...) -> None: ...

class RegistrationAttempt(_message.Message):
    __slots__ = ("anchor", "keyframe_ids", "point_count", "inlier_ratio", "median_relative_residual", "outcome")
    ANCHOR_FIELD_NUMBER: _ClassVar[int]
    KEYFRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    POINT_COUNT_FIELD_NUMBER: _ClassVar[int]
    INLIER_RATIO_FIELD_NUMBER: _ClassVar[int]
    MEDIAN_RELATIVE_RESIDUAL_FIELD_NUMBER: _ClassVar[int]
    OUTCOME_FIELD_NUMBER: _ClassVar[int]
    anchor: str
    keyframe_ids: _containers.RepeatedScalarFieldContainer[str]
    point_count: int
    inlier_ratio: float
    median_relative_residual: float
    outcome: str
    def __init__(self, anchor: _Optional[str] = ..., keyframe_ids: _Optional[_Iterable[str]] = ..., point_count: _Optional[int] = ..., inlier_ratio: _Optional[float] = ..., median_relative_residual: _Optional[float] = ..., outcome: _Optional[str] = ...) -> None: ...

class Constraint(_message.Message):
    __slots__ = ("schema_version", "spec", "accepted", "reason", "j_from_i", "inlier_ratio", "median_relative_residual", "information", "point_count", "attempts")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    SPEC_FIELD_NUMBER: _ClassVar[int]
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    J_FROM_I_FIELD_NUMBER: _ClassVar[int]
    INLIER_RATIO_FIELD_NUMBER: _ClassVar[int]
    MEDIAN_RELATIVE_RESIDUAL_FIELD_NUMBER: _ClassVar[int]
    INFORMATION_FIELD_NUMBER: _ClassVar[int]
    POINT_COUNT_FIELD_NUMBER: _ClassVar[int]
    ATTEMPTS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    spec: RegistrationSpec
    accepted: bool
    reason: str
    j_from_i: _common_pb2.Sim3
    inlier_ratio: float
    median_relative_residual: float
    information: _containers.RepeatedScalarFieldContainer[float]
    point_count: int
    attempts: _containers.RepeatedCompositeFieldContainer[RegistrationAttempt]
    def __init__(self, schema_version: _Optional[int] = ..., spec: _Optional[_Union[RegistrationSpec, _Mapping]] = ..., accepted: bool = ..., reason: _Optional[str] = ..., j_from_i: _Optional[_Union[_common_pb2.Sim3, _Mapping]] = ..., inlier_ratio: _Optional[float] = ..., median_relative_residual: _Optional[float] = ..., information: _Optional[_Iterable[float]] = ..., point_count: _Optional[int] = ..., attempts: _Optional[_Iterable[_Union[RegistrationAttempt, _Mapping]]] = ...) -> None: ...

class SharedGeometry(_message.Message):
    __slots__ = ("in_i", "in_j")
    IN_I_FIELD_NUMBER: _ClassVar[int]
    IN_J_FIELD_NUMBER: _ClassVar[int]
    in_i: _submap_pb2.FrameGeometry
    in_j: _submap_pb2.FrameGeometry
    def __init__(self, in_i: _Optional[_Union[_submap_pb2.FrameGeometry, _Mapping]] = ..., in_j: _Optional[_Union[_submap_pb2.FrameGeometry, _Mapping]] = ...) -> None: ...

class RegisterTask(_message.Message):
    __slots__ = ("schema_version", "spec", "shared", "fix_scale")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    SPEC_FIELD_NUMBER: _ClassVar[int]
    SHARED_FIELD_NUMBER: _ClassVar[int]
    FIX_SCALE_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    spec: RegistrationSpec
    shared: _containers.RepeatedCompositeFieldContainer[SharedGeometry]
    fix_scale: bool
    def __init__(self, schema_version: _Optional[int] = ..., spec: _Optional[_Union[RegistrationSpec, _Mapping]] = ..., shared: _Optional[_Iterable[_Union[SharedGeometry, _Mapping]]] = ..., fix_scale: bool = ...) -> None: ...
