"""Weights that stay in their checkpoint: mapped into memory, read by need, given back after use.

On a CPU a parameter whose dtype is that of the checkpoint needs no copy. A block of the network runs once in a pass, so
its pages are given back as soon as it has run: the weights then take no memory that somebody else needs. The kernel
keeps them in its page cache while there is room, where all workers of a machine share them, and from where they come
back at the speed of memory.
"""

from __future__ import annotations

import ctypes
import mmap
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from torch import Tensor, nn

from vggt_motion.inference.vggt.backbone import PatchProjection
from vggt_motion.inference.vggt.camera_head import CameraHead
from vggt_motion.inference.vggt.layers import Block

_PROCESS_MAPS = Path("/proc/self/maps")
Range = tuple[int, int]  # addresses: of the first byte, and of the byte after the last


@dataclass(frozen=True)
class FileMapping:
    """Where a file lies in this process's memory as private pages; nowhere on systems other than Linux."""

    ranges: tuple[Range, ...]

    def holds(self, tensor: Tensor) -> bool:
        """Whether the tensor's bytes are the file's own."""
        begin, end = _bytes_of(tensor)
        return any(first <= begin and end <= last for first, last in self.ranges)

    def pages_of(self, tensors: Iterable[Tensor]) -> list[Range]:
        """Whole pages of those tensors that lie in the file, joined where they touch."""
        page = mmap.PAGESIZE
        joined: list[Range] = []
        for begin, end in sorted(_bytes_of(tensor) for tensor in tensors if self.holds(tensor)):
            if joined and begin - joined[-1][1] < page:
                joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
            else:
                joined.append((begin, end))
        whole = [(-(-begin // page) * page, end // page * page) for begin, end in joined]
        return [(begin, end) for begin, end in whole if begin < end]

    def give_back(self, tensors: Iterable[Tensor]) -> None:
        """Let go of the memory of those tensors that lie in the file; they are read from it again when used."""
        _drop(self.pages_of(tensors))


def mapping_of(file: Path, maps: Path = _PROCESS_MAPS) -> FileMapping:
    """Find a file in the memory map of this process."""
    name = str(file.resolve())
    ranges = []
    try:
        for line in maps.read_text(encoding="utf-8", errors="surrogateescape").splitlines():
            fields = line.split(maxsplit=5)
            # Only what is this very file: dropping any other page would lose what is on it.
            if len(fields) == 6 and fields[5] == name and fields[1].endswith("p"):
                first, last = (int(address, 16) for address in fields[0].split("-"))
                ranges.append((first, last))
    except (OSError, ValueError):
        return FileMapping(())
    return FileMapping(tuple(ranges))


def give_back_after_use(model: nn.Module, mapping: FileMapping) -> None:
    """Let each large part of a network give its mapped weights back when it has run.

    The weights must not be changed from then on: a change would go with its page.
    """
    for part in model.modules():
        # The camera head goes through its blocks four times: reading them again costs less than all of them at once.
        if isinstance(part, Block | CameraHead | PatchProjection):
            pages = mapping.pages_of(part.parameters())
            part.register_forward_hook(lambda *_, pages=pages: _drop(pages))


def _drop(pages: Iterable[Range]) -> None:
    advise = _madvise()
    if advise is not None:
        for begin, end in pages:
            # A refusal costs memory and nothing else.
            advise(begin, end - begin, mmap.MADV_DONTNEED)


@lru_cache(maxsize=1)
def _madvise() -> Callable[[int, int, int], int] | None:
    """The C library's madvise; None where there is none."""
    function = getattr(ctypes.CDLL(None), "madvise", None) if hasattr(mmap, "MADV_DONTNEED") else None
    if function is None:
        return None
    function.argtypes, function.restype = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int), ctypes.c_int
    advise: Callable[[int, int, int], int] = function
    return advise


def _bytes_of(tensor: Tensor) -> Range:
    begin = tensor.data_ptr()
    return begin, begin + tensor.numel() * tensor.element_size()
