"""The sample in the repository is whole, small, licensed, and its poses belong to its images."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

FRAME_COUNT = 51
WIDTH_PX, HEIGHT_PX = 620, 187
MAX_BYTES = 2_000_000

# Camera P0 of KITTI odometry 04 to 12 (the benchmark's calib.txt), of images 1226 x 370 px.
KITTI_FOCAL_PX, KITTI_CX_PX, KITTI_CY_PX, KITTI_WIDTH_PX, KITTI_HEIGHT_PX = 707.0912, 601.8873, 183.1104, 1226, 370


@pytest.fixture(scope="module")
def kitti(sample_dir: Path) -> Path:
    return sample_dir / "kitti_06_first51"


@pytest.fixture(scope="module")
def poses(kitti: Path) -> npt.NDArray[np.float64]:
    """``world_from_camera`` (51, 3, 4), metres."""
    return np.loadtxt(kitti / "poses.txt").reshape(-1, 3, 4)


@pytest.fixture(scope="module")
def images(kitti: Path) -> list[npt.NDArray[np.uint8]]:
    return [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted((kitti / "image_0").iterdir())]


def test_images_are_complete_and_of_one_size(kitti: Path, images: list[npt.NDArray[np.uint8]]) -> None:
    names = sorted(path.name for path in (kitti / "image_0").iterdir())
    assert names == [f"{index:06d}.jpg" for index in range(FRAME_COUNT)]
    assert {image.shape for image in images} == {(HEIGHT_PX, WIDTH_PX)}  # no third axis: grey
    assert all(not np.array_equal(a, b) for a, b in itertools.pairwise(images))


def test_sample_is_small(kitti: Path) -> None:
    assert sum(path.stat().st_size for path in kitti.rglob("*") if path.is_file()) < MAX_BYTES


def test_times_are_those_of_a_ten_hertz_camera(kitti: Path) -> None:
    times_s = np.loadtxt(kitti / "times.txt")
    assert times_s.shape == (FRAME_COUNT,)
    np.testing.assert_allclose(np.diff(times_s), 0.1, atol=1e-6)


def test_poses_are_rigid_and_drive_59_metres_forward(poses: npt.NDArray[np.float64]) -> None:
    assert poses.shape == (FRAME_COUNT, 3, 4)
    rotations = poses[:, :, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1) - np.eye(3), 0.0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-5)
    steps_m = np.diff(poses[:, :, 3], axis=0)
    assert 59.0 < np.linalg.norm(steps_m, axis=1).sum() < 60.5
    forward = rotations[:-1, :, 2]  # the optical axis in the world: world_from_camera, not its inverse
    cosine = np.einsum("ij,ij->i", steps_m, forward) / np.linalg.norm(steps_m, axis=1)
    assert cosine.min() > 0.99


def _epipolar_error_px(
    first: npt.NDArray[np.float64],
    second: npt.NDArray[np.float64],
    pose_a: npt.NDArray[np.float64],
    pose_b: npt.NDArray[np.float64],
) -> float:
    """Median Sampson distance of matched pixels (M, 2) and (M, 2) under two poses ``world_from_camera`` (3, 4)."""
    sx, sy = WIDTH_PX / KITTI_WIDTH_PX, HEIGHT_PX / KITTI_HEIGHT_PX
    camera = np.array(
        [
            [KITTI_FOCAL_PX * sx, 0.0, (KITTI_CX_PX + 0.5) * sx - 0.5],
            [0.0, KITTI_FOCAL_PX * sy, (KITTI_CY_PX + 0.5) * sy - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    x, y, z = pose_b[:, :3].T @ (pose_a[:, 3] - pose_b[:, 3])
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ pose_b[:, :3].T @ pose_a[:, :3]
    fundamental = np.linalg.inv(camera).T @ essential @ np.linalg.inv(camera)
    p, q = (np.column_stack([points, np.ones(len(points))]) for points in (first, second))
    line_q, line_p = p @ fundamental.T, q @ fundamental
    gradient = (line_q[:, :2] ** 2).sum(1) + (line_p[:, :2] ** 2).sum(1)
    return float(np.median(np.abs((q * line_q).sum(1)) / np.sqrt(gradient)))


def test_poses_belong_to_the_images(poses: npt.NDArray[np.float64], images: list[npt.NDArray[np.uint8]]) -> None:
    """Points matched between neighbours lie on the epipolar lines of their own poses, not of other frames' poses."""
    sift = cv2.SIFT_create(1500)
    matcher = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True)
    right, shifted = [], []
    for index in range(0, FRAME_COUNT - 1, 5):
        (points_a, descriptors_a), (points_b, descriptors_b) = (
            sift.detectAndCompute(images[i], None) for i in (index, index + 1)
        )
        matches = matcher.match(descriptors_a, descriptors_b)
        assert len(matches) > 200
        first = np.array([points_a[match.queryIdx].pt for match in matches])
        second = np.array([points_b[match.trainIdx].pt for match in matches])
        other = (index + 11) % (FRAME_COUNT - 1)
        right.append(_epipolar_error_px(first, second, poses[index], poses[index + 1]))
        shifted.append(_epipolar_error_px(first, second, poses[other], poses[other + 1]))
    assert np.mean(right) < 0.25
    assert np.mean(right) < 0.7 * np.mean(shifted)


def test_video_is_the_motorway_clip(sample_dir: Path) -> None:
    capture = cv2.VideoCapture(str(sample_dir / "highway_straight" / "highway_straight.mp4"))
    try:
        assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(25.0)
        count = 0
        while True:
            is_read, frame = capture.read()
            if not is_read:
                break
            assert frame.shape == (540, 960, 3)
            count += 1
        assert count == 221
    finally:
        capture.release()


@pytest.mark.parametrize(
    ("folder", "licence", "attribution"),
    [
        ("kitti_06_first51", "Attribution-NonCommercial-ShareAlike 3.0 Unported", "A. Geiger, P. Lenz, R. Urtasun"),
        ("highway_straight", "Copyright (c) 2016-2018 Udacity, Inc.", "CarND-LaneLines-P1"),
    ],
)
def test_licence_and_attribution_lie_beside_the_data(
    sample_dir: Path, folder: str, licence: str, attribution: str
) -> None:
    assert licence in (sample_dir / folder / "LICENSE").read_text(encoding="utf-8")
    assert attribution in (sample_dir / folder / "README.md").read_text(encoding="utf-8")
