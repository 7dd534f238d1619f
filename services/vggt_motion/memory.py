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
_M_ARENA_MAX: Final = -8
_LONGEST_KEPT_BYTES: Final = 32 * 2**20  # the most that the library allows; longer ones go back at once
_KEPT_BYTES: Final = 64 * 2**20  # of what is free at the end of an arena
_ARENAS: Final = 2  # each thread would have its own, and keep as much


def keep_freed_memory() -> bool:
    """Have this process keep what it frees, 64 MiB at most at the end of each of two arenas.

    What lies under a piece that is in use stays as well, as it does without the setting. False: the C library has no
    such setting.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    settings = (
        (_M_MMAP_THRESHOLD, _LONGEST_KEPT_BYTES),
        (_M_TRIM_THRESHOLD, _KEPT_BYTES),
        (_M_ARENA_MAX, _ARENAS),
    )
    return all(mallopt(name, value) for name, value in settings)
