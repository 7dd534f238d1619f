"""The pose graph over submaps (paper section 3.3, DESIGN 3.6): from constraints to poses, breaks and reports.

The direction of constraints and residuals is explained in :mod:`vggt_motion.backend.factors`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from vggt_motion.backend.factors import Edge, Loss
from vggt_motion.backend.robust import solve_component
from vggt_motion.config import BackendConfig
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import Constraint, ConstraintKind, EdgeReport, GraphUpdate, SubmapPose


def chain(nodes: Sequence[tuple[int, int]], constraints: Sequence[Constraint]) -> dict[int, Sim3]:
    """Start values ``world_from_submap`` per submap index, composed of accepted adjacent constraints in index order.

    The first submap of each connected part is the identity. The result does not depend on the order of the arguments.
    """
    return _components(_latest(nodes), _usable(_latest(nodes), constraints)).start


def solve(
    nodes: Sequence[tuple[int, int]],
    constraints: Sequence[Constraint],
    config: BackendConfig,
    *,
    revision: int,
    is_final: bool,
    is_metric: bool = False,
    undecided: Collection[int] = (),
) -> GraphUpdate:
    """Solve the pose graph afresh: a pure function of its arguments, whatever their order.

    Each part that adjacent constraints connect is a component of its own, with the gauge ``X = identity`` at its first
    submap. Constraints that are refused, or between other revisions than the nodes', take no part.

    Args:
        nodes: (submap index, revision) of every submap with geometry; the highest revision of an index counts.
        constraints: everything that was registered, refused ones too (they name the reason of a break).
        config: Huber width and the like.
        revision: number of the update.
        is_final: whether this is the last solve of the run.
        is_metric: all submaps are in metres: SE(3) factors, all scales 1.
        undecided: submaps whose joint with those before is still being worked on (``planner.undecided_joints``):
            components of their own for now, but no break.

    Raises:
        OptimizationError: the solver failed or diverged.
    """
    latest = _latest(nodes)
    usable = _usable(latest, constraints)
    parts = _components(latest, usable)
    poses: dict[int, Sim3] = {}
    edges: list[EdgeReport] = []
    cost = 0.0
    inside: dict[int, list[Constraint]] = defaultdict(list)
    for constraint in usable:
        if parts.root[constraint.spec.i] == parts.root[constraint.spec.j]:
            inside[parts.root[constraint.spec.i]].append(constraint)
        else:
            edges.append(EdgeReport(constraint.record_id, float("nan"), is_used=False, robust_weight=0.0))
    members: dict[int, list[int]] = defaultdict(list)
    for index in sorted(latest):
        members[parts.root[index]].append(index)
    for root, indices in members.items():
        solution = solve_component(
            {index: parts.start[index] for index in indices},
            [to_edge(c, config) for c in inside[root] if c.spec.kind is ConstraintKind.ADJACENT],
            [to_edge(c, config) for c in inside[root] if c.spec.kind is ConstraintKind.LOOP],
            config,
            is_metric=is_metric,
        )
        gauge = solution.poses[root].inverse()
        poses.update({index: gauge @ pose for index, pose in solution.poses.items()} | {root: Sim3.identity()})
        edges.extend(solution.reports)
        cost += solution.cost
    return GraphUpdate(
        revision=revision,
        is_final=is_final,
        poses=tuple(SubmapPose(index, latest[index], parts.root[index], poses[index]) for index in sorted(latest)),
        edges=tuple(sorted(edges, key=lambda edge: edge.constraint_id)),
        breaks=_breaks(latest, parts, constraints, undecided),
        final_cost=cost,
    )


def find_breaks(
    nodes: Sequence[tuple[int, int]], constraints: Sequence[Constraint], undecided: Collection[int] = ()
) -> tuple[str, ...]:
    """One line for each place where the trajectory is broken, and why; ``undecided`` as in :func:`solve`."""
    latest = _latest(nodes)
    return _breaks(latest, _components(latest, _usable(latest, constraints)), constraints, undecided)


def to_edge(constraint: Constraint, config: BackendConfig) -> Edge:
    """The constraint for the solver, under the Huber loss.

    The whole information matrix weights rotation, translation and scale apart; the inlier ratio, the paper's ``w_ij``,
    weights them together.
    """
    return Edge(
        constraint.record_id,
        constraint.spec.i,
        constraint.spec.j,
        _orthonormal(constraint.j_from_i),
        constraint.inlier_ratio * constraint.information,
        Loss("huber", config.huber_sigma),
    )


def _orthonormal(transform: Sim3) -> Sim3:
    """The transform with its rotation's rounding taken out, which a chain of thousands would add up (Newton-Schulz)."""
    r = transform.rotation
    return Sim3(1.5 * r - 0.5 * (r @ (r.T @ r)), transform.translation, transform.scale)


