"""The pose graph over submaps (paper section 3.3, DESIGN 3.6), solved with GTSAM.

A constraint says ``x_j = S_ij x_i``; with ``w = X_i x_i = X_j x_j`` the residual that vanishes at the truth is
``r_ij = log(S_ij X_i^-1 X_j)``. (The paper prints its residual with ``S_ij^-1``, which does not.) GTSAM's between
factor computes ``log(Z^-1 X_i^-1 X_j)``, hence ``Z = S_ij^-1``, and the residual is exactly the left perturbation in
frame j to which the constraint's information belongs: no adjoint is needed.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from vggt_motion.config import BackendConfig
from vggt_motion.errors import OptimizationError
from vggt_motion.geometry import se3, sim3
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import Constraint, ConstraintKind, EdgeReport, GraphUpdate, SubmapPose

_LOG = logging.getLogger(__name__)
_MAX_ITERATIONS = 100
_RELATIVE_TOLERANCE = 1e-9
_ABSOLUTE_TOLERANCE = 1e-12


def to_gtsam(transform: Sim3) -> gtsam.Similarity3:
    """GTSAM's Similarity3 acts as ``s (R p + t)``: its translation is ours divided by the scale."""
    return gtsam.Similarity3(gtsam.Rot3(transform.rotation), transform.translation / transform.scale, transform.scale)


def from_gtsam(value: gtsam.Similarity3) -> Sim3:
    """The reverse of :func:`to_gtsam`."""
    scale = float(value.scale())
    return Sim3(se3.nearest_rotation(value.rotation().matrix()), scale * np.asarray(value.translation()), scale)


def residual(constraint: Constraint, x_i: Sim3, x_j: Sim3) -> npt.NDArray[np.float64]:
    """``log(S_ij X_i^-1 X_j)`` (7,): rotation, translation, log-scale; zero where the poses agree with it."""
    return sim3.log(constraint.j_from_i @ x_i.inverse() @ x_j)


def between_factor(constraint: Constraint, config: BackendConfig) -> gtsam.NonlinearFactor:
    """The constraint as a factor under the Huber loss."""
    return _factor(constraint, _robust(_gaussian(constraint, 7), config.huber_sigma), is_metric=False)


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
        start = {index: parts.start[index] for index in indices}
        solution = _solve_component(start, inside[root], config, is_metric=is_metric)
        gauge = solution.poses[root].inverse()
        poses.update({index: gauge @ pose for index, pose in solution.poses.items()} | {root: Sim3.identity()})
        edges.extend(solution.edges)
        cost += solution.cost
    return GraphUpdate(
        revision=revision,
        is_final=is_final,
        poses=tuple(SubmapPose(index, latest[index], parts.root[index], poses[index]) for index in sorted(latest)),
        edges=tuple(sorted(edges, key=lambda edge: edge.constraint_id)),
        breaks=_breaks(latest, parts, constraints),
        final_cost=cost,
    )


@dataclass(frozen=True)
class _Parts:
    root: dict[int, int]  # submap index -> first index of its component
    start: dict[int, Sim3]


@dataclass(frozen=True)
class _Solution:
    poses: Mapping[int, Sim3]
    edges: tuple[EdgeReport, ...]
    cost: float


def _latest(nodes: Sequence[tuple[int, int]]) -> dict[int, int]:
    latest: dict[int, int] = {}
    for index, revision in nodes:
        latest[index] = max(revision, latest.get(index, revision))
    return latest


def _order(constraint: Constraint) -> tuple[int, int, str]:
    return constraint.spec.i, constraint.spec.j, constraint.spec.kind.value


def _is_current(latest: Mapping[int, int], constraint: Constraint) -> bool:
    spec = constraint.spec
    return latest.get(spec.i) == spec.i_revision and latest.get(spec.j) == spec.j_revision and spec.i != spec.j


def _usable(latest: Mapping[int, int], constraints: Sequence[Constraint]) -> list[Constraint]:
    """Accepted constraints of the current revisions, each once, in the order that decides how rounding falls."""
    unique = {c.record_id: c for c in constraints if c.accepted and _is_current(latest, c)}
    return sorted(unique.values(), key=_order)


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
                    forward = constraint.j_from_i if constraint.spec.i == other else constraint.j_from_i.inverse()
                    root[other], start[other] = first, start[at] @ forward
                    queue.append(other)
    return _Parts(root, start)


