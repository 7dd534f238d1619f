"""Small blobs one behind the other in files of their own: ``blobs/packs/00000001.pack``.

A file for each would cost two syncs and a name; among the rows each is written twice, to the write-ahead log and to the
database. Here many share one sync. A pack holds contents and nothing else, each batch from the beginning of a block:
which blob lies where stands in the rows, and they refer to a place only after what lies there has been forced to the
disk. So nobody refers to what was torn; the next writer goes on behind it, and a check cuts it off where it is the end.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import logging
import os
import re
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from vggt_motion.direct import aligned_up, block_memory, open_direct, read_direct
from vggt_motion.disk import NO_SPACE
from vggt_motion.errors import DiskFullError, LedgerError
from vggt_motion.ledger.files import FileOperations, SharedSync, make_folder
from vggt_motion.ledger.store import Content, Place, Writing

_LOGGER = logging.getLogger(__name__)
_NAME = re.compile(r"(\d{8})\.pack")
MAX_PACK_BYTES: Final = 2**30
_STAGE_BYTES = 8 * 2**20
_BACKGROUND_BYTES = 2**19  # less is on the disk before another thread would have begun


class PackFiles:
    """Packs in a folder; safe for use from many threads. One process at a time writes (the lock of the session)."""

    def __init__(
        self,
        folder: Path,
        *,
        max_pack_bytes: int = MAX_PACK_BYTES,
        files: FileOperations | None = None,
        is_read_only: bool = False,
    ) -> None:
        """Open or create the folder.

        Args:
            folder: where the packs are.
            max_pack_bytes: a pack that has grown so long is followed by a new one.
            files: the file operations; defaults to the real ones.
            is_read_only: True to create nothing.

        Raises:
            LedgerError: the folder cannot be created or read.
        """
        self._folder = folder
        self._max_pack_bytes = max_pack_bytes
        self._files = files or FileOperations()
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._writing_count = 0
        self._open: dict[int, _Pack] = {}
        self._background = ThreadPoolExecutor(1, thread_name_prefix="packs")
        self._is_closed = False
        try:
            if not is_read_only:
                make_folder(folder, self._files)
                self._files.sync_folder(folder.parent)  # a process that was killed may have made the folder only
            self._number = max(self.numbers(), default=1)
        except OSError as error:
            raise LedgerError(f"cannot use {folder} for packs: {error.strerror or error}") from error

    def append(self, contents: Sequence[Content]) -> list[Place]:
        """Make contents durable, in order, under one sync; other callers at the same time share it.

        Raises:
            DiskFullError: there is no space; nothing was kept.
            LedgerError: the disk failed.
        """
        writing = self.begin(contents, in_background=False)
        writing.wait()
        return list(writing.places)

    def begin(self, contents: Sequence[Content], *, in_background: bool = True) -> Writing:
        """As :meth:`append`, to be waited for: until then long contents are on their way to the disk.

        Raises:
            LedgerError: see there.
        """
        if not contents:
            return Writing((), lambda: None)
        size_bytes = sum(map(len, contents))
        with self._translated(size_bytes), self._lock:
            pack = self._writable()
            begin = offset = pack.reserve(size_bytes)
            make_durable = functools.partial(self._make_durable, pack, begin, contents)
            wait: Callable[[], None]
            if in_background and size_bytes >= _BACKGROUND_BYTES:
                wait = self._background.submit(make_durable).result
            else:
                wait = _Once(make_durable)
        places = []
        for content in contents:
            places.append(Place(pack.number, offset, len(content)))
            offset += len(content)
        return Writing(tuple(places), wait)

    def _make_durable(self, pack: _Pack, begin: int, contents: Sequence[Content]) -> None:
        with self._translated(sum(map(len, contents))), self._writing():
            try:
                pack.write(begin, contents)
            except OSError:
                with self._lock:
                    pack.give_back(begin, contents)
                raise
            try:
                pack.sync()
            except OSError:
                with self._lock:
                    self._number = max(self._number, pack.number + 1)
                raise

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """While something is written the files stay open: a closed descriptor may be another file's at once."""
        with self._lock:
            self._refuse_if_closed()
            self._writing_count += 1
        try:
            yield
        finally:
            with self._lock:
                self._writing_count -= 1
                self._changed.notify_all()

    @contextlib.contextmanager
    def _translated(self, size_bytes: int) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if error.errno in NO_SPACE:
                raise DiskFullError(f"no space for {size_bytes} bytes in {self._folder}") from error
            raise LedgerError(f"cannot write to {self._folder}: {error.strerror or error}") from error

    def read(self, place: Place) -> bytes:
        """What lies at a place; shorter or empty where the pack is not what it was. Not verified."""
        try:
            with self._lock:
                pack = self._pack(place.pack, is_new=False)
            return pack.read(place)
        except FileNotFoundError:
            return b""
        except OSError as error:
            if error.errno != errno.EIO:
                raise LedgerError(f"cannot read {self._path(place.pack)}: {error.strerror or error}") from error
            # As damaged as any: it can come back, and the others can still be read.
            _LOGGER.error("cannot read %s at %d: %s", self._path(place.pack), place.offset_bytes, error.strerror)
            return b""

    def has(self, place: Place) -> bool:
        """Whether the pack is as long as the place asks for."""
        try:
            return self._path(place.pack).stat().st_size >= place.offset_bytes + place.size_bytes
        except OSError:
            return False

    def numbers(self) -> list[int]:
        """The numbers of all packs, in order."""
        paths = self._folder.iterdir() if self._folder.exists() else ()
        return sorted(int(match[1]) for path in paths if (match := _NAME.fullmatch(path.name)))

    def unused_bytes(self, used: Iterable[Place]) -> dict[int, int]:
        """Per pack, how many bytes lie behind the block in which the last place that is used ends."""
        ends = dict.fromkeys(self.numbers(), 0)
        for place in used:
            ends[place.pack] = max(ends.get(place.pack, 0), place.offset_bytes + place.size_bytes)
        rests = {
            number: self._path(number).stat().st_size - aligned_up(end)
            for number, end in ends.items()
            if self._has(number)
        }
        return {number: rest for number, rest in rests.items() if rest > 0}

    def cut_off(self, number: int, byte_count: int) -> None:
        """Remove the last bytes of a pack, to which no row refers."""
        path = self._path(number)
        os.truncate(path, path.stat().st_size - byte_count)

    def last_bytes(self, number: int, byte_count: int) -> bytes:
        """The last bytes of a pack."""
        return self.read(Place(number, self._path(number).stat().st_size - byte_count, byte_count))

    def close(self) -> None:
        """Close the files for good: the session may be somebody else's from now on."""
        with self._lock:
            self._is_closed = True
            self._changed.wait_for(lambda: self._writing_count == 0)
        self._background.shutdown()
        with self._lock:
            for pack in self._open.values():
                pack.close()
            self._open.clear()

    def _writable(self) -> _Pack:
        pack = self._pack(self._number, is_new=True)
        if pack.end >= self._max_pack_bytes:
            self._number += 1
            pack = self._pack(self._number, is_new=True)
        return pack

    def _pack(self, number: int, *, is_new: bool) -> _Pack:
        self._refuse_if_closed()
        if number not in self._open:
            self._open[number] = _Pack(self._path(number), number, self._files, may_create=is_new)
        return self._open[number]

    def _refuse_if_closed(self) -> None:
        if self._is_closed:
            raise OSError(errno.EBADF, "the session is closed")

    def _has(self, number: int) -> bool:
        return self._path(number).is_file()

    def _path(self, number: int) -> Path:
        return _path(self._folder, number)


