"""Following a stream of the log: a cursor, the live publications, and reading where there is a gap (DESIGN section 4).

Live messages are the fast path only. Whatever goes missing (late start, cut link, restarted router or ledger, a full
buffer) is read from the ledger, so that what comes out is dense and in order whatever happens in between.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

from vggt_motion.bus import calls, codec
from vggt_motion.bus.ledger import LedgerClient
from vggt_motion.bus.session import Bus, Sample
from vggt_motion.errors import BusUnavailableError, CodecError, LedgerError, VggtMotionError
from vggt_motion.records import LogEntry

_log = logging.getLogger(__name__)
SEVERAL_ENTRIES: Final = codec.encoding_of(calls.ReadReply)
"""Encoding of a publication of records that became durable together."""

POLL_S = 2.0  # a lost last message shows up after this at the latest
_GAP_PATIENCE_S = 0.05  # a gap may close by itself: live messages can overtake the answer to a read
_RETRY_S = 0.25
_BUFFER_COUNT = 256
_JOIN_S = 1.0
FollowedRecord = TypeVar("FollowedRecord")


@dataclass(frozen=True)
class Followed(Generic[FollowedRecord]):
    """One record of a stream."""

    sequence: int
    record: FollowedRecord
    entry: LogEntry  # as it stands in the log


class Follower(Generic[FollowedRecord]):
    """Delivers the records of one stream, dense and in order. One thread may take from it."""

    def __init__(
        self,
        bus: Bus,
        stream: str,
        cls: type[FollowedRecord],
        *,
        from_sequence: int = 0,
        on_news: Callable[[], None] | None = None,
    ) -> None:
        """Start to follow.

        Args:
            bus: joined.
            stream: its name.
            cls: the record that it holds.
            from_sequence: first to deliver.
            on_news: None: it listens and asks for itself. Else somebody does both for several streams, with
                :meth:`offer` and :meth:`expect`, and is called whenever there is something to take; must not block.
        """
        self._ledger = LedgerClient(bus)
        self._bus = bus
        self._stream = str(stream)
        self._class = cls
        self._on_news = on_news
        lock = threading.RLock()
        self._changed = threading.Condition(lock)  # for who takes
        self._work = threading.Condition(lock)  # for our thread
        self._fetched = from_sequence  # sequence number of the next entry to put into the buffer
        self._live: dict[int, LogEntry] = {}  # ahead of the cursor
        self._buffer: deque[Followed[FollowedRecord]] = deque()
        self._position = from_sequence
        self._end = 0
        self._live_end = 0  # of what was published since the last read was sent
        self._skipped_count = 0
        self._is_doubted = True  # the ledger is to be asked whatever was published
        self._failure: VggtMotionError | None = None
        self._is_closed = False
        self._subscription = (
            bus.subscribe(bus.keys.log(self._stream), self._on_sample, is_small=True) if on_news is None else None
        )
        self._thread = threading.Thread(target=self._run, name=f"follow {stream}", daemon=True)
        self._thread.start()

    @property
    def position(self) -> int:
        """Sequence number of the record that the next call delivers."""
        return self._position

    @property
    def known_end(self) -> int:
        """Number of records that the stream is known to have; grows while the link is up."""
        return self._end

    @property
    def skipped_count(self) -> int:
        """Entries that could not be decoded and were passed over, each with an error in the log."""
        return self._skipped_count

    def next(self, timeout_s: float) -> Followed[FollowedRecord] | None:
        """The next record, or None if none came in time.

        Raises:
            LedgerError: the log is not the one that was followed: it is shorter than what was delivered.
        """
        with self._changed:
            if not self._buffer and timeout_s > 0.0:
                self._changed.wait_for(lambda: self._buffer or self._failure or self._is_closed, timeout_s)
            if not self._buffer:
                if self._failure is not None:
                    raise self._failure
                return None
            followed = self._buffer.popleft()
            self._position = followed.sequence + 1
            self._take_live()
            if self._needs_read():
                self._work.notify()
            return followed

    def offer(self, entry: LogEntry) -> None:
        """Take in what was published; from any thread."""
        with self._changed:
            self._end = max(self._end, entry.sequence + 1)
            self._live_end = max(self._live_end, entry.sequence + 1)
            # Bounded: what does not fit is read later.
            if entry.stream == self._stream and entry.sequence >= self._fetched and len(self._live) < _BUFFER_COUNT:
                self._live[entry.sequence] = entry
                self._take_live()
            if self._needs_read():
                self._work.notify()

    def expect(self, end: int) -> None:
        """The ledger says that the stream has so many records; from any thread."""
        with self._changed:
            self._end = max(self._end, end)
            self._is_doubted |= end < self._fetched
            if self._is_doubted or self._needs_read():
                self._work.notify()

    def close(self) -> None:
        """Stop following."""
        with self._changed:
            if self._is_closed:
                return
            self._is_closed = True
            self._changed.notify_all()
            self._work.notify_all()
        if self._subscription is not None:
            self._subscription.close()
        self._thread.join(_JOIN_S)

    def _on_sample(self, sample: Sample) -> None:
        for entry in published_entries(sample):
            self.offer(entry)

    def _run(self) -> None:
        next_poll = math.inf if self._on_news is not None else 0.0
        while True:
            with self._changed:
                is_due = self._is_doubted or self._needs_read() or time.monotonic() >= next_poll
                if not (self._is_closed or is_due):
                    self._work.wait(None if next_poll == math.inf else max(0.0, next_poll - time.monotonic()))
                    continue
                if not self._is_closed and len(self._buffer) >= _BUFFER_COUNT:
                    self._work.wait(POLL_S)
                    continue
                if self._needs_read() and self._live:
                    self._work.wait(_GAP_PATIENCE_S)
                    if not (self._is_closed or self._is_doubted or self._needs_read()):
                        continue
                if self._is_closed:
                    return
                position = self._fetched
                self._live_end = 0
                self._is_doubted = False
            try:
                page = self._ledger.page(self._stream, position, _BUFFER_COUNT)
                if page.next_sequence < position:
                    raise LedgerError(
                        f"stream {self._stream} has {page.next_sequence} records, but {position} were delivered: "
                        "this is another log"
                    )
                if not page.entries and page.next_sequence > position:
                    raise BusUnavailableError(f"stream {self._stream}: the ledger gave none of its records")
            except BusUnavailableError:
                with self._changed:
                    self._is_doubted = True
                if self._bus.wait(_RETRY_S):
                    self._fail(BusUnavailableError(f"stream {self._stream}: stopping"), is_final=False)
                    return
                continue
            except VggtMotionError as error:
                self._fail(error, is_final=True)
                return
            with self._changed:
                for entry in page.entries:
                    self._put(entry)
                # The ledger knows its end; a publication that claims more is believed for one read only.
                self._end = max(self._fetched, page.next_sequence, self._live_end)
                self._live = {number: entry for number, entry in self._live.items() if number < self._end}
                self._take_live()
                self._is_doubted |= bool(page.entries) and self._fetched < page.next_sequence
            if self._on_news is None:
                next_poll = time.monotonic() + POLL_S

    def _needs_read(self) -> bool:
        """There are records beyond the cursor, and the next one is not among the live ones."""
        return self._end > self._fetched and self._fetched not in self._live

    def _take_live(self) -> None:
        while len(self._buffer) < _BUFFER_COUNT and (entry := self._live.pop(self._fetched, None)) is not None:
            self._put(entry)

    def _put(self, entry: LogEntry) -> None:
        if entry.sequence != self._fetched:
            return
        self._live.pop(entry.sequence, None)
        self._fetched += 1
        try:
            record = codec.decode(self._class, entry.payload)
        except CodecError as error:
            # One bad record must not stop all that follow it.
            self._skipped_count += 1
            extra = {"stream": self._stream, "sequence": entry.sequence, "reason": str(error)}
            _log.error("a record cannot be decoded and is passed over", extra=extra)
            return
        self._buffer.append(Followed(entry.sequence, record, entry))
        self._changed.notify_all()
        if self._on_news is not None:
            self._on_news()

    def _fail(self, error: VggtMotionError, *, is_final: bool) -> None:
        if is_final:
            _log.error("following ended", extra={"stream": self._stream, "reason": str(error)})
        with self._changed:
            if is_final:
                self._failure = error
            self._is_closed = True
            self._changed.notify_all()
            if self._on_news is not None:
                self._on_news()


def published_entries(sample: Sample) -> Sequence[LogEntry]:
    """What a publication of the log holds; nothing, and a warning, where it is none."""
    try:
        if sample.encoding == SEVERAL_ENTRIES:
            return codec.decode(calls.ReadReply, sample.payload).entries
        return (codec.decode(LogEntry, sample.payload),)
    except CodecError as error:
        _log.warning("not a log entry, passed over", extra={"key": sample.key, "reason": str(error)})
        return ()
