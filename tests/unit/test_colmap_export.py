"""The export is read by COLMAP itself (pycolmap) and means the same there."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import cv2  # before pycolmap: the other order crashes
import numpy as np
import pytest

pycolmap = pytest.importorskip("pycolmap")

from test_trajectory import graph, two_submaps  # noqa: E402

from vggt_motion.backend.colmap_export import ColmapImage, collect_images, write_colmap  # noqa: E402
from vggt_motion.backend.map import PointMap  # noqa: E402
from vggt_motion.backend.trajectory import compose  # noqa: E402
from vggt_motion.geometry import se3  # noqa: E402
from vggt_motion.geometry.projection import Intrinsics, project  # noqa: E402


def scene() -> tuple[list[ColmapImage], PointMap]:
    rng = np.random.default_rng(0)
    cameras = [Intrinsics(700.0, 705.0, 609.0, 172.0, 1241, 376), Intrinsics.centred(718.0, 1241, 376, -0.1)]
    images = [
        ColmapImage(f"front_0_{n:08d}.png", cameras[n % 2], se3.exp(rng.normal(0, [0.1] * 3 + [2.0] * 3)))
        for n in range(5)
    ]
    points = rng.uniform([-5, -2, 12], [5, 2, 60], (200, 3)).astype(np.float32)
    return images, PointMap(points, rng.integers(0, 255, (200, 3)).astype(np.uint8), 0.1, 200)


@pytest.mark.parametrize("form", ["text", "binary"])
def test_colmap_reads_the_model(tmp_path: Path, form: Literal["text", "binary"]) -> None:
    assert cv2.__version__
    images, points = scene()
    write_colmap(tmp_path / "sparse" / "0", images, points, form)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert (model.num_cameras(), model.num_images(), model.num_points3D()) == (2, 5, 200)
    by_name = {image.name: image for image in model.images.values()}
    for image in images:
        theirs = by_name[image.name]
        camera = model.cameras[theirs.camera_id]
        assert (camera.width, camera.height) == (1241, 376)
        camera_from_world = theirs.cam_from_world()
        np.testing.assert_allclose(camera_from_world.matrix(), se3.inverse(image.world_from_camera)[:3], atol=1e-9)
        # the same point falls on the same pixel, whose centre COLMAP counts from one half
        in_camera = se3.act(se3.inverse(image.world_from_camera), points.points[:20].astype(np.float64))
        ours = project(in_camera, image.intrinsics)
        for point, pixel in zip(in_camera, ours, strict=True):
            if point[2] > 1.0:
                np.testing.assert_allclose(camera.img_from_cam(point) - 0.5, pixel, atol=1e-6)
    xyz = np.array([model.points3D[n].xyz for n in range(1, 201)])
    colors = np.array([model.points3D[n].color for n in range(1, 201)])
    np.testing.assert_allclose(xyz, points.points, rtol=1e-6)
    np.testing.assert_array_equal(colors, points.colors)


def test_an_empty_map_is_a_model_too(tmp_path: Path) -> None:
    images, _ = scene()
    write_colmap(tmp_path, images, PointMap(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), 0.0, 0))
    assert pycolmap.Reconstruction(str(tmp_path)).num_images() == 5


def test_images_are_collected_from_a_run() -> None:
    keyframes, segments, submaps = two_submaps()
    trajectory = compose(keyframes, segments, submaps, graph({0: 0, 1: 0}))
    images = collect_images(trajectory, keyframes, submaps)
    assert [image.name for image in images] == [f"front_0_{n:08d}.png" for n in range(0, 16, 3)]
    for image, frame in zip(images, trajectory.keyframes, strict=True):
        np.testing.assert_array_equal(image.world_from_camera, frame.world_from_camera)
        assert (image.intrinsics.width_px, image.intrinsics.height_px) == (64, 32)
    broken = compose(keyframes, segments, submaps, graph({0: 0, 1: 1}))
    assert len(collect_images(broken, keyframes, submaps)) == 3
    assert collect_images(broken, keyframes, submaps, component=1)[0].name == "front_0_00000009.png"
