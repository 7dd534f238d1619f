"""What every worker does around its numerics: claim, heartbeat, compute in a child, deliver (DESIGN section 4)."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from vggt_motion.bus.ledger import LedgerClient
from vggt_motion.bus.service import ServiceContext
from vggt_motion.compute import ComputeCancelledError, ComputeChild, ComputeError
from vggt_motion.errors import BusUnavailableError, DiskFullError, InputError, VggtMotionError
from vggt_motion.records import BlobRef, JobKind, Lease, Stream

_log = logging.getLogger(__name__)
_CLAIM_WAIT_S = 10.0
_RETRY_S = 0.5
_HEARTBEATS_PER_LEASE = 4
_WARM_UP_DEADLINE_S = 1800.0  # no job waits for it, and compilation on a busy machine takes minutes
_LONGEST_YIELD_S = 5.0


@dataclass(frozen=True)
class Computation:
    """A call for the child: a module-level function and its arguments."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    detail: str  # one line for status and log
    # For several at a time, where that is faster: from their arguments to a list of results, or reasons of failure.
    of_several: Callable[[list[tuple[Any, ...]]], list[Any]] | None = None


class BlobCache:
    """Payloads of the last task: neighbouring tasks share most of theirs. Bounded by one task's payloads."""

    def __init__(self, ledger: LedgerClient) -> None:
        self._ledger = ledger
        self._last: dict[str, bytes] = {}

    def fetch(self, refs: Sequence[BlobRef]) -> list[bytes]:
        """The payloads in the order of their references."""
        missing = {ref.sha256: ref for ref in refs if ref.sha256 not in self._last}
        fetched = dict(zip(missing, self._ledger.blobs(list(missing.values())), strict=True))
        known = self._last | fetched
        current = self._last = {ref.sha256: known[ref.sha256] for ref in refs}
        return [current[ref.sha256] for ref in refs]


def work(
    context: ServiceContext,
    *,
    kinds: Sequence[JobKind],
    models: Sequence[str],
    stream: Stream,
    prepare: Callable[[Lease], Computation],
    deadline_s: float,
    warm_up: Computation | None = None,
    warm_up_deadline_s: float | None = None,
) -> None:
    """Serve jobs until the service is told to stop.

    Args:
        context: of the service.
        kinds: of jobs that this worker can do.
        models: that it offers.
        stream: that the results belong to.
        prepare: fetches the inputs of a job; runs here and may use the bus. The function that it names returns the
            record and the payloads that the record refers to.
        deadline_s: seconds that one computation may take.
        warm_up: called in the child once, so that its imports do not delay the first job; returns one line for status
            and log on what this worker offers, and how many jobs it takes together at most, or nothing.
        warm_up_deadline_s: seconds that it may take; None = as long as any computation.

    Raises:
        InputError: the warm-up failed: this worker cannot do its work as it is configured.
    """
    child = ComputeChild(f"{context.service}-{context.instance}")
    done = failed = 0
    try:
        offer, batch = "", 1
        if warm_up is not None:
            offer, batch = _warm_up(context, child, warm_up, warm_up_deadline_s or deadline_s)
        while not context.stopping.is_set():
            context.set_health("idle", offer, jobs_done=done, jobs_failed=failed)
            try:
                lease = context.jobs.claim(kinds, models, context.worker, _CLAIM_WAIT_S)
            except (BusUnavailableError, DiskFullError) as error:
                context.set_health("waiting", str(error), jobs_done=done, jobs_failed=failed)
                context.stopping.wait(_RETRY_S)
                continue
            if lease is None:
                continue
            leases = [lease]
            # One that failed before is tried alone, so that it cannot take others with it again.
            while (
                len(leases) < batch and lease.attempt == 1 and (more := _claim_now(context, kinds, models)) is not None
            ):
                leases.append(more)
            if len(leases) == 1:
                count = int(_carry_out(context, child, lease, stream, prepare, deadline_s))
            else:
                count = _carry_out_together(context, child, leases, stream, prepare, deadline_s)
            done, failed = done + count, failed + len(leases) - count
    except ComputeCancelledError:
        return  # told to stop: the lease ends with our liveliness token and the job runs elsewhere
    finally:
        child.kill()


def _claim_now(context: ServiceContext, kinds: Sequence[JobKind], models: Sequence[str]) -> Lease | None:
    try:
        return context.jobs.claim(kinds, models, context.worker, 0.0)
    except (BusUnavailableError, DiskFullError):
        return None


def _warm_up(context: ServiceContext, child: ComputeChild, warm_up: Computation, deadline_s: float) -> tuple[str, int]:
    context.set_health("starting", warm_up.detail)
    try:
        answer = child.call(
            warm_up.function,
            *warm_up.arguments,
            deadline_s=max(deadline_s, _WARM_UP_DEADLINE_S),
            on_tick=lambda: not context.stopping.is_set(),
        )
    except ComputeCancelledError:
        raise
    except ComputeError as error:
        raise InputError(str(error)) from error
    offer, batch = answer or ("", 1)
    _log.info("ready", extra={"offer": offer, "batch": batch})
    return offer, int(batch)


