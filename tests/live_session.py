"""A session with real processes on loopback, started as users start them: ``vggt-motion serve NAME``."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml

from bus_processes import free_port
from ledger_processes import wait_until_ledger_is_served
from synthetic_session import Session
from vggt_motion.bus import codec
from vggt_motion.bus.ledger import LedgerClient
from vggt_motion.bus.liveliness import ServiceWatch
from vggt_motion.bus.session import Bus, open_bus
from vggt_motion.config import Config, load_config
from vggt_motion.records import HealthReport

PATIENCE_S = 60.0


def wait_for(condition: Callable[[], Any], what: str = "it", timeout_s: float = PATIENCE_S) -> Any:
    """The first truthy answer of a condition."""
    end = time.monotonic() + timeout_s
    while True:
        answer = condition()
        if answer:
            return answer
        assert time.monotonic() < end, f"{what} did not come about"
        time.sleep(0.02)


class Service:
    """One process of the session."""

    def __init__(self, name: str, arguments: list[str], log: Path) -> None:
        self.name = name
        self.log = log
        with log.open("ab") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "vggt_motion", "serve", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=file,
            )

    def stop(self) -> int:
        """SIGTERM; the exit code."""
        self.process.terminate()
        return self.process.wait(PATIENCE_S)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(PATIENCE_S)

    def text(self) -> str:
        return self.log.read_text(encoding="utf-8")


class LiveSession:
    """Router and ledger are up; other services are started by the test."""

    def __init__(self, folder: Path, **sections: dict[str, Any]) -> None:
        self.folder = folder
        settings: dict[str, Any] = {
            "bus": {"endpoint": f"tcp/127.0.0.1:{free_port()}", "session": "test"},
            "gateway": {"port": 0},
            "ledger": {"reserve_bytes": 0},
            **sections,
        }
        self.config_file = folder / "config.yaml"
        self.config_file.write_text(yaml.safe_dump(settings), encoding="utf-8")
        self.config: Config = load_config(self.config_file)
        self.services: list[Service] = []
        self.start("router")
        self.start("ledger", "--directory", str(folder / "ledger"))
        self.bus: Bus = open_bus(self.config.bus.model_copy(update={"connect_timeout_s": PATIENCE_S}))
        self.watch = ServiceWatch(self.bus)
        self.ledger = LedgerClient(self.bus)
        assert self.watch.wait_for({"ledger": 1}, PATIENCE_S)
        wait_until_ledger_is_served(self.bus)  # it is alive before that

    def start(self, name: str, *arguments: str) -> Service:
        log = self.folder / f"{name}.log"
        service = Service(name, [name, "--config", str(self.config_file), *arguments], log)
        self.services.append(service)
        return service

    def started(self, name: str, *arguments: str) -> Service:
        """Start a service and wait until it has reported for itself."""
        service = self.start(name, *arguments)
        wait_for(lambda: service.process.poll() is not None or self.report_of(service), f"{name}'s report")
        assert service.process.poll() is None, service.text()
        return service

    def report_of(self, service: Service) -> HealthReport | None:
        """Latest health of a process, by its id, which is part of its instance's name."""
        for (name, instance), report in self.watch.services().items():
            is_it = name == service.name and f"-{service.process.pid}-" in f"{instance}-"
            if is_it and report is not None and report.state != "starting":
                return report
        return None

    def append(self, session: Session, **options: Any) -> None:
        """Put the records of a synthetic session into the ledger, payloads with them."""
        for stream, _, record in session.entries(**options):
            blobs = [session.blobs[ref.sha256] for ref in codec.blob_refs(record)]
            record_id = _record_id(record)
            self.ledger.append(stream.value, record_id, record, blobs, patience_s=PATIENCE_S)  # type: ignore[arg-type]

    def close(self) -> None:
        self.watch.close()
        self.bus.close()
        for service in reversed(self.services):
            if service.process.poll() is None:
                service.process.kill()
                service.process.wait(PATIENCE_S)


@contextlib.contextmanager
def live_session(folder: Path, **sections: dict[str, Any]) -> Iterator[LiveSession]:
    session = LiveSession(folder, **sections)
    try:
        yield session
    finally:
        session.close()


def _record_id(record: Any) -> str:
    for name in ("record_id", "keyframe_id", "event_id"):
        if hasattr(record, name):
            return str(getattr(record, name))
    raise AssertionError(type(record))
