"""Information (7, 7) of a left perturbation ``exp(xi) @ S``: about which point, in which unit, and is it enough."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from vggt_motion.errors import RegistrationError
from vggt_motion.geometry.sim3 import Sim3

Array = npt.NDArray[np.float64]

# Below this ratio of the extreme eigenvalues, all parts in one unit, something is not seen at all.
_SINGULAR = 1e-9


def about(information: Array, centre: Array) -> Array:
    """Information of the perturbation about ``centre`` (3,) instead of about the origin of the frame."""
    to_origin = Sim3(np.eye(3), centre, 1.0).adjoint()
    return np.asarray(to_origin.T @ information @ to_origin, dtype=np.float64)


def uncertainty(information: Array, centre: Array, typical_depth: float, *, fix_scale: bool) -> Array:
    """Standard deviations (7,) of rotation (rad), translation (typical depths) and log-scale.

    Args:
        information: (7, 7).
        centre: (3,) point about which the parts are told apart, the middle of the points.
        typical_depth: unit of the translation.
        fix_scale: the log-scale is known.

    Raises:
        RegistrationError: some part is not determined at all.
    """
    return np.sqrt(np.diag(_covariance(about(information, centre), typical_depth, fix_scale=fix_scale)))


def require_determined(
    information: Array, centre: Array, typical_depth: float, limit: Array, *, fix_scale: bool
) -> None:
    """Refuse a transform of which some part is guessed; arguments as of :func:`uncertainty`, ``limit`` in its units.

    Raises:
        RegistrationError: names the part.
    """
    sigma = uncertainty(information, centre, typical_depth, fix_scale=fix_scale)
    worst = int(np.argmax(sigma / limit))
    if sigma[worst] > limit[worst]:
        part = ("rotation", "translation", "scale")[worst // 3]
        amount = f"{np.degrees(sigma[worst]):.1f} degrees" if worst < 3 else f"{100 * sigma[worst]:.0f} %"
        raise RegistrationError(f"the {part} is uncertain by {amount}")


def with_floor(information: Array, centre: Array, typical_depth: float, floor: Array, *, fix_scale: bool) -> Array:
    """The information after independent errors of standard deviations ``floor`` (7,) are added.

    Arguments as of :func:`uncertainty`; the floor is in its units, about its centre.
    """
    covariance = _covariance(about(information, centre), typical_depth, fix_scale=fix_scale) + np.diag(floor**2)
    unit = _units(typical_depth)
    return about(np.linalg.inv(covariance) / np.outer(unit, unit), -centre)


def _units(typical_depth: float) -> Array:
    return np.array([1.0] * 3 + [typical_depth] * 3 + [1.0])


def _covariance(centred: Array, typical_depth: float, *, fix_scale: bool) -> Array:
    size = 6 if fix_scale else 7
    unit = _units(typical_depth)
    scaled = (centred * np.outer(unit, unit))[:size, :size]
    eigenvalues, vectors = np.linalg.eigh(scaled)
    if not np.isfinite(eigenvalues).all() or eigenvalues[0] <= _SINGULAR * eigenvalues[-1]:
        raise RegistrationError("the points do not determine the transform")
    out = np.zeros((7, 7))
    out[:size, :size] = (vectors / eigenvalues) @ vectors.T
    return out
