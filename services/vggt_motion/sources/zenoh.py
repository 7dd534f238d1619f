"""Frames from the image key of the bus: a robot's bridge, a camera on another machine, a replayed recording.

Publishers that number their frames (a replay, a frontend elsewhere) are waited for and get every frame through: they
publish blocking. From those that do not, the newest frame wins: what does not fit is dropped and counted.
The location is ``zenoh:CAMERA``; endpoint and session are those of the configuration in the environment
(``VGGT_MOTION_BUS__ENDPOINT``, ``VGGT_MOTION_BUS__SESSION``), or are given by who opens the source.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Iterator

from vggt_motion.bus.images import ReceivedImage, decode_image
from vggt_motion.bus.keys import Keys
from vggt_motion.bus.logs import is_told
from vggt_motion.bus.session import Bus, Sample, open_bus
from vggt_motion.config import BusConfig, Config, load_config
from vggt_motion.errors import BusError, CodecError, SourceError
from vggt_motion.sources.selection import Selection
from vggt_motion.sources.source import Frame
from vggt_motion.sources.timing import NANOSECONDS, TimestampRepair

_log = logging.getLogger(__name__)
_CAPACITY = 8
_POLL_S = 0.5


class ZenohSource:
    """Frames of one camera from the bus."""

    is_live = True
    frame_count: int | None = None
    frame_rate_hz: float | None = None

    def __init__(
        self,
        config: BusConfig,
        camera: str,
        selection: Selection,
        *,
        first_frame_timeout_s: float = 60.0,
        idle_timeout_s: float | None = None,
    ) -> None:
        """Remember where; the bus is joined by :meth:`join`, at the latest by :meth:`frames`.

        Args:
            config: endpoint and session.
            camera: name in the image key.
            selection: which of the arriving frames to take.
            first_frame_timeout_s: without a frame for so long from the start there is no camera.
            idle_timeout_s: the stream has ended when nothing came for so long; None = it never ends by itself.

        Raises:
            ConfigurationError: the camera's name cannot be part of a key.
        """
        self._config = config
        self._camera = camera
        self._key = Keys(config.session).image(camera)
        self._bus: Bus | None = None
        self._selection = selection
        self._first_frame_timeout_s = first_frame_timeout_s
        self._idle_timeout_s = idle_timeout_s
        self._changed = threading.Condition()
        self._waiting: deque[ReceivedImage] = deque()
        self._last_index: tuple[int, int] = (-1, -1)
        self._is_ended = False
        self.dropped_count = 0  # frames that arrived and were not taken, because newer ones did
        self.missing_count = 0  # numbers that a publisher left out: frames that never arrived
        self.refused_count = 0  # messages that are no image, or too large a one
        self.description = f"camera {camera} on the bus, session {config.session}"
        self.fingerprint = f"zenoh:{camera}:{selection}"

    def join(self) -> None:
        """Join the bus and begin to receive, over a link of its own: a source that waits may hold up nothing else.

        Raises:
            SourceError: no router answers.
        """
        if self._bus is not None:
            return
        try:
            self._bus = open_bus(self._config)
        except BusError as error:
            raise SourceError(f"zenoh:{self._camera}: {error}") from error
        self._bus.subscribe(self._key, self._on_sample, history=True)

    def frames(self) -> Iterator[Frame]:
        """The frames in order of arrival, until the publisher says that it was the last, or :meth:`close`.

        Raises:
            SourceError: no router answers, or not one frame arrived in time.
        """
        self.join()
        repair: TimestampRepair | None = None
        position = index = 0
        while (image := self._next(is_first=position == 0)) is not None:
            if self._selection.is_past(position):
                return
            if self._selection.takes(position):
                if repair is None:
                    interval_ns = round(NANOSECONDS / self._selection.nominal_rate_hz)
                    repair = TimestampRepair(interval_ns, self.description)
                # A bridge that leaves the time unset means "now".
                is_timed = image.header is not None or image.capture_time_ns > 0
                time_ns = image.capture_time_ns if is_timed else time.time_ns()
                yield Frame(index, repair(time_ns), image.encoded, image.media_type)
                index += 1
            position += 1
        if position == 0:
            raise SourceError(f"no frame came on {self._key}")

    def close(self) -> None:
        """End the stream and leave the bus; safe to call twice."""
        self._end()
        if self._bus is not None:
            self._bus.close()

    def _end(self) -> None:
        with self._changed:
            self._is_ended = True
            self._changed.notify_all()

    def _next(self, *, is_first: bool) -> ReceivedImage | None:
        timeout_s = self._first_frame_timeout_s if is_first else self._idle_timeout_s
        end = None if timeout_s is None else time.monotonic() + timeout_s
        with self._changed:
            while not self._waiting:
                if self._is_ended or (end is not None and time.monotonic() >= end):
                    return None
                self._changed.wait(_POLL_S)
            image = self._waiting.popleft()
            self._changed.notify_all()
            return image

    def _on_sample(self, sample: Sample) -> None:
        try:
            image = decode_image(sample.payload, sample.attachment)
        except CodecError as error:
            self.refused_count += 1
            if is_told(self.refused_count):
                _log.warning(
                    "image refused", extra={"key": self._key, "count": self.refused_count, "reason": str(error)}
                )
            return
        with self._changed:
            if self._is_ended or not self._is_next(image):
                return
            if image.header is None:
                if len(self._waiting) >= _CAPACITY:
                    self._waiting.popleft()
                    self.dropped_count += 1
            else:
                # Not taking the next message from the link is what makes a blocking publisher wait.
                self._changed.wait_for(lambda: self._is_ended or len(self._waiting) < _CAPACITY)
            self._waiting.append(image)
            if image.header is not None and image.header.is_last:
                self._is_ended = True
            self._changed.notify_all()

    def _is_next(self, image: ReceivedImage) -> bool:
        """Whether a numbered frame comes after the last one; repeats come from the history of a publisher."""
        if image.header is None:
            return True
        number = (image.header.epoch, image.header.frame_index)
        if number <= self._last_index:
            return False
        if number[0] == self._last_index[0]:
            self.missing_count += number[1] - self._last_index[1] - 1
        self._last_index = number
        return True


def open_zenoh(location: str, selection: Selection, config: Config | None = None) -> ZenohSource:
    """Open ``zenoh:CAMERA``; see :func:`vggt_motion.sources.registry.open_source`.

    Args:
        location: without a camera's name the configured one is meant.
        selection: which of the arriving frames to take.
        config: where the bus is; None = as the environment says.
    """
    settings = load_config() if config is None else config
    camera = location.removeprefix("zenoh:").strip("/")
    return ZenohSource(settings.bus, camera or settings.run.camera, selection)
