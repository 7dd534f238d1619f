from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import pytest

from vggt_motion.gathering import Gathering


class Doubling:
    """Doubles numbers; the first batches are held until they are released."""

    def __init__(self, held: int) -> None:
        self.batches: list[list[int]] = []
        self.release = threading.Event()
        self._held = held
        self._lock = threading.Lock()

    def __call__(self, batch: Sequence[int]) -> list[int]:
        with self._lock:
            self.batches.append(list(batch))
            is_held = len(self.batches) <= self._held
        if is_held:
            assert self.release.wait(20)
        if 13 in batch:
            raise ValueError("13")
        return [2 * item for item in batch]


def wait_for_waiting(gathering: Gathering[int, int], count: int) -> None:
    deadline = time.monotonic() + 20
    while len(gathering._waiting) < count:
        assert time.monotonic() < deadline
        time.sleep(0.001)


@pytest.mark.parametrize("lanes", [1, 2])
def test_what_comes_while_all_lanes_are_busy_goes_together_in_order(lanes: int) -> None:
    double = Doubling(held=lanes)
    gathering: Gathering[int, int] = Gathering(double, lanes=lanes)
    with ThreadPoolExecutor(16) as pool:
        first = [pool.submit(gathering, number) for number in range(lanes)]
        deadline = time.monotonic() + 20
        while len(double.batches) < lanes:
            assert time.monotonic() < deadline
            time.sleep(0.001)
        rest = []
        for number in range(lanes, 12):
            rest.append(pool.submit(gathering, number))
            wait_for_waiting(gathering, len(rest))
        double.release.set()
        assert [future.result(20) for future in first + rest] == [2 * number for number in range(12)]
    assert sorted(double.batches[:lanes]) == [[number] for number in range(lanes)]
    assert double.batches[lanes:] == [list(range(lanes, 12))]
    gathering.wait_until_idle()


def test_a_batch_is_no_heavier_than_allowed_but_for_a_single_item() -> None:
    double = Doubling(held=1)
    gathering: Gathering[int, int] = Gathering(double, max_weight=lambda: 10, weigh=lambda item: item)
    with ThreadPoolExecutor(16) as pool:
        futures = [pool.submit(gathering, 1)]
        while not double.batches:
            time.sleep(0.001)
        for count, number in enumerate([4, 5, 6, 4, 50, 1, 2], start=1):
            futures.append(pool.submit(gathering, number))
            wait_for_waiting(gathering, count)
        double.release.set()
        assert [future.result(20) for future in futures] == [2, 8, 10, 12, 8, 100, 2, 4]
    assert double.batches == [[1], [4, 5], [6, 4], [50], [1, 2]]


def test_what_ends_in_an_error_ends_so_for_all_of_its_batch_and_for_no_other() -> None:
    double = Doubling(held=1)
    gathering: Gathering[int, int] = Gathering(double)
    with ThreadPoolExecutor(16) as pool:
        futures = [pool.submit(gathering, 1)]
        while not double.batches:
            time.sleep(0.001)
        for count, number in enumerate([12, 13, 14], start=1):
            futures.append(pool.submit(gathering, number))
            wait_for_waiting(gathering, count)
        double.release.set()
        assert futures[0].result(20) == 2
        assert [type(future.exception(20)) for future in futures[1:]] == [ValueError] * 3
    assert gathering(7) == 14


def test_many_threads_get_what_is_theirs() -> None:
    gathering: Gathering[int, int] = Gathering(
        lambda batch: [2 * item for item in batch], lanes=3, max_weight=lambda: 5
    )
    with ThreadPoolExecutor(32) as pool:
        assert list(pool.map(gathering, range(5000))) == [2 * number for number in range(5000)]
    gathering.wait_until_idle()
    assert gathering._busy_lanes == 0 and not gathering._waiting
