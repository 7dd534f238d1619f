"""Turning according to ground truth, as the issue defines it: yaw rate above 5 deg/s over the smoothing window."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vggt_motion.geometry.se3 import so3_log

TURNING_DEG_PER_S = 5.0


def yaw_rates_deg_per_s(sequence: Path, times_ns: list[int], sigma_frames: float) -> npt.NDArray[np.float64]:
    """Signed yaw rate (N - 1,) of frames 1, 2, ..., smoothed by a Gaussian of this width.

    Camera axes: y is down, so that a turn to the right is positive.
    """
    world_from_camera = np.loadtxt(sequence / "poses.txt").reshape(-1, 3, 4)[:, :, :3]
    rates = []
    for k in range(1, len(world_from_camera)):
        previous_from_current = world_from_camera[k - 1].T @ world_from_camera[k]
        seconds = (times_ns[k] - times_ns[k - 1]) * 1e-9
        rates.append(math.degrees(so3_log(previous_from_current)[1]) / seconds)
    reach = math.ceil(3 * sigma_frames)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_frames) ** 2)
    smooth = np.convolve(rates, kernel, "same") / np.convolve(np.ones(len(rates)), kernel, "same")
    return np.asarray(smooth, np.float64)


def is_turning(sequence: Path, times_ns: list[int], sigma_frames: float = 2.0) -> npt.NDArray[np.bool_]:
    """Truth (N - 1,) for frames 1, 2, ..."""
    return np.asarray(np.abs(yaw_rates_deg_per_s(sequence, times_ns, sigma_frames)) > TURNING_DEG_PER_S)


def f1(predicted: npt.NDArray[np.bool_], truth: npt.NDArray[np.bool_]) -> float:
    """Harmonic mean of precision and recall; NaN where neither has a positive."""
    positives = np.sum(predicted) + np.sum(truth)
    return float(2 * np.sum(predicted & truth) / positives) if positives else math.nan
