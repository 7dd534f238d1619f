"""Records of a file on their way to the ledger: several travel together while the frontend looks at the next frames."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

from vggt_motion.bus import codec
from vggt_motion.bus.ledger import AppendResult, LedgerClient, append_request
from vggt_motion.bus.wire import Payload
from vggt_motion.errors import BusUnavailableError, DiskFullError, VggtMotionError

MAX_WAITING_BYTES: Final = 16 * 2**20
MAX_WAITING: Final = 64
_RETRY_S = 0.5
_GATHER_S = 0.1  # nobody waits for a frame of a file so soon, and of what goes together each costs a third


class LedgerSender:
    """Appends records in the order in which they are put, in a thread of its own; bounded.

    A source never outruns the ledger by more than what may wait here. Nothing is left out: what the ledger has no space
    for is sent until it has, and nothing more is taken meanwhile.
    """

    def __init__(self, ledger: LedgerClient, on_disk_full: Callable[[DiskFullError], None]) -> None:
        """Start.

        Args:
            ledger: where the records go.
            on_disk_full: called, from the thread, each time the ledger has no space.
        """
        self._ledger = ledger
        self._on_disk_full = on_disk_full
        self._changed = threading.Condition()
        self._waiting: deque[tuple[str, Payload]] = deque()  # record id, request
        self._waiting_bytes = 0
        self._is_disk_full = False
        self._is_flushing = False
        self._is_closed = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="send to the ledger", daemon=True)
        self._thread.start()

    def put(self, stream: str, record_id: str, record: codec.Record, blobs: Sequence[bytes] = ()) -> None:
        """Let a record wait to be sent, as soon as there is room.

        Raises:
            VggtMotionError: one that was put before could not be sent; the sender takes nothing more.
            CodecError: the record breaks a rule of the wire.
        """
        request = codec.encode_in_pieces(append_request(stream, record_id, record, blobs))
        with self._changed:
            self._wait_until(lambda: self._has_room(len(request)))
            self._waiting.append((record_id, request))
            self._waiting_bytes += len(request)
            self._changed.notify_all()

    def flush(self) -> None:
        """Return when all is acknowledged; raises as :meth:`put`."""
        with self._changed:
            self._is_flushing = True
            self._changed.notify_all()
            try:
                self._wait_until(lambda: not self._waiting)
            finally:
                self._is_flushing = False

    def close(self) -> None:
        """Send nothing more."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def _wait_until(self, condition: Callable[[], bool]) -> None:
        self._changed.wait_for(lambda: self._failure is not None or self._is_closed or condition())
        if self._failure is not None:
            raise self._failure
        if self._is_closed:
            raise BusUnavailableError("nothing more is sent")

    def _has_room(self, size_bytes: int) -> bool:
        if self._is_disk_full:
            return False
        is_small = len(self._waiting) < MAX_WAITING and self._waiting_bytes + size_bytes <= MAX_WAITING_BYTES
        return is_small or not self._waiting

    def _is_enough(self) -> bool:
        is_much = len(self._waiting) >= MAX_WAITING // 2 or self._waiting_bytes >= MAX_WAITING_BYTES // 2
        return is_much or self._is_flushing or self._is_closed

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._is_closed)
                self._changed.wait_for(self._is_enough, _GATHER_S)
                if self._is_closed:
                    return
                batch = list(self._waiting)  # they wait until they are acknowledged
            try:
                outcomes = self._ledger.append_all_encoded([request for _, request in batch], what=batch[0][0])
            except Exception as error:  # whatever it is, whoever puts more must not wait for ever
                with self._changed:
                    self._failure = error
                    self._changed.notify_all()
                return
            with self._changed:
                self._settle(batch, outcomes)
                is_disk_full = self._is_disk_full
                self._changed.notify_all()
                if self._failure is not None:
                    return
                if is_disk_full:
                    self._changed.wait_for(lambda: self._is_closed, _RETRY_S)

    def _settle(self, batch: Sequence[tuple[str, Payload]], outcomes: Sequence[AppendResult | VggtMotionError]) -> None:
        kept: list[tuple[str, Payload]] = []
        for entry, outcome in zip(batch, outcomes, strict=True):
            self._waiting.popleft()
            if isinstance(outcome, DiskFullError):
                if not kept:
                    self._on_disk_full(outcome)
                kept.append(entry)
            elif isinstance(outcome, VggtMotionError):
                self._failure = self._failure or outcome
            else:
                self._waiting_bytes -= len(entry[1])
        self._waiting.extendleft(reversed(kept))
        self._is_disk_full = bool(kept)
