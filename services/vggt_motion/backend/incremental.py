"""The live pose graph: one constraint at a time, with iSAM2, while the drive goes on (DESIGN 3.6).

Chosen by measurement over the warm-started batch, which at 10,000 submaps takes half a second for a submap and a second
for a loop, where this takes milliseconds and a tenth of a second (tests/benchmarks/bench_posegraph.py). What a loop
moves is linearised anew only then. Small graphs are built again from a batch solve for every loop, which judges the
loops better and costs no more there. iSAM2's QR costs ten times its Cholesky, which may meet a system that it cannot
factor: then the graph is built again too. The live estimate is for looking at: the final one is always a fresh batch
(posegraph.solve).
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence

import gtsam
import numpy as np

from vggt_motion.backend import posegraph
from vggt_motion.backend.factors import (
    Edge,
    Loss,
    add_prior,
    between,
    estimated,
    from_gtsam,
    gaussian,
    insert_pose,
    robust,
    robust_weight,
)
from vggt_motion.config import BackendConfig
from vggt_motion.errors import OptimizationError
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.geometry.sim3_batch import Sim3Batch
from vggt_motion.records import Constraint, ConstraintKind, EdgeReport, GraphUpdate, SubmapPose

_LOG = logging.getLogger(__name__)

_RELINEARISE_THRESHOLD = 1.0
_SMALL = 300  # submaps up to which a loop is worth a batch solve
_BULK = 100  # constraints at once, after a restart say, are solved together
_NEVER = 2**31 - 1  # relinearisation is asked for where there is a reason, not every so many updates


class LiveGraph:
    """Poses of all submaps so far, kept up to date.

    A submap is part of the estimate once an adjacent constraint ties it to another; until then it waits, as a
    component of its own. Adding what is known already changes nothing.
    """

    def __init__(self, config: BackendConfig, *, is_metric: bool = False) -> None:
        """An empty graph; ``is_metric`` as in :func:`vggt_motion.backend.posegraph.solve`."""
        self._config = config
        self._size = 6 if is_metric else 7
        self._revisions: dict[int, int] = {}
        self._constraints: dict[str, Constraint] = {}
        self._component: dict[int, int] = {}  # inserted submap -> the one that holds the gauge of its part
        self._factors: dict[str, gtsam.NonlinearFactor] = {}  # of used constraints, not robust
        self._edges: dict[str, Edge] = {}
        self._pending: dict[str, Constraint] = {}
        self._isam = self._empty()

    def add(self, nodes: Iterable[tuple[int, int]], constraints: Iterable[Constraint]) -> None:
        """Take in new submaps (index, revision) and constraints, in any order.

        Raises:
            OptimizationError: not even the batch solve succeeds.
        """
        is_stale = has_loop = False
        for index, revision in nodes:
            known = self._revisions.get(index)
            if known is None or revision > known:
                self._revisions[index] = revision
                is_stale |= index in self._component
        for constraint in constraints:
            if constraint.record_id not in self._constraints:
                self._constraints[constraint.record_id] = constraint
                self._pending[constraint.record_id] = constraint
                has_loop |= constraint.accepted and constraint.spec.kind is ConstraintKind.LOOP
        is_small = len(self._revisions) <= _SMALL
        if is_stale or (has_loop and is_small) or len(self._pending) > _BULK:
            self._rebuild()
            return
        try:
            if not self._extend():
                self._rebuild()
        except RuntimeError as error:
            _LOG.info("live graph built again", extra={"reason": " ".join(str(error).split())})
            self._rebuild()

    def pose(self, index: int) -> Sim3:
        """``world_from_submap`` of one submap; the identity while it waits."""
        if index not in self._component:
            if index not in self._revisions:
                raise KeyError(index)
            return Sim3.identity()
        return self._gauge(self._root_of(index)) @ self._estimate(index)

    def snapshot(self, revision: int, undecided: Collection[int] = ()) -> GraphUpdate:
        """The whole estimate as a live update of the graph stream; ``undecided`` as in ``posegraph.solve``."""
        values = self._isam.calculateEstimate()
        members: dict[int, list[int]] = defaultdict(list)
        for index in sorted(self._revisions):
            members[self._component.get(index, index)].append(index)
        poses = []
        for indices in members.values():
            root = indices[0]
            if root not in self._component:
                poses.append(SubmapPose(root, self._revisions[root], root, Sim3.identity()))
                continue
            found = Sim3Batch.of([estimated(values, index, self._size) for index in indices])
            moved = (found.take(np.zeros(1, np.intp)).inverse() @ found).to_list()
            moved[0] = Sim3.identity()  # without rounding
            poses.extend(
                SubmapPose(index, self._revisions[index], root, pose)
                for index, pose in zip(indices, moved, strict=True)
            )
        reports, cost = [], 0.0
        for edge_id, factor in sorted(self._factors.items()):
            left = (2.0 * factor.error(values)) ** 0.5
            edge = self._edges[edge_id]
            weight = robust_weight(edge.loss, left, is_metric=self._size == 6)
            is_used = edge.loss.kind == "huber" or left <= self._config.loop_gate_sigma
            reports.append(EdgeReport(edge_id, left, is_used, weight))
            cost += 0.5 * weight * left * left
        reports += [
            EdgeReport(record_id, float("nan"), is_used=False, robust_weight=0.0)
            for record_id, constraint in self._constraints.items()
            if record_id not in self._factors and constraint.accepted and self._is_current(constraint)
        ]
        reports.sort(key=lambda report: report.constraint_id)
        nodes = list(self._revisions.items())
        breaks = posegraph.find_breaks(nodes, list(self._constraints.values()), undecided)
        poses.sort(key=lambda pose: pose.submap_index)
        return GraphUpdate(revision, False, tuple(poses), tuple(reports), breaks, cost)

    def _empty(self) -> gtsam.ISAM2:
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization("CHOLESKY")
        parameters.setRelinearizeThreshold(_RELINEARISE_THRESHOLD)
        parameters.relinearizeSkip = _NEVER
        # From the top of the tree down to the first submaps that hardly moved: a third of the time of a loop.
        parameters.enablePartialRelinearizationCheck = True
        return gtsam.ISAM2(parameters)

    def _extend(self) -> bool:
        """Insert what is pending and possible; False where only building again can."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        fresh: dict[int, Sim3] = {}
        has_loop = False
        for constraint in self._ready(ConstraintKind.ADJACENT):
            i, j = constraint.spec.i, constraint.spec.j
            edge = posegraph.to_edge(constraint, self._config)
            if i not in self._component and j not in self._component:
                self._component[min(i, j)] = min(i, j)
                fresh[min(i, j)] = Sim3.identity()
                add_prior(graph, min(i, j), Sim3.identity(), self._size)
            if i in self._component and j in self._component:
                if self._component[i] != self._component[j]:
                    return False
                has_loop = True  # a second way between two submaps is as good as one
            elif i in self._component:
                fresh[j] = self._known(i, fresh) @ edge.j_from_i.inverse()
                self._component[j] = self._component[i]
            else:
                fresh[i] = self._known(j, fresh) @ edge.j_from_i
                self._component[i] = self._component[j]
            self._keep(graph, edge)
        for constraint in self._ready(ConstraintKind.LOOP):
            if self._component[constraint.spec.i] == self._component[constraint.spec.j]:
                edge = posegraph.to_edge(constraint, self._config)
                self._keep(graph, self._doubtful(edge))
                has_loop = True
        if graph.size() == 0:
            return True
        for index, pose in fresh.items():
            insert_pose(values, index, pose, self._size)
        parameters = gtsam.ISAM2UpdateParams()
        parameters.force_relinearize = has_loop
        self._isam.update(graph, values, parameters)
        return True

    def _ready(self, kind: ConstraintKind) -> Sequence[Constraint]:
        """Pending accepted constraints of a kind that can be inserted now, taken out of the pending ones."""
        ready = []
        for record_id, constraint in sorted(self._pending.items(), key=lambda item: posegraph.order(item[1])):
            spec = constraint.spec
            if not constraint.accepted or spec.i == spec.j:
                del self._pending[record_id]
            elif spec.kind is kind and self._is_current(constraint):
                if kind is ConstraintKind.LOOP and not (spec.i in self._component and spec.j in self._component):
                    continue
                del self._pending[record_id]
                ready.append(constraint)
        return ready

    def _is_current(self, constraint: Constraint) -> bool:
        spec = constraint.spec
        return (self._revisions.get(spec.i), self._revisions.get(spec.j)) == (spec.i_revision, spec.j_revision)

    def _keep(self, graph: gtsam.NonlinearFactorGraph, edge: Edge) -> None:
        noise = gaussian(edge, self._size)
        graph.add(between(edge, robust(edge.loss, noise, self._size), self._size))
        self._factors[edge.edge_id] = between(edge, noise, self._size)
        self._edges[edge.edge_id] = edge

    def _doubtful(self, edge: Edge) -> Edge:
        loss = Loss("cauchy", self._config.loop_cauchy_sigma)
        return Edge(edge.edge_id, edge.i, edge.j, edge.j_from_i, edge.information, loss)

    def _known(self, index: int, fresh: dict[int, Sim3]) -> Sim3:
        return fresh[index] if index in fresh else self._estimate(index)

    def _estimate(self, index: int) -> Sim3:
        if self._size == 6:
            return Sim3.from_se3(self._isam.calculateEstimatePose3(index).matrix())
        return from_gtsam(self._isam.calculateEstimateSimilarity3(index))

    def _root_of(self, index: int) -> int:
        gauge = self._component[index]
        return min(i for i, holder in self._component.items() if holder == gauge)

    def _gauge(self, root: int) -> Sim3:
        # the prior sits on the first submap that came, which is nearly always the first of its part
        return Sim3.identity() if self._component[root] == root else self._estimate(root).inverse()

    def _rebuild(self) -> None:
        """Begin anew from a batch solve of everything known."""
        nodes, constraints = list(self._revisions.items()), list(self._constraints.values())
        solved = posegraph.solve(
            nodes, constraints, self._config, revision=0, is_final=False, is_metric=self._size == 6
        )
        self._isam = self._empty()
        self._component, self._factors, self._edges = {}, {}, {}
        self._pending = dict(self._constraints)
        start = {pose.submap_index: pose for pose in solved.poses}
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for constraint in sorted(self._constraints.values(), key=posegraph.order):
            spec = constraint.spec
            if not constraint.accepted or spec.i not in start or spec.j not in start or spec.i == spec.j:
                continue
            a, b = start[spec.i], start[spec.j]
            if (a.submap_revision, b.submap_revision) != (spec.i_revision, spec.j_revision):
                continue
            if a.component != b.component:
                continue
            del self._pending[constraint.record_id]
            for pose in (a, b):
                if pose.submap_index not in self._component:
                    self._component[pose.submap_index] = pose.component
                    insert_pose(values, pose.submap_index, pose.world_from_submap, self._size)
                    if pose.submap_index == pose.component:
                        add_prior(graph, pose.component, pose.world_from_submap, self._size)
            edge = posegraph.to_edge(constraint, self._config)
            self._keep(graph, self._doubtful(edge) if spec.kind is ConstraintKind.LOOP else edge)
        if graph.size() == 0:
            return
        try:
            self._isam.update(graph, values)
        except RuntimeError as error:
            raise OptimizationError(f"live pose graph: {' '.join(str(error).split())}") from error
