from __future__ import annotations

import math
import random
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vggt_motion.backend import focal, planner, posegraph
from vggt_motion.backend.state import LogState
from vggt_motion.config import Config, load_config
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import (
    BlobRef,
    Constraint,
    Event,
    EventKind,
    FrameGeometry,
    JobKind,
    Keyframe,
    MotionState,
    PredictTask,
    RegisterTask,
    ScaleKind,
    Segment,
    SubmapGeometry,
    SubmapQuality,
    SubmapSpec,
    SubmapVerdict,
    submap_id,
    submap_index,
)

BLOB = BlobRef("0" * 64, 1, "image/jpeg")
CONFIG = Config()


def keyframe(index: int) -> Keyframe:
    return Keyframe("front", 0, index, index * 100_000_000, MotionState.LINEAR, 620, 188, BLOB)


def segment(index: int, base: int = 4, overlap: int = 2) -> Segment:
    def ids(first: int, count: int) -> tuple[str, ...]:
        return tuple(keyframe(i).keyframe_id for i in range(first, first + count))

    return Segment(
        index=index,
        camera="front",
        epoch=0,
        base_keyframe_ids=ids(index * base, base),
        overlap_keyframe_ids=ids(index * base - overlap, overlap) if index else (),
        frames=(),
        closed_by="budget",
    )


def geometry(spec: SubmapSpec, focal_over_width: float = 0.58, sigma: float = 0.02) -> SubmapGeometry:
    lattice = Intrinsics.centred(180.0, 310, 94)
    frames = tuple(FrameGeometry(name, lattice, np.eye(4), BLOB) for name in spec.keyframe_ids)
    quality = SubmapQuality(len(frames), 0.3, 0.9, 3.0, focal_over_width, sigma)
    return SubmapGeometry(spec, SubmapVerdict.GOOD, "", ScaleKind.RELATIVE, "test", frames, quality)


def constraint(task: RegisterTask) -> Constraint:
    return Constraint(task.spec, True, "", Sim3.identity(), 1.0, 0.01, np.eye(7), 1000)


def dead(job_id: str) -> Event:
    return Event(f"job_dead/{job_id}", EventKind.JOB_DEAD, "gave up", 0, {"job_id": job_id})


def whole(segment_index: int, revision: int = 1) -> str:
    return submap_id(submap_index(segment_index), revision)


def started(segment_count: int, *, base: int = 4, ended: bool = True) -> LogState:
    state = LogState()
    for index in range(segment_count):
        entry = segment(index, base, min(2, base))
        state.apply(entry)
        for name in entry.base_keyframe_ids:
            state.apply(keyframe(int(name.rsplit("/", 1)[1])))
    if ended:
        detail = {"frame_count": "9", "segment_count": str(segment_count)}
        state.apply(Event("stream_ended", EventKind.STREAM_ENDED, "", 0, detail))
    return state


def result(job: planner.PlannedJob, focals: dict[int, float], sigma: float) -> SubmapGeometry | Constraint:
    if isinstance(job.task, RegisterTask):
        return constraint(job.task)
    hint = job.task.spec.focal_hint
    if job.task.spec.revision == 2:
        assert hint is not None
        return geometry(job.task.spec, hint.focal_over_width, sigma)
    return geometry(job.task.spec, focals.get(job.task.spec.submap_index, 0.58), sigma)


def run(
    state: LogState,
    order: random.Random,
    focals: dict[int, float] | None = None,
    sigma: float = 0.02,
    dead_share: float = 0.0,
    bad_share: float = 0.0,
) -> None:
    """Carry out whatever is planned, one job at a time in random order, until nothing is left."""
    for _ in range(10_000):
        jobs = planner.next_jobs(state, CONFIG)
        if not jobs:
            return
        job = order.choice(jobs)
        is_doomed = zlib.crc32(job.job_id.encode()) % 100 < 100 * dead_share
        done = dead(job.job_id) if is_doomed else result(job, focals or {}, sigma)
        if isinstance(done, SubmapGeometry) and zlib.crc32(b"bad" + job.job_id.encode()) % 100 < 100 * bad_share:
            done = replace(done, verdict=SubmapVerdict.LOW_QUALITY, reason="no texture")
        state.apply(done)
    raise AssertionError("the plan does not end")


