"""The service ``ledger``: the log and the job queue of one session, on the bus (DESIGN section 4)."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from vggt_motion.bus import calls, codec
from vggt_motion.bus.follow import SEVERAL_ENTRIES
from vggt_motion.bus.jobs import many_lines, one_line
from vggt_motion.bus.keys import last_chunk, service_of
from vggt_motion.bus.logs import is_told
from vggt_motion.bus.service import ServiceContext, run_service
from vggt_motion.bus.serving import Handler
from vggt_motion.bus.session import Bus, Closable
from vggt_motion.bus.wire import Payload, Pieces
from vggt_motion.config import Config, LedgerConfig
from vggt_motion.errors import (
    BusError,
    BusUnavailableError,
    CodecError,
    DiskFullError,
    LedgerError,
    RequestRefusedError,
    VggtMotionError,
)
from vggt_motion.ledger.admission import admitted, known_stream
from vggt_motion.ledger.directory import Ledger
from vggt_motion.ledger.jobs import JobPolicy
from vggt_motion.ledger.log import Append
from vggt_motion.ledger.store import Content, NewRecord, RecordRow, reserve_line
from vggt_motion.records import (
    Event,
    EventKind,
    JobCount,
    JobKind,
    JobReport,
    JobState,
    LedgerStatus,
    LogEntry,
    Stream,
    StreamPosition,
)

_log = logging.getLogger(__name__)

# New work comes in here; everything else finishes work that has begun.
INPUT_STREAMS: Final = frozenset({Stream.KEYFRAME.value})
RESULT_STREAMS: Final = {
    JobKind.DESCRIBE.value: Stream.DESCRIPTOR.value,
    JobKind.PREDICT.value: Stream.SUBMAP.value,
    JobKind.REGISTER.value: Stream.CONSTRAINT.value,
}
_TICK_S = 1.0
_TICKS_PER_LEASE = 8
_HEALTH_S = 1.0
_SIZES_S = 5.0  # the sum over all blobs is not asked for more often
_HISTORY = 16
_PUBLISHED_TOGETHER = 32
_PUBLISHED_BYTES = 32 * 2**10
_GATHER_S = 0.01  # acknowledgements go out first, and what comes together is read from the log together
_CROWDED_GATHER_S = 0.05  # while so much comes that reading it apart would hold up the next acknowledgements
_CROWD = 4
_FEW_WAITERS = 32
_CROWDED_WAIT_S = 1.0
_VANISHED_GRACE_S = 0.2
_RECONNECTED_GRACE_S = 2.0  # after our own link was down, tokens need this long to come back
_MAX_VANISHED = 4096
_JOIN_S = 1.0

# Long polls have threads of their own, so that they never hold up an append.
_APPEND_THREADS = 1  # what comes meanwhile goes together; two would alternate at every statement, and take longer
_APPENDS_AT_A_TIME = 64  # what comes meanwhile shares one fsync
_DONE_THREADS = 8
_READ_THREADS = 4
_CLAIM_THREADS = 64
_FEW_THREADS = 2
_BLOBS_REPLY_BYTES = 16 * 2**20  # and one blob more


def main(config: Config, *, directory: Path) -> int:
    """Serve the session in ``directory`` until told to stop.

    Returns:
        Exit code; 1 with one line if the directory is in use, damaged, or its disk fails.
    """
    return run_service("ledger", config, lambda context: _serve(context, directory))


def dead_event(report: JobReport, time_ns: int | None = None) -> NewRecord:
    """The record by which the log tells of a dead job."""
    event = Event(
        event_id=f"job_dead/{report.job_id}",
        kind=EventKind.JOB_DEAD,
        message=one_line(f"job {report.job_id} is dead: {report.last_reason}"),
        time_ns=time.time_ns() if time_ns is None else time_ns,
        detail={
            "job_id": report.job_id,
            "kind": report.kind.value,
            "reason": one_line(report.last_reason),
            "traceback": many_lines(report.last_traceback),
        },
    )
    return NewRecord(
        stream=Stream.EVENT.value,
        record_id=event.event_id,
        payload_type=codec.payload_type(Event),
        payload=codec.encode(event),
        identity_sha256=codec.identity_digest(event),
    )


def open_session(directory: Path, config: LedgerConfig) -> Ledger:
    """Open or create a session with the rules of the project.

    Raises:
        LedgerError: in use by another process, damaged, of a newer schema, or not writable.
    """
    return Ledger(
        directory,
        reserve_bytes=config.reserve_bytes,
        recent_bytes=config.recent_bytes,
        input_streams=INPUT_STREAMS,
        policy=JobPolicy(
            lease_duration_s=config.lease_duration_s,
            max_failures=config.max_failures,
            max_lost_leases=config.max_lost_leases,
            retry_backoff_s=config.retry_backoff_s,
        ),
        result_streams=RESULT_STREAMS,
        dead_event=dead_event,
    )


def _serve(context: ServiceContext, directory: Path) -> None:
    ledger = _open(context, directory)
    if ledger is None:
        return
    try:
        with contextlib.ExitStack() as undo:
            publisher = LogPublisher(context.bus, ledger)
            undo.callback(publisher.close)
            desk = Desk(ledger, publisher.wake)
            undo.callback(desk.close)
            presence = Presence()
            undo.callback(context.bus.watch_liveliness(context.bus.keys.all_alive(), presence.on_token).close)
            for server in desk.serve(context.bus, presence):
                undo.callback(server.close)
            undo.callback(ledger.jobs.close)  # first of all: ends the long polls
            _watch(context, ledger, desk, presence, publisher)
    finally:
        ledger.close()


def _open(context: ServiceContext, directory: Path) -> Ledger | None:
    while not context.stopping.is_set():
        try:
            return open_session(directory, context.config.ledger)
        except DiskFullError as error:
            context.set_health("waiting", str(error))
            context.stopping.wait(_HEALTH_S)
    return None


def _watch(context: ServiceContext, ledger: Ledger, desk: Desk, presence: Presence, publisher: LogPublisher) -> None:
    """The loop of the service: leases, and health."""
    next_health_s = 0.0
    tick_s = min(_TICK_S, context.config.ledger.lease_duration_s / _TICKS_PER_LEASE)
    while not context.stopping.wait(tick_s):
        failure = desk.failure or publisher.failure
        if failure is not None:
            raise failure
        is_connected = context.bus.is_connected
        try:
            gone = presence.take_vanished(is_connected=is_connected)
            lost = sum(ledger.jobs.release_worker(worker) for worker in gone)
            # While nobody can reach us, silence says nothing; the queue sees the gap and moves the deadlines.
            if is_connected:
                lost += ledger.jobs.tick()
            if lost:
                publisher.wake()
            if time.monotonic() >= next_health_s:
                next_health_s = time.monotonic() + _HEALTH_S
                _report(context, desk.status())
        except DiskFullError as error:
            context.set_health("waiting", str(error))


def _report(context: ServiceContext, status: LedgerStatus) -> None:
    counters = {f"records_{position.stream}": float(position.next_sequence) for position in status.positions}
    # Every one each time: health keeps what is not named, and a state that nobody is in any more is not counted.
    counters |= {f"jobs_{kind}_{state}": 0.0 for kind in JobKind for state in JobState}
    counters |= {f"jobs_{count.kind}_{count.state}": float(count.count) for count in status.job_counts}
    context.set_health(
        "working" if status.is_accepting else "waiting",
        status.detail,
        **counters,
        refused_requests=float(status.refused_request_count),
        stored_bytes=float(status.stored_bytes),
        free_bytes=float(status.free_bytes),
    )


class Presence:
    """Which workers have vanished; thread-safe.

    A token that ends is believed after a moment, and only while our own link is up: when the router goes, all tokens
    end and come back.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Nobody has vanished."""
        self._clock = clock
        self._lock = threading.Lock()
        self._vanished: OrderedDict[str, float | None] = OrderedDict()  # worker -> when to act, None once acted

    def on_token(self, key: str, is_alive: bool) -> None:
        """A liveliness token appeared or ended."""
        worker = "/".join(service_of(key))
        with self._lock:
            if is_alive:
                self._vanished.pop(worker, None)
                return
            self._vanished[worker] = self._clock() + _VANISHED_GRACE_S
            while len(self._vanished) > _MAX_VANISHED:
                self._vanished.popitem(last=False)

    def on_lease(self, worker: str) -> None:
        """A lease was given to a worker, which may have vanished while its claim was on its way."""
        with self._lock:
            if worker in self._vanished:
                self._vanished[worker] = self._clock() + _RECONNECTED_GRACE_S

    def take_vanished(self, *, is_connected: bool) -> list[str]:
        """The workers whose leases are to be ended now."""
        now_s = self._clock()
        with self._lock:
            due = [worker for worker, due_s in self._vanished.items() if due_s is not None and due_s <= now_s]
            for worker in due:
                self._vanished[worker] = None if is_connected else now_s + _RECONNECTED_GRACE_S
            return due if is_connected else []


class LogPublisher:
    """Publishes what is durable on ``log/{stream}``, in order; one thread.

    Never blocks for a slow subscriber: the log on disk is the truth, and followers read what they missed.
    """

    def __init__(self, bus: Bus, ledger: Ledger) -> None:
        """Start after what is there already: followers read that."""
        self._store = ledger.store
        self._cursors = {stream.value: 0 for stream in Stream} | self._store.positions()
        encoding = codec.encoding_of(LogEntry)
        self._publishers = {
            stream: bus.publisher(bus.keys.log(stream), blocking=False, history=_HISTORY, encoding=encoding)
            for stream in self._cursors
        }
        self._wake = threading.Event()
        self._is_closed = False
        self.failure: LedgerError | None = None
        self._thread = threading.Thread(target=self._run, name="publish the log", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Something may have become durable."""
        self._wake.set()

    def close(self) -> None:
        """Publish what is durable by now, and end."""
        self._is_closed = True
        self._wake.set()
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        count = 0
        is_last = False
        while not is_last:
            self._wake.wait()
            is_last = self._is_closed
            if not is_last:
                time.sleep(_GATHER_S if count < _CROWD else _CROWDED_GATHER_S)
            self._wake.clear()
            try:
                count = self._publish()
            except BusUnavailableError:
                return  # the session is closed
            except LedgerError as error:
                self.failure = error
                return

    def _publish(self) -> int:
        """Publish what is new; returns how many records that were."""
        published = 0
        for stream, end in self._store.positions().items():
            while self._cursors[stream] < end:
                rows = self._store.read(stream, self._cursors[stream])
                while rows:
                    count = _published_together(rows)
                    self._put(stream, [_entry(row) for row in rows[:count]])
                    self._cursors[stream] = rows[count - 1].sequence + 1
                    published += count
                    rows = rows[count:]
        return published

    def _put(self, stream: str, entries: Sequence[LogEntry]) -> None:
        try:
            if len(entries) == 1:
                self._publishers[stream].put(codec.encode(entries[0]))
            else:
                together = calls.ReadReply(tuple(entries), entries[-1].sequence + 1)
                self._publishers[stream].put(codec.encode(together), encoding=SEVERAL_ENTRIES)
        except BusUnavailableError:
            raise
        except BusError as error:
            extra = {"stream": stream, "sequence": entries[0].sequence, "reason": str(error)}
            _log.error("records cannot be published", extra=extra)


