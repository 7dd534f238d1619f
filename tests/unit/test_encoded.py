"""What is told of an encoded image before it is decoded, and what is refused on that alone."""

from __future__ import annotations

import contextlib
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vggt_motion import MAX_IMAGE_PIXELS
from vggt_motion.bus import codec
from vggt_motion.errors import CodecError, SourceError, SourceTruncatedError
from vggt_motion.frontend.flow import GreyDecoder
from vggt_motion.records import BlobRef, Keyframe, MotionState
from vggt_motion.sources import encoded
from vggt_motion.sources.encoded import JPEG, MAX_BYTES, MAX_SIDE_PX, PNG, checked_media_type, decode_rgb, read_head
from vggt_motion.sources.registry import open_source
from vggt_motion.sources.source import Frame

WIDTH, HEIGHT = 61, 43
START, END = b"\xff\xd8", b"\xff\xd9"


def picture(suffix: str, *options: int) -> bytes:
    pixels = np.random.default_rng(3).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return bytes(cv2.imencode(suffix, pixels, options)[1])


BASELINE = picture(".jpg")
PROGRESSIVE = picture(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
RESTARTING = picture(".jpg", cv2.IMWRITE_JPEG_RST_INTERVAL, 2)
WHOLE_PNG = picture(".png")
FILES = {"baseline": BASELINE, "progressive": PROGRESSIVE, "restarting": RESTARTING, "png": WHOLE_PNG}


def segment(marker: int, content: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(content) + 2) + content


def with_segments(jpeg: bytes, *segments: bytes) -> bytes:
    return jpeg[:2] + b"".join(segments) + jpeg[2:]


def resized_jpeg(jpeg: bytes, width: int, height: int) -> bytes:
    """The same file with another size in its frame header."""
    at = max(jpeg.find(b"\xff\xc0"), jpeg.find(b"\xff\xc2"))
    return jpeg[: at + 5] + struct.pack(">HH", height, width) + jpeg[at + 9 :]


def resized_png(width: int, height: int) -> bytes:
    header = b"IHDR" + struct.pack(">II", width, height) + WHOLE_PNG[24:29]
    return WHOLE_PNG[:12] + header + struct.pack(">I", zlib.crc32(header)) + WHOLE_PNG[33:]


def png_bomb(side: int) -> bytes:
    """A valid file that decodes to side x side zeros and is a thousandth of that."""
    compressor = zlib.compressobj(9)
    rows = [compressor.compress(bytes(side + 1)) for _ in range(side)]
    data = b"IDAT" + b"".join(rows) + compressor.flush()
    header = b"IHDR" + struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    chunks = [struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in (header, data, b"IEND")]
    return WHOLE_PNG[:8] + b"".join(chunks)


@pytest.mark.parametrize("kind", FILES)
def test_the_head_says_type_and_size(kind: str) -> None:
    head = read_head(FILES[kind])
    assert head is not None
    assert (head.media_type, head.width_px, head.height_px) == (PNG if kind == "png" else JPEG, WIDTH, HEIGHT)
    assert checked_media_type(FILES[kind]) == head.media_type


@pytest.mark.parametrize("kind", FILES)
def test_files_that_were_cut_off_have_no_head(kind: str) -> None:
    whole = FILES[kind]
    for length in range(len(whole) - 1):
        assert (kind == "png" and length >= len(whole) - 4) or read_head(whole[:length]) is None


def test_the_end_of_a_preview_is_not_the_end_of_the_image() -> None:
    whole = with_segments(BASELINE, segment(0xE1, b"Exif\0\0" + picture(".jpg", cv2.IMWRITE_JPEG_QUALITY, 1)))
    head = read_head(whole)
    assert head is not None and (head.width_px, head.height_px) == (WIDTH, HEIGHT)
    assert read_head(whole[:-100]) is None


@given(st.binary(max_size=64), st.sampled_from([b"", START + b"\xff", WHOLE_PNG[:8], WHOLE_PNG[:16]]))
def test_whatever_the_bytes_they_have_a_head_or_are_refused(data: bytes, beginning: bytes) -> None:
    with contextlib.suppress(CodecError):
        assert checked_media_type(beginning + data) in (JPEG, PNG)


SMALL_FRAME = segment(0xC0, b"\x08\x00\x01\x00\x01\x01\x01\x11\x00")  # of 1x1 pixels


@given(
    kind=st.sampled_from(sorted(FILES)),
    changes=st.lists(st.tuples(st.integers(2, 700), st.integers(0, 255)), max_size=3),
    inserted=st.binary(max_size=12) | st.sampled_from([SMALL_FRAME, segment(0xE1, SMALL_FRAME), b"\xff" + SMALL_FRAME]),
    at=st.just(2) | st.integers(2, 700),
)
@settings(max_examples=1000, deadline=None)
def test_what_opencv_decodes_has_the_size_that_the_head_says(
    kind: str, changes: list[tuple[int, int]], inserted: bytes, at: int
) -> None:
    """Nothing that is done to a file may make the decoder see another size than the check."""
    data = bytearray(FILES[kind])
    for position, value in changes:
        data[position % len(data)] = value
    if kind == "png":
        data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    else:
        data[at:at] = inserted
    head = read_head(bytes(data))
    if head is None or not 0 < head.width_px * head.height_px < 2**22:
        return
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        return
    assert pixels is None or sorted(pixels.shape) == sorted((head.width_px, head.height_px))


@st.composite
def sides_beyond(draw: st.DrawFn, largest: int) -> tuple[int, int]:
    """Width and height of which one is too long, or that are too much together."""
    long = draw(st.integers(MAX_SIDE_PX // 2, largest))
    least = 1 if long > MAX_SIDE_PX else MAX_IMAGE_PIXELS // long + 1
    short = draw(st.integers(least, largest))
    return draw(st.sampled_from([(long, short), (short, long)]))


@given(
    png_size=sides_beyond(2**32 - 1),
    jpeg_size=sides_beyond(2**16 - 1),
    metadata=st.lists(st.binary(max_size=50), max_size=3),
    filling=st.sampled_from([b"", b"\xff", b"\xff\xff", b"\x00\x17", b"\xff\x00"]),
)
@settings(deadline=None)
def test_sides_beyond_the_bound_are_refused_without_decoding(
    png_size: tuple[int, int], jpeg_size: tuple[int, int], metadata: list[bytes], filling: bytes
) -> None:
    parts = [part for content in metadata for part in (segment(0xE1, content), filling)]
    cases = {
        resized_png(*png_size): png_size,
        with_segments(resized_jpeg(BASELINE, *jpeg_size), *parts): jpeg_size,
        with_segments(resized_jpeg(PROGRESSIVE, *jpeg_size), *parts): jpeg_size,
    }
    decoder = GreyDecoder(320)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was decoded"))
        for data, (width, height) in cases.items():
            with pytest.raises(SourceError, match=f"frame 0 is an image of {width}x{height} pixels, allowed are"):
                decoder.decode(Frame(0, 0, data, "image/png"))
    # what was refused has not said what size the frames have
    assert decoder.decode(Frame(0, 0, BASELINE, JPEG)).width_px == WIDTH
    with pytest.raises(SourceTruncatedError, match=r"frame 1 is an image of .* the 1 frames before it are used"):
        decoder.decode(Frame(1, 0, resized_png(*png_size), PNG))


@pytest.mark.parametrize("size", [(1, MAX_SIDE_PX), (2**13, 2**13), (7680, 4320), (0, 5), (5, 0)])
def test_only_sides_within_the_bound_are_taken(size: tuple[int, int]) -> None:
    if 0 in size:
        with pytest.raises(CodecError, match=f"{size[0]}x{size[1]} pixels"):
            checked_media_type(resized_png(*size))
    else:
        assert checked_media_type(resized_png(*size)) == PNG
        assert checked_media_type(resized_jpeg(BASELINE, *size)) == JPEG


def test_a_jpeg_of_very_many_scans_is_refused() -> None:
    """Each is a pass over all pixels: a megabyte of them took minutes."""
    last = PROGRESSIVE[PROGRESSIVE.rfind(b"\xff\xda") : -2]
    usual = read_head(PROGRESSIVE)
    assert usual is not None and usual.scan_count == 10
    assert checked_media_type(PROGRESSIVE[:-2] + 90 * last + END) == JPEG
    with pytest.raises(CodecError, match="a JPEG image of 101 scans, allowed are 100"):
        checked_media_type(PROGRESSIVE[:-2] + 91 * last + END)
    # of a baseline image only one scan is read: what else looks like one lies behind it
    assert checked_media_type(BASELINE + 200 * b"\xff\xda" + END) == JPEG


def test_metadata_without_end_is_refused_soon() -> None:
    assert read_head(with_segments(BASELINE, *[segment(0xE1, b"x")] * 1000)) is not None
    assert read_head(with_segments(BASELINE, *[segment(0xE1, b"x")] * 5000)) is None
    assert read_head(with_segments(BASELINE, b"\xff" * 1000)) is not None
    assert read_head(with_segments(BASELINE, b"\xff" * 2000)) is None


def test_an_image_of_too_many_bytes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encoded, "MAX_BYTES", len(BASELINE) + 10)
    assert checked_media_type(BASELINE + bytes(10)) == JPEG
    with pytest.raises(CodecError, match=f"an image of {len(BASELINE) + 11} bytes, allowed are {len(BASELINE) + 10}"):
        checked_media_type(BASELINE + bytes(11))


def test_what_is_let_in_can_be_a_keyframe() -> None:
    def keyframe(size_bytes: int, side_px: int) -> Keyframe:
        image = BlobRef("0" * 64, size_bytes, JPEG)
        return Keyframe("front", 0, 0, 0, MotionState.LINEAR, side_px, side_px, image, None)

    codec.encode(keyframe(MAX_BYTES, MAX_SIDE_PX))
    for too_large in (keyframe(MAX_BYTES + 1, 1), keyframe(1, MAX_SIDE_PX + 1)):
        with pytest.raises(CodecError, match="allowed are"):
            codec.encode(too_large)


HEADERS = {
    "a.bmp": b"BM" + struct.pack("<IIIIiiHHI24x", 54, 0, 54, 40, 30_000, 30_000, 1, 24, 0),
    "a.pgm": b"P5 30000 30000 255\n" + bytes(1000),
    "a.webp": b"RIFF\x1c\x00\x00\x00WEBPVP8L\x10\x00\x00\x00\x2f" + struct.pack("<I", 16382 | 16382 << 14) + bytes(60),
}


@pytest.fixture(scope="module")
def bombs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for each file that decodes to more than is allowed."""
    side = 8200
    contents = HEADERS | {
        "a.tif": bytes(cv2.imencode(".tif", np.zeros((side, side), np.uint8))[1]),
        "a.png": png_bomb(side),
    }
    root = tmp_path_factory.mktemp("bombs")
    for name, content in contents.items():
        (root / name.removeprefix("a.")).mkdir()
        (root / name.removeprefix("a.") / name).write_bytes(content)
    return root


READ_IN_A_NEW_PROCESS = """
import sys
from vggt_motion.errors import SourceError
from vggt_motion.sources.registry import open_source

def peak_kb():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))

