"""Which frames of an input are taken, and from when: ``--start``, ``--end``, ``--stride`` and the nominal rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from vggt_motion.errors import InputError

DEFAULT_NOMINAL_RATE_HZ = 10.0  # of a folder that says nothing about time; the rate of KITTI

_Item = TypeVar("_Item")


@dataclass(frozen=True)
class Selection:
    """A slice of the input's frames, as in ``frames[start:end:stride]``.

    Attributes:
        start: first frame taken.
        end: first frame not taken any more; None = up to the last.
        stride: every so many frames.
        nominal_rate_hz: frames per second assumed where the input carries no time at all.

    Raises:
        InputError: on construction, when a bound is negative, the range is empty or a step is not positive.
    """

    start: int = 0
    end: int | None = None
    stride: int = 1
    nominal_rate_hz: float = DEFAULT_NOMINAL_RATE_HZ

    def __post_init__(self) -> None:
        if self.start < 0:
            raise InputError(f"start must not be negative: {self.start}")
        if self.end is not None and self.end <= self.start:
            raise InputError(f"end must be larger than start: start {self.start}, end {self.end}")
        if self.stride < 1:
            raise InputError(f"stride must be at least 1: {self.stride}")
        if not 0 < self.nominal_rate_hz < float("inf"):
            raise InputError(f"the nominal frame rate must be positive: {self.nominal_rate_hz}")

    def of(self, items: Sequence[_Item]) -> Sequence[_Item]:
        """The selected items."""
        return items[self.start : self.end : self.stride]

    def count(self, total: int) -> int:
        """How many frames are selected out of ``total``."""
        return len(range(total)[self.start : self.end : self.stride])

    def takes(self, position: int) -> bool:
        """Whether the frame at this position of the input is selected."""
        return position >= self.start and not self.is_past(position) and (position - self.start) % self.stride == 0

    def is_past(self, position: int) -> bool:
        """Whether neither this frame nor any later one is selected."""
        return self.end is not None and position >= self.end

    def __str__(self) -> str:
        return f"{self.start}:{'' if self.end is None else self.end}:{self.stride}"
