"""Requests over a real router: answers, refusals, silence, many at once, and stopping."""

from __future__ import annotations

import functools
import gc
import threading
import time
import weakref
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import zenoh

from bus_processes import (
    answer_when_ready,
    bus_config,
    connect,
    free_port,
    running,
    serve,
    wait_until,
    wait_until_heard,
    wait_until_served,
)
from vggt_motion.bus import calls, codec
from vggt_motion.bus.serving import BUNDLE_ENCODING
from vggt_motion.bus.session import Bus, EndpointTakenError, open_bus, zenoh_config
from vggt_motion.errors import (
    BusError,
    BusUnavailableError,
    CodecError,
    ConfigurationError,
    DiskFullError,
    RefusalCode,
    RequestRefusedError,
)


def echo_when_ready(bus: Bus, payload: bytes = b"") -> bytes:
    return answer_when_ready(bus, "echo", payload)


def test_answers_and_refusals_come_back_as_what_they_are(bus: Bus, endpoint: str, tmp_path: Path) -> None:
    with running(tmp_path, "answer", endpoint):
        assert echo_when_ready(bus) == b""
        for payload in (b"x", bytes(range(256)) * 4000, bytes(20_000_000)):
            assert bus.request(bus.keys.rpc("test", "echo"), payload) == payload
        with pytest.raises(RequestRefusedError, match="known with another content") as refused:
            bus.request(bus.keys.rpc("test", "conflict"), b"")
        assert refused.value.code is RefusalCode.CONFLICT
        with pytest.raises(DiskFullError, match="12 MB are left, the reserve is 256 MB"):
            bus.request(bus.keys.rpc("test", "full"), b"")
        with pytest.raises(RequestRefusedError, match=r"^internal error: ZeroDivisionError$") as defect:
            bus.request(bus.keys.rpc("test", "defect"), b"")
        assert defect.value.code is RefusalCode.INTERNAL
        assert bus.request(bus.keys.rpc("test", "echo"), b"still here") == b"still here"


either_way = pytest.mark.parametrize("is_long_poll", [False, True])


@either_way
def test_no_reply_is_a_failure(bus: Bus, is_long_poll: bool) -> None:
    with pytest.raises(BusUnavailableError, match="nobody answers"):
        bus.request(bus.keys.rpc("test", "nothing"), b"", is_long_poll=is_long_poll)


@either_way
def test_a_slow_answer_times_out(bus: Bus, endpoint: str, tmp_path: Path, is_long_poll: bool) -> None:
    with running(tmp_path, "answer", endpoint):
        echo_when_ready(bus)
        assert bus.request(bus.keys.rpc("test", "echo"), b"x", is_long_poll=is_long_poll) == b"x"
        with pytest.raises(BusUnavailableError, match=r"no answer within 0\.3 s"):
            bus.request(bus.keys.rpc("test", "slow"), b"", timeout_s=0.3, is_long_poll=is_long_poll)


@either_way
def test_an_answerer_that_is_killed_ends_the_request(
    bus: Bus, endpoint: str, tmp_path: Path, is_long_poll: bool
) -> None:
    with running(tmp_path, "answer", endpoint) as answerer:
        echo_when_ready(bus)
        timer = threading.Timer(0.3, answerer.kill)
        timer.start()
        with pytest.raises(BusUnavailableError, match="nobody answers"):
            bus.request(bus.keys.rpc("test", "slow"), b"", timeout_s=60.0, is_long_poll=is_long_poll)
        timer.join()


def test_waiting_requests_do_not_hold_up_others(endpoint: str) -> None:
    release = threading.Event()
    begun: list[str] = []

    def wait(key: str, _: bytes) -> bytes:
        begun.append(key)
        return b"late" if release.wait(30) else b""

    with connect(endpoint) as server, connect(endpoint) as client:
        serve(server, server.keys.rpc("test", "wait"), wait, asker=client, threads=32)
        serve(server, server.keys.rpc("test", "echo"), lambda _, payload: payload, asker=client)
        with ThreadPoolExecutor(32) as pool:
            waiting = [pool.submit(client.request, client.keys.rpc("test", "wait"), b"") for _ in range(32)]
            wait_until(lambda: len(begun) == 32)
            assert client.request(client.keys.rpc("test", "echo"), b"now") == b"now"
            assert not any(future.done() for future in waiting)
            release.set()
            assert [future.result(30) for future in waiting] == [b"late"] * 32


