"""Pose graph: the direction of the residual first (DESIGN 3.6), then the solver."""

from __future__ import annotations

import gtsam
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vggt_motion.backend import posegraph
from vggt_motion.config import BackendConfig
from vggt_motion.geometry import sim3
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import Constraint, ConstraintKind, RegistrationSpec

CONFIG = BackendConfig()


def random_sim3(
    rng: np.random.Generator, rotation: float = 1.0, translation: float = 3.0, log_scale: float = 0.5
) -> Sim3:
    return sim3.exp(
        np.concatenate([rng.normal(0, rotation, 3), rng.normal(0, translation, 3), [rng.normal(0, log_scale)]])
    )


def constraint(
    i: int,
    j: int,
    j_from_i: Sim3,
    kind: ConstraintKind = ConstraintKind.ADJACENT,
    *,
    information: np.ndarray | None = None,
    accepted: bool = True,
    reason: str = "",
) -> Constraint:
    if information is None:
        information = np.diag([1e4] * 3 + [1e3] * 3 + [1e4])
    return Constraint(
        RegistrationSpec(i, j, 1, 1, kind, ("k",)), accepted, reason, j_from_i, 1.0, 0.01, information, 80_000
    )


def distance(a: Sim3, b: Sim3) -> float:
    return float(np.linalg.norm(sim3.log(a.inverse() @ b)))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_direction_residual_is_zero_at_the_truth(seed: int) -> None:
    """``x_j = S_ij x_i`` and ``w = X_i x_i = X_j x_j``: the residual vanishes at the truth."""
    rng = np.random.default_rng(seed)
    x_i, x_j = random_sim3(rng), random_sim3(rng)
    point_i = rng.normal(0, 5, (10, 3))
    world = x_i.act(point_i)
    point_j = x_j.inverse().act(world)
    j_from_i = x_j.inverse() @ x_i
    np.testing.assert_allclose(j_from_i.act(point_i), point_j, atol=1e-9)

    measured = constraint(0, 1, j_from_i)
    np.testing.assert_allclose(posegraph.residual(measured, x_i, x_j), 0.0, atol=1e-9)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(posegraph.between_factor(measured, CONFIG))
    values.insert(0, posegraph.to_gtsam(x_i))
    values.insert(1, posegraph.to_gtsam(x_j))
    assert graph.error(values) < 1e-12
    values.update(1, posegraph.to_gtsam(x_j @ sim3.exp(np.full(7, 0.05))))
    assert graph.error(values) > 1e-3


def test_direction_optimised_graph_goes_to_the_truth() -> None:
    """A ring whose first edges are disturbed but weak is pulled to the truth by exact, strong ones."""
    rng = np.random.default_rng(1)
    count = 8
    truth = [Sim3.identity()]
    truth += [random_sim3(rng, 0.4, 2.0, 0.2) for _ in range(count - 1)]
    constraints = []
    for i in range(count - 1):
        exact = truth[i + 1].inverse() @ truth[i]
        noisy = sim3.exp(rng.normal(0, 0.05, 7)) @ exact
        # the chain start is composed of these, hence far from the truth
        constraints.append(constraint(i, i + 1, noisy, information=np.eye(7) * 1e-3))
    for i in range(count - 2):
        exact = truth[i + 2].inverse() @ truth[i]
        constraints.append(constraint(i, i + 2, exact, ConstraintKind.LOOP, information=np.eye(7) * 1e4))
    exact = truth[count - 1].inverse() @ truth[0]
    constraints.append(constraint(0, count - 1, exact, ConstraintKind.LOOP, information=np.eye(7) * 1e4))
    start = posegraph.chain([(k, 1) for k in range(count)], constraints)
    assert max(distance(start[k], truth[k]) for k in range(count)) > 0.05

    update = posegraph.solve([(k, 1) for k in range(count)], constraints, CONFIG, revision=1, is_final=True)

    for pose in update.poses:
        assert distance(pose.world_from_submap, truth[pose.submap_index]) < 1e-4
