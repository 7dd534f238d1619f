"""Numerics in a child process, so that the process loop that answers the bus is never held up (DESIGN section 4).

A GTSAM solve or a structure-from-motion run can hold the interpreter for seconds; heartbeats, health and shutdown must
not wait for it. The child is spawned (forking after Zenoh is open is unsafe), kept between calls so that imports are
paid once, and ends with its parent, however the parent ends.
"""

from __future__ import annotations

import logging
import multiprocessing
import multiprocessing.connection
import os
import select
import signal
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from vggt_motion.errors import VggtMotionError
from vggt_motion.memory import keep_freed_memory

_log = logging.getLogger(__name__)
_POLL_S = 0.2
_context = multiprocessing.get_context("spawn")
Result = TypeVar("Result")


class ComputeError(VggtMotionError):
    """The computation raised, ran out of time or died; ``traceback_text`` is the child's, where there is one."""

    def __init__(self, message: str, traceback_text: str = "") -> None:
        super().__init__(message)
        self.traceback_text = traceback_text


class ComputeCancelledError(ComputeError):
    """The caller asked to stop; the child was ended."""


class ComputeDeadlineError(ComputeError):
    """The deadline passed; the child was ended."""


class ComputeCrashedError(ComputeError):
    """The child died: killed from outside, out of memory, or a crash in compiled code."""


@dataclass(frozen=True)
class _Failure:
    message: str
    traceback_text: str


class ComputeChild:
    """One child process that runs one function at a time. Not thread-safe: one owner calls it."""

    def __init__(self, name: str) -> None:
        """Remember the name; the process is started by the first call, or by :meth:`start`."""
        self._name = name
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: Connection | None = None

    def start(self) -> Connection:
        """Start the process if it is not running, so that its imports do not delay the first call."""
        if self._process is not None and self._process.is_alive() and self._connection is not None:
            return self._connection
        self.kill()
        ours, theirs = _context.Pipe()
        process = _context.Process(target=_serve, args=(theirs,), name=f"{self._name}-compute", daemon=True)
        process.start()
        theirs.close()
        self._process, self._connection = process, ours
        return ours

    def call(
        self,
        function: Callable[..., Result],
        *args: Any,
        deadline_s: float,
        on_tick: Callable[[], bool] | None = None,
    ) -> Result:
        """Run a module-level function in the child and return its result.

        Args:
            function: importable by name; it and its arguments cross a pipe between our own two processes.
            args: positional arguments.
            deadline_s: seconds of wall clock that the call may take.
            on_tick: called about five times a second from the calling thread; returning False cancels, and so does
                an exception, which is passed on.

        Raises:
            ComputeCancelledError: ``on_tick`` returned False.
            ComputeDeadlineError: the deadline passed.
            ComputeCrashedError: the child died.
            ComputeError: the function raised; the message is that of its exception.
        """
        connection = self.start()
        end = time.monotonic() + deadline_s
        self._guarded(lambda: connection.send((function, args)))
        answer = select.poll()  # the connection's own makes a new selector each time
        answer.register(connection.fileno(), select.POLLIN)
        while not answer.poll(_POLL_S * 1000.0):
            if on_tick is not None and not self._tick(on_tick):
                self.kill()
                raise ComputeCancelledError("cancelled")
            if time.monotonic() > end:
                self.kill()
                raise ComputeDeadlineError(f"took longer than {deadline_s:g} s and was ended")
        outcome: Any = self._guarded(connection.recv)
        if isinstance(outcome, _Failure):
            raise ComputeError(outcome.message, outcome.traceback_text)
        result: Result = outcome
        return result

    def _guarded(self, step: Callable[[], Result]) -> Result:
        try:
            return step()
        except (EOFError, OSError) as error:
            exit_code = self._reap()
            raise ComputeCrashedError(f"the computing process died ({_describe(exit_code)})") from error

    def _tick(self, on_tick: Callable[[], bool]) -> bool:
        try:
            return on_tick()
        except BaseException:
            # The call is given up: its result, left in the pipe, would be taken for that of the next one.
            self.kill()
            raise

    def _reap(self) -> int | None:
        process = self._process
        if process is not None:
            process.join(timeout=2.0)
        exit_code = process.exitcode if process is not None else None
        self.kill()
        return exit_code

    def kill(self) -> None:
        """End the process at once; the next call starts a new one."""
        if self._process is not None and self._process.pid is not None:
            self._process.kill()
            self._process.join()
        if self._connection is not None:
            self._connection.close()
        self._process, self._connection = None, None


def _describe(exit_code: int | None) -> str:
    if exit_code is None:
        return "no exit code"
    if exit_code < 0:
        name = signal.Signals(-exit_code).name
        return f"signal {name}" + (", perhaps out of memory" if name == "SIGKILL" else "")
    return f"exit code {exit_code}"


def _serve(connection: Connection) -> None:
    keep_freed_memory()
    # Ctrl-C reaches the whole process group: the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    while True:
        try:
            function, args = connection.recv()
        except (EOFError, OSError):
            return
        try:
            outcome: Any = function(*args)
        except Exception as error:
            text = " ".join(str(error).split()) or type(error).__name__
            message = text if isinstance(error, VggtMotionError) else f"{type(error).__name__}: {text}"
            outcome = _Failure(message, traceback.format_exc())
        connection.send(outcome)


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)
