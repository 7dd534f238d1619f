"""Sim(3): group laws, and exp/log against the matrix exponential and GTSAM."""

from __future__ import annotations

import gtsam
import numpy as np
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vggt_motion.backend import factors
from vggt_motion.geometry import se3, sim3
from vggt_motion.geometry.sim3 import Sim3

small = st.floats(-1.5, 1.5)
tangents = st.tuples(
    arrays(np.float64, 3, elements=small), arrays(np.float64, 3, elements=st.floats(-50, 50)), st.floats(-2.5, 2.5)
).map(lambda parts: np.concatenate([parts[0], parts[1], [parts[2]]]))
point_arrays = arrays(np.float64, (4, 3), elements=st.floats(-20, 20))


def generator(tangent: np.ndarray) -> np.ndarray:
    """The homogeneous (4, 4) element of the Lie algebra."""
    out = np.zeros((4, 4))
    out[:3, :3] = se3.skew(tangent[:3]) + tangent[6] * np.eye(3)
    out[:3, 3] = tangent[3:6]
    return out


def assert_same(a: Sim3, b: Sim3) -> None:
    np.testing.assert_allclose(a.matrix(), b.matrix(), atol=1e-8 * max(1.0, np.abs(a.matrix()).max()))


@given(tangents, tangents, tangents)
def test_composition_is_associative(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    x, y, z = sim3.exp(a), sim3.exp(b), sim3.exp(c)
    assert_same((x @ y) @ z, x @ (y @ z))


@given(tangents)
def test_inverse_and_identity(a: np.ndarray) -> None:
    x = sim3.exp(a)
    assert_same(x @ x.inverse(), Sim3.identity())
    assert_same(x.inverse() @ x, Sim3.identity())
    assert_same(x @ Sim3.identity(), x)


@given(tangents, tangents, point_arrays)
def test_action_follows_composition_and_the_matrix(a: np.ndarray, b: np.ndarray, points: np.ndarray) -> None:
    x, y = sim3.exp(a), sim3.exp(b)
    expected = x.act(y.act(points))
    tolerance = 1e-9 * max(1.0, np.abs(expected).max())
    np.testing.assert_allclose((x @ y).act(points), expected, atol=tolerance)
    homogeneous = np.concatenate([points, np.ones((4, 1))], axis=1) @ (x @ y).matrix().T
    np.testing.assert_allclose(homogeneous[:, :3], expected, atol=tolerance)


@given(tangents, point_arrays)
def test_pose_action_moves_the_centre_and_keeps_the_axes_orthonormal(a: np.ndarray, points: np.ndarray) -> None:
    x = sim3.exp(a)
    source_from_camera = se3.make(se3.so3_exp(points[0] / 20.0), points[1])
    target_from_camera = x.act_pose(source_from_camera)
    np.testing.assert_allclose(target_from_camera[:3, :3] @ target_from_camera[:3, :3].T, np.eye(3), atol=1e-9)
    # a camera point moves as a point of the source frame would, up to the scale of the camera's own unit
    direct = x.act(se3.act(source_from_camera, points[2]))
    through_pose = se3.act(target_from_camera, x.scale * points[2])
    np.testing.assert_allclose(through_pose, direct, atol=1e-8 * max(1.0, np.abs(direct).max()))


@given(tangents)
def test_exp_is_the_matrix_exponential(a: np.ndarray) -> None:
    expected = scipy.linalg.expm(generator(a))
    np.testing.assert_allclose(sim3.exp(a).matrix(), expected, atol=1e-9 * max(1.0, np.abs(expected).max()))


@given(tangents)
def test_log_inverts_exp(a: np.ndarray) -> None:
    # rotation vectors of these sizes stay below pi, where the logarithm is unique
    np.testing.assert_allclose(sim3.log(sim3.exp(a)), a, atol=1e-7)


@given(tangents, tangents)
def test_adjoint_carries_a_perturbation_across(a: np.ndarray, b: np.ndarray) -> None:
    x = sim3.exp(a)
    assert_same(x @ sim3.exp(0.1 * b) @ x.inverse(), sim3.exp(x.adjoint() @ (0.1 * b)))


@given(tangents)
def test_tangent_coordinates_are_those_of_gtsam(a: np.ndarray) -> None:
    theirs = gtsam.Similarity3.Expmap(a)
    assert_same(sim3.exp(a), factors.from_gtsam(theirs))
    np.testing.assert_allclose(gtsam.Similarity3.Logmap(factors.to_gtsam(sim3.exp(a))), a, atol=1e-6)


@given(tangents, point_arrays)
def test_conversion_to_gtsam_keeps_the_action(a: np.ndarray, points: np.ndarray) -> None:
    x = sim3.exp(a)
    theirs = factors.to_gtsam(x)
    for point in points:
        np.testing.assert_allclose(
            theirs.transformFrom(point), x.act(point), atol=1e-8 * max(1.0, np.abs(x.matrix()).max() * 20)
        )
    assert_same(factors.from_gtsam(theirs), x)


def test_exp_and_log_next_to_zero() -> None:
    for size in (0.0, 1e-300, 1e-12, 1e-7, 1e-4):
        a = size * np.array([1.0, -2.0, 0.5, 3.0, 1.0, -1.0, 0.7])
        np.testing.assert_allclose(sim3.log(sim3.exp(a)), a, rtol=1e-9, atol=1e-15)
