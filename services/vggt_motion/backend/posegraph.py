"""The pose graph over submaps (paper section 3.3, DESIGN 3.6): from constraints to poses, breaks and reports.

The direction of constraints and residuals is explained in :mod:`vggt_motion.backend.factors`.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from vggt_motion.backend.factors import Edge, Loss
from vggt_motion.backend.robust import solve_component
from vggt_motion.config import BackendConfig
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.geometry.sim3_batch import Sim3Batch
from vggt_motion.records import Constraint, ConstraintKind, EdgeReport, GraphUpdate, SubmapPose


def chain(nodes: Sequence[tuple[int, int]], constraints: Sequence[Constraint]) -> dict[int, Sim3]:
    """Start values ``world_from_submap`` per submap index, composed of accepted adjacent constraints in index order.

    The first submap of each connected part is the identity. The result does not depend on the order of the arguments.
    """
    usable = _usable(_latest(nodes), constraints)
    return _start(_components(_latest(nodes), usable), _orthonormal(usable))


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
    transforms = _orthonormal(usable)
    start = _start(parts, transforms)
    poses: dict[int, Sim3] = {}
    edges: list[EdgeReport] = []
    cost = 0.0
    inside: dict[tuple[int, ConstraintKind], list[Edge]] = defaultdict(list)
    for constraint, j_from_i in zip(usable, transforms, strict=True):
        root = parts.root[constraint.spec.i]
        if root == parts.root[constraint.spec.j]:
            inside[root, constraint.spec.kind].append(_edge(constraint, j_from_i, config))
        else:
            edges.append(EdgeReport(constraint.record_id, float("nan"), is_used=False, robust_weight=0.0))
    members: dict[int, list[int]] = defaultdict(list)
    for index in sorted(latest):
        members[parts.root[index]].append(index)
    for root, indices in members.items():
        solution = solve_component(
            {index: start[index] for index in indices},
            inside[root, ConstraintKind.ADJACENT],
            inside[root, ConstraintKind.LOOP],
            config,
            is_metric=is_metric,
        )
        gauge = Sim3Batch.of([solution.poses[root].inverse()])
        moved = (gauge @ Sim3Batch.of(list(solution.poses.values()))).to_list()
        poses.update(zip(solution.poses, moved, strict=True))
        poses[root] = Sim3.identity()
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
    return _edge(constraint, _orthonormal([constraint])[0], config)


def _edge(constraint: Constraint, j_from_i: Sim3, config: BackendConfig) -> Edge:
    return Edge(
        constraint.record_id,
        constraint.spec.i,
        constraint.spec.j,
        j_from_i,
        constraint.inlier_ratio * constraint.information,
        Loss("huber", config.huber_sigma),
    )


def _orthonormal(constraints: Sequence[Constraint]) -> list[Sim3]:
    """Their transforms with the rotations' rounding taken out, which a chain of thousands adds up (Newton-Schulz)."""
    batch = Sim3Batch.of([constraint.j_from_i for constraint in constraints])
    r = batch.rotation
    return replace(batch, rotation=1.5 * r - 0.5 * (r @ (r.transpose(0, 2, 1) @ r))).to_list()


@dataclass(frozen=True)
class _Parts:
    root: dict[int, int]  # submap index -> first index of its component
    steps: list[tuple[int, int, int, bool]]  # known submap, next one, constraint between them, does it lead forward


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
    neighbours: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for number, constraint in enumerate(usable):
        if constraint.spec.kind is ConstraintKind.ADJACENT:
            neighbours[constraint.spec.i].append((constraint.spec.j, number))
            neighbours[constraint.spec.j].append((constraint.spec.i, number))
    root: dict[int, int] = {}
    steps: list[tuple[int, int, int, bool]] = []
    for first in sorted(latest):
        if first in root:
            continue
        root[first] = first
        queue = deque([first])
        while queue:
            at = queue.popleft()
            for other, number in sorted(neighbours[at]):
                if other not in root:
                    root[other] = first
                    steps.append((at, other, number, usable[number].spec.i == at))
                    queue.append(other)
    return _Parts(root, steps)


def _start(parts: _Parts, transforms: Sequence[Sim3]) -> dict[int, Sim3]:
    """World poses of all submaps, composed along the steps; ``transforms`` are those of the constraints."""
    start = {index: Sim3.identity() for index, root in parts.root.items() if index == root}
    for at, other, number, is_forward in parts.steps:
        j_from_i = transforms[number]
        start[other] = start[at] @ (j_from_i.inverse() if is_forward else j_from_i)
    return start


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
