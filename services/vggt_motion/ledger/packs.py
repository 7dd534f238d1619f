"""Small blobs one behind the other in files of their own: ``blobs/packs/00000001.pack``.

A file for each would cost two syncs and a name; among the rows each is written twice, to the write-ahead log and to the
database. Here many share one sync. A pack holds contents and nothing else, each batch from the beginning of a block:
which blob lies where stands in the rows, and they refer to a place only after what lies there has been forced to the
disk. So nobody refers to what was torn; the next writer goes on behind it, and a check cuts it off where it is the end.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from vggt_motion.direct import aligned_up, block_memory, open_direct, read_direct
from vggt_motion.errors import DiskFullError, LedgerError
from vggt_motion.ledger.files import NO_SPACE, FileOperations, SharedSync, make_folder
from vggt_motion.ledger.store import Content, Place

_LOGGER = logging.getLogger(__name__)
_NAME = re.compile(r"(\d{8})\.pack")
MAX_PACK_BYTES: Final = 2**30
_STAGE_BYTES = 8 * 2**20


class PackFiles:
    """Packs in a folder; safe for use from many threads. One process at a time writes (the lock of the session)."""

    def __init__(
        self, folder: Path, *, max_pack_bytes: int = MAX_PACK_BYTES, files: FileOperations | None = None
    ) -> None:
        """Open or create the folder.

        Args:
            folder: where the packs are.
            max_pack_bytes: a pack that has grown so long is followed by a new one.
            files: the file operations; defaults to the real ones.

        Raises:
            LedgerError: the folder cannot be created or read.
        """
        self._folder = folder
        self._max_pack_bytes = max_pack_bytes
        self._files = files or FileOperations()
        self._lock = threading.Lock()
        self._open: dict[int, _Pack] = {}
        self._is_closed = False
        try:
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
        if not contents:
            return []
        try:
            with self._lock:
                pack = self._writable()
                offset = pack.write(contents)
            try:
                pack.sync()
            except OSError:
                with self._lock:
                    self._number = max(self._number, pack.number + 1)
                raise
        except OSError as error:
            if error.errno in NO_SPACE:
                raise DiskFullError(f"no space for {sum(map(len, contents))} bytes in {self._folder}") from error
            raise LedgerError(f"cannot write to {self._folder}: {error.strerror or error}") from error
        places = []
        for content in contents:
            places.append(Place(pack.number, offset, len(content)))
            offset += len(content)
        return places

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
        return sorted(int(match[1]) for path in self._folder.iterdir() if (match := _NAME.fullmatch(path.name)))

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

    def close(self) -> None:
        """Close the files for good: the session may be somebody else's from now on."""
        with self._lock:
            self._is_closed = True
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
        if self._is_closed:
            raise OSError(errno.EBADF, "the session is closed")
        if number not in self._open:
            self._open[number] = _Pack(self._path(number), number, self._files, may_create=is_new)
        return self._open[number]

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
        return read_direct(descriptor, place.offset_bytes, place.size_bytes)
    finally:
        os.close(descriptor)


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number:08d}.pack"


class _Pack:
    """One open file."""

    def __init__(self, path: Path, number: int, files: FileOperations, *, may_create: bool) -> None:
        self.number = number
        self._path = path
        self._files = files
        self._descriptor = open_direct(path, os.O_RDWR | (os.O_CREAT if may_create else 0))
        self.end = aligned_up(os.fstat(self._descriptor).st_size)
        self._is_named = False  # also if it is there: a process that was killed may not have come to its name
        self._failure: OSError | None = None
        self._shared_sync = SharedSync(self._force)

    def write(self, contents: Sequence[Content]) -> int:
        """Put contents behind what is there, not durable yet; returns where they begin. One caller at a time."""
        begin = self.end
        self._refuse_after_failure()
        try:
            self._write(contents)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, begin)
            self.end = begin
            raise
        return begin

    def sync(self) -> None:
        """Return when all that was written before is durable."""
        self._shared_sync()

    def read(self, place: Place) -> bytes:
        return read_direct(self._descriptor, place.offset_bytes, place.size_bytes)

    def close(self) -> None:
        os.close(self._descriptor)

    def _write(self, contents: Sequence[Content]) -> None:
        size_bytes = sum(map(len, contents))
        with block_memory(min(size_bytes, _STAGE_BYTES)) as stage:
            filled = 0
            for content in contents:
                rest = memoryview(content)
                while rest:
                    count = min(len(rest), len(stage) - filled)
                    stage[filled : filled + count] = rest[:count]
                    filled, rest = filled + count, rest[count:]
                    if filled == len(stage):
                        self._write_blocks(stage)
                        filled = 0
            if filled:
                padded = aligned_up(filled)
                stage[filled:padded] = bytes(padded - filled)
                self._write_blocks(stage[:padded])

    def _write_blocks(self, blocks: memoryview) -> None:
        self._files.write_blocks(self._path, self._descriptor, self.end, blocks)
        self.end += len(blocks)

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