def _gaussian(constraint: Constraint, dimension: int) -> gtsam.noiseModel.Base:
    """Noise model of the whole information matrix, which weights rotation, translation and scale apart.

    It is multiplied by the inlier ratio, the paper's ``w_ij``.
    """
    information = constraint.inlier_ratio * constraint.information[:dimension, :dimension]
    information = 0.5 * (information + information.T)
    try:
        # the upper Cholesky factor, which GTSAM takes as square-root information
        return gtsam.noiseModel.Gaussian.SqrtInformation(np.linalg.cholesky(information).T)
    except np.linalg.LinAlgError as error:
        raise OptimizationError(f"information of {constraint.record_id} is not positive definite") from error


def _robust(noise: gtsam.noiseModel.Base, huber_sigma: float) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(huber_sigma), noise)


def _factor(constraint: Constraint, noise: gtsam.noiseModel.Base, *, is_metric: bool) -> gtsam.NonlinearFactor:
    i_from_j = constraint.j_from_i.inverse()
    if is_metric:
        measured = gtsam.Pose3(gtsam.Rot3(i_from_j.rotation), i_from_j.translation)
        return gtsam.BetweenFactorPose3(constraint.spec.i, constraint.spec.j, measured, noise)
    return gtsam.BetweenFactorSimilarity3(constraint.spec.i, constraint.spec.j, to_gtsam(i_from_j), noise)


def _solve_component(
    start: Mapping[int, Sim3], constraints: Sequence[Constraint], config: BackendConfig, *, is_metric: bool
) -> _Solution:
    if len(constraints) < len(start):
        # a tree: the chain meets every constraint exactly, there is nothing to optimise
        reports = tuple(EdgeReport(c.record_id, 0.0, is_used=True) for c in constraints)
        return _Solution(start, reports, 0.0)
    dimension = 6 if is_metric else 7
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    root = min(start)
    gauge_noise = gtsam.noiseModel.Isotropic.Sigma(dimension, 1e-2)
    if is_metric:
        graph.add(gtsam.PriorFactorPose3(root, gtsam.Pose3(), gauge_noise))
    else:
        graph.add(gtsam.PriorFactorSimilarity3(root, gtsam.Similarity3(), gauge_noise))
    for index in sorted(start):
        pose = start[index]
        values.insert(index, gtsam.Pose3(gtsam.Rot3(pose.rotation), pose.translation) if is_metric else to_gtsam(pose))
    plain: list[gtsam.NonlinearFactor] = []
    for constraint in constraints:
        noise = _gaussian(constraint, dimension)
        plain.append(_factor(constraint, noise, is_metric=is_metric))
        graph.add(_factor(constraint, _robust(noise, config.huber_sigma), is_metric=is_metric))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_MAX_ITERATIONS)
    parameters.setRelativeErrorTol(_RELATIVE_TOLERANCE)
    parameters.setAbsoluteErrorTol(_ABSOLUTE_TOLERANCE)
    try:
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        solved = optimizer.optimize()
        cost = float(graph.error(solved))
    except RuntimeError as error:
        raise OptimizationError(f"pose graph of {len(start)} submaps: {' '.join(str(error).split())}") from error
    if not np.isfinite(cost):
        raise OptimizationError(f"pose graph of {len(start)} submaps diverged")
    measured: list[EdgeReport] = []
    for constraint, factor in zip(constraints, plain, strict=True):
        weighted = float(np.sqrt(2.0 * factor.error(solved)))
        weight = min(1.0, config.huber_sigma / weighted) if weighted > 0.0 else 1.0
        measured.append(EdgeReport(constraint.record_id, weighted, is_used=True, robust_weight=weight))
    poses = {}
    for index in sorted(start):
        if is_metric:
            pose3 = solved.atPose3(index)
            poses[index] = Sim3(pose3.rotation().matrix(), np.asarray(pose3.translation()), 1.0)
        else:
            poses[index] = from_gtsam(solved.atSimilarity3(index))
    return _Solution(poses, tuple(measured), cost)


def _breaks(latest: Mapping[int, int], parts: _Parts, constraints: Sequence[Constraint]) -> tuple[str, ...]:
    refused: dict[int, list[str]] = defaultdict(list)
    for constraint in sorted(constraints, key=_order):
        if (
            constraint.spec.kind is ConstraintKind.ADJACENT
            and not constraint.accepted
            and _is_current(latest, constraint)
        ):
            refused[constraint.spec.j].append(f"refused against submap {constraint.spec.i}: {constraint.reason}")
    lines = []
    roots = sorted(index for index, root in parts.root.items() if index == root)
    for index in roots[1:]:
        reason = "; ".join(refused[index]) or "no constraint to the submap before it"
        lines.append(f"the trajectory is broken before submap {index}: {reason}")
    return tuple(lines)
