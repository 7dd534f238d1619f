"""Real processes for the tests of the ledger: run as ``python ledger_processes.py ROLE ...``; and what starts them."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bus_processes import READY_S, SESSION, connect, free_port, leave, wait_until, wait_until_served
from vggt_motion.bus import codec, router
from vggt_motion.bus.jobs import JobClient
from vggt_motion.bus.ledger import LedgerClient
from vggt_motion.bus.service import ServiceContext, run_service
from vggt_motion.bus.session import Bus
from vggt_motion.config import Config, load_config
from vggt_motion.errors import BusUnavailableError
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.ledger import service
from vggt_motion.ledger.admission import admitted
from vggt_motion.ledger.directory import Ledger
from vggt_motion.records import (
    BlobRef,
    Event,
    EventKind,
    FrameGeometry,
    Job,
    JobKind,
    Keyframe,
    LedgerStatus,
    MotionState,
    ScaleKind,
    SubmapGeometry,
    SubmapQuality,
    SubmapSpec,
    SubmapVerdict,
)

IMAGE_TYPE = "image/jpeg"
CALLS = {
    "ledger": ("append", "read", "status"),
    "jobs": ("submit", "claim", "heartbeat", "done", "fail", "reports", "cancel"),
}


def wait_until_ledger_is_served(bus: Bus) -> None:
    """Return when a session reaches every call of a ledger: they are declared one after the other."""
    client = LedgerClient(bus)

    def is_answered() -> bool:
        try:
            client.status()
        except BusUnavailableError:
            return False
        return True

    wait_until(is_answered)
    wait_until_served(
        bus, bus.keys.all_blobs(), *(bus.keys.rpc(service, call) for service, calls in CALLS.items() for call in calls)
    )


# --- records ---------------------------------------------------------------------------------------------------------
def event(number: int, prefix: str = "event") -> Event:
    return Event(f"{prefix}-{number}", EventKind.WARNING, f"number {number}", number)


def keyframe(number: int, image: bytes) -> Keyframe:
    ref = codec.blob_ref(image, IMAGE_TYPE)
    return Keyframe("front", 0, number, number, MotionState.LINEAR, 64, 48, ref)


def depth_blob(seed: int, width: int = 40, height: int = 30) -> bytes:
    random = np.random.default_rng(seed)
    depth = random.uniform(1.0, 50.0, (height, width)).astype(np.float32)
    return codec.encode_depth(depth, random.uniform(0.0, 1.0, (height, width)).astype(np.float32))


def submap(index: int, depth: bytes, seconds: float = 1.0, *, shape: tuple[int, int] = (40, 30)) -> SubmapGeometry:
    """A result of a predict job: the same content for the same index, but for the time that it took."""
    name = f"front/0/{index:08d}"
    ref = BlobRef(codec.blob_ref(depth, codec.DEPTH_MEDIA_TYPE).sha256, len(depth), codec.DEPTH_MEDIA_TYPE)
    intrinsics = Intrinsics(fx=30.0, fy=30.0, cx=20.0, cy=15.0, width_px=shape[0], height_px=shape[1])
    return SubmapGeometry(
        spec=SubmapSpec(index, 1, (), (name,)),
        verdict=SubmapVerdict.GOOD,
        reason="",
        scale_kind=ScaleKind.RELATIVE,
        model="test",
        frames=(FrameGeometry(name, intrinsics, np.eye(4), ref),),
        quality=SubmapQuality(1, 0.3, 0.9, 2.0, 0.75, 0.01),
        stage_seconds={"all": seconds},
    )


def predict(index: int) -> Job:
    spec = SubmapSpec(index, 1, (), (f"front/0/{index:08d}",))
    return Job(f"submap/{index:06d}/r1", JobKind.PREDICT, codec.encode(spec), codec.payload_type(SubmapSpec))


# --- starting and stopping -------------------------------------------------------------------------------------------
class Process:
    """One child; its standard error goes to a file, so that it never blocks."""

    counter = itertools.count()

    def __init__(self, folder: Path, role: str, *arguments: str) -> None:
        self.log = folder / f"{role}-{next(self.counter)}.log"
        with self.log.open("wb") as file:
            command = [sys.executable, __file__, role, *arguments]
            self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, stderr=file)

    def send(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(10)

    def end(self) -> None:
        if self.process.poll() is None:
            self.send(signal.SIGCONT)
            self.kill()

    def terminate(self) -> float:
        """SIGTERM; seconds until it has ended."""
        begin = time.monotonic()
        self.process.terminate()
        self.process.wait(30)
        return time.monotonic() - begin

    def text(self) -> str:
        return self.log.read_text()


class Site:
    """A router and a ledger, which can be killed and started again, and clients of them."""

    def __init__(self, folder: Path, *assignments: str, directory: Path | None = None) -> None:
        self.folder = folder
        self.directory = directory or folder / "session"
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.assignments = (f"bus.session={SESSION}", f"bus.endpoint={self.endpoint}", *assignments)
        self._stack = contextlib.ExitStack()
        self.router = self.start("router")
        self.ledger = self.start_ledger()
        self.bus = self.connect()
        self.wait_until_ready()

    def start(self, role: str, *arguments: str) -> Process:
        process = Process(self.folder, role, "|".join(self.assignments), *arguments)
        self._stack.callback(process.end)
        return process

    def start_ledger(self) -> Process:
        return self.start("ledger", str(self.directory))

    def start_again(self, name: str) -> None:
        """SIGKILL and a new process in its place."""
        getattr(self, name).kill()
        setattr(self, name, self.start_ledger() if name == "ledger" else self.start("router"))

    def connect(self, **changes: float) -> Bus:
        bus = connect(self.endpoint, **changes)
        self._stack.callback(bus.close)
        return bus

    def client(self) -> LedgerClient:
        return LedgerClient(self.bus)

    def jobs(self) -> JobClient:
        return JobClient(self.bus)

    def status(self) -> LedgerStatus:
        return LedgerClient(self.bus).status()

    def wait_until_ready(self) -> None:
        wait_until_ledger_is_served(self.bus)

    def job_state(self, job_id: str) -> str:
        return next(report.state.value for report in self.jobs().reports() if report.job_id == job_id)

    def opened(self) -> Ledger:
        """The session itself, after its ledger has gone."""
        ledger = service.open_session(self.directory, Config().ledger)
        self._stack.callback(ledger.close)
        return ledger

    def close(self) -> None:
        self._stack.close()


@contextlib.contextmanager
def site(folder: Path, *assignments: str, directory: Path | None = None) -> Iterator[Site]:
    opened = Site(folder, *assignments, directory=directory)
    try:
        yield opened
    finally:
        opened.close()


# --- roles -----------------------------------------------------------------------------------------------------------
def worker(context: ServiceContext, seconds: float, start: Path | None = None) -> None:
    """Does predict jobs: sleeps with heartbeats, then delivers; the seconds count from when ``start`` exists."""
    while not context.stopping.is_set():
        try:
            lease = context.jobs.claim([JobKind.PREDICT], ["test"], context.worker, 1.0)
        except BusUnavailableError:
            context.stopping.wait(0.1)
            continue
        if lease is None:
            continue
        index = codec.decode(SubmapSpec, lease.job.payload).submap_index
        sys.stdout.write(f"lease {lease.job.job_id} {lease.attempt}\n")
        sys.stdout.flush()
        end: float | None = None
        while not context.stopping.wait(0.1):
            if end is None and (start is None or start.exists()):
                end = time.monotonic() + seconds
            if end is not None and time.monotonic() >= end:
                break
            with contextlib.suppress(BusUnavailableError):
                if not context.jobs.heartbeat(lease.lease_id):
                    break
        depth = depth_blob(index)
        with contextlib.suppress(BusUnavailableError):
            context.jobs.done(lease, "submap", lease.job.job_id, submap(index, depth, seconds), [depth])


def appender(directory: str, thread_count: int) -> int:
    """Appends without a bus, as fast as it can, and says on standard output what was acknowledged."""
    ledger = service.open_session(Path(directory), Config().ledger)

    def run(thread: int) -> None:
        for number in itertools.count():
            image = f"image {os.getpid()} {thread} {number} ".encode() * 100
            frame = keyframe(os.getpid() * 1_000_000 + thread * 100_000 + number, image)
            request = service.calls.AppendRequest(
                "keyframe",
                frame.keyframe_id,
                codec.payload_type(Keyframe),
                codec.encode(frame),
                codec.identity_digest(frame),
                (image,),
                (frame.image,),
            )
            appended = ledger.store.append(*admitted(request))
            # One write of less than a page of a pipe arrives whole or not at all.
            os.write(1, f"{appended.sequence} {frame.keyframe_id} {frame.image.sha256}\n".encode())

    threads = [threading.Thread(target=run, args=(number,)) for number in range(thread_count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return 0


def main(arguments: list[str]) -> int:
    role, first, *rest = arguments
    if role == "appender":
        return appender(first, int(rest[0]))
    config = load_config(None, [*first.split("|"), f"bus.connect_timeout_s={READY_S}"])
    match role:
        case "router":
            return router.main(config)
        case "ledger":
            return service.main(config, directory=Path(rest[0]))
        case "worker":
            return run_service(
                "inference", config, lambda context: worker(context, float(rest[0]), *map(Path, rest[1:]))
            )
    raise SystemExit(f"unknown role {role}")


if __name__ == "__main__":
    leave(main(sys.argv[1:]))
