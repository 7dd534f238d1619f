"""Many similarity transforms at once, for passes over a whole graph. See :mod:`vggt_motion.geometry.sim3`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vggt_motion.geometry.sim3 import QUADRATURE_NODES, QUADRATURE_WEIGHTS, Sim3

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Sim3Batch:
    """``target_from_source`` similarities."""

    rotation: Array  # (N, 3, 3)
    translation: Array  # (N, 3), target units
    scale: Array  # (N,), positive

    @staticmethod
    def of(transforms: Sequence[Sim3]) -> Sim3Batch:
        """The given transforms, in their order."""
        count = len(transforms)
        return Sim3Batch(
            np.array([t.rotation for t in transforms], dtype=np.float64).reshape(count, 3, 3),
            np.array([t.translation for t in transforms], dtype=np.float64).reshape(count, 3),
            np.array([t.scale for t in transforms], dtype=np.float64),
        )

    def __len__(self) -> int:
        return len(self.scale)

    def __getitem__(self, index: int) -> Sim3:
        """One of the transforms."""
        return Sim3(self.rotation[index], self.translation[index], float(self.scale[index]))

    def to_list(self) -> list[Sim3]:
        """All transforms."""
        return [
            Sim3(rotation, translation, scale)
            for rotation, translation, scale in zip(self.rotation, self.translation, self.scale.tolist(), strict=True)
        ]

    def take(self, indices: npt.NDArray[np.integer]) -> Sim3Batch:
        """The transforms at the given positions."""
        return Sim3Batch(self.rotation[indices], self.translation[indices], self.scale[indices])

    def __matmul__(self, other: Sim3Batch) -> Sim3Batch:
        """Compositions, one by one; a batch of one is composed with every transform of the other."""
        moved = (self.rotation @ other.translation[:, :, None])[:, :, 0]
        return Sim3Batch(
            self.rotation @ other.rotation, self.scale[:, None] * moved + self.translation, self.scale * other.scale
        )

    def inverse(self) -> Sim3Batch:
        """``source_from_target`` of each."""
        rotation = self.rotation.transpose(0, 2, 1)
        return Sim3Batch(
            rotation, -np.einsum("nij,nj->ni", rotation, self.translation) / self.scale[:, None], 1.0 / self.scale
        )

    def adjoint(self) -> Array:
        """Adjoint matrices (N, 7, 7), as :meth:`Sim3.adjoint`."""
        out = np.zeros((len(self), 7, 7))
        out[:, :3, :3] = self.rotation
        out[:, 3:6, :3] = _skew(self.translation) @ self.rotation
        out[:, 3:6, 3:6] = self.scale[:, None, None] * self.rotation
        out[:, 3:6, 6] = -self.translation
        out[:, 6, 6] = 1.0
        return out


def exp(tangents: Array) -> Sim3Batch:
    """Exponential map of tangents (N, 7): rotation, translation, log-scale."""
    omega, u, log_scale = tangents[:, :3], tangents[:, 3:6], tangents[:, 6]
    angle = np.linalg.norm(omega, axis=1)
    k = _skew(omega)
    k2 = k @ k
    first, second = _sine_terms(angle)
    rotation = np.eye(3) + first[:, None, None] * k + second[:, None, None] * k2
    # the translation factor V, by the same quadrature as for a single transform
    nodes = QUADRATURE_NODES
    weights = QUADRATURE_WEIGHTS * np.exp(log_scale[:, None] * nodes)
    first_at, second_at = _sine_terms(angle[:, None] * nodes)
    v = weights.sum(axis=1)[:, None] * u
    v += (weights * nodes * first_at).sum(axis=1)[:, None] * np.einsum("nij,nj->ni", k, u)
    v += (weights * nodes**2 * second_at).sum(axis=1)[:, None] * np.einsum("nij,nj->ni", k2, u)
    return Sim3Batch(rotation, v, np.exp(log_scale))


def _sine_terms(angle: Array) -> tuple[Array, Array]:
    """``sin(a) / a`` and ``(1 - cos(a)) / a^2``, regular at zero."""
    return np.sinc(angle / np.pi), 0.5 * np.sinc(0.5 * angle / np.pi) ** 2


def _skew(vectors: Array) -> Array:
    out = np.zeros((len(vectors), 3, 3))
    out[:, 0, 1], out[:, 0, 2] = -vectors[:, 2], vectors[:, 1]
    out[:, 1, 0], out[:, 1, 2] = vectors[:, 2], -vectors[:, 0]
    out[:, 2, 0], out[:, 2, 1] = -vectors[:, 1], vectors[:, 0]
    return out
