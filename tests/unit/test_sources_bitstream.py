"""Sizes that packets announce, against what the decoder says, and a video that changes size."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vggt_motion.errors import SourceTruncatedError
from vggt_motion.sources.bitstream import size_reader
from vggt_motion.sources.registry import open_source
from vggt_motion.sources.source import Frame
from vggt_motion.sources.video import quiet_ffmpeg

quiet_ffmpeg()  # OpenCV looks at it once, at the first capture of the process: here that is a test's own

# fourcc for the writer, container, fourcc that FFmpeg reports
CODECS = [("MJPG", "avi"), ("MJPG", "mjpeg"), ("MPG2", "m2v"), ("mpg2", "ts"), ("mp4v", "ts"), ("XVID", "avi")]
CHANGING = [("MJPG", "mjpeg"), ("MPG2", "m2v"), ("mpg2", "ts"), ("mp4v", "ts")]


def _write(path: Path, fourcc: str, size: tuple[int, int], count: int = 20) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*fourcc), 25.0, size)
    assert writer.isOpened()
    rng = np.random.default_rng(0)
    for _ in range(count):
        writer.write(rng.integers(0, 255, (size[1], size[0], 3), dtype=np.uint8))
    writer.release()
    return path


def _packets(path: Path) -> tuple[str, list[bytes]]:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    assert capture.set(cv2.CAP_PROP_FORMAT, -1)
    fourcc = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode()
    packets = []
    while True:
        ok, packet = capture.read()
        if not ok:
            return fourcc, packets
        packets.append(np.asarray(packet, np.uint8).tobytes())


@pytest.mark.parametrize(("fourcc", "suffix"), CODECS)
@pytest.mark.parametrize("size", [(320, 240), (162, 122), (720, 306)])
def test_announced_size_is_the_decoded_size(tmp_path: Path, fourcc: str, suffix: str, size: tuple[int, int]) -> None:
    found, packets = _packets(_write(tmp_path / f"v.{suffix}", fourcc, size))
    reader = size_reader(found)
    assert reader is not None, found
    announced = {reader(packet) for packet in packets} - {None}
    assert announced <= {size}
    if (fourcc, suffix) in CHANGING:
        assert announced == {size}


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "size"), [("highway_straight.mp4", (960, 540)), ("standing_at_red_light.mp4", (640, 360))]
)
def test_h264_of_real_cameras(data_dir: Path, name: str, size: tuple[int, int]) -> None:
    fourcc, packets = _packets(data_dir / "video" / name)
    reader = size_reader(fourcc)
    assert fourcc == "h264" and reader is not None
    announced = [reader(packet) for packet in packets]
    assert announced[0] == size  # 540 is no multiple of 16: the rest is cropped
    assert set(announced) == {size, None}


def _drain(path: Path) -> tuple[list[Frame], str]:
    frames: list[Frame] = []
    try:
        frames.extend(open_source(str(path)).frames())
    except SourceTruncatedError as error:
        return frames, str(error)
    return frames, ""


@pytest.mark.parametrize(("fourcc", "suffix"), CHANGING)
def test_a_video_that_changes_size_ends_there(tmp_path: Path, fourcc: str, suffix: str) -> None:
    first = _write(tmp_path / f"a.{suffix}", fourcc, (320, 240))
    second = _write(tmp_path / f"b.{suffix}", fourcc, (640, 480))
    joined = tmp_path / f"joined.{suffix}"
    joined.write_bytes(first.read_bytes() + second.read_bytes())
    frames, error = _drain(joined)
    assert "changes size from 320x240 to 640x480 at frame 20" in error
    assert len(frames) == 20


@pytest.mark.data
def test_h264_that_changes_size_ends_there(data_dir: Path, tmp_path: Path) -> None:
    joined = tmp_path / "joined.h264"
    with joined.open("wb") as file:
        for name in ("standing_at_red_light.mp4", "highway_straight.mp4"):
            file.write(b"".join(_packets(data_dir / "video" / name)[1][:60]))
    frames, error = _drain(joined)
    assert "changes size from 640x360 to 960x540" in error
    assert 55 <= len(frames) <= 60  # the decoder gives its last pictures out late


@pytest.mark.parametrize(("fourcc", "suffix"), CODECS)
def test_a_video_of_one_size_runs_to_its_end(tmp_path: Path, fourcc: str, suffix: str) -> None:
    frames, error = _drain(_write(tmp_path / f"v.{suffix}", fourcc, (320, 240)))
    assert error == "" and len(frames) == 20


@pytest.mark.parametrize("name", ["hevc", "h264", "vp8.ivf", "vp9.ivf"])
def test_streams_of_other_encoders_that_change_size_end_there(name: str) -> None:
    """Six frames of 322x182, then six of 160x120, made with x265, x264 and libvpx."""
    path = Path(__file__).resolve().parents[1] / "data" / "size_change" / f"size_change.{name}"
    frames, error = _drain(path)
    assert "changes size from 322x182 to 160x120 at frame 6" in error
    assert len(frames) == 6
    fourcc, packets = _packets(path)
    reader = size_reader(fourcc)
    assert reader is not None
    announced = [reader(packet) for packet in packets]
    assert [size for size in dict.fromkeys(announced) if size] == [(322, 182), (160, 120)]


@given(st.sampled_from(["h264", "hevc", "VP80", "VP90", "mpg2", "FMP4", "MJPG"]), st.binary(max_size=80), st.booleans())
def test_damaged_packets_never_raise(fourcc: str, data: bytes, with_start: bool) -> None:
    reader = size_reader(fourcc)
    assert reader is not None
    prefix = {
        "h264": b"\0\0\1\x67",
        "hevc": b"\0\0\1\x42\x01",
        "VP80": b"\0\0\0\x9d\x01\x2a",
        "VP90": b"\x82\x49\x83\x42",
        "mpg2": b"\0\0\1\xb3",
        "FMP4": b"\0\0\1\x20",
        "MJPG": b"\xff\xd8",
    }[fourcc]
    size = reader(prefix + data if with_start else data)
    assert size is None or len(size) == 2


def test_unknown_codecs_say_nothing() -> None:
    assert size_reader("AV01") is None
