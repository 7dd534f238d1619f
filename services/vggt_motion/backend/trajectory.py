"""Composition of the world trajectory from the optimised graph (paper eq. 13, DESIGN 3.7).

A keyframe's pose is ``T_w = X_k T_k`` through its home submap k; every other input frame is interpolated by capture
time between the keyframes around it, in the world, after optimisation. No input frame is without an entry: where
there is no pose, the entry says so.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise
from typing import Literal

import numpy as np
import numpy.typing as npt

from vggt_motion.geometry import se3
from vggt_motion.geometry.track import PoseTrack
from vggt_motion.records import (
    FrameEntry,
    FrameGeometry,
    GraphUpdate,
    Keyframe,
    MotionState,
    Segment,
    SubmapGeometry,
    SubmapPose,
    SubmapVerdict,
    submap_index,
)

Array = npt.NDArray[np.float64]
NO_COMPONENT = -1


class PoseOrigin(StrEnum):
    """Where a pose comes from."""

    HOME = "home"  # solved in the keyframe's home submap
    OTHER_SUBMAP = "other_submap"  # not registered at home, but in a submap that overlaps it
    ZERO_MOTION_COPY = "zero_motion_copy"  # the other end of a stop: shares the pose of the first
    INTERPOLATED = "interpolated"  # between two keyframes of one component
    HELD = "held"  # no keyframe on one side, or the trajectory is broken there: the nearest pose is held
    NONE = "none"  # nothing is known


@dataclass(frozen=True)
class TrajectoryPose:
    """One input frame in the world."""

    camera: str
    epoch: int
    frame_index: int
    capture_time_ns: int
    state: MotionState
    is_keyframe: bool
    origin: PoseOrigin
    component: int  # first submap of its connected part, across which poses share no frame; NO_COMPONENT = no pose
    world_from_camera: Array | None  # (4, 4), world units; None if and only if the origin is NONE
    verdict: SubmapVerdict | None = None  # of the submap that it comes from, the worse of two; None = no pose, or none


@dataclass(frozen=True)
class Trajectory:
    """All input frames in the order of their cameras, epochs and indices, keyframes among them."""

    graph_revision: int
    is_final: bool
    frames: tuple[TrajectoryPose, ...]
    scale: float = 1.0  # world units per unit of the graph; not 1 where a known distance sets the scale

    @property
    def keyframes(self) -> tuple[TrajectoryPose, ...]:
        """The keyframes alone."""
        return tuple(frame for frame in self.frames if frame.is_keyframe)

    @property
    def components(self) -> tuple[int, ...]:
        """The connected parts, in order; more than one means that the trajectory is broken."""
        return tuple(sorted({frame.component for frame in self.frames if frame.world_from_camera is not None}))

    def origin_counts(self) -> dict[PoseOrigin, int]:
        """How many frames have their pose from where."""
        return dict(Counter(frame.origin for frame in self.frames))

    def track(self, frames: Literal["key", "all"] = "all", component: int | None = None) -> PoseTrack:
        """Poses of the keyframes or of all frames that have one, of one component or of all."""
        chosen = [
            frame
            for frame in self.frames
            if frame.world_from_camera is not None
            and (frames == "all" or frame.is_keyframe)
            and (component is None or frame.component == component)
        ]
        poses = np.array([frame.world_from_camera for frame in chosen], dtype=np.float64).reshape(-1, 4, 4)
        return PoseTrack(np.array([frame.capture_time_ns for frame in chosen], dtype=np.int64), poses)

    def path_length(self) -> float:
        """Length of the path through all frames, world units; gaps between components do not count."""
        return _path_length(self.frames)


def compose(
    keyframes: Sequence[Keyframe],
    segments: Sequence[Segment],
    submaps: Mapping[int, SubmapGeometry],
    graph: GraphUpdate,
    *,
    known_distance_m: float | None = None,
) -> Trajectory:
    """Put every input frame of the closed segments into the world.

    Args:
        keyframes: at least those of the segments; they say which is the zero-motion copy of which.
        segments: the closed segments; their lists of frames are the input frames.
        submaps: geometry per submap index, of the revision that the graph holds; others are not used.
        graph: optimised submap poses.
        known_distance_m: travelled distance; sets the scale so that the path through all frames is as long.
    """
    solved = _solve_keyframes(submaps, graph)
    originals = {k.keyframe_id: k.zero_motion_copy_of for k in keyframes if k.zero_motion_copy_of is not None}
    for copy, original in sorted(originals.items()):
        _share(solved, copy, original)
    frames: list[TrajectoryPose] = []
    for (camera, epoch), entries in _streams(segments).items():
        first = submap_index(min(s.index for s in segments if (s.camera, s.epoch) == (camera, epoch)))
        known = {
            k.frame_index: solved[k.keyframe_id]
            for k in keyframes
            if (k.camera, k.epoch) == (camera, epoch) and k.keyframe_id in solved
        }
        frames.extend(_fill(camera, epoch, entries, known, first))
    trajectory = Trajectory(graph.revision, graph.is_final, tuple(frames))
    length = trajectory.path_length()
    if known_distance_m is None or length <= 0.0:
        return trajectory
    return _scaled(trajectory, known_distance_m / length)


@dataclass(frozen=True)
class _Solved:
    world_from_camera: Array
    component: int
    origin: PoseOrigin
    verdict: SubmapVerdict | None = None


def _solve_keyframes(submaps: Mapping[int, SubmapGeometry], graph: GraphUpdate) -> dict[str, _Solved]:
    """Poses of the keyframes that a solved submap holds: home before overlap before loop frames, then index order."""
    candidates: dict[str, tuple[tuple[int, int], FrameGeometry, SubmapPose, SubmapVerdict]] = {}
    for pose in graph.poses:
        submap = submaps.get(pose.submap_index)
        if submap is None or submap.spec.revision != pose.submap_revision:
            continue
        roles = (submap.spec.base_keyframe_ids, submap.spec.overlap_keyframe_ids, submap.spec.loop_keyframe_ids)
        rank = {keyframe_id: place for place, ids in reversed(list(enumerate(roles))) for keyframe_id in ids}
        for frame in submap.frames:
            found = candidates.get(frame.keyframe_id)
            place = (rank[frame.keyframe_id], pose.submap_index)
            if found is None or place < found[0]:
                candidates[frame.keyframe_id] = (place, frame, pose, submap.verdict)
    return {
        keyframe_id: _Solved(
            pose.world_from_submap.act_pose(frame.submap_from_camera),
            pose.component,
            PoseOrigin.HOME if role == 0 else PoseOrigin.OTHER_SUBMAP,
            verdict,
        )
        for keyframe_id, ((role, _), frame, pose, verdict) in candidates.items()
    }


def _share(solved: dict[str, _Solved], copy: str, original: str) -> None:
    """Both ends of a stop get one pose, whichever of them is solved; the original's where both are."""
    if original in solved:
        solved[copy] = replace(solved[original], origin=PoseOrigin.ZERO_MOTION_COPY)
    elif copy in solved:
        solved[original] = replace(solved[copy], origin=PoseOrigin.ZERO_MOTION_COPY)


