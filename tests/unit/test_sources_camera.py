"""Live sources on a scripted device: what is dropped, stamped, counted and opened again."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from vggt_motion.errors import SourceError, SourceTruncatedError
from vggt_motion.sources.camera import CameraSource, is_device, is_stream, open_device, without_credentials
from vggt_motion.sources.registry import SOURCE_KINDS, open_source
from vggt_motion.sources.selection import Selection
from vggt_motion.sources.source import CountsLosses, Frame, Source, losses_of

MS = 1_000_000
SECOND = 1_000_000_000


class ScriptedCapture:
    """Delivers numbered pictures (the number is the grey value) with given stamps, then fails."""

    def __init__(self, stamps_ms: list[float], rate_hz: float = 20.0, gate: threading.Semaphore | None = None) -> None:
        self._stamps = iter(stamps_ms)
        self._number = 0
        self._now_ms = 0.0
        self._rate_hz = rate_hz
        self._gate = gate
        self.is_released = False

    def isOpened(self) -> bool:  # noqa: N802
        return True

    def read(self) -> tuple[bool, np.ndarray | None]:
        if self._gate is not None:
            self._gate.acquire()
        stamp = next(self._stamps, None)
        if stamp is None:
            return False, None
        self._now_ms = stamp
        picture = np.full((48, 64, 3), self._number, np.uint8)
        self._number += 1
        return True, picture

    def get(self, propId: int) -> float:  # noqa: N803
        return {cv2.CAP_PROP_FPS: self._rate_hz, cv2.CAP_PROP_POS_MSEC: self._now_ms}.get(propId, 0.0)

    def release(self) -> None:
        self.is_released = True


class Closed:
    """A device that cannot be opened."""

    def isOpened(self) -> bool:  # noqa: N802
        return False

    def read(self) -> tuple[bool, None]:
        raise AssertionError("read from a closed device")

    def get(self, propId: int) -> float:  # noqa: N803
        return 0.0

    def release(self) -> None:
        return


def _clock(start_ns: int = 1_700_000_000 * SECOND, step_ns: int = 50 * MS) -> Iterator[int]:
    return itertools.count(start_ns, step_ns)


def _number_of(frame: Frame) -> int:
    pixels = cv2.imdecode(np.frombuffer(frame.encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert pixels is not None
    return round(float(pixels.mean()))


def _wait(condition: object, timeout_s: float = 10.0) -> None:
    end = time.monotonic() + timeout_s
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end
        time.sleep(0.005)


def test_frames_in_order_with_the_devices_steps_on_the_wall_clock() -> None:
    gate = threading.Semaphore(0)
    jitter = iter([0, 30 * MS, 5 * MS, 60 * MS, 0, 0])
    ticks = _clock()
    capture = ScriptedCapture([1000.0 + 50 * k for k in range(6)], gate=gate)
    source = CameraSource(lambda: capture, "fake", Selection(), clock_ns=lambda: next(ticks) + next(jitter))
    frames = []
    stream = source.frames()
    for _ in range(6):
        gate.release()
        frames.append(next(stream))
    source.close()
    assert [_number_of(frame) for frame in frames] == list(range(6))
    assert [frame.index for frame in frames] == list(range(6))
    # the times of arrival jitter, the stamps do not
    assert [frame.capture_time_ns - 1_700_000_000 * SECOND for frame in frames] == [50 * MS * k for k in range(6)]
    assert losses_of(source) == {"dropped_frames": 0, "missing_frames": 0, "refused_frames": 0, "reconnects": 0}
    gate.release()
    _wait(lambda: capture.is_released)


def test_a_slow_reader_gets_the_newest_frames_and_the_rest_is_counted() -> None:
    gate = threading.Semaphore(0)
    ticks = _clock()
    capture = ScriptedCapture([50.0 * k for k in range(1, 101)], gate=gate)
    source = CameraSource(lambda: capture, "fake", Selection(), clock_ns=lambda: next(ticks))
    stream = source.frames()
    gate.release()
    first = next(stream)
    gate.release(60)  # 60 frames come while nobody looks
    _wait(lambda: source.dropped_count >= 56)
    late = [next(stream) for _ in range(4)]
    source.close()
    gate.release()
    assert _number_of(first) == 0
    assert [_number_of(frame) for frame in late] == [57, 58, 59, 60]
    assert source.dropped_count == 56
    assert [frame.index for frame in late] == [1, 2, 3, 4]
    times = [frame.capture_time_ns for frame in (first, *late)]
    assert np.diff(times).tolist() == [57 * 50 * MS, 50 * MS, 50 * MS, 50 * MS]


def test_frames_that_the_device_left_out_are_counted() -> None:
    ticks = _clock()
    gate = threading.Semaphore(0)
    capture = ScriptedCapture([50.0, 100.0, 250.0, 300.0], gate=gate)
    source = CameraSource(lambda: capture, "fake", Selection(), clock_ns=lambda: next(ticks))
    stream = source.frames()
    for _ in range(4):
        gate.release()
        next(stream)
    source.close()
    gate.release()
    assert source.missing_count == 2
    assert source.frame_rate_hz == 20.0


@pytest.mark.parametrize("stamps", [[0.0] * 5, [-1.0] * 5, [float("nan")] * 5])
def test_without_stamps_the_time_of_arrival_counts(stamps: list[float]) -> None:
    ticks = _clock()
    gate = threading.Semaphore(0)
    capture = ScriptedCapture(stamps, gate=gate)
    source = CameraSource(lambda: capture, "fake", Selection(), clock_ns=lambda: next(ticks))
    stream = source.frames()
    times = []
    for _ in range(5):
        gate.release()
        times.append(next(stream).capture_time_ns)
    source.close()
    gate.release()
    assert np.diff(times).tolist() == [50 * MS] * 4


def test_a_stream_that_breaks_off_is_opened_again_and_times_go_on() -> None:
    opened: list[ScriptedCapture] = []
    gate = threading.Semaphore(0)
    start = time.time_ns()

    def open_capture() -> ScriptedCapture:
        opened.append(ScriptedCapture([50.0 * k for k in range(1, 4)], gate=gate))
        return opened[-1]

    source = CameraSource(open_capture, "fake", Selection())
    stream = source.frames()
    frames = []
    for number in range(9):
        # One read for the frame, and before every fourth frame the one that ends a stream.
        gate.release(2 if number in (3, 6) else 1)
        frames.append(next(stream))
    source.close()
    gate.release()
    assert len(opened) >= 3
    assert source.reconnect_count >= 2
    assert all(capture.is_released for capture in opened[:2])
    times = [frame.capture_time_ns for frame in frames]
    assert all(b > a for a, b in itertools.pairwise(times))
    assert start - SECOND < times[0] <= times[-1] < time.time_ns() + SECOND
    # three frames, then the pause before the device is opened again
    assert times[3] - times[2] > 300 * MS


def test_a_stream_that_comes_back_in_another_size_ends_with_one_line() -> None:
    class Wider(ScriptedCapture):
        def read(self) -> tuple[bool, np.ndarray | None]:
            ok, picture = super().read()
            return ok, None if picture is None else np.repeat(picture, 2, axis=1)

    captures = iter([ScriptedCapture([50.0, 100.0, 150.0]), Wider([50.0, 100.0, 150.0])])
    source = CameraSource(lambda: next(captures), "fake", Selection())
    frames: list[Frame] = []
    with pytest.raises(SourceTruncatedError, match=r"fake has changed size from 64x48 to 128x48; .* 3 frames before"):
        frames.extend(source.frames())
    source.close()
    assert len(frames) == 3


def test_a_camera_that_lowers_its_rate_keeps_its_own_steps() -> None:
    """In the dark many webcams expose longer and halve their rate: 20 Hz, then 10 Hz, then 20 Hz again."""
    stamps = np.cumsum([50.0] * 10 + [100.0] * 10 + [50.0] * 10)
    gate = threading.Semaphore(0)
    arrival = iter(1_700_000_000 * SECOND + round(float(stamp) * MS) + 7 * MS for stamp in stamps)
    capture = ScriptedCapture([float(stamp) for stamp in stamps], gate=gate)
    source = CameraSource(lambda: capture, "fake", Selection(), clock_ns=lambda: next(arrival))
    stream = source.frames()
    times = []
    for _ in stamps:
        gate.release()
        times.append(next(stream).capture_time_ns)
    source.close()
    gate.release()
    np.testing.assert_array_equal(np.diff(times), np.round(np.diff(stamps) * MS).astype(int))


def test_no_camera() -> None:
    source = CameraSource(Closed, "fake", Selection(), first_frame_timeout_s=0.3)
    with pytest.raises(SourceError, match="no frame came from fake"):
        next(iter(source.frames()))
    source.close()


def test_closing_ends_a_waiting_reader() -> None:
    gate = threading.Semaphore(1)
    source = CameraSource(lambda: ScriptedCapture([1.0, 2.0], gate=gate), "fake", Selection())
    stream = source.frames()
    next(stream)
    threading.Timer(0.2, source.close).start()
    assert next(stream, None) is None
    gate.release()


def test_selection_on_a_live_stream() -> None:
    capture = ScriptedCapture([50.0 * k for k in range(1, 5)])
    source = CameraSource(lambda: capture, "fake", Selection(start=1, end=4, stride=2))
    frames = list(source.frames())
    source.close()
    assert [_number_of(frame) for frame in frames] == [1, 3]
    assert [frame.index for frame in frames] == [0, 1]


def test_nothing_is_opened_before_frames_are_asked_for() -> None:
    def open_capture() -> ScriptedCapture:
        raise AssertionError("opened")

    source: Source = CameraSource(open_capture, "fake", Selection())
    source.close()
    assert source.is_live and isinstance(source, CountsLosses)


@pytest.mark.parametrize(
    ("location", "kind"),
    [
        ("rtsp://user:secret@10.0.0.7:554/live?token=1", "stream"),
        ("http://host/video.mjpg", "stream"),
        ("RTSP://host/x", "stream"),
        ("camera:0", "camera"),
        ("/dev/video2", "camera"),
        ("zenoh:front", "zenoh"),
        ("drive.MCAP", "mcap"),
        ("drive.mp4", "video"),
        ("file.with://odd", "video"),
    ],
)
def test_registry_by_location(location: str, kind: str) -> None:
    assert next(k.name for k in SOURCE_KINDS if k.matches(location)) == kind
    assert is_stream(location) == (kind == "stream")
    assert is_device(location) == (kind == "camera")


def test_credentials_do_not_reach_the_status() -> None:
    assert without_credentials("rtsp://user:secret@10.0.0.7:554/live?token=1") == "rtsp://10.0.0.7:554/live"
    assert without_credentials("http://[::1]:80/a") == "http://[::1]:80/a"
    assert "secret" not in without_credentials("rtsp://u:secret@host:notaport/")


@pytest.mark.parametrize(("location", "device"), [("camera:3", 3), ("camera:/dev/video2", "/dev/video2")])
def test_a_device_is_opened_by_number_or_path(
    location: str, device: int | str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No machine that tests this has a camera: the driver is replaced, all above it is real."""
    asked: list[object] = []

    def video_capture(*arguments: object) -> ScriptedCapture:
        asked.append(arguments)
        return ScriptedCapture([50.0, 100.0, 150.0])

    monkeypatch.setattr(cv2, "VideoCapture", video_capture)
    source = open_source(location, end=3)
    frames = list(source.frames())
    source.close()
    assert [_number_of(frame) for frame in frames] == [0, 1, 2]
    assert asked[0] == (device,)
    assert source.frame_rate_hz == 20.0


def test_a_camera_has_a_number_or_a_path() -> None:
    with pytest.raises(SourceError, match="names no camera"):
        open_device("camera:front", Selection())