def test_more_requests_than_threads_are_all_answered_each_once(endpoint: str) -> None:
    seen: list[bytes] = []
    with connect(endpoint) as server, connect(endpoint) as client:

        def handler(_: str, payload: bytes) -> bytes:
            time.sleep(0.002)
            seen.append(payload)
            return payload

        serve(server, server.keys.rpc("test", "echo"), handler, asker=client, threads=3)
        payloads = [f"{number}".encode() * 1000 for number in range(300)]
        with ThreadPoolExecutor(64) as pool:
            answers = list(pool.map(lambda payload: client.request(client.keys.rpc("test", "echo"), payload), payloads))
    assert answers == payloads
    assert sorted(seen) == sorted(payloads)


def test_at_most_so_many_handlers_run_at_a_time_and_never_in_zenohs_threads(endpoint: str) -> None:
    names: set[str] = set()
    at_work: list[int] = []
    counts: list[int] = []
    are_four = threading.Event()
    with connect(endpoint) as server, connect(endpoint) as client:

        def handler(_: str, payload: bytes) -> bytes:
            names.add(threading.current_thread().name)
            at_work.append(1)
            counts.append(len(at_work))
            if len(at_work) == 4:
                are_four.set()
            are_four.wait(30)  # however slowly they come, the first four are there together
            time.sleep(0.01)  # time for a fifth
            at_work.pop()
            return payload

        key = server.keys.rpc("test", "echo")
        serve(server, key, handler, asker=client, threads=4)
        with ThreadPoolExecutor(16) as pool:
            list(pool.map(lambda _: client.request(key, b""), range(64)))
    assert max(counts) == 4 and names == {f"serve {key}"}


def test_what_comes_while_others_are_answered_is_answered_together_and_each_for_itself(endpoint: str) -> None:
    release = threading.Event()
    batches: list[list[bytes]] = []

    def handler(payloads: Sequence[bytes]) -> list[bytes | Exception]:
        batches.append(list(payloads))
        if payloads == [b"first"]:
            assert release.wait(30)
        return [RequestRefusedError("odd") if payload == b"odd" else payload for payload in payloads]

    with connect(endpoint) as server, connect(endpoint) as client:
        key = server.keys.rpc("test", "together")
        served = server.serve_together(key, handler, at_a_time=8)
        wait_until_served(client, key)
        with ThreadPoolExecutor(32) as pool:
            first = pool.submit(client.request, key, b"first")
            wait_until(lambda: bool(batches))
            others = [pool.submit(client.request, key, b"even" if index % 2 else b"odd") for index in range(20)]
            wait_until(lambda: len(served._waiting) == 20)  # type: ignore[attr-defined]
            assert not any(future.done() for future in others)
            release.set()
            assert first.result(30) == b"first"
            for index, future in enumerate(others):
                if index % 2:
                    assert future.result(30) == b"even"
                else:
                    with pytest.raises(RequestRefusedError, match="odd"):
                        future.result(30)
    assert sum(map(len, batches)) == 21 and max(map(len, batches)) == 8


def test_a_batch_ends_before_it_grows_too_large_and_a_defect_refuses_all_of_it(endpoint: str) -> None:
    release = threading.Event()
    batches: list[int] = []

    def handler(payloads: Sequence[bytes]) -> list[bytes | Exception]:
        batches.append(sum(map(len, payloads)))
        assert release.wait(30)
        raise ValueError("a defect")

    with connect(endpoint) as server, connect(endpoint) as client:
        key = server.keys.rpc("test", "together")
        served = server.serve_together(key, handler, at_a_time=64)
        wait_until_served(client, key)
        with ThreadPoolExecutor(8) as pool:
            asked = [pool.submit(client.request, key, bytes(12 * 2**20)) for _ in range(6)]
            wait_until(lambda: len(served._waiting) == 5)  # type: ignore[attr-defined]
            release.set()
            for future in asked:
                with pytest.raises(RequestRefusedError, match="internal error: ValueError"):
                    future.result(30)
    assert sum(batches) == 72 * 2**20 and max(batches) <= 32 * 2**20


class Content:
    """What a handler makes of a request."""


