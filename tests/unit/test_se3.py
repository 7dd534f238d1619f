"""SE(3) against scipy and the matrix exponential."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation, Slerp

from vggt_motion.geometry import se3

vectors = arrays(np.float64, 3, elements=st.floats(-1.7, 1.7))
quaternions = arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 0.1)


@given(vectors)
def test_so3_exp_against_scipy(vector: np.ndarray) -> None:
    np.testing.assert_allclose(se3.so3_exp(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)


@given(quaternions)
def test_quaternion_and_log_against_scipy(q: np.ndarray) -> None:
    rotation = Rotation.from_quat(q, scalar_first=True)
    np.testing.assert_allclose(se3.rotation_from_quaternion(q), rotation.as_matrix(), atol=1e-12)
    ours = se3.quaternion_from_rotation(rotation.as_matrix())
    np.testing.assert_allclose(se3.rotation_from_quaternion(ours), rotation.as_matrix(), atol=1e-12)
    assert ours[0] >= 0.0 and np.linalg.norm(ours) == pytest.approx(1.0, abs=1e-12)
    log = se3.so3_log(rotation.as_matrix())
    assert np.linalg.norm(log) <= np.pi + 1e-12
    np.testing.assert_allclose(se3.so3_exp(log), rotation.as_matrix(), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1.0, np.pi - 1e-6, np.pi])
def test_log_at_special_angles(angle: float) -> None:
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    log = se3.so3_log(se3.so3_exp(vector))
    if angle > 3.0 and log @ vector < 0:  # at pi both signs are the same rotation
        log = -log
    np.testing.assert_allclose(log, vector, atol=1e-8)


@given(vectors, vectors)
def test_exp_is_the_matrix_exponential_and_log_inverts_it(omega: np.ndarray, v: np.ndarray) -> None:
    tangent = np.concatenate([omega, v])
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = se3.skew(omega), v
    np.testing.assert_allclose(se3.exp(tangent), scipy.linalg.expm(generator), atol=1e-9)
    np.testing.assert_allclose(se3.log(se3.exp(tangent)), tangent, atol=1e-8)


@given(vectors, vectors, vectors)
def test_inverse_and_action(omega: np.ndarray, v: np.ndarray, point: np.ndarray) -> None:
    transform = se3.exp(np.concatenate([omega, v]))
    np.testing.assert_allclose(se3.inverse(transform), np.linalg.inv(transform), atol=1e-9)
    np.testing.assert_allclose(se3.act(se3.inverse(transform), se3.act(transform, point)), point, atol=1e-9)
    np.testing.assert_allclose(se3.skew(omega) @ point, np.cross(omega, point), atol=1e-12)


@given(vectors, vectors, st.floats(0, 1))
def test_interpolation_against_slerp(a: np.ndarray, b: np.ndarray, fraction: float) -> None:
    first, second = se3.exp(np.concatenate([a, b])), se3.exp(np.concatenate([0.5 * b, a]))
    got = se3.interpolate(first, second, fraction)
    rotations = Rotation.from_matrix(np.stack([first[:3, :3], second[:3, :3]]))
    if (rotations[0].inv() * rotations[1]).magnitude() < np.pi - 1e-3:
        np.testing.assert_allclose(got[:3, :3], Slerp([0.0, 1.0], rotations)(fraction).as_matrix(), atol=1e-8)
    np.testing.assert_allclose(got[:3, 3], (1 - fraction) * first[:3, 3] + fraction * second[:3, 3], atol=1e-12)
    np.testing.assert_allclose(se3.interpolate(first, second, 0.0), first, atol=1e-9)
    np.testing.assert_allclose(se3.interpolate(first, second, 1.0), second, atol=1e-8)


@given(arrays(np.float64, (3, 3), elements=st.floats(-1, 1)).filter(lambda m: abs(np.linalg.det(m)) > 1e-2))
def test_nearest_rotation_is_one_and_no_small_turn_brings_it_closer(matrix: np.ndarray) -> None:
    nearest = se3.nearest_rotation(matrix)
    np.testing.assert_allclose(nearest @ nearest.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(nearest) == pytest.approx(1.0)
    best = np.linalg.norm(matrix - nearest)
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        assert np.linalg.norm(matrix - nearest @ se3.so3_exp(0.02 * axis)) >= best - 1e-9
