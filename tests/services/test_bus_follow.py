"""Following a stream over kills and restarts: dense, in order, from anywhere."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from bus_processes import Process, connect, entry, free_port, running, serve, wait_until, wait_until_heard
from vggt_motion.bus import calls, codec
from vggt_motion.bus.follow import SEVERAL_ENTRIES, Followed, Follower
from vggt_motion.bus.log import LogFollower
from vggt_motion.bus.session import Bus
from vggt_motion.errors import LedgerError
from vggt_motion.records import Event, LedgerStatus, LogEntry, Stream, StreamPosition


def take(follower: Follower[Event], count: int, timeout_s: float = 40.0) -> list[int]:
    numbers: list[int] = []
    end = time.monotonic() + timeout_s
    while len(numbers) < count and time.monotonic() < end:
        followed = follower.next(0.5)
        if followed is not None:
            assert followed.record.event_id == f"event-{followed.sequence}" == followed.entry.record_id
            numbers.append(followed.sequence)
    return numbers


def serve_log(bus: Bus, entries: list[LogEntry], *, asker: Bus, page: int = 7) -> None:
    def read(_: str, payload: bytes) -> bytes:
        request = codec.decode(calls.ReadRequest, payload)
        answer = entries[request.from_sequence : request.from_sequence + min(page, request.limit)]
        return codec.encode(calls.ReadReply(tuple(answer), len(entries)))

    serve(bus, bus.keys.rpc("ledger", "read"), read, asker=asker)


def test_live_publications_with_holes_come_out_dense(bus: Bus, endpoint: str, tmp_path: Path) -> None:
    with running(tmp_path, "ledger", endpoint, "60", "0.01"):
        follower = Follower(bus, "event", Event)
        assert take(follower, 60) == list(range(60))
        assert follower.position == follower.known_end == 60
        assert follower.next(0.0) is None
        follower.close()


def test_a_late_follower_reads_from_any_position(endpoint: str, bus: Bus) -> None:
    with connect(endpoint) as ledger:
        serve_log(ledger, [entry(number) for number in range(700)], asker=bus)
        assert take(Follower(bus, "event", Event, from_sequence=0), 700) == list(range(700))
        assert take(Follower(bus, "event", Event, from_sequence=695), 5) == list(range(695, 700))
        at_the_end = Follower(bus, "event", Event, from_sequence=700)
        assert at_the_end.next(0.5) is None


def test_a_follower_survives_the_router(tmp_path: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    with (
        running(tmp_path, "router", address) as router,
        connect(address) as bus,
        running(tmp_path, "ledger", address, "200", "0.02"),
    ):
        follower = Follower(bus, "event", Event)
        numbers = take(follower, 30)
        router.kill()
        time.sleep(1.0)
        with running(tmp_path, "router", address):
            numbers += take(follower, 170)
            assert numbers == list(range(200))


def test_a_follower_survives_a_ledger_that_comes_back_with_more(bus: Bus, endpoint: str, tmp_path: Path) -> None:
    # The second one publishes nothing of what the first one had: only reading can bring it.
    first = Process(tmp_path, "ledger", endpoint, "40", "0.01")
    follower = Follower(bus, "event", Event)
    numbers = take(follower, 40)
    first.kill()
    time.sleep(0.5)
    with running(tmp_path, "ledger", endpoint, "80", "0.0"):
        numbers += take(follower, 40)
    assert numbers == list(range(80))


def test_a_lost_last_message_shows_up_all_the_same(endpoint: str, bus: Bus) -> None:
    entries = [entry(0)]
    with connect(endpoint) as ledger:
        serve_log(ledger, entries, asker=bus)
        follower = Follower(bus, "event", Event)
        assert take(follower, 1) == [0]
        entries.append(entry(1))  # never published
        assert take(follower, 1) == [1]


def test_a_follower_that_nobody_takes_from_holds_a_bounded_number(endpoint: str, bus: Bus) -> None:
    with connect(endpoint) as ledger:
        serve_log(ledger, [entry(number) for number in range(3000)], asker=bus, page=1000)
        follower = Follower(bus, "event", Event)
        wait_until(lambda: len(follower._buffer) >= 256)
        time.sleep(0.5)
        assert len(follower._buffer) <= 256 + 256
        assert take(follower, 3000) == list(range(3000))


def test_a_record_that_cannot_be_decoded_is_passed_over_and_counted(endpoint: str, bus: Bus) -> None:
    bad = LogEntry("event", 1, "event-1", "vggt_motion.v1.Event", b"garbage", 0)
    with connect(endpoint) as ledger:
        serve_log(ledger, [entry(0), bad, entry(2)], asker=bus)
        follower = Follower(bus, "event", Event)
        assert take(follower, 2) == [0, 2]
        assert follower.skipped_count == 1


def test_another_log_under_the_same_name_is_an_error_not_a_silence(endpoint: str, bus: Bus) -> None:
    with connect(endpoint) as ledger:
        serve_log(ledger, [entry(number) for number in range(5)], asker=bus)
        follower = Follower(bus, "event", Event, from_sequence=9)

        def problem() -> bool:
            try:
                return follower.next(0.1) is not None
            except LedgerError:
                return True

        wait_until(problem)
        with pytest.raises(LedgerError, match="another log"):
            follower.next(0.0)


def test_publications_that_lie_do_not_disturb(endpoint: str, bus: Bus) -> None:
    entries = [entry(number) for number in range(3)]
    with connect(endpoint) as ledger, connect(endpoint) as liar:
        serve_log(ledger, entries, asker=bus)
        follower = Follower(bus, "event", Event)
        assert take(follower, 3) == [0, 1, 2]
        publisher = liar.publisher(liar.keys.log("event"), blocking=True)
        wait_until_heard(liar, liar.keys.log("event"))
        for payload in (b"", b"garbage", codec.encode(entry(2**40)), codec.encode(entry(1)), bytes(100_000)):
            publisher.put(payload)
        for number in range(400):
            publisher.put(codec.encode(entry(10**6 + number)))
        entries.append(entry(3))
        assert take(follower, 1) == [3]
        wait_until(lambda: follower.known_end == 4)


def test_closing_ends_a_waiting_call(endpoint: str, bus: Bus) -> None:
    follower: Follower[Event] = Follower(bus, "event", Event)
    outcome: list[Followed[Event] | None] = []
    waiting = threading.Thread(target=lambda: outcome.append(follower.next(60.0)))
    waiting.start()
    time.sleep(0.2)
    follower.close()
    waiting.join(10)
    assert outcome == [None]


def serve_all_streams(ledger: Bus, entries: list[LogEntry], asker: Bus) -> None:
    """Be a ledger that holds these events, and what is added to them."""

    def status(_: str, __: bytes) -> bytes:
        positions = (StreamPosition("event", len(entries)),)
        return codec.encode(LedgerStatus(positions, (), 0, 1, True, "", 0, "f00d"))

    def read(_: str, payload: bytes) -> bytes:
        request = codec.decode(calls.ReadRequest, payload)
        held = entries[request.from_sequence :] if request.stream == "event" else []
        return codec.encode(calls.ReadReply(tuple(held), len(entries) if request.stream == "event" else 0))

    serve(ledger, ledger.keys.rpc("ledger", "status"), status, asker=asker)
    serve(ledger, ledger.keys.rpc("ledger", "read"), read, asker=asker)


def test_a_ledger_that_appears_is_asked_at_once(endpoint: str, bus: Bus) -> None:
    entries = [entry(0)]
    with connect(endpoint) as ledger:
        serve_all_streams(ledger, entries, bus)
        asked = threading.Event()
        log = LogFollower(bus, on_status=lambda status: asked.set() if status else None, interval_s=3600.0)
        taken: list[str] = []

        def has(count: int) -> bool:
            log.wait(0.2)
            taken.extend(record.event_id for record in log.poll() if isinstance(record, Event))
            return len(taken) == count

        wait_until(lambda: has(1))
        assert asked.wait(10.0)
        entries.append(entry(1))  # never published, as while the link was down
        assert not has(2)
        ledger.declare_token(ledger.keys.alive("ledger", "back"))
        wait_until(lambda: has(2))
        log.close()


def test_all_streams_share_one_question_about_what_was_lost(endpoint: str, bus: Bus) -> None:
    entries = [entry(number) for number in range(3)]
    statuses: list[LedgerStatus | None] = []
    with connect(endpoint) as ledger:
        serve_all_streams(ledger, entries, bus)
        log = LogFollower(bus, {Stream.EVENT: 1}, on_status=statuses.append, interval_s=0.1)
        taken: list[str] = []

        def has(*numbers: int) -> bool:
            log.wait(0.5)
            taken.extend(record.event_id for record in log.poll() if isinstance(record, Event))
            return taken == [f"event-{number}" for number in numbers]

        wait_until(lambda: has(1, 2))
        entries.append(entry(3))  # never published
        wait_until(lambda: has(1, 2, 3))
        publisher = ledger.publisher(ledger.keys.log("event"), blocking=True)
        wait_until_heard(ledger, ledger.keys.log("event"))
        entries.append(entry(4))
        publisher.put(codec.encode(entries[4]))
        wait_until(lambda: has(1, 2, 3, 4))
        assert log.positions()[Stream.EVENT] == 5
        together = tuple(entry(number) for number in range(3, 8))  # two of them are known already
        entries.extend(together[2:])
        publisher.put(codec.encode(calls.ReadReply(together, 8)), encoding=SEVERAL_ENTRIES)
        publisher.put(b"garbage", encoding=SEVERAL_ENTRIES)
        wait_until(lambda: has(*range(1, 8)))
        assert any(answer is not None and answer.position("event") == 4 for answer in statuses)
        log.close()
