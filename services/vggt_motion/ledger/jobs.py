"""The job queue: pulled under leases, committed once.

A worker claims a job and holds a lease on it: a deadline that its heartbeats move, and its liveliness token. The result
is appended to the log in the same transaction that makes the job done, so a job is done if and only if its record is
there. A lease that ends puts the job back; a result that comes late is taken once if nobody else brought one. What
keeps failing becomes dead, with an event in the log from the same transaction, and holds up nothing else.

Deadlines are measured by a monotonic clock of this process, so jumps of the wall clock do nothing. Silence only counts
against a worker while the ledger could hear it: see :meth:`JobQueue.tick`.
"""

from __future__ import annotations

import dataclasses
import logging
import threading
import time
import uuid
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from dataclasses import dataclass

from vggt_motion.ledger.log import MAX_PAYLOAD_TYPE_BYTES, Store, check_id, check_record
from vggt_motion.ledger.store import (
    Blob,
    BlobEntry,
    ConflictError,
    Content,
    InvalidRequestError,
    JobRow,
    LeaseRow,
    NewRecord,
    Reader,
    Rows,
    Transaction,
    UnknownError,
)
from vggt_motion.records import DoneOutcome, Job, JobKind, JobReport, JobState, Lease

_LOGGER = logging.getLogger(__name__)

MAX_JOBS_PER_SUBMIT = 10_000
MAX_MODELS_PER_CLAIM = 64
MAX_REASON_CHARACTERS = 2_000
MAX_TRACEBACK_CHARACTERS = 16_000
MAX_REPORTS = 1_000
MAX_WAIT_S = 60.0
MAX_JOB_ID_BYTES = 240  # the id of the event of its death is longer
MAX_JOB_PAYLOAD_BYTES = 4 * 2**20
_LONGEST_PAUSE_S = 10.0  # of a claim between two looks: whatever makes a job ready wakes it
_HELD_BACK_PAUSE_S = 1.0  # ... but space on the disk wakes nobody
_FINAL = (JobState.DONE, JobState.DEAD, JobState.CANCELLED)


@dataclass(frozen=True)
class Done:
    """Answer to a result."""

    outcome: DoneOutcome
    sequence: int = 0  # of the record, unless dropped


@dataclass(frozen=True)
class Submitted:
    """Answer to a submission."""

    new_count: int
    known_count: int


@dataclass(frozen=True)
class JobPolicy:
    """When a lease ends and when a job is given up."""

    lease_duration_s: float = 10.0
    max_failures: int = 3
    max_lost_leases: int = 10
    retry_backoff_s: float = 0.5


class _Waiter:
    """A claim that waits for a job."""

    def __init__(self, worker: str, kinds: Set[str]) -> None:
        self.worker = worker
        self.kinds = kinds
        self.is_abandoned = False
        self.has_news = threading.Event()


