"""The estimator on point arrays: against numpy, the closed form, its symmetries, and refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vggt_motion.config import RegistrationConfig
from vggt_motion.errors import RegistrationError
from vggt_motion.geometry import se3, sim3, umeyama
from vggt_motion.geometry.projection import Intrinsics, pixel_rays, unproject
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.registration import anchors, kernels
from vggt_motion.registration.sim3 import estimate_sim3

CONFIG = RegistrationConfig()
seeds = st.integers(0, 2**32 - 1)


def scene(seed: int, count: int = 2000, noise: float = 0.01, outliers: float = 0.1):  # type: ignore[no-untyped-def]
    """Points before a camera at the origin of frame i, 4 to 60 deep, and in frame j with errors along the ray."""
    rng = np.random.default_rng(seed)
    depth = np.exp(rng.uniform(np.log(4), np.log(60), count))
    rays = np.stack([rng.uniform(-1, 1, count), rng.uniform(-0.3, 0.3, count), np.ones(count)], axis=1)
    points = rays * depth[:, None]
    truth = sim3.exp(np.concatenate([rng.normal(0, 0.5, 3), rng.normal(0, 5, 3), rng.normal(0, 0.4, 1)]))
    wrong = rng.random(count) < outliers
    factor = 1 + noise * rng.normal(size=count) + np.where(wrong, rng.uniform(0.3, 2.0, count), 0.0)
    start = sim3.exp(rng.normal(0, 0.03, 7)) @ truth
    return truth, points, truth.act(points * factor[:, None]), truth.scale * depth, start, wrong


def error(got: Sim3, truth: Sim3) -> tuple[float, float, float]:
    """Rotation in radians, translation relative to 10 units of frame i, log-scale."""
    delta = got @ truth.inverse()
    return (
        float(np.linalg.norm(se3.so3_log(delta.rotation))),
        float(np.linalg.norm(got.translation - truth.translation)) / (10 * truth.scale),
        abs(float(np.log(delta.scale))),
    )


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_exact_points_give_the_exact_transform(seed: int) -> None:
    truth, x, y, depth, start, _ = scene(seed, noise=0.0, outliers=0.0)
    got = estimate_sim3(x, y, np.ones(len(x)), depth, start, CONFIG)
    assert max(error(got.j_from_i, truth)) < 2e-6  # the points are float32
    assert got.inlier_ratio == 1.0
    assert got.median_relative_residual < 1e-5


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_outliers_do_not_rule(seed: int) -> None:
    truth, x, y, depth, start, wrong = scene(seed)
    got = estimate_sim3(x, y, np.ones(len(x)), depth, start, CONFIG)
    naive = umeyama.align(x, y)
    assert sum(error(got.j_from_i, truth)) < sum(error(naive, truth))
    assert max(error(got.j_from_i, truth)) < 0.02
    assert got.inlier_ratio == pytest.approx(1 - wrong.mean(), abs=0.02)


@given(seeds, seeds)
@settings(max_examples=25, deadline=None)
def test_equivariance(seed: int, other: int) -> None:
    """Any similarity applied to one side moves the answer with it: its scale moves the residuals' unit as well."""
    _, x, y, depth, start, _ = scene(seed)
    weights = np.ones(len(x))
    rng = np.random.default_rng(other)
    move = sim3.exp(np.concatenate([rng.normal(0, 1, 3), rng.normal(0, 5, 3), rng.normal(0, 0.5, 1)]))
    plain = estimate_sim3(x, y, weights, depth, start, CONFIG)
    moved_target = estimate_sim3(x, move.act(y), weights, move.scale * depth, move @ start, CONFIG)
    moved_source = estimate_sim3(move.act(x), y, weights, depth, start @ move.inverse(), CONFIG)
    assert max(error(moved_target.j_from_i, move @ plain.j_from_i)) < 1e-4
    assert max(error(moved_source.j_from_i, plain.j_from_i @ move.inverse())) < 1e-4
    assert moved_target.inlier_ratio == pytest.approx(plain.inlier_ratio, abs=2e-3)
    # the information belongs to the left perturbation in frame j and is carried along by the adjoint
    adjoint = move.adjoint()
    carried = adjoint.T @ moved_target.information @ adjoint
    np.testing.assert_allclose(carried, plain.information, rtol=1e-2, atol=1e-3 * np.abs(plain.information).max())


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_order_of_points_does_not_matter(seed: int) -> None:
    _, x, y, depth, start, _ = scene(seed)
    order = np.random.default_rng(seed).permutation(len(x))
    a = estimate_sim3(x, y, np.ones(len(x)), depth, start, CONFIG)
    b = estimate_sim3(x[order], y[order], np.ones(len(x)), depth[order], start, CONFIG)
    assert max(error(a.j_from_i, b.j_from_i)) < 1e-5


def test_same_input_same_bits() -> None:
    _, x, y, depth, start, _ = scene(5)
    a = estimate_sim3(x, y, np.ones(len(x)), depth, start, CONFIG)
    b = estimate_sim3(x.copy(), y.copy(), np.ones(len(x)), depth.copy(), start, CONFIG)
    np.testing.assert_array_equal(a.j_from_i.matrix(), b.j_from_i.matrix())
    np.testing.assert_array_equal(a.information, b.information)


