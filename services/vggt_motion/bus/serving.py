"""Answering requests: queries are taken in at once and handled in threads of ours, never in Zenoh's."""

from __future__ import annotations

import itertools
import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import zenoh
from zenoh import handlers

from vggt_motion.bus import calls, codec
from vggt_motion.bus.delivery import Calls
from vggt_motion.bus.parcels import Parcels
from vggt_motion.bus.wire import Payload, joined, parts_of
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
Handler = Callable[[str, bytes], Payload]
BatchHandler = Callable[[Sequence[bytes | memoryview]], Sequence[bytes | Exception]]
REFUSAL_ENCODING = codec.encoding_of(calls.Refusal)
BUNDLE_ENCODING = codec.encoding_of(calls.Bundle)
_FIFO_CAPACITY = 8
_MAX_PENDING = 1024
_MAX_PENDING_BYTES = 512 * 2**20
_MAX_BATCH_BYTES = 32 * 2**20
_MAX_MESSAGE_CHARS = 1000
_CLOSE_S = 1.0


class _Request(NamedTuple):
    """A query that was taken in."""

    query: zenoh.Query
    attachment: bytes | None
    size_bytes: int


class _Taken(NamedTuple):
    """A request with its payload at hand, or those of its bundle."""

    request: _Request
    key: str
    payloads: Sequence[bytes | memoryview]
    is_bundle: bool


