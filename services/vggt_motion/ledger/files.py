"""The file operations that durability rests on, and syncs that many callers share."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

from vggt_motion import disk
from vggt_motion.direct import write_blocks


class FileOperations:
    """The file operations that durability rests on, apart so that tests can record them and let them fail."""

    def write_and_sync(self, path: Path, data: bytes | memoryview) -> None:
        """Create a file with this content and force it to the disk."""
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            view = memoryview(data)
            while view:
                view = view[os.write(descriptor, view) :]
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def write_blocks(self, path: Path, descriptor: int, offset_bytes: int, blocks: memoryview) -> None:
        """Write whole blocks into the open file ``path`` past the cache (:mod:`..direct`); not durable yet."""
        write_blocks(descriptor, blocks, offset_bytes)

    def sync_data(self, path: Path, descriptor: int) -> None:
        """Force the content and the length of the open file ``path`` to the disk."""
        getattr(os, "fdatasync", os.fsync)(descriptor)  # macOS has the second only

    def rename(self, source: Path, target: Path) -> None:
        """Move a file within the file system, atomically; replaces ``target``."""
        source.replace(target)

    def sync_folder(self, folder: Path) -> None:
        """Force the entries of a folder to the disk."""
        disk.sync_folder(folder)


def make_folder(folder: Path, files: FileOperations) -> None:
    """Create a folder with its parents, durably."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    for path in reversed(missing):
        path.mkdir(exist_ok=True)
        files.sync_folder(path.parent)


class SharedSync:
    """Forces something to the disk, once for all threads that ask while a sync is under way."""

    def __init__(self, sync: Callable[[], None]) -> None:
        """Bind what forces it to the disk."""
        self._sync = sync
        self._condition = threading.Condition()
        self._asked = 0
        self._done = 0  # all that was done before so many asked is durable
        self._is_running = False

    def __call__(self) -> None:
        """Return when all that the caller did before is durable; an error is that of the caller's own sync."""
        with self._condition:
            self._asked += 1
            ticket = self._asked
            while self._is_running and self._done < ticket:
                self._condition.wait()
            if self._done >= ticket:
                return
            self._is_running = True
            covered = self._asked
        is_synced = False
        try:
            self._sync()
            is_synced = True
        finally:
            with self._condition:
                self._is_running = False
                if is_synced:
                    self._done = max(self._done, covered)
                self._condition.notify_all()
