"""Requests on their way to the ledger, kept on disk until they are acknowledged: a live camera does not wait.

One file a request, named by its number, in the order in which they came. A process that is killed leaves its files; the
next one sends them first.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from pathlib import Path

from vggt_motion.disk import NO_SPACE, free_space, sync_folder
from vggt_motion.errors import InputError

_SUFFIX = ".request"


class Spool:
    """A first-in, first-out queue of bytes in a folder, bounded in bytes. Thread-safe; one process at a time."""

    def __init__(self, folder: Path, max_bytes: int, reserve_bytes: int = 0) -> None:
        """Take up what an earlier process left.

        Args:
            folder: created if it is not there.
            max_bytes: of all files together; a single longer request is taken when nothing else waits.
            reserve_bytes: so much of the disk is left free, for the ledger may be on the same one; when nothing else
                waits, a single request is taken all the same.

        Raises:
            InputError: the folder cannot be used.
        """
        self._folder = folder
        self._max_bytes = max_bytes
        self._reserve_bytes = reserve_bytes
        self._changed = threading.Condition()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for leftover in folder.glob("*.part"):
                leftover.unlink()
            found = sorted(folder.glob(f"*{_SUFFIX}"))
            self._sizes = {int(path.name.removesuffix(_SUFFIX)): path.stat().st_size for path in found}
        except (OSError, ValueError) as error:
            raise InputError(f"cannot use {folder} as spool: {error}") from error
        self._next = max(self._sizes, default=-1) + 1

    @property
    def count(self) -> int:
        """Requests that wait."""
        with self._changed:
            return len(self._sizes)

    @property
    def size_bytes(self) -> int:
        """Bytes of all requests that wait."""
        with self._changed:
            return sum(self._sizes.values())

    def put(self, request: bytes, timeout_s: float) -> bool:
        """Add a request; False if there was no room in time, in the spool or on its disk.

        Raises:
            InputError: the folder cannot be written.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._has_room(len(request)), timeout_s):
                return False
            number = self._next
            # While the ledger answers, the page cache is enough against a kill; a backlog is kept through a power loss.
            if not self._write(number, request, is_forced=bool(self._sizes)):
                self._changed.wait(timeout_s)
                return False
            self._next = number + 1
            self._sizes[number] = len(request)
            self._changed.notify_all()
            return True

    def first(self, timeout_s: float) -> bytes | None:
        """The oldest request, which stays until :meth:`drop_first`; None if there is none in time."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._sizes, timeout_s):
                return None
            return self._path(min(self._sizes)).read_bytes()

    def drop_first(self) -> None:
        """The oldest request is acknowledged."""
        with self._changed:
            number = min(self._sizes)
            self._path(number).unlink(missing_ok=True)
            del self._sizes[number]
            self._changed.notify_all()

    def set_first_aside(self) -> Path:
        """The oldest request can never be acknowledged: keep it in ``refused/``, where a person can look at it."""
        with self._changed:
            number = min(self._sizes)
            folder = self._folder / "refused"
            target = folder / f"{time.time_ns()}{_SUFFIX}"
            try:
                folder.mkdir(exist_ok=True)
                self._path(number).replace(target)
            except OSError as error:
                raise InputError(f"cannot write to the spool {folder}: {error.strerror or error}") from error
            del self._sizes[number]
            self._changed.notify_all()
            return target

    def wait_until_empty(self, timeout_s: float) -> bool:
        """Whether nothing waits any more."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._sizes, timeout_s)

    def _has_room(self, size_bytes: int) -> bool:
        if not self._sizes:
            return True
        if sum(self._sizes.values()) + size_bytes > self._max_bytes:
            return False
        with contextlib.suppress(OSError):  # then writing fails as well, and says why
            return free_space(self._folder) - size_bytes >= self._reserve_bytes
        return True

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:012d}{_SUFFIX}"

    def _write(self, number: int, request: bytes, *, is_forced: bool) -> bool:
        """Whether there was space."""
        path = self._path(number)
        partial = path.with_suffix(".part")
        try:
            with partial.open("wb") as file:
                file.write(request)
                if is_forced:
                    file.flush()
                    os.fsync(file.fileno())
            partial.replace(path)
            if is_forced:
                sync_folder(self._folder)
            return True
        except OSError as error:
            partial.unlink(missing_ok=True)
            if error.errno in NO_SPACE:
                return False
            raise InputError(f"cannot write to the spool {self._folder}: {error.strerror or error}") from error
