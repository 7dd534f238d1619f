"""The errors of a trajectory as a person and a program read them, and the comparison of two files."""

from __future__ import annotations

import json
import math
from pathlib import Path

from vggt_motion.errors import InputError
from vggt_motion.evaluation import metrics
from vggt_motion.evaluation.metrics import TrajectoryMetrics
from vggt_motion.evaluation.trajectory_io import read_kitti, read_tum
from vggt_motion.geometry.track import PoseTrack

_KITTI_FIELDS = 12


def is_kitti(path: Path) -> bool:
    """Whether a trajectory file has twelve numbers a line (KITTI) and not eight (TUM).

    Raises:
        InputError: the file cannot be read.
    """
    try:
        with path.open(encoding="utf-8") as file:
            first = next((line for line in file if line.strip() and not line.startswith("#")), "")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "it is not text"
        raise InputError(f"cannot read trajectory {path}: {reason}") from error
    return len(first.split()) == _KITTI_FIELDS


def evaluate_files(estimate: Path, ground_truth: Path, *, max_difference_s: float = 0.01) -> TrajectoryMetrics:
    """Compare two trajectory files, TUM or KITTI.

    KITTI files have no times: two of them are compared line by line; one beside a TUM file needs its ``times.txt``
    in the same folder.

    Raises:
        InputError: a file cannot be read, or nothing matches.
    """
    both_kitti = is_kitti(estimate) and is_kitti(ground_truth)
    tracks = [_read(path, with_times=not both_kitti) for path in (ground_truth, estimate)]
    if both_kitti and len(tracks[0]) != len(tracks[1]):
        raise InputError(
            f"{estimate} has {len(tracks[1])} poses and {ground_truth} {len(tracks[0])}: "
            "KITTI files without times must have one line for each frame"
        )
    return metrics.evaluate(tracks[0], tracks[1], max_difference_s)


def _read(path: Path, *, with_times: bool) -> PoseTrack:
    if not is_kitti(path):
        return read_tum(path)
    times = path.with_name("times.txt")
    if with_times and not times.is_file():
        raise InputError(f"{path} has no times: put times.txt beside it, or compare two KITTI files")
    return read_kitti(path, times if with_times else None)


def error_table(errors: TrajectoryMetrics) -> dict[str, float | int]:
    """The errors by name with their units; what the drive is too short for is NaN."""
    return {
        "ate_rmse_m": errors.ate_sim3.position_m.rmse,
        "ate_mean_m": errors.ate_sim3.position_m.mean,
        "ate_median_m": errors.ate_sim3.position_m.median,
        "ate_max_m": errors.ate_sim3.position_m.max,
        "drift_ate_percent": errors.ate_sim3.drift_ate_percent,
        "ate_rmse_se3_m": errors.ate_se3.position_m.rmse,
        "ate_rmse_scale_only_m": errors.ate_scale.position_m.rmse,
        "t_rel_percent": errors.kitti.t_rel_percent,
        "r_rel_deg_per_100m": errors.kitti.r_rel_deg_per_100m,
        "rpe_translation_rmse_m": errors.rpe.translation_m.rmse,
        "rpe_rotation_rmse_deg": errors.rpe.rotation_deg.rmse,
        "reference_length_m": errors.reference_length_m,
        "scale_reference_over_estimate": errors.ate_sim3.reference_from_estimate.scale,
        "matched_pose_count": errors.matched_count,
        "estimate_pose_count": errors.estimate_count,
    }


def to_json(errors: TrajectoryMetrics) -> str:
    """:func:`error_table` as JSON; what is not known is null."""
    finite = {name: value if math.isfinite(value) else None for name, value in error_table(errors).items()}
    return json.dumps(finite, indent=2) + "\n"


def to_text(errors: TrajectoryMetrics) -> str:
    """:func:`error_table` in aligned columns; after Sim(3) alignment unless the name says otherwise."""
    table = error_table(errors)
    width = max(map(len, table))
    lines = []
    for name, value in table.items():
        text = str(value) if isinstance(value, int) else f"{value:.6g}" if math.isfinite(value) else "drive too short"
        lines.append(f"{name:<{width}}  {text}")
    return "\n".join(lines) + "\n"
