"""Answering requests: queries are taken in at once and handled in threads of ours, never in Zenoh's."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
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
REFUSAL_ENCODING = codec.encoding_of(calls.Refusal)
_FIFO_CAPACITY = 8
_MAX_PENDING = 1024
_MAX_PENDING_BYTES = 512 * 2**20
_MAX_MESSAGE_CHARS = 1000
_CLOSE_S = 1.0


class Server:
    """One queryable with its threads; they are started as they are needed, up to the given number."""

    def __init__(self, session: zenoh.Session, key: str, handler: Handler, *, threads: int) -> None:
        self._handler = handler
        self._key = key
        self._max_threads = threads
        self._pending: queue.SimpleQueue[zenoh.Query | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._pending_count = self._pending_bytes = self._idle = 0
        self._workers: list[threading.Thread] = []
        self.is_closed = False
        channel: Any = handlers.FifoChannel(_FIFO_CAPACITY)
        self._queryable: Any = session.declare_queryable(key, channel, complete=True)
        self._channel = self._queryable.handler
        self._thread = threading.Thread(target=self._take_in, name=f"take in {key}", daemon=True)
        self._thread.start()

    def begin_close(self) -> None:
        """Take no more queries and refuse those that wait."""
        if self.is_closed:
            return
        self.is_closed = True
        try:
            self._queryable.undeclare()
        except (zenoh.ZError, RuntimeError):
            _log.debug("already undeclared", extra={"key": self._key})
        for _ in range(len(self._workers)):
            self._pending.put(None)

    def close(self, wait_s: float = _CLOSE_S) -> None:
        """End, and give the handlers that are under way a moment to answer."""
        self.begin_close()
        deadline = time.monotonic() + wait_s
        for thread in (self._thread, *self._workers):
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))

    def _take_in(self) -> None:
        while True:
            try:
                query = self._channel.recv()
            except zenoh.ZError:
                return
            size = len(query.payload) if query.payload is not None else 0
            with self._lock:
                is_full = self._pending_count >= _MAX_PENDING or self._pending_bytes + size > _MAX_PENDING_BYTES
                if not (is_full or self.is_closed):
                    self._pending_count += 1
                    self._pending_bytes += size
            if is_full or self.is_closed:
                _refuse(query, RefusalCode.UNAVAILABLE, "stopping" if self.is_closed else "overloaded, try again later")
                continue
            self._pending.put(query)
            with self._lock:
                if self._idle < self._pending_count and len(self._workers) < self._max_threads:
                    worker = threading.Thread(target=self._work, name=f"serve {self._key}", daemon=True)
                    self._workers.append(worker)
                    worker.start()

    def _work(self) -> None:
        while True:
            with self._lock:
                self._idle += 1
            query = self._pending.get()
            with self._lock:
                self._idle -= 1
            if query is None:
                return
            size = len(query.payload) if query.payload is not None else 0
            with self._lock:
                self._pending_count -= 1
            try:
                self._answer(query)
            finally:
                with self._lock:
                    self._pending_bytes -= size

    def _answer(self, query: zenoh.Query) -> None:
        if self.is_closed:
            _refuse(query, RefusalCode.UNAVAILABLE, "stopping")
            return
        key = str(query.key_expr)
        payload = query.payload.to_bytes() if query.payload is not None else b""
        try:
            if "*" in key:
                raise RequestRefusedError("a request names one key, without wildcards")
            reply = self._handler(key, payload)
        except VggtMotionError as error:
            _refuse(query, refusal_code(error), str(error))
        except Exception as error:
            _log.exception("a request ended in a defect of ours", extra={"key": key, "bytes": len(payload)})
            _refuse(query, RefusalCode.INTERNAL, f"internal error: {type(error).__name__}")
        else:
            _send(query, lambda: query.reply(key, reply))


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
