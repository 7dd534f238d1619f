from vggt_motion.v1 import common_pb2 as _common_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class SubmapPose(_message.Message):
    __slots__ = ("submap_index", "submap_revision", "component", "world_from_submap")
    SUBMAP_INDEX_FIELD_NUMBER: _ClassVar[int]
    SUBMAP_REVISION_FIELD_NUMBER: _ClassVar[int]
    COMPONENT_FIELD_NUMBER: _ClassVar[int]
    WORLD_FROM_SUBMAP_FIELD_NUMBER: _ClassVar[int]
    submap_index: int
    submap_revision: int
    component: int
    world_from_submap: _common_pb2.Sim3
    def __init__(self, submap_index: _Optional[int] = ..., submap_revision: _Optional[int] = ..., component: _Optional[int] = ..., world_from_submap: _Optional[_Union[_common_pb2.Sim3, _Mapping]] = ...) -> None: ...

class EdgeReport(_message.Message):
    __slots__ = ("constraint_id", "weighted_residual", "is_used", "robust_weight")
    CONSTRAINT_ID_FIELD_NUMBER: _ClassVar[int]
    WEIGHTED_RESIDUAL_FIELD_NUMBER: _ClassVar[int]
    IS_USED_FIELD_NUMBER: _ClassVar[int]
    ROBUST_WEIGHT_FIELD_NUMBER: _ClassVar[int]
    constraint_id: str
    weighted_residual: float
    is_used: bool
    robust_weight: float
    def __init__(self, constraint_id: _Optional[str] = ..., weighted_residual: _Optional[float] = ..., is_used: bool = ..., robust_weight: _Optional[float] = ...) -> None: ...

class GraphUpdate(_message.Message):
    __slots__ = ("schema_version", "revision", "is_final", "poses", "edges", "breaks", "final_cost")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    IS_FINAL_FIELD_NUMBER: _ClassVar[int]
    POSES_FIELD_NUMBER: _ClassVar[int]
    EDGES_FIELD_NUMBER: _ClassVar[int]
    BREAKS_FIELD_NUMBER: _ClassVar[int]
    FINAL_COST_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    revision: int
    is_final: bool
    poses: _containers.RepeatedCompositeFieldContainer[SubmapPose]
    edges: _containers.RepeatedCompositeFieldContainer[EdgeReport]
    breaks: _containers.RepeatedScalarFieldContainer[str]
    final_cost: float
    def __init__(self, schema_version: _Optional[int] = ..., revision: _Optional[int] = ..., is_final: bool = ..., poses: _Optional[_Iterable[_Union[SubmapPose, _Mapping]]] = ..., edges: _Optional[_Iterable[_Union[EdgeReport, _Mapping]]] = ..., breaks: _Optional[_Iterable[str]] = ..., final_cost: _Optional[float] = ...) -> None: ...
