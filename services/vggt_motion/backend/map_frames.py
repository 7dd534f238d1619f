"""From the log to the map: the keyframes of the solved submaps with their payloads, one at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import cv2
import numpy as np

from vggt_motion.backend.map import MapFrame
from vggt_motion.bus.depth import decode_depth
from vggt_motion.errors import CodecError
from vggt_motion.records import BlobRef, GraphUpdate, Keyframe, SubmapGeometry


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
            image = cv2.imdecode(np.frombuffer(load_blob(keyframe.image), np.uint8), cv2.IMREAD_COLOR)
            if image is None:
                raise CodecError(f"the image of keyframe {keyframe_id} cannot be decoded")
            yield MapFrame(
                keyframe_id=keyframe_id,
                depth=depth,
                confidence=confidence,
                intrinsics=frame.intrinsics,
                world_from_submap=pose.world_from_submap,
                submap_from_camera=frame.submap_from_camera,
                image=np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8),
            )