@dataclass(frozen=True)
class _Parts:
    root: dict[int, int]  # submap index -> first index of its component
    start: dict[int, Sim3]


def _latest(nodes: Sequence[tuple[int, int]]) -> dict[int, int]:
    latest: dict[int, int] = {}
    for index, revision in nodes:
        latest[index] = max(revision, latest.get(index, revision))
    return latest


def order(constraint: Constraint) -> tuple[int, int, str]:
    """The order in which constraints enter a graph, whatever that of their arrival."""
    return constraint.spec.i, constraint.spec.j, constraint.spec.kind.value


def _is_current(latest: Mapping[int, int], constraint: Constraint) -> bool:
    spec = constraint.spec
    return latest.get(spec.i) == spec.i_revision and latest.get(spec.j) == spec.j_revision and spec.i != spec.j


def _usable(latest: Mapping[int, int], constraints: Sequence[Constraint]) -> list[Constraint]:
    """Accepted constraints of the current revisions, each once, in the order that decides how rounding falls."""
    unique = {c.record_id: c for c in constraints if c.accepted and _is_current(latest, c)}
    return sorted(unique.values(), key=order)


def _components(latest: Mapping[int, int], usable: Sequence[Constraint]) -> _Parts:
    neighbours: dict[int, list[tuple[int, Constraint]]] = defaultdict(list)
    for constraint in usable:
        if constraint.spec.kind is ConstraintKind.ADJACENT:
            neighbours[constraint.spec.i].append((constraint.spec.j, constraint))
            neighbours[constraint.spec.j].append((constraint.spec.i, constraint))
    root: dict[int, int] = {}
    start: dict[int, Sim3] = {}
    for first in sorted(latest):
        if first in root:
            continue
        root[first], start[first] = first, Sim3.identity()
        queue = [first]
        while queue:
            at = queue.pop(0)
            for other, constraint in sorted(neighbours[at], key=lambda entry: entry[0]):
                if other not in root:
                    j_from_i = _orthonormal(constraint.j_from_i)
                    forward = j_from_i if constraint.spec.i == other else j_from_i.inverse()
                    root[other], start[other] = first, start[at] @ forward
                    queue.append(other)
    return _Parts(root, start)


def _breaks(
    latest: Mapping[int, int], parts: _Parts, constraints: Sequence[Constraint], undecided: Collection[int]
) -> tuple[str, ...]:
    refused: dict[int, list[str]] = defaultdict(list)
    for constraint in sorted(constraints, key=order):
        if (
            constraint.spec.kind is ConstraintKind.ADJACENT
            and not constraint.accepted
            and _is_current(latest, constraint)
        ):
            refused[constraint.spec.j].append(f"refused against submap {constraint.spec.i}: {constraint.reason}")
    lines = []
    roots = sorted(index for index, root in parts.root.items() if index == root)
    for index in roots[1:]:
        if index in undecided:
            continue
        reason = "; ".join(refused[index]) or "no constraint to the submap before it"
        lines.append(f"the trajectory is broken before submap {index}: {reason}")
    return tuple(lines)
