"""One run of the main job under attack, and its comparison with the undisturbed one."""

from __future__ import annotations

import contextlib
import json
import os
import random
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from vggt_motion.bus import codec
from vggt_motion.bus.ledger import LedgerClient
from vggt_motion.bus.session import open_bus
from vggt_motion.config import BusConfig
from vggt_motion.errors import BusError, DiskFullError
from vggt_motion.evaluation.trajectory_io import read_tum
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.ledger.check import check
from vggt_motion.ledger.sqlite import read_only
from vggt_motion.records import Constraint, Event, EventKind, GraphUpdate, JobState, Stream

HERE = Path(__file__).parent
TOLERANCE = 1e-9
RUN_TIMEOUT_S = 400.0
SMALL_SUBMAPS = ("frontend.max_keyframes=4", "frontend.overlap_keyframes=2")
"""The sample in eight submaps instead of three: more to lose, less time each."""


def with_hook(folder: Path, **variables: str) -> dict[str, str]:
    """Environment of processes that import ``sitecustomize`` from a folder before anything else."""
    return {"PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]), **variables}


# Leases and heartbeats as short as a busy machine allows, so that a frozen process is noticed within the test.
QUICK = ("bus.lease_s=2", "ledger.lease_duration_s=3", "bus.request_timeout_s=5", "gateway.port=0")


@dataclass(frozen=True)
class Snapshot:
    """What has to be equal whatever happened."""

    keyframes: frozenset[str]
    segments: frozenset[str]
    submaps: frozenset[str]
    constraints: Mapping[str, tuple[bool, np.ndarray]]
    graph: Mapping[tuple[int, int, int], np.ndarray]
    breaks: tuple[str, ...]
    times_ns: np.ndarray
    poses: np.ndarray

    @classmethod
    def of(cls, out: Path) -> Snapshot:
        with read_only(out / "ledger" / "ledger.db") as reader:
            rows = {stream: reader.records(stream.value, 0, 100_000) for stream in Stream}
        constraints = {}
        for row in rows[Stream.CONSTRAINT]:
            constraint = codec.decode(Constraint, row.payload)
            constraints[row.record_id] = (constraint.accepted, _matrix(constraint.j_from_i))
        (final,) = (row for row in rows[Stream.GRAPH] if row.record_id == "graph/final")
        graph = codec.decode(GraphUpdate, final.payload)
        track = read_tum(out / "trajectory_frames.tum")
        return cls(
            keyframes=frozenset(row.record_id for row in rows[Stream.KEYFRAME]),
            segments=frozenset(row.record_id for row in rows[Stream.SEGMENT]),
            submaps=frozenset(row.record_id for row in rows[Stream.SUBMAP]),
            constraints=constraints,
            graph={(p.submap_index, p.submap_revision, p.component): _matrix(p.world_from_submap) for p in graph.poses},
            breaks=graph.breaks,
            times_ns=track.times_ns,
            poses=track.world_from_camera,
        )

    def differences(self, other: Snapshot) -> list[str]:
        """One line for each thing that is not the same."""
        found = [
            f"{name}: {sorted(getattr(self, name) ^ getattr(other, name))}"
            for name in ("keyframes", "segments", "submaps")
            if getattr(self, name) != getattr(other, name)
        ]
        if self.constraints.keys() != other.constraints.keys():
            found.append(f"constraints: {sorted(self.constraints.keys() ^ other.constraints.keys())}")
        else:
            for name, (accepted, matrix) in self.constraints.items():
                is_same = accepted == other.constraints[name][0]
                if not (is_same and np.allclose(matrix, other.constraints[name][1], rtol=0, atol=TOLERANCE)):
                    found.append(f"constraint {name} differs")
        if self.graph.keys() != other.graph.keys() or self.breaks != other.breaks:
            found.append(f"graph: {sorted(self.graph.keys() ^ other.graph.keys())}, {self.breaks}, {other.breaks}")
        elif any(not np.allclose(self.graph[k], other.graph[k], rtol=0, atol=TOLERANCE) for k in self.graph):
            found.append("graph: poses differ")
        if not np.array_equal(self.times_ns, other.times_ns):
            found.append(f"trajectory: {len(self.times_ns)} frames, {len(other.times_ns)} frames")
        elif not np.allclose(self.poses, other.poses, rtol=0, atol=TOLERANCE):
            found.append(f"trajectory: poses differ by {np.abs(self.poses - other.poses).max():.3g}")
        return found


def _matrix(transform: Sim3) -> np.ndarray:
    return np.concatenate([transform.rotation.ravel(), transform.translation, [transform.scale]])


@dataclass
class Outcome:
    """What a run under attack came to."""

    exit_code: int
    seconds: float
    injected: Counter[str]
    acknowledged: int  # records of the witness that the ledger acknowledged
    records_lost: int
    records_twice: int
    jobs_lost: int
    jobs_run_twice: int
    differences: list[str]
    problems: list[str]
    output: str

    @property
    def is_equal(self) -> bool:
        return not self.differences


@dataclass
class FaultRun:
    """``vggt-motion run`` in a process of its own, with a witness that appends records all along."""

    source: Path
    out: Path
    reference: Snapshot
    assignments: Sequence[str]
    arguments: Sequence[str] = ()
    endpoints: Mapping[str, str] = field(default_factory=dict)  # of services that join elsewhere: proxies
    port: int = 0
    environment: Mapping[str, str] = field(default_factory=dict)
    injected: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.out.parent.mkdir(parents=True, exist_ok=True)
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self._log = self.out.parent / f"{self.out.name}-{time.monotonic_ns()}.txt"
        command = [sys.executable, str(HERE / "linked_run.py"), json.dumps(dict(self.endpoints))]
        command += ["run", str(self.source), "--out", str(self.out), *self.arguments]
        for assignment in (f"bus.endpoint={self.endpoint}", *QUICK, *self.assignments):
            command += ["--set", assignment]
        self._begin = time.monotonic()
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env={**os.environ, **self.environment}
            )
        self.witness = Witness(BusConfig(endpoint=self.endpoint, connect_timeout_s=60.0))

    # --- looking ---

    @property
    def is_running(self) -> bool:
        return self.process.poll() is None

    def processes(self, service: str) -> list[psutil.Process]:
        """The present processes of a service, without their computing children, in order of their ids."""
        found = []
        with contextlib.suppress(psutil.NoSuchProcess):
            for child in psutil.Process(self.process.pid).children():
                with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):
                    line = child.cmdline()
                    if "serve" in line and line[line.index("serve") + 1] == service:
                        found.append(child)
        return sorted(found, key=lambda child: child.pid)

    def count(self, stream: Stream) -> int:
        """Number of records of a stream at present."""
        with contextlib.suppress(Exception), read_only(self.out / "ledger" / "ledger.db") as reader:
            return reader.positions().get(stream.value, 0)
        return 0

    def wait_until(self, condition: Callable[[], Any], timeout_s: float = 120.0) -> bool:
        """Wait for a condition, or for the end of the run; whether it came about."""
        end = time.monotonic() + timeout_s
        while self.is_running and time.monotonic() < end:
            if condition():
                return True
            time.sleep(0.02)
        return False

    # --- attacking ---

    def signal(self, service: str, number: signal.Signals, what: str, which: int = 0) -> bool:
        """Send a signal to one process of a service; whether there was one."""
        processes = self.processes(service)
        if not processes or not self.is_running:
            return False
        with contextlib.suppress(psutil.NoSuchProcess):
            processes[which % len(processes)].send_signal(number)
            self.injected[f"{what} {service}"] += 1
            return True
        return False

    def kill(self, service: str, which: int = 0) -> bool:
        return self.signal(service, signal.SIGKILL, "SIGKILL", which)

    def restart(self, service: str, which: int = 0) -> bool:
        return self.signal(service, signal.SIGTERM, "restart", which)

    def freeze(self, service: str, seconds: float, which: int = 0) -> bool:
        processes = self.processes(service)
        if not processes or not self.is_running:
            return False
        process = processes[which % len(processes)]
        with contextlib.suppress(psutil.NoSuchProcess):
            process.suspend()
            self.injected[f"SIGSTOP {service}"] += 1
            time.sleep(seconds)
            process.resume()
            return True
        return False

    def kill_everything(self) -> None:
        """SIGKILL to the run and all that it started, at one moment."""
        parent = psutil.Process(self.process.pid)
        everything = [*parent.children(recursive=True), parent]
        for process in everything:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.suspend()
        for process in everything:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        self.injected["SIGKILL of everything"] += 1
        self.process.wait()
        psutil.wait_procs(everything, timeout=20)
        self.witness.close()

    # --- ending ---

    def finish(self, timeout_s: float = RUN_TIMEOUT_S) -> Outcome:
        """Wait until the run ends by itself, and judge it."""
        problems = []
        self.witness.stop()
        try:
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            problems.append(f"the run did not end by itself within {timeout_s:.0f} s")
            self.stop()
        self.witness.close()
        seconds = time.monotonic() - self._begin
        output = self._log.read_text(encoding="utf-8", errors="replace")
        if self.process.returncode != 0:
            problems.append(f"exit code {self.process.returncode}")
        if "Traceback" in output:
            problems.append("a traceback")
        problems += _orphans(self.out)
        differences: list[str] = []
        lost = twice = jobs_lost = run_twice = 0
        try:
            differences = Snapshot.of(self.out).differences(self.reference)
        except Exception as error:
            differences = [f"no result: {type(error).__name__}: {error}"]
        try:
            report = check(self.out / "ledger", repair=False)
            problems += report.problems
            with read_only(self.out / "ledger" / "ledger.db") as reader:
                for stream in Stream:
                    rows = reader.records(stream.value, 0, 100_000)
                    ids = Counter(row.record_id for row in rows)
                    twice += sum(count - 1 for count in ids.values())
                    if [row.sequence for row in rows] != list(range(len(rows))):
                        problems.append(f"stream {stream.value} is not dense")
                    if stream is Stream.EVENT:
                        lost = sum(ids[name] == 0 for name in self.witness.acknowledged)
                jobs = reader.jobs(None, "", 100_000)
            jobs_lost = sum(job.state is not JobState.DONE for job in jobs)
            run_twice = sum(job.attempt > 1 for job in jobs)
        except Exception as error:
            problems.append(f"the ledger cannot be read: {type(error).__name__}: {error}")
        return Outcome(
            exit_code=self.process.returncode,
            seconds=seconds,
            injected=self.injected,
            acknowledged=len(self.witness.acknowledged),
            records_lost=lost,
            records_twice=twice,
            jobs_lost=jobs_lost,
            jobs_run_twice=run_twice,
            differences=differences,
            problems=problems,
            output=output,
        )

    def stop(self) -> None:
        """End it, whatever state it is in."""
        with contextlib.suppress(psutil.NoSuchProcess):
            for process in [*psutil.Process(self.process.pid).children(recursive=True)]:
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.kill()
        self.process.kill()
        self.process.wait()
        self.witness.close()


