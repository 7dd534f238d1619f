"""Starts the local processes of a run and keeps them alive: restart with back-off, give up on a crash loop.

Every process writes its log to a file of its own. A child watches its parent (``watch_parent``), so that it ends even
when the parent is killed.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vggt_motion.errors import InputError, SourceTruncatedError, VggtMotionError

_log = logging.getLogger(__name__)
_FIRST_BACKOFF_S = 0.25
_MAX_BACKOFF_S = 5.0
_CRASH_LOOP_COUNT = 5  # so many unexpected ends ...
_CRASH_LOOP_S = 60.0  # ... within this time: starting it again will not help
_STOP_S = 5.0
_PARENT_POLL_S = 0.5
_SINGLE_THREADED = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


class CrashLoopError(VggtMotionError):
    """A service ended again and again; the message carries its last words."""


@dataclass(frozen=True)
class ServiceCommand:
    """One process to run: ``vggt-motion serve`` with these arguments."""

    name: str  # of the service; two workers of one service have the same name
    label: str  # unique, names the log file
    arguments: tuple[str, ...]
    tier: int = 0  # higher tiers need lower ones: they are stopped first
    ends_by_itself: bool = False  # ending with 0 or 3 is what it should do (the frontend)


@dataclass
class _Child:
    command: ServiceCommand
    process: subprocess.Popen[bytes] | None = None
    exit_code: int | None = None  # of a process that ended by itself, as it should
    restart_at: float = 0.0
    crashes: list[float] = field(default_factory=list)


class Supervisor:
    """Owns the processes of one run. Use as a context manager: leaving it ends them all."""

    def __init__(self, commands: Sequence[ServiceCommand], log_directory: Path, environment: dict[str, str]) -> None:
        """Remember what to run; nothing is started yet.

        Args:
            commands: in the order in which to start them.
            log_directory: gets one ``<label>.log`` for each; must exist.
            environment: added to ours, for secrets that must not stand on a command line.
        """
        self._children = {command.label: _Child(command) for command in commands}
        self._log_directory = log_directory
        self._environment = {**os.environ, **_SINGLE_THREADED, **environment}
        self.restart_count = 0

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self, labels: Sequence[str] | None = None) -> None:
        """Start the named processes, or all that do not run at present; also what ended by itself."""
        for label, child in self._children.items():
            if child.process is None and (labels is None or label in labels):
                self._start(child)

    def log_file(self, label: str) -> Path:
        """Where a process writes."""
        return self._log_directory / f"{label}.log"

    def exit_code(self, label: str) -> int | None:
        """Exit code of a process that ended by itself, else None."""
        return self._children[label].exit_code

    def pids(self) -> dict[str, int]:
        """Process ids of what runs now."""
        return {label: child.process.pid for label, child in self._children.items() if child.process is not None}

    def poll(self) -> None:
        """Notice what ended, and start again what should not have.

        Raises:
            InputError: a service refuses its configuration or input; the message is its own.
            CrashLoopError: a service keeps ending.
        """
        now = time.monotonic()
        for child in self._children.values():
            if child.process is not None and (exit_code := child.process.poll()) is not None:
                child.process = None
                self._ended(child, exit_code, now)
            elif child.process is None and child.crashes and child.exit_code is None and now >= child.restart_at:
                self.restart_count += 1
                self._start(child)

    def _ended(self, child: _Child, exit_code: int, now: float) -> None:
        command = child.command
        if command.ends_by_itself and exit_code in (0, SourceTruncatedError.exit_code):
            child.exit_code = exit_code
            return
        words = self.last_words(command.label)
        if exit_code == InputError.exit_code:
            raise InputError(words or f"{command.label} refused its input or configuration")
        child.crashes = [moment for moment in child.crashes if now - moment < _CRASH_LOOP_S] + [now]
        if len(child.crashes) >= _CRASH_LOOP_COUNT:
            raise CrashLoopError(
                f"{command.label} ended {len(child.crashes)} times within {_CRASH_LOOP_S:.0f} s; "
                f"its last words: {words or 'none'} (log: {self.log_file(command.label)})"
            )
        backoff = min(_FIRST_BACKOFF_S * 2 ** (len(child.crashes) - 1), _MAX_BACKOFF_S)
        child.restart_at = now + backoff
        _log.warning(
            "%s ended (%s), starting it again",
            command.label,
            f"exit code {exit_code}" if exit_code >= 0 else f"signal {-exit_code}, {signal.strsignal(-exit_code)}",
            extra={"service": command.label, "exit_code": exit_code, "backoff_s": backoff, "last_words": words},
        )

    def last_words(self, label: str) -> str:
        """Last line of a process's log, without the prefix of an error message."""
        try:
            with self.log_file(label).open("rb") as file:
                file.seek(0, os.SEEK_END)
                file.seek(max(0, file.tell() - 4096))
                lines = file.read().decode("utf-8", "replace").strip().splitlines()
        except OSError:
            return ""
        return lines[-1].removeprefix("vggt-motion: ").strip() if lines else ""

    def _start(self, child: _Child) -> None:
        command = child.command
        child.exit_code = None
        arguments = [sys.executable, "-m", "vggt_motion", "serve", *command.arguments, "--parent-pid", str(os.getpid())]
        with self.log_file(command.label).open("ab") as log:
            # A group of its own: Ctrl-C on the terminal reaches only us, and we decide who ends when.
            child.process = subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=self._environment,
                start_new_session=True,
            )

    def stop(self, labels: Sequence[str] | None = None) -> None:
        """End the named processes, or all: ask, wait, then kill; the highest tier first. None is started again."""
        chosen = [child for label, child in self._children.items() if labels is None or label in labels]
        for tier in sorted({child.command.tier for child in chosen}, reverse=True):
            _end([child for child in chosen if child.command.tier == tier])


def _end(children: Sequence[_Child]) -> None:
    running = []
    for child in children:
        child.crashes = []
        if child.process is not None:
            running.append((child.command.label, child.process))
            child.process = None
    for _, process in running:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
    deadline = time.monotonic() + _STOP_S
    for label, process in running:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            _log.warning("service did not end when asked and was killed", extra={"service": label})
            process.kill()
            process.wait()


def watch_parent(parent_pid: int) -> None:
    """Make this process end when its parent has: politely first, then at once."""

    def watch() -> None:
        with contextlib.suppress(AttributeError, OSError):  # not on this system, or the parent has ended already
            parent = os.pidfd_open(parent_pid)
            if os.getppid() == parent_pid:
                select.select([parent], [], [])  # readable once it has ended
        while os.getppid() == parent_pid:
            time.sleep(_PARENT_POLL_S)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_STOP_S)
        os._exit(1)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()
