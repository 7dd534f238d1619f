"""Files that are written and read past the kernel's page cache (open(2), ``O_DIRECT``).

What is megabytes long and read again soon, if at all, by whoever has it in memory anyway, only displaces other files
there; and where memory is given to a virtual machine as it is touched, a page of the cache costs more than the disk:
measured, 5 MB written and forced to the disk took 13 ms by way of the cache, 11 of them processor time, and 3.1 ms and
0.5 ms past it. Where a file system does not offer it, the same calls go by way of the cache.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Final

BLOCK_BYTES: Final = 4096
"""Places, lengths and memory are multiples of this: the logical blocks of disks have 512 or 4096 bytes."""

_O_DIRECT: Final = getattr(os, "O_DIRECT", 0)  # macOS has none
_MAX_KEPT_BYTES = 8 * 2**20
_MAX_KEPT = 2


def aligned_up(byte_count: int) -> int:
    """The first multiple of :data:`BLOCK_BYTES` from this on."""
    return -(-byte_count // BLOCK_BYTES) * BLOCK_BYTES


def open_direct(path: Path, flags: int, mode: int = 0o644) -> int:
    """Open a file past the cache if its file system offers that; returns the descriptor.

    Raises:
        OSError: as ``os.open``.
    """
    try:
        return os.open(path, flags | os.O_CLOEXEC | _O_DIRECT, mode)
    except OSError as error:
        if error.errno != errno.EINVAL or not _O_DIRECT:
            raise
    return os.open(path, flags | os.O_CLOEXEC, mode)


def write_blocks(descriptor: int, blocks: memoryview, offset_bytes: int) -> None:
    """Write whole blocks from memory of :func:`block_memory` at a multiple of a block; not durable yet.

    Raises:
        OSError: as ``os.pwrite``.
    """
    while blocks:
        try:
            written = os.pwrite(descriptor, blocks, offset_bytes)
        except OSError as error:
            if error.errno != errno.EINVAL or not _leave_to_the_cache(descriptor):
                raise
            continue
        blocks = blocks[written:]
        offset_bytes += written


def read_direct(descriptor: int, offset_bytes: int, size_bytes: int) -> bytes:
    """So many bytes from a place, or fewer where the file ends; as ``os.pread``.

    Raises:
        OSError: as ``os.pread``.
    """
    begin = offset_bytes // BLOCK_BYTES * BLOCK_BYTES
    skipped = offset_bytes - begin
    with block_memory(skipped + size_bytes) as memory:
        filled = 0
        while filled < skipped + size_bytes:
            try:
                count = os.preadv(descriptor, [memory[filled:]], begin + filled)
            except OSError as error:
                if error.errno != errno.EINVAL or not _leave_to_the_cache(descriptor):
                    raise
                continue
            filled += count
            if count == 0 or filled % BLOCK_BYTES:  # the end of the file
                break
        return bytes(memory[skipped : min(filled, skipped + size_bytes)])


@contextlib.contextmanager
def block_memory(byte_count: int) -> Iterator[memoryview]:
    """Memory of whole blocks, at least so long, that begins at a block; what it holds is of no meaning."""
    memory = _kept.take(byte_count)
    try:
        yield memoryview(memory)[: aligned_up(byte_count)]
    finally:
        _kept.give_back(memory)


class _KeptMemory:
    """A few pieces of memory that are used again: touching new ones costs more than filling them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._free: list[mmap.mmap] = []

    def take(self, byte_count: int) -> mmap.mmap:
        with self._lock:
            if self._free and len(self._free[-1]) >= byte_count:
                return self._free.pop()
        # Whole mebibytes, so that the next one that is somewhat longer fits as well.
        return mmap.mmap(-1, max(1, -(-byte_count // 2**20)) * 2**20)

    def give_back(self, memory: mmap.mmap) -> None:
        with self._lock:
            if len(memory) <= _MAX_KEPT_BYTES:
                self._free.append(memory)
                self._free.sort(key=len)
                del self._free[:-_MAX_KEPT]


_kept = _KeptMemory()


def _leave_to_the_cache(descriptor: int) -> bool:
    """Use the cache from now on, for a file system that opens files past it but does not write them; False: it does."""
    flags = fcntl.fcntl(descriptor, fcntl.F_GETFL)
    if not flags & _O_DIRECT:
        return False
    fcntl.fcntl(descriptor, fcntl.F_SETFL, flags & ~_O_DIRECT)
    return True
