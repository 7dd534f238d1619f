"""Real processes for the tests of the bus: run as ``python bus_processes.py ROLE ENDPOINT ...``."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from vggt_motion.bus import calls, codec, router
from vggt_motion.bus.keys import last_chunk
from vggt_motion.bus.service import ServiceContext, run_service
from vggt_motion.bus.serving import Handler
from vggt_motion.bus.session import Bus, Closable, open_bus
from vggt_motion.config import BusConfig, Config
from vggt_motion.errors import BusUnavailableError, DiskFullError, RefusalCode, RequestRefusedError
from vggt_motion.records import Event, EventKind, LogEntry

_log = logging.getLogger(__name__)
SESSION = "test"
READY_S = 60.0  # patience only: nothing waits longer than it has to
EXIT_LIMIT_S = 2.0  # the one limit in time that is part of a contract
THIS = Path(__file__)
_kept_ports: deque[socket.socket] = deque(maxlen=64)  # many more than one test asks for


def free_port() -> int:
    """A port that stays the test's own, also while nobody listens on it: before its router starts, and between two.

    The socket remains bound and never listens. A listener that sets SO_REUSEADDR, as Zenoh's and ours do, may join it;
    but the system gives the port to nobody who asks for any, nor to the near end of a connection, which could otherwise
    even be made to itself by whoever tries to reach a router that is not there yet.
    """
    keeper = socket.socket()
    keeper.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    keeper.bind(("127.0.0.1", 0))
    _kept_ports.append(keeper)
    return int(keeper.getsockname()[1])


def bus_config(endpoint: str, **changes: float) -> BusConfig:
    return BusConfig(endpoint=endpoint, session=SESSION, lease_s=4.0, **changes)


def event(number: int) -> Event:
    return Event(f"event-{number}", EventKind.WARNING, f"number {number}", number)


def entry(number: int) -> LogEntry:
    return LogEntry("event", number, f"event-{number}", codec.payload_type(Event), codec.encode(event(number)), number)


# --- starting and stopping -------------------------------------------------------------------------------------------
class Process:
    """One child; its standard error goes to a file, so that it never blocks."""

    def __init__(self, folder: Path, role: str, endpoint: str, *arguments: str, script: Path = THIS) -> None:
        self.log = folder / f"{role}-{time.monotonic_ns()}.log"
        with self.log.open("wb") as file:
            command = [sys.executable, str(script), role, endpoint, *arguments]
            self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, stderr=file)

    def wait(self, timeout_s: float = READY_S) -> int:
        return self.process.wait(timeout_s)

    def terminate(self) -> float:
        """SIGTERM; seconds until it has ended."""
        begin = time.monotonic()
        self.process.terminate()
        self.process.wait(30)
        return time.monotonic() - begin

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(10)

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def text(self) -> str:
        return self.log.read_text()

    def handles(self, number: signal.Signals) -> bool:
        """Whether it has set a handler for a signal: before that, the system ends it."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        caught = next(line for line in status.splitlines() if line.startswith("SigCgt:"))
        return bool(int(caught.split()[1], 16) >> (number - 1) & 1)


@contextlib.contextmanager
def running(folder: Path, role: str, endpoint: str, *arguments: str, script: Path = THIS) -> Iterator[Process]:
    process = Process(folder, role, endpoint, *arguments, script=script)
    try:
        yield process
    finally:
        if process.process.poll() is None:
            process.signal(signal.SIGCONT)
            process.kill()


def connect(endpoint: str, **changes: float) -> Bus:
    return open_bus(bus_config(endpoint, **{"connect_timeout_s": READY_S, **changes}))


def wait_until(condition: object, timeout_s: float = READY_S) -> None:
    end = time.monotonic() + timeout_s
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end, "did not come about in time"
        time.sleep(0.02)


# --- knowing of each other -------------------------------------------------------------------------------------------
# A declaration takes a moment to travel to the router and on to the others. A request that comes before it finds
# nobody, and what is published before it is dropped: services repeat and read what they lack, a test has to wait.
def wait_until_served(asker: Bus, *keys: str) -> None:
    """Return when requests from a session reach somebody who serves the keys."""
    for key in keys:
        querier = asker._session.declare_querier(key)
        wait_until(lambda querier=querier: querier.matching_status.matching)
        querier.undeclare()


def serve(server: Bus, key: str, handler: Handler, *, asker: Bus, threads: int = 1) -> Closable:
    """Serve a key, and return when requests of another session are answered."""
    served = server.serve(key, handler, threads=threads)
    wait_until_served(asker, key)
    return served


def wait_until_heard(sender: Bus, key: str) -> None:
    """Return when what a session publishes on a key reaches a subscriber."""
    _wait_until_subscribed(sender, key, wanted=True)


