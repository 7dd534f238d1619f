"""Answering requests: queries are taken in at once and handled in threads of ours, never in Zenoh's."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import zenoh
from zenoh import handlers

from vggt_motion.bus import calls, codec
from vggt_motion.errors import (
    BusUnavailableError,
    CodecError,
    DiskFullError,
    InputError,
    RefusalCode,
    RequestRefusedError,
    VggtMotionError,
)

_log = logging.getLogger(__name__)
Handler = Callable[[str, bytes], bytes]
BatchHandler = Callable[[Sequence[bytes]], Sequence[bytes | Exception]]
REFUSAL_ENCODING = codec.encoding_of(calls.Refusal)
_FIFO_CAPACITY = 8
_MAX_PENDING = 1024
_MAX_PENDING_BYTES = 512 * 2**20
_MAX_BATCH_BYTES = 8 * 2**20
_MAX_MESSAGE_CHARS = 1000
_CLOSE_S = 1.0


@dataclass(frozen=True)
class _Request:
    """A query that was taken in."""

    query: zenoh.Query
    size_bytes: int


class Server:
    """One queryable with its threads; they are started as they are needed, up to one more than may answer at a time.

    Every thread receives and answers, so that a query costs no change of thread. One that comes while enough others
    answer lets its query wait, or refuses it when there are too many, and receives on: somebody always does, for a
    channel that fills holds up everything on its link.
    """

    def __init__(
        self, session: zenoh.Session, key: str, handler: Handler | BatchHandler, *, threads: int, at_a_time: int | None
    ) -> None:
        """Declare the queryable.

        Args:
            session: where it is declared.
            key: may hold wildcards, if not ``at_a_time``.
            handler: of one request, or of a batch.
            threads: so many may answer at the same time.
            at_a_time: how many requests a batch may hold; None: ``handler`` takes one.
        """
        self._handler: Any = handler
        self._key = key
        self._max_answering = threads
        self._at_a_time = at_a_time
        self._lock = threading.Lock()
        self._waiting: deque[_Request] = deque()
        self._held_bytes = 0  # of requests that are not answered yet
        self._answering = 0
        self._receiving = 0
        self.is_closed = False
        channel: Any = handlers.FifoChannel(_FIFO_CAPACITY)
        self._queryable: Any = session.declare_queryable(key, channel, complete=True)
        self._channel = self._queryable.handler
        self._threads: list[threading.Thread] = []
        with self._lock:
            self._start()

    def begin_close(self) -> None:
        """Take no more queries and refuse those that wait."""
        if self.is_closed:
            return
        self.is_closed = True
        try:
            self._queryable.undeclare()
        except (zenoh.ZError, RuntimeError):
            _log.debug("already undeclared", extra={"key": self._key})

    def close(self, wait_s: float = _CLOSE_S) -> None:
        """End, and give the handlers that are under way a moment to answer."""
        self.begin_close()
        deadline = time.monotonic() + wait_s
        with self._lock:
            threads = list(self._threads)
        for thread in threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))

    def _start(self) -> None:
        """One thread more; with the lock."""
        self._receiving += 1
        thread = threading.Thread(target=self._work, name=f"serve {self._key}", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _work(self) -> None:
        while True:
            try:
                query = self._channel.recv()
            except zenoh.ZError:
                return
            batch = self._take(query)
            del query
            while batch:
                try:
                    self._answer(batch)
                finally:
                    with self._lock:
                        self._held_bytes -= sum(request.size_bytes for request in batch)
                        batch = self._next_batch()

    def _take(self, query: zenoh.Query) -> list[_Request]:
        """Take a query in; returns what this thread is to answer now."""
        size_bytes = len(query.payload) if query.payload is not None else 0
        with self._lock:
            is_full = len(self._waiting) >= _MAX_PENDING or self._held_bytes + size_bytes > _MAX_PENDING_BYTES
            if not (is_full or self.is_closed):
                self._held_bytes += size_bytes
                self._waiting.append(_Request(query, size_bytes))
                if self._answering >= self._max_answering:
                    return []
                self._answering += 1
                self._receiving -= 1
                if self._receiving == 0 and len(self._threads) <= self._max_answering:
                    self._start()
                return self._next_batch()
        _refuse(query, RefusalCode.UNAVAILABLE, "stopping" if self.is_closed else "overloaded, try again later")
        return []

    def _next_batch(self) -> list[_Request]:
        """What waits, as much as fits into a batch; nothing: this thread is to receive again. With the lock."""
        batch: list[_Request] = []
        size_bytes = 0
        while self._waiting and len(batch) < (self._at_a_time or 1):
            size_bytes += self._waiting[0].size_bytes
            if batch and size_bytes > _MAX_BATCH_BYTES:
                break
            batch.append(self._waiting.popleft())
        if not batch:
            self._answering -= 1
            self._receiving += 1
        return batch

    def _answer(self, batch: Sequence[_Request]) -> None:
        requests: list[tuple[zenoh.Query, str, bytes]] = []
        for request in batch:
            query = request.query
            key = str(query.key_expr)
            if self.is_closed:
                _refuse(query, RefusalCode.UNAVAILABLE, "stopping")
            elif "*" in key:
                _refuse(query, RefusalCode.INVALID, "a request names one key, without wildcards")
            else:
                requests.append((query, key, query.payload.to_bytes() if query.payload is not None else b""))
        outcomes: Sequence[bytes | Exception]
        try:
            if self._at_a_time is None:
                outcomes = [self._handler(key, payload) for _, key, payload in requests]
            else:
                outcomes = self._handler([payload for _, _, payload in requests])
        except Exception as error:
            outcomes = [error] * len(requests)
        for (query, key, payload), outcome in zip(requests, outcomes, strict=True):
            _reply(query, key, outcome, len(payload))


def refusal_code(error: VggtMotionError) -> RefusalCode:
    """The code under which an error of a handler travels."""
    if isinstance(error, RequestRefusedError):
        return error.code
    if isinstance(error, DiskFullError):
        return RefusalCode.DISK_FULL
    if isinstance(error, BusUnavailableError):
        return RefusalCode.UNAVAILABLE
    if isinstance(error, (CodecError, InputError)):
        return RefusalCode.INVALID
    return RefusalCode.INTERNAL


def error_of(refusal: calls.Refusal) -> VggtMotionError:
    """The exception that a refusal stands for; the inverse of :func:`refusal_code`."""
    if refusal.code is RefusalCode.DISK_FULL:
        return DiskFullError(refusal.message)
    if refusal.code is RefusalCode.UNAVAILABLE:
        return BusUnavailableError(refusal.message)
    return RequestRefusedError(refusal.message, refusal.code)


def _reply(query: zenoh.Query, key: str, outcome: bytes | Exception, request_bytes: int) -> None:
    if isinstance(outcome, VggtMotionError):
        _refuse(query, refusal_code(outcome), str(outcome))
    elif isinstance(outcome, Exception):
        extra = {"key": key, "bytes": request_bytes}
        _log.error("a request ended in a defect of ours", extra=extra, exc_info=outcome)
        _refuse(query, RefusalCode.INTERNAL, f"internal error: {type(outcome).__name__}")
    else:
        _send(query, lambda: query.reply(key, outcome))


def _refuse(query: zenoh.Query, code: RefusalCode, message: str) -> None:
    line = "".join(character if character.isprintable() else " " for character in " ".join(message.split()))
    payload = codec.encode(calls.Refusal(code, line[:_MAX_MESSAGE_CHARS]))
    _send(query, lambda: query.reply_err(payload, encoding=REFUSAL_ENCODING))


def _send(query: zenoh.Query, send: Callable[[], None]) -> None:
    try:
        send()
    except zenoh.ZError as error:
        _log.warning("a reply could not be sent", extra={"reason": " ".join(str(error).split())})
    finally:
        # The asker waits until the query is dropped, and Python's finalizers are not prompt.
        query.drop()  # type: ignore[no-untyped-call]
