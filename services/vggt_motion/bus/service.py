"""The scaffold that every service shares: logging, bus, signals, liveliness, health, exit code (DESIGN section 4)."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import re
import secrets
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Literal

from vggt_motion.bus.jobs import JobClient, one_line
from vggt_motion.bus.ledger import LedgerClient
from vggt_motion.bus.liveliness import Announcement
from vggt_motion.bus.logs import set_up_logging
from vggt_motion.bus.session import Bus, open_bus
from vggt_motion.config import Config
from vggt_motion.errors import VggtMotionError
from vggt_motion.records import HealthReport

_log = logging.getLogger(__name__)
_INTERRUPT_AFTER_S = 0.5  # requests that are still under way so long after the signal are ended
_GIVE_UP_AFTER_S = 10.0  # a process never hangs at its exit
_DEFECT_EXIT_CODE = 1
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_SignalHandler = Callable[[int, FrameType | None], object] | int | signal.Handlers | None


class StopEvent(threading.Event):
    """Set once; then it also wakes up who waits for something else."""

    def __init__(self) -> None:
        """Not set."""
        super().__init__()
        self._wakers: list[Callable[[], None]] = []

    def set(self) -> None:
        """Set it, and call every waker."""
        super().set()
        for wake in tuple(self._wakers):
            wake()

    def wakes(self, wake: Callable[[], None]) -> None:
        """Call ``wake`` when it is set, or now if it is; from any thread, must not block."""
        self._wakers.append(wake)
        if self.is_set():
            wake()


class NumericsClock:
    """Processor seconds that threads of this process spend on numerics: the rest is the fabric's. Thread-safe.

    ``with clock:`` counts what the calling thread does, but for what it does in ``with clock.paused():``.
    """

    def __init__(self) -> None:
        """Nothing was counted yet."""
        self._lock = threading.Lock()
        self._begun = threading.local()
        self.cpu_s = 0.0

    def __enter__(self) -> None:
        self._begun.at_s = time.thread_time()

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self.cpu_s += time.thread_time() - self._begun.at_s

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Do not count this."""
        begun_s = time.thread_time()
        try:
            yield
        finally:
            with self._lock:
                self.cpu_s -= time.thread_time() - begun_s


class ServiceContext:
    """What a service works with."""

    def __init__(self, service: str, instance: str, config: Config, bus: Bus, stopping: StopEvent) -> None:
        """Join the parts; made by :func:`run_service`."""
        self.service = service
        self.instance = instance
        self.config = config
        self.bus = bus
        self.stopping = stopping
        self.ledger = LedgerClient(bus)
        self.jobs = JobClient(bus)
        self.numerics = NumericsClock()
        self._health = _Health(service, instance, self.numerics)
        self._announcement: Announcement | None = None

    @property
    def worker(self) -> str:
        """How the ledger knows this process: ``service/instance``, the end of its liveliness token's key."""
        return f"{self.service}/{self.instance}"

    def set_health(self, state: str, detail: str = "", **counters: float) -> None:
        """Say how the service is, from its own loop.

        Args:
            state: one word: "starting", "idle", "working", "waiting", "ended".
            detail: one line for a person.
            counters: name with its unit -> value; those not named stay as they were.
        """
        has_changed = self._health.update(state, one_line(detail), counters)
        if has_changed and self._announcement is not None:
            self._announcement.publish_soon()

    def set_counters(self, **counters: float) -> None:
        """Renew some counters; state and detail stay as they are. May be called from any thread."""
        self._health.count(counters)

    def announce(self) -> Announcement:
        """Declare the token and begin to send health; called by :func:`run_service`."""
        self._announcement = Announcement(self.bus, self.service, self.instance, self._health.report)
        return self._announcement


class _Health:
    def __init__(self, service: str, instance: str, numerics: NumericsClock) -> None:
        self._lock = threading.Lock()
        self._service, self._instance = service, instance
        self._numerics = numerics
        self._state, self._detail = "starting", ""
        self._counters: dict[str, float] = {}

    def count(self, counters: dict[str, float]) -> None:
        with self._lock:
            self._counters.update(counters)

    def update(self, state: str, detail: str, counters: dict[str, float]) -> bool:
        with self._lock:
            has_changed = state != self._state
            self._state, self._detail = state, detail
            self._counters.update(counters)
            return has_changed

    def report(self) -> HealthReport:
        cpu_s = max(0.0, self._numerics.cpu_s)
        with self._lock:
            return HealthReport(
                service=self._service,
                instance=self._instance,
                time_ns=time.time_ns(),
                state=self._state,
                detail=self._detail,
                resident_bytes=resident_bytes(),
                counters=self._counters | ({"numerics_cpu_s": cpu_s} if cpu_s else {}),
            )


