"""The depth blob: float16 depth, byte-shuffled, and uint8 confidence under zstd, with a header that bounds decoding.

Layout, little-endian: magic ``VMD1`` (4 bytes), version (u8), 0 (u8), scale exponent ``e`` (i16), width (u32), height
(u32), CRC-32 of the 16 bytes before (u32); then one zstd frame with content size and checksum: the low bytes of all
float16 values, their high bytes, and one confidence byte per pixel. Depth is ``float16 * 2**e``: one power of two per
map puts its largest value just below 2**15, so that any submap unit fits and 29 octaves below keep full precision.
"""

from __future__ import annotations

import math
import struct
import threading
import zlib

import numpy as np
import numpy.typing as npt
import zstandard

from vggt_motion.errors import CodecError

MEDIA_TYPE = "application/vnd.vggt-motion.depth"
MAX_PIXELS = 2**24
MAX_SIDE_PX = 2**15
DEPTH_RELATIVE_ERROR = 2.0**-11  # of float16 rounding: below 5e-4
_MAGIC = b"VMD1"
_VERSION = 1
_FIELDS = struct.Struct("<4sBBhII")
_CHECKED = struct.Struct("<I")
_HEADER_BYTES = _FIELDS.size + _CHECKED.size
_BYTES_PER_PIXEL = 3
_TOP_EXPONENT = 15  # scaled depth is at most 2**15, well inside float16
_MIN_EXPONENT, _MAX_EXPONENT = -112, 111  # 2**e times any normal float16 is a normal float32
_MAX_DEPTH = 2.0**126
_MIN_NORMAL = np.float32(2.0**-14)
_MIN_HIGH_BYTE, _MAX_HIGH_BYTE = 0x04, 0x7B  # of a normal float16 that is not negative
_LEVEL = 1
_of_thread = threading.local()

Depth = npt.NDArray[np.float32]


def encode_depth(depth: npt.NDArray[np.floating], confidence: npt.NDArray[np.floating]) -> bytes:
    """Encode one depth map.

    Positive depth more than 29 octaves below the largest one cannot be held to float16 precision and becomes unknown.

    Args:
        depth: (H, W) along the optical axis, any unit; finite, not negative, 0 where unknown.
        confidence: (H, W) in [0, 1]; counts as 0 where depth is unknown.

    Returns:
        The blob. Depth comes back with a relative error below 5e-4, confidence to 1/510.

    Raises:
        CodecError: shapes differ, or a value is NaN, infinite, negative or above 1.
    """
    with np.errstate(over="ignore"):  # becomes infinite, and is refused below
        depth32 = np.asarray(depth, dtype=np.float32)
    confidence32 = np.asarray(confidence, dtype=np.float32)
    if depth32.ndim != 2 or depth32.shape != confidence32.shape:
        raise CodecError(f"depth {depth32.shape} and confidence {confidence32.shape} must be one (height, width)")
    height, width = depth32.shape
    _check_size(width, height)
    largest = float(depth32.max())
    if not (depth32.min() >= 0.0 and largest <= _MAX_DEPTH):  # a NaN anywhere makes the minimum NaN
        raise CodecError("depth must be finite and not negative, and below 2**126")
    if not (confidence32.min() >= 0.0 and confidence32.max() <= 1.0):
        raise CodecError("confidence must be in [0, 1]")
    exponent = 0
    if largest > 0.0:
        exponent = min(max(math.frexp(largest)[1] - _TOP_EXPONENT, _MIN_EXPONENT), _MAX_EXPONENT)
    scaled = np.ldexp(depth32, -exponent)
    is_known = scaled >= _MIN_NORMAL
    halves = np.where(is_known, scaled, np.float32(0.0)).astype("<f2")
    levels = np.where(is_known, np.rint(confidence32 * np.float32(255.0)), np.float32(0.0)).astype(np.uint8)
    pixels = height * width
    raw = np.empty(_BYTES_PER_PIXEL * pixels, dtype=np.uint8)
    planes = halves.reshape(-1).view(np.uint8).reshape(-1, 2)
    raw[:pixels] = planes[:, 0]
    raw[pixels : 2 * pixels] = planes[:, 1]
    raw[2 * pixels :] = levels.reshape(-1)
    header = _FIELDS.pack(_MAGIC, _VERSION, 0, exponent, width, height)
    compressor = zstandard.ZstdCompressor(level=_LEVEL, write_checksum=True, write_content_size=True)
    return b"".join((header, _CHECKED.pack(zlib.crc32(header)), compressor.compress(raw.data)))


