"""Many similarity transforms at once, for passes over a whole graph. See :mod:`vggt_motion.geometry.sim3`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vggt_motion.geometry import se3
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
    of_identity, of_skew, of_square = _translation_terms(omega, log_scale)
    moved = of_identity[:, None] * u
    moved += of_skew[:, None] * (k @ u[:, :, None])[:, :, 0]
    moved += of_square[:, None] * (k2 @ u[:, :, None])[:, :, 0]
    return Sim3Batch(rotation, moved, np.exp(log_scale))


def log(transforms: Sim3Batch) -> Array:
    """Logarithm map: tangents (N, 7), rotations of norm at most pi."""
    omega = _rotation_log(transforms.rotation)
    log_scale = np.log(transforms.scale)
    weights, first, second = _translation_terms(omega, log_scale)
    k = _skew(omega)
    v = weights[:, None, None] * np.eye(3) + first[:, None, None] * k + second[:, None, None] * (k @ k)
    u = np.linalg.solve(v, transforms.translation[:, :, None])[:, :, 0]
    return np.concatenate([omega, u, log_scale[:, None]], axis=1)


def _rotation_log(rotation: Array) -> Array:
    """Rotation vectors (N, 3)."""
    axis = 0.5 * np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=1,
    )
    sine, cosine = np.linalg.norm(axis, axis=1), 0.5 * (np.trace(rotation, axis1=1, axis2=2) - 1.0)
    angle = np.arctan2(sine, cosine)
    out = axis / np.sinc(angle / np.pi)[:, None]
    # next to pi the sine says nothing of the axis; such a turn is rare enough to be taken one by one
    for n in np.flatnonzero(cosine < -0.9).tolist():
        out[n] = se3.so3_log(rotation[n])
    return np.asarray(out, dtype=np.float64)


def _translation_terms(omega: Array, log_scale: Array) -> tuple[Array, Array, Array]:
    """Factors (N,) of the identity, skew(omega) and its square in ``V``, by the quadrature of a single transform."""
    nodes = QUADRATURE_NODES
    weights = QUADRATURE_WEIGHTS * np.exp(log_scale[:, None] * nodes)
    first, second = _sine_terms(np.linalg.norm(omega, axis=1)[:, None] * nodes)
    return weights.sum(axis=1), (weights * nodes * first).sum(axis=1), (weights * nodes**2 * second).sum(axis=1)


def _sine_terms(angle: Array) -> tuple[Array, Array]:
    """``sin(a) / a`` and ``(1 - cos(a)) / a^2``, regular at zero."""
    return np.sinc(angle / np.pi), 0.5 * np.sinc(0.5 * angle / np.pi) ** 2


def _skew(vectors: Array) -> Array:
    out = np.zeros((len(vectors), 3, 3))
    out[:, 0, 1], out[:, 0, 2] = -vectors[:, 2], vectors[:, 1]
    out[:, 1, 0], out[:, 1, 2] = vectors[:, 2], -vectors[:, 0]
    out[:, 2, 0], out[:, 2, 1] = -vectors[:, 1], vectors[:, 0]
    return out
