"""Replay: the frames of a recording on the image key again, as the camera would send them."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from vggt_motion.bus.images import ImageHeader, encode_image
from vggt_motion.bus.session import Bus, open_bus
from vggt_motion.config import Config
from vggt_motion.errors import InputError, SourceTruncatedError
from vggt_motion.sources.mcap import McapSource
from vggt_motion.sources.selection import Selection
from vggt_motion.sources.source import Frame
from vggt_motion.sources.timing import NANOSECONDS

_log = logging.getLogger(__name__)
_HISTORY = 64  # frames that a receiver which joins late still gets
_SETTLE_S = 0.5


@dataclass(frozen=True)
class ReplayOutcome:
    """What was replayed."""

    frame_count: int
    laps: int  # whole passes over the recording
    truncated: str  # how the recording breaks off, if it does; empty when it is whole


def replay(
    file: Path,
    config: Config,
    *,
    rate: float = 1.0,
    loop: bool = False,
    start_s: float = 0.0,
    duration_s: float | None = None,
    camera: str | None = None,
    stopping: threading.Event | None = None,
    bus: Bus | None = None,
) -> ReplayOutcome:
    """Publish the recorded frames on the image key, at the pace of their capture times.

    Frames are published blocking and numbered 0, 1, 2, ...; the last one says that it is the last, so that a receiver
    ends. Index and capture time of a whole replay are those of the recording; in further laps both go on increasing.

    Args:
        file: MCAP recording.
        config: bus and, for the camera's name, run.
        rate: 2 = twice as fast; inf = as fast as the receivers take them.
        loop: begin again at the end, until stopped.
        start_s: skip so many seconds of the recording.
        duration_s: stop after so many seconds of the recording; None = to its end.
        camera: name in the key; None = the configured one.
        stopping: ends the replay early.
        bus: joined; None = join for the time of the replay.

    Raises:
        InputError: a parameter is out of range, or nothing is left after ``start_s``.
        SourceError: the file is no recording with frames.
        BusUnavailableError: no router answers.
    """
    if not rate > 0:
        raise InputError(f"the rate must be positive: {rate}")
    if not (math.isfinite(start_s) and start_s >= 0):
        raise InputError(f"the start must not be negative: {start_s}")
    if duration_s is not None and not duration_s > 0:
        raise InputError(f"the duration must be positive: {duration_s}")
    source = McapSource(file, Selection())
    stopping = stopping or threading.Event()
    own_bus = bus is None
    joined = open_bus(config.bus, stopping=stopping) if bus is None else bus
    try:
        with_camera = camera or config.run.camera
        publisher = joined.publisher(
            joined.keys.image(with_camera),
            blocking=True,
            history=_HISTORY,
            encoding="application/protobuf;foxglove.CompressedImage",
        )
        try:
            # Before Zenoh has told us of the receivers that are there, it drops what is published.
            stopping.wait(_SETTLE_S)
            pace = _Pace(rate, stopping)
            frames = _Laps(source, start_s, duration_s, loop=loop)
            count = 0
            for frame, is_last in _with_last(frames):
                if not pace.wait_for(frame.capture_time_ns):
                    break
                publisher.put(
                    encode_image(frame, with_camera),
                    timestamp_ns=time.time_ns(),
                    attachment=ImageHeader(0, frame.index, is_last, is_accepted=False).encode(),
                )
                count += 1
            # What a receiver missed it asks us for, as long as we are there.
            stopping.wait(_SETTLE_S)
        finally:
            publisher.close()
    finally:
        source.close()
        if own_bus:
            joined.close()
    return ReplayOutcome(count, frames.laps, frames.truncated)


class _Laps:
    """The frames of a recording, once or again and again, index and time always increasing."""

    def __init__(self, source: McapSource, start_s: float, duration_s: float | None, *, loop: bool) -> None:
        self._source = source
        self._start_ns = round(start_s * NANOSECONDS)
        self._duration_ns = None if duration_s is None else round(duration_s * NANOSECONDS)
        self._is_looping = loop
        self.laps = 0
        self.truncated = ""

    def __iter__(self) -> Iterator[Frame]:
        index, shift_ns = 0, 0
        while True:
            first: Frame | None = None
            last_ns = 0
            for frame in self._lap():
                first = first or frame
                last_ns = frame.capture_time_ns
                # A whole recording keeps its very indices and times; a part of it begins at index 0.
                yield replace(frame, index=index, capture_time_ns=last_ns + shift_ns)
                index += 1
            if first is None:
                raise InputError(f"no frame of {self._source.description} lies in the chosen part")
            self.laps += 1
            if not self._is_looping:
                return
            interval_ns = round(NANOSECONDS / (self._source.frame_rate_hz or 10.0))
            shift_ns += last_ns - first.capture_time_ns + interval_ns

    def _lap(self) -> Iterator[Frame]:
        begin_ns: int | None = None
        try:
            for frame in self._source.frames():
                begin_ns = frame.capture_time_ns if begin_ns is None else begin_ns
                passed_ns = frame.capture_time_ns - begin_ns
                if self._duration_ns is not None and passed_ns >= self._start_ns + self._duration_ns:
                    return
                if passed_ns >= self._start_ns:
                    yield frame
        except SourceTruncatedError as error:
            self.truncated = str(error)


class _Pace:
    """Waits until a frame is due, counted from the first one."""

    def __init__(self, rate: float, stopping: threading.Event) -> None:
        self._rate = rate
        self._stopping = stopping
        self._origin: tuple[int, float] | None = None

    def wait_for(self, capture_time_ns: int) -> bool:
        """False if told to stop."""
        if self._origin is None:
            self._origin = (capture_time_ns, time.monotonic())
        first_ns, begin = self._origin
        due = begin + (capture_time_ns - first_ns) / NANOSECONDS / self._rate
        delay = due - time.monotonic()
        return not self._stopping.wait(delay) if delay > 0 else not self._stopping.is_set()


def _with_last(frames: _Laps) -> Iterator[tuple[Frame, bool]]:
    """Each frame with whether it is the last one."""
    previous: Frame | None = None
    for frame in frames:
        if previous is not None:
            yield previous, False
        previous = frame
    if previous is not None:
        yield previous, True
