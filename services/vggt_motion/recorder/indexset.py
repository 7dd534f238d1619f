"""A set of frame numbers that costs nothing while the numbers are dense."""

from __future__ import annotations

from bisect import bisect_right


class IndexSet:
    """Non-negative whole numbers, kept as runs: 100,000 frames without a gap are one pair of numbers."""

    def __init__(self) -> None:
        self._starts: list[int] = []
        self._ends: list[int] = []  # exclusive
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __contains__(self, index: int) -> bool:
        run = bisect_right(self._starts, index) - 1
        return run >= 0 and index < self._ends[run]

    def add(self, index: int) -> bool:
        """Add a number; False if it was there."""
        if index in self:
            return False
        self._count += 1
        run = bisect_right(self._starts, index) - 1
        touches_left = run >= 0 and self._ends[run] == index
        touches_right = run + 1 < len(self._starts) and self._starts[run + 1] == index + 1
        if touches_left and touches_right:
            self._ends[run] = self._ends.pop(run + 1)
            self._starts.pop(run + 1)
        elif touches_left:
            self._ends[run] = index + 1
        elif touches_right:
            self._starts[run + 1] = index
        else:
            self._starts.insert(run + 1, index)
            self._ends.insert(run + 1, index + 1)
        return True
