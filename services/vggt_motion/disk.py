"""What a full disk says, how much is left of it, and files that wait for space."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

NO_SPACE: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Numbers of the errors by which a file system says that it is full."""


def free_space(folder: Path) -> int:
    """Bytes that an ordinary process may still write to the file system of ``folder``.

    Raises:
        OSError: as ``os.statvfs``.
    """
    stat = os.statvfs(folder)
    return stat.f_bavail * stat.f_frsize


def sync_folder(folder: Path) -> None:
    """Force the entries of a folder to the disk.

    Raises:
        OSError: as ``os.fsync``.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class PatientFile(io.FileIO):
    """A file, written from its beginning, whose ``write`` waits for space on a full disk.

    What was written of a call before there was no more space stays: the rest goes behind it, and nothing is torn.
    """

    def __init__(self, path: Path, wait_for_space: Callable[[OSError], bool]) -> None:
        """Create or empty the file.

        Args:
            path: the file.
            wait_for_space: waits a while; False: give up, then ``write`` raises the error.

        Raises:
            OSError: as ``open``.
        """
        super().__init__(path, "wb")
        self._wait_for_space = wait_for_space

    def write(self, data: Any) -> int:
        """As that of any raw file: returns how many bytes were written, which may be fewer than asked for."""
        while True:
            try:
                return super().write(data)
            except OSError as error:
                if error.errno not in NO_SPACE or not self._wait_for_space(error):
                    raise
