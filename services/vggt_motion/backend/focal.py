"""The running estimate of the camera over a session, folded in index order from the submaps' results (DESIGN 3.4).

One submap with a wrong focal length and a confident sigma must not carry the estimate away, so it is a weighted median,
and the sigma grows with the scatter of the results about it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable

import numpy as np

from vggt_motion.records import FocalHint, SubmapQuality

# A submap's own sigma covers its noise, not what its scene does to it (rolling shutter, moving cars): so much is added.
_MODEL_SIGMA = 0.01
_SETTLED_RELATIVE_SIGMA = 0.01
_SETTLED_MIN_RESULTS = 3  # fewer cannot tell which of them is wrong
_MAD_TO_SIGMA = 1.4826  # median absolute deviation of a normal distribution to its standard deviation


class FocalEstimate:
    """Weighted median of the log focal length (in image widths), and of the radial coefficient and its shape."""

    def __init__(self) -> None:
        """Start without any result."""
        self._log_focals: list[float] = []
        self._k1s: list[float] = []
        self._shapes: list[float] = []
        self._weights: list[float] = []

    def add(self, quality: SubmapQuality | None) -> None:
        """Take in one submap's result; one that is missing, failed or held its focal length tells nothing."""
        if quality is None:
            return
        sigma, focal = quality.focal_relative_sigma, quality.focal_over_width
        if math.isfinite(sigma) and math.isfinite(focal) and focal > 0.0:
            self._log_focals.append(math.log(focal))
            self._k1s.append(quality.radial_k1)
            self._shapes.append(quality.radial_shape)
            self._weights.append(1.0 / (sigma * sigma + _MODEL_SIGMA * _MODEL_SIGMA))

    def hint(self) -> FocalHint | None:
        """The estimate as a hint, or None while nothing is known."""
        if not self._weights:
            return None
        return _hint(tuple(self._log_focals), tuple(self._k1s), tuple(self._shapes), tuple(self._weights))

    def settled_hint(self) -> FocalHint | None:
        """The hint if it is good enough to judge earlier submaps by it, else None."""
        hint = self.hint() if len(self._weights) >= _SETTLED_MIN_RESULTS else None
        return hint if hint is not None and hint.relative_sigma < _SETTLED_RELATIVE_SIGMA else None


def fold(qualities: Iterable[SubmapQuality | None]) -> FocalEstimate:
    """The estimate after a series of results in index order; None stands for a submap without a result."""
    estimate = FocalEstimate()
    for quality in qualities:
        estimate.add(quality)
    return estimate


@functools.lru_cache(1024)
def _hint(
    log_focals: tuple[float, ...], k1s: tuple[float, ...], shapes: tuple[float, ...], weights: tuple[float, ...]
) -> FocalHint:
    """Remembered, because a plan folds all results anew whenever one has come."""
    log_focal = _weighted_median(log_focals, weights)
    normalised = np.abs(np.array(log_focals) - log_focal) * np.sqrt(weights)
    scatter = _MAD_TO_SIGMA * float(np.median(normalised))
    return FocalHint(
        focal_over_width=math.exp(log_focal),
        relative_sigma=max(1.0, scatter) / math.sqrt(sum(weights)),
        radial_k1=_weighted_median(k1s, weights),
        radial_shape=_weighted_median(shapes, weights),
    )


def _weighted_median(values: tuple[float, ...], weights: tuple[float, ...]) -> float:
    """The value at half of the total weight, interpolated between the mid-points of the neighbours' weights.

    Continuous in values and weights; two results of equal weight give their mean.
    """
    order = np.argsort(values, kind="stable")
    sorted_values, sorted_weights = np.array(values)[order], np.array(weights)[order]
    midpoints = np.cumsum(sorted_weights) - 0.5 * sorted_weights
    return float(np.interp(0.5 * float(sorted_weights.sum()), midpoints, sorted_values))
