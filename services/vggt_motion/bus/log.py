"""All streams of the log at once, for those who fold it: backend, gateway, recorder, ``run``."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping

from vggt_motion.bus.follow import Follower, published_entries
from vggt_motion.bus.keys import last_chunk
from vggt_motion.bus.ledger import LedgerClient
from vggt_motion.bus.session import Bus, Sample
from vggt_motion.errors import BusUnavailableError, VggtMotionError
from vggt_motion.records import Constraint, Event, GraphUpdate, Keyframe, LedgerStatus, Segment, Stream, SubmapGeometry

_log = logging.getLogger(__name__)
_POLL_S = 10.0
_RETRY_S = 0.25
_JOIN_S = 1.0
LogRecord = Keyframe | Segment | SubmapGeometry | Constraint | GraphUpdate | Event

RECORD_OF_STREAM: dict[Stream, type[LogRecord]] = {
    Stream.KEYFRAME: Keyframe,
    Stream.SEGMENT: Segment,
    Stream.SUBMAP: SubmapGeometry,
    Stream.CONSTRAINT: Constraint,
    Stream.GRAPH: GraphUpdate,
    Stream.EVENT: Event,
}


class LogFollower:
    """Follows every stream; records of one stream come in order, the streams are independent."""

    def __init__(
        self,
        bus: Bus,
        positions: Mapping[Stream, int] | None = None,
        *,
        on_status: Callable[[LedgerStatus | None], None] | None = None,
        interval_s: float = _POLL_S,
    ) -> None:
        """Start to follow.

        Args:
            bus: joined.
            positions: first record to deliver of each stream; 0 where it names none.
            on_status: told what the ledger says of itself whenever it was asked; None: it did not answer. Called from
                a thread of ours.
            interval_s: how often the ledger is asked; a lost last message shows up after this at the latest. It is
                asked besides when it appears, anew or behind a link that was cut.
        """
        self._ledger = LedgerClient(bus)
        self._on_status = on_status
        self._interval_s = interval_s
        self._news = threading.Event()
        self._is_due = threading.Event()
        self._is_closed = False
        first = positions or {}
        self.followers: dict[Stream, Follower[LogRecord]] = {
            stream: Follower(bus, stream, cls, from_sequence=first.get(stream, 0), on_news=self._news.set)
            for stream, cls in RECORD_OF_STREAM.items()
        }
        self._by_name = {stream.value: follower for stream, follower in self.followers.items()}
        self._subscription = bus.subscribe(bus.keys.all_logs(), self._on_sample, is_small=True)
        self._liveliness = bus.watch_liveliness(bus.keys.all_alive("ledger"), self._on_ledger)
        self._thread = threading.Thread(target=self._watch, name="watch the log", daemon=True)
        self._thread.start()

    def wait(self, timeout_s: float) -> bool:
        """Wait for something to take; whether there may be."""
        has_news = self._news.wait(timeout_s)
        # Before it is taken: what comes in between is announced again.
        self._news.clear()
        return has_news

    def wake(self) -> None:
        """End a :meth:`wait` that is under way; from any thread."""
        self._news.set()

    def poll(self) -> list[LogRecord]:
        """What is new since the last call; does not wait."""
        records: list[LogRecord] = []
        for follower in self.followers.values():
            while (followed := follower.next(0.0)) is not None:
                records.append(followed.record)
        return records

    def expect(self, ends: Mapping[str, int]) -> None:
        """The ledger says that its streams have so many records each: what has not come is read at once."""
        for name, follower in self._by_name.items():
            follower.expect(ends.get(name, 0))

    def positions(self) -> dict[Stream, int]:
        """Of each stream, the sequence number of the record that is delivered next."""
        return {stream: follower.position for stream, follower in self.followers.items()}

    def close(self) -> None:
        """Stop following."""
        self._is_closed = True
        self._is_due.set()
        self._subscription.close()
        self._liveliness.close()
        for follower in self.followers.values():
            follower.close()
        self._thread.join(_JOIN_S)

    def _on_sample(self, sample: Sample) -> None:
        follower = self._by_name.get(last_chunk(sample.key))
        if follower is not None:
            for entry in published_entries(sample):
                follower.offer(entry)

    def _on_ledger(self, _: str, is_alive: bool) -> None:
        if is_alive:
            self._is_due.set()

    def _watch(self) -> None:
        """Ask the ledger for the ends of all streams now and then: a publication may be lost."""
        wait_s = 0.0
        while True:
            self._is_due.wait(wait_s)
            self._is_due.clear()
            if self._is_closed:
                return
            wait_s = self._interval_s
            status: LedgerStatus | None = None
            try:
                status = self._ledger.status()
            except BusUnavailableError:
                wait_s = _RETRY_S
            except VggtMotionError as error:
                _log.warning("the ledger does not say how long the log is", extra={"reason": str(error)})
            if self._on_status is not None:
                self._on_status(status)
            if status is not None:
                self.expect({entry.stream: entry.next_sequence for entry in status.positions})
