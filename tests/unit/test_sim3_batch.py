"""Batches of transforms against single ones."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vggt_motion.geometry import sim3, sim3_batch
from vggt_motion.geometry.sim3_batch import Sim3Batch


def random_tangents(seed: int, count: int = 6) -> np.ndarray:
    rng = np.random.default_rng(seed)
    tangents = rng.normal(0, [0.8, 0.8, 0.8, 9, 9, 9, 0.8], (count, 7))
    tangents[0] = 0.0
    tangents[1] *= 1e-9
    return tangents


@given(st.integers(0, 2**32 - 1))
def test_batches_do_what_single_transforms_do(seed: int) -> None:
    a, b = random_tangents(seed), random_tangents(seed + 1)
    left, right = sim3_batch.exp(a), sim3_batch.exp(b)
    singles = [(sim3.exp(x), sim3.exp(y)) for x, y in zip(a, b, strict=True)]
    composed, inverted, adjoints = left @ right, left.inverse(), left.adjoint()
    first = left.take(np.array([2])) @ right
    for n, (x, y) in enumerate(singles):
        np.testing.assert_allclose(left[n].matrix(), x.matrix(), atol=1e-10)
        np.testing.assert_allclose(composed[n].matrix(), (x @ y).matrix(), atol=1e-8)
        np.testing.assert_allclose(inverted[n].matrix(), x.inverse().matrix(), atol=1e-8)
        np.testing.assert_allclose(adjoints[n], x.adjoint(), atol=1e-9)
        np.testing.assert_allclose(first[n].matrix(), (singles[2][0] @ y).matrix(), atol=1e-8)
    logs = sim3_batch.log(left)
    np.testing.assert_allclose(logs, [sim3.log(x) for x, _ in singles], atol=1e-8)
    again = Sim3Batch.of(composed.to_list())
    np.testing.assert_array_equal(again.translation, composed.translation)
    assert len(Sim3Batch.of([])) == 0


def test_turns_next_to_pi_have_their_logarithm() -> None:
    axis = np.array([0.6, -0.48, 0.64])
    for angle in (np.pi - 1e-7, np.pi - 1e-3, 3.0):
        tangent = np.concatenate([angle * axis, [1.0, 2.0, 3.0], [0.2]])
        np.testing.assert_allclose(sim3_batch.log(sim3_batch.exp(tangent[None]))[0], tangent, atol=1e-6)
