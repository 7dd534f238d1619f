"""Similarity transforms Sim(3): ``x_target = scale * rotation @ x_source + translation``.

Tangent vectors are ordered rotation, translation, log-scale, as GTSAM orders them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from vggt_motion.geometry import se3

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Sim3:
    """``target_from_source`` similarity: rotation (3, 3), translation (3,) in target units, positive scale."""

    rotation: Array = field(default_factory=lambda: np.eye(3))
    translation: Array = field(default_factory=lambda: np.zeros(3))
    scale: float = 1.0

    @staticmethod
    def identity() -> Sim3:
        """The neutral element."""
        return Sim3()

    @staticmethod
    def from_se3(target_from_source: Array, scale: float = 1.0) -> Sim3:
        """Similarity with the rotation and translation of a rigid (4, 4) transform."""
        return Sim3(target_from_source[:3, :3].copy(), target_from_source[:3, 3].copy(), scale)

    def matrix(self) -> Array:
        """Homogeneous (4, 4) matrix with ``scale * rotation`` in its upper left block."""
        out = np.eye(4)
        out[:3, :3] = self.scale * self.rotation
        out[:3, 3] = self.translation
        return out

    def __matmul__(self, other: Sim3) -> Sim3:
        """Composition: ``(a_from_b @ b_from_c)`` is ``a_from_c``."""
        return Sim3(
            self.rotation @ other.rotation,
            self.scale * (self.rotation @ other.translation) + self.translation,
            self.scale * other.scale,
        )

    def inverse(self) -> Sim3:
        """``source_from_target``."""
        rotation = self.rotation.T
        return Sim3(rotation, -(rotation @ self.translation) / self.scale, 1.0 / self.scale)

    def act(self, points_source: npt.NDArray[np.floating]) -> Array:
        """Points (..., 3) of the source frame in the target frame, in float64."""
        return np.asarray(self.scale * (points_source @ self.rotation.T) + self.translation, dtype=np.float64)

    def act_pose(self, source_from_camera: Array) -> Array:
        """``target_from_camera`` as a rigid (4, 4) transform: the camera's centre moves, its axes stay orthonormal."""
        return se3.make(self.rotation @ source_from_camera[:3, :3], self.act(source_from_camera[:3, 3]))

    def adjoint(self) -> Array:
        """The (7, 7) matrix ``A`` with ``S @ exp(xi) @ S.inverse() == exp(A @ xi)``.

        It carries a perturbation of the source frame to the target frame. Follows from conjugating the homogeneous
        generator ``[[skew(omega) + lambda I, u], [0, 0]]`` (Eade, "Lie groups for computer vision", section 6).
        """
        out = np.zeros((7, 7))
        out[:3, :3] = self.rotation
        out[3:6, :3] = se3.skew(self.translation) @ self.rotation
        out[3:6, 3:6] = self.scale * self.rotation
        out[3:6, 6] = -self.translation
        out[6, 6] = 1.0
        return out


# The integrand of _translation_factor is entire, so that Gauss-Legendre quadrature with this many nodes is exact to
# rounding for rotations up to pi and scale factors between e^-10 and e^10, without the closed form's branches at zero.
_LEGENDRE_NODES, _LEGENDRE_WEIGHTS = np.polynomial.legendre.leggauss(24)
QUADRATURE_NODES, QUADRATURE_WEIGHTS = 0.5 * (_LEGENDRE_NODES + 1.0), 0.5 * _LEGENDRE_WEIGHTS  # on [0, 1]


def _translation_factor(omega: Array, log_scale: float) -> Array:
    """``V = integral over [0, 1] of exp(tau * lambda) * exp(tau * skew(omega)) d tau``, (3, 3): translation = V @ u."""
    angle = float(np.linalg.norm(omega))
    k = se3.skew(omega)
    weights = QUADRATURE_WEIGHTS * np.exp(log_scale * QUADRATURE_NODES)
    # sin(a tau)/a and (1 - cos(a tau))/a^2 = (sin(a tau/2)/(a/2))^2 / 2, both regular at a = 0;
    # np.sinc(x) is sin(pi x)/(pi x)
    first = QUADRATURE_NODES * np.sinc(angle * QUADRATURE_NODES / np.pi)
    second = 0.5 * (QUADRATURE_NODES * np.sinc(0.5 * angle * QUADRATURE_NODES / np.pi)) ** 2
    return float(weights.sum()) * np.eye(3) + float(weights @ first) * k + float(weights @ second) * (k @ k)


def exp(tangent: Array) -> Sim3:
    """Exponential map of a tangent (7,): rotation in radians, translation, log-scale.

    The coordinates are those of GTSAM's ``Similarity3.Expmap``, although GTSAM stores its translation in other units.
    """
    omega, u, log_scale = tangent[:3], tangent[3:6], float(tangent[6])
    return Sim3(se3.so3_exp(omega), _translation_factor(omega, log_scale) @ u, float(np.exp(log_scale)))


def log(target_from_source: Sim3) -> Array:
    """Logarithm map: the tangent (7,) whose :func:`exp` is the given transform, rotation of norm at most pi."""
    omega = se3.so3_log(target_from_source.rotation)
    log_scale = float(np.log(target_from_source.scale))
    u = np.linalg.solve(_translation_factor(omega, log_scale), target_from_source.translation)
    return np.concatenate([omega, u, [log_scale]])
