"""A recording as a source: the recorded frames, byte for byte, with the index and capture time that they had.

Any MCAP file with foxglove.CompressedImage messages (JPEG or PNG) will do; in recordings of ours the frames are
numbered, so that order and repeats in the file do not matter. Frames of a bridge that did not number them are taken as
the recorded segments list them: those that the frontend accepted, and the ones after the last segment. Where a file has
both, the segments say which were the frontend's.
"""

from __future__ import annotations

import hashlib
import logging
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from google.protobuf.message import DecodeError

from vggt_motion import foxglove
from vggt_motion.errors import CodecError, SourceError, SourceTruncatedError
from vggt_motion.recorder import schemas
from vggt_motion.recorder.container import Location, McapScanner, StoredMessage
from vggt_motion.recorder.record import CAMERA, EPOCH, LOG_TOPIC, NUMBERED
from vggt_motion.records import Stream
from vggt_motion.sources.encoded import checked_media_type
from vggt_motion.sources.selection import Selection
from vggt_motion.sources.source import Frame
from vggt_motion.sources.timing import NANOSECONDS, TimestampRepair, median_interval_ns
from vggt_motion.v1 import segment_pb2

_log = logging.getLogger(__name__)
_SEGMENT_TOPIC = LOG_TOPIC + Stream.SEGMENT.value


@dataclass(frozen=True, slots=True)
class _Entry:
    """Where a frame lies, and what orders it."""

    topic: str
    is_numbered: bool
    epoch: int
    index: int
    capture_time_ns: int
    location: Location
    checksum: int


class McapSource:
    """Frames of one camera of an MCAP file."""

    is_live = False

    def __init__(self, path: Path, selection: Selection) -> None:
        """Open and scan the file.

        Args:
            path: an MCAP file, whole or broken off.
            selection: which of the frames to take.

        Raises:
            SourceError: no MCAP file, no frame in it, or the selection is empty.
        """
        self._scanner = McapScanner(path)
        try:
            entries = self._scan()
            if not entries:
                raise SourceError(self._nothing_found())
        except BaseException:
            self._scanner.close()
            raise
        self._path = path
        self._total = len(entries)
        self._reaches_end = selection.end is None or selection.end > len(entries)
        self._entries = list(selection.of(entries))
        if not self._entries:
            self._scanner.close()
            raise SourceError(f"frames {selection} select nothing: {path} has {len(entries)} frames")
        self._interval_ns = median_interval_ns(
            [entry.capture_time_ns for entry in self._entries], round(NANOSECONDS / selection.nominal_rate_hz)
        )
        self.frame_count: int | None = len(self._entries)
        self.frame_rate_hz: float | None = NANOSECONDS / self._interval_ns
        self.description = f"recording {path}: {len(self._entries)} of {len(entries)} frames"
        self.fingerprint = _fingerprint(entries, selection)

    def frames(self) -> Iterator[Frame]:
        """The frames in time order; see :class:`vggt_motion.sources.source.Source`."""
        repair = TimestampRepair(self._interval_ns, self.description)
        for index, entry in enumerate(self._entries):
            try:
                encoded, media_type = _read_image(self._scanner.data_at(entry.location))
            except (CodecError, SourceError) as error:
                message = f"frame {index} of {self._path}: {error}"
                if index == 0:
                    raise SourceError(message) from error
                raise SourceTruncatedError(f"{message}; the {index} frames before it are used") from error
            yield Frame(index, repair(entry.capture_time_ns), encoded, media_type)
        if self._scanner.damage is not None and self._reaches_end:
            raise SourceTruncatedError(
                f"{self._path} is broken off: {self._scanner.damage}; the {self._total} frames before that are used"
            )

    def close(self) -> None:
        """Close the file."""
        self._scanner.close()

    def _scan(self) -> list[_Entry]:
        entries: list[_Entry] = []
        accepted: dict[int, int] = {}  # capture time of a frame that a segment lists -> its index
        self._topics: set[str] = set()
        for message in self._scanner.messages():
            self._topics.add(message.channel.topic)
            if message.channel.schema_name == schemas.IMAGE and message.channel.message_encoding == "protobuf":
                entries.append(_entry(message))
            elif message.channel.topic == _SEGMENT_TOPIC:
                accepted.update(_listed_frames(message.data))
        counts = Counter(entry.topic for entry in entries)
        if not counts:
            return []
        topic = min(counts, key=lambda name: (-counts[name], name))
        if len(counts) > 1:
            others = ", ".join(sorted(name for name in counts if name != topic))
            _log.warning("%s holds several cameras: %s is taken, not %s", self._scanner.path, topic, others)
        numbered = [entry for entry in entries if entry.topic == topic and entry.is_numbered]
        unnumbered = [entry for entry in entries if entry.topic == topic and not entry.is_numbered]
        # Whoever else published on the key while the frontend did: their frames are not those that it accepted.
        if not unnumbered or _are_most(numbered, accepted):
            return _in_order(numbered, self._scanner.path)
        return _as_listed(unnumbered, accepted)

    def _nothing_found(self) -> str:
        damage = f"; the file is broken off: {self._scanner.damage}" if self._scanner.damage else ""
        # escaped as in a literal: what stands in a file must not break the line
        topics = ", ".join(repr(topic)[1:-1] for topic in sorted(self._topics)[:8]) or "none"
        return f"{self._scanner.path} has no {schemas.IMAGE} messages (topics: {topics}){damage}"


