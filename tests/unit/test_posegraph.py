"""Pose graph: the direction of the residual first (DESIGN 3.6), then the solver."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import graphs
from vggt_motion.backend import factors, incremental, posegraph, skeleton
from vggt_motion.backend.incremental import LiveGraph
from vggt_motion.bus import codec
from vggt_motion.config import BackendConfig
from vggt_motion.errors import OptimizationError
from vggt_motion.geometry import sim3
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import Constraint, ConstraintKind, GraphUpdate, RegistrationSpec

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
    edge = posegraph.to_edge(measured, CONFIG)
    np.testing.assert_allclose(factors.residual(edge, x_i, x_j), 0.0, atol=1e-9)
    # GTSAM's factor with Z = S_ij^-1 agrees, and with Z = S_ij (the printed residual) it does not
    z = factors.to_gtsam(j_from_i.inverse())
    noise = gtsam.noiseModel.Unit.Create(7)
    values = gtsam.Values()
    values.insert(0, factors.to_gtsam(x_i))
    values.insert(1, factors.to_gtsam(x_j))
    assert gtsam.BetweenFactorSimilarity3(0, 1, z, noise).error(values) < 1e-12
    assert gtsam.BetweenFactorSimilarity3(0, 1, z.inverse(), noise).error(values) > 1e-3


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


ROAD = graphs.circle(24, 100.0)


def solve(drive: graphs.SimulatedDrive, config: BackendConfig = CONFIG, **options: bool) -> GraphUpdate:
    return posegraph.solve(drive.nodes, drive.constraints, config, revision=1, is_final=True, **options)


def test_loops_reduce_the_error_of_the_chain() -> None:
    drive = graphs.simulate(ROAD, 120, 30, 0.0, seed=1)
    chain = posegraph.chain(drive.nodes, drive.constraints)
    before = graphs.position_error(drive, [chain[k] for k in range(120)])
    update = solve(drive)
    assert graphs.position_error(drive, graphs.poses_of(update)) < 0.3 * before
    assert all(edge.is_used for edge in update.edges) and len(update.edges) == 119 + 30
    assert update.poses[0].world_from_submap.matrix() == pytest.approx(np.eye(4))
    assert update.breaks == ()


@pytest.mark.parametrize("false_share", [0.1, 0.3, 0.5])
def test_false_loops_are_switched_off(false_share: float) -> None:
    drive = graphs.simulate(ROAD, 150, 40, false_share, seed=2)
    honest = posegraph.solve(drive.nodes, drive.without_false_loops(), CONFIG, revision=1, is_final=True)
    update = solve(drive)
    loops = {edge.constraint_id: edge for edge in update.edges if edge.constraint_id.startswith("constraint/loop")}
    assert {edge_id for edge_id, edge in loops.items() if edge.is_used} == drive.true_loops
    for edge in loops.values():
        assert edge.is_used or (edge.robust_weight == 0.0 and edge.weighted_residual > CONFIG.loop_gate_sigma)
    clean, dirty = (graphs.position_error(drive, graphs.poses_of(g)) for g in (honest, update))
    assert dirty < 1.05 * clean
    # what the gate is for: Huber alone is bent by them
    bent = solve(drive, CONFIG.model_copy(update={"loop_loss": "huber"}))
    assert graphs.position_error(drive, graphs.poses_of(bent)) > 2.0 * clean


def test_order_of_arrival_does_not_matter() -> None:
    """The same bits, whatever the order of constraints and nodes, also past the size at which the graph is reduced."""
    for count in (40, 260):
        drive = graphs.simulate(ROAD, count, 12, 0.2, seed=3)
        first = solve(drive)
        rng = np.random.default_rng(0)
        for _ in range(3):
            shuffled = [drive.constraints[n] for n in rng.permutation(len(drive.constraints))]
            nodes = [drive.nodes[n] for n in rng.permutation(count)]
            again = posegraph.solve(nodes, shuffled, CONFIG, revision=1, is_final=True)
            assert again.edges == first.edges and again.final_cost == first.final_cost
            for a, b in zip(first.poses, again.poses, strict=True):
                np.testing.assert_array_equal(a.world_from_submap.matrix(), b.world_from_submap.matrix())


def test_metric_graphs_keep_every_scale() -> None:
    drive = graphs.simulate(ROAD, 60, 10, 0.2, seed=4, metric=True)
    update = solve(drive, is_metric=True)
    assert {pose.world_from_submap.scale for pose in update.poses} == {1.0}
    chain = posegraph.chain(drive.nodes, drive.constraints)
    before = graphs.position_error(drive, [chain[k] for k in range(60)])
    assert graphs.position_error(drive, graphs.poses_of(update)) < before


def test_a_break_starts_a_component_and_says_why() -> None:
    drive = graphs.simulate(ROAD, 30, 0, 0.0, seed=5)
    constraints = [replace(c, accepted=False, reason="no texture") if c.spec.j == 10 else c for c in drive.constraints]
    constraints = [c for c in constraints if c.spec.j != 20]
    across = constraint(5, 15, Sim3.identity(), ConstraintKind.LOOP)
    update = posegraph.solve(drive.nodes, [*constraints, across], CONFIG, revision=1, is_final=True)
    assert [pose.component for pose in update.poses] == [0] * 10 + [10] * 10 + [20] * 10
    assert len(update.breaks) == 2
    assert "before submap 10" in update.breaks[0] and "no texture" in update.breaks[0]
    assert "before submap 20" in update.breaks[1] and "no constraint" in update.breaks[1]
    for root in (0, 10, 20):
        np.testing.assert_array_equal(update.poses[root].world_from_submap.matrix(), np.eye(4))
    # a single loop cannot be told from a false one, so that it joins no parts
    live = LiveGraph(CONFIG)
    live.add(drive.nodes, [*constraints, across])
    for graph in (update, live.snapshot(1)):
        unused = next(edge for edge in graph.edges if edge.constraint_id == across.record_id)
        assert not unused.is_used and np.isnan(unused.weighted_residual)
        back = codec.decode(GraphUpdate, codec.encode(graph))
        assert next(edge for edge in back.edges if np.isnan(edge.weighted_residual)).constraint_id == across.record_id
        assert len(back.edges) == len(graph.edges) == 28
    undecided = posegraph.solve(drive.nodes, constraints, CONFIG, revision=1, is_final=False, undecided={20})
    assert undecided.breaks == update.breaks[:1]
    assert [pose.component for pose in undecided.poses] == [pose.component for pose in update.poses]


def test_constraints_of_other_revisions_take_no_part() -> None:
    good = constraint(0, 1, Sim3(translation=np.array([1.0, 0.0, 0.0])))
    stale = replace(
        constraint(0, 1, Sim3(translation=np.array([9.0, 0.0, 0.0]))),
        spec=RegistrationSpec(0, 1, 1, 2, ConstraintKind.ADJACENT, ("k",)),
    )
    update = posegraph.solve([(0, 1), (1, 1)], [stale, good], CONFIG, revision=1, is_final=True)
    assert [edge.constraint_id for edge in update.edges] == [good.record_id]
    np.testing.assert_allclose(update.poses[1].world_from_submap.translation, [-1.0, 0.0, 0.0])
    newer = posegraph.solve([(0, 1), (1, 1), (1, 2)], [stale, good], CONFIG, revision=1, is_final=True)
    assert [edge.constraint_id for edge in newer.edges] == [stale.record_id]
    assert newer.poses[1].submap_revision == 2


def test_gaps_in_the_index_and_edges_that_skip_are_a_chain_too() -> None:
    """Submaps that were never predicted leave gaps in the index; a dead one is bridged by an edge over it."""
    edges = [constraint(0, 2, Sim3(scale=2.0)), constraint(2, 6, Sim3(scale=0.5)), constraint(6, 8, Sim3(scale=4.0))]
    update = posegraph.solve([(8, 1), (0, 1), (2, 1), (6, 1)], edges, CONFIG, revision=1, is_final=False)
    assert [pose.world_from_submap.scale for pose in update.poses] == pytest.approx([1.0, 0.5, 1.0, 0.25])
    assert update.breaks == () and update.record_id == "graph/00000001"


def test_information_that_is_none_is_named() -> None:
    bad = constraint(0, 1, Sim3.identity(), information=np.zeros((7, 7)))
    loop = constraint(0, 1, Sim3.identity(), ConstraintKind.LOOP)
    with pytest.raises(OptimizationError, match="constraint/adjacent/000000"):
        posegraph.solve([(0, 1), (1, 1)], [bad, loop], CONFIG, revision=1, is_final=True)


def test_empty_and_single_graphs() -> None:
    assert posegraph.solve([], [], CONFIG, revision=1, is_final=True).poses == ()
    update = posegraph.solve([(4, 1)], [], CONFIG, revision=1, is_final=True)
    assert [pose.component for pose in update.poses] == [4] and update.breaks == ()


def test_weights_tell_rotation_translation_and_scale_apart() -> None:
    """Two edges contradict each other; each part goes to the one that is certain of it."""
    sure_of_rotation = np.diag([1e6] * 3 + [1.0] * 3 + [1.0])
    sure_of_the_rest = np.diag([1.0] * 3 + [1e6] * 3 + [1e6])
    first = sim3.exp(np.array([0.1, 0, 0, 0, 0, 0, 0]))
    second = sim3.exp(np.array([0, 0, 0, 0.3, 0, 0, 0.2]))
    edges = [
        constraint(0, 1, first, information=sure_of_rotation),
        constraint(0, 1, second, ConstraintKind.LOOP, information=sure_of_the_rest),
    ]
    config = CONFIG.model_copy(update={"huber_sigma": 1e6, "loop_gate_sigma": 1e6, "loop_cauchy_sigma": 1e6})
    update = posegraph.solve([(0, 1), (1, 1)], edges, config, revision=1, is_final=True)
    found = update.poses[1].world_from_submap.inverse()
    assert np.linalg.norm(sim3.log(found)[:3] - [0.1, 0, 0]) < 1e-3
    assert np.log(found.scale) == pytest.approx(0.2, abs=1e-3)
    assert found.translation[0] == pytest.approx(0.3, abs=0.05)


def test_skeleton_is_the_chain_in_fewer_edges() -> None:
    drive = graphs.simulate(ROAD, 300, 6, 0.0, seed=6)
    edges = [posegraph.to_edge(c, CONFIG) for c in drive.constraints]
    adjacent, loops = edges[:299], edges[299:]
    chain = posegraph.chain(drive.nodes, drive.constraints)
    reduced = skeleton.reduce_chain(chain, adjacent, loops, is_metric=False)
    assert reduced is not None and len(reduced.kept) <= 13
    ends = {end for loop in loops for end in (loop.i, loop.j)} | {0}
    assert {reduced.members[position] for position in reduced.kept} == ends
    for edge in reduced.edges:
        np.testing.assert_allclose(factors.residual(edge, chain[edge.i], chain[edge.j]), 0.0, atol=1e-8)
    # unmoved ends give the chain again, and moved ones are met
    for index, pose in reduced.expand(reduced.start()).items():
        np.testing.assert_allclose(pose.matrix(), chain[index].matrix(), atol=1e-6)
    solved = factors.optimise(reduced.start(), [*reduced.edges, *loops], is_metric=False, relative_tolerance=1e-6)
    expanded = reduced.expand(solved.poses)
    for index, pose in solved.poses.items():
        np.testing.assert_array_equal(expanded[index].matrix(), pose.matrix())
    # the marginal is what it should be: the expansion costs what the skeleton said, and the full optimum hardly less
    full = factors.optimise(expanded, [*adjacent, *loops], is_metric=False, relative_tolerance=1e-9)
    left = [(e, factors.residual(e, expanded[e.i], expanded[e.j])) for e in [*adjacent, *loops]]
    start = float(sum(r @ e.information @ r for e, r in left))
    assert start == pytest.approx(float(np.sum(full.weighted_residuals**2)), rel=0.05)


def test_composed_covariance_is_that_of_samples() -> None:
    """The covariance of a stretch against the scatter of noisy chains."""
    drive = graphs.simulate(ROAD, 12, 0, 0.0, seed=7, metric=False)
    edges = [posegraph.to_edge(c, CONFIG) for c in drive.constraints]
    chain = posegraph.chain(drive.nodes, drive.constraints)
    loop = posegraph.to_edge(constraint(0, 11, Sim3.identity(), ConstraintKind.LOOP), CONFIG)
    reduced = skeleton.reduce_chain(chain, edges, [loop], is_metric=False)
    assert reduced is not None
    (composed,) = reduced.edges
    rng = np.random.default_rng(0)
    samples = []
    for _ in range(4000):
        total = Sim3.identity()
        for edge in edges:
            noise = rng.multivariate_normal(np.zeros(7), 0.01 * np.linalg.inv(edge.information))
            total = sim3.exp(noise) @ edge.j_from_i @ total
        samples.append(sim3.log(total @ composed.j_from_i.inverse()))
    scatter = np.cov(np.array(samples).T) / 0.01
    expected = np.linalg.inv(composed.information)
    unit = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(scatter / np.outer(unit, unit), expected / np.outer(unit, unit), atol=0.1)


def grow(live: LiveGraph, drive: graphs.SimulatedDrive) -> None:
    """Feed a drive as it happens: a submap, then its constraints."""
    by_end: dict[int, list[Constraint]] = {}
    for c in drive.constraints:
        by_end.setdefault(c.spec.j, []).append(c)
    for index, revision in drive.nodes:
        live.add([(index, revision)], [])
        live.add([], by_end.get(index, []))


@pytest.mark.parametrize("metric", [False, True])
@pytest.mark.parametrize(("small", "factor"), [(0, 1.4), (incremental._SMALL, 1.05)])
def test_live_graph_follows_the_batch(metric: bool, small: int, factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Loop by loop with iSAM2, as large graphs are kept, and with a batch solve for each loop, as small ones are."""
    monkeypatch.setattr(incremental, "_SMALL", small)
    drive = graphs.simulate(ROAD, 100, 20, 0.2, seed=8, metric=metric)
    live = LiveGraph(CONFIG, is_metric=metric)
    grow(live, drive)
    update = live.snapshot(7)
    batch = solve(drive, is_metric=metric)
    clean = graphs.position_error(drive, graphs.poses_of(batch))
    assert graphs.position_error(drive, graphs.poses_of(update)) < factor * clean + 0.05
    assert [(p.submap_index, p.submap_revision, p.component) for p in update.poses] == [
        (p.submap_index, p.submap_revision, p.component) for p in batch.poses
    ]
    # one step per constraint is not convergence: a true loop may still look doubtful, a false one never looks true
    shown, used = ({e.constraint_id for e in g.edges if e.is_used} for g in (update, batch))
    assert shown <= used and len(used - shown) <= 3
    assert update.revision == 7 and not update.is_final
    for index in (0, 50, 99):
        np.testing.assert_allclose(live.pose(index).matrix(), update.poses[index].world_from_submap.matrix(), atol=1e-6)
    # what is known already changes nothing
    live.add(drive.nodes, drive.constraints)
    assert live.snapshot(7).poses[99].world_from_submap.translation == pytest.approx(
        update.poses[99].world_from_submap.translation, abs=1e-9
    )


