"""Two threads for work that leaves the interpreter's lock: compiled kernels and OpenCV.

One worker keeps two cores busy with it. What is done and in which order it is put together is decided by the caller, so
that no result depends on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_THREADS = 2
_In = TypeVar("_In")
_Out = TypeVar("_Out")


def each(function: Callable[[_In], _Out], items: Sequence[_In]) -> list[_Out]:
    """The function of each item, in the order of the items; its first error passes through."""
    if len(items) < 2:
        return [function(item) for item in items]
    with ThreadPoolExecutor(min(_THREADS, len(items))) as pool:  # its own, so that calls within calls cannot block
        return list(pool.map(function, items))