def test_a_segment_without_its_keyframes_waits() -> None:
    state = LogState()
    state.apply(segment(0))
    assert planner.next_jobs(state, CONFIG) == []


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_what_is_complete_lacks_nothing_however_far_each_stream_has_been_read(data: st.DataObject) -> None:
    """A backend that starts again reads the streams side by side: the event that ends the input may come first."""
    full = started(4)
    run(full, random.Random(data.draw(st.integers(0, 5))), dead_share=data.draw(st.sampled_from([0.0, 0.3])))
    assert planner.is_complete(full, CONFIG)
    partial = LogState()
    for stream in (full.keyframes, full.segments, full.submaps, full.constraints, full.events):
        records = list(stream.values())
        for record in records[: data.draw(st.integers(0, len(records)) | st.just(len(records)))]:
            partial.apply(record)
    if planner.is_complete(partial, CONFIG):
        assert partial.usable_submaps().keys() == full.usable_submaps().keys()
        assert planner.current_constraints(partial) == planner.current_constraints(full)


def test_nothing_is_complete_while_its_keyframes_and_submaps_are_on_their_way() -> None:
    full = started(3)
    run(full, random.Random(1))
    partial = LogState(segments=dict(full.segments), events=dict(full.events), constraints=dict(full.constraints))
    assert planner.next_jobs(partial, CONFIG) == []
    assert not planner.is_complete(partial, CONFIG)
    partial.submaps.update(full.submaps)
    assert not planner.is_complete(partial, CONFIG)
    partial.keyframes.update(full.keyframes)
    assert planner.is_complete(partial, CONFIG)


def test_the_hint_of_submap_k_folds_submaps_0_to_k_minus_3() -> None:
    state = started(6)
    first = planner.next_jobs(state, CONFIG)
    assert [job.job_id for job in first] == [whole(k) for k in range(3)]
    assert all(isinstance(job.task, PredictTask) and job.task.spec.focal_hint is None for job in first)
    # 2 before 0: submap 3 has to wait for 0 all the same.
    assert isinstance(first[2].task, PredictTask) and isinstance(first[0].task, PredictTask)
    state.apply(geometry(first[2].task.spec, 0.7))
    assert whole(3) not in {job.job_id for job in planner.next_jobs(state, CONFIG)}
    state.apply(geometry(first[0].task.spec, 0.6))
    third = next(job for job in planner.next_jobs(state, CONFIG) if job.job_id == whole(3))
    assert isinstance(third.task, PredictTask) and third.task.spec.focal_hint is not None
    assert third.task.spec.focal_hint.focal_over_width == pytest.approx(0.6)


def quality(focal_over_width: float, sigma: float) -> SubmapQuality:
    return SubmapQuality(17, 0.3, 0.9, 3.0, focal_over_width, sigma)


def test_two_results_of_equal_sigma_give_their_geometric_mean() -> None:
    results = [quality(0.5, 0.02), None, quality(0.6, 0.02), quality(0.9, math.inf), quality(math.nan, 0.01)]
    hint = focal.fold(results).hint()
    assert hint is not None
    assert hint.focal_over_width == pytest.approx(math.sqrt(0.5 * 0.6), rel=1e-12)


def test_sigma_shrinks_as_agreeing_results_come_in() -> None:
    # n equal results of variance s^2 (plus 1 % for the model) have variance (s^2 + 0.01^2) / n.
    hint = focal.fold([quality(0.58, 0.03)] * 16).hint()
    assert hint is not None
    assert hint.relative_sigma == pytest.approx(math.sqrt((0.03**2 + 0.01**2) / 16), rel=1e-12)
    assert hint.focal_over_width == pytest.approx(0.58)


