"""Live pictures: a camera at this machine, or a network stream (RTSP and whatever else FFmpeg reads from a URL).

The newest frame wins: a thread takes every frame from the device at once; those that the frontend has no time for are
dropped, oldest first, and counted. A stream that stalls or breaks off is opened again, for as long as it takes. One
that comes back with pictures of another size has ended, and what was read is finished. (Within one connection OpenCV
scales such pictures to the first size, and nobody can tell.)
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol
from urllib.parse import urlsplit

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.errors import SourceError, SourceTruncatedError
from vggt_motion.sources.encoded import JPEG, encode_video_frame
from vggt_motion.sources.selection import Selection
from vggt_motion.sources.source import Frame
from vggt_motion.sources.timing import NANOSECONDS, TimestampRepair
from vggt_motion.sources.video import quiet_ffmpeg

_log = logging.getLogger(__name__)

STREAM_SCHEMES = ("rtsp", "rtsps", "rtp", "http", "https", "udp", "tcp")
DEVICE_PREFIX = "camera:"

_CAPACITY = 4  # decoded frames that wait; more is only delay
_POLL_S = 0.1
_OPEN_TIMEOUT_S = 10.0
_READ_TIMEOUT_S = 5.0  # a stream that is silent for so long has stalled
_FIRST_RETRY_S, _LAST_RETRY_S = 0.5, 5.0
_EARLY_TOLERANCE_NS, _LATE_TOLERANCE_NS = NANOSECONDS // 2, 10 * NANOSECONDS
_MILLISECOND_NS = 1_000_000
# JPEG pictures in a row, as many webcams send them over HTTP, carry no times; FFmpeg makes some up, 25 in a second
_MOTION_JPEG = (float(cv2.VideoWriter.fourcc(*"MJPG")), float(cv2.VideoWriter.fourcc(*"mjpg")))


class Capture(Protocol):
    """The part of cv2.VideoCapture that is used."""

    def isOpened(self) -> bool:  # noqa: N802
        """Whether frames can be expected."""
        ...

    def read(self) -> tuple[bool, npt.NDArray[np.uint8] | None]:
        """The next frame, (H, W, 3) BGR; blocks."""
        ...

    def get(self, propId: int) -> float:  # noqa: N803
        """A property; 0 where unknown."""
        ...

    def release(self) -> None:
        """Close."""
        ...


@dataclass(frozen=True)
class _Picture:
    pixels: npt.NDArray[np.uint8]
    capture_time_ns: int


class CameraSource:
    """Frames of a live camera or stream, as JPEG, with the device's time stamps on the wall clock."""

    is_live = True
    frame_count: int | None = None

    def __init__(
        self,
        open_capture: Callable[[], Capture],
        name: str,
        selection: Selection,
        *,
        first_frame_timeout_s: float = 30.0,
        has_stamps: Callable[[Capture], bool] = lambda _: True,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Remember how to open the device; that happens when the frames are asked for.

        Args:
            open_capture: opens the device; called again whenever it stalls or breaks off.
            name: for status and report, without credentials.
            selection: which of the delivered frames to take.
            first_frame_timeout_s: without a frame for so long from the start there is no camera.
            has_stamps: whether the opened device's time stamps mean something.
            clock_ns: wall clock.
        """
        self._open_capture = open_capture
        self._name = name
        self._selection = selection
        self._first_frame_timeout_s = first_frame_timeout_s
        self._has_stamps = has_stamps
        self._clock_ns = clock_ns
        self._changed = threading.Condition()
        self._waiting: deque[_Picture] = deque()
        self._is_closed = threading.Event()
        self.frame_rate_hz: float | None = None  # known once the device is open
        self.dropped_count = 0  # frames that arrived and were not taken, because newer ones did
        self.missing_count = 0  # frames that never arrived, as far as the device's stamps tell
        self.refused_count = 0  # frames that are not readable: such a stream is opened again
        self.reconnect_count = 0  # times that the stream stalled or broke off and was opened again
        self.description = f"live {name}"
        self.fingerprint = f"live:{name}:{selection}"

    def frames(self) -> Iterator[Frame]:
        """The frames as they come, until :meth:`close`.

        Raises:
            SourceError: not one frame arrived in time.
            SourceTruncatedError: the stream was opened again and has another size.
        """
        repair = TimestampRepair(round(NANOSECONDS / self._selection.nominal_rate_hz), self.description)
        quiet_ffmpeg()
        threading.Thread(target=self._read_on, name="camera", daemon=True).start()
        position = index = 0
        size: tuple[int, int] | None = None
        while not self._selection.is_past(position):
            picture = self._next(self._first_frame_timeout_s if position == 0 else None)
            if picture is None:
                if position == 0 and not self._is_closed.is_set():
                    raise SourceError(f"no frame came from {self._name} within {self._first_frame_timeout_s:g} s")
                return
            height, width = picture.pixels.shape[:2]
            size = size or (width, height)
            if size != (width, height):
                raise SourceTruncatedError(
                    f"{self._name} has changed size from {size[0]}x{size[1]} to {width}x{height}; "
                    f"the input ends there and the {index} frames before it are used"
                )
            if self._selection.takes(position):
                yield Frame(index, repair(picture.capture_time_ns), encode_video_frame(picture.pixels), JPEG)
                index += 1
            position += 1

    def close(self) -> None:
        """End the stream; safe to call twice. The device is released by the thread that reads from it."""
        self._is_closed.set()
        with self._changed:
            self._changed.notify_all()

    def _next(self, timeout_s: float | None) -> _Picture | None:
        end = None if timeout_s is None else time.monotonic() + timeout_s
        with self._changed:
            while not self._waiting:
                if self._is_closed.is_set() or (end is not None and time.monotonic() >= end):
                    return None
                self._changed.wait(_POLL_S)
            return self._waiting.popleft()

    def _read_on(self) -> None:
        retry_s = _FIRST_RETRY_S
        while not self._is_closed.is_set():
            count = self._read_until_it_breaks()
            if self._is_closed.is_set():
                return
            retry_s = _FIRST_RETRY_S if count else min(2 * retry_s, _LAST_RETRY_S)
            if count:
                self.reconnect_count += 1
                _log.warning("%s stalled or broke off after %d frames; opening it again", self._name, count)
            self._is_closed.wait(retry_s)

    def _read_until_it_breaks(self) -> int:
        """Read until there is no frame any more; returns how many there were."""
        count = 0
        capture: Capture | None = None
        try:
            capture = self._open_capture()
            if not capture.isOpened():
                return 0
            has_stamps = self._has_stamps(capture)
            rate = capture.get(cv2.CAP_PROP_FPS)
            self.frame_rate_hz = rate if has_stamps and math.isfinite(rate) and 0.1 <= rate <= 1000 else None
            clock = _DeviceClock(self._clock_ns, self.frame_rate_hz)
            while not self._is_closed.is_set():
                ok, pixels = capture.read()
                if not ok or pixels is None:
                    return count
                time_ns, missing = clock.stamp(capture.get(cv2.CAP_PROP_POS_MSEC) if has_stamps else math.nan)
                count += 1
                self.missing_count += missing
                with self._changed:
                    if len(self._waiting) >= _CAPACITY:
                        self._waiting.popleft()
                        self.dropped_count += 1
                    self._waiting.append(_Picture(pixels, time_ns))
                    self._changed.notify_all()
        except cv2.error as error:
            _log.warning("%s: %s", self._name, " ".join(str(error).split()))
        finally:
            if capture is not None:
                capture.release()
        return count


class _DeviceClock:
    """Puts a device's stamps (milliseconds since whenever) on the wall clock.

    The time of arrival jitters with decoding and network, the device's stamps do not. The first frame ties one to the
    other, and a later one when they have gone apart: when it comes much sooner than the first one did, after a burst of
    frames that had waited, or absurdly late, as the device's clock was set anew.
    """

    def __init__(self, clock_ns: Callable[[], int], rate_hz: float | None) -> None:
        self._clock_ns = clock_ns
        self._rate_hz = rate_hz
        self._offset_ns: int | None = None
        self._last_ms: float | None = None

    def stamp(self, device_ms: float) -> tuple[int, int]:
        """Wall-clock time of the frame in nanoseconds, and how many frames are missing before it.

        Args:
            device_ms: the device's stamp; one that is not a number, negative or not later than the last is none, and
                the frame gets its time of arrival.
        """
        now_ns = self._clock_ns()
        last_ms = self._last_ms
        if not math.isfinite(device_ms) or device_ms < 0 or (last_ms is not None and device_ms <= last_ms):
            self._last_ms = self._offset_ns = None
            return now_ns, 0
        self._last_ms = device_ms
        device_ns = round(device_ms * _MILLISECOND_NS)
        delay_ns = now_ns - device_ns
        offset_ns = self._offset_ns
        if offset_ns is None or not -_EARLY_TOLERANCE_NS <= delay_ns - offset_ns <= _LATE_TOLERANCE_NS:
            self._offset_ns = offset_ns = delay_ns
        steps = 1 if last_ms is None or self._rate_hz is None else round((device_ms - last_ms) * 1e-3 * self._rate_hz)
        return device_ns + offset_ns, max(0, steps - 1)


def is_stream(location: str) -> bool:
    """Whether the location is the URL of a network stream."""
    scheme, separator, _ = location.partition("://")
    return bool(separator) and scheme.lower() in STREAM_SCHEMES


def is_device(location: str) -> bool:
    """Whether the location is a camera at this machine: ``camera:0``, ``camera:/dev/video2`` or ``/dev/video2``."""
    return location.startswith((DEVICE_PREFIX, "/dev/video"))


def without_credentials(url: str) -> str:
    """The URL without user name and password, for logs and reports."""
    try:
        parts = urlsplit(url)
        host = parts.hostname or ""
        port = f":{parts.port}" if parts.port is not None else ""
    except ValueError:
        return url.partition("://")[0] + "://..."
    # a query may hold a token as well
    return f"{parts.scheme}://{f'[{host}]' if ':' in host else host}{port}{parts.path}"


def open_stream(location: str, selection: Selection) -> CameraSource:
    """A network stream by its URL."""
    is_over_http = location.partition("://")[0].lower() in ("http", "https")
    parameters = [
        cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
        round(1e3 * _OPEN_TIMEOUT_S),
        cv2.CAP_PROP_READ_TIMEOUT_MSEC,
        round(1e3 * _READ_TIMEOUT_S),
    ]
    return CameraSource(
        lambda: cv2.VideoCapture(location, cv2.CAP_FFMPEG, parameters),  # type: ignore[arg-type, return-value]
        f"stream {without_credentials(location)}",
        selection,
        has_stamps=lambda capture: not (is_over_http and capture.get(cv2.CAP_PROP_FOURCC) in _MOTION_JPEG),
    )


def open_device(location: str, selection: Selection) -> CameraSource:
    """A camera at this machine by number or path.

    Raises:
        SourceError: the number is none.
    """
    text = location.removeprefix(DEVICE_PREFIX)
    device: int | str = text
    if not text.startswith("/"):
        if not text.isdecimal():
            raise SourceError(f"'{location}' names no camera: use camera:0, camera:1, ... or camera:/dev/video0")
        device = int(text)
    return CameraSource(
        lambda: cv2.VideoCapture(device),  # type: ignore[arg-type, return-value]
        f"camera {text}",
        selection,
        first_frame_timeout_s=10.0,
    )
