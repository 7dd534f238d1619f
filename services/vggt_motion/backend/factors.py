"""Everything GTSAM: conversions, factors and one solve of a connected graph.

A constraint says ``x_j = S_ij x_i``; with ``w = X_i x_i = X_j x_j`` the residual that vanishes at the truth is
``r_ij = log(S_ij X_i^-1 X_j)``. (The paper prints its residual with ``S_ij^-1``, which does not.) GTSAM's between
factor computes ``log(Z^-1 X_i^-1 X_j)``, hence ``Z = S_ij^-1``, and the residual is exactly the left perturbation in
frame j to which the constraint's information belongs: no adjoint is needed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gtsam
import numpy as np
import numpy.typing as npt

from vggt_motion.errors import OptimizationError
from vggt_motion.geometry import sim3
from vggt_motion.geometry.sim3 import Sim3

Array = npt.NDArray[np.float64]

_MAX_ITERATIONS = 100
_ABSOLUTE_TOLERANCE = 1e-12
# A Huber width is stated for one dimension. The norm of a residual of d dimensions stays below this multiple of it as
# often.
_WIDTH_OF_DIMENSION = {6: 2.22, 7: 2.37}


@dataclass(frozen=True)
class Loss:
    """A robust loss on the norm of a whitened residual."""

    kind: Literal["huber", "cauchy"]
    width: float  # Huber: standard deviations of one dimension; Cauchy: of the norm


@dataclass(frozen=True)
class Edge:
    """A constraint as the solver takes it."""

    edge_id: str
    i: int
    j: int
    j_from_i: Sim3
    information: Array  # (7, 7), weighted; left perturbation, frame j
    loss: Loss


@dataclass(frozen=True)
class Solved:
    """Poses and what is left of each edge."""

    poses: Mapping[int, Sim3]
    weighted_residuals: Array  # (E,) sqrt(r^T Omega r), in the order of the edges
    cost: float  # robust


def to_gtsam(transform: Sim3) -> gtsam.Similarity3:
    """GTSAM's Similarity3 acts as ``s (R p + t)``: its translation is ours divided by the scale."""
    return gtsam.Similarity3(transform.rotation, transform.translation / transform.scale, transform.scale)


def from_gtsam(value: gtsam.Similarity3) -> Sim3:
    """The reverse of :func:`to_gtsam`; the matrix of GTSAM is ``[[R, t], [0, 1 / s]]``."""
    matrix = value.matrix()
    scale = 1.0 / float(matrix[3, 3])
    return Sim3(matrix[:3, :3].copy(), scale * matrix[:3, 3], scale)


def residual(edge: Edge, x_i: Sim3, x_j: Sim3) -> Array:
    """``log(S_ij X_i^-1 X_j)`` (7,): rotation, translation, log-scale; zero where the poses agree with the edge."""
    return sim3.log(edge.j_from_i @ x_i.inverse() @ x_j)


def optimise(
    start: Mapping[int, Sim3],
    edges: Sequence[Edge],
    *,
    is_metric: bool,
    relative_tolerance: float,
    only_scored: Sequence[Edge] = (),
) -> Solved:
    """Levenberg-Marquardt on a connected graph, with the smallest index as gauge.

    Args:
        start: where to begin, per node.
        edges: the factors, in the order in which rounding falls.
        is_metric: Pose3 factors: all scales are 1, and the log-scale of the information is passed over.
        relative_tolerance: decrease of the cost at which to stop.
        only_scored: edges that take no part, but whose residuals are wanted; appended to those of ``edges``.

    Raises:
        OptimizationError: the information of an edge is not positive definite, or the solver failed.
    """
    size = 6 if is_metric else 7
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    root = min(start)
    # The prior agrees with the start, so that it holds the gauge whatever its strength.
    add_prior(graph, root, start[root], size)
    for index, pose in start.items():
        insert_pose(values, index, pose, size)
    plain = []
    scored = [*edges, *only_scored]
    for position, (edge, noise) in enumerate(zip(scored, _gaussians(scored, size), strict=True)):
        measured = _measured(edge, size)
        plain.append(_between(edge, measured, noise, size))
        if position < len(edges):
            graph.add(_between(edge, measured, robust(edge.loss, noise, size), size))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_MAX_ITERATIONS)
    parameters.setRelativeErrorTol(relative_tolerance)
    parameters.setAbsoluteErrorTol(_ABSOLUTE_TOLERANCE)
    try:
        solved = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        cost = float(graph.error(solved))
        squared = np.array([2.0 * factor.error(solved) for factor in plain])
    except RuntimeError as error:
        raise OptimizationError(f"pose graph of {len(start)} submaps: {' '.join(str(error).split())}") from error
    if not (np.isfinite(cost) and np.isfinite(squared).all()):
        raise OptimizationError(f"pose graph of {len(start)} submaps diverged")
    return Solved({index: estimated(solved, index, size) for index in start}, np.sqrt(squared), cost)