def test_a_confident_but_wrong_result_neither_rules_nor_settles() -> None:
    wrong_first = [quality(0.7, 0.005)] + [quality(0.58, 0.01)] * 2
    assert focal.fold(wrong_first[:2]).settled_hint() is None
    hint = focal.fold(wrong_first + [quality(0.58, 0.01)] * 4).settled_hint()
    assert hint is not None and hint.focal_over_width == pytest.approx(0.58, rel=0.01)


def test_a_known_camera_needs_no_waiting_and_no_second_revision() -> None:
    config = load_config(assignments=["inference.focal_over_width=0.58"])
    state = started(6)
    jobs = planner.next_jobs(state, config)
    assert len(jobs) == 6
    for job in jobs:
        assert isinstance(job.task, PredictTask) and job.task.spec.focal_hint is not None
        assert job.task.spec.focal_hint.is_fixed
        state.apply(geometry(job.task.spec, 0.9, 0.001))
    assert {job.kind for job in planner.next_jobs(state, config)} == {JobKind.REGISTER}


@pytest.mark.parametrize("predictor", ["vggt", "pi3", "pi3x", "depth_anything_3", "map_anything"])
def test_networks_take_no_hint_so_nothing_waits_for_one_and_nothing_is_predicted_twice(predictor: str) -> None:
    config = load_config(assignments=[f"inference.predictor={predictor}"])
    # focal lengths and sigmas as bad as can be: they must not matter
    state = started(9)
    jobs = planner.next_jobs(state, config)
    assert [job.job_id for job in jobs] == [whole(k) for k in range(9)]
    for k, job in enumerate(jobs):
        assert isinstance(job.task, PredictTask) and job.task.spec.focal_hint is None
        state.apply(geometry(job.task.spec, 0.4 + 0.05 * k, sigma=0.001))
    jobs = planner.next_jobs(state, config)
    assert {job.kind for job in jobs} == {JobKind.REGISTER}
    for job in jobs:
        assert isinstance(job.task, RegisterTask)
        state.apply(constraint(job.task))
    assert planner.is_complete(state, config)


def test_submaps_without_a_sigma_neither_give_hints_nor_are_predicted_twice() -> None:
    """What workers with ``auto`` send where they chose a network."""
    state = started(7)
    run(state, random.Random(0), {k: 0.4 + 0.05 * k for k in range(7)}, sigma=math.nan)
    assert {(g.spec.revision, g.spec.focal_hint) for g in state.submaps.values()} == {(1, None)}


def test_submaps_that_the_settled_estimate_contradicts_are_predicted_once_more() -> None:
    state = started(8)
    run(state, random.Random(0), {0: 0.7, 1: 0.575}, sigma=0.01)
    # Submap 0 is 0.7 against 0.58 of all others: it alone is done again, with the estimate that had settled.
    assert {key for key in state.submaps if key[1] == 2} == {(0, 2)}
    used = state.submap(0)
    assert used is not None and used.quality.focal_over_width < 0.65
    assert planner.is_complete(state, CONFIG)
    revisions = {(c.spec.i, c.spec.i_revision, c.spec.j, c.spec.j_revision) for c in planner.current_constraints(state)}
    assert revisions == {(0, 2, 2, 1)} | {(2 * k, 1, 2 * k + 2, 1) for k in range(1, 7)}


def edges(state: LogState) -> set[tuple[int, int]]:
    return {(c.spec.i, c.spec.j) for c in planner.current_constraints(state)}


def test_submaps_of_a_straight_road_agree_on_one_focal_length_though_nobody_knows_it() -> None:
    state = started(5)
    run(state, random.Random(0), {0: 0.69, 1: 0.41, 2: 0.57, 3: 0.6, 4: 0.5}, sigma=0.2)
    assert planner.is_complete(state, CONFIG)
    second = {
        geometry.spec.submap_index: geometry.spec.focal_hint for (_, r), geometry in state.submaps.items() if r == 2
    }
    hints = set(second.values())
    assert len(hints) == 1
    hint = hints.pop()
    assert hint is not None and hint.relative_sigma <= 0.005
    for geometry in state.usable_submaps().values():
        assert geometry.quality.focal_over_width == pytest.approx(
            hint.focal_over_width, rel=planner.MAX_FOCAL_DEVIATION
        )


