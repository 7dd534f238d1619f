"""The export is read by COLMAP itself (pycolmap) and means the same there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2  # before pycolmap: the other order crashes
import numpy as np
import pytest

pycolmap = pytest.importorskip("pycolmap")

from test_trajectory import graph, two_submaps  # noqa: E402

from street import SMALL_CAMERA, drive, street_depth  # noqa: E402
from vggt_motion.backend.colmap_export import (  # noqa: E402
    ColmapImage,
    ColmapModel,
    build_model,
    collect_images,
    undistort,
    without_distortion,
    write_colmap,
)
from vggt_motion.backend.map import MapFrame, PointMap, build_map  # noqa: E402
from vggt_motion.backend.trajectory import compose  # noqa: E402
from vggt_motion.config import BackendConfig  # noqa: E402
from vggt_motion.geometry import se3, sim3  # noqa: E402
from vggt_motion.geometry.projection import Intrinsics, project  # noqa: E402

SCALE = 1.7  # world units per unit of the graph


def street_frames(count: int = 6, k1: float = 0.0, k2: float = 0.0) -> list[MapFrame]:
    """Keyframes of a drive along the street, in a submap of odd unit and place; the world is SCALE times the street."""
    camera = replace(SMALL_CAMERA, k1=k1, k2=k2)
    submap_from_world = sim3.exp(np.array([0.1, -0.4, 0.05, 2.0, 1.0, -3.0, 0.3]))
    frames = []
    for n, pose in enumerate(drive(count)):
        depth = street_depth(pose, camera) * submap_from_world.scale
        image = np.full((*depth.shape, 3), 40 * n, np.uint8)
        frames.append(
            MapFrame(
                *(f"front/0/{n:08d}", depth.astype(np.float32), np.ones(depth.shape, np.float32), camera),
                *(submap_from_world.inverse(), submap_from_world.act_pose(pose), image),
            )
        )
    return frames


def street_model(
    k1: float = 0.0, max_per_image: int = 100_000, image_k1: float | None = None, k2: float = 0.0
) -> ColmapModel:
    frames = street_frames(k1=k1, k2=k2)
    points = build_map(frames, BackendConfig(), step=8.0, scale=SCALE)
    file_camera = replace(SMALL_CAMERA, k1=k1 if image_k1 is None else image_k1, k2=k2).resized(1240, 372)
    images = []
    for frame in frames:
        pose = frame.world_from_submap.act_pose(frame.submap_from_camera)
        pose[:3, 3] *= SCALE
        images.append(ColmapImage(frame.keyframe_id, frame.keyframe_id.replace("/", "_"), file_camera, pose))
    return build_model(images, points, frames, scale=SCALE, max_per_image=max_per_image)


@pytest.mark.parametrize("form", ["text", "binary"])
@pytest.mark.parametrize(("k1", "k2"), [(0.0, 0.0), (-0.1, 0.0), (-0.3, 0.09)])
def test_colmap_reads_the_model_with_its_tracks(
    tmp_path: Path, form: Literal["text", "binary"], k1: float, k2: float
) -> None:
    assert cv2.__version__
    ours = street_model(k1, k2=k2)
    assert len(ours.points) > 500
    write_colmap(tmp_path / "sparse" / "0", ours, "binary" if form == "text" else "text")
    write_colmap(tmp_path / "sparse" / "0", ours, form)  # the other form goes
    theirs = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert (theirs.num_cameras(), theirs.num_images()) == (1, len(ours.images))
    assert theirs.num_points3D() == len(ours.points)
    assert theirs.compute_num_observations() == len(ours.pixels)
    assert theirs.compute_mean_track_length() == pytest.approx(len(ours.pixels) / len(ours.points))
    camera = theirs.cameras[1]
    assert (camera.width, camera.height) == (1240, 372)
    by_name = {image.name: image for image in theirs.images.values()}
    seen = 0
    for image in ours.images:
        other = by_name[image.name]
        matrix = other.cam_from_world().matrix()
        np.testing.assert_allclose(matrix, se3.inverse(image.world_from_camera)[:3], atol=1e-9)
        points2d = list(other.points2D)
        seen += len(points2d)
        for index in range(0, len(points2d), 97):
            point2d = points2d[index]
            point = theirs.points3D[point2d.point3D_id]
            assert any(e.image_id == other.image_id and e.point2D_idx == index for e in point.track.elements)
            # COLMAP's own projection of the point falls on the pixel that we say
            projected = camera.img_from_cam(matrix[:, :3] @ point.xyz + matrix[:, 3])
            np.testing.assert_allclose(projected, point2d.xy, atol=1e-4)
            assert 0 <= point2d.xy[0] <= 1240 and 0 <= point2d.xy[1] <= 372
    assert seen == len(ours.pixels)
    lengths = [point.track.length() for point in theirs.points3D.values()]
    assert min(lengths) >= 2 and max(lengths) == len(ours.images)
    xyz = np.array([theirs.points3D[n].xyz for n in range(1, len(ours.points) + 1)])
    colors = np.array([theirs.points3D[n].color for n in range(1, len(ours.points) + 1)])
    np.testing.assert_allclose(xyz, ours.points, rtol=1e-6)
    np.testing.assert_array_equal(colors, ours.colors)


def test_a_keyframe_observes_what_it_sees_and_not_what_is_hidden() -> None:
    """Against the ray cast of the street: a point of a track is the surface at its pixel, and every such point is."""
    frames = street_frames()
    wall = frames[2].depth.copy()
    wall[:, :60] = 2.0 * frames[2].world_from_submap.scale ** -1  # something 2 m away hides the left of keyframe 2
    frames[2] = replace(frames[2], depth=wall)
    points = build_map([f for f in frames if f is not frames[2]], BackendConfig(), step=8.0, scale=SCALE)
    images = []
    for frame, pose in zip(frames, drive(6), strict=True):
        scaled = pose.copy()
        scaled[:3, 3] *= SCALE
        images.append(ColmapImage(frame.keyframe_id, frame.keyframe_id, SMALL_CAMERA, scaled))
    model = build_model(images, points, frames, scale=SCALE, max_per_image=100_000)
    for number, pose in enumerate(drive(6)):
        own = model.image_of == number
        pixels = np.rint(model.pixels[own]).astype(int)
        in_camera = se3.act(se3.inverse(pose), model.points[model.point_of[own]].astype(np.float64) / SCALE)
        surface = street_depth(pose, SMALL_CAMERA)[pixels[:, 1], pixels[:, 0]]
        np.testing.assert_allclose(in_camera[:, 2], surface, rtol=0.051)
        assert own.sum() > 300
    hidden = model.pixels[model.image_of == 2]
    assert (np.rint(hidden[:, 0]) >= 60).all()
    assert (np.rint(model.pixels[model.image_of == 3][:, 0]) < 60).any()


def test_observations_of_an_image_are_bounded_and_tracks_stay_long() -> None:
    full, few = street_model(), street_model(max_per_image=200)
    counts = np.bincount(few.image_of, minlength=6)
    assert counts.max() <= 200
    mean_length = len(few.pixels) / len(few.points)
    assert mean_length > 0.5 * len(full.pixels) / len(full.points)
    again = street_model(max_per_image=200)
    np.testing.assert_array_equal(few.points, again.points)
    np.testing.assert_array_equal(few.pixels, again.pixels)


def test_undistorted_images_show_points_where_the_pinhole_does() -> None:
    camera = Intrinsics.centred(180.0, 310, 94, -0.2)
    rng = np.random.default_rng(0)
    points = rng.uniform([-4, -1, 6], [4, 1, 12], (40, 3))
    straight = without_distortion(ColmapImage("k", "k.jpg", camera, np.eye(4)))
    assert straight.name == "k.png" and straight.intrinsics.k1 == 0.0
    checked = 0
    for point in points:
        u, v = project(point, camera)
        image = np.zeros((94, 310, 3), np.uint8)
        if not (8 < u < 302 and 8 < v < 86):
            continue
        cv2.circle(image, (round(16 * float(u)), round(16 * float(v))), 5 * 16, (255, 255, 255), -1, cv2.LINE_AA, 4)
        weights = undistort(image, camera)[..., 0].astype(float)
        rows, columns = np.indices(weights.shape)
        centre = np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()
        expected = project(point, straight.intrinsics)
        if (expected > 9).all() and expected[0] < 300 and expected[1] < 84:
            np.testing.assert_allclose(centre, expected, atol=0.35)
            checked += 1
    assert checked > 10


def test_an_empty_map_is_a_model_too(tmp_path: Path) -> None:
    images = [ColmapImage("k", "k.png", SMALL_CAMERA, np.eye(4))]
    empty = PointMap(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), 0.0, 0)
    write_colmap(tmp_path, build_model(images, empty, [], scale=1.0, max_per_image=10))
    assert pycolmap.Reconstruction(str(tmp_path)).num_images() == 1


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