def _published_together(rows: Sequence[RecordRow]) -> int:
    """How many of the first rows go in one message, so that it stays small."""
    size_bytes = 0
    for count, row in enumerate(rows):
        size_bytes += len(row.payload)
        if count and (size_bytes > _PUBLISHED_BYTES or count == _PUBLISHED_TOGETHER):
            return count
    return len(rows)


class Desk:
    """Answers the calls of the ledger and of the job queue; thread-safe."""

    def __init__(self, ledger: Ledger, wake_publisher: Callable[[], None]) -> None:
        """Bind the open session."""
        self._ledger = ledger
        self._wake_publisher = wake_publisher
        self._lock = threading.Lock()
        self._refused_count = 0
        self._full_count = 0
        self._waiting_claims = 0
        self._stored_bytes = 0
        self._sizes_until_s = 0.0
        self._is_closed = False
        self.failure: LedgerError | None = None  # of the store: the service has to begin anew

    def serve(self, bus: Bus, presence: Presence) -> Iterator[Closable]:
        """Declare every key."""
        handlers: list[tuple[str, int, Handler]] = [
            (bus.keys.rpc("ledger", "read"), _READ_THREADS, lambda _, payload: self.read(payload)),
            (bus.keys.rpc("ledger", "blobs"), _READ_THREADS, lambda _, payload: self.blobs(payload)),
            (bus.keys.rpc("ledger", "status"), _FEW_THREADS, lambda _, payload: self.answer_status(payload)),
            (bus.keys.all_blobs(), _READ_THREADS, lambda key, _: self.blob(last_chunk(key))),
            (bus.keys.rpc("jobs", "submit"), _FEW_THREADS, lambda _, payload: self.submit(payload)),
            (bus.keys.rpc("jobs", "claim"), _CLAIM_THREADS, lambda _, payload: self.claim(payload, presence)),
            (bus.keys.rpc("jobs", "heartbeat"), _READ_THREADS, lambda _, payload: self.heartbeat(payload)),
            (bus.keys.rpc("jobs", "done"), _DONE_THREADS, lambda _, payload: self.done(payload)),
            (bus.keys.rpc("jobs", "fail"), _FEW_THREADS, lambda _, payload: self.fail(payload)),
            (bus.keys.rpc("jobs", "reports"), _FEW_THREADS, lambda _, payload: self.reports(payload)),
            (bus.keys.rpc("jobs", "cancel"), _FEW_THREADS, lambda _, payload: self.cancel(payload)),
        ]
        yield bus.serve_together(
            bus.keys.rpc("ledger", "append"),
            self.append,
            at_a_time=_APPENDS_AT_A_TIME,
            threads=_APPEND_THREADS,
            after=self._wake_publisher,
        )
        for key, threads, handler in handlers:
            yield bus.serve(key, self.guarded(handler), threads=threads)

    def close(self) -> None:
        """From now on, a call that fails because the session is closed may be repeated elsewhere."""
        self._is_closed = True

    def append(self, payloads: Sequence[bytes | memoryview]) -> list[bytes | Exception]:
        """``@rpc/ledger/append``, several at a time: each for itself, under one fsync."""
        wanted = [_admitted_or_why_not(payload) for payload in payloads]
        appended = iter(self._ledger.store.append_all([entry for entry in wanted if isinstance(entry, Append)]))
        outcomes = [next(appended) if isinstance(entry, Append) else entry for entry in wanted]
        return [
            self._answerable("append", outcome)
            if isinstance(outcome, Exception)
            else codec.encode(calls.AppendReply(outcome.sequence, outcome.was_known))
            for outcome in outcomes
        ]

    def read(self, payload: bytes) -> bytes:
        """``@rpc/ledger/read``."""
        request = codec.decode(calls.ReadRequest, payload)
        stream = known_stream(request.stream)
        # In this order: an answer without entries must not claim that there are more.
        end = self._ledger.store.positions().get(stream, 0)
        entries = tuple(map(_entry, self._ledger.store.read(stream, request.from_sequence, request.limit)))
        if entries:
            end = max(end, entries[-1].sequence + 1)
        return codec.encode(calls.ReadReply(entries, end))

    def blob(self, sha256: str) -> Payload:
        """``@rpc/ledger/blob/{sha256}``."""
        return Pieces((self._ledger.store.blob(sha256),))

    def blobs(self, payload: bytes) -> Payload:
        """``@rpc/ledger/blobs``."""
        contents: list[Content] = []
        size_bytes = 0
        for sha256 in codec.decode(calls.BlobsRequest, payload).sha256:
            contents.append(self._ledger.store.blob(sha256))
            size_bytes += len(contents[-1])
            if size_bytes >= _BLOBS_REPLY_BYTES:
                break
        return codec.encode_in_pieces(calls.BlobsReply(tuple(contents)))

    def answer_status(self, payload: bytes) -> bytes:
        """``@rpc/ledger/status``."""
        codec.decode(calls.StatusRequest, payload)
        return codec.encode(self.status())

    def status(self) -> LedgerStatus:
        """What the ledger says of itself."""
        store = self._ledger.store
        free_bytes = self._ledger.blobs.free_bytes()
        return LedgerStatus(
            positions=tuple(StreamPosition(stream, end) for stream, end in sorted(store.positions().items())),
            job_counts=tuple(
                JobCount(kind, state, count) for (kind, state), count in sorted(self._ledger.jobs.counts().items())
            ),
            stored_bytes=self._stored(),
            free_bytes=free_bytes,
            is_accepting=free_bytes >= store.reserve_bytes,
            detail="" if free_bytes >= store.reserve_bytes else reserve_line(free_bytes, store.reserve_bytes),
            refused_request_count=self._refused_count,
            ledger_id=self._ledger.ledger_id,
        )

    def submit(self, payload: bytes) -> bytes:
        """``@rpc/jobs/submit``."""
        submitted = self._ledger.jobs.submit(codec.decode(calls.SubmitRequest, payload).jobs)
        return codec.encode(calls.SubmitReply(submitted.new_count, submitted.known_count))

    def claim(self, payload: bytes, presence: Presence) -> bytes:
        """``@rpc/jobs/claim``."""
        request = codec.decode(calls.ClaimRequest, payload)
        with self._lock:
            self._waiting_claims += 1
            is_crowded = self._waiting_claims > _FEW_WAITERS
        try:
            # More claims than threads: each waits a little, so that all have their turn.
            wait_s = min(request.wait_s, _CROWDED_WAIT_S) if is_crowded else request.wait_s
            lease = self._ledger.jobs.claim(
                request.kinds, request.models, request.worker, wait_s, claim_id=request.claim_id
            )
        finally:
            with self._lock:
                self._waiting_claims -= 1
        if lease is not None:
            presence.on_lease(request.worker)
        return codec.encode(calls.ClaimReply(lease))

    def heartbeat(self, payload: bytes) -> bytes:
        """``@rpc/jobs/heartbeat``."""
        is_valid = self._ledger.jobs.heartbeat(codec.decode(calls.HeartbeatRequest, payload).lease_id)
        return codec.encode(calls.HeartbeatReply(is_valid))

    def done(self, payload: bytes) -> bytes:
        """``@rpc/jobs/done``."""
        request = codec.decode(calls.DoneRequest, payload)
        done = self._ledger.jobs.done(request.job_id, request.lease_id, *admitted(request.result))
        self._wake_publisher()
        return codec.encode(calls.DoneReply(done.outcome, done.sequence))

    def fail(self, payload: bytes) -> bytes:
        """``@rpc/jobs/fail``."""
        request = codec.decode(calls.FailRequest, payload)
        is_counted = self._ledger.jobs.fail(
            request.job_id, request.lease_id, request.reason, request.traceback, is_permanent=request.is_permanent
        )
        self._wake_publisher()
        return codec.encode(calls.FailReply(is_counted))

    def reports(self, payload: bytes) -> bytes:
        """``@rpc/jobs/reports``."""
        request = codec.decode(calls.ReportsRequest, payload)
        state: JobState | None = request.state
        return codec.encode(
            calls.ReportsReply(tuple(self._ledger.jobs.reports(state, request.after_job_id, request.limit)))
        )

    def cancel(self, payload: bytes) -> bytes:
        """``@rpc/jobs/cancel``."""
        return codec.encode(
            calls.CancelReply(self._ledger.jobs.cancel(codec.decode(calls.CancelRequest, payload).job_ids))
        )

    def _stored(self) -> int:
        with self._lock:
            if time.monotonic() >= self._sizes_until_s:
                sizes = self._ledger.store.sizes()
                self._stored_bytes = sizes.row_bytes + sizes.blob_bytes
                self._sizes_until_s = time.monotonic() + _SIZES_S
            return self._stored_bytes

    def guarded(self, handler: Handler) -> Handler:
        """A handler whose refusals are counted, and whose store may fail."""

        def guarded(key: str, payload: bytes) -> Payload:
            try:
                return handler(key, payload)
            except Exception as error:
                raise self._answerable(key, error) from error

        return guarded

    def _answerable(self, key: str, error: Exception) -> Exception:
        """Count and note what went wrong; returns what the caller is told."""
        if isinstance(error, (CodecError, RequestRefusedError, DiskFullError)):
            self._count_refusal(key, error)
        elif isinstance(error, LedgerError):
            # The caller may repeat it: the ledger is stopping, or will be started again.
            if not self._is_closed and self.failure is None:
                _log.error("the store failed", extra={"key": key, "reason": str(error)})
                self.failure = error
            return BusUnavailableError(str(error))
        elif not isinstance(error, VggtMotionError):
            self._count_refusal(key, error)
        return error

    def _count_refusal(self, key: str, error: Exception) -> None:
        with self._lock:
            self._refused_count += 1
            if isinstance(error, DiskFullError):
                self._full_count += 1
                if not is_told(self._full_count):
                    return  # the log may lie on that disk
        _log.warning("a request was refused", extra={"key": key, "reason": one_line(str(error))})


def _admitted_or_why_not(payload: bytes | memoryview) -> Append | Exception:
    try:
        return admitted(codec.decode(calls.AppendRequest, payload))
    except Exception as error:
        return error


def _entry(row: RecordRow) -> LogEntry:
    return LogEntry(
        stream=row.stream,
        sequence=row.sequence,
        record_id=row.record_id,
        payload_type=row.payload_type,
        payload=row.payload,
        append_time_ns=row.append_time_ns,
    )