def test_a_dead_submap_is_predicted_in_two_overlapping_halves() -> None:
    state = started(5, base=7)
    state.apply(dead(whole(2)))
    ids = {job.job_id: job for job in planner.next_jobs(state, CONFIG)}
    assert whole(2) not in ids
    first, second = (ids[name].task for name in ("submap/000004a/r1", "submap/000005b/r1"))
    assert isinstance(first, PredictTask) and isinstance(second, PredictTask)
    entry = state.segments[2]
    assert first.spec.overlap_keyframe_ids == entry.overlap_keyframe_ids
    assert first.spec.base_keyframe_ids == entry.base_keyframe_ids[:4]
    assert second.spec.overlap_keyframe_ids == entry.base_keyframe_ids[:4]
    assert second.spec.base_keyframe_ids == entry.base_keyframe_ids[4:]
    assert [k.keyframe_id for k in second.keyframes] == list(second.spec.keyframe_ids)
    run(state, random.Random(0))
    assert planner.is_complete(state, CONFIG)
    assert edges(state) == {(0, 2), (2, 4), (4, 5), (5, 6), (6, 8)}
    assert state.unpredicted_segments() == set()
    graph = posegraph.solve(
        [(i, g.spec.revision) for i, g in state.usable_submaps().items()],
        planner.current_constraints(state), CONFIG.backend, revision=1, is_final=True,
    )  # fmt: skip
    assert graph.breaks == () and {pose.component for pose in graph.poses} == {0}


@pytest.mark.parametrize(
    ("half", "kept", "broken_before"),
    [
        ("submap/000004a/r1", {(0, 2), (5, 6), (6, 8)}, 5),
        ("submap/000005b/r1", {(0, 2), (2, 4), (6, 8)}, 6),
    ],
)
def test_the_graph_breaks_where_a_half_is_dead_too(half: str, kept: set[tuple[int, int]], broken_before: int) -> None:
    state = started(5)
    state.apply(dead(whole(2)))
    state.apply(dead(half))
    run(state, random.Random(0))
    assert planner.is_complete(state, CONFIG)
    assert edges(state) == kept
    graph = posegraph.solve(
        [(i, g.spec.revision) for i, g in state.usable_submaps().items()],
        planner.current_constraints(state), CONFIG.backend, revision=1, is_final=True,
    )  # fmt: skip
    assert len(graph.breaks) == 1 and f"before submap {broken_before}:" in graph.breaks[0]


def test_a_base_of_one_keyframe_has_no_halves() -> None:
    state = started(3, base=1)
    state.apply(dead(whole(1)))
    run(state, random.Random(0))
    assert planner.is_complete(state, CONFIG)
    assert sorted(index for index, _ in state.submaps) == [0, 4]
    assert edges(state) == set()


def test_a_dead_submap_does_not_hold_up_the_others() -> None:
    state = started(9)
    state.apply(dead(whole(4)))
    for _ in range(100):
        jobs = [job for job in planner.next_jobs(state, CONFIG) if "/000008a" not in job.job_id]
        jobs = [job for job in jobs if "/000009b" not in job.job_id]
        if not jobs:
            break
        state.apply(result(jobs[0], {}, 0.02))
    # All others are there while nobody takes the halves.
    assert sorted(index for index, _ in state.submaps) == [0, 2, 4, 6, 10, 12, 14, 16]
    assert not planner.is_complete(state, CONFIG)


def test_a_half_that_the_settled_estimate_contradicts_is_predicted_once_more() -> None:
    state = started(8)
    state.apply(dead(whole(1)))
    run(state, random.Random(0), {2: 0.7}, sigma=0.01)
    assert {key for key in state.submaps if key[1] == 2} == {(2, 2)}
    assert state.submaps[2, 2].record_id == "submap/000002a/r2"
    assert planner.is_complete(state, CONFIG)
    assert edges(state) == {(0, 2), (2, 3), (3, 4)} | {(2 * k, 2 * k + 2) for k in range(2, 7)}