def _streams(segments: Sequence[Segment]) -> dict[tuple[str, int], list[FrameEntry]]:
    """Frames per camera and epoch, each once, in order of index."""
    streams: dict[tuple[str, int], dict[int, FrameEntry]] = defaultdict(dict)
    for segment in segments:
        streams[(segment.camera, segment.epoch)] |= {entry.frame_index: entry for entry in segment.frames}
    return {key: [frames[index] for index in sorted(frames)] for key, frames in sorted(streams.items())}


def _fill(
    camera: str, epoch: int, entries: Sequence[FrameEntry], solved: Mapping[int, _Solved], component: int
) -> Iterable[TrajectoryPose]:
    """Interpolate between the solved keyframes (by frame index) of one epoch.

    ``component`` names the epoch where no submap of it is solved.
    """
    known = [(p, solved[entry.frame_index]) for p, entry in enumerate(entries) if entry.frame_index in solved]
    found: dict[int, _Solved] = dict(known)
    if not known:
        # A camera that never moved needs no geometry to have a pose.
        if all(entry.state is MotionState.STATIC for entry in entries):
            found = dict.fromkeys(range(len(entries)), _Solved(np.eye(4), component, PoseOrigin.HELD))
    else:
        first, last = known[0], known[-1]
        found |= dict.fromkeys(range(first[0]), replace(first[1], origin=PoseOrigin.HELD))
        found |= dict.fromkeys(range(last[0] + 1, len(entries)), replace(last[1], origin=PoseOrigin.HELD))
    for (before, left), (after, right) in pairwise(known):
        for position in range(before + 1, after):
            if left.component == right.component:
                fraction = _fraction(entries, before, position, after)
                between = se3.interpolate(left.world_from_camera, right.world_from_camera, fraction)
                worse = _worse(left.verdict, right.verdict)
                found[position] = _Solved(between, left.component, PoseOrigin.INTERPOLATED, worse)
            else:
                found[position] = replace(left, origin=PoseOrigin.HELD)
    for position, entry in enumerate(entries):
        solution = found.get(position)
        yield TrajectoryPose(
            camera,
            epoch,
            entry.frame_index,
            entry.capture_time_ns,
            entry.state,
            entry.is_keyframe,
            PoseOrigin.NONE if solution is None else solution.origin,
            NO_COMPONENT if solution is None else solution.component,
            None if solution is None else solution.world_from_camera,
            None if solution is None else solution.verdict,
        )


def _worse(one: SubmapVerdict | None, other: SubmapVerdict | None) -> SubmapVerdict | None:
    known = [verdict for verdict in (one, other) if verdict is not None]
    return max(known, key=list(SubmapVerdict).index, default=None)


def _fraction(entries: Sequence[FrameEntry], before: int, position: int, after: int) -> float:
    """Share of the way by capture time; by position where the clock stood still or ran backwards."""
    start, at, end = (entries[p].capture_time_ns for p in (before, position, after))
    if start <= at <= end and start < end:
        return (at - start) / (end - start)
    return (position - before) / (after - before)


def _path_length(frames: Sequence[TrajectoryPose]) -> float:
    total = 0.0
    for a, b in pairwise(frames):
        same = (a.camera, a.epoch, a.component) == (b.camera, b.epoch, b.component)
        if same and a.world_from_camera is not None and b.world_from_camera is not None:
            total += float(np.linalg.norm(b.world_from_camera[:3, 3] - a.world_from_camera[:3, 3]))
    return total


def _scaled(trajectory: Trajectory, scale: float) -> Trajectory:
    def moved(frame: TrajectoryPose) -> TrajectoryPose:
        if frame.world_from_camera is None:
            return frame
        pose = frame.world_from_camera.copy()
        pose[:3, 3] *= scale
        return replace(frame, world_from_camera=pose)

    return replace(trajectory, frames=tuple(moved(frame) for frame in trajectory.frames), scale=scale)
