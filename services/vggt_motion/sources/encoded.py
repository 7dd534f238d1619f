"""Encoded images: telling what bytes are without decoding them, and encoding what cannot be passed through."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion import MAX_IMAGE_PIXELS
from vggt_motion.errors import CodecError

JPEG = "image/jpeg"
PNG = "image/png"

# Video frames have lost their detail to the codec before: at 95 the second loss (0.4-1 grey levels rms) is below that
# of the first. Measured on 960x540: JPEG 95 takes 1.4 ms and 88 kB, PNG level 1 takes 21 ms and 375 kB.
VIDEO_JPEG_QUALITY = 95

# What the wire takes as a keyframe's image; a frame that is let in may become one.
MAX_BYTES = 128 * 2**20
MAX_SIDE_PX = 2**15

_JPEG_START = b"\xff\xd8\xff"
_JPEG_END = b"\xff\xd9"
_JPEG_SCAN = b"\xff\xda"
_PNG_START = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER = struct.Struct(">8s8sII9x")  # as far as the end of the first chunk
_PNG_FIRST_CHUNK = b"\x00\x00\x00\x0dIHDR"
_PNG_END = b"IEND"

# As libjpeg finds the next one: it passes over whatever stands before it. Those that stand alone say nothing here.
_JPEG_MARKER = re.compile(rb"\xff[\x02-\xcf\xd8-\xfe]")
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_PROGRESSIVE = frozenset({0xC2, 0xC6, 0xCA, 0xCE})
_START, _END, _SCAN = 0xD8, 0xD9, 0xDA
_MAX_SEGMENTS = 4096  # before the first scan; those of long metadata are some hundreds
_MAX_GAP_BYTES = 1024  # between two of them stands nothing, or a little filling
# Each scan of a JPEG that has several is a pass over all pixels, and costs its author a hundred bytes; usual are ten.
_MAX_SCANS = 100


@dataclass(frozen=True)
class ImageHead:
    """What a JPEG or PNG file says of itself before its pixels."""

    media_type: str
    width_px: int  # as stored: an orientation tag may ask for the sides to be swapped
    height_px: int
    scan_count: int = 1


def read_head(encoded: bytes) -> ImageHead | None:
    """Head of a whole JPEG or PNG file; None for anything else, and for a file that was cut off.

    Judged by content, never by name. Decoders differ in what they do with a file that ends early (some fill up with
    grey), so the end marker is looked for here. Inside entropy-coded data 0xFF is always stuffed, so the marker
    cannot occur by chance.
    """
    if encoded.startswith(_JPEG_START):
        return _read_jpeg(encoded)
    if encoded.startswith(_PNG_START) and encoded.rfind(_PNG_END) >= _PNG_HEADER.size:
        _, first_chunk, width, height = _PNG_HEADER.unpack_from(encoded)
        return ImageHead(PNG, width, height) if first_chunk == _PNG_FIRST_CHUNK else None
    return None


def is_jpeg_or_png(encoded: bytes) -> bool:
    """Whether the bytes begin as such a file does, whole or not."""
    return encoded.startswith((_JPEG_START, _PNG_START))


def _read_jpeg(encoded: bytes) -> ImageHead | None:
    at = len(_JPEG_START) - 1
    frame: tuple[int, int, int, int] | None = None  # marker, height, width, number of components
    for _ in range(_MAX_SEGMENTS):
        found = _JPEG_MARKER.search(encoded, at, at + _MAX_GAP_BYTES)
        if found is None or len(encoded) < found.end() + 8:
            return None
        marker, at = encoded[found.end() - 1], found.end()
        if marker in (_START, _END):
            return None
        (length,) = struct.unpack_from(">H", encoded, at)
        if marker == _SCAN:
            break
        if marker in _START_OF_FRAME:
            frame = (marker, *struct.unpack_from(">HHB", encoded, at + 3))
        at += length
    else:
        return None
    # Behind the head: a preview among the metadata has a scan and an end of its own.
    if frame is None or encoded.rfind(_JPEG_END) < at + length:
        return None
    marker, height, width, components = frame
    has_more_scans = marker in _PROGRESSIVE or encoded[at + 2] < components
    return ImageHead(JPEG, width, height, 1 + encoded.count(_JPEG_SCAN, at) if has_more_scans else 1)


def checked_media_type(encoded: bytes) -> str:
    """Media type of a whole JPEG or PNG file that may be a frame, told before anything of it is decoded.

    Raises:
        CodecError: it is no such file, was cut off, or has too many bytes, pixels or scans. Its text goes on
            after "the image is".
    """
    if len(encoded) > MAX_BYTES:
        raise CodecError(f"an image of {len(encoded)} bytes, allowed are {MAX_BYTES}")
    head = read_head(encoded)
    if head is None:
        raise CodecError("not a whole JPEG or PNG image")
    width, height = head.width_px, head.height_px
    if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX and width * height <= MAX_IMAGE_PIXELS):
        raise CodecError(
            f"an image of {width}x{height} pixels, allowed are {MAX_IMAGE_PIXELS} and {MAX_SIDE_PX} along a side"
        )
    if head.scan_count > _MAX_SCANS:
        raise CodecError(f"a JPEG image of {head.scan_count} scans, allowed are {_MAX_SCANS}")
    return head.media_type


def decode_rgb(encoded: bytes) -> npt.NDArray[np.uint8]:
    """Pixels of a JPEG or PNG file that may be a frame, (H, W, 3), red first.

    Raises:
        CodecError: as :func:`checked_media_type`, or it cannot be decoded.
    """
    checked_media_type(encoded)
    try:
        pixels = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR_RGB)
    except cv2.error as error:
        raise CodecError("not a readable image") from error
    if pixels is None:
        raise CodecError("not a readable image")
    return np.asarray(pixels, np.uint8)


def transcode_to_png(encoded: bytes) -> bytes:
    """Re-encode any other image that OpenCV reads (BMP, TIFF, WebP, PNM) as PNG, without loss.

    Raises:
        CodecError: OpenCV reads no 8-bit or 16-bit image from the bytes, or it is too large. Its text goes on after
            "the image is".
    """
    try:
        pixels: Any = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED) if encoded else None
        if pixels is not None and pixels.dtype in (np.uint8, np.uint16):
            ok, buffer = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            if ok:
                return buffer.tobytes()
    except cv2.error as error:
        raise CodecError(f"not a readable image of at most {MAX_IMAGE_PIXELS} pixels") from error
    raise CodecError("not a readable image")


def encode_video_frame(pixels: npt.NDArray[np.uint8]) -> bytes:
    """JPEG of one decoded video frame, (H, W, 3) BGR or (H, W) grey; the same pixels give the same bytes."""
    ok, buffer = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, VIDEO_JPEG_QUALITY])
    if not ok:
        raise ValueError(f"JPEG encoder refused an array of shape {pixels.shape}")
    encoded: bytes = buffer.tobytes()
    return encoded