def _orphans(out: Path) -> list[str]:
    """Processes of the run that are left: each has the folder on its command line."""
    end = time.monotonic() + 10.0
    while True:
        left = [
            " ".join(process.info["cmdline"][:6])
            for process in psutil.process_iter(["cmdline"])
            if f"{out}/" in " ".join(process.info["cmdline"] or ())
        ]
        if not left or time.monotonic() > end:
            return [f"left behind: {line}" for line in left]
        time.sleep(0.1)


class Witness:
    """Appends small records without pause and remembers which were acknowledged."""

    def __init__(self, config: BusConfig, interval_s: float = 0.1) -> None:
        self._config, self._interval_s = config, interval_s
        self.acknowledged: list[str] = []
        self._stopping = threading.Event()
        self._bus: Any = None
        self._thread = threading.Thread(target=self._run, name="witness", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._bus = open_bus(self._config, stopping=self._stopping)
            ledger = LedgerClient(self._bus)
            # of its own: a run that is continued has another witness, who must not bring back what was lost
            name = f"witness/{secrets.token_hex(4)}"
            number = 0
            while not self._stopping.wait(self._interval_s):
                event = Event(f"{name}/{number:06d}", EventKind.WARNING, f"witness {number}", time.time_ns())
                with contextlib.suppress(DiskFullError):
                    ledger.append(Stream.EVENT, event.event_id, event)
                    self.acknowledged.append(event.event_id)
                    number += 1
        except BusError:
            pass

    def stop(self) -> None:
        """Append nothing more: a run with a stream that always grows would not see the recorder at its end."""
        self._stopping.set()
        self._thread.join(1.0)
        if self._bus is not None:
            self._bus.interrupt()

    def close(self) -> None:
        self.stop()
        self._thread.join(5.0)
        if self._bus is not None:
            self._bus.close()


def moments(generator: random.Random, count: int, over_s: float) -> list[float]:
    """Random pauses between faults that sum to about ``over_s``."""
    times = sorted(generator.uniform(0.0, over_s) for _ in range(count))
    return [b - a for a, b in zip([0.0, *times], times, strict=False)]