@given(seeds)
@settings(max_examples=15, deadline=None)
def test_fixed_scale_is_rigid(seed: int) -> None:
    truth, x, _, depth, _, _ = scene(seed, outliers=0.0)
    rigid = Sim3(truth.rotation, truth.translation, 1.0)
    got = estimate_sim3(x, rigid.act(x), np.ones(len(x)), depth / truth.scale, rigid, CONFIG, fix_scale=True)
    assert got.j_from_i.scale == 1.0
    assert max(error(got.j_from_i, rigid)) < 1e-5


def reference_weights(x: np.ndarray, y: np.ndarray, depth: np.ndarray, at: Sim3) -> tuple[np.ndarray, np.ndarray]:
    residual = np.linalg.norm(at.act(x) - y, axis=1) / depth
    return residual, np.minimum(1.0, CONFIG.huber_relative / np.maximum(residual, 1e-12)) / depth**2


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_estimate_is_a_fixed_point_of_the_numpy_reference(seed: int) -> None:
    """Weights of plain numpy at the answer, and the closed form of plain numpy under them, give the answer again."""
    _, x, y, depth, start, _ = scene(seed)
    got = estimate_sim3(x, y, np.ones(len(x)), depth, start, CONFIG)
    residual, weights = reference_weights(x, y, depth, got.j_from_i)
    assert max(error(umeyama.align(x, y, weights, "symmetric"), got.j_from_i)) < 5e-5
    assert got.median_relative_residual == pytest.approx(np.median(residual), rel=1e-4)
    assert got.inlier_ratio == pytest.approx(np.mean(residual <= CONFIG.inlier_relative), abs=2e-3)


def test_kernels_against_numpy() -> None:
    _, x, y, depth, start, _ = scene(11)
    x32, y32, unit = x.astype(np.float32), y.astype(np.float32), (1 / depth).astype(np.float32)
    columns_x, columns_y = np.ascontiguousarray(x32.T), np.ascontiguousarray(y32.T)
    base = np.random.default_rng(0).uniform(0.5, 1.5, len(x)).astype(np.float32)
    affine = np.ascontiguousarray(start.matrix()[:3])
    ox, oy = x.mean(axis=0), y.mean(axis=0)
    residual = np.linalg.norm(start.act(x32.astype(float)) - y32, axis=1) * unit
    w = base * unit.astype(float) ** 2 * np.minimum(1.0, 0.02 / residual)
    dx, dy = x32 - ox, y32 - oy
    expected = np.concatenate(
        [[w.sum()], w @ dx, w @ dy, ((dy * w[:, None]).T @ dx).ravel(), [w @ (dx**2).sum(1)], [w @ (dy**2).sum(1)]]
    )
    got = kernels.accumulate(columns_x, columns_y, base, unit, affine, 0.02, ox, oy, 1)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())
    centre = start.act(ox)
    p = start.act(x32.astype(float)) - centre
    second = (p * w[:, None]).T @ p
    residuals, sums = kernels.score(columns_x, columns_y, base, unit, affine, 0.02, centre)
    np.testing.assert_allclose(residuals, residual, rtol=1e-5)
    expected = np.concatenate([[w.sum()], w @ p, second[np.triu_indices(3)]])
    np.testing.assert_allclose(sums, expected, rtol=1e-5, atol=1e-7 * np.abs(second).max())


def test_gather_keeps_the_usable_points_in_order() -> None:
    _, x, y, depth, _, _ = scene(4, count=50)
    weights = np.ones(50)
    x[3, 1], y[7, 0], depth[11], depth[12], weights[20] = np.nan, np.inf, 0.0, -1.0, 0.0
    keep = np.setdiff1d(np.arange(50), [3, 7, 11, 12, 20])
    for dtype in (np.float32, np.float64):
        arrays = [array.astype(dtype) for array in (x, y, weights, depth)]
        got_x, got_y, got_w, got_unit = kernels.gather(*arrays)
        np.testing.assert_array_equal(got_x, x[keep].astype(np.float32).T)
        np.testing.assert_array_equal(got_y, y[keep].astype(np.float32).T)
        np.testing.assert_allclose(got_unit, 1 / depth[keep], rtol=1e-6)
        assert len(got_w) == len(keep)


def test_a_coarse_pass_sums_over_some_blocks_only() -> None:
    _, x, y, depth, start, _ = scene(11, count=3000)
    arguments = [*kernels.gather(x, y, np.ones(len(x)), depth), np.ascontiguousarray(start.matrix()[:3]), 0.02]
    origin = np.zeros(3)
    parts = []
    for first in range(5):
        shifted = np.concatenate([np.arange(128 * b, min(128 * b + 128, 3000)) for b in range(first, 24, 5)])
        own = kernels.gather(x[shifted], y[shifted], np.ones(len(shifted)), depth[shifted])
        parts.append(kernels.accumulate(*own, *arguments[4:], origin, origin, 1))
    np.testing.assert_allclose(kernels.accumulate(*arguments, origin, origin, 5), parts[0], rtol=1e-12)
    np.testing.assert_allclose(kernels.accumulate(*arguments, origin, origin, 1), np.sum(parts, axis=0), rtol=1e-9)


