"""Dense depth against closed-form surfaces and a plain reference."""

from __future__ import annotations

import numpy as np
import pytest

import sfm_scene
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, project
from vggt_motion.inference.sfm import depth as dense
from vggt_motion.inference.sfm import stereo

CAMERA = Intrinsics.centred(200.0, 310, 124)


def sparse_of(truth: np.ndarray, camera: Intrinsics) -> dense.SparseDepth:
    """Every 12th pixel's point, as tracks would leave them."""
    from vggt_motion.geometry.projection import unproject

    points = unproject(np.where(np.isfinite(truth), truth, 0.0), camera)[4::12, 4::12]
    known = np.isfinite(truth[4::12, 4::12])
    return dense.SparseDepth(points[known])


def depths_of(
    poses: list[np.ndarray], camera: Intrinsics, usable: np.ndarray | None = None
) -> tuple[dict[int, dense.DepthMap], list[np.ndarray]]:
    images, truth = sfm_scene.keyframes(sfm_scene.street(), poses, camera)
    grey = {k: image.pixels[..., 0] for k, image in enumerate(images)}
    maps = dense.dense_depth(
        grey,
        {k: se3.inverse(pose) for k, pose in enumerate(poses)},
        {k: sparse_of(true, camera) for k, true in enumerate(truth)},
        camera,
        np.ones((camera.height_px, camera.width_px), dtype=bool) if usable is None else usable,
    )
    return maps, truth


@pytest.fixture(scope="module")
def forward() -> tuple[dict[int, dense.DepthMap], list[np.ndarray]]:
    return depths_of(sfm_scene.drive(6, 0.8), CAMERA)


def test_forward_motion_gives_depth_where_it_is_confident(
    forward: tuple[dict[int, dense.DepthMap], list[np.ndarray]],
) -> None:
    maps, truth = forward
    for position in (1, 3, 5):
        confident = maps[position].confidence > 0.5
        assert confident.mean() > 0.2
        error = np.abs(maps[position].depth[confident] / truth[position][confident] - 1.0)
        assert np.median(error) < 0.02
        assert np.percentile(error, 95) < 0.1


def test_error_falls_as_confidence_rises(forward: tuple[dict[int, dense.DepthMap], list[np.ndarray]]) -> None:
    maps, truth = forward
    confidence = np.concatenate([maps[p].confidence.ravel() for p in maps])
    depth = np.concatenate([maps[p].depth.ravel() for p in maps])
    exact = np.concatenate([truth[p].ravel() for p in maps])
    quantiles = []
    for low, high in ((0.01, 0.2), (0.2, 0.5), (0.5, 0.8), (0.8, 1.01)):
        inside = (confidence >= low) & (confidence < high) & np.isfinite(exact)
        assert inside.sum() > 500
        quantiles.append(np.percentile(np.abs(depth[inside] / exact[inside] - 1.0), (50.0, 84.0, 95.0)))
    assert (np.diff(quantiles, axis=0) < 0.0).all()  # the rare large errors too


def test_sky_has_no_confidence(forward: tuple[dict[int, dense.DepthMap], list[np.ndarray]]) -> None:
    maps, truth = forward
    for position in maps:
        # away from the edge of the buildings, whose texture a window still sees
        sky = np.isinf(truth[position])
        sky[1:] &= sky[:-1]
        inner = sky.copy()
        for shift in range(1, 5):
            inner[shift:] &= sky[:-shift]
            inner[:-shift] &= sky[shift:]
            inner[:, shift:] &= sky[:, :-shift]
            inner[:, :-shift] &= sky[:, shift:]
        assert inner.sum() > 1000
        assert (maps[position].confidence[inner] > 0.1).mean() < 0.005


@pytest.mark.parametrize("step", [(0.0, 0.0, 0.8), (0.5, 0.0, 0.0)], ids=["ahead at our speed", "crossing"])
def test_moving_objects_have_no_confidence(step: tuple[float, float, float]) -> None:
    poses = sfm_scene.drive(6, 0.8)
    grey, truth, cars = {}, [], {}
    for k, pose in enumerate(poses):
        centre = np.array([-1.0, 0.4, 9.0]) + k * np.array(step)
        car = sfm_scene.Rectangle((centre[0], centre[1], centre[2]), (1.5, 0.0, 0.0), (0.0, 1.1, 0.0), 40.0)
        image, seen = sfm_scene.render([*sfm_scene.street(), car], pose, CAMERA)
        _, without = sfm_scene.render(sfm_scene.street(), pose, CAMERA)
        grey[k], cars[k] = image[..., 0], seen != without
        truth.append(np.where(cars[k], np.inf, seen))  # the structure knows nothing of what moves
    maps = dense.dense_depth(
        grey,
        {k: se3.inverse(pose) for k, pose in enumerate(poses)},
        {k: sparse_of(true, CAMERA) for k, true in enumerate(truth)},
        CAMERA,
        np.ones((CAMERA.height_px, CAMERA.width_px), dtype=bool),
    )
    for k in (1, 2, 3):
        inner = cars[k].copy()
        for shift in range(1, 4):  # away from the edge, where a window sees the street behind
            for axis in (0, 1):
                inner &= np.roll(cars[k], shift, axis) & np.roll(cars[k], -shift, axis)
        assert inner.sum() > 300
        assert (maps[k].confidence[inner] > 0.5).mean() < 0.02
        assert (maps[k].confidence[~cars[k] & np.isfinite(truth[k])] > 0.5).mean() > 0.2


