"""Frames, poses and points as Foxglove messages, and images back: the one place where ``foxglove.*`` is touched.

The messages are those of https://docs.foxglove.dev/docs/visualization/message-schemas/introduction, their code is that
of the package ``foxglove-schemas-protobuf``. Frames of reference:

- ``map``: axes for people, x forward, y left, z up; drawn upright by any viewer.
- ``world``: the frame of the trajectory, with the axes of the first camera (x right, y down, z forward).
- ``camera/<name>``: the camera, OpenCV axes, as CompressedImage demands.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp

from vggt_motion.errors import CodecError
from vggt_motion.geometry import se3
from vggt_motion.sources.timing import MAX_TIME_NS

MAP_FRAME = "map"
WORLD_FRAME = "world"
# Turns OpenCV axes upright: forward (z) becomes x, left (-x) becomes y, up (-y) becomes z.
MAP_FROM_WORLD = se3.make(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))

_NANOSECONDS = 1_000_000_000
_MAX_TIME_NS = 2**63 - 1
_FORMAT_OF_MEDIA_TYPE = {"image/jpeg": "jpeg", "image/png": "png"}
_MEDIA_TYPE_OF_FORMAT = {"jpeg": "image/jpeg", "jpg": "image/jpeg", "png": "image/png"}
_POINT = np.dtype([("xyz", "<f4", (3,)), ("rgba", "u1", (4,))])


def camera_frame(camera: str) -> str:
    """Name of a camera's frame of reference."""
    return f"camera/{camera}"


def world_frame(component: int) -> str:
    """Frame of one connected part of the trajectory; parts behind a break share no frame with the first."""
    return WORLD_FRAME if component == 0 else f"{WORLD_FRAME}/{component}"


def encode_image(encoded: bytes, media_type: str, capture_time_ns: int, camera: str) -> bytes:
    """A foxglove.CompressedImage with exactly these image bytes.

    Raises:
        CodecError: the media type has no Foxglove format, or the time is negative.
    """
    image_format = _FORMAT_OF_MEDIA_TYPE.get(media_type)
    if image_format is None:
        raise CodecError(f"images of type {media_type} cannot travel, only JPEG and PNG can")
    message = CompressedImage(
        timestamp=_timestamp(capture_time_ns), frame_id=camera_frame(camera), data=encoded, format=image_format
    )
    return message.SerializeToString()


def decode_image(payload: bytes) -> tuple[bytes, str, int]:
    """Image bytes, media type and capture time in nanoseconds of a foxglove.CompressedImage.

    Raises:
        CodecError: not such a message, without image bytes, of a format that we do not read, or its time is impossible.
    """
    try:
        message = CompressedImage.FromString(payload)
    except DecodeError as error:
        raise CodecError("not a foxglove.CompressedImage") from error
    media_type = _MEDIA_TYPE_OF_FORMAT.get(message.format.lower())
    if media_type is None:
        raise CodecError(f"image format {message.format[:20]!r} is not read, only jpeg and png are")
    if not 0 <= message.timestamp.nanos < _NANOSECONDS:
        raise CodecError(f"image timestamp has {message.timestamp.nanos} nanoseconds")
    time_ns = message.timestamp.seconds * _NANOSECONDS + message.timestamp.nanos
    if not 0 <= time_ns <= MAX_TIME_NS:
        raise CodecError(f"image timestamp of {message.timestamp.seconds} s is out of range")
    encoded = message.data
    if not encoded:
        raise CodecError("image message without image bytes")
    return encoded, media_type, time_ns


def pose_in_frame(world_from_camera: npt.NDArray[np.float64], frame_id: str, capture_time_ns: int) -> bytes:
    """A foxglove.PoseInFrame of a (4, 4) rigid transform."""
    return PoseInFrame(
        timestamp=_timestamp(capture_time_ns), frame_id=frame_id, pose=_pose(world_from_camera)
    ).SerializeToString()


def poses_in_frame(world_from_camera: Sequence[npt.NDArray[np.float64]], frame_id: str, capture_time_ns: int) -> bytes:
    """A foxglove.PosesInFrame of (4, 4) rigid transforms; the time is that of the last pose."""
    return PosesInFrame(
        timestamp=_timestamp(capture_time_ns), frame_id=frame_id, poses=[_pose(pose) for pose in world_from_camera]
    ).SerializeToString()


def frame_transform(
    parent_from_child: npt.NDArray[np.float64], parent_frame: str, child_frame: str, time_ns: int
) -> bytes:
    """A foxglove.FrameTransform of a (4, 4) rigid transform."""
    pose = _pose(parent_from_child)
    return FrameTransform(
        timestamp=_timestamp(time_ns),
        parent_frame_id=parent_frame,
        child_frame_id=child_frame,
        translation=pose.position,
        rotation=pose.orientation,
    ).SerializeToString()


def point_cloud(points: npt.NDArray[np.floating], colours: npt.NDArray[np.uint8], frame_id: str, time_ns: int) -> bytes:
    """A foxglove.PointCloud of points (N, 3) in the frame's units with colours (N, 3) RGB; 16 bytes a point."""
    packed = np.empty(len(points), dtype=_POINT)
    packed["xyz"] = points
    packed["rgba"][:, :3] = colours
    packed["rgba"][:, 3] = 255
    fields = [
        PackedElementField(name=name, offset=4 * k, type=PackedElementField.FLOAT32) for k, name in enumerate("xyz")
    ] + [
        PackedElementField(name=name, offset=12 + k, type=PackedElementField.UINT8)
        for k, name in enumerate(("red", "green", "blue", "alpha"))
    ]
    return PointCloud(
        timestamp=_timestamp(time_ns),
        frame_id=frame_id,
        pose=_pose(np.eye(4)),
        point_stride=_POINT.itemsize,
        fields=fields,
        data=packed.tobytes(),
    ).SerializeToString()


def _timestamp(time_ns: int) -> Timestamp:
    if not 0 <= time_ns <= _MAX_TIME_NS:
        raise CodecError(f"{time_ns} ns is not a time that can be recorded")
    seconds, nanos = divmod(time_ns, _NANOSECONDS)
    return Timestamp(seconds=seconds, nanos=nanos)


def _pose(target_from_source: npt.NDArray[np.float64]) -> Pose:
    w, x, y, z = (float(value) for value in se3.quaternion_from_rotation(target_from_source[:3, :3]))
    tx, ty, tz = (float(value) for value in target_from_source[:3, 3])
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = tx, ty, tz
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = x, y, z, w
    return pose
