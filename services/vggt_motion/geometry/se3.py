"""Rigid transforms SE(3) as homogeneous matrices.

A transform is a (4, 4) float64 array named ``target_from_source``: it takes points in the source frame to the target
frame. Tangent vectors are ordered rotation, translation (as GTSAM orders them).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_SMALL_ANGLE_RAD = 1e-6


def skew(vector: Array) -> Array:
    """Return the (3, 3) matrix ``K`` with ``K @ x == cross(vector, x)``."""
    x, y, z = (float(value) for value in vector)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def so3_exp(rotation_vector: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,) in radians (Rodrigues)."""
    angle = float(np.linalg.norm(rotation_vector))
    k = skew(rotation_vector)
    if angle < _SMALL_ANGLE_RAD:
        return np.eye(3) + k + 0.5 * (k @ k)
    first, second = float(np.sin(angle) / angle), float((1.0 - np.cos(angle)) / angle**2)
    return np.eye(3) + first * k + second * (k @ k)


def so3_log(rotation: Array) -> Array:
    """Rotation vector (3,) in radians, of norm at most pi, of a rotation matrix (3, 3).

    Goes through the unit quaternion, which stays accurate next to both 0 and pi.
    """
    w, x, y, z = quaternion_from_rotation(rotation)
    vector = np.array([x, y, z])
    norm = float(np.linalg.norm(vector))
    if norm < 1e-12:
        return 2.0 * vector
    return float(2.0 * np.arctan2(norm, w) / norm) * vector


def quaternion_from_rotation(rotation: Array) -> Array:
    """Unit quaternion (w, x, y, z) with w >= 0 of a rotation matrix (3, 3) (Shepperd's method)."""
    m = np.asarray(rotation, dtype=np.float64)
    trace = float(np.trace(m))
    candidates = np.array([trace, m[0, 0], m[1, 1], m[2, 2]])
    largest = int(np.argmax(candidates))
    if largest == 0:
        q = np.array([1.0 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    elif largest == 1:
        q = np.array([m[2, 1] - m[1, 2], 1.0 + m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]])
    elif largest == 2:
        q = np.array([m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1.0 - m[0, 0] + m[1, 1] - m[2, 2], m[1, 2] + m[2, 1]])
    else:
        q = np.array([m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1.0 - m[0, 0] - m[1, 1] + m[2, 2]])
    q /= np.linalg.norm(q)
    return q if q[0] >= 0.0 else -q


def rotation_from_quaternion(quaternion: Array) -> Array:
    """Rotation matrix (3, 3) of a quaternion (w, x, y, z), which is normalised first."""
    w, x, y, z = np.asarray(quaternion, dtype=np.float64) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def make(rotation: Array, translation: Array) -> Array:
    """Homogeneous (4, 4) transform from a rotation (3, 3) and a translation (3,)."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def inverse(target_from_source: Array) -> Array:
    """``source_from_target`` of a rigid (4, 4) transform."""
    rotation = target_from_source[:3, :3]
    return make(rotation.T, -rotation.T @ target_from_source[:3, 3])


def act(target_from_source: Array, points_source: Array) -> Array:
    """Points (..., 3) of the source frame in the target frame, same shape."""
    return points_source @ target_from_source[:3, :3].T + target_from_source[:3, 3]


def nearest_rotation(matrix: Array) -> Array:
    """The rotation (3, 3) closest in Frobenius norm to a matrix (3, 3), determinant +1."""
    u, _, vt = np.linalg.svd(matrix)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return np.asarray((u * signs) @ vt, dtype=np.float64)


def exp(tangent: Array) -> Array:
    """Exponential map: tangent (6,), rotation then translation, to a (4, 4) transform."""
    omega, v = tangent[:3], tangent[3:]
    angle = float(np.linalg.norm(omega))
    k = skew(omega)
    if angle < _SMALL_ANGLE_RAD:
        v_matrix = np.eye(3) + 0.5 * k + (k @ k) / 6.0
    else:
        v_matrix = np.eye(3) + ((1.0 - np.cos(angle)) / angle**2) * k + ((angle - np.sin(angle)) / angle**3) * (k @ k)
    return make(so3_exp(omega), v_matrix @ v)


def log(target_from_source: Array) -> Array:
    """Logarithm map: (4, 4) transform to its tangent (6,), rotation then translation."""
    omega = so3_log(target_from_source[:3, :3])
    angle = float(np.linalg.norm(omega))
    k = skew(omega)
    if angle < _SMALL_ANGLE_RAD:
        v_inverse = np.eye(3) - 0.5 * k + (k @ k) / 12.0
    else:
        half = 0.5 * angle
        v_inverse = np.eye(3) - 0.5 * k + (1.0 - half / np.tan(half)) / angle**2 * (k @ k)
    return np.concatenate([omega, v_inverse @ target_from_source[:3, 3]])


def interpolate(target_from_a: Array, target_from_b: Array, fraction: float) -> Array:
    """The transform at ``fraction`` (0 gives a, 1 gives b) on the geodesic of SO(3) x R^3 between two poses.

    Rotation and translation are interpolated apart: the straight chord of the camera centre is what two keyframes tell
    about the path between them, while the screw of SE(3) would bend it by the rotation.
    """
    rotation_a, rotation_b = target_from_a[:3, :3], target_from_b[:3, :3]
    rotation = rotation_a @ so3_exp(fraction * so3_log(rotation_a.T @ rotation_b))
    translation = (1.0 - fraction) * target_from_a[:3, 3] + fraction * target_from_b[:3, 3]
    return make(rotation, translation)