def read_place(folder: Path, place: Place) -> bytes:
    """What lies at a place of a folder of packs that another process may be writing; not verified.

    Raises:
        OSError: it cannot be read.
    """
    descriptor = open_direct(_path(folder, place.pack), os.O_RDONLY)
    try:
        return _read(descriptor, place)
    finally:
        os.close(descriptor)


def _read(descriptor: int, place: Place) -> bytes:
    # A row that is damaged may ask for anything.
    size_bytes = min(place.size_bytes, os.fstat(descriptor).st_size - place.offset_bytes)
    if place.offset_bytes < 0 or size_bytes <= 0:
        return b""
    return read_direct(descriptor, place.offset_bytes, size_bytes)


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number:08d}.pack"


class _Once:
    """Work that is carried out by the first who waits for it; everybody gets what came of it. Thread-safe."""

    def __init__(self, work: Callable[[], None]) -> None:
        self._work = work
        self._lock = threading.Lock()
        self._is_done = False
        self._error: Exception | None = None

    def __call__(self) -> None:
        with self._lock:
            if not self._is_done:
                self._is_done = True
                try:
                    self._work()
                except Exception as error:
                    self._error = error
        if self._error is not None:
            raise self._error


class _Pack:
    """One open file."""

    def __init__(self, path: Path, number: int, files: FileOperations, *, may_create: bool) -> None:
        self.number = number
        self._path = path
        self._files = files
        self._descriptor = open_direct(path, os.O_RDWR | (os.O_CREAT if may_create else 0))
        self.end = aligned_up(os.fstat(self._descriptor).st_size)
        self._given_back: dict[int, int] = {}  # rooms, by their ends: where they begin
        self._is_named = False  # also if it is there: a process that was killed may not have come to its name
        self._failure: OSError | None = None
        self._shared_sync = SharedSync(self._force)

    def reserve(self, size_bytes: int) -> int:
        """Room for contents behind all others; returns where it begins. One caller at a time, as :meth:`give_back`.

        Raises:
            OSError: nothing may be written any more.
        """
        self._refuse_after_failure()
        begin = self.end
        self.end += aligned_up(size_bytes)
        return begin

    def give_back(self, begin: int, contents: Sequence[Content]) -> None:
        """The room will not be used; where others wrote behind it, it stays, and nobody refers to it."""
        self._given_back[begin + aligned_up(sum(map(len, contents)))] = begin
        while self.end in self._given_back:
            self.end = self._given_back.pop(self.end)
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self.end)

    def write(self, begin: int, contents: Sequence[Content]) -> None:
        """Put contents where room was reserved for them, not durable yet.

        Raises:
            OSError: the disk is full, or fails.
        """
        offset = begin
        with block_memory(min(sum(map(len, contents)), _STAGE_BYTES)) as stage:
            filled = 0
            for content in contents:
                rest = memoryview(content)
                while rest:
                    count = min(len(rest), len(stage) - filled)
                    stage[filled : filled + count] = rest[:count]
                    filled, rest = filled + count, rest[count:]
                    if filled == len(stage):
                        self._files.write_blocks(self._path, self._descriptor, offset, stage)
                        offset, filled = offset + filled, 0
            if filled:
                padded = aligned_up(filled)
                stage[filled:padded] = bytes(padded - filled)
                self._files.write_blocks(self._path, self._descriptor, offset, stage[:padded])

    def sync(self) -> None:
        """Return when all that was written before is durable."""
        self._shared_sync()

    def read(self, place: Place) -> bytes:
        return _read(self._descriptor, place)

    def close(self) -> None:
        os.close(self._descriptor)

    def _force(self) -> None:
        self._refuse_after_failure()
        try:
            self._files.sync_data(self._path, self._descriptor)
            if not self._is_named:
                self._files.sync_folder(self._path.parent)
                self._is_named = True
        except OSError as error:
            self._failure = error
            raise

    def _refuse_after_failure(self) -> None:
        """After a sync that failed the next one may succeed though what was written before both is gone (fsync(2))."""
        if self._failure is not None:
            raise OSError(self._failure.errno, f"an earlier sync failed: {self._failure.strerror}")
