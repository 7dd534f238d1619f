"""What travels on the image key: foxglove.CompressedImage, and, from those who number their frames, a header.

The payload is the plain Foxglove message, so that any bridge or robot can feed us and any viewer can look. The frontend
and a replay attach an ImageHeader, so that a recording keeps the very indices that the trajectory speaks of.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from google.protobuf.message import DecodeError

from vggt_motion import foxglove
from vggt_motion.errors import CodecError
from vggt_motion.sources.encoded import checked_media_type
from vggt_motion.sources.source import Frame
from vggt_motion.v1 import recording_pb2

_SCHEMA_VERSION = 1


@dataclass(frozen=True)
class ImageHeader:
    """Which frame this is, according to who published it."""

    epoch: int
    frame_index: int
    is_last: bool = False  # no frame follows
    is_accepted: bool = True  # epoch and index are those of the frontend's records; False for a replay

    def encode(self) -> bytes:
        """The attachment of the image's message."""
        return recording_pb2.ImageHeader(
            schema_version=_SCHEMA_VERSION,
            epoch=self.epoch,
            frame_index=self.frame_index,
            is_last=self.is_last,
            is_accepted=self.is_accepted,
        ).SerializeToString()


@dataclass(frozen=True)
class ReceivedImage:
    """One image from the image key."""

    encoded: bytes = field(repr=False)
    media_type: str
    capture_time_ns: int
    header: ImageHeader | None  # None from a bridge that does not number its frames


def encode_image(frame: Frame, camera: str) -> bytes:
    """Payload for the image key: a foxglove.CompressedImage with exactly the frame's bytes.

    Raises:
        CodecError: the frame's media type or time cannot travel.
    """
    return foxglove.encode_image(frame.encoded, frame.media_type, frame.capture_time_ns, camera)


def decode_image(payload: bytes, attachment: bytes = b"") -> ReceivedImage:
    """Read a message of the image key. Whoever reads them takes the same: what the frontend refuses is not recorded.

    Raises:
        CodecError: payload or attachment is malformed or of a newer schema, or the image is not a whole one of the
            type that the message gives, or too large.
    """
    encoded, media_type, time_ns = foxglove.decode_image(payload)
    found = checked_media_type(encoded)
    if found != media_type:
        raise CodecError(f"the image is {found}, its message says {media_type}")
    return ReceivedImage(encoded, media_type, time_ns, _decode_header(attachment) if attachment else None)


def _decode_header(attachment: bytes) -> ImageHeader:
    try:
        message = recording_pb2.ImageHeader.FromString(attachment)
    except DecodeError as error:
        raise CodecError("the attachment of an image is not an ImageHeader") from error
    if message.schema_version != _SCHEMA_VERSION:
        raise CodecError(f"image header of schema {message.schema_version}, known is {_SCHEMA_VERSION}")
    if message.frame_index >= 2**32:
        # MCAP numbers messages with 32 bits.
        raise CodecError(f"frame index {message.frame_index} is out of range")
    return ImageHeader(message.epoch, message.frame_index, message.is_last, message.is_accepted)