@pytest.mark.parametrize("is_together", [False, True])
def test_what_a_refused_request_took_in_memory_is_let_go_at_once(endpoint: str, is_together: bool) -> None:
    contents: weakref.WeakSet[Content] = weakref.WeakSet()

    def handler(_: str, payload: bytes) -> bytes:
        content = Content()
        contents.add(content)
        try:
            raise ValueError(payload)
        except ValueError as error:
            raise CodecError(f"{content} cannot be read") from error

    def why_not(payload: bytes) -> Exception:
        try:
            handler("", payload)
        except CodecError as error:
            return error
        raise AssertionError

    def handler_of_many(payloads: Sequence[bytes]) -> list[bytes | Exception]:
        outcomes = [why_not(payload) for payload in payloads]  # each leads to this frame, and the frame to each
        return list(outcomes)

    with connect(endpoint) as server, connect(endpoint) as client:
        key = server.keys.rpc("test", "refuse")
        if is_together:
            server.serve_together(key, handler_of_many, at_a_time=8)
            wait_until_served(client, key)
        else:
            serve(server, key, handler, asker=client)
        gc.collect()
        gc.disable()
        try:
            with pytest.raises(RequestRefusedError, match="cannot be read"):
                client.request(key, b"")
            wait_until(lambda: not contents, 10.0)
        finally:
            gc.enable()


