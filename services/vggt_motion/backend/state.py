"""The log folded into what the planner, the pose graph and the trajectory need to know."""

from __future__ import annotations

from dataclasses import dataclass, field

from vggt_motion.records import (
    Constraint,
    Event,
    EventKind,
    GraphUpdate,
    Keyframe,
    ScaleKind,
    Segment,
    SubmapGeometry,
    SubmapVerdict,
    segment_index_of,
)

MAX_REVISION = 2  # a submap is predicted at most once more: with a settled focal length, in a wider view, or both
_USABLE = (SubmapVerdict.GOOD, SubmapVerdict.LOW_QUALITY, SubmapVerdict.ROTATION_ONLY)  # best first


@dataclass
class LogState:
    """Everything that the log says, by identity.

    Applying a record twice, or records of different streams in another order, gives the same state.
    """

    keyframes: dict[str, Keyframe] = field(default_factory=dict)
    segments: dict[int, Segment] = field(default_factory=dict)
    submaps: dict[tuple[int, int], SubmapGeometry] = field(default_factory=dict)  # (index, revision)
    constraints: dict[str, Constraint] = field(default_factory=dict)
    dead_jobs: dict[str, Event] = field(default_factory=dict)
    graphs: dict[str, GraphUpdate] = field(default_factory=dict)  # only the newest live one and the final one
    events: dict[str, Event] = field(default_factory=dict)

    def apply(self, record: Keyframe | Segment | SubmapGeometry | Constraint | GraphUpdate | Event) -> None:
        """Take in one record of the log."""
        match record:
            case Keyframe():
                self.keyframes[record.keyframe_id] = record
            case Segment():
                self.segments[record.index] = record
            case SubmapGeometry():
                self.submaps[(record.spec.submap_index, record.spec.revision)] = record
            case Constraint():
                self.constraints[record.record_id] = record
            case GraphUpdate():
                newest = self.latest_graph()
                is_newer = newest is None or (not newest.is_final and record.revision >= newest.revision)
                if record.is_final or is_newer:
                    self.graphs = {record.record_id: record}
            case Event():
                self.events[record.event_id] = record
                if record.kind is EventKind.JOB_DEAD:
                    self.dead_jobs[record.detail.get("job_id", record.event_id)] = record

    @property
    def stream_ended(self) -> Event | None:
        """The event that closed the input, if it has come."""
        return next((e for e in self.events.values() if e.kind is EventKind.STREAM_ENDED), None)

    @property
    def is_input_complete(self) -> bool:
        """Whether the input is closed and every segment that it promised is here."""
        ended = self.stream_ended
        return ended is not None and len(self.segments) >= int(ended.detail.get("segment_count", "0"))

    @property
    def graph_input_count(self) -> int:
        """How many records a graph of this moment is made from; only grows, and numbers the graphs."""
        return len(self.submaps) + len(self.constraints) + len(self.dead_jobs)

    @property
    def is_metric(self) -> bool:
        """Whether all usable submaps are in metres, so that every scale is 1."""
        usable = self.usable_submaps().values()
        return bool(usable) and all(geometry.scale_kind is ScaleKind.METRIC for geometry in usable)

    def unpredicted_segments(self) -> set[int]:
        """Indices of the closed segments that no submap came of yet."""
        return self.segments.keys() - {segment_index_of(index) for index, _ in self.submaps}

    def awaited_keyframes(self) -> set[str]:
        """Keyframes that a segment names and that have not come."""
        named = (
            keyframe_id
            for segment in self.segments.values()
            for keyframe_id in (*segment.overlap_keyframe_ids, *segment.base_keyframe_ids)
        )
        return {keyframe_id for keyframe_id in named if keyframe_id not in self.keyframes}

    def latest_graph(self) -> GraphUpdate | None:
        """The final graph, or else the newest live one."""
        return next(iter(self.graphs.values()), None)

    def submap(self, index: int) -> SubmapGeometry | None:
        """The submap's usable geometry of the best verdict, of the higher revision where two are alike."""
        tried = (self.submaps.get((index, revision)) for revision in range(MAX_REVISION, 0, -1))
        usable = [geometry for geometry in tried if geometry is not None and geometry.verdict in _USABLE]
        return min((g for g in usable if g.frames), key=lambda g: _USABLE.index(g.verdict), default=None)

    def usable_submaps(self) -> dict[int, SubmapGeometry]:
        """:meth:`submap` of every index that has one, in index order."""
        found = ((index, self.submap(index)) for index in sorted({index for index, _ in self.submaps}))
        return {index: geometry for index, geometry in found if geometry is not None}
