"""Who is there: liveliness tokens, and health once a second from a thread of Python's.

A token ends when the process or its link does; health shows that Python still runs in it. A process that hangs keeps
its token and falls silent.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence

from vggt_motion.bus import codec
from vggt_motion.bus.keys import service_of
from vggt_motion.bus.session import Bus, Closable, Sample
from vggt_motion.errors import BusError, CodecError
from vggt_motion.records import HealthReport

_log = logging.getLogger(__name__)
HEALTH_INTERVAL_S = 1.0
_SETTLE_S = 0.05  # a worker that is idle for a moment between two jobs, or works for one, need not say so
_JOIN_S = 0.5
_MAX_SERVICES = 4096


class Announcement:
    """A token and a stream of health reports."""

    def __init__(self, bus: Bus, service: str, instance: str, health: Callable[[], HealthReport]) -> None:
        self.is_closed = False
        self._health = health
        self._publisher = bus.publisher(
            bus.keys.health(service, instance), blocking=False, encoding=codec.encoding_of(HealthReport)
        )
        self._closing = threading.Event()
        self._changed = threading.Event()
        self._token = bus.declare_token(bus.keys.alive(service, instance))
        self._thread = threading.Thread(target=self._run, name="health", daemon=True)
        self._thread.start()

    def publish_soon(self) -> None:
        """Send a report soon: a change of state should not wait a second."""
        self._changed.set()

    def close(self) -> None:
        """Send a last report and take the token back."""
        if self.is_closed:
            return
        self.is_closed = True
        self._closing.set()
        self._changed.set()
        self._thread.join(_JOIN_S)
        self._token.close()
        self._publisher.close()

    def _run(self) -> None:
        while True:
            self._changed.clear()  # before we look: what is set from now on is seen next time
            is_last = self._closing.is_set()
            try:
                self._publisher.put(codec.encode(self._health()))
            except BusError as error:
                _log.warning("health not sent", extra={"reason": str(error)})
            if is_last:
                return
            if self._changed.wait(HEALTH_INTERVAL_S):
                self._closing.wait(_SETTLE_S)


def announce(bus: Bus, service: str, instance: str, health: Callable[[], HealthReport]) -> Announcement:
    """Say that this process is there, and once a second how it is.

    Args:
        bus: joined.
        service: "frontend", "ledger", ...
        instance: unique per process.
        health: called from a thread of ours; must not block.
    """
    return Announcement(bus, service, instance, health)


class ServiceWatch:
    """All services of the session that are alive, with what they last said of themselves.

    Reports come once a second from each and are asked for seldom: they are decoded when they are.
    """

    def __init__(self, bus: Bus, reports_of: Sequence[str] | None = None) -> None:
        """Start to watch.

        Args:
            bus: joined.
            reports_of: services whose reports are wanted; None: of all.
        """
        self._changed = threading.Condition()
        self._alive: set[tuple[str, str]] = set()
        # With the monotonic time of arrival.
        self._reports: dict[tuple[str, str], tuple[HealthReport, float]] = {}
        self._unread: dict[tuple[str, str], tuple[bytes, float]] = {}
        self._subscriptions: list[Closable] = [
            bus.watch_liveliness(bus.keys.all_alive(), self._on_token),
            *(
                bus.subscribe(key, self._on_health, is_small=True)
                for key in (
                    [bus.keys.all_health()]
                    if reports_of is None
                    else [bus.keys.all_health(service) for service in reports_of]
                )
            ),
        ]

    def services(self) -> dict[tuple[str, str], HealthReport | None]:
        """(service, instance) -> last report, None before the first one; sorted."""
        with self._changed:
            self._read()
            last = {name: report for name, (report, _) in self._reports.items()}
            return {name: last.get(name) for name in sorted(self._alive)}

    def newest_report(self, service: str) -> HealthReport | None:
        """The last report of any living instance of a service."""
        with self._changed:
            self._read(service)
            reports = [self._reports[name][0] for name in self._alive & self._reports.keys() if name[0] == service]
            return max(reports, key=lambda report: report.time_ns, default=None)

    def silence_s(self, service: str, instance: str) -> float | None:
        """Seconds since the last report arrived, by our clock; None if none did."""
        with self._changed:
            self._read(service)
            known = self._reports.get((service, instance))
            return None if known is None else time.monotonic() - known[1]

    def wait_for(self, names: Mapping[str, int], timeout_s: float) -> bool:
        """Wait until so many instances of each service are alive; False if some are still :meth:`missing`."""
        with self._changed:
            return bool(self._changed.wait_for(lambda: not self._missing(names), timeout_s))

    def wait_for_report(self, service: str, timeout_s: float) -> HealthReport | None:
        """The first report of any instance of a service, or None if none comes in time."""

        def newest() -> HealthReport | None:
            self._read(service)
            reports = [report for (name, _), (report, _) in self._reports.items() if name == service]
            return max(reports, key=lambda report: report.time_ns, default=None)

        with self._changed:
            return self._changed.wait_for(newest, timeout_s)

    def missing(self, names: Mapping[str, int]) -> dict[str, int]:
        """How many instances of each service are not there."""
        with self._changed:
            return self._missing(names)

    def close(self) -> None:
        """Stop watching."""
        for subscription in self._subscriptions:
            subscription.close()

    def _missing(self, names: Mapping[str, int]) -> dict[str, int]:
        alive = [service for service, _ in self._alive]
        return {name: count - alive.count(name) for name, count in names.items() if alive.count(name) < count}

    def _on_token(self, key: str, is_alive: bool) -> None:
        name = service_of(key)
        with self._changed:
            if not is_alive:
                self._alive.discard(name)
                self._reports.pop(name, None)
                self._unread.pop(name, None)
            elif len(self._alive) < _MAX_SERVICES:
                self._alive.add(name)
            self._changed.notify_all()

    def _on_health(self, sample: Sample) -> None:
        name = service_of(sample.key)
        with self._changed:
            # The token decides who is alive, but health may overtake it.
            if name in self._unread or len(self._unread) < _MAX_SERVICES:
                self._unread[name] = (sample.payload, time.monotonic())
            self._changed.notify_all()

    def _read(self, service: str | None = None) -> None:
        """Decode what has come since the last time, of one service or of all."""
        for name in [name for name in self._unread if service is None or name[0] == service]:
            payload, arrived_at = self._unread.pop(name)
            who = "/".join(name)
            try:
                report = codec.decode(HealthReport, payload)
            except CodecError as error:
                _log.warning("not a health report, passed over", extra={"of": who, "reason": str(error)})
                continue
            if (report.service, report.instance) != name:
                _log.warning("health under another's name, passed over", extra={"of": who})
                continue
            if len(self._reports) >= _MAX_SERVICES:
                # Reports that came after the end of their service's token must not keep out those of the living.
                self._reports = {known: kept for known, kept in self._reports.items() if known in self._alive}
            if name in self._reports or len(self._reports) < _MAX_SERVICES:
                self._reports[name] = (report, arrived_at)