def test_what_is_longer_than_all_that_may_wait_is_for_the_handler_to_refuse(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vggt_motion.bus.serving._MAX_PENDING_BYTES", 1000)
    release = threading.Event()

    def handler(_: str, payload: bytes) -> bytes:
        if payload == b"wait":
            assert release.wait(30)
            return b""
        raise CodecError(f"{len(payload)} bytes are more than the allowed 500")

    with connect(endpoint) as server, connect(endpoint) as client, ThreadPoolExecutor(1) as pool:
        key = server.keys.rpc("test", "measure")
        served = serve(server, key, handler, asker=client)
        with pytest.raises(RequestRefusedError, match="1001 bytes are more than the allowed 500"):
            client.request(key, bytes(1001))
        wait_until(lambda: served._held_bytes == 0)  # type: ignore[attr-defined]
        waiting = pool.submit(client.request, key, b"wait")
        wait_until(lambda: served._held_bytes == 4)  # type: ignore[attr-defined]
        with pytest.raises(BusUnavailableError, match="overloaded, try again later"):
            client.request(key, bytes(1001))
        release.set()
        assert waiting.result(30) == b""


def test_what_one_client_asks_at_a_time_travels_together_and_each_gets_its_own(endpoint: str) -> None:
    release = threading.Event()
    batches: list[list[bytes]] = []
    answered: list[int] = []

    def handler(payloads: Sequence[bytes | memoryview]) -> list[bytes | Exception]:
        batches.append([bytes(payload) for payload in payloads])
        if batches == [[b"first"]]:
            assert release.wait(30)
        return [RequestRefusedError("odd", RefusalCode.CONFLICT) if p == b"odd" else bytes(p) for p in payloads]

    def taken_in() -> int:
        return len(client._gatherings[key]._waiting)

    with connect(endpoint) as server, connect(endpoint) as client:
        key = server.keys.rpc("test", "together")
        server.serve_together(key, handler, at_a_time=8, after=lambda: answered.append(len(batches)))
        wait_until_served(client, key)
        long = bytes(3_000_000)
        with ThreadPoolExecutor(128) as pool:
            asked = [pool.submit(client.request_among_others, key, b"first")]
            wait_until(lambda: bool(batches))
            asked += [pool.submit(client.request_among_others, key, b"second")]  # the other lane
            wait_until(lambda: client._gatherings[key]._busy_lanes == 2)
            kinds = [b"odd", b"even", b"x" * 100_000]
            asked += [pool.submit(client.request_among_others, key, kinds[number % 3]) for number in range(90)]
            wait_until(lambda: taken_in() == 90)
            alone = pool.submit(client.request_among_others, key, long)
            release.set()
            assert alone.result(30) == long
            for number, future in enumerate(asked[2:]):
                if number % 3 == 0:
                    with pytest.raises(RequestRefusedError, match="odd") as refused:
                        future.result(30)
                    assert refused.value.code is RefusalCode.CONFLICT
                else:
                    assert future.result(30) == kinds[number % 3]
            assert [future.result(30) for future in asked[:2]] == [b"first", b"second"]
    sizes = [len(batch) for batch in batches]
    assert sum(sizes) == 93 and max(sizes) >= 64, "one message may hold 64"
    assert len(answered) == len(batches)


def test_a_bundle_that_is_none_is_one_request_and_a_defect_refuses_all_of_a_bundle(endpoint: str) -> None:
    came: list[list[bytes]] = []

    def handler(payloads: Sequence[bytes | memoryview]) -> list[bytes | Exception]:
        came.append([bytes(payload) for payload in payloads])
        raise ValueError("a defect")

    with connect(endpoint) as server, connect(endpoint) as client:
        key = server.keys.rpc("test", "together")
        server.serve_together(key, handler, at_a_time=8)
        wait_until_served(client, key)
        broken = [b"", b"\xff" * 20, codec.encode(calls.Bundle((b"a",)))[:-1]]
        for payload in broken:
            with pytest.raises(RequestRefusedError, match="ValueError"):
                client.request(key, payload, encoding=BUNDLE_ENCODING)
        assert came == [[payload] for payload in broken]
        bundle = codec.encode(calls.Bundle((b"a", b"b")))
        reply = codec.decode(calls.BundleReply, client.request(key, bundle, encoding=BUNDLE_ENCODING))
        assert [answer.refusal and answer.refusal.code for answer in reply.answers] == [RefusalCode.INTERNAL] * 2
        assert came[-1] == [b"a", b"b"]


def test_an_interrupted_process_does_not_wait_for_what_gathers(endpoint: str) -> None:
    with connect(endpoint) as server, connect(endpoint) as client:
        key = server.keys.rpc("test", "together")
        release = threading.Event()

        def handler(payloads: Sequence[bytes | memoryview]) -> list[bytes | Exception]:
            release.wait(30)
            return [b""] * len(payloads)

        server.serve_together(key, handler, at_a_time=8)
        wait_until_served(client, key)
        with ThreadPoolExecutor(16) as pool:
            asked = [pool.submit(client.request_among_others, key, b"x") for _ in range(16)]
            wait_until(lambda: len(client._gatherings) == 1 and len(client._gatherings[key]._waiting) == 14)
            client.interrupt()
            for future in asked:
                with pytest.raises(BusUnavailableError):
                    future.result(10)
        release.set()


def test_a_wildcard_request_is_refused(endpoint: str) -> None:
    with connect(endpoint) as server, connect(endpoint) as client:
        serve(server, server.keys.all_blobs(), lambda *_: b"content", asker=client)
        assert client.request(client.keys.blob("ab" * 32), b"") == b"content"
        with pytest.raises(RequestRefusedError, match="without wildcards"):
            client.request(client.keys.all_blobs(), b"")


def test_closing_a_server_refuses_what_waits_and_frees_the_key(endpoint: str) -> None:
    release, has_begun = threading.Event(), threading.Event()

    def wait(*_: object) -> bytes:
        has_begun.set()
        return b"first" if release.wait(30) else b""

    with connect(endpoint) as server, connect(endpoint) as client:
        key = server.keys.rpc("test", "wait")
        served = serve(server, key, wait, asker=client)
        with ThreadPoolExecutor(2) as pool:
            first, second = (pool.submit(client.request, key, b"") for _ in range(2))
            # One is being answered, the other one waits its turn.
            wait_until(lambda: has_begun.is_set() and len(served._waiting) == 1)  # type: ignore[attr-defined]
            threading.Timer(0.2, release.set).start()
            served.close()
            outcomes = [future.exception(30) or future.result() for future in (first, second)]
        assert b"first" in outcomes
        assert any(isinstance(outcome, BusUnavailableError) and "stopping" in str(outcome) for outcome in outcomes)
        with pytest.raises(BusUnavailableError, match="nobody answers"):
            client.request(key, b"")
        serve(server, key, lambda *_: b"second", asker=client)
        assert client.request(key, b"") == b"second"


def test_leaving_does_not_wait_for_handlers_that_do_not_end_and_flushes_all_the_same(endpoint: str) -> None:
    release = threading.Event()
    got: list[bytes] = []
    with connect(endpoint) as client, connect(endpoint) as server, ThreadPoolExecutor(6) as pool:
        client.subscribe(client.keys.all_images(), lambda sample: got.append(sample.payload[:4]))
        keys = [server.keys.rpc("test", f"wait-{number}") for number in range(6)]
        begun: list[str] = []

        def wait(key: str, _: bytes) -> bytes:
            begun.append(key)
            return b"late" if release.wait(60) else b""

        for key in keys:
            serve(server, key, wait, asker=client)
        pending = [pool.submit(client.request, key, b"") for key in keys]
        publisher = server.publisher(server.keys.image("front"), blocking=True)
        wait_until_heard(server, server.keys.image("front"))
        wait_until(lambda: len(begun) == len(keys))
        for number in range(20):
            publisher.put(f"{number:04d}".encode() + bytes(1_000_000))
        server.close()
        assert not release.is_set()
        assert all(isinstance(future.exception(30), BusUnavailableError) for future in pending)
        release.set()
        wait_until(lambda: b"0019" in got)
        assert got[-20:] == [f"{number:04d}".encode() for number in range(20)]


@either_way
def test_interrupt_ends_requests_under_way_and_refuses_new_ones(
    bus: Bus, endpoint: str, tmp_path: Path, is_long_poll: bool
) -> None:
    slow = functools.partial(bus.request, bus.keys.rpc("test", "slow"), b"", timeout_s=60.0, is_long_poll=is_long_poll)
    with running(tmp_path, "answer", endpoint):
        echo_when_ready(bus)
        with ThreadPoolExecutor(4) as pool:
            pending = [pool.submit(slow) for _ in range(4)]
            time.sleep(0.3)
            bus.interrupt()
            for future in pending:
                with pytest.raises(BusUnavailableError, match="stopping"):
                    future.result(10)
        with pytest.raises(BusUnavailableError, match="stopping"):
            bus.request(bus.keys.rpc("test", "echo"), b"")


def test_requests_work_again_after_the_router_was_replaced(tmp_path: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    with running(tmp_path, "router", address) as first, connect(address) as bus, running(tmp_path, "answer", address):
        assert echo_when_ready(bus, b"before") == b"before"
        assert bus.is_connected
        first.kill()
        wait_until(lambda: not bus.is_connected)
        with pytest.raises(BusUnavailableError):
            bus.request(bus.keys.rpc("test", "echo"), b"")
        time.sleep(1.5)  # longer than one attempt to connect
        with running(tmp_path, "router", address):
            assert echo_when_ready(bus, b"after") == b"after"


def test_no_router_is_one_clear_line(tmp_path: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(BusUnavailableError, match=rf"^no router at {address} within 1\.5 s$"):
        open_bus(bus_config(address, connect_timeout_s=1.5))


def test_waiting_for_a_router_can_be_stopped() -> None:
    stopping = threading.Event()
    threading.Timer(0.3, stopping.set).start()
    begin = time.monotonic()
    with pytest.raises(BusUnavailableError, match="stopped while waiting"):
        open_bus(bus_config(f"tcp/127.0.0.1:{free_port()}", connect_timeout_s=60.0), stopping=stopping)
    assert time.monotonic() - begin < 30.0


@pytest.mark.parametrize("address", ["nonsense", "tcp/", "tcp/nowhere", "carrier-pigeon/127.0.0.1:1"])
def test_an_endpoint_that_makes_no_sense_is_a_configuration_error(address: str) -> None:
    with pytest.raises((ConfigurationError, BusUnavailableError)) as problem:
        open_bus(bus_config(address, connect_timeout_s=0.5))
    assert address in str(problem.value)
    assert "\n" not in str(problem.value)


def test_a_taken_endpoint_is_one_clear_line(endpoint: str, bus: Bus) -> None:
    with pytest.raises(EndpointTakenError, match=rf"^endpoint {endpoint} is already in use$"):
        open_bus(bus_config(endpoint), mode="router")


def test_our_settings_win_over_the_users_file(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(
        '{mode: "peer", scouting: {multicast: {enabled: true}}, '
        'transport: {auth: {usrpwd: {user: "u", password: "p"}}}}'
    )
    config = bus_config("tcp/127.0.0.1:7447").model_copy(update={"zenoh_config": file})
    merged = zenoh_config(config)
    assert isinstance(merged, zenoh.Config)
    assert merged.get_json("mode") == '"client"'
    assert merged.get_json("scouting/multicast/enabled") == "false"
    assert merged.get_json("scouting/gossip/enabled") == "false"
    assert merged.get_json("transport/shared_memory/enabled") == "false"
    assert merged.get_json("transport/link/tx/lease") == "4000"
    assert merged.get_json("transport/link/tx/keep_alive") == "2"
    assert merged.get_json("transport/auth/usrpwd/user") == '"u"'
    file.write_text("{no json5")
    with pytest.raises(ConfigurationError, match=r"zenoh\.json5: not accepted by Zenoh"):
        zenoh_config(config)


def test_a_message_that_zenoh_would_drop_without_a_word_is_refused(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vggt_motion.bus.session.MAX_PAYLOAD_BYTES", 1000)
    monkeypatch.setattr("vggt_motion.bus.pubsub.MAX_PAYLOAD_BYTES", 1000)
    with pytest.raises(BusError, match="1001 bytes is longer than the bus carries"):
        bus.request(bus.keys.rpc("test", "echo"), bytes(1001))
    with pytest.raises(BusError, match="1001 bytes is longer than the bus carries"):
        bus.publisher(bus.keys.image("front"), blocking=False).put(bytes(1001))