def open_mcap(location: str, selection: Selection) -> McapSource:
    """Open a recording; see :func:`vggt_motion.sources.registry.open_source`."""
    return McapSource(Path(location), selection)


def _entry(message: StoredMessage) -> _Entry:
    metadata = message.channel.metadata
    try:
        epoch = int(metadata.get(EPOCH, "0"))
        _, _, capture_time_ns = foxglove.decode_image(message.data)
    except (CodecError, ValueError):
        # Kept, so that reading ends here with a clear word instead of passing over a frame in silence.
        epoch, capture_time_ns = 0, message.publish_time_ns
    return _Entry(
        message.channel.topic,
        CAMERA in metadata and metadata.get(NUMBERED) == "true",
        epoch,
        message.sequence,
        # A bridge may leave the time of the image unset; the time of publication is the next best.
        capture_time_ns or message.publish_time_ns,
        message.location,
        zlib.crc32(message.data),
    )


def _listed_frames(payload: bytes) -> dict[int, int]:
    try:
        segment = segment_pb2.Segment.FromString(payload)
    except DecodeError:
        return {}
    return {frame.capture_time_ns: frame.frame_index for frame in segment.frames}


def _in_order(entries: list[_Entry], path: Path) -> list[_Entry]:
    """Numbered frames by number, each once."""
    by_number = {(entry.epoch, entry.index): entry for entry in reversed(entries)}
    ordered = [by_number[number] for number in sorted(by_number)]
    missing = sum(
        1 + max(entry.index for entry in ordered if entry.epoch == epoch)
        for epoch in {entry.epoch for entry in ordered}
    ) - len(ordered)
    if missing > 0:
        _log.warning("%s lacks %d frames of the original run; the others are numbered anew", path, missing)
    return ordered


def _are_most(entries: list[_Entry], accepted: dict[int, int]) -> bool:
    """Whether frames are at least half of what the segments list."""
    found = {entry.capture_time_ns for entry in entries} & accepted.keys()
    return bool(accepted) and 2 * len(found) >= len(accepted)


def _as_listed(entries: list[_Entry], accepted: dict[int, int]) -> list[_Entry]:
    """Frames without numbers: what the segments list, and what came after the last.

    All of them where there are no segments, and where the frontend had to give other times than the frames' own (a
    bridge that leaves the time unset), so that frames and segments cannot be brought together.
    """
    if not _are_most(entries, accepted):
        return entries
    last_ns = max(accepted)
    return [entry for entry in entries if entry.capture_time_ns in accepted or entry.capture_time_ns > last_ns]


def _read_image(payload: bytes) -> tuple[bytes, str]:
    encoded, _, _ = foxglove.decode_image(payload)
    return encoded, checked_media_type(encoded)


def _fingerprint(entries: list[_Entry], selection: Selection) -> str:
    """Time and checksum of every frame: the same after repair or another compression, another with any other frame."""
    digest = hashlib.sha256()
    for entry in entries:
        digest.update(b"%d,%d;" % (entry.capture_time_ns, entry.checksum))
    return f"mcap:{digest.hexdigest()}:{selection}"
