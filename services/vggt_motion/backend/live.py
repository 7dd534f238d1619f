"""The live graph across the border to the computing process: what is new goes there, the whole estimate comes back.

The graph itself (:class:`.incremental.LiveGraph`) lives in the child, for that is where GTSAM may hold the interpreter.
A child that was ended and started again has none; it says so, and is sent everything once more.
"""

from __future__ import annotations

from dataclasses import dataclass

from vggt_motion.backend.incremental import LiveGraph
from vggt_motion.backend.state import LogState
from vggt_motion.config import BackendConfig
from vggt_motion.records import Constraint, GraphUpdate

REGISTRATION_PATIENCE_S = 1.0


class LivePace:
    """When a live graph is due: at once, but for a submap whose place in the graph is about to be measured.

    Without its registrations a new submap stands apart, and a new revision of one tears the graph in two; a moment
    later they are there, as a rule. Where registering takes long, what there is is shown all the same.
    """

    def __init__(self) -> None:
        """Nothing is solved yet."""
        self._solved_inputs = -1  # how many submaps and constraints the newest graph was solved from
        self._since_s: float | None = None  # when the first of those came that it was not solved from

    def wait_s(self, inputs: int, *, is_registering: bool, now_s: float) -> float | None:
        """Seconds until a live graph is due, if nothing more comes; None: it would say nothing new.

        Args:
            inputs: number of submaps and constraints in the log.
            is_registering: whether there are submaps whose registration is still to come.
            now_s: by a clock that does not jump.
        """
        if inputs == 0 or inputs <= self._solved_inputs:
            self._since_s = None
            return None
        if self._since_s is None:
            self._since_s = now_s
        return max(0.0, self._since_s + REGISTRATION_PATIENCE_S - now_s) if is_registering else 0.0

    def solved(self, inputs: int) -> None:
        """A graph was solved from so many, here or by a backend before this one."""
        if inputs > self._solved_inputs:
            self._solved_inputs = inputs
            self._since_s = None


@dataclass(frozen=True)
class LiveStep:
    """What came since the step before."""

    number: int  # 0 begins a new graph
    nodes: tuple[tuple[int, int], ...]  # (submap index, revision)
    constraints: tuple[Constraint, ...]
    is_metric: bool


class LiveFeed:
    """What the child knows, as the service sees it."""

    def __init__(self) -> None:
        """The child knows nothing."""
        self._next = 0
        self._is_metric = False
        self._nodes: dict[int, int] = {}
        self._constraint_ids: set[str] = set()
        self._step: LiveStep | None = None

    def next_step(self, state: LogState) -> LiveStep:
        """What the log holds and the child does not; all of it where the graph turns metric or stops being so."""
        if state.is_metric is not self._is_metric:
            self.restart()
            self._is_metric = state.is_metric
        nodes = {index: geometry.spec.revision for index, geometry in state.usable_submaps().items()}
        self._step = LiveStep(
            self._next,
            tuple((index, revision) for index, revision in nodes.items() if self._nodes.get(index) != revision),
            tuple(c for c_id, c in state.constraints.items() if c_id not in self._constraint_ids),
            self._is_metric,
        )
        return self._step

    def confirm(self) -> None:
        """The child has taken the step in."""
        if self._step is not None:
            self._nodes.update(self._step.nodes)
            self._constraint_ids.update(constraint.record_id for constraint in self._step.constraints)
            self._next += 1
            self._step = None

    def restart(self) -> None:
        """The child knows nothing again: the next step brings everything."""
        self._next, self._step = 0, None
        self._nodes.clear()
        self._constraint_ids.clear()


@dataclass
class _Held:
    graph: LiveGraph
    next_number: int


_held: list[_Held] = []  # of this process: none or one


def advance(
    step: LiveStep, config: BackendConfig, revision: int, undecided: frozenset[int] = frozenset()
) -> GraphUpdate | None:
    """Take a step in and return the whole estimate; None if this process does not hold what the step goes on from.

    Args:
        step: of :meth:`LiveFeed.next_step`; a graph that fails to take it in is dropped.
        config: losses and gate.
        revision: number of the update.
        undecided: as in :func:`vggt_motion.backend.posegraph.solve`.

    Raises:
        OptimizationError: not even a batch solve succeeds.
    """
    if step.number == 0:
        held = _Held(LiveGraph(config, is_metric=step.is_metric), 0)
    elif not _held or _held[0].next_number != step.number:
        return None
    else:
        held = _held[0]
    _held.clear()
    held.graph.add(step.nodes, step.constraints)
    held.next_number += 1
    update = held.graph.snapshot(revision, undecided)
    _held.append(held)
    return update