@pytest.mark.parametrize(
    ("k_i", "k_j"), [((0.0, 0.0), (0.0, 0.0)), ((-0.2, 0.0), (0.05, 0.0)), ((-0.3, 0.09), (0.0, 0.1))]
)
def test_unprojection_of_a_pair_against_numpy(k_i: tuple[float, float], k_j: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    camera_i, camera_j = (
        replace(Intrinsics.centred(focal, 64, 32), k1=k1, k2=k2) for focal, (k1, k2) in ((60.0, k_i), (63.0, k_j))
    )
    pose_i, pose_j = se3.exp(rng.normal(0, 1, 6)), se3.exp(rng.normal(0, 1, 6))
    depth_i, depth_j = (rng.uniform(2, 50, (32, 64)).astype(np.float32) for _ in range(2))
    mask = rng.random((32, 64)) < 0.7
    x, y, inverse, rays = kernels.unproject_pair(
        depth_i, depth_j, mask, anchors._camera(camera_i), anchors._camera(camera_j), pose_i, pose_j, 1.7
    )
    np.testing.assert_allclose(x.T, se3.act(pose_i, unproject(depth_i, camera_i)[mask]), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(y.T, se3.act(pose_j, unproject(depth_j, camera_j)[mask]), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(inverse, 1 / np.sqrt(1.7 * depth_i[mask].astype(float) * depth_j[mask]), rtol=1e-6)
    r = pixel_rays(camera_j)[mask]
    expected = [r[:, 0].sum(), r[:, 1].sum(), *(r[:, a] @ r[:, b] for a, b in ((0, 0), (0, 1), (1, 1)))]
    np.testing.assert_allclose(rays, expected, rtol=1e-6, atol=1e-6)


def test_information_is_the_curvature_of_the_cost() -> None:
    """Numerical second derivative of the weighted cost under a left perturbation, up to the one common factor."""
    _, x, y, depth, start, _ = scene(7, noise=0.01, outliers=0.0)
    got = estimate_sim3(x, y, np.ones(len(x)), depth, start, CONFIG)
    _, weights = reference_weights(x, y, depth, got.j_from_i)

    def residuals(xi: np.ndarray) -> np.ndarray:
        moved = (sim3.exp(xi) @ got.j_from_i).act(x)
        return ((moved - y) * np.sqrt(weights)[:, None]).ravel()

    step = 1e-6
    jacobian = np.stack([(residuals(step * e) - residuals(-step * e)) / (2 * step) for e in np.eye(7)], axis=1)
    normal = jacobian.T @ jacobian
    factor = np.trace(got.information) / np.trace(normal)
    assert factor > 0
    np.testing.assert_allclose(got.information / factor, normal, rtol=1e-3, atol=1e-4 * np.abs(normal).max())


@pytest.mark.parametrize("side", ["points_i", "points_j", "depth", "weights"])
def test_points_that_are_not_finite_are_left_out(side: str) -> None:
    truth, x, y, depth, start, _ = scene(3, outliers=0.0)
    weights = np.ones(len(x))
    bad = np.arange(0, len(x), 7)
    {"points_i": x, "points_j": y, "depth": depth, "weights": weights}[side][bad] = np.nan
    got = estimate_sim3(x, y, weights, depth, start, CONFIG)
    assert got.point_count == len(x) - len(bad)
    assert max(error(got.j_from_i, truth)) < 0.01


def test_too_few_and_weightless_points_are_refused() -> None:
    _, x, y, depth, start, _ = scene(3)
    with pytest.raises(RegistrationError, match="valid points"):
        estimate_sim3(x[:100], y[:100], np.ones(100), depth[:100], start, CONFIG)
    with pytest.raises(RegistrationError, match="0 valid points"):
        estimate_sim3(x, y, np.zeros(len(x)), depth, start, CONFIG)
    with pytest.raises(RegistrationError, match="0 valid points"):
        estimate_sim3(x * np.nan, y, np.ones(len(x)), depth, start, CONFIG)


@pytest.mark.parametrize("kind", ["line", "nearly a line", "one point"])
def test_points_without_extent_are_refused(kind: str) -> None:
    rng = np.random.default_rng(0)
    count = 2000
    along = np.linspace(5, 40, count)[:, None]
    x = np.full((count, 3), 5.0) if kind == "one point" else along * [0.1, 0.05, 1.0]
    x = x + (rng.normal(0, 0.02, (count, 3)) if kind != "line" else 0.0)
    truth = sim3.exp(np.full(7, 0.1))
    y = truth.act(x) * (1 + 0.02 * rng.normal(size=(count, 1)))
    with pytest.raises(RegistrationError):
        estimate_sim3(x, y, np.ones(count), np.abs(y[:, 2]), truth, CONFIG)