class JobQueue:
    """The jobs of one session. Thread-safe; may block for a disk, and in :meth:`claim` for a job."""

    def __init__(
        self,
        rows: Rows,
        store: Store,
        *,
        policy: JobPolicy | None = None,
        result_streams: Mapping[str, str],
        dead_event: Callable[[JobReport], NewRecord],
        clock: Callable[[], float] = time.monotonic,
        may_start: Callable[[], bool] | None = None,
        new_lease_id: Callable[[], str] | None = None,
    ) -> None:
        """Put the queue's rules on top of the rows that ``store`` uses, and open again what was leased.

        Args:
            rows: durable rows, the same as the store's.
            store: takes results and events.
            policy: when a lease ends and when a job is given up.
            result_streams: for each kind of job, the stream of its results.
            dead_event: makes the record that reports a dead job.
            clock: seconds, monotonic.
            may_start: whether jobs may be handed out at present; defaults to the store having space for their results.
            new_lease_id: makes ids that never repeat: a result from another session must not be taken for one of this.
        """
        self._rows = rows
        self._store = store
        self._policy = policy or JobPolicy()
        self._result_streams = dict(result_streams)
        self._dead_event = dead_event
        self._clock = clock
        self._may_start = may_start or (lambda: store.is_accepting)
        self._new_lease_id = new_lease_id or (lambda: uuid.uuid4().hex)
        self._lock = threading.Lock()
        self._waiters: list[_Waiter] = []
        self._is_closed = False
        self._last_tick_s = clock()
        self._recover()

    def submit(self, jobs: Sequence[Job]) -> Submitted:
        """Add jobs, all or none. A known id with the same content is left as it is, but a cancelled job is open again.

        A job whose result is in the log already is done at once.

        Raises:
            InvalidRequestError: malformed or out of bounds.
            ConflictError: an id is known with another content.
        """
        if len(jobs) > MAX_JOBS_PER_SUBMIT:
            raise InvalidRequestError(f"{len(jobs)} jobs at once; at most {MAX_JOBS_PER_SUBMIT} are allowed")
        for job in jobs:
            self._check_job(job)

        def change(transaction: Transaction) -> Submitted:
            new_count = sum(self._submit_one(transaction, job) for job in jobs)
            return Submitted(new_count, len(jobs) - new_count)

        submitted = self._rows.write(change)
        self._wake({job.kind.value for job in jobs})
        return submitted

    def claim(
        self, kinds: Collection[JobKind], models: Collection[str], worker: str, wait_s: float = 0.0, claim_id: str = ""
    ) -> Lease | None:
        """Lease the first open job that fits, by priority and then order of submission; wait for one if there is none.

        Args:
            kinds: kinds that the worker can do.
            models: models that it offers; a job without a model fits every worker of its kind.
            worker: whose liveliness token and heartbeats keep the lease.
            wait_s: how long to wait, at most ``MAX_WAIT_S``.
            claim_id: made by the worker for this claim; a repeated claim gets the same lease again while it is valid.

        Returns:
            The lease, or None when no job came in time, the worker vanished or the queue was closed.

        Raises:
            InvalidRequestError: malformed or out of bounds.
        """
        check_id("worker", worker)
        if len(models) > MAX_MODELS_PER_CLAIM:
            raise InvalidRequestError(f"more than {MAX_MODELS_PER_CLAIM} models in one claim")
        for model in models:
            check_id("model", model)
        if claim_id:
            check_id("claim_id", claim_id)
        if not kinds or not 0 <= wait_s < float("inf"):
            raise InvalidRequestError("a claim needs at least one kind and a finite wait_s that is not negative")
        names = {kind.value for kind in kinds}
        until_s = self._clock() + min(wait_s, MAX_WAIT_S)
        waiter = _Waiter(worker, names)
        with self._lock:
            self._waiters.append(waiter)
        try:
            while True:
                # Before the look: no change between it and the wait is slept through.
                waiter.has_news.clear()
                if self._is_closed or waiter.is_abandoned:
                    return None
                has_lease, has_job = self._look(names, models, worker, claim_id)
                is_held_back = has_job and not has_lease and not self._may_start()
                if has_job and not is_held_back:
                    lease = self._take(names, models, worker, claim_id)
                    if lease is not None:
                        return lease
                pause_s = min(until_s, self._next_wake_s(names, models)) - self._clock()
                if until_s <= self._clock():
                    return None
                longest_s = _HELD_BACK_PAUSE_S if is_held_back else _LONGEST_PAUSE_S
                waiter.has_news.wait(min(max(pause_s, 0.001), longest_s))
        finally:
            with self._lock:
                self._waiters.remove(waiter)

    def heartbeat(self, lease_id: str) -> bool:
        """Move the deadline of a lease; False: the lease is gone, stop working on it."""

        def change(transaction: Transaction) -> bool:
            job = self._job_of(transaction, lease_id)
            if job is None:
                return False
            transaction.update_job(dataclasses.replace(job, deadline_s=self._clock() + self._policy.lease_duration_s))
            return True

        return self._rows.write(change)

    def done(
        self,
        job_id: str,
        lease_id: str,
        record: NewRecord,
        blobs: Sequence[Content | Blob] = (),
        references: Sequence[BlobEntry] = (),
    ) -> Done:
        """Append the result of a job and make the job done, in one transaction.

        A late result (the lease is lost, nobody else brought one) is committed. Whichever result comes first stays.

        Raises:
            InvalidRequestError: malformed, or a result for another job or in another stream.
            UnknownError: the lease was never handed out for this job, or a reference to a blob that is not there.
            DiskFullError: not enough space; nothing was changed.
        """
        check_record(record)
        if record.record_id != job_id:
            raise InvalidRequestError(f"result '{record.record_id}' is not the one of job '{job_id[:256]}'")
        settled = self._rows.read(lambda reader: self._settled(reader, job_id, lease_id, record.stream))
        if settled is not None:
            return settled

        def change(transaction: Transaction) -> Done:
            settled = self._settled(transaction, job_id, lease_id, record.stream)
            job = transaction.find_job(job_id)
            if settled is not None or job is None:
                return settled or Done(DoneOutcome.DROPPED)
            transaction.update_job(dataclasses.replace(job, state=JobState.DONE, lease_id=""))
            known = transaction.find_record(record.stream, job_id)
            if known is not None:
                return Done(DoneOutcome.ALREADY_DONE, known.sequence)
            return Done(DoneOutcome.COMMITTED, self._store.add(transaction, record, prepared).sequence)

        prepared = self._store.prepare(blobs, references, is_input=False)
        done = self._rows.write(change)
        if done.outcome is DoneOutcome.COMMITTED:
            self._store.remember(blobs)
        return done

    def fail(self, job_id: str, lease_id: str, reason: str, traceback: str = "", *, is_permanent: bool = False) -> bool:
        """Give a job back after an error; until ``max_failures`` it is tried again, after a back-off that doubles.

        Args:
            job_id: the job.
            lease_id: the worker's lease on it.
            reason: one line for a person.
            traceback: for a developer.
            is_permanent: trying again is useless: the job is dead at once.

        Returns:
            False: the lease was gone, nothing was counted.
        """
        line = " ".join(reason.split())[:MAX_REASON_CHARACTERS] or "no reason given"
        text = traceback[-MAX_TRACEBACK_CHARACTERS:]

        def change(transaction: Transaction) -> bool:
            job = self._job_of(transaction, lease_id)
            if job is None or job.job_id != job_id:
                return False
            count = job.failure_count + 1
            job = dataclasses.replace(job, lease_id="", failure_count=count, last_reason=line, last_traceback=text)
            if is_permanent or count >= self._policy.max_failures:
                self._bury(transaction, job)
            else:
                not_before_s = self._clock() + self._policy.retry_backoff_s * 2.0 ** (count - 1)
                transaction.update_job(dataclasses.replace(job, state=JobState.OPEN, not_before_s=not_before_s))
            return True

        is_counted = self._rows.write(change)
        if is_counted:
            _LOGGER.warning("job %s failed: %s", job_id, line)
            self._wake()
        return is_counted

    def cancel(self, job_ids: Sequence[str]) -> int:
        """Make open and leased jobs cancelled; returns how many. Unknown and finished ones stay as they are."""

        def change(transaction: Transaction) -> int:
            count = 0
            for job_id in job_ids:
                job = transaction.find_job(job_id)
                if job is not None and job.state not in _FINAL:
                    transaction.update_job(dataclasses.replace(job, state=JobState.CANCELLED, lease_id=""))
                    count += 1
            return count

        return self._rows.write(change)

    def release_worker(self, worker: str) -> int:
        """End the leases and waiting claims of a worker whose liveliness token vanished; returns how many leases."""
        with self._lock:
            for waiter in self._waiters:
                waiter.is_abandoned = waiter.is_abandoned or waiter.worker == worker
        self._wake()
        return self._lose(lambda reader: reader.leased_jobs(worker=worker), f"worker {worker} vanished")

    def tick(self) -> int:
        """End the leases whose deadline is over; returns how many. To be called several times per lease duration.

        Call it only while workers can reach the ledger. A long time between two calls means that the ledger was frozen,
        starved or cut off, and that the silence was not the workers': all deadlines move by as much.
        """
        now_s = self._clock()
        gap_s = now_s - self._last_tick_s
        self._last_tick_s = now_s
        if gap_s > self._policy.lease_duration_s / 4:
            _LOGGER.warning("no lease was watched for %.1f s; all deadlines are moved by as much", gap_s)
            self._rows.write(lambda transaction: transaction.shift_deadlines(gap_s))
            return 0
        return self._lose(lambda reader: reader.leased_jobs(deadline_before_s=now_s), "no heartbeat came in time")

    def counts(self) -> dict[tuple[str, str], int]:
        """Number of jobs per (kind, state)."""
        return self._rows.read(lambda reader: dict(reader.job_counts()))

    def reports(self, state: JobState | None = None, after_job_id: str = "", limit: int = 0) -> list[JobReport]:
        """Jobs in order of id, in one state or all; empty only after the last one."""
        count = min(limit or MAX_REPORTS, MAX_REPORTS)
        name = None if state is None else state.value
        return [_report(job) for job in self._rows.read(lambda reader: reader.jobs(name, after_job_id, count))]

    def close(self) -> None:
        """End all waiting claims and answer new ones with nothing."""
        self._is_closed = True
        self._wake()

    def _recover(self) -> None:
        def change(transaction: Transaction) -> int:
            # The clock began anew, and whatever happened to the ledger was not the workers' fault: nothing is counted.
            transaction.reset_times()
            leased = transaction.leased_jobs()
            for job in leased:
                transaction.update_job(dataclasses.replace(job, state=JobState.OPEN, lease_id="", deadline_s=0.0))
            return len(leased)

        count = self._rows.write(change)
        if count:
            _LOGGER.info("%d jobs that were leased are open again", count)

    def _check_job(self, job: Job) -> None:
        check_id("job_id", job.job_id, MAX_JOB_ID_BYTES)
        check_id("payload_type", job.payload_type, MAX_PAYLOAD_TYPE_BYTES)
        if job.model:
            check_id("model", job.model)
        if job.kind.value not in self._result_streams:
            raise InvalidRequestError(f"job '{job.job_id}': there is no stream for results of kind {job.kind.value}")
        if len(job.payload) > MAX_JOB_PAYLOAD_BYTES:
            raise InvalidRequestError(f"job '{job.job_id}': a payload of {len(job.payload)} bytes is too large")
        if not -(2**31) <= job.priority < 2**31:
            raise InvalidRequestError(f"job '{job.job_id}': priority {job.priority} is out of bounds")

    def _submit_one(self, transaction: Transaction, job: Job) -> bool:
        known = transaction.find_job(job.job_id)
        if known is not None:
            content = (known.kind, known.model, known.payload_type, known.payload)
            if content != (job.kind.value, job.model, job.payload_type, job.payload):
                raise ConflictError(f"job '{job.job_id}' is known with another content")
            if known.state == JobState.CANCELLED:
                transaction.update_job(dataclasses.replace(known, state=JobState.OPEN, not_before_s=0.0))
            return False
        is_done = transaction.find_record(self._result_streams[job.kind.value], job.job_id) is not None
        row = JobRow(
            job_id=job.job_id,
            submission=0,
            kind=job.kind.value,
            model=job.model,
            priority=job.priority,
            payload_type=job.payload_type,
            payload=job.payload,
            state=JobState.DONE if is_done else JobState.OPEN,
        )
        transaction.add_job(row)
        return True

    def _next_wake_s(self, kinds: Collection[str], models: Collection[str]) -> float:
        now_s = self._clock()
        wake_s = self._rows.read(lambda reader: reader.next_wake_s(kinds, models, now_s))
        return float("inf") if wake_s is None else wake_s

    def _look(self, kinds: Collection[str], models: Collection[str], worker: str, claim_id: str) -> tuple[bool, bool]:
        """Whether a claim has its lease already, and whether there is a job for it, leased or open; without a lock.

        Most find nothing, and a transaction costs an fsync.
        """

        def look(reader: Reader) -> tuple[bool, bool]:
            has_lease = bool(claim_id) and reader.find_claim(worker, claim_id) is not None
            return has_lease, has_lease or reader.next_open_job(kinds, models, self._clock()) is not None

        return self._rows.read(look)

    def _take(self, kinds: Collection[str], models: Collection[str], worker: str, claim_id: str) -> Lease | None:
        def change(transaction: Transaction) -> Lease | None:
            now_s = self._clock()
            deadline_s = now_s + self._policy.lease_duration_s
            held = transaction.find_claim(worker, claim_id) if claim_id else None
            job = transaction.find_job(held.job_id) if held is not None else None
            if job is not None:
                transaction.update_job(dataclasses.replace(job, deadline_s=deadline_s))
                return self._lease(job)
            job = transaction.next_open_job(kinds, models, now_s)
            if job is None:
                return None
            job = dataclasses.replace(
                job,
                state=JobState.LEASED,
                attempt=job.attempt + 1,
                lease_id=self._new_lease_id(),
                worker=worker,
                deadline_s=deadline_s,
            )
            transaction.update_job(job)
            transaction.add_lease(LeaseRow(job.lease_id, job.job_id, worker, claim_id, job.attempt))
            return self._lease(job)

        return self._rows.write(change)

    def _lease(self, row: JobRow) -> Lease:
        job = Job(row.job_id, JobKind(row.kind), row.payload, row.payload_type, row.priority, row.model)
        return Lease(job, row.lease_id, row.attempt, self._policy.lease_duration_s)

    def _job_of(self, transaction: Transaction, lease_id: str) -> JobRow | None:
        """The job that is leased under this id at present."""
        lease = transaction.find_lease(lease_id)
        job = None if lease is None else transaction.find_job(lease.job_id)
        return job if job is not None and job.state == JobState.LEASED and job.lease_id == lease_id else None

    def _settled(self, reader: Reader, job_id: str, lease_id: str, stream: str) -> Done | None:
        """The answer to a result that will not be committed, or None if it may be."""
        job = reader.find_job(job_id)
        if job is None:
            return Done(DoneOutcome.DROPPED)
        lease = reader.find_lease(lease_id)
        if lease is None or lease.job_id != job_id:
            raise UnknownError(f"lease '{lease_id[:64]}' was never handed out for job '{job_id}'")
        if stream != self._result_streams[job.kind]:
            raise InvalidRequestError(
                f"results of kind {job.kind} belong into the stream {self._result_streams[job.kind]}"
            )
        if job.state == JobState.DONE:
            record = reader.find_record(stream, job_id)
            return Done(DoneOutcome.ALREADY_DONE, 0 if record is None else record.sequence)
        if job.state in _FINAL:
            return Done(DoneOutcome.DROPPED)
        return None

    def _lose(self, find: Callable[[Reader], Sequence[JobRow]], reason: str) -> int:
        if not self._rows.read(find):
            return 0

        def change(transaction: Transaction) -> list[JobRow]:
            lost = list(find(transaction))
            for job in lost:
                count = job.lost_lease_count + 1
                job = dataclasses.replace(job, lease_id="", lost_lease_count=count, last_reason=reason)
                if count >= self._policy.max_lost_leases:
                    text = f"{count} leases were lost, the last one because {reason}"
                    self._bury(transaction, dataclasses.replace(job, last_reason=text))
                else:
                    transaction.update_job(dataclasses.replace(job, state=JobState.OPEN))
            return lost

        lost = self._rows.write(change)
        for job in lost:
            _LOGGER.warning("job %s lost its lease (%d so far): %s", job.job_id, job.lost_lease_count + 1, reason)
        if lost:
            self._wake()
        return len(lost)

    def _bury(self, transaction: Transaction, job: JobRow) -> None:
        job = dataclasses.replace(job, state=JobState.DEAD)
        transaction.update_job(job)
        event = self._dead_event(_report(job))
        # Somebody may have appended an event under this id; a job that cannot die would be tried for ever.
        if transaction.find_record(event.stream, event.record_id) is None:
            self._store.add(transaction, event)

    def _wake(self, kinds: Set[str] | None = None) -> None:
        """Have the claims look again that ask for jobs of these kinds, or all."""
        with self._lock:
            for waiter in self._waiters:
                if kinds is None or not waiter.kinds.isdisjoint(kinds):
                    waiter.has_news.set()


def _report(job: JobRow) -> JobReport:
    return JobReport(
        job_id=job.job_id,
        kind=JobKind(job.kind),
        state=job.state,
        failure_count=job.failure_count,
        lost_lease_count=job.lost_lease_count,
        worker=job.worker,
        last_reason=job.last_reason,
        last_traceback=job.last_traceback,
    )
