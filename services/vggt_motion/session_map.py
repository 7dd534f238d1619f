"""The map of a session from its log: which keyframes enter, in which frame, with payloads read one at a time.

``backend/map.py`` gathers points; here the records and payloads are brought to it. Used wherever a map is made: at the
end of a run, by the gateway and by the recorder.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.backend.map import MapFrame, PointMap, build_map
from vggt_motion.backend.trajectory import Trajectory
from vggt_motion.bus.depth import decode_depth
from vggt_motion.config import BackendConfig
from vggt_motion.errors import CodecError
from vggt_motion.records import BlobRef, GraphUpdate, Keyframe, SubmapGeometry

_log = logging.getLogger(__name__)


def main_component(graph: GraphUpdate) -> int | None:
    """The connected part with the most submaps, the first of equals; None for a graph without poses.

    Parts behind a break share no frame of reference: one map cannot hold two of them.
    """
    counts = Counter(pose.component for pose in graph.poses)
    return min(counts, key=lambda component: (-counts[component], component), default=None)


def build_session_map(
    keyframes: Mapping[str, Keyframe],
    submaps: Mapping[int, SubmapGeometry],
    graph: GraphUpdate,
    trajectory: Trajectory,
    config: BackendConfig,
    read_blob: Callable[[BlobRef], bytes],
    *,
    component: int | None = None,
) -> PointMap:
    """Gather the map of one connected part of a session.

    Args:
        keyframes: by id; their images give the colours.
        submaps: geometry by submap index, in the revisions that the graph holds; others are not used.
        graph: poses of the submaps.
        trajectory: composed from the same graph; gives scale and spacing of the keyframes.
        config: confidence threshold, voxels, greatest number of points.
        read_blob: fetches a payload; its errors pass through.
        component: which part; None = :func:`main_component`.
    """
    part = main_component(graph) if component is None else component
    centres = trajectory.track("key", part).positions
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    moving = steps[steps > 0.0]
    step = float(np.median(moving)) if len(moving) else 0.0
    frames = _frames(keyframes, submaps, graph, part, read_blob)
    return build_map(frames, config, step=step, scale=trajectory.scale)


def _frames(
    keyframes: Mapping[str, Keyframe],
    submaps: Mapping[int, SubmapGeometry],
    graph: GraphUpdate,
    component: int | None,
    read_blob: Callable[[BlobRef], bytes],
) -> Iterator[MapFrame]:
    """Keyframes through their home submaps, in index order; the second end of a stop shows nothing new."""
    for pose in sorted(graph.poses, key=lambda pose: pose.submap_index):
        submap = submaps.get(pose.submap_index)
        if pose.component != component or submap is None or submap.spec.revision != pose.submap_revision:
            continue
        copies = {copy for copy, _ in submap.spec.zero_motion_copies}
        home = set(submap.spec.base_keyframe_ids) - copies
        for frame in submap.frames:
            keyframe = keyframes.get(frame.keyframe_id)
            if frame.keyframe_id not in home or keyframe is None:
                continue
            try:
                image = _decode_image(read_blob(keyframe.image))
                depth, confidence = decode_depth(read_blob(frame.depth))
            except CodecError as error:
                _log.warning(
                    "keyframe left out of the map", extra={"keyframe": frame.keyframe_id, "reason": str(error)}
                )
                continue
            yield MapFrame(
                frame.keyframe_id,
                depth,
                confidence,
                frame.intrinsics,
                pose.world_from_submap,
                frame.submap_from_camera,
                image,
            )


def _decode_image(encoded: bytes) -> npt.NDArray[np.uint8]:
    """Pixels (H, W, 3) RGB."""
    buffer = np.frombuffer(encoded, np.uint8)
    pixels = cv2.imdecode(buffer, cv2.IMREAD_COLOR) if len(buffer) else None
    if pixels is None:
        raise CodecError("the image cannot be decoded")
    return np.ascontiguousarray(pixels[:, :, ::-1], dtype=np.uint8)