frames = open_source(sys.argv[1]).frames()
before = peak_kb()
try:
    next(frames)
except SourceError as error:
    print(peak_kb() - before, error)
"""


@pytest.mark.parametrize("kind", ["bmp", "pgm", "webp", "tif", "png"])
def test_no_format_is_decoded_beyond_the_bound(bombs: Path, kind: str) -> None:
    """In a process of its own: OpenCV must hear of the bound before it is loaded."""
    command = [sys.executable, "-c", READ_IN_A_NEW_PROCESS, str(bombs / kind)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    growth_kb, message = result.stdout.split(maxsplit=1)
    assert f"a.{kind} is" in message and f"{MAX_IMAGE_PIXELS}" in message
    assert int(growth_kb) < 20_000


def test_a_bomb_ends_a_folder_there(tmp_path: Path) -> None:
    (tmp_path / "0.jpg").write_bytes(BASELINE)
    (tmp_path / "1.png").write_bytes(resized_png(32_000, 32_000))
    frames = open_source(str(tmp_path)).frames()
    assert next(frames).encoded == BASELINE
    with pytest.raises(SourceTruncatedError, match=r"1\.png is an image of 32000x32000 pixels"):
        next(frames)


def test_pixels_are_those_of_the_file_with_red_first() -> None:
    pixels = np.random.default_rng(3).integers(0, 255, (20, 30, 3), dtype=np.uint8)
    png = cv2.imencode(".png", pixels[..., ::-1])[1].tobytes()
    assert np.array_equal(decode_rgb(png), pixels)
    jpeg = cv2.imencode(".jpg", pixels)[1].tobytes()
    blue_first = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert blue_first is not None and np.array_equal(decode_rgb(jpeg), blue_first[..., ::-1])
    with pytest.raises(CodecError, match="not a whole"):
        decode_rgb(jpeg[:-10])
    with pytest.raises(CodecError, match="not a readable"):
        decode_rgb(png[:40] + bytes(len(png) - 60) + png[-20:])