def test_the_epipole_of_forward_motion_has_little_confidence(
    forward: tuple[dict[int, dense.DepthMap], list[np.ndarray]],
) -> None:
    maps, truth = forward
    v, u = np.indices(truth[3].shape)
    textured = np.isfinite(truth[3])
    ahead = project(np.array([0.0, 0.0, 10.0]), CAMERA)
    near = textured & (np.hypot(u - ahead[0], v - ahead[1]) < 8.0)
    assert near.sum() > 30
    assert maps[3].confidence[near].mean() < 0.25 * maps[3].confidence[textured & ~near].mean()


def test_sideways_motion_with_distortion_and_an_offset_principal_point() -> None:
    camera = Intrinsics(200.0, 200.0, 162.0, 58.0, 310, 124, -0.12)
    poses = [se3.make(np.eye(3), np.array([0.3 * k, 0.0, 0.0])) for k in range(4)]
    maps, truth = depths_of(poses, camera)
    confident = maps[1].confidence > 0.5
    assert confident.mean() > 0.25
    assert np.median(np.abs(maps[1].depth[confident] / truth[1][confident] - 1.0)) < 0.01


def test_masked_pixels_have_neither_depth_nor_confidence() -> None:
    usable = np.ones((124, 310), dtype=bool)
    usable[90:] = False
    maps, _ = depths_of(sfm_scene.drive(3, 0.8), CAMERA, usable)
    for found in maps.values():
        assert not found.depth[90:].any()
        assert not found.confidence[90:].any()
        assert np.all((found.confidence == 0.0) | (found.depth > 0.0))


def test_cameras_in_one_place_see_no_depth() -> None:
    poses = [se3.make(np.eye(3), np.zeros(3))] * 3
    maps, _ = depths_of(poses, CAMERA)
    assert not any(found.confidence.any() for found in maps.values())


def reference_semi_global(cost: np.ndarray, p1: float, p2: float) -> np.ndarray:
    """Hirschmueller 2008, eq. 13, along four paths, one array operation per step."""
    total = np.zeros(cost.shape, dtype=np.float64)
    for axis, reverse in ((1, False), (1, True), (0, False), (0, True)):
        lines = np.moveaxis(cost.astype(np.float64), axis, 0)
        lines = lines[::-1] if reverse else lines
        path = np.empty_like(lines)
        path[0] = lines[0]
        for step in range(1, len(lines)):
            before = path[step - 1]
            least = before.min(axis=-1, keepdims=True)
            up = np.pad(before, ((0, 0), (1, 0)), constant_values=np.inf)[:, :-1] + p1
            down = np.pad(before, ((0, 0), (0, 1)), constant_values=np.inf)[:, 1:] + p1
            path[step] = (
                lines[step] + np.minimum.reduce([before, up, down, np.broadcast_to(least + p2, before.shape)]) - least
            )
        path = path[::-1] if reverse else path
        total += np.moveaxis(path, 0, axis)
    return total


def test_semi_global_matching_equals_the_reference() -> None:
    cost = np.random.default_rng(2).uniform(0, 2, (9, 11, 7)).astype(np.float32)
    np.testing.assert_allclose(
        stereo.semi_global(cost, 0.08, 0.5), reference_semi_global(cost, 0.08, 0.5), rtol=1e-4, atol=1e-4
    )


def test_correlation_of_a_view_with_itself_is_one_at_the_right_depth() -> None:
    image = sfm_scene.texture(seed=1)[:60, :90].astype(np.float32)
    camera = Intrinsics.centred(80.0, 90, 60)
    rays = stereo.pixel_rays(camera).astype(np.float32)
    # a frontal plane at depth 4 moves by 5 px under a sideways step of 0.25
    moved = np.roll(image, -5, axis=1)
    step = np.eye(4)
    step[0, 3] = -0.25
    cost = stereo.sweep_cost(
        image, moved[None], step[None, :3, :3], step[None, :3, 3], rays, stereo._camera(camera), np.arange(9) / 16.0
    )
    inner = cost[10:-10, 15:-15]
    assert (inner.argmin(axis=2) == 4).mean() > 0.99  # 4 / 16 is one over the depth of 4
    assert np.median(inner[..., 4]) < 0.02  # flat windows, which correlate with nothing, are few
