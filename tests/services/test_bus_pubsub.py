"""Publishing and subscribing over a real router: history, recovery, order; a slow subscriber harms only itself."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from bus_processes import (
    connect,
    free_port,
    running,
    serve,
    wait_until,
    wait_until_heard,
    wait_until_known,
)
from vggt_motion.bus.pubsub import MAX_HISTORY, Publisher
from vggt_motion.bus.session import Bus, Sample


class Collector:
    def __init__(self, delay_s: float = 0.0, gate: threading.Event | None = None) -> None:
        self.samples: list[Sample] = []
        self.delay_s = delay_s
        self.gate = gate

    def __call__(self, sample: Sample) -> None:
        time.sleep(self.delay_s)
        self.samples.append(sample)
        if self.gate is not None:
            self.gate.wait(60)

    def numbers(self) -> list[int]:
        return [int(sample.payload.split(b":")[0]) for sample in self.samples]


def publish_until_heard(publish: Callable[[], None], collector: Collector) -> None:
    """A subscription takes a moment to reach the publisher."""

    def heard() -> bool:
        publish()
        return bool(collector.samples)

    wait_until(heard)


def publish_until_settled(publisher: Publisher, collector: Collector) -> None:
    """Be heard, and leave nothing on its way: a mark that comes last has come. Forgets what was received."""
    publish_until_heard(lambda: put(publisher, 0), collector)
    put(publisher, -1)
    wait_until(lambda: -1 in collector.numbers())
    collector.samples.clear()


def put(publisher: Publisher, number: int, size: int = 0) -> None:
    publisher.put(f"{number}:".encode() + bytes(size))


def put_all(publisher: Publisher, numbers: Iterable[int], size: int) -> None:
    for number in numbers:
        put(publisher, number, size)


def test_a_sample_carries_payload_time_attachment_and_encoding(endpoint: str) -> None:
    with connect(endpoint) as sender, connect(endpoint) as receiver:
        got = Collector()
        receiver.subscribe(receiver.keys.all_images(), got)
        publisher = sender.publisher(sender.keys.image("front"), blocking=True, encoding="application/protobuf;a.B")
        moment = 1_700_000_000_123_456_789
        publish_until_heard(lambda: publisher.put(b"frame", timestamp_ns=moment, attachment=b"head"), got)
        first = got.samples[0]
        assert (first.payload, first.attachment) == (b"frame", b"head")
        assert (first.key, first.encoding) == (sender.keys.image("front"), "application/protobuf;a.B")
        assert first.timestamp_ns is not None and abs(first.timestamp_ns - moment) <= 2


def test_a_late_subscriber_gets_the_history_in_order(endpoint: str) -> None:
    with connect(endpoint) as sender, connect(endpoint) as witness, connect(endpoint) as receiver:
        early = Collector()
        witness.subscribe(witness.keys.log("event"), early)
        publisher = sender.publisher(sender.keys.log("event"), blocking=True, history=8)
        numbers = itertools.count()
        publish_until_heard(lambda: put(publisher, next(numbers)), early)
        # Late means after the router has seen the publisher and all it sent: what is still under way arrives live, and
        # in the very millisecond in which both sides declare themselves, Zenoh may answer the query with nothing.
        last = next(numbers) + 20
        put_all(publisher, range(last - 20, last + 1), 0)
        wait_until(lambda: last in early.numbers())
        got = Collector()
        receiver.subscribe(receiver.keys.log("event"), got, history=True)
        wait_until(lambda: len(got.samples) >= 8)
        put(publisher, last + 1)
        wait_until(lambda: last + 1 in got.numbers())
        assert got.numbers() == list(range(last - 7, last + 2))


def test_nothing_is_lost_while_the_router_is_away(tmp_path: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    with (
        running(tmp_path, "router", address) as router,
        connect(address) as sender,
        connect(address) as receiver,
    ):
        got = Collector()
        receiver.subscribe(receiver.keys.log("event"), got, history=True)
        publisher = sender.publisher(sender.keys.log("event"), blocking=True, history=64)
        wait_until_heard(sender, sender.keys.log("event"))
        for number in range(10):
            put(publisher, number)
        wait_until(lambda: len(got.samples) == 10)
        router.kill()
        for number in range(10, 30):
            put(publisher, number)
            time.sleep(0.02)
        with running(tmp_path, "router", address):
            for number in range(30, 40):
                put(publisher, number)
                time.sleep(0.02)
            wait_until(lambda: len(got.samples) >= 40)
            assert got.numbers() == list(range(40))


def test_a_slow_live_subscriber_sees_the_newest_and_holds_up_nobody(endpoint: str) -> None:
    with connect(endpoint) as sender, connect(endpoint) as receiver:
        serve(receiver, receiver.keys.rpc("test", "echo"), lambda _, payload: payload, asker=sender)
        # It takes longer over one message than all the others need, however slow the machine is.
        release = threading.Event()
        slow = Collector(gate=release)
        receiver.subscribe(receiver.keys.all_images(), slow, latest_only=True)
        publisher = sender.publisher(sender.keys.image("front"), blocking=False)
        publish_until_heard(lambda: put(publisher, 0), slow)
        slow.samples.clear()
        for number in range(1, 101):
            put(publisher, number, size=100_000)
            time.sleep(0.005)
        assert sender.request(sender.keys.rpc("test", "echo"), b"x", timeout_s=5.0) == b"x"
        assert slow.samples == []
        release.set()

        def has_newest() -> bool:
            put(publisher, 100)  # again: it does not block, and so the bus may drop any one of them
            return 100 in slow.numbers()

        wait_until(has_newest)
        assert len(slow.samples) < 50
        assert slow.numbers() == sorted(slow.numbers())


def test_a_slow_blocking_subscriber_with_a_link_of_its_own_gets_all_and_holds_up_no_request(endpoint: str) -> None:
    count = 60
    with connect(endpoint) as sender, connect(endpoint) as receiver, connect(endpoint) as third:
        serve(third, third.keys.rpc("test", "echo"), lambda _, payload: payload, asker=receiver)
        slow = Collector(delay_s=0.02)
        receiver.subscribe(receiver.keys.all_images(), slow, isolated=True)
        publisher = sender.publisher(sender.keys.image("front"), blocking=True)
        publish_until_settled(publisher, slow)
        sending = threading.Thread(target=put_all, args=(publisher, range(1, count + 1), 1_000_000))
        sending.start()
        for _ in range(10):
            assert receiver.request(receiver.keys.rpc("test", "echo"), b"x", timeout_s=5.0) == b"x"
        sending.join(60)
        wait_until(lambda: len(slow.samples) >= count)
        assert slow.numbers() == list(range(1, count + 1))


def test_a_callback_that_raises_does_not_end_the_subscription(endpoint: str) -> None:
    with connect(endpoint) as sender, connect(endpoint) as receiver:
        got = Collector()

        def callback(sample: Sample) -> None:
            if sample.payload.startswith(b"1:"):
                raise ValueError("a defect of the subscriber")
            got(sample)

        receiver.subscribe(receiver.keys.log("event"), callback, history=True)
        publisher = sender.publisher(sender.keys.log("event"), blocking=True, history=8)
        wait_until_heard(sender, sender.keys.log("event"))
        for number in range(4):
            put(publisher, number)
        wait_until(lambda: 3 in got.numbers())
        assert got.numbers() == [0, 2, 3]


def test_a_closed_subscription_is_silent_and_closing_twice_is_fine(endpoint: str, bus: Bus) -> None:
    with connect(endpoint) as sender:
        got, other = Collector(), Collector()
        subscription = bus.subscribe(bus.keys.all_images(), got)
        bus.subscribe(bus.keys.all_images(), other)
        publisher = sender.publisher(sender.keys.image("front"), blocking=True)
        publish_until_settled(publisher, got)
        subscription.close()
        subscription.close()
        put(publisher, 1)
        wait_until(lambda: 1 in other.numbers())
        assert got.samples == []
        publisher.close()
        publisher.close()


def test_the_longest_history_fits_while_nobody_reads_yet(endpoint: str) -> None:
    """Replies of the history come in before the subscription is there; they must not wait for a reader."""
    with connect(endpoint) as sender:
        publisher = sender.publisher(sender.keys.image("front"), blocking=True, history=MAX_HISTORY)
        put_all(publisher, range(MAX_HISTORY), 20_000)
        wait_until_known(sender)
        for _ in range(10):
            with connect(endpoint) as receiver:
                got = Collector()
                receiver.subscribe(receiver.keys.all_images(), got, history=True)
                wait_until(lambda got=got: got.numbers() == list(range(MAX_HISTORY)))
        with pytest.raises(ValueError, match="longer than"):
            sender.publisher(sender.keys.image("rear"), blocking=True, history=MAX_HISTORY + 1)


def test_a_subscription_that_is_closed_while_it_is_full_leaves_nothing_blocked(endpoint: str) -> None:
    """Also with a reader that gives up in the middle: the process can open the next session, the publisher goes on."""
    with connect(endpoint) as sender:
        publisher = sender.publisher(sender.keys.image("front"), blocking=True)
        is_over = threading.Event()

        def feed() -> None:
            number = 0
            while not is_over.is_set():
                put(publisher, number, 100_000)
                number += 1

        feeder = threading.Thread(target=feed, daemon=True)
        feeder.start()
        opened: list[Bus] = []

        def open_and_give_up() -> None:
            for _ in range(12):
                receiver, release = connect(endpoint), threading.Event()
                receiver.subscribe(
                    receiver.keys.all_images(), lambda _, release=release: release.wait(60), history=True
                )
                time.sleep(0.1)  # channel and link fill up
                release.set()
                receiver.close()
                opened.append(receiver)

        opener = threading.Thread(target=open_and_give_up, daemon=True)
        opener.start()
        opener.join(100)
        assert len(opened) == 12, "the process cannot open a session any more"
        is_over.set()
        feeder.join(60)
        assert not feeder.is_alive()


def test_a_watch_begins_among_more_services_than_fit_a_channel_of_messages(endpoint: str) -> None:
    names = {f"worker-{number}" for number in range(300)}
    with connect(endpoint) as fleet, connect(endpoint) as watcher, connect(endpoint) as asker:
        for name in names:
            fleet.declare_token(fleet.keys.alive("inference", name))
        seen: dict[str, bool] = {}
        watcher.watch_liveliness(watcher.keys.all_alive(), lambda key, is_alive: seen.update({key: is_alive}))
        serve(watcher, watcher.keys.rpc("ledger", "status"), lambda _, payload: payload, asker=asker)
        wait_until(lambda: {key.rsplit("/", 1)[1] for key, is_alive in seen.items() if is_alive} >= names)
        assert asker.request(asker.keys.rpc("ledger", "status"), b"there") == b"there"
        fleet.close()
        wait_until(lambda: not any(is_alive for key, is_alive in seen.items() if key.rsplit("/", 1)[1] in names))
