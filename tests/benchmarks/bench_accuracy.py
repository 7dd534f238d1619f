"""Accuracy and time of the whole method, in one process, on the evaluation sequences and the shipped sample.

    python tests/benchmarks/bench_accuracy.py [SEQUENCE ...] [--set section.field=value] [--verbose]

A sequence is a path, a name below the evaluation data, or a name of ``derived_sequences.py``: other lenses, small
images, stops, turns on the spot. Without any, all of them, and those of KITTI once more with the camera given.

Prints, per sequence: frames, keyframes, submaps and how the predictor judged them, refused constraints, breaks, ATE of
all frames after Sim(3) alignment, drift, and seconds of video against seconds of computing with one worker.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

import cv2
import derived_sequences

from vggt_motion.config import Config, load_config
from vggt_motion.evaluation import metrics
from vggt_motion.evaluation.offline import OfflineRun, run_offline
from vggt_motion.evaluation.trajectory_io import read_kitti
from vggt_motion.geometry.track import PoseTrack

REPOSITORY = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("VGGT_MOTION_DATA", REPOSITORY.parent / "shared" / "data"))
SEQUENCES = (
    "kitti_06_first51",
    "kitti_01_first51",
    "kitti_00_first200",
    "redkitchen_first400",
    "kitti_raw_road_91",
    "video/highway_straight.mp4",
    "video/standing_at_red_light.mp4",
)
HEADER = ("sequence", "frames", "key", "submaps", "refused", "breaks", "ATE m", "max m", "drift %", "video s", "CPU s")
WIDTHS = (34, 7, 5, 30, 8, 7, 8, 8, 8, 8, 8)


def row(cells: tuple[str, ...]) -> str:
    return "  ".join(f"{cell:>{width}}" for cell, width in zip(cells, WIDTHS, strict=True))


def truth_of(location: Path, run: OfflineRun) -> PoseTrack | None:
    poses = location / "poses.txt"
    if not poses.is_file():
        return None
    track = read_kitti(poses)
    frames = [frame for frame in run.trajectory.frames if frame.frame_index < len(track)]
    times = run.trajectory.track("all").times_ns[: len(frames)]
    return PoseTrack(times, track.world_from_camera[: len(times)])


def report(name: str, location: Path, run: OfflineRun) -> str:
    state = run.state
    latest = {index: state.submaps[index, revision] for index, revision in sorted(state.submaps)}
    verdicts = [geometry.verdict.value for geometry in latest.values()]
    counts = ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in dict.fromkeys(verdicts))
    graph = state.latest_graph()
    truth = truth_of(location, run)
    errors = ("-", "-", "-")
    if truth is not None and len(run.trajectory.track("all")) > 2:
        ate = metrics.evaluate(truth, run.trajectory.track("all")).ate_sim3
        errors = (f"{ate.position_m.rmse:.3f}", f"{ate.position_m.max:.3f}", f"{ate.drift_ate_percent:.2f}")
    frames = run.trajectory.frames
    duration_s = (frames[-1].capture_time_ns - frames[0].capture_time_ns) / 1e9
    return row(
        (
            name,
            str(len(frames)),
            str(len(state.keyframes)),
            counts,
            str(sum(not constraint.accepted for constraint in state.constraints.values())),
            str(len(graph.breaks) if graph is not None else 0),
            *errors,
            f"{duration_s:.1f}",
            f"{sum(run.seconds.values()):.1f}",
        )
    )


def camera_of(name: str) -> list[str]:
    """The benchmark's own calibration as assignments of the configuration."""
    focal, cx, cy = derived_sequences.KITTI_CAMERAS[name]
    return [f"inference.intrinsics.{field}={value}" for field, value in (("fx", focal), ("cx", cx), ("cy", cy))]


def details(run: OfflineRun) -> None:
    print({stage: round(seconds, 2) for stage, seconds in run.seconds.items()})
    for (index, revision), geometry in sorted(run.state.submaps.items()):
        quality = geometry.quality
        print(
            f"  submap {index} r{revision}: {geometry.verdict.value} {geometry.reason}"
            f" {len(geometry.spec.overlap_keyframe_ids)}+{len(geometry.spec.base_keyframe_ids)} keyframes,"
            f" {quality.registered_frame_count} registered, {quality.mean_reprojection_error_px:.2f} px,"
            f" parallax {quality.median_parallax_deg:.1f} deg,"
            f" focal {quality.focal_over_width:.4f} +- {100 * quality.focal_relative_sigma:.1f} %,"
            f" {sum(geometry.stage_seconds.values()):.1f} s {geometry.stage_seconds}"
        )
        for attempt in quality.attempts:
            print(f"    {attempt}")
    for record_id, constraint in sorted(run.state.constraints.items()):
        print(
            f"  {record_id}: {'accepted' if constraint.accepted else 'refused ' + constraint.reason},"
            f" inliers {constraint.inlier_ratio:.2f}, residual {constraint.median_relative_residual:.4f},"
            f" scale {constraint.j_from_i.scale:.3f}"
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequences", nargs="*", help="paths, or names below the evaluation data")
    parser.add_argument("--set", action="append", default=[], dest="assignments")
    parser.add_argument("--verbose", action="store_true", help="every submap and constraint")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    config: Config = load_config(assignments=arguments.assignments)
    sample = REPOSITORY / "tests/data/kitti_06_first51"
    given = () if arguments.sequences else tuple(derived_sequences.KITTI_CAMERAS)
    chosen = arguments.sequences or [str(sample), *SEQUENCES, *derived_sequences.NAMES]
    print(row(HEADER))
    with tempfile.TemporaryDirectory() as folder:
        for name in chosen:
            location = Path(name) if Path(name).exists() else DATA / name
            label = f"shipped {location.name}" if location == sample else location.name
            if name in derived_sequences.NAMES:
                label = name
                try:
                    location = derived_sequences.write(name, DATA, Path(folder))
                except OSError:
                    location = Path(folder) / "absent"
            if not location.exists():
                print(f"{name}: not there, left out (set VGGT_MOTION_DATA)")
                continue
            run = run_offline(str(location), config)
            print(report(label, location, run), flush=True)
            if arguments.verbose:
                details(run)
    for name in given:
        if (DATA / name).exists():
            run = run_offline(str(DATA / name), load_config(assignments=[*arguments.assignments, *camera_of(name)]))
            print(report(f"{name}, camera given", DATA / name, run), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
