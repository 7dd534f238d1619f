"""What a worker does after a job failed on it, with the ledger's own queue and without a bus."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ledger_helpers import Clock, open_ledger, predict, record
from vggt_motion.bus import worker
from vggt_motion.compute import ComputeCrashedError
from vggt_motion.config import Config
from vggt_motion.errors import PredictionError
from vggt_motion.ledger.jobs import JobPolicy, JobQueue
from vggt_motion.records import JobKind, Lease, Stream


class InlineChild:
    """Computes here."""

    def __init__(self, name: str) -> None:
        pass

    def call(self, function: Callable[..., Any], *arguments: Any, **_: object) -> Any:
        return function(*arguments)

    def kill(self) -> None:
        pass


class Stopping(threading.Event):
    """Time passes when somebody waits, in small steps, and nothing else takes any."""

    def __init__(self, clock: Clock, on_step: Callable[[], None]) -> None:
        super().__init__()
        self.clock, self.on_step = clock, on_step

    def wait(self, timeout: float | None = None) -> bool:
        for _ in range(round((timeout or 0.0) / 0.125)):
            self.clock.now_s += 0.125
            self.on_step()
        return self.is_set()


@dataclass(frozen=True)
class Result:
    """What a computation returns."""

    record_id: str


class Jobs:
    """The ledger's queue as a worker sees it."""

    def __init__(self, queue: JobQueue, stopping: threading.Event) -> None:
        self.queue, self.stopping = queue, stopping
        self.reasons: list[str] = []
        self.results: list[str] = []

    def claim(self, kinds: Any, models: Any, name: str, wait_s: float) -> Lease | None:
        lease = self.queue.claim(kinds, models, name)
        if lease is None and wait_s > 0.0:
            self.stopping.set()  # nothing is left, or nobody else came
        return lease

    def heartbeat(self, lease_id: str) -> bool:
        return self.queue.heartbeat(lease_id)

    def done(self, lease: Lease, stream: Stream, record_id: str, result: Result, blobs: object) -> bool:
        self.queue.done(lease.job.job_id, lease.lease_id, record(stream.value, record_id))
        self.results.append(record_id)
        return True

    def fail(self, lease: Lease, reason: str, traceback_text: str) -> None:
        self.reasons.append(reason)
        assert self.queue.fail(lease.job.job_id, lease.lease_id, reason, traceback_text)


class Bench:
    """A ledger, a worker's view of it, and a clock."""

    def __init__(self, directory: Path, monkeypatch: pytest.MonkeyPatch, *job_ids: str) -> None:
        monkeypatch.setattr(worker, "ComputeChild", InlineChild)
        self.clock, config = Clock(), Config()
        policy = JobPolicy(retry_backoff_s=config.ledger.retry_backoff_s)
        self.ledger = open_ledger(directory, clock=self.clock, policy=policy)
        self.ledger.jobs.submit([predict(job_id) for job_id in job_ids])
        self.stopping = Stopping(self.clock, lambda: self.on_step())
        self.on_step: Callable[[], None] = lambda: None
        self.jobs = Jobs(self.ledger.jobs, self.stopping)
        self.health: list[tuple[str, str]] = []
        self.context: Any = SimpleNamespace(
            service="inference",
            instance="small",
            worker="inference/small",
            config=config,
            stopping=self.stopping,
            ledger=None,
            jobs=self.jobs,
            set_health=lambda state, detail="", **_: self.health.append((state, detail)),
        )

    def work(self, prepare: Callable[[Lease], worker.Computation], batch: int = 1) -> None:
        worker.work(
            self.context,
            kinds=(JobKind.PREDICT,),
            models=(),
            stream=Stream.SUBMAP,
            prepare=prepare,
            deadline_s=1.0,
            warm_up=worker.Computation(lambda: ("what it offers", batch), (), "warming up"),
        )


def test_a_job_that_failed_here_is_offered_elsewhere_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(tmp_path, monkeypatch, "submap/000000/r1")
    elsewhere: list[Lease] = []

    def a_larger_worker_asks() -> None:
        lease = bench.ledger.jobs.claim((JobKind.PREDICT,), (), "inference/large") if bench.jobs.reasons else None
        if lease is not None:
            elsewhere.append(lease)
            bench.stopping.set()

    def too_large() -> None:
        raise PredictionError("a submap of 17 frames needs about 9.0 GiB, 4.0 GiB are free")

    bench.on_step = a_larger_worker_asks
    bench.work(lambda lease: worker.Computation(too_large, (), "submap 0"))
    assert bench.jobs.reasons == ["a submap of 17 frames needs about 9.0 GiB, 4.0 GiB are free"]
    assert ("idle", "what it offers") in bench.health
    assert ("waiting", "a job failed here: submap/000000/r1") in bench.health
    assert [(lease.job.job_id, lease.attempt) for lease in elsewhere] == [("submap/000000/r1", 2)]
    bench.ledger.close()


class TestSeveralAtATime:
    JOBS = tuple(f"submap/00000{index}/r1" for index in range(5))

    @staticmethod
    def prepared(calls: list[list[str]]) -> Callable[[Lease], worker.Computation]:
        def several(arguments: list[tuple[str]]) -> list[Any]:
            calls.append([job_id for (job_id,) in arguments])
            return ["too large" if "2" in job_id else (Result(job_id), ()) for (job_id,) in arguments]

        def one(job_id: str) -> Any:
            calls.append([job_id])
            return Result(job_id), ()

        return lambda lease: worker.Computation(one, (lease.job.job_id,), lease.job.job_id, of_several=several)

    def test_takes_what_there_is_up_to_the_limit(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        bench, calls = Bench(tmp_path, monkeypatch, *self.JOBS), []  # type: ignore[var-annotated]
        bench.work(self.prepared(calls), batch=3)
        together, alone, rest = self.JOBS[:3], self.JOBS[2:3], self.JOBS[3:]
        assert calls == [list(together), list(alone), list(rest)], "the one that failed is tried again, alone"
        assert bench.jobs.reasons == ["too large"]
        assert sorted(bench.jobs.results) == sorted(self.JOBS)
        bench.ledger.close()

    def test_one_at_a_time_unless_the_worker_offers_more(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        bench, calls = Bench(tmp_path, monkeypatch, *self.JOBS), []  # type: ignore[var-annotated]
        bench.work(self.prepared(calls))
        assert calls == [[job_id] for job_id in self.JOBS]
        bench.ledger.close()

    def test_a_call_that_fails_is_a_failure_of_each(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        bench = Bench(tmp_path, monkeypatch, *self.JOBS[:2])

        def crash(*_: object) -> Any:
            bench.stopping.set()
            raise ComputeCrashedError("the computing process died (signal SIGKILL, perhaps out of memory)")

        bench.work(lambda lease: worker.Computation(crash, (1,), "submap", of_several=crash), batch=8)
        assert bench.jobs.reasons == ["the computing process died (signal SIGKILL, perhaps out of memory)"] * 2
        bench.ledger.close()