def decode_depth(payload: bytes | memoryview) -> tuple[Depth, Depth]:
    """Decode a depth blob; the inverse of :func:`encode_depth`.

    Never allocates more than the header declares, and the header cannot declare more than ``MAX_PIXELS``.

    Returns:
        Depth (H, W) float32 in the unit it was given in, 0 where unknown, and confidence (H, W) float32 in [0, 1].

    Raises:
        CodecError: not a depth blob, damaged, of a newer version, too large, or with a value that no encoder writes.
    """
    (height, width), exponent, planes = _planes(payload)
    interleaved = np.empty((height * width, 2), dtype=np.uint8)
    interleaved[:, 0] = planes[0]
    interleaved[:, 1] = planes[1]
    bits = interleaved.reshape(-1).view("<f2")
    depth = np.ldexp(bits.astype(np.float32), exponent).reshape(height, width)
    confidence = (planes[2].astype(np.float32) * np.float32(1.0 / 255.0)).reshape(height, width)
    return depth, confidence


def check_depth(payload: bytes | memoryview) -> tuple[int, int]:
    """Whether :func:`decode_depth` takes a blob; returns its height and width in pixels.

    Raises:
        CodecError: see there.
    """
    return _planes(payload)[0]


def _planes(payload: bytes | memoryview) -> tuple[tuple[int, int], int, npt.NDArray[np.uint8]]:
    """Height and width, scale exponent, and low bytes, high bytes and confidence (3, H * W); checked."""
    if len(payload) < _HEADER_BYTES or payload[:4] != _MAGIC:
        raise CodecError("depth blob: not a depth blob")
    _, version, reserved, exponent, width, height = _FIELDS.unpack_from(payload)
    if zlib.crc32(payload[: _FIELDS.size]) != _CHECKED.unpack_from(payload, _FIELDS.size)[0]:
        raise CodecError("depth blob: damaged header")
    if version != _VERSION or reserved != 0:
        raise CodecError(f"depth blob: version {version} is not known here (known: {_VERSION})")
    _check_size(width, height)
    if not _MIN_EXPONENT <= exponent <= _MAX_EXPONENT:
        raise CodecError(f"depth blob: scale exponent {exponent} is out of range")
    raw = _decompress(payload[_HEADER_BYTES:], _BYTES_PER_PIXEL * width * height)
    planes = np.frombuffer(raw, dtype=np.uint8).reshape(_BYTES_PER_PIXEL, width * height)
    low, high, levels = planes
    # Of float16 bits, 0 and the positive normal numbers are valid, which by their high bytes are 0x04 to 0x7B: 0x7C00
    # is infinity, NaN and negative ones lie above, and what lies below is zero or too small to be normal.
    is_small = high < _MIN_HIGH_BYTE
    if bool((high > _MAX_HIGH_BYTE).any()) or bool((is_small & ((low | high) != 0)).any()):
        raise CodecError("depth blob: depth must be finite, not negative and at float16 precision")
    if bool((is_small & (levels != 0)).any()):
        raise CodecError("depth blob: confidence without depth")
    return (height, width), exponent, planes


def _check_size(width: int, height: int) -> None:
    if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX and width * height <= MAX_PIXELS):
        raise CodecError(f"depth blob: size {width} x {height} px is out of range")


def _zstd() -> zstandard.ZstdDecompressor:
    """One for each thread: making one costs as much as a small frame, and two threads may not share it."""
    if not hasattr(_of_thread, "decompressor"):
        _of_thread.decompressor = zstandard.ZstdDecompressor(max_window_size=2**27)
    decompressor: zstandard.ZstdDecompressor = _of_thread.decompressor
    return decompressor


def _decompress(frame: bytes | memoryview, expected_bytes: int) -> bytes:
    try:
        if zstandard.get_frame_parameters(frame).content_size != expected_bytes:
            raise CodecError("depth blob: content has another size than the header declares")
        raw = _zstd().decompress(frame, max_output_size=expected_bytes, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CodecError(f"depth blob: damaged: {error}") from error
    if len(raw) != expected_bytes:
        raise CodecError("depth blob: content has another size than the header declares")
    return raw
