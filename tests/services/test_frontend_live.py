"""Live streams from real sockets on loopback, into the source and through the whole frontend."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from bus_processes import wait_until
from live_servers import MjpegServer, RtspServer, numbered_picture, write_transport_stream
from vggt_motion.config import FrontendConfig
from vggt_motion.errors import SourceError
from vggt_motion.frontend.pipeline import FrontendPipeline, SegmentOutput
from vggt_motion.sources.camera import CameraSource
from vggt_motion.sources.registry import open_source
from vggt_motion.sources.selection import Selection
from vggt_motion.sources.source import Frame

pytestmark = pytest.mark.timeout(120)
SECOND = 1_000_000_000


@pytest.fixture
def rtsp(tmp_path: Path) -> Iterator[RtspServer]:
    server = RtspServer(write_transport_stream(tmp_path / "camera.ts", 60, 20.0), duration_s=3.0)
    yield server
    server.close()


def _take(location: str, count: int) -> tuple[list[Frame], CameraSource]:
    source = open_source(location)
    assert isinstance(source, CameraSource)
    frames = list(itertools.islice(source.frames(), count))
    source.close()
    return frames, source


def _resembles(frame: Frame, number: int) -> bool:
    pixels = cv2.imdecode(np.frombuffer(frame.encoded, np.uint8), cv2.IMREAD_COLOR)
    return pixels is not None and float(np.abs(pixels.astype(float) - numbered_picture(number)).mean()) < 6.0


def test_rtsp_frames_with_the_stamps_of_the_camera(rtsp: RtspServer) -> None:
    begin = time.time_ns()
    frames, source = _take(f"rtsp://user:secret@127.0.0.1:{rtsp.port}/live", 40)
    steps = np.diff([frame.capture_time_ns for frame in frames])
    assert np.median(steps) == pytest.approx(SECOND / 20, rel=0.01)
    assert begin - SECOND < frames[0].capture_time_ns < time.time_ns() + SECOND
    if source.dropped_count == 0:
        assert all(_resembles(frame, number) for number, frame in enumerate(frames))
    assert "secret" not in source.description + source.fingerprint


def test_rtsp_that_breaks_off_is_opened_again(rtsp: RtspServer) -> None:
    frames, source = _take(f"rtsp://127.0.0.1:{rtsp.port}/live", 90)  # more than one connection delivers
    assert rtsp.connections >= 2
    assert source.reconnect_count >= 1
    assert all(b.capture_time_ns > a.capture_time_ns for a, b in itertools.pairwise(frames))


def test_pictures_over_http_get_their_time_of_arrival() -> None:
    server = MjpegServer(rate_hz=8.0)
    try:
        begin = time.time_ns()
        frames, source = _take(f"http://127.0.0.1:{server.port}/", 24)
        seconds = (time.time_ns() - begin) / SECOND
    finally:
        server.close()
    # FFmpeg would stamp them 25 in a second, whatever the camera does
    span = (frames[-1].capture_time_ns - frames[0].capture_time_ns) / SECOND
    assert 23 / 8.0 * 0.8 < span <= seconds
    assert source.frame_rate_hz is None
    assert _resembles(frames[0], 0)


def test_a_reader_that_falls_behind_loses_old_frames_not_new_ones() -> None:
    server = MjpegServer(rate_hz=100.0)
    source = open_source(f"http://127.0.0.1:{server.port}/")
    assert isinstance(source, CameraSource)
    try:
        stream = source.frames()
        next(stream)
        wait_until(lambda: source.dropped_count > 20)
        late = [next(stream) for _ in range(5)]
        now = time.time_ns()
    finally:
        source.close()
        server.close()
    assert source.dropped_count > 20
    assert now - late[-1].capture_time_ns < SECOND // 2
    assert [frame.index for frame in late] == [1, 2, 3, 4, 5]


def test_a_stream_that_stalls_is_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The connection stays open, and nothing comes."""
    monkeypatch.setattr("vggt_motion.sources.camera._READ_TIMEOUT_S", 0.5)
    server = MjpegServer(rate_hz=20.0, frames_per_connection=8, then_stalls=True)
    try:
        frames, source = _take(f"http://127.0.0.1:{server.port}/", 20)
    finally:
        server.close()
    assert server.connections >= 3
    assert source.reconnect_count >= 2
    steps = np.diff([frame.capture_time_ns for frame in frames])
    assert (steps > 0).all() and steps.max() > SECOND // 2


def test_a_live_stream_through_the_frontend() -> None:
    server = MjpegServer(rate_hz=30.0)
    source = open_source(f"http://127.0.0.1:{server.port}/")
    pipeline = FrontendPipeline(FrontendConfig(), "front")
    outputs = []
    try:
        for frame in itertools.islice(source.frames(), 45):
            outputs += pipeline.push(frame)
    finally:
        source.close()
        server.close()
    outputs += pipeline.finish()
    listed = [entry.frame_index for o in outputs if isinstance(o, SegmentOutput) for entry in o.segment.frames]
    assert listed == list(range(45))
    assert pipeline.keyframe_count > 3  # the picture pans by 4 px a frame


def test_nobody_at_the_address() -> None:
    source = CameraSource(
        lambda: cv2.VideoCapture("rtsp://127.0.0.1:9/live", cv2.CAP_FFMPEG),  # the discard port: refused
        "stream",
        Selection(),
        first_frame_timeout_s=1.0,
    )
    with pytest.raises(SourceError, match="no frame came from stream"):
        next(iter(source.frames()))
    source.close()
