"""The map of one moment of a session: records and payloads of the log brought to ``backend/map.py``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from vggt_motion.backend.map import MapFrame, PointMap, build_map
from vggt_motion.backend.trajectory import NO_COMPONENT, Trajectory
from vggt_motion.bus.depth import decode_depth
from vggt_motion.config import BackendConfig
from vggt_motion.errors import CodecError
from vggt_motion.records import BlobRef, GraphUpdate, Keyframe, SubmapGeometry
from vggt_motion.sources.encoded import decode_rgb


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
    component: int | None = None,
) -> PointMap:
    """Gather the map of one connected part.

    Args:
        keyframes: by id; their images give the colours.
        submaps: geometry by submap index, in the revisions that the graph holds; others are not used.
        graph: poses of the submaps.
        trajectory: composed from the same graph; gives scale and spacing of the keyframes.
        config: confidence threshold, voxels, greatest number of points.
        read_blob: fetches a payload; its errors pass through.
        component: which part; the largest by default.

    Raises:
        CodecError: an image or a depth payload cannot be decoded.
    """
    component = main_component(trajectory) if component is None else component
    steps = np.linalg.norm(np.diff(trajectory.track("key", component).positions, axis=0), axis=1)
    moving = steps[steps > 0.0]
    step = float(np.median(moving)) if len(moving) else 0.0
    frames = map_frames(keyframes, submaps, graph, component, read_blob)
    return build_map(frames, config, step=step, scale=trajectory.scale)


def map_frames(
    keyframes: Mapping[str, Keyframe],
    submaps: Mapping[int, SubmapGeometry],
    graph: GraphUpdate,
    component: int,
    load_blob: Callable[[BlobRef], bytes],
) -> Iterator[MapFrame]:
    """Keyframes of one connected part, each through its home submap, in order.

    Zero-motion copies are left out: they show what their originals show.

    Args:
        keyframes: by id.
        submaps: usable geometry by index.
        graph: solved; submaps of another revision than its are left out.
        component: the connected part.
        load_blob: fetches a payload.

    Raises:
        CodecError: an image or depth payload cannot be decoded.
    """
    for pose in graph.poses:
        submap = submaps.get(pose.submap_index)
        if pose.component != component or submap is None or submap.spec.revision != pose.submap_revision:
            continue
        copies = {copy for copy, _ in submap.spec.zero_motion_copies}
        for keyframe_id in submap.spec.base_keyframe_ids:
            frame, keyframe = submap.frame(keyframe_id), keyframes.get(keyframe_id)
            if frame is None or keyframe is None or keyframe_id in copies:
                continue
            depth, confidence = decode_depth(load_blob(frame.depth))
            try:
                image = decode_rgb(load_blob(keyframe.image))
            except CodecError as error:
                raise CodecError(f"keyframe {keyframe_id} is {error}") from error
            yield MapFrame(
                keyframe_id=keyframe_id,
                depth=depth,
                confidence=confidence,
                intrinsics=frame.intrinsics,
                world_from_submap=pose.world_from_submap,
                submap_from_camera=frame.submap_from_camera,
                image=image,
            )
