"""The camera model against OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vggt_motion.geometry.projection import Intrinsics, fold_radius, pixel_rays, project, undistort_rays, unproject


@pytest.mark.parametrize(("k1", "k2"), [(-0.3, 0.0), (-0.3, 0.09), (-0.05, 0.0), (0.0, 0.0), (0.1, 0.0), (0.0, 0.05)])
def test_project_against_opencv(k1: float, k2: float) -> None:
    rng = np.random.default_rng(0)
    camera = Intrinsics(300.0, 310.0, 155.0, 47.0, 310, 94, k1, k2)
    points = rng.uniform([-4, -1, 8], [4, 1, 40], (100, 3))
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.matrix(), np.array([k1, k2, 0.0, 0.0, 0.0])
    )
    np.testing.assert_allclose(project(points, camera), expected[:, 0], atol=1e-9)


@given(st.floats(-0.25, 0.25), st.floats(0.6, 3.0))
def test_unproject_then_project_returns_the_pixels(k1: float, focal_over_width: float) -> None:
    camera = Intrinsics.centred(focal_over_width * 64, 64, 32, k1)
    depth = np.random.default_rng(0).uniform(1, 50, (32, 64)).astype(np.float32)
    points = unproject(depth, camera)
    np.testing.assert_allclose(points[..., 2], depth, rtol=1e-6)
    u, v = np.meshgrid(np.arange(64), np.arange(32))
    seen = project(points, camera)
    # wide barrel lenses: pixels beyond the fold of the model have no ray, only a finite stand-in
    radius = np.hypot((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    has_ray = radius < (0.99 * 2 / 3 / np.sqrt(-3 * k1) if k1 < 0 else np.inf)
    np.testing.assert_allclose(seen[has_ray], np.stack([u, v], axis=-1)[has_ray], atol=1e-5)
    assert np.isfinite(points).all()


def test_points_behind_the_camera_have_no_pixel() -> None:
    camera = Intrinsics.centred(100.0, 64, 32)
    assert np.isnan(project(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]), camera)).all()


def test_resized_camera_sees_the_same_rays() -> None:
    camera = Intrinsics(700.0, 700.0, 609.5, 172.8, 1241, 376, -0.3, 0.09)
    half = camera.resized(620, 188)
    # the corner of the image (not the centre of its first pixel) is where the lattices coincide
    for full, small in ((-0.5, -0.5), (1240.5, 619.5)):
        assert (full - camera.cx) / camera.fx == pytest.approx((small - half.cx) / half.fx)
    assert pixel_rays(half).shape == (188, 620, 3)
    assert (half.k1, half.k2) == (camera.k1, camera.k2)


def test_undistortion_inverts_the_radial_model() -> None:
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.3, 0.3, 5))
    for k1, k2 in ((-0.3, 0.0), (-0.1, 0.0), (0.2, 0.0), (-0.4, 0.16), (0.0, 0.1)):
        square = x**2 + y**2
        factor = 1 + k1 * square + k2 * square**2
        got_x, got_y = undistort_rays(x * factor, y * factor, k1, k2)
        np.testing.assert_allclose(np.stack([got_x, got_y]), np.stack([x, y]), atol=1e-9)


@pytest.mark.parametrize(("k1", "k2"), [(-0.3, 0.0), (-0.4, 0.02), (0.1, -0.05), (-0.3, -0.05)])
def test_the_model_folds_where_its_image_is_largest(k1: float, k2: float) -> None:
    radius = np.linspace(0.0, 3.0, 300_001)
    seen = radius * (1 + k1 * radius**2 + k2 * radius**4)
    turns = np.flatnonzero(np.diff(seen) < 0)[0]
    assert fold_radius(k1, k2) == pytest.approx(radius[turns], abs=1e-4)


@pytest.mark.parametrize(("k1", "k2"), [(0.0, 0.0), (0.2, 0.0), (-0.4, 0.16), (0.1, 0.1)])
def test_some_lenses_never_fold(k1: float, k2: float) -> None:
    assert fold_radius(k1, k2) == np.inf