def _carry_out(
    context: ServiceContext,
    child: ComputeChild,
    lease: Lease,
    stream: Stream,
    prepare: Callable[[Lease], Computation],
    deadline_s: float,
) -> bool:
    job = lease.job
    begin = time.monotonic()
    try:
        computation = prepare(lease)
        context.set_health("working", computation.detail)
        keeper = _LeaseKeeper(context, lease)
        record, blobs = child.call(
            computation.function, *computation.arguments, deadline_s=deadline_s, on_tick=keeper.tick
        )
        is_committed = _hand_in(context, keeper, stream, record, blobs)
    except ComputeCancelledError:
        if context.stopping.is_set():
            raise
        _log.warning("lease lost, the job runs elsewhere", extra={"job": job.job_id})
        return False
    except BusUnavailableError as error:
        _log.warning("link lost, the job will be repeated", extra={"job": job.job_id, "reason": str(error)})
        return False
    except VggtMotionError as error:
        text = error.traceback_text if isinstance(error, ComputeError) else traceback.format_exc()
        _report_failure(context, lease, str(error), text)
        _yield(context, [lease])
        return False
    seconds = time.monotonic() - begin
    _log.info("job done", extra={"job": job.job_id, "seconds": round(seconds, 3), "committed": is_committed})
    return True


def _carry_out_together(
    context: ServiceContext,
    child: ComputeChild,
    leases: Sequence[Lease],
    stream: Stream,
    prepare: Callable[[Lease], Computation],
    deadline_s: float,
) -> int:
    """Several jobs in one call of the child; returns how many were done."""
    begin = time.monotonic()
    keepers = [_LeaseKeeper(context, lease) for lease in leases]
    failed: list[Lease] = []
    done = 0

    def tick() -> bool:
        # A lease that is lost does not stop the others, and a late result is taken once.
        is_kept = [keeper.tick() for keeper in keepers]
        return any(is_kept)

    def fail(lease: Lease, reason: str, traceback_text: str) -> None:
        _report_failure(context, lease, reason, traceback_text)
        failed.append(lease)

    try:
        computations = [prepare(lease) for lease in leases]
        context.set_health("working", f"{len(leases)} jobs from {computations[0].detail} on")
        function = computations[0].of_several
        if function is None:
            raise ComputeError("jobs that are not made to be computed together")
        arguments = [computation.arguments for computation in computations]
        outcomes = child.call(function, arguments, deadline_s=deadline_s * len(leases), on_tick=tick)
        for keeper, outcome in zip(keepers, outcomes, strict=True):
            if isinstance(outcome, str):
                fail(keeper.lease, outcome, "")
                continue
            record, blobs = outcome
            is_committed = _hand_in(context, keeper, stream, record, blobs)
            done += 1
            seconds = (time.monotonic() - begin) / len(leases)
            _log.info(
                "job done",
                extra={"job": keeper.lease.job.job_id, "seconds": round(seconds, 3), "committed": is_committed},
            )
    except ComputeCancelledError:
        if context.stopping.is_set():
            raise
        _log.warning("leases lost, the jobs run elsewhere", extra={"jobs": len(leases)})
    except BusUnavailableError as error:
        _log.warning("link lost, the jobs will be repeated", extra={"jobs": len(leases), "reason": str(error)})
    except VggtMotionError as error:
        text = error.traceback_text if isinstance(error, ComputeError) else traceback.format_exc()
        for lease in leases[done + len(failed) :]:
            fail(lease, str(error), text)
    if failed:
        _yield(context, failed)
    return done


def _report_failure(context: ServiceContext, lease: Lease, reason: str, traceback_text: str) -> None:
    job = lease.job
    _log.warning("job failed", extra={"job": job.job_id, "attempt": lease.attempt, "reason": reason})
    try:
        context.jobs.fail(lease, reason, traceback_text)
    except VggtMotionError as report_error:
        _log.warning("failure not reported", extra={"job": job.job_id, "reason": str(report_error)})


def _yield(context: ServiceContext, leases: Sequence[Lease]) -> None:
    """Let other workers have jobs first that failed here: they may have what it lacked, memory above all.

    A job is open again after the ledger's back-off, which doubles with each failure; we come back a little later.
    """
    back_off_s = context.config.ledger.retry_backoff_s * 2.0 ** (max(lease.attempt for lease in leases) - 1)
    context.set_health("waiting", f"a job failed here: {leases[0].job.job_id}")
    context.stopping.wait(min(2.0 * back_off_s, _LONGEST_YIELD_S))


def _hand_in(
    context: ServiceContext, keeper: _LeaseKeeper, stream: Stream, record: Any, blobs: Sequence[bytes]
) -> bool:
    """Hand in a result; while the ledger has no space, wait with it: it was dear, and the job has not failed."""
    while True:
        try:
            return context.jobs.done(keeper.lease, stream, record.record_id, record, blobs)
        except DiskFullError as error:
            context.set_health("waiting", str(error))
        # Also without the lease: a late result is taken once.
        keeper.tick()
        if context.stopping.wait(_RETRY_S):
            raise ComputeCancelledError("told to stop")


class _LeaseKeeper:
    """Sends heartbeats from the worker's own loop: a worker that hangs loses its lease, one that computes does not."""

    def __init__(self, context: ServiceContext, lease: Lease) -> None:
        self._context, self.lease = context, lease
        self._interval_s = lease.duration_s / _HEARTBEATS_PER_LEASE
        self._next = time.monotonic() + self._interval_s

    def tick(self) -> bool:
        """Whether to go on; sends a heartbeat when one is due."""
        if self._context.stopping.is_set():
            return False
        if time.monotonic() < self._next:
            return True
        self._next = time.monotonic() + self._interval_s
        try:
            return self._context.jobs.heartbeat(self.lease.lease_id)
        except (BusUnavailableError, DiskFullError):
            return True  # that may be over before the result is there, and a late result is still worth something
