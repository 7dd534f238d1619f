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

    def act(self, points_source: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        """Points (..., 3) of the source frame in the target frame."""
        return self.scale * (points_source @ self.rotation.T) + self.translation

    def act_pose(self, source_from_camera: Array) -> Array:
        """``target_from_camera`` as a rigid (4, 4) transform: the camera's centre moves, its axes stay orthonormal."""
        return se3.make(self.rotation @ source_from_camera[:3, :3], self.act(source_from_camera[:3, 3]))
