"""A synthetic session: records as the services would write them, along a road whose poses are known in closed form."""

from __future__ import annotations

import hashlib

import numpy as np

from vggt_motion.bus.codec import blob_ref, encode_depth
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import (
    BlobRef,
    Constraint,
    ConstraintKind,
    DropReason,
    EdgeReport,
    Event,
    EventKind,
    FrameEntry,
    FrameGeometry,
    GraphUpdate,
    Keyframe,
    MotionState,
    RegistrationSpec,
    ScaleKind,
    Segment,
    Stream,
    SubmapGeometry,
    SubmapPose,
    SubmapQuality,
    SubmapSpec,
    SubmapVerdict,
)

FRAME_INTERVAL_NS = 100_000_000
FRAMES_PER_KEYFRAME = 2
BASE = 6
OVERLAP = 2
WIDTH, HEIGHT = 32, 20
"""Size of images and depth maps."""


def world_from_camera(frame_index: int) -> np.ndarray:
    """Driving a circle of radius 20 at one unit a frame, upright; the first camera is the world."""
    angle = frame_index / 20.0
    centre = np.array([20.0 * (1.0 - np.cos(angle)), 0.0, 20.0 * np.sin(angle)])
    return se3.make(se3.so3_exp(np.array([0.0, angle, 0.0])), centre)


def world_from_submap(index: int) -> Sim3:
    """Where the graph puts a submap: each has its own scale and frame."""
    if index == 0:
        return Sim3.identity()
    rotation = se3.so3_exp(np.array([0.1, -0.2, 0.3]) * index)
    return Sim3(rotation, np.array([1.0, -2.0, 0.5]) * index, 1.0 + 0.25 * index)


def depth_blob(frame_index: int) -> tuple[BlobRef, bytes]:
    """A wall 5 units in front of the camera, in submap units of scale 1, all confident."""
    depth = np.full((HEIGHT, WIDTH), 5.0 + 0.01 * frame_index, dtype=np.float32)
    data = encode_depth(depth, np.ones_like(depth))
    return blob_ref(data, "application/vnd.vggt-motion.depth"), data


class Session:
    """Records of ``segment_count`` segments; ``entries()`` gives them as (stream, sequence, record)."""

    def __init__(self, segment_count: int, image: bytes = b"", media_type: str = "image/jpeg") -> None:
        self.image = image
        self.image_ref = BlobRef(hashlib.sha256(image).hexdigest(), len(image), media_type)
        self.segment_count = segment_count
        self.keyframes: list[Keyframe] = []
        self.segments: list[Segment] = []
        self.submaps: list[SubmapGeometry] = []
        self.constraints: list[Constraint] = []
        self.blobs: dict[str, bytes] = {self.image_ref.sha256: image}
        previous: tuple[str, ...] = ()
        for k in range(segment_count):
            base = [self._keyframe(k * BASE + n) for n in range(BASE)]
            self.keyframes += base
            ids = tuple(keyframe.keyframe_id for keyframe in base)
            first = 0 if k == 0 else self.segments[-1].frames[-1].frame_index + 1
            entries = tuple(self._entry(index) for index in range(first, base[-1].frame_index + 1))
            self.segments.append(Segment(k, "front", 0, ids, previous[-OVERLAP:], entries, "budget"))
            self.submaps.append(self._submap(k, previous[-OVERLAP:], ids))
            if k:
                self.constraints.append(self._constraint(k))
            previous = ids

    @property
    def frame_count(self) -> int:
        return self.segments[-1].frames[-1].frame_index + 1

    @staticmethod
    def state(frame_index: int) -> MotionState:
        return MotionState.TURNING if frame_index % 4 == 0 else MotionState.LINEAR

    def _keyframe(self, number: int) -> Keyframe:
        index = number * FRAMES_PER_KEYFRAME
        return Keyframe("front", 0, index, index * FRAME_INTERVAL_NS, self.state(index), WIDTH, HEIGHT, self.image_ref)

    def _entry(self, index: int) -> FrameEntry:
        is_keyframe = index % FRAMES_PER_KEYFRAME == 0
        reason = None if is_keyframe else DropReason.LOW_PARALLAX
        return FrameEntry(index, index * FRAME_INTERVAL_NS, self.state(index), is_keyframe, reason)

    def _submap(self, k: int, overlap: tuple[str, ...], base: tuple[str, ...]) -> SubmapGeometry:
        submap_from_world = world_from_submap(k).inverse()
        frames = []
        for keyframe_id in overlap + base:
            index = int(keyframe_id.rsplit("/", 1)[1])
            ref, data = depth_blob(index)
            self.blobs[ref.sha256] = data
            frames.append(
                FrameGeometry(
                    keyframe_id,
                    Intrinsics.centred(30.0, WIDTH, HEIGHT),
                    submap_from_world.act_pose(world_from_camera(index)),
                    ref,
                )
            )
        quality = SubmapQuality(len(frames), 0.2, 0.9, 4.0, 0.9, 0.01)
        spec = SubmapSpec(k, 1, overlap, base)
        verdict = SubmapVerdict.LOW_QUALITY if k == 1 else SubmapVerdict.GOOD
        reason = "few tracks" if k == 1 else ""
        return SubmapGeometry(spec, verdict, reason, ScaleKind.RELATIVE, "sfm", tuple(frames), quality)

    def _constraint(self, k: int) -> Constraint:
        shared = self.segments[k].overlap_keyframe_ids
        spec = RegistrationSpec(k - 1, k, 1, 1, ConstraintKind.ADJACENT, shared)
        j_from_i = world_from_submap(k).inverse() @ world_from_submap(k - 1)
        return Constraint(spec, True, "", j_from_i, 0.9, 0.01, np.eye(7), 1000)

    def graph(
        self, submap_count: int | None = None, *, is_final: bool = False, broken_at: int | None = None
    ) -> GraphUpdate:
        count = self.segment_count if submap_count is None else submap_count
        poses = tuple(
            SubmapPose(k, 1, broken_at if broken_at is not None and k >= broken_at else 0, world_from_submap(k))
            for k in range(count)
        )
        edges = tuple(EdgeReport(c.record_id, 0.1, True) for c in self.constraints if c.spec.j < count)
        breaks = () if broken_at is None else (f"between submaps {broken_at - 1} and {broken_at}: too few points",)
        return GraphUpdate(2 * count, is_final, poses, edges, breaks)

    def ended(self) -> Event:
        detail = {"frame_count": str(self.frame_count), "segment_count": str(self.segment_count)}
        return Event("stream_ended/front/0", EventKind.STREAM_ENDED, "the input has ended", 7, detail)

    def entries(self, *, is_final: bool = True, broken_at: int | None = None) -> list[tuple[Stream, int, object]]:
        events = [Event("session_started", EventKind.SESSION_STARTED, "started", 1), self.ended()]
        streams: dict[Stream, list[object]] = {
            Stream.KEYFRAME: list(self.keyframes),
            Stream.SEGMENT: list(self.segments),
            Stream.SUBMAP: list(self.submaps),
            Stream.CONSTRAINT: list(self.constraints),
            Stream.EVENT: list(events),
            Stream.GRAPH: [self.graph(is_final=is_final, broken_at=broken_at)],
        }
        return [(stream, n, record) for stream, records in streams.items() for n, record in enumerate(records)]
