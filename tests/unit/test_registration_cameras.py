"""Cameras as witnesses: the fused transform is the minimum of the total cost, and weights say what they should."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from vggt_motion.errors import RegistrationError
from vggt_motion.geometry import se3, sim3
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.registration import cameras
from vggt_motion.registration.uncertainty import about, require_determined, uncertainty, with_floor

seeds = st.integers(0, 2**32 - 1)


def problem(seed: int, rotation: float = 0.002, centre: float = 0.02, count: int = 5):  # type: ignore[no-untyped-def]
    """The truth and the cameras of both submaps, disturbed by the given standard deviations."""
    rng = np.random.default_rng(seed)
    truth = sim3.exp(rng.normal(0, [0.5, 0.5, 0.5, 3, 3, 3, 0.3]))
    in_i = [
        se3.make(se3.so3_exp(rng.normal(0, 0.1, 3)), np.array([0.1 * k, 0, 1.5 * k]) + rng.normal(0, 0.1, 3))
        for k in range(count)
    ]
    in_j = [truth.act_pose(p) @ se3.exp(rng.normal(0, [rotation] * 3 + [centre] * 3)) for p in in_i]
    return truth, in_i, in_j


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_exact_cameras_give_the_exact_transform(seed: int) -> None:
    truth, in_i, in_j = problem(seed, 0.0, 0.0)
    got, _ = cameras.align(in_i, in_j, fix_scale=False)
    np.testing.assert_allclose(got.matrix(), truth.matrix(), atol=1e-6)


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_fused_transform_is_the_minimum_of_the_total_cost(seed: int) -> None:
    truth, in_i, in_j = problem(seed, 0.0005, 0.002)
    rng = np.random.default_rng(seed)
    by_points = sim3.exp(rng.normal(0, 0.001, 7)) @ truth
    root = rng.normal(0, 40, (7, 7))
    information = root.T @ root
    judged = cameras.witnesses(in_i, in_j, 10.0)

    def cost(xi: np.ndarray, of: Sim3) -> float:
        moved = sim3.exp(xi) @ of
        away = sim3.log(moved @ by_points.inverse())
        total = away @ information @ away
        for a, b in zip(in_i, in_j, strict=True):
            turn = se3.so3_log(moved.rotation @ a[:3, :3] @ b[:3, :3].T)
            total += turn @ turn / judged.sigma_rotation_rad**2
            total += np.sum((moved.act(a[:3, 3]) - b[:3, 3]) ** 2) / judged.sigma_centre**2
        return float(total)

    fused, total = cameras.fuse(by_points, information, judged, fix_scale=False)
    found = minimize(cost, np.zeros(7), args=(fused,), method="BFGS")
    assert cost(np.zeros(7), fused) - found.fun < 1e-3
    # the information is the curvature of that cost at its minimum
    step = 1e-5
    for axis in range(7):
        e = step * np.eye(7)[axis]
        curvature = (cost(e, fused) - 2 * cost(np.zeros(7), fused) + cost(-e, fused)) / (2 * step**2)
        assert curvature == pytest.approx(total[axis, axis], rel=0.05)


def test_scale_is_kept_where_it_is_fixed() -> None:
    truth, in_i, in_j = problem(1)
    rigid = Sim3(truth.rotation, truth.translation, 1.0)
    fused, _ = cameras.fuse(rigid, np.eye(7), cameras.witnesses(in_i, in_j, 10.0), fix_scale=True)
    assert fused.scale == 1.0


def test_scatter_is_what_was_put_in() -> None:
    """The standard deviations of many cameras come back: two submaps of which one errs."""
    _, in_i, in_j = problem(2, rotation=0.01, centre=0.2, count=400)
    judged = cameras.witnesses(in_i, in_j, 10.0)
    assert judged.sigma_rotation_rad == pytest.approx(0.01, rel=0.05)
    # the floor is a hundredth of the baseline, which 400 cameras make long
    assert judged.sigma_centre >= 0.2 * 0.9
    short = cameras.witnesses(in_i[:2], in_j[:2], 10.0)
    assert (short.sigma_rotation_rad, short.sigma_centre) == (0.005, 0.1)


@pytest.mark.parametrize(
    ("rotation", "centre", "count", "words"),
    [(0.0, 0.0, 2, "2 shared cameras"), (0.1, 0.0, 5, "disagree"), (0.0, 1.0, 5, "disagree")],
)
def test_cameras_alone_must_be_enough_and_agree(rotation: float, centre: float, count: int, words: str) -> None:
    _, in_i, in_j = problem(4, rotation, centre, count)
    with pytest.raises(RegistrationError, match=words):
        cameras.align(in_i, in_j, fix_scale=False)


def test_cameras_that_stand_still_have_no_scale() -> None:
    with pytest.raises(RegistrationError, match="do not move"):
        cameras.align([np.eye(4)] * 4, [np.eye(4)] * 4, fix_scale=False)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_information_about_a_point_and_with_a_floor(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root, centre = rng.normal(0, 5, (9, 7)), rng.normal(0, 10, 3)
    information = root.T @ root
    np.testing.assert_allclose(about(about(information, centre), -centre), information, rtol=1e-6, atol=1e-6)
    # moving the point of reference is a change of coordinates: exp(xi) about c is T exp(xi) T^-1 about the origin
    xi = rng.normal(0, 1e-3, 7)
    shift = Sim3(np.eye(3), centre, 1.0)
    at_origin = sim3.log(shift @ sim3.exp(xi) @ shift.inverse())
    assert xi @ about(information, centre) @ xi == pytest.approx(at_origin @ information @ at_origin, rel=1e-9)
    floor = np.array([0.1] * 3 + [0.2] * 3 + [0.3])
    floored = with_floor(information, centre, 4.0, floor, fix_scale=False)
    before = uncertainty(information, centre, 4.0, fix_scale=False)
    after = uncertainty(floored, centre, 4.0, fix_scale=False)
    np.testing.assert_allclose(after**2, before**2 + floor**2, rtol=1e-6)


def test_an_undetermined_part_is_named() -> None:
    information = np.diag([1e4] * 3 + [1e2] * 3 + [1.0])
    with pytest.raises(RegistrationError, match="the scale is uncertain by 100 %"):
        require_determined(information, np.zeros(3), 10.0, np.full(7, 0.5), fix_scale=False)
    require_determined(information, np.zeros(3), 10.0, np.full(7, 0.5), fix_scale=True)
    information[0, 0] = 0.0
    with pytest.raises(RegistrationError, match="do not determine"):
        uncertainty(information, np.zeros(3), 10.0, fix_scale=False)
