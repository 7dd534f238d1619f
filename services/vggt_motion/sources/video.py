"""A video file: each frame decoded and encoded once, here, with the container's time stamps."""

from __future__ import annotations

import hashlib
import logging
import math
import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from vggt_motion.errors import SourceError, SourceTruncatedError
from vggt_motion.sources.bitstream import Size, size_reader
from vggt_motion.sources.encoded import JPEG, encode_video_frame
from vggt_motion.sources.selection import Selection
from vggt_motion.sources.source import Frame
from vggt_motion.sources.timing import NANOSECONDS, TimestampRepair

_log = logging.getLogger(__name__)

_MILLISECOND_NS = 1_000_000
_SAMPLE_BYTES = 2**20
_HEAD_BYTES = 4096
_MAX_FRAME_COUNT = 10**9  # a raw stream without a header has a nonsensical count


class VideoFile:
    """Frames of a video file through FFmpeg, re-encoded as JPEG at a fixed quality.

    ``frame_count`` is what the container promises; a file that delivers fewer frames ends with SourceTruncatedError.
    A few are forgiven (1 in 500, at least one): edit lists and leading pictures that cannot be decoded make honest
    files miss them.
    """

    is_live = False

    def __init__(self, path: Path, selection: Selection) -> None:
        """Open the file.

        Raises:
            SourceError: no such file, not a video, or the selection lies beyond its end.
        """
        self._path = path
        self._selection = selection
        capture = _open(path)
        try:
            promised = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            rate = capture.get(cv2.CAP_PROP_FPS)
            width, height = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        finally:
            capture.release()
        self._count_is_exact = _counts_exactly(path)
        self._promised = int(promised) if 0 < promised < _MAX_FRAME_COUNT else None
        self._container_rate_hz = rate if math.isfinite(rate) and 0.01 <= rate <= 10_000 else None
        if self._container_rate_hz is None:
            _log.warning(
                "%s states no frame rate; taken as %g Hz where time stamps are missing", path, selection.nominal_rate_hz
            )
        base_rate = self._container_rate_hz or selection.nominal_rate_hz
        self._interval_ns = round(NANOSECONDS / base_rate)
        self.frame_rate_hz: float | None = base_rate / selection.stride
        self.frame_count: int | None = None if self._promised is None else selection.count(self._promised)
        if self.frame_count == 0:
            raise SourceError(f"frames {selection} select nothing: {path} has {self._promised} frames")
        counted = "an unknown number of" if self.frame_count is None else str(self.frame_count)
        self.description = f"video {path}: {width}x{height}, {base_rate:g} Hz, {counted} frames"
        self.fingerprint = f"video:{_digest(path)}:{selection}"

    def frames(self) -> Iterator[Frame]:
        """The frames in time order; see :class:`vggt_motion.sources.source.Source`."""
        capture, sizes = _open(self._path), _AnnouncedSizes(self._path)
        try:
            yield from self._read(capture, sizes)
        finally:
            capture.release()
            sizes.close()

    def close(self) -> None:
        """The file is only open while it is iterated."""

    def _read(self, capture: cv2.VideoCapture, sizes: _AnnouncedSizes) -> Iterator[Frame]:
        selection = self._selection
        repair = TimestampRepair(self._interval_ns, str(self._path))
        index = position = time_ns = 0
        has_stamps = True
        while not selection.is_past(position):
            if not capture.grab():
                break
            change = sizes.next_change()
            if change is not None and position:
                raise SourceTruncatedError(
                    f"{self._path} changes size from {change[0]} to {change[1]} at frame {position}; "
                    f"the input ends there and the {index} frames before it are used"
                )
            if selection.takes(position):
                ok, pixels = capture.retrieve()
                if not ok:
                    break
                milliseconds = capture.get(cv2.CAP_PROP_POS_MSEC)
                if position and has_stamps and not (math.isfinite(milliseconds) and milliseconds > 0):
                    # raw streams carry no times; once missing, the others would not fit to those counted from the rate
                    has_stamps = False
                time_ns = (
                    round(milliseconds * _MILLISECOND_NS) if has_stamps and position else self._interval_ns * position
                )
                yield Frame(index, repair(time_ns), encode_video_frame(np.asarray(pixels, np.uint8)), JPEG)
                index += 1
            position += 1
        if position == 0:
            raise SourceError(f"no readable frame in {self._path}")
        if index == 0:
            raise SourceError(f"frames {selection} select nothing: {self._path} has {position} readable frames")
        self._check_end(position, index, time_ns)

    def _check_end(self, read: int, used: int, last_time_ns: int) -> None:
        """Raise when the container promised more than could be read."""
        if self._promised is None or self._selection.is_past(read):
            return
        missing = self._promised - read
        if not self._count_is_exact:
            # the count is only the duration times a guessed rate: the end of the last frame must fall short of it too
            missing = min(missing, self._promised - math.ceil(last_time_ns / self._interval_ns) - 1)
        if missing > max(1, self._promised // 500):
            raise SourceTruncatedError(
                f"{self._path} is truncated or damaged: {read} of {self._promised} frames are readable; {used} are used"
            )


class _AnnouncedSizes:
    """Reads the packets of a video beside its decoder; see :mod:`vggt_motion.sources.bitstream`."""

    def __init__(self, path: Path) -> None:
        self._capture = _open(path)
        fourcc = int(self._capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode("latin-1")
        reader = size_reader(fourcc)
        # a capture that cannot give out packets gives pictures instead: they are not looked at
        self._reader = reader if reader is not None and self._capture.set(cv2.CAP_PROP_FORMAT, -1) else None
        self._size: Size | None = None

    def next_change(self) -> tuple[str, str] | None:
        """Take the next packet; the old and the new size where it announces another one than before."""
        if self._reader is None:
            return None
        ok, packet = self._capture.read()
        size = self._reader(np.asarray(packet, np.uint8).tobytes()) if ok else None
        if size is None or size == self._size:
            return None
        before, self._size = self._size, size
        return None if before is None else (f"{before[0]}x{before[1]}", f"{size[0]}x{size[1]}")

    def close(self) -> None:
        """Release the file."""
        self._capture.release()


def quiet_ffmpeg() -> None:
    """Keep FFmpeg and OpenCV from reporting on stderr what we say once, in our words: no video, a damaged macro-block.

    OpenCV reads the variable for FFmpeg at its first capture; what a user has set stays.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    if "OPENCV_LOG_LEVEL" not in os.environ:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)


def _open(path: Path) -> cv2.VideoCapture:
    if not path.is_file():
        raise SourceError(f"no such file: {path}")
    if _is_text(path):  # FFmpeg draws it, a letter at a time
        raise SourceError(f"{path} is a text file, not a video")
    quiet_ffmpeg()
    # Hardware decoders differ between machines; software decoding of a file is bit-exact by the standard.
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_HW_ACCELERATION, cv2.VIDEO_ACCELERATION_NONE])
    if not capture.isOpened():
        capture.release()
        raise SourceError(f"{path} is not a readable video")
    return capture


def _is_text(path: Path) -> bool:
    """Whether a file begins as text does, other than a playlist or raw video, whose pixels may look like letters."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror or error}") from error
    if head.startswith((b"#EXTM3U", b"ffconcat", b"YUV4MPEG2")):
        return False
    try:
        text = head.decode("utf-8")
    except UnicodeDecodeError as error:
        if error.start < len(head) - 3:  # else a character at the end was cut
            return False
        text = head[: error.start].decode("utf-8")
    return bool(text) and all(character.isprintable() or character.isspace() for character in text)


def _digest(path: Path) -> str:
    """Size, head, middle and tail of the file: a long video need not be read whole to be told from another."""
    size = path.stat().st_size
    digest = hashlib.sha256(str(size).encode())
    with path.open("rb") as file:
        for offset in (0, size // 2, max(0, size - _SAMPLE_BYTES)):
            file.seek(offset)
            digest.update(file.read(_SAMPLE_BYTES))
    return digest.hexdigest()


def _counts_exactly(path: Path) -> bool:
    """Whether this kind of container states its number of frames; for others FFmpeg guesses it from the duration."""
    with path.open("rb") as file:
        head = file.read(12)
    return head[4:8] == b"ftyp" or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")