def run_service(
    name: str,
    config: Config,
    body: Callable[[ServiceContext], None],
    *,
    instance: str | None = None,
    mode: Literal["client", "router"] = "client",
) -> int:
    """Run one service until its body returns.

    SIGTERM and SIGINT set ``context.stopping``; requests that are still under way half a second later are interrupted
    (BusUnavailableError), so that a body that looks at ``stopping`` is out in less than two seconds.

    Args:
        name: of the service.
        config: the whole tree.
        body: the work; returns when ``context.stopping`` is set, or when there is nothing left to do.
        instance: unique per process; made up if not given.
        mode: "router" for the router only.

    Returns:
        The exit code: 0, or that of the VggtMotionError that ended the body, whose message is the last line on standard
        error.
    """
    instance = instance or make_instance()
    set_up_logging(name, instance)
    stopping = StopEvent()
    bus: Bus | None = None
    failure = ""
    exit_code = 0
    with _Signals(stopping) as signals:
        try:
            bus = open_bus(config.bus, mode, stopping=stopping)
            signals.on_overdue(bus.interrupt)
            context = ServiceContext(name, instance, config, bus, stopping)
            with contextlib.closing(context.announce()):
                _log.info(
                    "started",
                    extra={"endpoint": config.bus.endpoint, "session": config.bus.session, "pid": os.getpid()},
                )
                body(context)
        except VggtMotionError as error:
            if not (stopping.is_set() and bus is not None and bus.is_interrupted):
                failure, exit_code = one_line(str(error)), error.exit_code
        except Exception as error:
            _log.exception("the service ends by a defect")
            failure, exit_code = one_line(f"{type(error).__name__}: {error}"), _DEFECT_EXIT_CODE
        finally:
            if bus is not None:
                bus.close()
        _log.info("ended", extra={"exit_code": exit_code, "asked": stopping.is_set()})
    if failure:
        sys.stderr.write(f"vggt-motion: {name}: {failure}\n")
        sys.stderr.flush()
    return exit_code


class _Signals:
    """SIGTERM and SIGINT set an event, whatever the main thread is doing at that moment.

    The interpreter runs signal handlers in the main thread only, and only between bytecodes; the wake-up descriptor is
    written by the C handler at once, and a thread of ours reads it.
    """

    def __init__(self, stopping: threading.Event) -> None:
        self._stopping = stopping
        self._overdue: Callable[[], None] = lambda: None
        self._is_done = threading.Event()
        self._previous: dict[int, _SignalHandler] = {}

    def on_overdue(self, action: Callable[[], None]) -> None:
        """What to do when the body does not return soon after a signal."""
        self._overdue = action

    def __enter__(self) -> _Signals:
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        if threading.current_thread() is threading.main_thread():
            self._previous_fd = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
            for number in (signal.SIGTERM, signal.SIGINT):
                self._previous[number] = signal.signal(number, lambda *_: None)
        threading.Thread(target=self._watch, name="signals", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_done.set()
        if self._previous:
            for number, handler in self._previous.items():
                signal.signal(number, handler)
            signal.set_wakeup_fd(self._previous_fd)
        self._writer.close()

    def _watch(self) -> None:
        while True:
            received = self._reader.recv(1)
            if not received:
                self._reader.close()
                return
            if received[0] in (signal.SIGTERM, signal.SIGINT):
                break
        _log.info("asked to stop", extra={"signal": signal.Signals(received[0]).name})
        self._stopping.set()
        if self._is_done.wait(_INTERRUPT_AFTER_S):
            return
        self._overdue()
        if not self._is_done.wait(_GIVE_UP_AFTER_S):
            _log.critical("did not end in time, ending at once", extra={"seconds": _GIVE_UP_AFTER_S})
            logging.shutdown()
            os._exit(_DEFECT_EXIT_CODE)


def make_instance() -> str:
    """A name for this process: host, process id and a random part, fit for a key."""
    host = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname().split(".")[0])[:24] or "host"
    return f"{host}-{os.getpid()}-{secrets.token_hex(2)}"


def resident_bytes() -> int:
    """Resident memory of this process; 0 where the system does not tell."""
    try:
        pages = int(os.pread(_memory_file(), 128, 0).split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * _PAGE_BYTES


@functools.cache
def _memory_file() -> int:
    return os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)
