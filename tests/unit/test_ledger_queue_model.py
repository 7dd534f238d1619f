"""The job queue against a model that is as simple as possible, under any order of calls."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, initialize, invariant, multiple, rule

from ledger_helpers import Clock, open_ledger, predict, record
from vggt_motion.ledger.jobs import JobPolicy
from vggt_motion.ledger.store import UnknownError
from vggt_motion.records import DoneOutcome, JobKind, JobState, Lease

# In memory where that is possible: the model asks what the rules do, other tests ask what the disk keeps.
MEMORY = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
LEASE_S = 10.0  # all times are sums of powers of two: no rounding decides which side of a deadline they are on
POLICY = JobPolicy(lease_duration_s=LEASE_S, max_failures=2, max_lost_leases=3, retry_backoff_s=1.0)
NAMES = st.sampled_from([f"job{index}" for index in range(8)])
WORKERS = st.sampled_from(["inference/a", "inference/b"])
FINAL = (JobState.DONE, JobState.DEAD, JobState.CANCELLED)


@dataclass
class Model:
    """What is known of one job."""

    priority: int
    submission: int
    state: JobState = JobState.OPEN
    failures: int = 0
    lost: int = 0
    lease_id: str = ""
    worker: str = ""
    deadline_s: float = 0.0
    not_before_s: float = 0.0
    result: bytes | None = None
    lease_ids: set[str] = field(default_factory=set)


class QueueMachine(RuleBasedStateMachine):
    """Random calls, each checked against the model; at every step the log is dense and holds exactly the results."""

    leases = Bundle("leases")

    def __init__(self) -> None:
        super().__init__()
        self.directory = Path(tempfile.mkdtemp(prefix="ledger-model-", dir=MEMORY))
        self.clock = Clock()
        self.lease_count = 0
        self.jobs: dict[str, Model] = {}
        self.results: list[str] = []
        self.deaths: list[str] = []

    @initialize()
    def begin(self) -> None:
        self.open()
        for number in range(6):
            self.submit(f"job{number}", number % 2)

    def open(self) -> None:
        self.ledger = open_ledger(self.directory, self.clock, policy=POLICY, new_lease_id=self.new_lease_id)

    def new_lease_id(self) -> str:
        self.lease_count += 1
        return f"lease{self.lease_count}"

    def teardown(self) -> None:
        with contextlib.suppress(AttributeError):
            self.ledger.close()
        shutil.rmtree(self.directory)

    @rule(name=NAMES, priority=st.integers(-1, 1))
    def submit(self, name: str, priority: int) -> None:
        known = self.jobs.get(name)
        reply = self.ledger.jobs.submit([predict(name, priority=priority)])
        assert reply.new_count == (known is None)
        if known is None:
            self.jobs[name] = Model(priority, len(self.jobs))
        elif known.state is JobState.CANCELLED:
            known.state, known.not_before_s = JobState.OPEN, 0.0

    @rule(target=leases, worker=WORKERS)
    def claim_one(self, worker: str) -> Lease:
        return self.claim(worker)

    def claim(self, worker: str) -> Lease:
        lease = self.ledger.jobs.claim([JobKind.PREDICT], [], worker)
        ready = [
            (job.priority, job.submission, name)
            for name, job in self.jobs.items()
            if job.state is JobState.OPEN and job.not_before_s <= self.clock.now_s
        ]
        if not ready:
            assert lease is None
            return multiple()  # type: ignore[no-any-return]
        assert lease is not None
        assert lease.job.job_id == min(ready)[2]
        job = self.jobs[lease.job.job_id]
        job.state, job.lease_id, job.worker = JobState.LEASED, lease.lease_id, worker
        job.deadline_s = self.clock.now_s + LEASE_S
        job.lease_ids.add(lease.lease_id)
        assert lease.attempt == len(job.lease_ids)
        return lease

    def is_present(self, lease: Lease) -> bool:
        return self.jobs[lease.job.job_id].lease_id == lease.lease_id

    @rule(lease=leases)
    def heartbeat(self, lease: Lease) -> None:
        self.heartbeat_of(lease)

    def heartbeat_of(self, lease: Lease) -> None:
        assert self.ledger.jobs.heartbeat(lease.lease_id) == self.is_present(lease)
        if self.is_present(lease):
            self.jobs[lease.job.job_id].deadline_s = self.clock.now_s + LEASE_S

    @rule(choice=st.integers(0, 3), content=st.binary(max_size=3))
    def done_in_time(self, choice: int, content: bytes) -> None:
        if lease := self.held(choice):
            self.done(lease, content)

    @rule(choice=st.integers(0, 3), is_permanent=st.sampled_from([False] * 5 + [True]))
    def fail_in_time(self, choice: int, is_permanent: bool) -> None:
        if lease := self.held(choice):
            self.fail(lease, is_permanent)

    @rule(worker=WORKERS, seconds=st.sampled_from([0.5, 1.0, 1.5, 2.0]), count=st.integers(1, 3))
    def a_worker_fails_again_and_again(self, worker: str, seconds: float, count: int) -> None:
        for _ in range(count):
            lease = self.claim(worker)
            if isinstance(lease, Lease):
                self.fail(lease, is_permanent=False)
            self.time_passes(seconds, 1)

    @rule(worker=WORKERS, count=st.integers(1, 3))
    def a_worker_is_killed_again_and_again(self, worker: str, count: int) -> None:
        for _ in range(count):
            self.claim(worker)
            self.worker_vanishes(worker)

    @rule(is_failure=st.booleans())
    def a_lease_changes_hands_and_the_old_one_is_used(self, is_failure: bool) -> None:
        old = self.claim("inference/slow")
        self.worker_vanishes("inference/slow")
        self.claim("inference/b")
        if isinstance(old, Lease):
            if is_failure:
                self.fail(old, is_permanent=False)
            else:
                self.heartbeat_of(old)

    def held(self, choice: int) -> Lease | None:
        """One of the leases that are valid at present."""
        names = [name for name, job in self.jobs.items() if job.lease_id]
        if not names:
            return None
        name = names[choice % len(names)]
        return Lease(predict(name), self.jobs[name].lease_id, attempt=1, duration_s=LEASE_S)

    @rule(lease=leases, content=st.binary(max_size=3))
    def done_at_any_time(self, lease: Lease, content: bytes) -> None:
        self.done(lease, content)

    def done(self, lease: Lease, content: bytes) -> None:
        name = lease.job.job_id
        job = self.jobs[name]
        reply = self.ledger.jobs.done(name, lease.lease_id, record("submap", name, content), [content])
        if job.state is JobState.DONE:
            assert reply.outcome is DoneOutcome.ALREADY_DONE
            assert reply.sequence == self.results.index(name)
        elif job.state in FINAL:
            assert reply.outcome is DoneOutcome.DROPPED
        else:
            assert reply.outcome is DoneOutcome.COMMITTED
            assert reply.sequence == len(self.results)
            job.state, job.lease_id, job.result = JobState.DONE, "", content
            self.results.append(name)

    @rule(lease=leases, other=NAMES)
    def done_for_another_job(self, lease: Lease, other: str) -> None:
        if other == lease.job.job_id or other not in self.jobs:
            return
        with contextlib.suppress(UnknownError):
            self.ledger.jobs.done(other, lease.lease_id, record("submap", other, b"wrong"))
            raise AssertionError("a lease on another job was accepted")

    @rule(lease=leases, is_permanent=st.booleans())
    def fail_at_any_time(self, lease: Lease, is_permanent: bool) -> None:
        self.fail(lease, is_permanent)

    def fail(self, lease: Lease, is_permanent: bool) -> None:
        job = self.jobs[lease.job.job_id]
        is_present = self.is_present(lease)
        counted = self.ledger.jobs.fail(lease.job.job_id, lease.lease_id, "why", is_permanent=is_permanent)
        assert counted == is_present
        if is_present:
            job.failures += 1
            job.lease_id = ""
            if is_permanent or job.failures == POLICY.max_failures:
                self.die(lease.job.job_id)
            else:
                job.state = JobState.OPEN
                job.not_before_s = self.clock.now_s + POLICY.retry_backoff_s * 2 ** (job.failures - 1)

    def die(self, name: str) -> None:
        self.jobs[name].state = JobState.DEAD
        self.deaths.append(f"job_dead/{name}")

    def lose(self, names: list[str]) -> None:
        for name in sorted(names, key=lambda name: self.jobs[name].submission):
            job = self.jobs[name]
            job.lease_id = ""
            job.lost += 1
            job.state = JobState.OPEN
            if job.lost == POLICY.max_lost_leases:
                self.die(name)

    @rule(worker=WORKERS)
    def worker_vanishes(self, worker: str) -> None:
        lost = [name for name, job in self.jobs.items() if job.lease_id and job.worker == worker]
        assert self.ledger.jobs.release_worker(worker) == len(lost)
        self.lose(lost)

    @rule(seconds=st.sampled_from([0.5, 1.0, 2.0, 2.5]), count=st.integers(1, 6))
    def time_passes(self, seconds: float, count: int) -> None:
        for _ in range(count):
            self.clock.now_s += seconds
            lost = [name for name, job in self.jobs.items() if job.lease_id and job.deadline_s < self.clock.now_s]
            assert self.ledger.jobs.tick() == len(lost)
            self.lose(lost)

    @rule(seconds=st.sampled_from([2.75, 60.0]))
    def ledger_freezes(self, seconds: float) -> None:
        self.clock.now_s += seconds
        assert self.ledger.jobs.tick() == 0
        for job in self.jobs.values():
            job.deadline_s += seconds

    @rule(names=st.lists(NAMES, max_size=2, unique=True))
    def cancel(self, names: list[str]) -> None:
        affected = [self.jobs[name] for name in names if name in self.jobs and self.jobs[name].state not in FINAL]
        assert self.ledger.jobs.cancel(names) == len(affected)
        for job in affected:
            job.state, job.lease_id = JobState.CANCELLED, ""

    @rule(is_clean=st.booleans())
    def ledger_restarts(self, is_clean: bool) -> None:
        if is_clean:
            self.ledger.close()
        else:
            # As a power cut leaves it: the files as they are, without closing anything.
            image = Path(tempfile.mkdtemp(prefix="ledger-model-", dir=MEMORY))
            shutil.copytree(self.directory, image, dirs_exist_ok=True)
            self.ledger.close()
            shutil.rmtree(self.directory)
            self.directory = image
        self.clock.now_s = 0.0
        self.open()
        for job in self.jobs.values():
            job.not_before_s = 0.0
            if job.state is JobState.LEASED:
                job.state, job.lease_id = JobState.OPEN, ""

    @invariant()
    def the_queue_is_as_the_model_says(self) -> None:
        if not hasattr(self, "ledger"):
            return
        reports = {report.job_id: report for report in self.ledger.jobs.reports()}
        assert {name: (job.state, job.failures, job.lost) for name, job in self.jobs.items()} == {
            name: (report.state, report.failure_count, report.lost_lease_count) for name, report in reports.items()
        }

    @invariant()
    def the_log_holds_every_result_and_death_once_and_densely(self) -> None:
        if not hasattr(self, "ledger"):
            return
        for stream, names in (("submap", self.results), ("event", self.deaths)):
            rows = self.ledger.store.read(stream)
            assert [row.sequence for row in rows] == list(range(len(names)))
            assert [row.record_id for row in rows] == names
        for row in self.ledger.store.read("submap"):
            assert row.payload == self.jobs[row.record_id].result


TestQueue = QueueMachine.TestCase
TestQueue.settings = settings(max_examples=80, stateful_step_count=50, deadline=None)