def test_live_graph_takes_breaks_late_constraints_and_new_revisions() -> None:
    drive = graphs.simulate(ROAD, 12, 0, 0.0, seed=9)
    late = next(c for c in drive.constraints if c.spec.j == 6)
    live = LiveGraph(CONFIG)
    live.add(drive.nodes, [c for c in drive.constraints if c is not late])
    assert [pose.component for pose in live.snapshot(1).poses] == [0] * 6 + [6] * 6
    assert len(live.snapshot(1).breaks) == 1
    live.add([], [late])
    joined = live.snapshot(2)
    assert {pose.component for pose in joined.poses} == {0} and joined.breaks == ()
    batch = solve(drive)
    for a, b in zip(joined.poses, batch.poses, strict=True):
        np.testing.assert_allclose(a.world_from_submap.matrix(), b.world_from_submap.matrix(), atol=1e-6)
    # submap 11 is predicted again: its old constraint is void until the new one comes
    live.add([(11, 2)], [])
    assert live.snapshot(3).poses[11].component == 11
    again = replace(drive.constraints[10], spec=RegistrationSpec(10, 11, 1, 2, ConstraintKind.ADJACENT, ("k",)))
    live.add([], [again])
    assert live.snapshot(4).poses[11].component == 0 and live.snapshot(4).poses[11].submap_revision == 2
    with pytest.raises(KeyError):
        live.pose(99)
