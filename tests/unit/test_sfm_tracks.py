"""Correspondences: tracks, features and patches measured again, on images whose motion is known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

import sfm_scene
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, project
from vggt_motion.inference.predictor import KeyframeImage
from vggt_motion.inference.sfm import alignment, features, images, rotation, tracks
from vggt_motion.inference.sfm.bundle import Observations

CAMERA = Intrinsics.centred(340.0, 480, 200)


def working(
    frames: list[npt.NDArray[np.uint8]], ego_mask: npt.NDArray[np.bool_] | None = None, width: int = 620
) -> images.WorkingImages:
    keyframes = [KeyframeImage(f"front/0/{k:08d}", k, frame) for k, frame in enumerate(frames)]
    return images.prepare(keyframes, ego_mask, width)


def shifted(offsets: list[tuple[float, float]], side: int = 260) -> list[npt.NDArray[np.uint8]]:
    """Views of one texture, moved by sub-pixel offsets."""
    base = sfm_scene.texture(seed=9).astype(np.float32)
    frames = []
    for dx, dy in offsets:
        u, v = np.meshgrid(np.arange(side) + 300.0 - dx, np.arange(side) + 300.0 - dy)
        grey = cv2.remap(base, u.astype(np.float32), v.astype(np.float32), cv2.INTER_CUBIC)
        frames.append(np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2))
    return frames


OFFSETS = [(0.0, 0.0), (7.3, -2.6), (16.9, 3.4), (21.1, 9.75)]


def test_what_is_remembered_is_of_the_same_images_and_the_same_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    first, other = working(shifted(OFFSETS)), working(shifted([(3.0, 1.0), *OFFSETS[1:]]))
    half = first.usable.copy()
    half[:, : half.shape[1] // 2] = False
    for image in (first, other, replace(first, usable=half), first):
        found = tracks.follow(image, [0, 1, 2, 3])
        with monkeypatch.context() as fresh:
            fresh.setattr(tracks, "_MEMORY", tracks._Memory())
            again = tracks.follow(image, [0, 1, 2, 3])
        np.testing.assert_array_equal(found.pixel, again.pixel)
        np.testing.assert_array_equal(found.point, again.point)


@pytest.mark.parametrize("method", [tracks.follow, tracks.match])
def test_tracks_move_as_the_image_does(method) -> None:  # type: ignore[no-untyped-def]
    found = method(working(shifted(OFFSETS)), [0, 1, 2, 3])
    assert found.count > 150
    for a, b in ((0, 1), (1, 2), (0, 3)):
        _, at_a, at_b = found.between(a, b)
        assert len(at_a) > 100
        expected = np.array(OFFSETS[b]) - np.array(OFFSETS[a])
        errors = np.linalg.norm(at_b - at_a - expected, axis=1)
        assert np.median(errors) < 0.15
        assert np.percentile(errors, 90) < 0.6


def test_tracks_hold_each_point_once_per_frame_in_order() -> None:
    found = tracks.follow(working(shifted(OFFSETS)), [0, 1, 2, 3])
    pairs = np.stack([found.point, found.frame], axis=1)
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    assert np.all(np.diff(found.point) >= 0)
    assert set(np.unique(found.point)) == set(range(found.count))
    assert np.bincount(found.point).min() >= 2


def test_nothing_is_seen_under_the_mask() -> None:
    mask = np.zeros((260, 260), dtype=bool)
    mask[:, 130:] = True
    image = working(shifted(OFFSETS), mask)
    for found in (tracks.follow(image, [0, 1, 2, 3]), tracks.match(image, [0, 1, 2, 3])):
        assert found.count > 50
        assert found.pixel[:, 0].max() < 131.0


def test_the_mask_is_reduced_with_the_image_and_hides_all_it_touches() -> None:
    mask = np.zeros((300, 1240), dtype=bool)
    mask[100, 501] = True
    usable = images.usable_pixels(mask, 620, 150)
    assert not usable[50, 250]
    assert usable.sum() == usable.size - 1


def test_feature_tracks_take_over_where_following_loses_too_much() -> None:
    # half the image is replaced by a jump that the flow cannot follow: features still find it
    near, far = shifted([(0.0, 0.0), (95.0, 60.0)])
    found = tracks.follow(working([near, far]), [0, 1])
    _, at_a, at_b = found.between(0, 1)
    assert len(at_a) > 60
    assert np.median(np.linalg.norm(at_b - at_a - np.array([95.0, 60.0]), axis=1)) < 0.5


def test_matches_do_not_depend_on_the_order_of_summation() -> None:
    image = working(shifted(OFFSETS))
    a, b = (features.detect(image.grey[k], image.usable) for k in (0, 2))
    turned = features.Features(b.points[::-1], np.ascontiguousarray(b.descriptors[::-1]))
    forward = {(int(i), int(j)) for i, j in features.match(a, b)}
    backward = {(int(i), len(b.points) - 1 - int(j)) for i, j in features.match(a, turned)}
    assert forward == backward
    assert len(forward) > 100


def test_an_image_without_texture_has_no_tracks() -> None:
    flat = np.full((200, 300, 3), 90, np.uint8)
    assert tracks.follow(working([flat, flat]), [0, 1]).count == 0
    assert tracks.match(working([flat, flat]), [0, 1]).count == 0


def test_patches_measured_again_lie_where_the_scene_has_them() -> None:
    poses = sfm_scene.drive(5, 0.8, 8.0)
    rendered, depths = sfm_scene.keyframes(sfm_scene.street(), poses, CAMERA)
    image = images.prepare(rendered, None, 620)
    # points of frame 3 on smooth surfaces, exactly placed; what frame 1 saw of them is more than a pixel off
    finite = np.where(np.isfinite(depths[3]), depths[3], 1e3)
    steps = cv2.dilate(finite, np.ones((15, 15))) - cv2.erode(finite, np.ones((15, 15)))
    corners = cv2.goodFeaturesToTrack(image.grey[3], 400, 0.02, 8)[:, 0]
    v, u = corners[:, 1].astype(int), corners[:, 0].astype(int)
    smooth = steps[v, u] < 0.15 * finite[v, u]
    u, v = u[smooth], v[smooth]
    rays = np.column_stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))])
    points = se3.act(poses[3], rays * depths[3][v, u, None])
    middle = np.array([0.5 * (CAMERA.width_px - 1), 0.5 * (CAMERA.height_px - 1)])
    scene = replace(sfm_scene.synthetic_problem(poses, CAMERA)[0], points=points)
    seen = {k: project(se3.act(se3.inverse(poses[k]), points), CAMERA) - middle for k in range(5)}
    inside = np.all(np.abs(seen[1]) < middle - 8.0, axis=1)
    point = np.concatenate([np.flatnonzero(inside), np.arange(len(points))])
    frame = np.concatenate([np.full(int(inside.sum()), 1), np.full(len(points), 3)])
    observations = Observations.build(point, frame, np.concatenate([seen[1][inside] + 0.8, seen[3]]), len(points))
    again = alignment.remeasure(scene, observations, observations, np.ones(5, dtype=bool), image.grey, image.usable)
    measured = again.subset(np.diff(again.start)[again.point] > 1)
    assert set(np.unique(measured.frame)) == {0, 1, 2, 3, 4}
    for k in (0, 1, 2, 4):
        rows = measured.frame == k
        assert rows.sum() > 40
        errors = np.linalg.norm(measured.pixel[rows] - seen[k][measured.point[rows]], axis=1)
        # the patch stands for a plane facing the camera, which walls and ground are not
        assert np.median(errors) < 0.25
        assert np.percentile(errors, 90) < 0.9


def test_rotation_alone_is_recognised_whatever_the_focal_length() -> None:
    yaw = [0.0, 0.05, 0.11, 0.16]
    poses = [se3.make(se3.so3_exp(np.array([0.01 * k, angle, 0.0])), np.zeros(3)) for k, angle in enumerate(yaw)]
    scene, observations = sfm_scene.synthetic_problem(poses, CAMERA, 400, 0.1)
    matched = {}
    for a in range(4):
        for b in range(a + 1, 4):
            in_a, in_b = (observations.subset(observations.frame == k) for k in (a, b))
            _, i, j = np.intersect1d(in_a.point, in_b.point, return_indices=True)
            matched[a, b] = (in_a.pixel[i], in_b.pixel[j])
    fit = rotation.fit_rotations(matched, [0, 1, 2, 3], CAMERA.fx, CAMERA.width_px)
    assert fit is not None
    assert fit.residual_px < 0.3
    for k in range(4):
        relative = fit.camera_from_submap[k] @ (scene.rotations[k] @ scene.rotations[0].T).T
        assert np.linalg.norm(se3.so3_log(relative)) < 1e-3
    blind = rotation.fit_rotations(matched, [0, 1, 2, 3], None, CAMERA.width_px)
    assert blind is not None
    assert blind.residual_px < 1.0
