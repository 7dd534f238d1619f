"""A full disk for tests in one process: files may not grow beyond a length (setrlimit(2), ``RLIMIT_FSIZE``)."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager


class FullDisk:
    """Refuses to let a file grow beyond so many bytes, until there is space again."""

    def __init__(self, max_bytes: int) -> None:
        self._before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, self._before[1]))

    def has_space_again(self) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, self._before)


@contextmanager
def full_disk(max_bytes: int) -> Iterator[FullDisk]:
    disk = FullDisk(max_bytes)
    try:
        yield disk
    finally:
        disk.has_space_again()