def wait_until_unheard(sender: Bus, key: str) -> None:
    """Return when a session knows that nobody subscribes to a key any more, so that it can wait for the next one."""
    _wait_until_subscribed(sender, key, wanted=False)


def _wait_until_subscribed(sender: Bus, key: str, *, wanted: bool) -> None:
    # A publisher beside the test's own: one with a history does not tell, and what a session knows is true for both.
    probe = sender._session.declare_publisher(key)
    wait_until(lambda: probe.matching_status.matching is wanted)
    probe.undeclare()


def wait_until_known(bus: Bus) -> None:
    """Return when the router knows all that a session has declared, and has all that it has published."""
    # The router takes messages of one link in turn: what came before this request has been dealt with.
    try:
        bus.request(bus.keys.rpc("test", "nobody_serves_this"), b"")
    except BusUnavailableError as error:
        if "nobody answers" not in str(error):
            raise


def answer_when_ready(bus: Bus, call: str, payload: bytes) -> bytes:
    """The answer of ``@rpc/test/{call}``, as soon as somebody gives one."""
    answers: list[bytes] = []

    def is_answered() -> bool:
        try:
            answers.append(bus.request(bus.keys.rpc("test", call), payload))
        except BusUnavailableError:
            return False
        return True

    wait_until(is_answered)
    return answers[0]


# --- roles -----------------------------------------------------------------------------------------------------------
def answer(context: ServiceContext) -> None:
    """Answers on @rpc/test/*: what the bus promises to carry."""
    release = threading.Event()

    def handler(key: str, payload: bytes) -> bytes:
        match last_chunk(key):
            case "echo":
                return payload
            case "conflict":
                raise RequestRefusedError("event-1 is known with another content", RefusalCode.CONFLICT)
            case "full":
                raise DiskFullError("12 MB are left,\nthe reserve is 256 MB")
            case "defect":
                raise ZeroDivisionError("secret detail")
            case "slow":
                release.wait(30)
                return b"late"
        raise RequestRefusedError("unknown call", RefusalCode.UNKNOWN)

    # Declarations arrive in order: whoever hears the echo finds the others too.
    context.bus.serve(context.bus.keys.rpc("test", "slow"), handler, threads=2)
    for call in ("conflict", "full", "defect", "echo"):
        context.bus.serve(context.bus.keys.rpc("test", call), handler)
    context.set_health("working", "answering", requests=1.0)
    context.stopping.wait()


def small_ledger(context: ServiceContext, count: int, interval_s: float) -> None:
    """A log in memory, of which the live publications of every fifth record are left out."""
    records = [entry(number) for number in range(count)]
    visible = 0

    def read(_: str, payload: bytes) -> bytes:
        request = codec.decode(calls.ReadRequest, payload)
        page = records[request.from_sequence : min(visible, request.from_sequence + 7)]
        return codec.encode(calls.ReadReply(tuple(page), visible))

    context.bus.serve(context.bus.keys.rpc("ledger", "read"), read)
    publisher = context.bus.publisher(context.bus.keys.log("event"), blocking=True, history=16)
    context.set_health("working", "publishing")
    for number, record in enumerate(records):
        if context.stopping.wait(interval_s):
            return
        visible = number + 1
        if number % 5 != 3:
            publisher.put(codec.encode(record))
    context.set_health("idle", "all published")
    context.stopping.wait()


def stubborn(context: ServiceContext) -> None:
    """Waits in a request that nobody will answer, in the main thread."""
    context.set_health("waiting", "for an answer")
    with contextlib.suppress(BusUnavailableError):
        context.bus.request(context.bus.keys.rpc("test", "slow"), b"", timeout_s=60.0)


def busy(context: ServiceContext) -> None:
    """Publishes and follows for all it is worth until it is told to stop."""
    publisher = context.bus.publisher(context.bus.keys.image("front"), blocking=False, history=2)
    context.bus.subscribe(context.bus.keys.all_images(), lambda _: None, latest_only=True)
    context.set_health("working")
    while not context.stopping.is_set():
        publisher.put(bytes(200_000))


def main(arguments: list[str]) -> int:
    role, endpoint, *rest = arguments
    config = Config(bus=bus_config(endpoint, connect_timeout_s=float(os.environ.get("TEST_CONNECT_TIMEOUT_S", "20"))))
    match role:
        case "router":
            return router.main(config)
        case "answer":
            return run_service("answer", config, answer, instance=rest[0] if rest else None)
        case "ledger":
            return run_service("ledger", config, lambda context: small_ledger(context, int(rest[0]), float(rest[1])))
        case "stubborn":
            return run_service("stubborn", config, stubborn)
        case "busy":
            return run_service("busy", config, busy)
    raise SystemExit(f"unknown role {role}")


def leave(code: int) -> NoReturn:
    """End as the command does: Zenoh's own threads may abort an interpreter that winds down."""
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    leave(main(sys.argv[1:]))
