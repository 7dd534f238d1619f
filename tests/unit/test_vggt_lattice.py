"""How a network's image lies in the recorded one, and what happens to arrays on the way back. No torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import unproject
from vggt_motion.inference.lattice import (
    Lattice,
    assemble,
    common_size,
    failed,
    fit_area,
    fit_width,
    shrink_mask,
)
from vggt_motion.inference.predictor import KeyframeImage, Prediction, PredictionHints
from vggt_motion.records import ScaleKind, SubmapVerdict


class TestFitWidth:
    @pytest.mark.parametrize(
        ("image", "whole", "window", "top"),
        [
            ((1241, 376), (518, 154), (518, 154), 0),  # KITTI
            ((640, 480), (518, 392), (518, 392), 0),
            ((518, 518), (518, 518), (518, 518), 0),
            ((1080, 1920), (518, 924), (518, 518), 203),  # an upright phone: the middle
            ((4000, 50), (518, 14), (518, 14), 0),
        ],
    )
    def test_sizes(self, image: tuple[int, int], whole: tuple[int, int], window: tuple[int, int], top: int) -> None:
        lattice = fit_width(*image, 518, 14)
        assert (lattice.width_px, lattice.height_px) == whole
        assert (lattice.window_width_px, lattice.window_height_px) == window
        assert (lattice.left_px, lattice.top_px) == (0, top)

    @given(st.integers(16, 5000), st.integers(16, 5000))
    def test_window_is_inside_and_divisible(self, width: int, height: int) -> None:
        lattice = fit_width(width, height, 518, 14)
        assert lattice.window_width_px % 14 == lattice.window_height_px % 14 == 0
        rows, columns = lattice.window
        assert 0 <= rows.start < rows.stop <= lattice.height_px
        assert 0 <= columns.start < columns.stop <= lattice.width_px
        if height >= width * 14 / 518:
            assert abs(lattice.height_px - height * 518 / width) <= 7.001


@given(st.integers(16, 5000), st.integers(16, 5000), st.integers(5_000, 300_000))
def test_fit_area_keeps_the_limit(width: int, height: int, pixels: int) -> None:
    lattice = fit_area(width, height, pixels, 14)
    assert lattice.width_px % 14 == lattice.height_px % 14 == 0
    assert 0 < lattice.width_px * lattice.height_px <= pixels
    assert (lattice.window_width_px, lattice.window_height_px) == (lattice.width_px, lattice.height_px)


@given(st.integers(1, 60), st.integers(1, 60), st.integers(1, 80), st.integers(1, 80), st.integers(0, 2**32 - 1))
def test_a_shrunk_mask_covers_the_mask(height: int, width: int, rows: int, columns: int, seed: int) -> None:
    mask = np.random.default_rng(seed).random((height, width)) < 0.1
    small = shrink_mask(mask, columns, rows)
    for row in range(rows):
        top, bottom = row * height / rows, (row + 1) * height / rows
        for column in range(columns):
            left, right = column * width / columns, (column + 1) * width / columns
            part = mask[int(top) : int(np.ceil(bottom - 1e-9)), int(left) : int(np.ceil(right - 1e-9))]
            assert small[row, column] == part.any()


def images(*sizes: tuple[int, int]) -> list[KeyframeImage]:
    return [
        KeyframeImage(f"front/0/{index:08d}", index, np.zeros((height, width, 3), np.uint8))
        for index, (width, height) in enumerate(sizes)
    ]


def test_common_size() -> None:
    assert common_size(images((8, 6), (8, 6))) == (8, 6)
    assert "no images" in str(common_size([]))
    assert "front/0/00000001 is 9x6" in str(common_size(images((8, 6), (9, 6))))


LATTICE = Lattice(6, 8, 6, 4, top_px=2)


def predicted(hints: PredictionHints | None = None, **changes: Any) -> Prediction:
    """Two frames of a tall image of which the middle is seen: a wall at depth 2 seen from two places."""
    pinhole = np.array([[5.0, 0.0, 3.0], [0.0, 4.0, 2.0], [0.0, 0.0, 1.0]])
    arguments: dict[str, Any] = {
        "depth": np.full((2, 4, 6), 2.0),
        "confidence": np.full((2, 4, 6), 0.75),
        "pinhole": np.stack([pinhole, pinhole]),
        "submap_from_camera": np.stack([np.eye(4), se3.make(np.eye(3), np.array([1.0, 0.0, 0.0]))]),
        "scale_kind": ScaleKind.RELATIVE,
        "model": "test",
        "stage_seconds": {"all": 1.0},
        **changes,
    }
    return assemble(LATTICE, hints or PredictionHints(), **arguments)


class TestAssemble:
    def test_covers_the_whole_image(self) -> None:
        prediction = predicted()
        assert prediction.verdict is SubmapVerdict.GOOD
        assert [frame.position for frame in prediction.frames] == [0, 1]
        for frame in prediction.frames:
            assert frame.depth.shape == frame.confidence.shape == (8, 6)
            assert frame.depth.dtype == frame.confidence.dtype == np.float32
            assert (frame.depth[2:6] == 2.0).all()
            assert (frame.confidence[2:6] == 0.75).all()
            assert not frame.depth[:2].any()
            assert not frame.depth[6:].any()
            assert not frame.confidence[6:].any()

    def test_a_point_is_where_the_network_saw_it(self) -> None:
        frame = predicted().frames[0]
        points = unproject(frame.depth, frame.intrinsics)
        # Row 1, column 5 of the network's window: x = (5 - 3) / 5 * 2, y = (1 - 2) / 4 * 2.
        np.testing.assert_allclose(points[2 + 1, 5], [0.8, -0.5, 2.0])

    def test_unknown_depth_has_no_confidence(self) -> None:
        depth = np.full((2, 4, 6), 2.0)
        depth[0, 0, :4] = [np.nan, np.inf, 0.0, -1.0]
        confidence = np.full((2, 4, 6), 0.75)
        confidence[0, 0, 4] = np.nan
        frame = predicted(depth=depth, confidence=confidence).frames[0]
        assert not frame.depth[2, :5].any()
        assert not frame.confidence[2, :5].any()
        assert frame.depth[2, 5] == 2.0

    def test_sky_and_own_vehicle(self) -> None:
        sky = np.zeros((2, 4, 6), bool)
        sky[1, 0] = True
        mask = np.zeros((80, 60), bool)
        mask[55:, :] = True
        frame = predicted(PredictionHints(ego_mask=mask), sky=sky).frames[1]
        assert not frame.depth[2].any()
        assert not frame.depth[5].any()
        assert not frame.confidence[5].any()
        assert frame.depth[3:5].all()

    def test_both_ends_of_a_stop_share_one_pose(self) -> None:
        frames = predicted(PredictionHints(zero_motion_copies={1: 0})).frames
        np.testing.assert_array_equal(frames[1].submap_from_camera, frames[0].submap_from_camera)

    def test_rotations_are_made_exact(self) -> None:
        poses = np.stack([np.eye(4), np.eye(4)])
        poses[1, :3, :3] *= 1.001
        rotation = predicted(submap_from_camera=poses).frames[1].submap_from_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)

    def test_quality_has_the_focal_length_and_claims_no_sigma(self) -> None:
        pinhole = np.tile(np.diag([6.0, 6.0, 1.0]), (2, 1, 1))
        pinhole[1, 0, 0] = 6.6
        quality = predicted(pinhole=pinhole).quality
        assert quality.registered_frame_count == 2
        assert quality.focal_over_width == pytest.approx(6.3 / 6)
        assert np.isnan(quality.focal_relative_sigma)
        assert np.isnan(quality.mean_reprojection_error_px)

    @pytest.mark.parametrize(
        ("changes", "reason"),
        [
            ({"submap_from_camera": np.full((2, 4, 4), np.nan)}, "poses"),
            ({"pinhole": np.full((2, 3, 3), np.inf)}, "intrinsics"),
            ({"pinhole": np.zeros((2, 3, 3))}, "field of view"),
            ({"depth": np.full((2, 4, 6), np.nan)}, "almost nowhere"),
        ],
    )
    def test_nonsense_fails_with_a_reason(self, changes: dict[str, Any], reason: str) -> None:
        prediction = predicted(**changes)
        assert prediction.verdict is SubmapVerdict.FAILED
        assert prediction.frames == ()
        assert reason in prediction.reason
        assert prediction.stage_seconds == {"all": 1.0}


def test_failed_has_no_frames() -> None:
    prediction = failed("why", ScaleKind.METRIC, "model")
    assert (prediction.verdict, prediction.reason, prediction.frames) == (SubmapVerdict.FAILED, "why", ())
    assert prediction.quality.registered_frame_count == 0
