"""Views for people: poses, trajectory, map and transforms, as Foxglove and Rerun draw them.

The lossless part of a recording needs none of this. A view of the whole (trajectory, map) is written again only when
the drive has grown by a fixed share, and at the end: so that the views of a long drive cost as much again as the last
of them, and not its square.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vggt_motion import foxglove
from vggt_motion.backend.map import PointMap
from vggt_motion.backend.session_map import build_session_map, main_component
from vggt_motion.backend.state import LogState
from vggt_motion.backend.trajectory import Trajectory, TrajectoryPose, compose
from vggt_motion.config import BackendConfig
from vggt_motion.recorder.record import MAP_TOPIC, TRAJECTORY_TOPIC, FrameId, Recording
from vggt_motion.records import BlobRef, GraphUpdate, SubmapGeometry

_TRAJECTORY_GROWTH = 1.1
_MAP_GROWTH = 1.5
_VIEW_POINTS = 200_000


def drawn_trajectory(log: LogState, graph: GraphUpdate, config: BackendConfig) -> Trajectory:
    """The trajectory that a graph of a log gives; pure computation."""
    return compose(
        list(log.keyframes.values()),
        [log.segments[index] for index in sorted(log.segments)],
        _submaps(log, graph),
        graph,
        known_distance_m=config.known_distance_m,
    )


def drawn_map(
    log: LogState,
    graph: GraphUpdate,
    trajectory: Trajectory,
    config: BackendConfig,
    read_blob: Callable[[BlobRef], bytes],
) -> PointMap:
    """The map for viewers, smaller than that of the results; pure computation but for ``read_blob``.

    Raises:
        CodecError: an image or a depth payload cannot be decoded.
    """
    small = config.model_copy(update={"map_max_points": min(config.map_max_points, _VIEW_POINTS)})
    return build_session_map(log.keyframes, _submaps(log, graph), graph, trajectory, small, read_blob)


def _submaps(log: LogState, graph: GraphUpdate) -> dict[int, SubmapGeometry]:
    ids = [(pose.submap_index, pose.submap_revision) for pose in graph.poses]
    return {index: log.submaps[index, revision] for index, revision in ids if (index, revision) in log.submaps}


class ViewWriter:
    """Writes the views of one recording; used from one thread."""

    def __init__(self, recording: Recording) -> None:
        """Views of a recording; what an earlier process wrote into it is not written again."""
        self._recording = recording
        self._written: dict[str, tuple[int, bool]] = {}  # topic -> posed keyframes, is final; by this process

    def add_trajectory(self, trajectory: Trajectory) -> None:
        """Write the poses of new keyframes and, when it has grown enough or is final, the whole trajectory.

        Raises:
            RecordingClosedError: the recording was closed meanwhile.
        """
        posed = [frame for frame in trajectory.keyframes if frame.world_from_camera is not None]
        for frame in posed:
            self._add_pose(frame)
        if posed and self._is_due(trajectory, TRAJECTORY_TOPIC, _TRAJECTORY_GROWTH):
            self._note(trajectory, TRAJECTORY_TOPIC)
            for component in trajectory.components:
                self._add_part(trajectory, component, [frame for frame in posed if frame.component == component])

    def wants_map(self, trajectory: Trajectory) -> bool:
        """Whether a map of this trajectory should be made and given to :meth:`add_map`."""
        return self._is_due(trajectory, MAP_TOPIC, _MAP_GROWTH)

    def add_map(self, points: PointMap, trajectory: Trajectory) -> None:
        """Write the map.

        Raises:
            RecordingClosedError: the recording was closed meanwhile.
        """
        self._note(trajectory, MAP_TOPIC)
        if len(points.points) == 0:
            return
        component = main_component(trajectory)
        time_ns = _last_time_ns([frame for frame in trajectory.keyframes if frame.component == component])
        message = foxglove.point_cloud(points.points, points.colors, foxglove.world_frame(component), time_ns)
        self._recording.add_map(trajectory.graph_revision, message, time_ns)

    def _is_due(self, trajectory: Trajectory, topic: str, growth: float) -> bool:
        written = self._written.get(topic)
        if written is None:
            return self._recording.view_revision(topic) != trajectory.graph_revision
        size, was_final = written
        if trajectory.is_final:
            # Once more where the end had come before all that it speaks of.
            return not was_final or _posed_count(trajectory) > size
        return _posed_count(trajectory) > size and _posed_count(trajectory) >= growth * size

    def _note(self, trajectory: Trajectory, topic: str) -> None:
        self._written[topic] = (_posed_count(trajectory), trajectory.is_final)

    def _add_pose(self, frame: TrajectoryPose) -> None:
        frame_id = FrameId(frame.camera, frame.epoch, frame.frame_index)
        if frame.world_from_camera is None or self._recording.has_pose(frame_id):
            return
        world, time_ns = foxglove.world_frame(frame.component), _time_ns(frame)
        camera = foxglove.camera_frame(frame.camera)
        self._recording.add_transform(
            foxglove.frame_transform(frame.world_from_camera, world, camera, time_ns), time_ns
        )
        self._recording.add_pose(frame_id, foxglove.pose_in_frame(frame.world_from_camera, world, time_ns), time_ns)

    def _add_part(self, trajectory: Trajectory, component: int, frames: list[TrajectoryPose]) -> None:
        poses = [np.asarray(frame.world_from_camera) for frame in frames]
        time_ns = _last_time_ns(frames)
        message = foxglove.poses_in_frame(poses, foxglove.world_frame(component), time_ns)
        self._recording.add_trajectory(trajectory.graph_revision, message, time_ns)


def _posed_count(trajectory: Trajectory) -> int:
    return sum(frame.world_from_camera is not None for frame in trajectory.keyframes)


def _time_ns(frame: TrajectoryPose) -> int:
    return max(0, frame.capture_time_ns)


def _last_time_ns(frames: list[TrajectoryPose]) -> int:
    return max((_time_ns(frame) for frame in frames), default=0)