def robust_weight(loss: Loss, weighted_residual: float, *, is_metric: bool) -> float:
    """Weight in [0, 1] that the loss gives to a residual."""
    if loss.kind == "cauchy":
        return 1.0 / (1.0 + (weighted_residual / loss.width) ** 2)
    width = loss.width * _WIDTH_OF_DIMENSION[6 if is_metric else 7]
    return 1.0 if weighted_residual <= width else width / weighted_residual


def add_prior(graph: gtsam.NonlinearFactorGraph, index: int, pose: Sim3, size: int) -> None:
    """Hold the gauge at one pose; ``size`` is 7 for similarities, 6 for rigid poses, here and below."""
    noise = gtsam.noiseModel.Isotropic.Sigma(size, 1e-2)
    if size == 6:
        graph.add(gtsam.PriorFactorPose3(index, _pose3(pose), noise))
    else:
        graph.add(gtsam.PriorFactorSimilarity3(index, to_gtsam(pose), noise))


def insert_pose(values: gtsam.Values, index: int, pose: Sim3, size: int) -> None:
    """Put a pose among the values."""
    values.insert(index, _pose3(pose) if size == 6 else to_gtsam(pose))


def estimated(values: gtsam.Values, index: int, size: int) -> Sim3:
    """A pose from among the values."""
    if size == 6:
        return Sim3.from_se3(values.atPose3(index).matrix())
    return from_gtsam(values.atSimilarity3(index))


def _pose3(pose: Sim3) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3(pose.rotation), pose.translation)


def gaussian(edge: Edge, size: int) -> gtsam.noiseModel.Base:
    """Noise model of an edge's information.

    Raises:
        OptimizationError: it is not positive definite.
    """
    return _gaussians([edge], size)[0]


def _gaussians(edges: Sequence[Edge], size: int) -> list[gtsam.noiseModel.Base]:
    if not edges:
        return []
    information = np.array([edge.information[:size, :size] for edge in edges])
    symmetric = 0.5 * (information + information.transpose(0, 2, 1))
    try:
        # the upper Cholesky factor is what GTSAM takes as square-root information
        roots = np.linalg.cholesky(symmetric).transpose(0, 2, 1)
    except np.linalg.LinAlgError as error:
        worst = min(zip(edges, symmetric, strict=True), key=lambda pair: float(np.linalg.eigvalsh(pair[1])[0]))[0]
        raise OptimizationError(f"the information of {worst.edge_id} is not positive definite") from error
    return [gtsam.noiseModel.Gaussian.SqrtInformation(root, False) for root in roots]


def robust(loss: Loss, noise: gtsam.noiseModel.Base, size: int) -> gtsam.noiseModel.Base:
    """The noise model under a robust loss."""
    estimators = gtsam.noiseModel.mEstimator
    if loss.kind == "cauchy":
        return gtsam.noiseModel.Robust.Create(estimators.Cauchy.Create(loss.width), noise)
    return gtsam.noiseModel.Robust.Create(estimators.Huber.Create(loss.width * _WIDTH_OF_DIMENSION[size]), noise)


def between(edge: Edge, noise: gtsam.noiseModel.Base, size: int) -> gtsam.NonlinearFactor:
    """The factor of an edge under a noise model."""
    return _between(edge, _measured(edge, size), noise, size)


def _measured(edge: Edge, size: int) -> Any:
    i_from_j = edge.j_from_i.inverse()
    return _pose3(i_from_j) if size == 6 else to_gtsam(i_from_j)


def _between(edge: Edge, measured: Any, noise: gtsam.noiseModel.Base, size: int) -> gtsam.NonlinearFactor:
    if size == 6:
        return gtsam.BetweenFactorPose3(edge.i, edge.j, measured, noise)
    return gtsam.BetweenFactorSimilarity3(edge.i, edge.j, measured, noise)
