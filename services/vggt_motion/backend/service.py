"""The backend: follows the log, submits the jobs that it calls for, and solves the pose graph (DESIGN 3.6 and 4).

While the run lasts, every new submap or constraint goes into the live graph, at once or with registrations that are at
work, and what that then says is published: a live update holds all that the log held when it was begun. The final graph
is a fresh batch over everything. All state is a fold of the log: killed and started again, the backend plans the same
jobs and solves the same final graph.
"""

from __future__ import annotations

import logging
import time

from vggt_motion.backend import live, planner, posegraph
from vggt_motion.backend.state import LogState
from vggt_motion.bus import codec
from vggt_motion.bus.log import LogFollower, LogRecord
from vggt_motion.bus.service import ServiceContext, run_service
from vggt_motion.compute import ComputeCancelledError, ComputeChild
from vggt_motion.config import Config
from vggt_motion.errors import BusUnavailableError, DiskFullError, RequestRefusedError, VggtMotionError
from vggt_motion.records import Constraint, GraphUpdate, Job, JobKind, Keyframe, Segment, Stream

_log = logging.getLogger(__name__)
_IDLE_S = 1.0
_RETRY_S = 0.5
_MAX_SOLVE_FAILURES = 3


def main(config: Config) -> int:
    """Run the backend until it is told to stop; returns the exit code of the process."""
    return run_service("backend", config, lambda context: _Backend(context).serve())


