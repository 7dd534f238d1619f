"""The live graph across the process border: every update holds all of the log, a new child is told everything."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import graphs
from vggt_motion.backend import live, posegraph
from vggt_motion.backend.state import LogState
from vggt_motion.config import BackendConfig
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.records import (
    BlobRef,
    FrameGeometry,
    GraphUpdate,
    ScaleKind,
    SubmapGeometry,
    SubmapQuality,
    SubmapSpec,
    SubmapVerdict,
)

CONFIG = BackendConfig()


def submap(index: int, revision: int = 1, scale: ScaleKind = ScaleKind.RELATIVE) -> SubmapGeometry:
    frame = FrameGeometry("front/0/00000000", Intrinsics.centred(60.0, 64, 32), np.eye(4), BlobRef("0" * 64, 1, "x/y"))
    spec = SubmapSpec(index, revision, (), (frame.keyframe_id,))
    return SubmapGeometry(
        spec, SubmapVerdict.GOOD, "", scale, "test", (frame,), SubmapQuality(1, 0.3, 0.9, 3.0, 0.6, 0.1)
    )


def publish(feed: live.LiveFeed, state: LogState) -> GraphUpdate:
    """What the service does."""
    update = live.advance(feed.next_step(state), CONFIG, state.graph_input_count)
    if update is None:
        feed.restart()
        update = live.advance(feed.next_step(state), CONFIG, state.graph_input_count)
    assert update is not None
    feed.confirm()
    return update


@pytest.mark.parametrize("metric", [False, True])
def test_every_update_holds_all_that_the_log_holds(metric: bool) -> None:
    """So the live trajectory lacks nothing that is registered: it is never more than the submap in hand behind."""
    drive = graphs.simulate(graphs.circle(24, 100.0), 40, 6, 0.0, seed=1, metric=metric)
    feed, state = live.LiveFeed(), LogState()
    sent = 0
    for index, _ in drive.nodes:
        state.apply(submap(index, scale=ScaleKind.METRIC if metric else ScaleKind.RELATIVE))
        new = [c for c in drive.constraints if c.spec.j == index]
        for constraint in new:
            state.apply(constraint)
        step = feed.next_step(state)
        sent += len(step.constraints)
        assert len(step.nodes) == 1 and len(step.constraints) == len(new)
        update = publish(feed, state)
        assert [pose.submap_index for pose in update.poses] == list(range(index + 1))
        assert {pose.component for pose in update.poses} == {0}
        assert len(update.edges) == len(state.constraints) and update.breaks == ()
        assert update.revision == state.graph_input_count
        if metric:
            assert {pose.world_from_submap.scale for pose in update.poses} == {1.0}
    assert sent == len(drive.constraints)  # each crosses the border once
    batch = posegraph.solve(drive.nodes, drive.constraints, CONFIG, revision=1, is_final=True, is_metric=metric)
    last = graphs.position_error(drive, graphs.poses_of(update))
    assert last < 1.2 * graphs.position_error(drive, graphs.poses_of(batch)) + 0.05


def test_a_child_that_was_started_again_is_told_everything() -> None:
    drive = graphs.simulate(graphs.circle(24, 100.0), 12, 0, 0.0, seed=2)
    feed, state = live.LiveFeed(), LogState()
    for index, _ in drive.nodes[:6]:
        state.apply(submap(index))
    for constraint in drive.constraints[:5]:
        state.apply(constraint)
    before = publish(feed, state)
    live._held.clear()  # the child died
    state.apply(submap(6))
    state.apply(drive.constraints[5])
    assert live.advance(feed.next_step(state), CONFIG, 1) is None
    after = publish(feed, state)
    assert len(after.poses) == 7 and {pose.component for pose in after.poses} == {0}
    for a, b in zip(before.poses, after.poses, strict=False):
        np.testing.assert_allclose(a.world_from_submap.matrix(), b.world_from_submap.matrix(), atol=1e-6)


def test_new_revisions_and_a_change_of_scale_reach_the_child() -> None:
    drive = graphs.simulate(graphs.circle(24, 100.0), 3, 0, 0.0, seed=3, metric=True)
    feed, state = live.LiveFeed(), LogState()
    for index in range(2):
        state.apply(submap(index, scale=ScaleKind.METRIC))
    state.apply(drive.constraints[0])
    assert publish(feed, state).poses[1].world_from_submap.scale == 1.0
    state.apply(submap(1, revision=2, scale=ScaleKind.METRIC))
    step = feed.next_step(state)
    assert step.nodes == ((1, 2),) and step.constraints == ()
    assert [pose.component for pose in publish(feed, state).poses] == [0, 1]
    state.apply(submap(2))  # without a scale of its own: the whole graph loses its metres
    spec = replace(drive.constraints[1].spec, i_revision=2)
    state.apply(replace(drive.constraints[1], spec=spec))
    step = feed.next_step(state)
    assert not step.is_metric and len(step.nodes) == 3 and len(step.constraints) == 2
    assert [(pose.submap_revision, pose.component) for pose in publish(feed, state).poses] == [(1, 0), (2, 1), (1, 1)]


def test_a_live_graph_is_made_at_once_but_waits_for_registrations_that_are_at_work() -> None:
    pace = live.LivePace()
    assert pace.wait_s(0, is_registering=False, now_s=0.0) is None, "there is nothing to show"
    assert pace.wait_s(1, is_registering=False, now_s=0.0) == 0.0, "the first submap needs no registration"
    pace.solved(1)
    assert pace.wait_s(1, is_registering=False, now_s=1.0) is None, "nothing is new"
    assert pace.wait_s(2, is_registering=True, now_s=10.0) == live.REGISTRATION_PATIENCE_S
    assert pace.wait_s(2, is_registering=True, now_s=10.4) == pytest.approx(live.REGISTRATION_PATIENCE_S - 0.4)
    assert pace.wait_s(3, is_registering=False, now_s=10.5) == 0.0, "its constraint is there"
    pace.solved(3)
    assert pace.wait_s(4, is_registering=True, now_s=20.0) == live.REGISTRATION_PATIENCE_S, "counted from now on"
    assert pace.wait_s(5, is_registering=True, now_s=20.0 + live.REGISTRATION_PATIENCE_S) == 0.0, "not for ever"
    pace.solved(5)
    pace.solved(3)
    assert pace.wait_s(5, is_registering=False, now_s=30.0) is None, "an older graph takes nothing back"