class Server:
    """One queryable with its threads; they are started as they are needed.

    Queries are taken in at once and wait for a thread, or are refused when too many wait: a channel that fills holds
    up everything on its link. How they are taken in is a matter of the subclass.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        handler: Handler | BatchHandler,
        parcels: Parcels,
        *,
        threads: int,
        at_a_time: int | None,
        after: Callable[[], None] | None = None,
    ) -> None:
        """Declare the queryable.

        Args:
            session: where it is declared.
            key: may hold wildcards, if not ``at_a_time``.
            handler: of one request, or of a batch.
            parcels: how long payloads come and go within this machine.
            threads: so many may answer at the same time.
            at_a_time: how many messages a batch may hold; None: ``handler`` takes one request.
            after: called when a batch was answered.
        """
        self._handler: Any = handler
        self._parcels = parcels
        self._key = key
        self._max_answering = threads
        self._at_a_time = at_a_time
        self._after = after
        self._lock = threading.Lock()
        self._waiting: deque[_Request] = deque()
        self._held_bytes = 0  # of requests that are not answered yet
        self._answering = 0
        self._threads: list[threading.Thread] = []
        self.is_closed = False
        self._queryable = self._declare(session)

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

    def _declare(self, session: zenoh.Session) -> Any:
        raise NotImplementedError

    def _work(self) -> None:
        raise NotImplementedError

    def _start(self) -> None:
        """One thread more; with the lock."""
        thread = threading.Thread(target=self._work, name=f"serve {self._key}", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _admit(self, query: zenoh.Query) -> bool:
        """Let a query wait, if there is room; with the lock."""
        attachment = _attachment_of(query)
        size_bytes = len(query.payload) if query.payload is not None else 0
        size_bytes += self._parcels.size_bytes(attachment)
        # What is longer than all that may wait comes in alone: it is not to be sent again, and the handler says so.
        is_too_much = self._held_bytes > 0 and self._held_bytes + size_bytes > _MAX_PENDING_BYTES
        is_full = len(self._waiting) >= _MAX_PENDING or is_too_much
        if is_full or self.is_closed:
            return False
        self._held_bytes += size_bytes
        self._waiting.append(_Request(query, attachment, size_bytes))
        return True

    def _turn_away(self, query: zenoh.Query) -> None:
        _refuse(query, RefusalCode.UNAVAILABLE, "stopping" if self.is_closed else "overloaded, try again later")

    def _next_batch(self) -> list[_Request]:
        """What waits, as much as fits into a batch; nothing: the thread answers no more. With the lock."""
        batch: list[_Request] = []
        size_bytes = 0
        while self._waiting and len(batch) < (self._at_a_time or 1):
            size_bytes += self._waiting[0].size_bytes
            if batch and size_bytes > _MAX_BATCH_BYTES:
                break
            batch.append(self._waiting.popleft())
        self._answering -= not batch
        return batch

    def _answer_all(self, batch: list[_Request]) -> None:
        """Answer a batch, and what waits then, until nothing does."""
        while batch:
            try:
                self._answer(batch)
            finally:
                with self._lock:
                    self._held_bytes -= sum(request.size_bytes for request in batch)
                    batch = self._next_batch()

    def _answer(self, batch: Sequence[_Request]) -> None:
        taken = [one for one in map(self._taken, batch) if one is not None]
        outcomes: Sequence[Payload | Exception]
        try:
            if self._at_a_time is None:
                outcomes = [self._handler(one.key, payload) for one in taken for payload in one.payloads]
            else:
                outcomes = self._handler([payload for one in taken for payload in one.payloads])
        except Exception as error:
            outcomes = [error] * sum(len(one.payloads) for one in taken)
        rest = iter(outcomes)
        for one in taken:
            self._reply(one, list(itertools.islice(rest, len(one.payloads))))
        if self._after is not None:
            self._after()

    def _taken(self, request: _Request) -> _Taken | None:
        """The payloads of a request, with which it need not come itself; None: it was refused."""
        query = request.query
        key = str(query.key_expr)
        if self.is_closed:
            _refuse(query, RefusalCode.UNAVAILABLE, "stopping")
        elif "*" in key:
            _refuse(query, RefusalCode.INVALID, "a request names one key, without wildcards")
        else:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            try:
                payload = self._parcels.take(payload, request.attachment)
            except BusUnavailableError as error:
                _refuse(query, refusal_code(error), str(error))
                return None
            bundled = self._bundled(query, payload)
            return _Taken(request, key, bundled or (payload,), is_bundle=bundled is not None)
        return None

    def _bundled(self, query: zenoh.Query, payload: bytes) -> Sequence[bytes | memoryview] | None:
        """The requests of a bundle; None: it is a request, or nothing, and the handler shall say what is wrong."""
        if self._at_a_time is None or str(query.encoding) != BUNDLE_ENCODING:
            return None
        try:
            return [part for one in codec.decode(calls.Bundle, payload).requests for part in parts_of(one)]
        except CodecError:
            return None

    def _reply(self, taken: _Taken, outcomes: Sequence[Payload | Exception]) -> None:
        refusals = [
            self._refusal(taken.key, outcome, len(payload)) if isinstance(outcome, Exception) else None
            for outcome, payload in zip(outcomes, taken.payloads, strict=True)
        ]
        request = taken.request
        if taken.is_bundle:
            answers = tuple(
                calls.BundledAnswer(b"" if isinstance(outcome, Exception) else joined(outcome), refusal)
                for outcome, refusal in zip(outcomes, refusals, strict=True)
            )
            payload: Payload = codec.encode(calls.BundleReply(answers))
        elif refusals[0] is not None:
            _send_refusal(request.query, refusals[0])
            return
        else:
            (payload,) = outcomes  # type: ignore[assignment]
        is_near = self._parcels.is_near(request.attachment)
        parcel = self._parcels.leave_answer(payload) if is_near else None
        greeting = self._parcels.greeting if is_near else None
        attachment = greeting if parcel is None else parcel.attachment
        content = joined(payload) if parcel is None else b""
        _send(request.query, lambda: request.query.reply(taken.key, content, attachment=attachment))

    def _refusal(self, key: str, error: Exception, request_bytes: int) -> calls.Refusal:
        if isinstance(error, VggtMotionError):
            # Its traceback holds the request, and by way of who called whom itself: several times its length in memory,
            # until Python looks for cycles.
            error.__traceback__ = error.__cause__ = error.__context__ = None
            return _as_refusal(refusal_code(error), str(error))
        _log.error("a request ended in a defect of ours", extra={"key": key, "bytes": request_bytes}, exc_info=error)
        return _as_refusal(RefusalCode.INTERNAL, f"internal error: {type(error).__name__}")


class SleepingServer(Server):
    """Takes queries in with a thread of Zenoh's, which sleeps until there is one, and wakes one of ours to answer."""

    def _declare(self, session: zenoh.Session) -> Any:
        self._wake_ups: queue.SimpleQueue[bool] = queue.SimpleQueue()
        calls = Calls(self._take)
        return calls.declare(lambda handler: session.declare_queryable(self._key, handler, complete=True))

    def begin_close(self) -> None:
        """As in any server; wakes the threads, so that they end."""
        super().begin_close()
        with self._lock:
            for _ in self._threads:
                self._wake_ups.put(False)

    def _take(self, query: zenoh.Query) -> None:
        with self._lock:
            is_taken = self._admit(query)
            if is_taken and self._answering < self._max_answering:
                self._answering += 1
                self._wake_ups.put(True)
                if len(self._threads) < self._answering:
                    self._start()
        if not is_taken:
            self._turn_away(query)

    def _work(self) -> None:
        while self._wake_ups.get():
            with self._lock:
                batch = self._next_batch()
            self._answer_all(batch)


