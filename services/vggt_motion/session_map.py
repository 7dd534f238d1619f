"""The map of one moment of a session: records and payloads brought to ``backend/map.py``.

Used where a map is made while the session runs: by the gateway and by the recorder.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np

from vggt_motion.backend.map import PointMap, build_map
from vggt_motion.backend.map_frames import map_frames
from vggt_motion.backend.trajectory import NO_COMPONENT, Trajectory
from vggt_motion.config import BackendConfig
from vggt_motion.records import BlobRef, GraphUpdate, Keyframe, SubmapGeometry


def main_component(trajectory: Trajectory) -> int:
    """The connected part with the most frames, the first of equals; NO_COMPONENT without a pose.

    Parts behind a break share no frame of reference: one map cannot hold two of them.
    """
    counts = Counter(frame.component for frame in trajectory.frames if frame.component != NO_COMPONENT)
    return min(counts, key=lambda component: (-counts[component], component), default=NO_COMPONENT)


def build_session_map(
    keyframes: Mapping[str, Keyframe],
    submaps: Mapping[int, SubmapGeometry],
    graph: GraphUpdate,
    trajectory: Trajectory,
    config: BackendConfig,
    read_blob: Callable[[BlobRef], bytes],
) -> PointMap:
    """Gather the map of the largest connected part.

    Args:
        keyframes: by id; their images give the colours.
        submaps: geometry by submap index, in the revisions that the graph holds; others are not used.
        graph: poses of the submaps.
        trajectory: composed from the same graph; gives scale and spacing of the keyframes.
        config: confidence threshold, voxels, greatest number of points.
        read_blob: fetches a payload; its errors pass through.

    Raises:
        CodecError: an image or a depth payload cannot be decoded.
    """
    component = main_component(trajectory)
    steps = np.linalg.norm(np.diff(trajectory.track("key", component).positions, axis=0), axis=1)
    moving = steps[steps > 0.0]
    step = float(np.median(moving)) if len(moving) else 0.0
    frames = map_frames(keyframes, submaps, graph, component, read_blob)
    return build_map(frames, config, step=step, scale=trajectory.scale)
