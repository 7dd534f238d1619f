"""Closed-form alignment against evo, a general minimiser, and its own symmetries."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core import geometry as evo_geometry
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from vggt_motion.errors import RegistrationError
from vggt_motion.geometry import sim3, umeyama
from vggt_motion.geometry.sim3 import Sim3

seeds = st.integers(0, 2**32 - 1)


def problem(seed: int, noise: float = 0.1, count: int = 40) -> tuple[Sim3, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = sim3.exp(rng.normal(0, [1, 1, 1, 5, 5, 5, 0.5]))
    source = rng.normal(0, [4, 2, 6], (count, 3))
    return truth, source, truth.act(source) + rng.normal(0, noise, (count, 3)), rng.uniform(0.1, 2.0, count)


@given(seeds)
def test_exact_points_give_the_exact_transform(seed: int) -> None:
    truth, source, target, weights = problem(seed, noise=0.0)
    for rule in ("least_squares", "symmetric"):
        got = umeyama.align(source, target, weights, rule)  # type: ignore[arg-type]
        np.testing.assert_allclose(got.matrix(), truth.matrix(), atol=1e-8)


@given(seeds, st.booleans())
def test_unweighted_against_evo(seed: int, with_scale: bool) -> None:
    _, source, target, _ = problem(seed)
    rotation, translation, scale = evo_geometry.umeyama_alignment(source.T, target.T, with_scale)
    got = umeyama.align(source, target, scale="least_squares" if with_scale else "fixed")
    np.testing.assert_allclose(got.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(got.translation, translation, atol=1e-8)
    assert got.scale == pytest.approx(scale)


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_weighted_solution_is_the_minimum(seed: int) -> None:
    _, source, target, weights = problem(seed, noise=0.5)
    got = umeyama.align(source, target, weights)

    def cost(xi: np.ndarray) -> float:
        return float(weights @ (((sim3.exp(xi) @ got).act(source) - target) ** 2).sum(axis=1))

    found = minimize(cost, np.zeros(7), method="BFGS", options={"gtol": 1e-9})
    assert cost(np.zeros(7)) <= found.fun + 1e-9
    np.testing.assert_allclose(found.x, 0.0, atol=1e-4)


@given(seeds)
def test_symmetric_scale_inverts_with_the_roles_swapped(seed: int) -> None:
    _, source, target, weights = problem(seed, noise=0.8)
    forward = umeyama.align(source, target, weights, "symmetric")
    backward = umeyama.align(target, source, weights, "symmetric")
    np.testing.assert_allclose((forward @ backward).matrix(), np.eye(4), atol=1e-8)


@given(seeds)
def test_weights_repeat_points(seed: int) -> None:
    _, source, target, _ = problem(seed)
    counts = np.random.default_rng(seed).integers(0, 4, len(source))
    repeated = umeyama.align(np.repeat(source, counts, axis=0), np.repeat(target, counts, axis=0))
    weighted = umeyama.align(source, target, counts.astype(np.float64))
    np.testing.assert_allclose(weighted.matrix(), repeated.matrix(), atol=1e-9)


def test_a_reflection_is_never_returned() -> None:
    _, source, _, _ = problem(3)
    got = umeyama.align(source, source * np.array([1.0, 1.0, -1.0]))
    assert np.linalg.det(got.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("source", "target", "weights"),
    [
        (np.zeros((5, 3)), np.zeros((5, 3)), np.ones(5)),
        (np.outer(np.arange(5.0), [1, 2, 3]), np.outer(np.arange(5.0), [3, 1, 2]), np.ones(5)),
        (np.eye(3), np.eye(3), np.zeros(3)),
        (np.full((4, 3), np.nan), np.ones((4, 3)), np.ones(4)),
    ],
)
def test_degenerate_points_are_refused(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> None:
    with pytest.raises(RegistrationError):
        umeyama.align(source, target, weights)