class PromptServer(Server):
    """Every thread receives and answers, so that a query costs no change of thread.

    A thread that waits in a channel of ours wakes up ten times a second, whether there is a query or not. There is one
    thread more than may answer at a time: one that receives while enough others answer lets the query wait and receives
    on.
    """

    def _declare(self, session: zenoh.Session) -> Any:
        self._receiving = 0
        channel: Any = handlers.FifoChannel(_FIFO_CAPACITY)
        queryable: Any = session.declare_queryable(self._key, channel, complete=True)
        self._channel = queryable.handler
        with self._lock:
            self._receiving += 1
            self._start()
        return queryable

    def _work(self) -> None:
        while True:
            try:
                query = self._channel.recv()
            except zenoh.ZError:
                return
            batch = self._take(query)
            del query
            if batch:
                self._answer_all(batch)
                with self._lock:
                    self._receiving += 1

    def _take(self, query: zenoh.Query) -> list[_Request]:
        """Take a query in; returns what this thread is to answer now."""
        with self._lock:
            is_taken = self._admit(query)
            if is_taken and self._answering < self._max_answering:
                self._answering += 1
                self._receiving -= 1
                if self._receiving == 0 and len(self._threads) <= self._max_answering:
                    self._receiving += 1
                    self._start()
                return self._next_batch()
        if not is_taken:
            self._turn_away(query)
        return []


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


def _attachment_of(query: zenoh.Query) -> bytes | None:
    attachment = query.attachment
    return None if attachment is None else attachment.to_bytes()


def _refuse(query: zenoh.Query, code: RefusalCode, message: str) -> None:
    _send_refusal(query, _as_refusal(code, message))


def _as_refusal(code: RefusalCode, message: str) -> calls.Refusal:
    line = "".join(character if character.isprintable() else " " for character in " ".join(message.split()))
    return calls.Refusal(code, line[:_MAX_MESSAGE_CHARS])


def _send_refusal(query: zenoh.Query, refusal: calls.Refusal) -> None:
    payload = codec.encode(refusal)
    _send(query, lambda: query.reply_err(payload, encoding=REFUSAL_ENCODING))


def _send(query: zenoh.Query, send: Callable[[], None]) -> None:
    try:
        send()
    except zenoh.ZError as error:
        _log.warning("a reply could not be sent", extra={"reason": " ".join(str(error).split())})
    finally:
        # The asker waits until the query is dropped, and Python's finalizers are not prompt.
        query.drop()  # type: ignore[no-untyped-call]
