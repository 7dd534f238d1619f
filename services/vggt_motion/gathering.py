"""Work that comes while other work of its kind is under way is carried out together, by the threads that bring it.

Nothing waits for company: what comes alone is carried out at once, without a change of thread. The busier it gets, the
more goes at a time. It is how a database commits many transactions with one write (group commit).
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


class _Entry(Generic[Item, Outcome]):
    """One item on its way; its caller waits at the gate until it is finished, or is to carry out a batch."""

    def __init__(self, item: Item, weight: int) -> None:
        self.item = item
        self.weight = weight
        self.gate: threading.Lock | None = None
        self.batch: list[_Entry[Item, Outcome]] | None = None  # that its caller is to carry out
        self.outcome: Outcome | None = None
        self.error: BaseException | None = None


class Gathering(Generic[Item, Outcome]):
    """Carries out items in batches. Thread-safe."""

    def __init__(
        self,
        carry_out: Callable[[Sequence[Item]], Sequence[Outcome]],
        *,
        lanes: int = 1,
        max_weight: Callable[[], int] | None = None,
        weigh: Callable[[Item], int] = lambda _: 1,
    ) -> None:
        """Bind.

        Args:
            carry_out: of a batch, the outcome of each item in order; what it raises, every caller of the batch gets.
            lanes: so many batches may be under way at a time.
            max_weight: of a batch of more than one item, at this moment; None: no bound.
            weigh: weight of an item.
        """
        self._carry_out = carry_out
        self._lanes = lanes
        self._max_weight = max_weight
        self._weigh = weigh
        self._lock = threading.Lock()
        self._is_idle = threading.Condition(self._lock)
        self._waiting: deque[_Entry[Item, Outcome]] = deque()
        self._busy_lanes = 0
        self._under_way = 0  # items in them

    def __call__(self, item: Item) -> Outcome:
        """Carry out an item, among others if there are others; returns its outcome."""
        entry: _Entry[Item, Outcome] = _Entry(item, self._weigh(item))
        with self._lock:
            self._waiting.append(entry)
            batch = self._next_batch()
            if not batch or batch[0] is not entry:
                entry.gate = threading.Lock()
                entry.gate.acquire()
        if batch:
            self._start(batch, entry)
        if entry.gate is not None:
            entry.gate.acquire()
        if entry.batch is not None:
            self._lead(entry.batch)
        if entry.error is not None:
            raise entry.error
        return entry.outcome  # type: ignore[return-value]

    def wait_until_idle(self) -> None:
        """Return when nothing is under way."""
        with self._is_idle:
            self._is_idle.wait_for(lambda: self._busy_lanes == 0)

    def _lead(self, batch: list[_Entry[Item, Outcome]]) -> None:
        """Carry out a batch, and let what has gathered meanwhile follow."""
        try:
            outcomes = self._carry_out([entry.item for entry in batch])
            for entry, outcome in zip(batch, outcomes, strict=True):
                entry.outcome = outcome
        except BaseException as error:
            for entry in batch:
                entry.error = error
        with self._lock:
            self._busy_lanes -= 1
            self._under_way -= len(batch)
            following = self._next_batch()
            if not self._busy_lanes:
                self._is_idle.notify_all()
        if following:
            self._start(following)
        for entry in batch[1:]:
            self._open(entry)

    def _next_batch(self) -> list[_Entry[Item, Outcome]]:
        """What goes now, and takes a lane; nothing: no lane is free, or too little waits for it. With the lock.

        While others are under way, a batch is a fair share of all, or every lane but one would carry a few items only.
        """
        batch: list[_Entry[Item, Outcome]] = []
        if self._busy_lanes >= self._lanes or len(self._waiting) * self._lanes < self._under_way:
            return batch
        weight = 0
        while self._waiting:
            weight += self._waiting[0].weight
            if batch and self._max_weight is not None and weight > self._max_weight():
                break
            batch.append(self._waiting.popleft())
        if batch:
            self._busy_lanes += 1
            self._under_way += len(batch)
        return batch

    def _start(self, batch: list[_Entry[Item, Outcome]], caller: _Entry[Item, Outcome] | None = None) -> None:
        batch[0].batch = batch
        if batch[0] is not caller:
            self._open(batch[0])

    @staticmethod
    def _open(entry: _Entry[Item, Outcome]) -> None:
        if entry.gate is not None:
            entry.gate.release()
