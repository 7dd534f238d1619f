"""The camera of a submap: what is known beforehand, where to start, and how well the submap sees the focal length."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vggt_motion.inference.sfm.bundle import Calibration

Array = npt.NDArray[np.float64]

# Errors of tracks are alike in neighbouring frames and pixels (drift, moving things, lenses that one coefficient does
# not describe): they tell less than their scatter of 0.1 px suggests. With this deviation the focal lengths of the
# evaluation drives lie within 2.5 of their stated deviations.
PIXEL_SIGMA = 1.0
_TYPICAL_FOCAL_OVER_WIDTH = 0.85
_TYPICAL_FOCAL_LOG_SIGMA = 0.5
_PRINCIPAL_SIGMA_OVER_WIDTH = 0.012
K1_SIGMA = 0.03  # of images that somebody rectified, or nearly
_UNRECTIFIED_K1_SIGMA = 0.3
# Of what a user gives. Held without any play, KITTI's own calibration costs more than it helps, for the rectified
# images keep a little distortion: 1.08 m on KITTI 00 instead of 0.21 m.
_GIVEN_FOCAL_SIGMA = 0.005
_GIVEN_PRINCIPAL_SIGMA_OVER_WIDTH = 0.003
_GIVEN_K1_SIGMA = 0.01
_UNKNOWN_STARTS = (0.65, 1.1, 1.8)  # focal length / image width to grow from where nothing is known
_LAST_USUAL_START = 1.5
_SURE_RELATIVE_SIGMA = 0.1
_MIN_FOCAL_OVER_WIDTH, _MAX_FOCAL_OVER_WIDTH = 0.25, 8.0


@dataclass(frozen=True)
class CameraPrior:
    """What is known about the camera before the submap is looked at."""

    focal_over_width: float | None = None
    relative_sigma: float = math.inf
    radial_k1: float = 0.0
    is_fixed: bool = False
    principal_over_width: tuple[float, float] | None = None  # from the middle of the image; None = near it
    radial_shape: float = 0.0  # k2 as a multiple of k1 squared

    @property
    def is_sure(self) -> bool:
        """Whether no other start than the known focal length is worth trying."""
        return self.is_fixed or self.relative_sigma < _SURE_RELATIVE_SIGMA

    def starts(self) -> Iterator[tuple[float, bool]]:
        """Focal lengths over width to grow from, best first, and whether each is a usual one."""
        known = self.focal_over_width
        usual = [start for start in _UNKNOWN_STARTS if start <= _LAST_USUAL_START]
        if known is not None:
            yield known, True
            # a wrong hint is contradicted best from afar
            usual = [start for start in usual if abs(math.log(start / known)) > _SURE_RELATIVE_SIGMA]
            usual.sort(key=lambda start: -abs(math.log(start / known)))
        if self.is_fixed:
            return
        for rank, start in enumerate(usual):
            yield start, known is None or rank == 0
        yield from ((start, False) for start in _UNKNOWN_STARTS if start > _LAST_USUAL_START)

    def principal_px(self, width_px: int) -> tuple[float, float]:
        """Where the principal point is, or starts, relative to the middle of the image."""
        u, v = self.principal_over_width if self.principal_over_width is not None else (0.0, 0.0)
        return u * width_px, v * width_px

    def calibration(self, width_px: int, is_unrectified: bool = False) -> Calibration:
        """The prior as the bundle adjustment takes it; the principal point may move even where the rest is fixed."""
        if self.principal_over_width is not None:
            return self._near_calibration(width_px)
        principal = _PRINCIPAL_SIGMA_OVER_WIDTH * width_px
        focal = self.focal_over_width if self.focal_over_width is not None else _TYPICAL_FOCAL_OVER_WIDTH
        sigma = min(max(self.relative_sigma, 1e-4), _TYPICAL_FOCAL_LOG_SIGMA)
        return Calibration(
            free=(not self.is_fixed, not self.is_fixed, True, True),
            mean=(math.log(focal * width_px), self.radial_k1, 0.0, 0.0),
            sigma=(sigma, _UNRECTIFIED_K1_SIGMA if is_unrectified else K1_SIGMA, principal, principal),
        )

    def _near_calibration(self, width_px: int) -> Calibration:
        """A given calibration, within its accuracy: one coefficient does not describe a lens, nor for ever."""
        assert self.focal_over_width is not None  # it is given together with the principal point
        principal = _GIVEN_PRINCIPAL_SIGMA_OVER_WIDTH * width_px
        k1_sigma = _GIVEN_K1_SIGMA if self.radial_k1 != 0.0 else K1_SIGMA
        return Calibration(
            free=(True, True, True, True),
            mean=(math.log(self.focal_over_width * width_px), self.radial_k1, *self.principal_px(width_px)),
            sigma=(_GIVEN_FOCAL_SIGMA, k1_sigma, principal, principal),
        )


def is_plausible(focal_over_width: float) -> bool:
    """Whether there are cameras with such a lens."""
    return _MIN_FOCAL_OVER_WIDTH < focal_over_width < _MAX_FOCAL_OVER_WIDTH


def relative_sigma(information: Array, calibration: Calibration) -> float:
    """Standard deviation of log focal as the observations alone see it; inf where held or unseen.

    Args:
        information: (4, 4) of the shared camera, per square pixel of noise variance, without priors.
        calibration: what was free; the priors of everything but the focal length count.
    """
    free = np.flatnonzero(calibration.free)
    if 0 not in free or not np.isfinite(information).all():
        return math.inf
    priors = np.array([0.0, *(1.0 / sigma**2 for sigma in calibration.sigma[1:])])
    block = information[np.ix_(free, free)] / PIXEL_SIGMA**2 + np.diag(priors[free])
    reduced = float(block[0, 0] - block[0, 1:] @ np.linalg.solve(block[1:, 1:], block[1:, 0]))
    return 1.0 / math.sqrt(reduced) if reduced > 1e-12 else math.inf
