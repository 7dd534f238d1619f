"""Foxglove messages and what travels on the image key."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from google.protobuf.timestamp_pb2 import Timestamp
from hypothesis import given, settings
from hypothesis import strategies as st

from vggt_motion import foxglove
from vggt_motion.bus import codec
from vggt_motion.bus.images import ImageHeader, decode_image, encode_image
from vggt_motion.errors import CodecError
from vggt_motion.records import BlobRef, Keyframe, MotionState
from vggt_motion.sources.source import Frame
from vggt_motion.sources.timing import MAX_TIME_NS, TimestampRepair

PICTURE = bytes(cv2.imencode(".png", np.zeros((4, 6), np.uint8))[1])
TIMES_NS = st.integers(0, MAX_TIME_NS)


@given(st.binary(min_size=1, max_size=200), st.sampled_from(["image/jpeg", "image/png"]), TIMES_NS)
def test_an_image_comes_back_as_it_went(encoded: bytes, media_type: str, time_ns: int) -> None:
    payload = foxglove.encode_image(encoded, media_type, time_ns, "front")
    assert foxglove.decode_image(payload) == (encoded, media_type, time_ns)
    message = CompressedImage.FromString(payload)  # and any other reader sees the same
    assert (message.data, message.frame_id) == (encoded, "camera/front")
    assert message.format == media_type.removeprefix("image/")
    assert message.timestamp.seconds * 10**9 + message.timestamp.nanos == time_ns


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**63), st.booleans(), st.booleans(), TIMES_NS)
def test_the_header_travels_beside_the_image(
    index: int, epoch: int, is_last: bool, is_accepted: bool, time_ns: int
) -> None:
    header = ImageHeader(epoch, index, is_last, is_accepted)
    payload = encode_image(Frame(index, time_ns, PICTURE, "image/png"), "front")
    assert decode_image(payload, header.encode()).header == header
    assert decode_image(payload).header is None


@given(st.binary(max_size=300), st.binary(max_size=60))
@settings(max_examples=1000)
def test_hostile_bytes_end_as_one_line(payload: bytes, attachment: bytes) -> None:
    try:
        image = decode_image(payload, attachment)
    except CodecError as error:
        message = str(error)
        assert message and "\n" not in message
    else:
        assert image.encoded and image.capture_time_ns >= 0


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (CompressedImage(data=b"x", format="webp"), "format 'webp' is not read"),
        (CompressedImage(data=b"x"), "format '' is not read"),
        (CompressedImage(data=b"x", format="a\nb"), r"format 'a\\nb' is not read"),
        (CompressedImage(format="png"), "without image bytes"),
        (CompressedImage(data=b"x", format="png", timestamp=Timestamp(seconds=-1)), "out of range"),
        (CompressedImage(data=b"x", format="png", timestamp=Timestamp(seconds=2**40)), "out of range"),
        (CompressedImage(data=b"x", format="png", timestamp=Timestamp(seconds=2**62 // 10**9)), "out of range"),
        (CompressedImage(data=b"x", format="png", timestamp=Timestamp(nanos=-5)), "-5 nanoseconds"),
        (CompressedImage(data=b"x", format="png", timestamp=Timestamp(nanos=10**9)), "1000000000 nanoseconds"),
    ],
)
def test_impossible_images_are_named(message: CompressedImage, reason: str) -> None:
    with pytest.raises(CodecError, match=reason):
        foxglove.decode_image(message.SerializeToString())


def test_a_time_that_is_let_in_can_be_recorded_and_so_can_those_repaired_after_it() -> None:
    repair = TimestampRepair(10**9)
    for time_ns in (MAX_TIME_NS, MAX_TIME_NS, 0, 10**18 // 10):
        image = BlobRef("0" * 64, 1, "image/png")
        codec.encode(Keyframe("front", 0, 0, repair(time_ns), MotionState.LINEAR, 6, 4, image, None))
    assert repair.count == 2


def test_headers_of_another_schema_and_numbers_too_large_are_refused() -> None:
    payload = foxglove.encode_image(PICTURE, "image/png", 0, "front")
    with pytest.raises(CodecError, match="schema 0"):
        decode_image(payload, b"\x18\x05")  # a frame index without a schema version
    with pytest.raises(CodecError, match="schema 2, known is 1"):
        decode_image(payload, b"\x08\x02")
    with pytest.raises(CodecError, match="out of range"):
        decode_image(payload, ImageHeader(0, 2**32).encode())


@pytest.mark.parametrize(
    ("encoded", "media_type", "reason"),
    [
        (PICTURE[:-9], "image/png", "not a whole JPEG or PNG image"),
        (b"a foreign image", "image/jpeg", "not a whole JPEG or PNG image"),
        (PICTURE, "image/jpeg", "the image is image/png, its message says image/jpeg"),
        (PICTURE[:16] + b"\x00\x00\x7d\x00" * 2 + PICTURE[24:], "image/png", "32000x32000 pixels"),
        (PICTURE + bytes(200), "image/png", f"an image of {len(PICTURE) + 200} bytes"),
    ],
    ids=["cut off", "foreign", "of another type", "too many pixels", "too many bytes"],
)
def test_what_may_not_be_a_frame_is_refused_on_the_image_key(
    monkeypatch: pytest.MonkeyPatch, encoded: bytes, media_type: str, reason: str
) -> None:
    monkeypatch.setattr("vggt_motion.sources.encoded.MAX_BYTES", len(PICTURE) + 100)
    payload = foxglove.encode_image(encoded, media_type, 0, "front")
    with pytest.raises(CodecError, match=reason):
        decode_image(payload, ImageHeader(0, 5).encode())


def test_what_cannot_be_recorded_is_refused() -> None:
    with pytest.raises(CodecError, match="image/webp"):
        foxglove.encode_image(b"x", "image/webp", 0, "front")
    for time_ns in (-1, 2**63):
        with pytest.raises(CodecError, match="not a time"):
            foxglove.encode_image(b"x", "image/png", time_ns, "front")


def test_parts_behind_a_break_have_frames_of_their_own() -> None:
    names = {foxglove.world_frame(component) for component in (0, 3, 12)}
    assert names == {"world", "world/3", "world/12"}
    assert foxglove.point_cloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "world", 0)
