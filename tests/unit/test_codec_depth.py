"""The depth blob against plain numpy: precision, bounds, and damage of every kind."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vggt_motion.bus.codec import decode_depth, encode_depth
from vggt_motion.bus.depth import MAX_PIXELS
from vggt_motion.errors import CodecError

RNG = np.random.default_rng(7)
HEADER_BYTES = 20


def scene(height: int = 12, width: int = 17, unit: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    depth = (RNG.lognormal(1.0, 1.5, (height, width)) * unit).astype(np.float32)
    depth[RNG.random((height, width)) < 0.2] = 0.0
    return depth, RNG.random((height, width), dtype=np.float32)


def blob(width: int, height: int, content: bytes, *, exponent: int = 0, version: int = 1) -> bytes:
    """A blob with any header, made without the encoder."""
    header = struct.pack("<4sBBhII", b"VMD1", version, 0, exponent, width, height)
    return header + struct.pack("<I", zlib.crc32(header)) + zstandard.ZstdCompressor().compress(content)


@given(
    depth=hnp.arrays(
        np.float32,
        hnp.array_shapes(min_dims=2, max_dims=2, max_side=12),
        elements=st.one_of(st.just(0.0), st.floats(2.0**-7, 1024.0, width=32)),
    ),
    octave=st.integers(-90, 90),
)
def test_depth_of_any_unit_comes_back_within_the_stated_error(depth: np.ndarray, octave: int) -> None:
    depth = np.ldexp(depth, octave)
    confidence = np.linspace(0.0, 1.0, depth.size, dtype=np.float32).reshape(depth.shape)
    got_depth, got_confidence = decode_depth(encode_depth(depth, confidence))
    assert got_depth.shape == got_confidence.shape == depth.shape
    assert got_depth.dtype == got_confidence.dtype == np.float32
    known = depth > 0
    assert np.array_equal(got_depth > 0, known)
    assert np.all(np.abs(got_depth[known] / depth[known] - 1.0) < 5e-4)
    assert np.all(np.abs(got_confidence - confidence)[known] <= 0.5 / 255 + 1e-6)
    assert np.all(got_confidence[~known] == 0.0)


def test_encoding_is_idempotent_and_deterministic() -> None:
    depth, confidence = scene()
    once = encode_depth(depth, confidence)
    assert encode_depth(depth.copy(), confidence.copy()) == once
    assert encode_depth(*decode_depth(once)) == once


def test_depth_beyond_the_range_of_one_map_becomes_unknown() -> None:
    depth = np.array([[1e6, 1e-6, 1.0]], dtype=np.float32)
    got, confidence = decode_depth(encode_depth(depth, np.ones_like(depth)))
    assert got[0, 1] == 0.0 and confidence[0, 1] == 0.0
    assert got[0, 0] == pytest.approx(1e6, rel=5e-4) and got[0, 2] == pytest.approx(1.0, rel=5e-4)


def test_the_range_of_float32_fits() -> None:
    for value in (2.0**126, np.finfo(np.float32).tiny):
        depth = np.full((2, 2), value, dtype=np.float32)
        got, _ = decode_depth(encode_depth(depth, np.ones_like(depth)))
        assert np.allclose(got, depth, rtol=5e-4, atol=0.0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1e-3, 1e300])
def test_impossible_depth_is_refused(value: float) -> None:
    depth = np.ones((3, 4))
    depth[1, 2] = value
    with pytest.raises(CodecError, match="depth must be finite and not negative"):
        encode_depth(depth, np.ones((3, 4)))


@pytest.mark.parametrize("value", [np.nan, -0.01, 1.01, np.inf])
def test_impossible_confidence_is_refused(value: float) -> None:
    confidence = np.ones((3, 4))
    confidence[0, 0] = value
    with pytest.raises(CodecError, match="confidence"):
        encode_depth(np.ones((3, 4)), confidence)


@pytest.mark.parametrize("shapes", [((3, 4), (4, 3)), ((12,), (12,)), ((0, 4), (0, 4)), ((1, 2, 3), (1, 2, 3))])
def test_wrong_shapes_are_refused(shapes: tuple[tuple[int, ...], tuple[int, ...]]) -> None:
    with pytest.raises(CodecError):
        encode_depth(np.ones(shapes[0]), np.ones(shapes[1]))


@given(st.binary(max_size=400))
def test_random_bytes_are_refused(payload: bytes) -> None:
    with pytest.raises(CodecError):
        decode_depth(payload)


def test_every_truncation_is_refused() -> None:
    payload = encode_depth(*scene())
    for length in range(len(payload)):
        with pytest.raises(CodecError):
            decode_depth(payload[:length])
    with pytest.raises(CodecError):
        decode_depth(payload + b"\0")


def test_every_flipped_bit_is_refused_or_without_effect() -> None:
    payload = encode_depth(*scene(6, 7))
    truth = decode_depth(payload)
    refused = 0
    for position in range(8 * len(payload)):
        damaged = bytearray(payload)
        damaged[position // 8] ^= 1 << position % 8
        try:
            got = decode_depth(bytes(damaged))
        except CodecError:
            refused += 1
        else:  # a bit that zstd defines as unused
            assert all(np.array_equal(a, b) for a, b in zip(got, truth, strict=True))
    assert refused > 8 * len(payload) - 8


@pytest.mark.parametrize(
    ("payload", "problem"),
    [
        (blob(4, 3, bytes(36), version=2), "version 2"),
        (blob(0, 3, b""), "size"),
        (blob(2**31, 2**31, bytes(36)), "size"),
        (blob(MAX_PIXELS // 2**12 + 1, 2**12, bytes(36)), "size"),
        (blob(4, 3, bytes(37)), "another size"),
        (blob(4, 3, bytes(10_000_000)), "another size"),
        (blob(4, 3, bytes(36), exponent=3000), "exponent"),
        (blob(4, 3, bytes(12) + b"\x7c" * 12 + bytes(12)), "depth must be finite"),
        (blob(4, 3, bytes(12) + b"\xc0" * 12 + bytes(12)), "depth must be finite"),
        (blob(4, 3, bytes(12) + b"\x01" * 12 + bytes(12)), "float16 precision"),
        (blob(4, 3, bytes(24) + b"\x01" * 12), "confidence without depth"),
    ],
)
def test_hostile_blobs_are_refused_by_name(payload: bytes, problem: str) -> None:
    with pytest.raises(CodecError, match=problem):
        decode_depth(payload)


def test_a_frame_that_hides_its_size_is_refused() -> None:
    header = struct.pack("<4sBBhII", b"VMD1", 1, 0, 0, 4, 3)
    frame = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(36))
    with pytest.raises(CodecError, match="another size"):
        decode_depth(header + struct.pack("<I", zlib.crc32(header)) + frame)


def test_a_frame_that_lies_about_its_size_is_refused_before_it_is_unpacked() -> None:
    # 8192 blocks of one byte 128 KiB times each, and a header that says 36 bytes (RFC 8878).
    block, last = ((2**17 << 3 | 1 << 1 | is_last).to_bytes(3, "little") + b"\0" for is_last in (0, 1))
    frame = b"\x28\xb5\x2f\xfd\xc0\x38" + struct.pack("<Q", 36) + block * 8191 + last
    with pytest.raises(CodecError, match="Destination buffer is too small"):
        decode_depth(blob(4, 3, bytes(36))[:HEADER_BYTES] + frame)


halves = st.one_of(st.just(0), st.integers(0x0400, 0x7BFF), st.integers(0, 0xFFFF))


@given(
    bits=hnp.arrays(np.uint16, (3, 4), elements=halves),
    levels=hnp.arrays(np.uint8, (3, 4)),
    exponent=st.integers(-9, 9),
)
def test_any_bits_are_depth_or_refused_for_their_values(bits: np.ndarray, levels: np.ndarray, exponent: int) -> None:
    planes = bits.astype("<u2").view(np.uint8).reshape(-1, 2)
    payload = blob(4, 3, planes[:, 0].tobytes() + planes[:, 1].tobytes() + levels.tobytes(), exponent=exponent)
    values = bits.view(np.float16).astype(np.float64)
    is_positive = np.isfinite(values) & (values >= 2.0**-14)
    if not np.all(is_positive | (bits == 0)):
        with pytest.raises(CodecError, match="depth must be finite, not negative"):
            decode_depth(payload)
    elif np.any((bits == 0) & (levels > 0)):
        with pytest.raises(CodecError, match="confidence without depth"):
            decode_depth(payload)
    else:
        depth, confidence = decode_depth(payload)
        assert np.array_equal(depth, values * 2.0**exponent)
        assert np.allclose(confidence, levels / 255.0, atol=1e-6)


@settings(max_examples=200)
@given(st.data())
def test_damage_in_many_places_ends_in_one_error(data: st.DataObject) -> None:
    payload = bytearray(encode_depth(*scene(4, 5)))
    for _ in range(data.draw(st.integers(1, 8))):
        payload[data.draw(st.integers(HEADER_BYTES, len(payload) - 1))] = data.draw(st.integers(0, 255))
    try:
        depth, confidence = decode_depth(bytes(payload))
    except CodecError:
        pass
    else:
        assert np.all(np.isfinite(depth)) and np.all(depth >= 0) and np.all((confidence >= 0) & (confidence <= 1))
