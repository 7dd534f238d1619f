"""The map: points where the scene is, each pixel once, bounded, deterministic, readable by others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from street import SMALL_CAMERA, drive, street_depth
from vggt_motion.backend.map import MapFrame, build_map
from vggt_motion.config import BackendConfig
from vggt_motion.geometry import se3, sim3

CONFIG = BackendConfig(map_voxel_over_step=0.0)
WORLD_FROM_SUBMAP = sim3.exp(np.array([0.2, 0.5, -0.1, 3.0, 1.0, -2.0, 0.4]))


def frames(count: int = 3) -> list[MapFrame]:
    """The street seen from a drive; the left half of each image is red, the right half green."""
    out = []
    for k, pose in enumerate(drive(count)):
        submap_from_world = WORLD_FROM_SUBMAP.inverse()
        depth = (submap_from_world.scale * street_depth(pose, SMALL_CAMERA)).astype(np.float32)
        image = np.zeros((96, 320, 3), np.uint8)
        image[:, :160, 0], image[:, 160:, 1] = 200, 100
        confidence = np.ones_like(depth)
        out.append(
            MapFrame(
                f"k{k}", depth, confidence, SMALL_CAMERA, WORLD_FROM_SUBMAP, submap_from_world.act_pose(pose), image
            )
        )
    return out


def distance_to_street(points: np.ndarray) -> np.ndarray:
    return np.min(np.abs([points[:, 1] - 1.6, points[:, 0] + 7, points[:, 0] - 9, points[:, 2] - 80]), axis=0)


def test_points_lie_on_the_street_and_have_their_colour() -> None:
    result = build_map(frames(1), CONFIG, step=1.5)
    assert len(result.points) == result.source_point_count == SMALL_CAMERA.width_px * SMALL_CAMERA.height_px
    assert distance_to_street(result.points).max() < 2e-3
    camera = se3.act(se3.inverse(drive(1)[0]), result.points.astype(np.float64))
    left = camera[:, 0] < -1e-6
    assert (result.colors[left] == [200, 0, 0]).all() and (result.colors[camera[:, 0] > 1e-6] == [0, 100, 0]).all()


def test_the_known_distance_scales_the_map() -> None:
    plain, scaled = build_map(frames(1), CONFIG, step=1.5), build_map(frames(1), CONFIG, step=1.5, scale=3.0)
    np.testing.assert_allclose(scaled.points, 3.0 * plain.points, rtol=1e-5, atol=1e-5)


def test_doubtful_unknown_and_repeated_pixels_stay_out() -> None:
    frame = frames(1)[0]
    depth, confidence = frame.depth.copy(), frame.confidence.copy()
    depth[0, :10] = 0.0
    depth[1, :10] = np.nan
    confidence[2, :10] = 0.4
    confidence[3, :10] = np.nan
    result = build_map([replace(frame, depth=depth, confidence=confidence), frame], CONFIG, step=1.5)
    assert result.source_point_count == depth.size - 40
    assert np.isfinite(result.points).all()


def test_voxels_hold_one_mean_point_each() -> None:
    config = CONFIG.model_copy(update={"map_voxel_over_step": 0.2})
    result = build_map(frames(), config, step=1.7)
    assert result.voxel == pytest.approx(0.34)
    cells = np.floor(result.points.astype(np.float64) / 0.34)
    # the mean of a voxel lies in it; float32 may push it over the edge by a rounding
    assert len(np.unique(cells, axis=0)) >= 0.999 * len(cells)
    raw = build_map(frames(), CONFIG, step=1.5)
    expected = len(np.unique(np.floor(raw.points.astype(np.float64) / 0.34), axis=0))
    assert len(result.points) == pytest.approx(expected, rel=0.01)
    assert distance_to_street(result.points).max() < 0.34


@pytest.mark.parametrize("share", [0.0, 0.01])
def test_the_number_of_points_is_bounded_and_the_choice_is_fixed(share: float) -> None:
    config = CONFIG.model_copy(update={"map_voxel_over_step": share, "map_max_points": 1000})
    first, second = build_map(frames(), config, step=1.5), build_map(iter(frames()), config, step=1.5)
    assert 400 <= len(first.points) <= 1000
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.colors, second.colors)
    # the whole street is covered, not only what came first or last
    assert first.points[:, 2].min() < 8 and first.points[:, 2].max() > 79


def test_ply_is_read_back_by_plyfile(tmp_path: Path) -> None:
    result = build_map(frames(1), CONFIG, step=1.5)
    result.write_ply(tmp_path / "map.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["map.ply"]
    ply = PlyData.read(str(tmp_path / "map.ply"))
    assert not ply.text and ply.byte_order == "<"
    vertex = ply["vertex"]
    np.testing.assert_array_equal(np.stack([vertex["x"], vertex["y"], vertex["z"]], axis=1), result.points)
    np.testing.assert_array_equal(np.stack([vertex["red"], vertex["green"], vertex["blue"]], axis=1), result.colors)


def test_no_frames_make_an_empty_map(tmp_path: Path) -> None:
    for share in (0.0, 0.1):
        result = build_map([], CONFIG.model_copy(update={"map_voxel_over_step": share}), step=1.5)
        result.write_ply(tmp_path / "empty.ply")
        assert len(PlyData.read(str(tmp_path / "empty.ply"))["vertex"]) == 0
