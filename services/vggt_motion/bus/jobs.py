"""Client of the job queue (DESIGN section 4): claim, heartbeat, done or fail."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Sequence

from vggt_motion.bus import calls, codec
from vggt_motion.bus.codec import Record
from vggt_motion.bus.ledger import append_request
from vggt_motion.bus.retry import retry
from vggt_motion.bus.session import Bus
from vggt_motion.records import DoneOutcome, Job, JobKind, JobReport, JobState, Lease

_DONE_PATIENCE_S = 120.0
_FAIL_PATIENCE_S = 20.0
_REPORTS_PER_PAGE = 500
_JOBS_PER_SUBMIT_BYTES = 16 * 2**20
_MAX_REASON_CHARS = 2000
_MAX_TRACEBACK_CHARS = 32_000


class JobClient:
    """Calls of the job queue. Thread-safe; each thread claims for itself."""

    def __init__(self, bus: Bus) -> None:
        """Bind the bus."""
        self._bus = bus
        self._claims = threading.local()

    def submit(self, jobs: Sequence[Job]) -> tuple[int, int]:
        """Put jobs into the queue; those that it knows stay as they are.

        Returns:
            How many were new and how many known.

        Raises:
            BusUnavailableError: nobody answers; submitting again is safe.
            RequestRefusedError: a job id is known with another content.
        """
        new = known = 0
        for batch in _batches(jobs):
            reply = codec.decode(
                calls.SubmitReply, self._request("submit", codec.encode(calls.SubmitRequest(tuple(batch))))
            )
            new, known = new + reply.new_count, known + reply.known_count
        return new, known

    def claim(self, kinds: Sequence[JobKind], models: Sequence[str], worker: str, wait_s: float) -> Lease | None:
        """Get a job to do, waiting for one.

        Args:
            kinds: that this worker can do.
            models: that it offers.
            worker: ``service/instance``: the lease ends with this process's liveliness token.
            wait_s: how long to wait at the ledger.

        Returns:
            The lease, or None if no job came.

        Raises:
            BusUnavailableError: nobody answers. If a lease was given all the same, this thread's next claim gets it.
        """
        claim_id = getattr(self._claims, "open_id", None) or secrets.token_hex(16)
        self._claims.open_id = claim_id
        request = calls.ClaimRequest(tuple(kinds), tuple(models), worker, wait_s, claim_id)
        timeout_s = wait_s + self._bus.config.request_timeout_s
        reply = codec.decode(
            calls.ClaimReply, self._request("claim", codec.encode(request), timeout_s=timeout_s, is_long_poll=True)
        )
        self._claims.open_id = None
        return reply.lease

    def heartbeat(self, lease_id: str) -> bool:
        """Keep a lease; False: it is gone, stop working on it.

        Raises:
            BusUnavailableError: nobody answers; the lease may live on.
        """
        reply = codec.decode(
            calls.HeartbeatReply, self._request("heartbeat", codec.encode(calls.HeartbeatRequest(lease_id)))
        )
        return reply.is_valid

    def done(
        self,
        lease: Lease,
        stream: str,
        record_id: str,
        record: Record,
        blobs: Sequence[bytes] = (),
        *,
        patience_s: float | None = _DONE_PATIENCE_S,
    ) -> bool:
        """Hand in a result: record, blobs and the job's completion are committed together.

        Tries again while nobody answers: results are dear, and handing one in twice is safe.

        Returns:
            Whether the job is done, by this result or an earlier one; False if the result was dropped.

        Raises:
            BusUnavailableError: patience is at its end, or the process was told to stop.
            RequestRefusedError: refused.
            DiskFullError: the ledger takes nothing until there is space again.
            CodecError: the record breaks a rule of the wire.
        """
        result = append_request(stream, record_id, record, blobs)
        payload = codec.encode(calls.DoneRequest(lease.job.job_id, lease.lease_id, result))
        reply = retry(
            self._bus,
            lambda: codec.decode(calls.DoneReply, self._request("done", payload)),
            patience_s=patience_s,
            what=f"done {lease.job.job_id}",
        )
        return reply.outcome in (DoneOutcome.COMMITTED, DoneOutcome.ALREADY_DONE)

    def fail(self, lease: Lease, reason: str, traceback_text: str = "", *, is_permanent: bool = False) -> bool:
        """Report that a job cannot be done; False: the lease was gone, nothing was counted.

        Raises:
            BusUnavailableError: nobody answers.
        """
        request = calls.FailRequest(
            lease.job.job_id, lease.lease_id, one_line(reason), many_lines(traceback_text), is_permanent
        )
        payload = codec.encode(request)
        reply = retry(
            self._bus,
            lambda: codec.decode(calls.FailReply, self._request("fail", payload)),
            patience_s=_FAIL_PATIENCE_S,
            what=f"fail {lease.job.job_id}",
        )
        return reply.is_counted

    def reports(self, state: JobState | None = None) -> list[JobReport]:
        """All jobs, or those in one state, in order of their ids.

        Raises:
            BusUnavailableError: nobody answers.
        """
        reports: list[JobReport] = []
        while True:
            after = reports[-1].job_id if reports else ""
            request = codec.encode(calls.ReportsRequest(state, after, _REPORTS_PER_PAGE))
            page = codec.decode(calls.ReportsReply, self._request("reports", request)).reports
            if not page or page[-1].job_id <= after:
                return reports
            reports.extend(page)

    def cancel(self, job_ids: Sequence[str]) -> int:
        """Take jobs back that are not done; returns how many were.

        Raises:
            BusUnavailableError: nobody answers.
        """
        request = codec.encode(calls.CancelRequest(tuple(job_ids)))
        return codec.decode(calls.CancelReply, self._request("cancel", request)).cancelled_count

    def _request(
        self, call: str, payload: bytes, *, timeout_s: float | None = None, is_long_poll: bool = False
    ) -> bytes:
        key = self._bus.keys.rpc("jobs", call)
        return self._bus.request(key, payload, timeout_s=timeout_s, is_long_poll=is_long_poll)


def one_line(text: str) -> str:
    """Foreign text (of an exception) as the wire allows it: one line, printable, not too long."""
    flat = " ".join(text.split())
    return "".join(character if character.isprintable() else "?" for character in flat)[:_MAX_REASON_CHARS]


def many_lines(text: str) -> str:
    """Foreign text of many lines as the wire allows it: printable, its end if it is too long."""
    kept = (character if character.isprintable() or character in "\n\t" else "?" for character in text)
    return "".join(kept)[-_MAX_TRACEBACK_CHARS:]


def _batches(jobs: Sequence[Job]) -> list[list[Job]]:
    batches: list[list[Job]] = [[]] if jobs else []
    size = 0
    for job in jobs:
        if size + len(job.payload) > _JOBS_PER_SUBMIT_BYTES and batches[-1]:
            batches.append([])
            size = 0
        batches[-1].append(job)
        size += len(job.payload)
    return batches
