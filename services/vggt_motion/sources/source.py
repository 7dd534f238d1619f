"""What a source is (DESIGN section 2): frames as encoded bytes with index and capture time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable


@dataclass(frozen=True)
class Frame:
    """One input frame as it enters the system.

    ``encoded`` are exactly the bytes that are decoded, stored and recorded: file bytes are passed through, video frames
    are encoded once, here (DESIGN section 4, "recording is exact").
    """

    index: int  # 0, 1, 2, ... within what was selected with --start, --end, --stride
    capture_time_ns: int  # strictly increasing within a source
    encoded: bytes
    media_type: str  # "image/jpeg" or "image/png"


class Source(Protocol):
    """An opened source.

    Iterating raises SourceError when not one frame can be read, and SourceTruncatedError after the last good frame when
    the input ends early (unreadable frame, size change): everything yielded before stays valid.
    """

    description: str  # one line for status and report: kind, path, size
    fingerprint: str  # identifies the input: the same file or folder gives the same text, another one does not
    is_live: bool  # a live source cannot wait for us
    frame_count: int | None  # None = unknown
    frame_rate_hz: float | None

    def frames(self) -> Iterator[Frame]:
        """The frames in time order."""
        ...

    def close(self) -> None:
        """Release files and devices; safe to call twice."""
        ...


@runtime_checkable
class CountsLosses(Protocol):
    """A live source that says what it could not deliver."""

    dropped_count: int  # frames that arrived and were not taken, because newer ones did
    missing_count: int  # frames that never arrived, as far as their numbers tell
    refused_count: int  # messages or pictures that are no readable frame


@runtime_checkable
class CountsReconnects(Protocol):
    """A live source that opens its device again when that stalls."""

    reconnect_count: int


def losses_of(source: Source) -> dict[str, float]:
    """What a source has lost so far, as counters for the status; empty for a source that loses nothing."""
    losses: dict[str, float] = {}
    if isinstance(source, CountsLosses):
        losses["dropped_frames"] = source.dropped_count
        losses["missing_frames"] = source.missing_count
        losses["refused_frames"] = source.refused_count
    if isinstance(source, CountsReconnects):
        losses["reconnects"] = source.reconnect_count
    return losses
