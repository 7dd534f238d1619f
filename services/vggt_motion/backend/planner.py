"""The planner: which jobs the log calls for (DESIGN section 4). A pure function; any restart plans the same jobs again.

- a segment closed: predict its submap, once the results that its focal hint folds (submaps 0 to k-3) are known;
- the focal estimate settled: predict submaps that it contradicts once more, as revision 2;
- two neighbours predicted: register them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from vggt_motion.backend import focal
from vggt_motion.backend.state import LogState
from vggt_motion.config import Config
from vggt_motion.records import (
    Constraint,
    ConstraintKind,
    FocalHint,
    JobKind,
    PredictTask,
    RegisterTask,
    RegistrationSpec,
    ScaleKind,
    SharedGeometry,
    SubmapGeometry,
    SubmapQuality,
    SubmapSpec,
    constraint_id,
    submap_id,
)

# Submap k gets the fold of submaps 0 .. k - HINT_LAG: up to HINT_LAG submaps can be predicted at the same time.
HINT_LAG = 3
# A focal length that is off by more than this share bends a submap visibly.
MAX_FOCAL_DEVIATION = 0.02


@dataclass(frozen=True)
class PlannedJob:
    """A job before it is encoded for the queue."""

    job_id: str
    kind: JobKind
    task: PredictTask | RegisterTask
    priority: int


def next_jobs(state: LogState, config: Config) -> list[PlannedJob]:
    """All jobs that the log calls for and that have no result and are not dead, in a fixed order.

    Jobs that are already in the queue are among them: submitting is idempotent by id.
    """
    return [*_predictions(state, config), *_registrations(state, config)]


def is_complete(state: LogState, config: Config) -> bool:
    """Whether the input is closed and no job is left to do: time for the final solve."""
    return state.is_input_complete and not next_jobs(state, config)


def _is_resolved(state: LogState, index: int, revision: int) -> bool:
    return (index, revision) in state.submaps or submap_id(index, revision) in state.dead_jobs


def _quality(state: LogState, index: int) -> SubmapQuality | None:
    geometry = state.submaps.get((index, 1))
    return geometry.quality if geometry is not None else None


def _given_hint(config: Config) -> FocalHint | None:
    given = config.inference.focal_over_width
    if given is None:
        return None
    return FocalHint(given, relative_sigma=0.0, radial_k1=config.inference.radial_k1 or 0.0, is_fixed=True)


def _predictions(state: LogState, config: Config) -> Iterator[PlannedJob]:
    given = _given_hint(config)
    estimate = focal.FocalEstimate()
    for index in sorted(state.segments):
        newest = index - HINT_LAG
        if given is None and newest >= 0:
            if not _is_resolved(state, newest, 1):
                break
            estimate.add(_quality(state, newest))
        if not _is_resolved(state, index, 1):
            yield from _predict_job(state, index, 1, given or estimate.hint())
    for index, hint in _second_predictions(state, config).items():
        if not _is_resolved(state, index, 2):
            yield from _predict_job(state, index, 2, hint)


def _second_predictions(state: LogState, config: Config) -> dict[int, FocalHint]:
    """Submaps whose focal length is contradicted by the estimate at the moment that it settled, with that estimate."""
    decision = _settled_estimate(state) if config.inference.focal_over_width is None else None
    if decision is None:
        return {}
    settled_at, hint = decision
    contradicted = {}
    for index in range(min(settled_at + HINT_LAG, len(state.segments))):
        quality = _quality(state, index)
        if quality is None or not quality.focal_over_width > 0.0:
            continue
        if abs(quality.focal_over_width / hint.focal_over_width - 1.0) > MAX_FOCAL_DEVIATION:
            contradicted[index] = hint
    return contradicted


def _settled_estimate(state: LogState) -> tuple[int, FocalHint] | None:
    """Index of the submap with which the fold settled, and the estimate at that point; the same on every run.

    A stream that ends before that is judged by all it has.
    """
    estimate = focal.FocalEstimate()
    for index in sorted(state.segments):
        if not _is_resolved(state, index, 1):
            return None
        estimate.add(_quality(state, index))
        hint = estimate.settled_hint()
        if hint is not None:
            return index, hint
    hint = estimate.hint()
    # An estimate that is worse than the deviation it is to judge cannot judge.
    if hint is None or not state.is_input_complete or hint.relative_sigma > MAX_FOCAL_DEVIATION:
        return None
    return len(state.segments) - 1, hint


def _predict_job(state: LogState, index: int, revision: int, hint: FocalHint | None) -> Iterator[PlannedJob]:
    segment = state.segments[index]
    members = segment.overlap_keyframe_ids + segment.base_keyframe_ids
    if any(keyframe_id not in state.keyframes for keyframe_id in members):
        return  # the streams are followed apart: the keyframes are on their way
    keyframes = tuple(state.keyframes[keyframe_id] for keyframe_id in members)
    copies = tuple(
        (keyframe.keyframe_id, keyframe.zero_motion_copy_of)
        for keyframe in keyframes
        if keyframe.zero_motion_copy_of is not None and keyframe.zero_motion_copy_of in members
    )
    spec = SubmapSpec(
        submap_index=index,
        revision=revision,
        overlap_keyframe_ids=segment.overlap_keyframe_ids,
        base_keyframe_ids=segment.base_keyframe_ids,
        zero_motion_copies=copies,
        focal_hint=hint,
        ego_mask=segment.ego_mask,
    )
    yield PlannedJob(submap_id(index, revision), JobKind.PREDICT, PredictTask(spec, keyframes), priority=index)


def _registrations(state: LogState, config: Config) -> Iterator[PlannedJob]:
    """Registration of neighbours.

    The first revisions as soon as both are there, so that there is a live trajectory; and the last revisions when it is
    certain which these are. So the set of constraints does not depend on who was faster.
    """
    second = _second_predictions(state, config)
    for j in sorted(state.segments):
        i = j - 1
        if i not in state.segments:
            continue
        yield from _register_job(state, state.submaps.get((i, 1)), state.submaps.get((j, 1)))
        is_certain = all(_is_resolved(state, k, 2) for k in (i, j) if k in second)
        if is_certain and not {i, j}.isdisjoint(second):
            yield from _register_job(state, state.submap(i), state.submap(j))


def _register_job(
    state: LogState, geometry_i: SubmapGeometry | None, geometry_j: SubmapGeometry | None
) -> Iterator[PlannedJob]:
    if geometry_i is None or geometry_j is None or not geometry_i.frames or not geometry_j.frames:
        return
    i, j = geometry_i.spec, geometry_j.spec
    kind = ConstraintKind.ADJACENT
    job_id = constraint_id(kind, i.submap_index, i.revision, j.submap_index, j.revision)
    if job_id in state.constraints or job_id in state.dead_jobs:
        return
    views = ((geometry_i.frame(keyframe_id), geometry_j.frame(keyframe_id)) for keyframe_id in j.overlap_keyframe_ids)
    shared = tuple(SharedGeometry(in_i, in_j) for in_i, in_j in views if in_i is not None and in_j is not None)
    spec = RegistrationSpec(
        i=i.submap_index,
        j=j.submap_index,
        i_revision=i.revision,
        j_revision=j.revision,
        kind=kind,
        shared_keyframe_ids=tuple(frame.in_i.keyframe_id for frame in shared),
    )
    fix_scale = geometry_i.scale_kind is ScaleKind.METRIC and geometry_j.scale_kind is ScaleKind.METRIC
    yield PlannedJob(job_id, JobKind.REGISTER, RegisterTask(spec, shared, fix_scale), priority=spec.j)


def current_constraints(state: LogState) -> list[Constraint]:
    """Constraints between the submaps that the trajectory uses, sorted by identity."""
    current = {index: geometry.spec.revision for index, geometry in state.usable_submaps().items()}
    return [
        constraint
        for _, constraint in sorted(state.constraints.items())
        if current.get(constraint.spec.i) == constraint.spec.i_revision
        and current.get(constraint.spec.j) == constraint.spec.j_revision
    ]
