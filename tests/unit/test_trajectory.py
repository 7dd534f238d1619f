"""Composition: home submaps, copies, interpolation, breaks, known distance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vggt_motion.backend.trajectory import NO_COMPONENT, PoseOrigin, Trajectory, compose
from vggt_motion.geometry import se3, sim3
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import (
    BlobRef,
    DropReason,
    FrameEntry,
    FrameGeometry,
    GraphUpdate,
    Keyframe,
    MotionState,
    ScaleKind,
    Segment,
    SubmapGeometry,
    SubmapPose,
    SubmapQuality,
    SubmapSpec,
    SubmapVerdict,
    submap_index,
)

BLOB = BlobRef("0" * 64, 1, "image/png")
CAMERA = Intrinsics.centred(50.0, 64, 32)
QUALITY = SubmapQuality(1, 0.3, 1.0, 2.0, 0.9, 0.01)
WORLD_FROM_SUBMAP = [sim3.exp(np.array([0.0, 0.1 * k, 0.0, k, 0.0, -k, 0.1 * k])) for k in range(3)]


def key(index: int) -> str:
    return f"front/0/{index:08d}"


def truth(index: float) -> np.ndarray:
    """A camera that drives 0.5 a frame along a gentle bend."""
    return se3.make(se3.so3_exp(np.array([0.0, 0.01 * index, 0.0])), np.array([0.02 * index, 0.0, 0.5 * index]))


def entry(index: int, is_key: bool, state: MotionState = MotionState.LINEAR, time_ns: int | None = None) -> FrameEntry:
    stamp = index * 100_000_000 if time_ns is None else time_ns
    return FrameEntry(index, stamp, state, is_key, None if is_key else DropReason.LOW_PARALLAX)


def keyframe(index: int, copy_of: int | None = None) -> Keyframe:
    original = None if copy_of is None else key(copy_of)
    return Keyframe("front", 0, index, index * 100_000_000, MotionState.LINEAR, 64, 32, BLOB, original)


def segment(k: int, base: list[int], overlap: list[int], frames: list[FrameEntry]) -> Segment:
    return Segment(k, "front", 0, tuple(map(key, base)), tuple(map(key, overlap)), tuple(frames), "budget")


def submap(k: int, base: list[int], overlap: list[int], registered: list[int], revision: int = 1) -> SubmapGeometry:
    spec = SubmapSpec(k, revision, tuple(map(key, overlap)), tuple(map(key, base)))
    to_submap = WORLD_FROM_SUBMAP[k].inverse()
    frames = tuple(FrameGeometry(key(i), CAMERA, to_submap.act_pose(truth(i)), BLOB) for i in registered)
    return SubmapGeometry(spec, SubmapVerdict.GOOD, "", ScaleKind.RELATIVE, "test", frames, QUALITY)


def graph(components: dict[int, int]) -> GraphUpdate:
    return GraphUpdate(4, True, tuple(SubmapPose(k, 1, c, WORLD_FROM_SUBMAP[k]) for k, c in components.items()), ())


def two_submaps() -> tuple[list[Keyframe], list[Segment], dict[int, SubmapGeometry]]:
    """Keyframes 0, 3, 6 | 9, 12, 15 with overlap 3, 6; every frame between them is dropped."""
    keyframes = [keyframe(i) for i in range(0, 16, 3)]
    segments = [
        segment(0, [0, 3, 6], [], [entry(i, i % 3 == 0) for i in range(7)]),
        segment(1, [9, 12, 15], [3, 6], [entry(i, i % 3 == 0) for i in range(7, 16)]),
    ]
    submaps = {0: submap(0, [0, 3, 6], [], [0, 3, 6]), 1: submap(1, [9, 12, 15], [3, 6], [3, 6, 9, 12, 15])}
    return keyframes, segments, submaps


def assert_poses(trajectory: Trajectory, atol: float = 1e-9) -> None:
    for frame in trajectory.frames:
        assert frame.world_from_camera is not None
        before, after = frame.frame_index // 3 * 3, min(frame.frame_index // 3 * 3 + 3, 15)
        fraction = (frame.frame_index - before) / 3
        expected = se3.interpolate(truth(before), truth(after), fraction)
        np.testing.assert_allclose(frame.world_from_camera, expected, atol=atol)


def test_every_frame_has_its_pose_in_the_world() -> None:
    keyframes, segments, submaps = two_submaps()
    trajectory = compose(keyframes, segments, submaps, graph({0: 0, 1: 0}))
    assert [frame.frame_index for frame in trajectory.frames] == list(range(16))
    assert_poses(trajectory)
    assert trajectory.origin_counts() == {PoseOrigin.HOME: 6, PoseOrigin.INTERPOLATED: 10}
    assert len(trajectory.keyframes) == len(trajectory.track("key")) == 6
    assert trajectory.components == (0,)
    again = compose(keyframes[::-1], segments[::-1], dict(reversed(submaps.items())), graph({1: 0, 0: 0}))
    np.testing.assert_array_equal(again.track().world_from_camera, trajectory.track().world_from_camera)


def test_a_keyframe_missing_at_home_is_taken_from_the_overlap() -> None:
    keyframes, segments, submaps = two_submaps()
    submaps[0] = submap(0, [0, 3, 6], [], [0, 6])
    trajectory = compose(keyframes, segments, submaps, graph({0: 0, 1: 0}))
    assert trajectory.frames[3].origin is PoseOrigin.OTHER_SUBMAP
    assert_poses(trajectory)


def test_a_keyframe_missing_everywhere_is_interpolated_and_says_so() -> None:
    keyframes, segments, submaps = two_submaps()
    submaps[1] = submap(1, [9, 12, 15], [3, 6], [3, 6, 9, 15])
    trajectory = compose(keyframes, segments, submaps, graph({0: 0, 1: 0}))
    frame = trajectory.frames[12]
    assert frame.is_keyframe and frame.origin is PoseOrigin.INTERPOLATED
    assert frame.world_from_camera is not None
    np.testing.assert_allclose(frame.world_from_camera, se3.interpolate(truth(9), truth(15), 0.5), atol=1e-9)


def test_interpolation_follows_capture_time_not_position() -> None:
    keyframes, segments, submaps = two_submaps()
    frames = [entry(i, i % 3 == 0) for i in range(7)]
    frames[1] = entry(1, False, time_ns=30_000_000)  # a tenth of the way from 0 to 300 ms
    segments[0] = segment(0, [0, 3, 6], [], frames)
    trajectory = compose(keyframes, segments, submaps, graph({0: 0, 1: 0}))
    pose = trajectory.frames[1].world_from_camera
    assert pose is not None
    np.testing.assert_allclose(pose, se3.interpolate(truth(0), truth(3), 0.1), atol=1e-9)


def test_a_clock_that_ran_backwards_still_gives_poses_between_the_keyframes() -> None:
    keyframes, segments, submaps = two_submaps()
    frames = [entry(i, i % 3 == 0, time_ns=0) for i in range(7)]
    segments[0] = segment(0, [0, 3, 6], [], frames)
    pose = compose(keyframes, segments, submaps, graph({0: 0, 1: 0})).frames[1].world_from_camera
    assert pose is not None
    np.testing.assert_allclose(pose, se3.interpolate(truth(0), truth(3), 1 / 3), atol=1e-9)


def test_both_ends_of_a_stop_share_one_pose_and_so_do_the_frames_between() -> None:
    keyframes, segments, submaps = two_submaps()
    keyframes[2] = keyframe(6, copy_of=3)
    trajectory = compose(keyframes, segments, submaps, graph({0: 0, 1: 0}))
    assert trajectory.frames[6].origin is PoseOrigin.ZERO_MOTION_COPY
    for index in (3, 4, 5, 6):
        pose = trajectory.frames[index].world_from_camera
        assert pose is not None
        np.testing.assert_allclose(pose, truth(3), atol=1e-9)


def test_a_copy_lends_its_pose_to_an_unsolved_original() -> None:
    keyframes, segments, submaps = two_submaps()
    keyframes[1] = keyframe(3, copy_of=0)
    submaps[0] = submap(0, [0, 3, 6], [], [3, 6])
    first = compose(keyframes, segments, submaps, graph({0: 0, 1: 0})).frames[0]
    assert first.origin is PoseOrigin.ZERO_MOTION_COPY and first.world_from_camera is not None
    np.testing.assert_allclose(first.world_from_camera, truth(3), atol=1e-9)


def test_a_break_is_not_interpolated_across() -> None:
    keyframes, segments, submaps = two_submaps()
    trajectory = compose(keyframes, segments, submaps, graph({0: 0, 1: 1}))
    assert trajectory.components == (0, 1)
    for index in (7, 8):
        frame = trajectory.frames[index]
        assert frame.origin is PoseOrigin.HELD and frame.component == 0
        np.testing.assert_allclose(frame.world_from_camera, truth(6), atol=1e-9)  # type: ignore[arg-type]
    inside = sum(np.linalg.norm(truth(b)[:3, 3] - truth(a)[:3, 3]) for a, b in ((0, 3), (3, 6), (9, 12), (12, 15)))
    assert trajectory.path_length() == pytest.approx(inside)


def test_frames_of_an_unsolved_submap_are_held_not_dropped() -> None:
    keyframes, segments, submaps = two_submaps()
    del submaps[1]
    trajectory = compose(keyframes, segments, submaps, graph({0: 0}))
    assert len(trajectory.frames) == 16
    assert {frame.origin for frame in trajectory.frames[7:]} == {PoseOrigin.HELD}
    np.testing.assert_allclose(trajectory.frames[15].world_from_camera, truth(6), atol=1e-9)  # type: ignore[arg-type]


def test_a_submap_of_another_revision_than_the_graph_is_not_used() -> None:
    keyframes, segments, submaps = two_submaps()
    submaps[1] = submap(1, [9, 12, 15], [3, 6], [3, 6, 9, 12, 15], revision=2)
    trajectory = compose(keyframes, segments, submaps, graph({0: 0, 1: 0}))
    assert trajectory.frames[9].origin is PoseOrigin.HELD


def test_no_geometry_at_all() -> None:
    keyframes, segments, _ = two_submaps()
    trajectory = compose(keyframes, segments, {}, graph({}))
    assert {(frame.origin, frame.component) for frame in trajectory.frames} == {(PoseOrigin.NONE, NO_COMPONENT)}
    assert len(trajectory.track()) == 0 and trajectory.components == ()


def test_a_camera_that_never_moved_has_identical_poses() -> None:
    frames = [entry(i, i in (0, 9), MotionState.STATIC) for i in range(10)]
    segments = [segment(0, [0, 9], [], frames)]
    trajectory = compose([keyframe(0), keyframe(9, copy_of=0)], segments, {}, graph({}))
    np.testing.assert_array_equal(trajectory.track().world_from_camera, np.broadcast_to(np.eye(4), (10, 4, 4)))
    assert trajectory.path_length() == 0.0
    # an epoch without a submap is a component of its own, by the index that its first submap would have
    later = compose([], [replace(segments[0], index=3)], {}, graph({}))
    assert later.components == (submap_index(3),)
    assert compose([keyframe(0)], segments, {}, graph({}), known_distance_m=5.0).scale == 1.0


def test_a_known_distance_sets_the_scale() -> None:
    keyframes, segments, submaps = two_submaps()
    plain = compose(keyframes, segments, submaps, graph({0: 0, 1: 0}))
    scaled = compose(keyframes, segments, submaps, graph({0: 0, 1: 0}), known_distance_m=123.0)
    assert scaled.path_length() == pytest.approx(123.0)
    assert scaled.track().path_length() == pytest.approx(123.0)
    np.testing.assert_allclose(scaled.track().positions, scaled.scale * plain.track().positions, atol=1e-12)
    np.testing.assert_allclose(
        scaled.track().world_from_camera[:, :3, :3], plain.track().world_from_camera[:, :3, :3], atol=1e-12
    )


def test_similarity_scale_of_a_submap_reaches_the_positions_only() -> None:
    """A submap in other units is put into the world by its scale; camera axes stay a rotation."""
    keyframes, segments, submaps = two_submaps()
    assert WORLD_FROM_SUBMAP[1].scale != pytest.approx(1.0) and isinstance(WORLD_FROM_SUBMAP[1], Sim3)
    poses = compose(keyframes, segments, submaps, graph({0: 0, 1: 0})).track("key").world_from_camera
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.eye(3)[None].repeat(6, 0), atol=1e-9
    )
