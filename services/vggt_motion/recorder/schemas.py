"""Message types as a recording describes them: full name, and a FileDescriptorSet with all that it depends on."""

from __future__ import annotations

from functools import cache

from foxglove_schemas_protobuf import (
    CompressedImage_pb2,
    FrameTransform_pb2,
    PointCloud_pb2,
    PoseInFrame_pb2,
    PosesInFrame_pb2,
)
from google.protobuf import descriptor_pb2
from google.protobuf.descriptor import Descriptor, FileDescriptor

from vggt_motion.errors import CodecError
from vggt_motion.v1 import (
    constraint_pb2,
    event_pb2,
    graph_pb2,
    keyframe_pb2,
    ledger_pb2,
    recording_pb2,
    segment_pb2,
    submap_pb2,
)

IMAGE = "foxglove.CompressedImage"
POSE = "foxglove.PoseInFrame"
TRAJECTORY = "foxglove.PosesInFrame"
POINTS = "foxglove.PointCloud"
TRANSFORM = "foxglove.FrameTransform"
BLOB = "vggt_motion.v1.Blob"
LOG_ENTRY = "vggt_motion.v1.LogEntry"

_FILES: tuple[FileDescriptor, ...] = tuple(
    module.DESCRIPTOR
    for module in (
        CompressedImage_pb2,
        FrameTransform_pb2,
        PointCloud_pb2,
        PoseInFrame_pb2,
        PosesInFrame_pb2,
        constraint_pb2,
        event_pb2,
        graph_pb2,
        keyframe_pb2,
        ledger_pb2,
        recording_pb2,
        segment_pb2,
        submap_pb2,
    )
)


@cache
def known_types() -> dict[str, Descriptor]:
    """Every message type that a recording may hold, by its full name."""
    return {message.full_name: message for file in _FILES for message in file.message_types_by_name.values()}


@cache
def schema_data(type_name: str) -> bytes:
    """Serialised FileDescriptorSet of a message type, dependencies before dependants.

    Raises:
        CodecError: the type is none of ours.
    """
    descriptor = known_types().get(type_name)
    if descriptor is None:
        raise CodecError(f"no schema is known for messages of type {type_name}")
    files: dict[str, FileDescriptor] = {}
    _collect(descriptor.file, files)
    collected = descriptor_pb2.FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(collected.file.add())
    return collected.SerializeToString(deterministic=True)


def _collect(file: FileDescriptor, files: dict[str, FileDescriptor]) -> None:
    if file.name in files:
        return
    for dependency in file.dependencies:
        _collect(dependency, files)
    files[file.name] = file
