from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import pytest

from vggt_motion.bus import calls, codec
from vggt_motion.bus.ledger import AppendResult, LedgerClient
from vggt_motion.bus.wire import Payload, joined
from vggt_motion.errors import BusUnavailableError, DiskFullError, RequestRefusedError, VggtMotionError
from vggt_motion.frontend import sender as module
from vggt_motion.frontend.sender import MAX_WAITING, LedgerSender
from vggt_motion.records import Event, EventKind

Outcome = AppendResult | VggtMotionError


class FakeLedger(LedgerClient):
    """Takes records as it is told to."""

    def __init__(self, answer: Callable[[str], Outcome] | None = None) -> None:
        self.answer = answer or (lambda _: AppendResult(0, was_known=False))
        self.batches: list[list[str]] = []
        self.gate = threading.Event()
        self.gate.set()

    def append_all_encoded(self, payloads: Sequence[Payload], *, what: str = "records") -> list[Outcome]:
        assert self.gate.wait(20)
        names = [codec.decode(calls.AppendRequest, joined(payload)).record_id for payload in payloads]
        self.batches.append(names)
        return [self.answer(name) for name in names]


def event(number: int) -> tuple[str, str, Event]:
    return "event", f"event-{number}", Event(f"event-{number}", EventKind.WARNING, "x" * 1000, number)


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def test_what_is_put_while_others_are_sent_goes_together_and_in_order() -> None:
    ledger = FakeLedger()
    sender = LedgerSender(ledger, lambda _: None)
    ledger.gate.clear()
    for number in range(10):
        sender.put(*event(number))
    ledger.gate.set()
    sender.flush()
    assert [name for batch in ledger.batches for name in batch] == [f"event-{number}" for number in range(10)]
    assert len(ledger.batches) <= 3
    sender.close()


def test_no_more_waits_than_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_WAITING_BYTES", 10_000)
    ledger = FakeLedger()
    ledger.gate.clear()
    sender = LedgerSender(ledger, lambda _: None)
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(lambda: [sender.put(*event(number)) for number in range(30)])
        wait_for(lambda: len(sender._waiting) >= 8)
        time.sleep(0.05)
        assert not done.done() and sender._waiting_bytes <= 10_000
        ledger.gate.set()
        assert done.result(20) == [None] * 30
    sender.flush()
    assert sum(map(len, ledger.batches)) == 30 and max(map(len, ledger.batches)) <= MAX_WAITING
    sender.close()


def test_while_the_disk_is_full_nothing_is_taken_and_nothing_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_RETRY_S", 0.01)
    is_full = threading.Event()
    is_full.set()

    def answer(name: str) -> Outcome:
        return DiskFullError("full") if is_full.is_set() and name != "event-1" else AppendResult(0, was_known=False)

    ledger, told = FakeLedger(answer), []
    ledger.gate.clear()
    sender = LedgerSender(ledger, told.append)
    for number in range(3):
        sender.put(*event(number))
    ledger.gate.set()
    wait_for(lambda: len(told) > 2)
    with ThreadPoolExecutor(1) as pool:
        more = pool.submit(sender.put, *event(3))
        time.sleep(0.05)
        assert not more.done()
        is_full.clear()
        more.result(20)
    sender.flush()
    names = [name for batch in ledger.batches for name in batch]
    assert names.count("event-1") == 1 and names.index("event-3") > names.index("event-2")
    assert names[-3:] == ["event-0", "event-2", "event-3"]
    sender.close()


def test_a_defect_in_the_thread_is_told_too_and_after_the_end_nothing_is_taken() -> None:
    def defect(_: str) -> Outcome:
        raise ValueError("a defect")

    sender = LedgerSender(FakeLedger(defect), lambda _: None)
    sender.put(*event(0))
    with pytest.raises(ValueError, match="a defect"):
        sender.flush()
    ledger = FakeLedger()
    ledger.gate.clear()
    sender = LedgerSender(ledger, lambda _: None)
    sender.put(*event(0))
    sender.close()
    with pytest.raises(BusUnavailableError):
        sender.flush()
    ledger.gate.set()


@pytest.mark.parametrize("error", [RequestRefusedError("no"), BusUnavailableError("stopping")])
def test_what_cannot_be_sent_is_told_to_whoever_puts_more(error: VggtMotionError) -> None:
    ledger = FakeLedger(lambda _: error)
    sender = LedgerSender(ledger, lambda _: None)
    sender.put(*event(0))
    with pytest.raises(type(error), match=str(error)):
        sender.flush()
    with pytest.raises(type(error), match=str(error)):
        sender.put(*event(1))
    assert ledger.batches == [["event-0"]]
    sender.close()