def bad(verdict: SubmapVerdict, spec: SubmapSpec) -> SubmapGeometry:
    done = replace(geometry(spec), verdict=verdict, reason="no texture")
    return replace(done, frames=()) if verdict is SubmapVerdict.FAILED else done


def test_a_failed_submap_is_tried_again_in_a_wider_view_and_then_not_registered() -> None:
    state = started(3)
    for job in planner.next_jobs(state, CONFIG):
        assert isinstance(job.task, PredictTask)
        spec = job.task.spec
        state.apply(bad(SubmapVerdict.FAILED, spec) if spec.submap_index == 2 else geometry(spec))
    (again,) = planner.next_jobs(state, CONFIG)
    assert isinstance(again.task, PredictTask)
    assert again.job_id == whole(1, 2)
    assert again.task.spec.base_keyframe_ids == segment(1).base_keyframe_ids
    assert again.task.spec.overlap_keyframe_ids == segment(0).base_keyframe_ids  # 4 instead of 2
    assert again.task.spec.focal_hint is not None
    assert not planner.is_complete(state, CONFIG)
    state.apply(bad(SubmapVerdict.FAILED, again.task.spec))
    assert planner.next_jobs(state, CONFIG) == []
    assert planner.is_complete(state, CONFIG)
    assert sorted(state.usable_submaps()) == [0, 4]


@pytest.mark.parametrize(
    ("second", "used"), [(SubmapVerdict.GOOD, 2), (SubmapVerdict.LOW_QUALITY, 2), (SubmapVerdict.ROTATION_ONLY, 1)]
)
def test_of_two_predictions_the_better_one_is_used(second: SubmapVerdict, used: int) -> None:
    state = started(2)
    for job in planner.next_jobs(state, CONFIG):
        assert isinstance(job.task, PredictTask)
        spec = job.task.spec
        state.apply(bad(SubmapVerdict.LOW_QUALITY, spec) if spec.submap_index == 2 else geometry(spec))
    again = next(job for job in planner.next_jobs(state, CONFIG) if isinstance(job.task, PredictTask))
    assert isinstance(again.task, PredictTask)
    state.apply(replace(geometry(again.task.spec), verdict=second))
    chosen = state.submap(2)
    assert chosen is not None and chosen.spec.revision == used
    run(state, random.Random(0))
    constraints = planner.current_constraints(state)
    assert [(c.spec.i_revision, c.spec.j_revision) for c in constraints] == [(1, used)]


def test_a_submap_without_anything_before_it_and_one_that_turned_are_not_tried_again() -> None:
    state = started(2)
    for job in planner.next_jobs(state, CONFIG):
        assert isinstance(job.task, PredictTask)
        verdict = SubmapVerdict.ROTATION_ONLY if job.task.spec.submap_index else SubmapVerdict.LOW_QUALITY
        state.apply(bad(verdict, job.task.spec))
    assert not any(isinstance(job.task, PredictTask) for job in planner.next_jobs(state, CONFIG))


def test_known_intrinsics_are_in_every_job_and_no_estimate_replaces_them() -> None:
    config = load_config(assignments=[f"inference.intrinsics.{name}" for name in ("fx=360", "cx=300", "cy=90.5")])
    state = started(5)
    jobs = planner.next_jobs(state, config)
    assert [job.job_id for job in jobs] == [whole(k) for k in range(5)]  # none waits for others
    for job in jobs:
        assert isinstance(job.task, PredictTask)
        hint = job.task.spec.focal_hint
        assert hint is not None and hint.is_fixed
        assert hint.focal_over_width == pytest.approx(360 / 620)
        assert hint.intrinsics == Intrinsics(360.0, 360.0, 300.0, 90.5, 620, 188)
        state.apply(geometry(job.task.spec, 0.7))
    assert not any(isinstance(job.task, PredictTask) for job in planner.next_jobs(state, config))