class _Backend:
    def __init__(self, context: ServiceContext) -> None:
        self._context = context
        self._config = context.config
        self._state = LogState()
        self._log = LogFollower(context.bus)
        self._child = ComputeChild("backend")
        self._live = live.LiveFeed()
        self._pace = live.LivePace()
        self._submitted: set[str] = set()
        self._is_complete = False
        self._is_registering = False
        self._awaited: set[str] = set()  # keyframes that a segment names and that have not come
        self._has_unsubmitted = False
        self._retry_at = 0.0
        self._solve_failures = 0
        self._has_ended = False  # the final graph is in the ledger, though perhaps not yet back from there

    def serve(self) -> None:
        self._context.stopping.wakes(self._log.wake)
        try:
            self._child.start()  # its imports take longer than the first submap should wait for
            while not self._context.stopping.is_set():
                if not self._pump() and not self._solve():
                    until_due_s = self._until_live_graph_s()
                    idle_s = _RETRY_S if self._has_unsubmitted else _IDLE_S
                    self._log.wait(idle_s if until_due_s is None else min(idle_s, until_due_s))
        except ComputeCancelledError:
            return
        finally:
            self._child.kill()
            self._log.close()

    def _pump(self) -> bool:
        """Take in what is new in the log and submit what it calls for; whether anything was new."""
        records = self._log.poll()
        is_planned = [self._apply(record) for record in records]
        if any(is_planned) or (self._has_unsubmitted and time.monotonic() >= self._retry_at):
            self._submit()
        if records:
            self._report()
        return bool(records)

    def _apply(self, record: LogRecord) -> bool:
        """Take in one record; whether the plan may change by it: most are keyframes that no segment names yet."""
        state = self._state
        state.apply(record)
        match record:
            case Keyframe():
                was_awaited = record.keyframe_id in self._awaited
                self._awaited.discard(record.keyframe_id)
                return was_awaited
            case Segment():
                named = (*record.overlap_keyframe_ids, *record.base_keyframe_ids)
                self._awaited.update(name for name in named if name not in state.keyframes)
            case GraphUpdate():
                return False
            case _:
                pass
        return True

    def _submit(self) -> None:
        called_for = planner.next_jobs(self._state, self._config)
        self._is_registering = any(job.kind is JobKind.REGISTER for job in called_for)
        self._is_complete = not called_for and planner.is_complete(self._state, self._config)
        planned = [job for job in called_for if job.job_id not in self._submitted]
        self._has_unsubmitted = bool(planned)
        if not planned:
            return
        model = self._config.inference.predictor
        jobs = [
            Job(
                job_id=job.job_id,
                kind=job.kind,
                payload=codec.encode(job.task),
                payload_type=type(job.task).__name__,
                priority=job.priority,
                model=model if job.kind is JobKind.PREDICT else "",
            )
            for job in planned
        ]
        try:
            self._context.jobs.submit(jobs)
        except (BusUnavailableError, DiskFullError) as error:
            self._hold_up(f"jobs not submitted yet: {error}")
            return
        self._submitted.update(job.job_id for job in planned)
        self._has_unsubmitted = False

    def _report(self) -> None:
        state = self._state
        graph = state.latest_graph()
        self._context.set_health(
            "ended" if graph is not None and graph.is_final else "working",
            f"{len(state.segments)} segments, {len(state.submaps)} submaps, {len(state.constraints)} constraints",
            segments=len(state.segments),
            submaps=len(state.submaps),
            constraints=len(state.constraints),
            dead_jobs=len(state.dead_jobs),
            graph_revision=graph.revision if graph is not None else -1,
        )

    def _solve(self) -> bool:
        """Solve the graph if there is anything new to solve, or the final one when all is done; whether it did."""
        state = self._state
        if self._is_over():
            return False
        is_final = self._is_complete
        inputs = state.graph_input_count
        if not is_final and self._until_live_graph_s() != 0.0:
            return False
        try:
            # The revision counts what went in, so that a backend that was killed and started again makes it again.
            update = self._solve_final(inputs) if is_final else self._update_live(inputs)
        except ComputeCancelledError:
            raise
        except VggtMotionError as error:
            self._solve_failures += 1
            _log.error("the pose graph was not solved", extra={"reason": str(error), "final": is_final})
            if self._solve_failures >= _MAX_SOLVE_FAILURES:
                raise
            self._context.stopping.wait(_RETRY_S)
            return True
        self._solve_failures = 0
        self._pace.solved(inputs)
        try:
            self._has_ended = self._append(update) and is_final
        except RequestRefusedError as error:
            if is_final:
                raise
            # A backend before this one had seen as many records, but not the same ones: its graph stands for now.
            _log.info("live graph not kept", extra={"reason": str(error)})
        return True

    def _is_over(self) -> bool:
        graph = self._state.latest_graph()
        return self._has_ended or (graph is not None and graph.is_final)

    def _until_live_graph_s(self) -> float | None:
        """See :meth:`.live.LivePace.wait_s`; after the final graph, whatever still comes, none is due."""
        if self._is_over():
            return None
        graph = self._state.latest_graph()
        if graph is not None:
            self._pace.solved(graph.revision)  # perhaps by a backend before this one
        return self._pace.wait_s(
            self._state.graph_input_count, is_registering=self._is_registering, now_s=time.monotonic()
        )

    def _solve_final(self, revision: int) -> GraphUpdate:
        state = self._state
        nodes = [(index, geometry.spec.revision) for index, geometry in state.usable_submaps().items()]
        return self._child.call(
            _solve_graph,
            nodes,
            planner.current_constraints(state),
            self._config,
            revision,
            state.is_metric,
            deadline_s=self._config.backend.solve_deadline_s,
            on_tick=self._keep_up,
        )

    def _update_live(self, revision: int) -> GraphUpdate:
        undecided = planner.undecided_joints(self._state, self._config)
        while True:
            # What is new is sent, until the child's graph turns out to be another one than ours: then everything.
            update = self._child.call(
                live.advance,
                self._live.next_step(self._state),
                self._config.backend,
                revision,
                undecided,
                deadline_s=self._config.backend.solve_deadline_s,
                on_tick=self._keep_up,
            )
            if update is not None:
                self._live.confirm()
                return update
            self._live.restart()

    def _append(self, update: GraphUpdate) -> bool:
        """Append, for as long as it takes; False: told to stop before it was."""
        while True:
            try:
                self._context.ledger.append(Stream.GRAPH, update.record_id, update)
                return True
            except DiskFullError as error:
                self._hold_up(f"graph not appended yet: {error}")
            if self._context.stopping.wait(_RETRY_S):
                return False

    def _hold_up(self, reason: str) -> None:
        """Say why it does not go on, and wait a moment with the next attempt."""
        _log.warning("waiting", extra={"reason": reason})
        self._context.set_health("waiting", reason)
        self._retry_at = time.monotonic() + _RETRY_S

    def _keep_up(self) -> bool:
        if self._context.stopping.is_set():
            return False
        self._pump()
        return True


def _solve_graph(
    nodes: list[tuple[int, int]], constraints: list[Constraint], config: Config, revision: int, is_metric: bool
) -> GraphUpdate:
    return posegraph.solve(nodes, constraints, config.backend, revision=revision, is_final=True, is_metric=is_metric)
