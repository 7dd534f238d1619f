"""What the gateway knows of the session: the log folded record by record, and what the services and the ledger say.

Fed by one thread, read by the event loop and by threads that build results. Each record costs a bounded amount of work,
whatever the length of the session; only a graph update costs in proportion to the graph.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from vggt_motion import __version__
from vggt_motion.backend.state import LogState
from vggt_motion.config import Config
from vggt_motion.gateway.hub import EventHub
from vggt_motion.gateway.models import (
    ClientStatus,
    ConstraintStatus,
    DeadJob,
    GraphStatus,
    JobStatus,
    LagStatus,
    LedgerStatusAnswer,
    MotionStatus,
    Notice,
    PredictorStatus,
    ReadinessAnswer,
    ServiceStatus,
    StatusAnswer,
    StreamStatus,
    SubmapStatus,
)
from vggt_motion.records import (
    BlobRef,
    Constraint,
    ConstraintKind,
    Event,
    GraphUpdate,
    HealthReport,
    JobKind,
    JobState,
    Keyframe,
    LedgerStatus,
    MotionState,
    Segment,
    Stream,
    SubmapGeometry,
    SubmapVerdict,
)

LogRecord = Keyframe | Segment | SubmapGeometry | Constraint | GraphUpdate | Event

_STALE_S = 5.0  # a ledger that was silent for so long does not answer
_LATEST = 50  # notices, doubtful submaps and dead jobs that the status lists


@dataclass(frozen=True)
class Snapshot:
    """The log at one moment, for composing a trajectory or a map; shared records, own containers."""

    keyframes: dict[str, Keyframe]
    segments: dict[int, Segment]
    submaps: dict[int, SubmapGeometry]  # by index, in the revisions that the graph holds
    graph: GraphUpdate


class GatewayState:
    """See the module. Thread-safe."""

    def __init__(
        self,
        config: Config,
        hub: EventHub | None = None,
        read_blob: Callable[[BlobRef], bytes] | None = None,
        look_at_services: Callable[[], None] | None = None,
    ) -> None:
        """Know nothing yet.

        Args:
            config: of the run.
            hub: those who listen.
            read_blob: fetches a payload of the ledger, from any thread; the map needs it.
            look_at_services: calls :meth:`set_services` with how they are now, from any thread; called for each status.
        """
        self.config = config
        self.read_blob = read_blob
        self._look_at_services = look_at_services
        self.hub = hub if hub is not None else EventHub()
        self._lock = threading.Lock()
        self._log = LogState()
        self._positions: dict[str, int] = {stream.value: 0 for stream in Stream}
        self._services: dict[tuple[str, str], HealthReport | None] = {}
        self._reported_at: dict[tuple[str, str], float] = {}  # time.monotonic()
        self._ledger: LedgerStatus | None = None
        self._ledger_seen_at = -_STALE_S
        self._newest_keyframe: Keyframe | None = None
        self._frame_counts: Counter[MotionState] = Counter()
        self._counted_segments: set[int] = set()
        self._verdicts: dict[int, tuple[int, SubmapVerdict, str]] = {}  # submap -> revision, verdict, model
        self._doubtful: deque[str] = deque(maxlen=_LATEST)
        self._constraints: Counter[tuple[ConstraintKind, bool]] = Counter()
        self._optimised_keyframes = 0
        self._optimised_until_ns: int | None = None
        self._notices: deque[Notice] = deque(maxlen=_LATEST)

    # --- fed by the service ---

    def apply(self, stream: Stream, sequence: int, record: LogRecord) -> None:
        """Take in one record; one that came before is passed over."""
        with self._lock:
            if sequence < self._positions[stream.value]:
                return
            self._positions[stream.value] = sequence + 1
            self._log.apply(record)
            news = self._count(record)
        if news is not None:
            self.hub.publish(stream.value, news)

    def set_services(
        self,
        services: Mapping[tuple[str, str], HealthReport | None],
        silences_s: Mapping[tuple[str, str], float] | None = None,
    ) -> None:
        """Who is alive, with the latest report of each, and how many seconds ago by our clock it came."""
        now = time.monotonic()
        with self._lock:
            self._services = dict(services)
            self._reported_at = {name: now - silence for name, silence in (silences_s or {}).items()}

    def set_ledger(self, status: LedgerStatus | None) -> None:
        """What the ledger answered; None = it did not."""
        with self._lock:
            if status is not None:
                self._ledger = status
                self._ledger_seen_at = time.monotonic()

    # --- read by the routes ---

    def snapshot(self) -> Snapshot | None:
        """The log at this moment; None before the first graph."""
        with self._lock:
            graph = self._log.latest_graph()
            if graph is None:
                return None
            ids = [(pose.submap_index, pose.submap_revision) for pose in graph.poses]
            submaps = {
                index: self._log.submaps[index, revision]
                for index, revision in ids
                if (index, revision) in self._log.submaps
            }
            return Snapshot(dict(self._log.keyframes), dict(self._log.segments), submaps, graph)

    def graph_key(self) -> tuple[str, int, int, int] | None:
        """Changes when the trajectory may have changed: graph, and how much of the other streams is known."""
        with self._lock:
            graph = self._log.latest_graph()
            if graph is None:
                return None
            return graph.record_id, len(self._log.keyframes), len(self._log.segments), len(self._log.submaps)

    def is_final(self) -> bool:
        """Whether the final graph is there."""
        with self._lock:
            graph = self._log.latest_graph()
            return graph is not None and graph.is_final

    def readiness(self) -> ReadinessAnswer:
        """Whether what the other answers say is complete and current."""
        with self._lock:
            return self._readiness()

    def status(self) -> StatusAnswer:
        """Everything that there is to say."""
        if self._look_at_services is not None:
            self._look_at_services()
        now = time.monotonic()
        with self._lock:
            return StatusAnswer(
                version=__version__,
                session=self.config.bus.session,
                phase=self._phase(),
                readiness=self._readiness(),
                services=[
                    _service_status(*name, report, self._reported_at.get(name), now)
                    for name, report in sorted(self._services.items())
                ],
                streams=[
                    StreamStatus(
                        stream=stream.value,
                        ledger_position=self._ledger.position(stream.value) if self._ledger is not None else None,
                        gateway_position=self._positions[stream.value],
                    )
                    for stream in Stream
                ],
                ledger=self._ledger_answer(),
                jobs=self._jobs(),
                dead_jobs=[_dead_job(event) for event in list(self._log.dead_jobs.values())[-_LATEST:]],
                dead_job_count=len(self._log.dead_jobs),
                motion=MotionStatus(
                    current=self._newest_keyframe.state.value if self._newest_keyframe is not None else None,
                    frame_counts={state.value: self._frame_counts[state] for state in MotionState},
                ),
                keyframes=len(self._log.keyframes),
                submaps=self._submaps(),
                constraints=ConstraintStatus(
                    accepted=sum(self._constraints[kind, True] for kind in ConstraintKind),
                    refused=sum(self._constraints[kind, False] for kind in ConstraintKind),
                    loops_accepted=self._constraints[ConstraintKind.LOOP, True],
                ),
                graph=_graph_status(self._log.latest_graph()),
                lag=self._lag(),
                predictor=PredictorStatus(
                    configured=self.config.inference.predictor,
                    reason=self.config.inference.predictor_reason,
                    models=dict(Counter(model for _, _, model in self._verdicts.values())),
                ),
                notices=list(self._notices),
                live_clients=ClientStatus(connected=self.hub.client_count, missed_events=self.hub.dropped_count),
            )

    # --- under the lock ---

    def _count(self, record: LogRecord) -> dict[str, Any] | None:
        """Keep the running figures; returns what the live clients are told."""
        match record:
            case Keyframe():
                if self._newest_keyframe is None or record.capture_time_ns >= self._newest_keyframe.capture_time_ns:
                    self._newest_keyframe = record
                return {
                    "keyframe_id": record.keyframe_id,
                    "frame_index": record.frame_index,
                    "capture_time_ns": record.capture_time_ns,
                    "state": record.state.value,
                }
            case Segment():
                if record.index not in self._counted_segments:
                    self._counted_segments.add(record.index)
                    self._frame_counts.update(frame.state for frame in record.frames)
                return {
                    "index": record.index,
                    "keyframes": len(record.base_keyframe_ids),
                    "frames": len(record.frames),
                    "closed_by": record.closed_by,
                }
            case SubmapGeometry():
                return self._count_submap(record)
            case Constraint():
                self._constraints[record.spec.kind, record.accepted] += 1
                return {
                    "constraint_id": record.record_id,
                    "accepted": record.accepted,
                    "reason": record.reason,
                    "inlier_ratio": record.inlier_ratio if record.accepted else None,
                }
            case GraphUpdate():
                return self._count_graph(record)
            case Event():
                self._notices.append(Notice(kind=record.kind.value, message=record.message, time_ns=record.time_ns))
                return {"kind": record.kind.value, "message": record.message, "time_ns": record.time_ns}

    def _count_submap(self, record: SubmapGeometry) -> dict[str, Any]:
        index, revision = record.spec.submap_index, record.spec.revision
        known = self._verdicts.get(index)
        if known is None or revision > known[0]:
            self._verdicts[index] = (revision, record.verdict, record.model)
        if record.verdict is not SubmapVerdict.GOOD:
            self._doubtful.append(f"submap {index} (revision {revision}): {record.verdict.value}: {record.reason}")
        return {
            "index": index,
            "revision": revision,
            "verdict": record.verdict.value,
            "reason": record.reason,
            "frames": len(record.frames),
        }

    def _count_graph(self, record: GraphUpdate) -> dict[str, Any] | None:
        graph = self._log.latest_graph()
        if graph is None or graph.record_id != record.record_id:
            return None  # an older one that came late
        self._optimised_keyframes = 0
        for pose in graph.poses:
            # Streams are not ordered mutually: a submap may be on its way still.
            submap = self._log.submaps.get((pose.submap_index, pose.submap_revision))
            if submap is None:
                continue
            self._optimised_keyframes += len(submap.spec.base_keyframe_ids)
            last = self._log.keyframes.get(submap.spec.base_keyframe_ids[-1])
            if last is not None:
                self._optimised_until_ns = max(self._optimised_until_ns or 0, last.capture_time_ns)
        return {
            "revision": graph.revision,
            "is_final": graph.is_final,
            "submaps": len(graph.poses),
            "components": len({pose.component for pose in graph.poses}),
            "breaks": len(graph.breaks),
        }

    def _phase(self) -> Literal["waiting", "running", "input_ended", "finished"]:
        graph = self._log.latest_graph()
        if graph is not None and graph.is_final:
            return "finished"
        if self._log.stream_ended is not None:
            return "input_ended"
        return "running" if self._log.keyframes else "waiting"

    def _is_ledger_answering(self) -> bool:
        return self._ledger is not None and time.monotonic() - self._ledger_seen_at < _STALE_S

    def _readiness(self) -> ReadinessAnswer:
        if self._ledger is None or not self._is_ledger_answering():
            return ReadinessAnswer(is_ready=False, reason="the ledger does not answer")
        behind = sum(
            max(0, self._ledger.position(stream.value) - self._positions[stream.value])
            for stream in Stream
            if stream is not Stream.DESCRIPTOR
        )
        # Records are in flight at any moment; a gateway that has just started has thousands to read.
        if behind > 100:
            return ReadinessAnswer(is_ready=False, reason=f"{behind} records of the log are still to be read")
        return ReadinessAnswer(is_ready=True, reason="")

    def _ledger_answer(self) -> LedgerStatusAnswer:
        status = self._ledger
        if status is None:
            return LedgerStatusAnswer(
                is_answering=False, is_accepting=False, stored_bytes=0, free_bytes=0, refused_requests=0
            )
        return LedgerStatusAnswer(
            is_answering=self._is_ledger_answering(),
            is_accepting=status.is_accepting,
            detail=status.detail,
            stored_bytes=status.stored_bytes,
            free_bytes=status.free_bytes,
            refused_requests=status.refused_request_count,
        )

    def _jobs(self) -> list[JobStatus]:
        status = self._ledger
        if status is None:
            return []
        return [
            JobStatus(kind=kind.value, **{state.value: status.job_count(state.value, kind.value) for state in JobState})
            for kind in JobKind
        ]

    def _submaps(self) -> SubmapStatus:
        counts = Counter(verdict for _, verdict, _ in self._verdicts.values())
        return SubmapStatus(
            closed_segments=len(self._log.segments),
            predicted=len(self._verdicts),
            verdicts={verdict.value: counts[verdict] for verdict in SubmapVerdict},
            doubtful=list(self._doubtful),
        )

    def _lag(self) -> LagStatus:
        newest = self._newest_keyframe
        video_s = None
        if newest is not None and self._optimised_until_ns is not None:
            video_s = max(0, newest.capture_time_ns - self._optimised_until_ns) / 1e9
        waiting = 0
        if self._ledger is not None:
            waiting = self._ledger.job_count(JobState.OPEN) + self._ledger.job_count(JobState.LEASED)
        return LagStatus(
            keyframes=max(0, len(self._log.keyframes) - self._optimised_keyframes),
            video_s=video_s,
            submaps=len(self._log.unpredicted_segments()),
            jobs_waiting=waiting,
        )


def _service_status(
    service: str, instance: str, report: HealthReport | None, reported_at: float | None, now: float
) -> ServiceStatus:
    return ServiceStatus(
        service=service,
        instance=instance,
        state=report.state if report is not None else "silent",
        detail=report.detail if report is not None else "alive, no report of health yet",
        report_age_s=now - reported_at if reported_at is not None else None,
        resident_bytes=report.resident_bytes if report is not None else None,
        counters=report.counters if report is not None else {},
    )


def _dead_job(event: Event) -> DeadJob:
    detail = event.detail
    return DeadJob(
        job_id=detail.get("job_id", event.event_id),
        kind=detail.get("kind", ""),
        reason=detail.get("reason", event.message),
        traceback=detail.get("traceback", ""),
    )


def _graph_status(graph: GraphUpdate | None) -> GraphStatus | None:
    if graph is None:
        return None
    used = sum(edge.is_used for edge in graph.edges)
    return GraphStatus(
        revision=graph.revision,
        is_final=graph.is_final,
        submaps=len(graph.poses),
        components=len({pose.component for pose in graph.poses}),
        edges_used=used,
        edges_switched_off=len(graph.edges) - used,
        breaks=list(graph.breaks),
    )