def test_not_complete_before_the_input_is_closed() -> None:
    state = started(3, ended=False)
    run(state, random.Random(0))
    assert not planner.is_complete(state, CONFIG)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    count=st.integers(1, 12),
    sigma=st.floats(0.002, 0.3),
    focals=st.dictionaries(st.integers(0, 23), st.floats(0.4, 0.9), max_size=6),
    dead_share=st.sampled_from([0.0, 0.2, 0.6]),
    bad_share=st.sampled_from([0.0, 0.3]),
    base=st.integers(1, 7),
)
def test_the_outcome_does_not_depend_on_who_is_faster(
    seed: int,
    count: int,
    sigma: float,
    focals: dict[int, float],
    dead_share: float,
    bad_share: float,
    base: int,
) -> None:
    outcomes = []
    for order in (random.Random(seed), random.Random(seed + 1)):
        state = started(count, base=base, ended=False)
        run(state, order, focals, sigma, dead_share, bad_share)
        state.apply(started(count, base=base).events["stream_ended"])
        run(state, order, focals, sigma, dead_share, bad_share)
        assert planner.is_complete(state, CONFIG)
        specs = {key: value.spec for key, value in state.submaps.items()}
        outcomes.append((specs, sorted(state.constraints), sorted(state.dead_jobs)))
    assert outcomes[0] == outcomes[1]


def live_breaks(state: LogState) -> tuple[str, ...]:
    nodes = [(index, geometry.spec.revision) for index, geometry in state.usable_submaps().items()]
    joints = planner.undecided_joints(state, CONFIG)
    return posegraph.find_breaks(nodes, planner.current_constraints(state), joints)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32), count=st.integers(2, 8), dead_share=st.sampled_from([0.0, 0.3, 0.6]))
def test_a_break_is_named_only_once_nothing_can_mend_it(seed: int, count: int, dead_share: float) -> None:
    """At every moment of a run, jobs in any order: what is called a break then is one at the end too."""
    state, order = started(count), random.Random(seed)
    named: set[str] = set()
    while jobs := planner.next_jobs(state, CONFIG):
        job = order.choice(jobs)
        is_doomed = zlib.crc32(f"{seed}/{job.job_id}".encode()) % 100 < 100 * dead_share
        state.apply(dead(job.job_id) if is_doomed else result(job, {}, 0.02))
        named.update(live_breaks(state))
    assert planner.undecided_joints(state, CONFIG) == frozenset()
    nodes = [(index, geometry.spec.revision) for index, geometry in state.usable_submaps().items()]
    final = posegraph.find_breaks(nodes, planner.current_constraints(state))
    assert named <= set(final)
    assert live_breaks(state) == final


def test_a_registration_that_is_still_leased_is_no_break_and_a_dead_one_is() -> None:
    state = started(3)
    while predictions := [job for job in planner.next_jobs(state, CONFIG) if job.kind is JobKind.PREDICT]:
        for job in predictions:
            state.apply(result(job, {}, 0.02))
    leased = planner.next_jobs(state, CONFIG)
    assert [job.kind for job in leased] == [JobKind.REGISTER] * 2
    assert live_breaks(state) == () and planner.undecided_joints(state, CONFIG) == {2, 4}
    state.apply(dead(leased[1].job_id))
    assert len(live_breaks(state)) == 1 and "before submap 4" in live_breaks(state)[0]
    task = leased[0].task
    assert isinstance(task, RegisterTask)
    state.apply(replace(constraint(task), accepted=False, reason="no texture"))
    assert len(live_breaks(state)) == 2 and "no texture" in live_breaks(state)[0]


def test_a_session_is_metric_when_all_its_submaps_are() -> None:
    state = started(2)
    assert not state.is_metric
    for job in planner.next_jobs(state, CONFIG):
        assert isinstance(job.task, PredictTask)
        state.apply(replace(geometry(job.task.spec), scale_kind=ScaleKind.METRIC))
    assert state.is_metric
    register = planner.next_jobs(state, CONFIG)[0].task
    assert isinstance(register, RegisterTask) and register.fix_scale
    state.submaps[(2, 1)] = replace(state.submaps[(2, 1)], scale_kind=ScaleKind.RELATIVE)
    assert not state.is_metric
