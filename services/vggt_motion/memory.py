"""Memory that was freed stays with the process for what comes next (mallopt(3), GNU libc).

Images, chunks of a recording and arrays of depth come and go at a megabyte or so each, and the C library gives such
memory back to the kernel whenever it is free: then each of their pages is found and cleared anew. Measured, a recording
of 40 MB of frames took 76 ms of processor time that way, and 31 ms with what is set here.
"""

from __future__ import annotations

import ctypes
from typing import Final

_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
_FROM_BYTES: Final = 8 * 2**20  # what is longer is rare, and goes back at once
_KEPT_BYTES: Final = 64 * 2**20  # at most so much of what is free


def keep_freed_memory() -> bool:
    """Have this process keep the memory of what it frees, up to a bound; False: the C library has no such setting."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _FROM_BYTES)) and bool(mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES))
