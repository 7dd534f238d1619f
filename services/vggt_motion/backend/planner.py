"""The planner: which jobs the log calls for (DESIGN section 4). A pure function; any restart plans the same jobs again.

- a segment closed: predict its submap, once the results that its focal hint folds (submaps 0 to k-3) are known;
- the focal estimate settled: predict submaps that it contradicts once more, as revision 2 (this, and the waiting for
  results, only with a predictor that takes a focal hint);
- a submap came out badly: predict it once more, as revision 2, with the settled estimate and in a wider view;
- a submap cannot be predicted (its job is dead): predict the two halves of its base, which overlap; where a half is
  dead too, the graph breaks;
- two neighbours predicted: register them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

from vggt_motion.backend import focal
from vggt_motion.backend.state import LogState
from vggt_motion.config import Config
from vggt_motion.inference.given import given_hint, is_given
from vggt_motion.inference.registry import takes_focal_hints
from vggt_motion.records import (
    Constraint,
    ConstraintKind,
    FocalHint,
    JobKind,
    PredictTask,
    RegisterTask,
    RegistrationSpec,
    ScaleKind,
    Segment,
    SharedGeometry,
    SubmapGeometry,
    SubmapPart,
    SubmapQuality,
    SubmapSpec,
    SubmapVerdict,
    constraint_id,
    submap_id,
    submap_index,
)

# Submap k gets the fold of submaps 0 .. k - HINT_LAG: up to HINT_LAG submaps can be predicted at the same time.
HINT_LAG = 3
# A focal length that is off by more than this share bends a submap visibly.
MAX_FOCAL_DEVIATION = 0.02
# A submap that came out badly is tried again together with so many more keyframes before it: a wider baseline, another
# start, and points that were seen for longer.
_WIDER_OVERLAP_FACTOR = 2
_BAD = frozenset({SubmapVerdict.LOW_QUALITY, SubmapVerdict.FAILED})
# Neighbours with different focal lengths differ by more than a similarity. On a straight road, where nobody knows the
# focal length, submaps that agree on a wrong one still fit together: so a second prediction keeps to the estimate,
# however uncertain that is. Measured on 59 m of straight road: 0.04 to 0.05 m ATE with any common value from 0.40 to
# 0.75 widths (the truth is 0.58), 0.08 m with a value of its own for each submap.
CONSENSUS_RELATIVE_SIGMA = 0.005


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
    """Whether the input is closed and no job is left to do: time for the final solve.

    The streams are followed apart: while keyframes or submaps are on their way, there may be nothing to do yet.
    """
    return (
        state.is_input_complete
        and not state.awaited_keyframes()
        and all(_is_resolved(state, composition, 1) for composition in _all_compositions(state, config))
        and not next_jobs(state, config)
    )


@dataclass(frozen=True)
class _Composition:
    """A submap as the log calls for it: a whole base, or half of one whose whole is dead."""

    segment: Segment
    part: SubmapPart | None
    overlap_keyframe_ids: tuple[str, ...]
    base_keyframe_ids: tuple[str, ...]

    @property
    def index(self) -> int:
        return submap_index(self.segment.index, self.part)


def _whole(segment: Segment) -> _Composition:
    return _Composition(segment, None, segment.overlap_keyframe_ids, segment.base_keyframe_ids)


def _halves(segment: Segment, config: Config) -> list[_Composition]:
    """The base in two, the second of which begins with the end of the first as its overlap; none of a single keyframe.

    A later submap shares the end of the base, so that it is neighbour to the second half as it was to the whole.
    """
    base = segment.base_keyframe_ids
    middle = (len(base) + 1) // 2
    first, second = base[:middle], base[middle:]
    if not second:
        return []
    shared = first[-config.frontend.overlap_keyframes :]
    return [
        _Composition(segment, SubmapPart.FIRST_HALF, segment.overlap_keyframe_ids, first),
        _Composition(segment, SubmapPart.SECOND_HALF, shared, second),
    ]


def _compositions(state: LogState, config: Config, segment: Segment) -> list[_Composition]:
    """The submaps of a segment: the whole, or its halves once the whole is dead."""
    whole = _whole(segment)
    return _halves(segment, config) if _is_dead(state, whole, 1) else [whole]


def _all_compositions(state: LogState, config: Config) -> list[_Composition]:
    """The submaps of all segments, along the drive."""
    return [c for index in sorted(state.segments) for c in _compositions(state, config, state.segments[index])]


def _is_dead(state: LogState, composition: _Composition, revision: int) -> bool:
    return submap_id(composition.index, revision, composition.part) in state.dead_jobs


def _geometry(state: LogState, composition: _Composition, revision: int) -> SubmapGeometry | None:
    geometry = state.submaps.get((composition.index, revision))
    # The whole and its first half have one index.
    return geometry if geometry is not None and geometry.spec.part is composition.part else None


def _is_resolved(state: LogState, composition: _Composition, revision: int) -> bool:
    return _geometry(state, composition, revision) is not None or _is_dead(state, composition, revision)


def _quality(state: LogState, composition: _Composition) -> SubmapQuality | None:
    geometry = _geometry(state, composition, 1)
    return geometry.quality if geometry is not None else None


def _is_focal_estimated(config: Config) -> bool:
    """Whether submaps are predicted with what earlier ones found of the focal length."""
    return not is_given(config.inference) and takes_focal_hints(config.inference.predictor)


def _predictions(state: LogState, config: Config) -> Iterator[PlannedJob]:
    is_estimated = _is_focal_estimated(config)
    estimate = focal.FocalEstimate()
    for index in sorted(state.segments):
        newest = index - HINT_LAG
        if is_estimated and newest >= 0:
            # Only wholes are folded: nobody waits for the halves of a submap that cannot be predicted.
            whole = _whole(state.segments[newest])
            if not _is_resolved(state, whole, 1):
                break
            estimate.add(_quality(state, whole))
        for composition in _compositions(state, config, state.segments[index]):
            if not _is_resolved(state, composition, 1):
                yield from _predict_job(state, config, composition, 1, estimate.hint())
    for composition, hint in _second_predictions(state, config).items():
        if not _is_resolved(state, composition, 2):
            first = _geometry(state, composition, 1)
            is_bad = first is not None and first.verdict in _BAD
            yield from _predict_job(state, config, _wider(state, composition) if is_bad else composition, 2, hint)


def _second_predictions(state: LogState, config: Config) -> dict[_Composition, FocalHint | None]:
    """Submaps that are predicted once more, and with which estimate.

    Those that came out badly, and those whose focal length the estimate contradicts at the moment that it settled.
    """
    is_estimated = _is_focal_estimated(config)
    decision = _settled_estimate(state) if is_estimated else None
    hint = decision[1] if decision is not None else None
    again: dict[_Composition, FocalHint | None] = {}
    for composition in _all_compositions(state, config):
        geometry = _geometry(state, composition, 1)
        if geometry is None or (decision is None and is_estimated):
            continue
        if geometry.verdict in _BAD and _wider(state, composition) is not composition:
            again[composition] = hint
        elif decision is not None and hint is not None and composition.segment.index < decision[0] + HINT_LAG:
            found = geometry.quality.focal_over_width
            if found > 0.0 and abs(found / hint.focal_over_width - 1.0) > MAX_FOCAL_DEVIATION:
                again[composition] = hint
    if hint is None:
        return again
    firm = replace(hint, relative_sigma=min(hint.relative_sigma, CONSENSUS_RELATIVE_SIGMA))
    return dict.fromkeys(again, firm)


def _wider(state: LogState, composition: _Composition) -> _Composition:
    """The same base with more of the keyframes before it; the composition itself where there are none."""
    before = state.segments.get(composition.segment.index - 1)
    if before is None or composition.part is SubmapPart.SECOND_HALF:
        return composition
    count = _WIDER_OVERLAP_FACTOR * len(composition.overlap_keyframe_ids)
    wider = before.base_keyframe_ids[-count:] if count else ()
    if len(wider) <= len(composition.overlap_keyframe_ids):
        return composition
    return replace(composition, overlap_keyframe_ids=wider)


def _settled_estimate(state: LogState) -> tuple[int, FocalHint] | None:
    """Index of the segment with which the fold settled, and the estimate at that point; the same on every run.

    A stream that ends before that is judged by all it has.
    """
    estimate = focal.FocalEstimate()
    for index in sorted(state.segments):
        whole = _whole(state.segments[index])
        if not _is_resolved(state, whole, 1):
            return None
        estimate.add(_quality(state, whole))
        hint = estimate.settled_hint()
        if hint is not None:
            return index, hint
    hint = estimate.hint()
    if hint is None or not state.is_input_complete:
        return None
    return len(state.segments) - 1, hint


def _predict_job(
    state: LogState, config: Config, composition: _Composition, revision: int, hint: FocalHint | None
) -> Iterator[PlannedJob]:
    members = composition.overlap_keyframe_ids + composition.base_keyframe_ids
    if any(keyframe_id not in state.keyframes for keyframe_id in members):
        return  # the streams are followed apart: the keyframes are on their way
    keyframes = tuple(state.keyframes[keyframe_id] for keyframe_id in members)
    copies = tuple(
        (keyframe.keyframe_id, keyframe.zero_motion_copy_of)
        for keyframe in keyframes
        if keyframe.zero_motion_copy_of is not None and keyframe.zero_motion_copy_of in members
    )
    index, part = composition.index, composition.part
    spec = SubmapSpec(
        submap_index=index,
        revision=revision,
        overlap_keyframe_ids=composition.overlap_keyframe_ids,
        base_keyframe_ids=composition.base_keyframe_ids,
        zero_motion_copies=copies,
        focal_hint=given_hint(config.inference, keyframes[0].width_px, keyframes[0].height_px) or hint,
        ego_mask=composition.segment.ego_mask,
        part=part,
    )
    yield PlannedJob(submap_id(index, revision, part), JobKind.PREDICT, PredictTask(spec, keyframes), priority=index)


def _registrations(state: LogState, config: Config) -> Iterator[PlannedJob]:
    """Registration of neighbours.

    The first revisions as soon as both are there, so that there is a live trajectory; and the last revisions when it is
    certain which these are. So the set of constraints does not depend on who was faster.
    """
    second = _second_predictions(state, config)
    for i, j in pairwise(_all_compositions(state, config)):
        if j.segment.index > i.segment.index + 1:
            continue  # the segment between them is on its way, or had a single keyframe and is dead
        yield from _register_job(state, _geometry(state, i, 1), _geometry(state, j, 1))
        is_certain = all(_is_resolved(state, k, 2) for k in (i, j) if k in second)
        if is_certain and not {i, j}.isdisjoint(second):
            yield from _register_job(state, _newest_usable(state, i), _newest_usable(state, j))


def _newest_usable(state: LogState, composition: _Composition) -> SubmapGeometry | None:
    geometry = state.submap(composition.index)
    return geometry if geometry is not None and geometry.spec.part is composition.part else None


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


def undecided_joints(state: LogState, config: Config) -> frozenset[int]:
    """Submaps of which nobody can say yet whether the trajectory goes on to them or breaks there.

    That is open while the submap or one before it is still to be predicted, or while the registration of the
    two is in the queue or leased.
    """
    second = _second_predictions(state, config)
    undecided: set[int] = set()
    is_open = False  # what lies between the last submap with geometry and the next one
    before: _Composition | None = None
    for composition in _all_compositions(state, config):
        if before is not None and any(
            index not in state.segments for index in range(before.segment.index + 1, composition.segment.index)
        ):
            is_open = True
        is_pending = not _is_resolved(state, composition, 1) or (
            composition in second and not _is_resolved(state, composition, 2)
        )
        geometry = _newest_usable(state, composition)
        if geometry is None:
            is_open |= is_pending
        else:
            is_next = before is not None and composition.segment.index <= before.segment.index + 1
            earlier = _newest_usable(state, before) if before is not None and is_next else None
            if is_open or is_pending or any(_register_job(state, earlier, geometry)):
                undecided.add(composition.index)
            is_open = is_pending
        before = composition
    return frozenset(undecided)


def current_constraints(state: LogState) -> list[Constraint]:
    """Constraints between the submaps that the trajectory uses, sorted by identity."""
    current = {index: geometry.spec.revision for index, geometry in state.usable_submaps().items()}
    return [
        constraint
        for _, constraint in sorted(state.constraints.items())
        if current.get(constraint.spec.i) == constraint.spec.i_revision
        and current.get(constraint.spec.j) == constraint.spec.j_revision
    ]
