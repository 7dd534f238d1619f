"""The scaffold of a service, in real processes: liveliness, health, signals, exit codes, and what is printed."""

from __future__ import annotations

import re
import signal
import time
from pathlib import Path

import pytest

from bus_processes import (
    EXIT_LIMIT_S,
    READY_S,
    Process,
    connect,
    free_port,
    running,
    wait_until,
    wait_until_heard,
    wait_until_known,
)
from vggt_motion.bus.liveliness import ServiceWatch, announce
from vggt_motion.bus.session import Bus
from vggt_motion.records import HealthReport


def alive(watch: ServiceWatch, service: str) -> bool:
    return any(name == service for name, _ in watch.services())


def test_a_service_shows_itself_and_says_how_it_is(bus: Bus, endpoint: str, tmp_path: Path) -> None:
    watch = ServiceWatch(bus)
    with running(tmp_path, "answer", endpoint, "one"), running(tmp_path, "answer", endpoint, "two") as second:
        assert watch.wait_for({"answer": 2}, READY_S)
        wait_until(lambda: all(report is not None for report in watch.services().values()))
        report = watch.services()["answer", "one"]
        wait_until(lambda: getattr(watch.services()["answer", "one"], "state", "") == "working")
        report = watch.services()["answer", "one"]
        assert report is not None
        assert (report.service, report.instance, report.detail) == ("answer", "one", "answering")
        assert report.counters == {"requests": 1.0}
        assert report.resident_bytes > 5_000_000
        assert abs(report.time_ns / 1e9 - time.time()) < 60
        earlier = report.time_ns
        wait_until(lambda: getattr(watch.services()["answer", "one"], "time_ns", 0) > earlier)
        # Just after a report, so that none is on its way that could overtake the end of the token.
        last = getattr(watch.services()["answer", "two"], "time_ns", 0)
        wait_until(lambda: getattr(watch.services()["answer", "two"], "time_ns", 0) > last)
        second.kill()
        wait_until(lambda: ("answer", "two") not in watch.services())
        assert watch.missing({"answer": 2, "ledger": 1}) == {"answer": 1, "ledger": 1}
        assert not watch.wait_for({"answer": 2}, 0.1)
        assert watch.silence_s("answer", "two") is None


def test_the_router_is_a_service_too(bus: Bus) -> None:
    assert ServiceWatch(bus).wait_for({"router": 1}, READY_S)


def test_a_frozen_process_falls_silent_and_is_gone_after_the_lease(bus: Bus, endpoint: str, tmp_path: Path) -> None:
    watch = ServiceWatch(bus)
    with running(tmp_path, "answer", endpoint, "one") as process:
        assert watch.wait_for({"answer": 1}, READY_S)
        process.signal(signal.SIGSTOP)
        wait_until(lambda: not alive(watch, "answer"))
        process.signal(signal.SIGCONT)
        wait_until(lambda: alive(watch, "answer"))


def test_a_watch_recovers_from_a_new_router(tmp_path: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    with (
        running(tmp_path, "router", address) as router,
        connect(address) as bus,
        running(tmp_path, "answer", address),
    ):
        watch = ServiceWatch(bus)
        assert watch.wait_for({"answer": 1, "router": 1}, READY_S)
        router.kill()
        wait_until(lambda: not watch.services())
        with running(tmp_path, "router", address):
            assert watch.wait_for({"answer": 1, "router": 1}, READY_S)
            wait_until(lambda: any(report for report in watch.services().values()))


def test_health_that_is_no_health_is_passed_over(bus: Bus, endpoint: str) -> None:
    watch = ServiceWatch(bus)
    with connect(endpoint) as other:
        good = HealthReport("frontend", "a", 1, "idle", "", 0)
        announce(other, "frontend", "a", lambda: good)
        liar = other.publisher(other.keys.health("frontend", "b"), blocking=False)
        wait_until_heard(other, other.keys.health("frontend", "b"))
        for _ in range(5):
            liar.put(b"garbage")
        wait_until(lambda: watch.services().get(("frontend", "a")) == good)
        assert set(watch.services()) >= {("frontend", "a")} and ("frontend", "b") not in watch.services()


@pytest.mark.parametrize("role", ["answer", "stubborn", "busy", "router"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_service_that_is_told_to_stop_ends_cleanly_and_soon(
    tmp_path: Path, role: str, number: signal.Signals
) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    with running(tmp_path, "router", address) as router, connect(address) as bus:
        watch = ServiceWatch(bus)
        process = router
        if role != "router":
            if role == "stubborn":
                bus.serve(bus.keys.rpc("test", "slow"), lambda *_: time.sleep(20) or b"")  # type: ignore[func-returns-value]
                wait_until_known(bus)
            process = Process(tmp_path, role, address)
            assert watch.wait_for({role: 1}, READY_S)
        time.sleep(0.2)
        begin = time.monotonic()
        process.signal(number)
        exit_code = process.wait()
        seconds = time.monotonic() - begin
        assert exit_code == 0, process.text()
        assert "Traceback" not in process.text()
        assert re.search(rf"INFO {role}/\S+ bus\.service: ended exit_code=0 asked=True\n$", process.text())
        # Part of the contract, with room for a busy machine.
        assert seconds < 2 * EXIT_LIMIT_S
        if role != "router":
            wait_until(lambda: not alive(watch, role))


def test_a_service_ends_also_when_its_router_is_frozen(tmp_path: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    with running(tmp_path, "router", address) as router, connect(address) as bus, running(
        tmp_path, "answer", address
    ) as process:  # fmt: skip
        assert ServiceWatch(bus).wait_for({"answer": 1}, READY_S)
        router.signal(signal.SIGSTOP)
        assert process.terminate() < 2 * EXIT_LIMIT_S
        assert process.process.returncode == 0
        router.signal(signal.SIGCONT)


def test_a_service_ends_also_when_its_router_is_gone(tmp_path: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    with running(tmp_path, "router", address) as router, connect(address) as bus, running(
        tmp_path, "answer", address
    ) as process:  # fmt: skip
        assert ServiceWatch(bus).wait_for({"answer": 1}, READY_S)
        router.kill()
        assert process.terminate() < 2 * EXIT_LIMIT_S
        assert process.process.returncode == 0


def test_a_service_without_a_router_says_so_in_its_last_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TEST_CONNECT_TIMEOUT_S", "1")
    address = f"tcp/127.0.0.1:{free_port()}"
    process = Process(tmp_path, "answer", address)
    assert process.wait() == 1
    assert process.text().splitlines()[-1] == f"vggt-motion: answer: no router at {address} within 1 s"
    assert "Traceback" not in process.text()


def test_a_service_can_be_stopped_while_it_waits_for_a_router(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TEST_CONNECT_TIMEOUT_S", "60")
    process = Process(tmp_path, "answer", f"tcp/127.0.0.1:{free_port()}")
    wait_until(lambda: process.handles(signal.SIGTERM))
    time.sleep(1.5)  # longer than one attempt to connect
    assert process.terminate() < 2 * EXIT_LIMIT_S
    assert "Traceback" not in process.text()


def test_a_second_router_on_the_endpoint_is_refused_with_exit_code_2(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    process = Process(tmp_path, "router", endpoint)
    assert process.wait() == 2
    assert process.text().splitlines()[-1] == f"vggt-motion: router: endpoint {endpoint} is already in use"
    assert "Traceback" not in process.text()
    assert bus.is_connected
