"""`vggt-motion run` with all its processes, timed: is it as fast as the video, and do two inference workers beat one?

    python tests/benchmarks/bench_end_to_end.py [SEQUENCE ...] [--workers 1 2] [--set section.field=value]

Per run: seconds of video, seconds of start-up (until every service is there), seconds from then to the final trajectory
and a complete recording, ATE of all frames, and where the inference workers spent their time.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("VGGT_MOTION_DATA", REPOSITORY.parent / "shared" / "data"))
SEQUENCES = ("kitti_00_first200", "kitti_06_first51")


def run(location: Path, workers: int, assignments: list[str], out: Path) -> dict[str, object]:
    """One run from a clean folder; its metrics."""
    command = [sys.executable, "-m", "vggt_motion", "run", str(location), "--out", str(out), "--fresh"]
    values = [f"run.inference_workers={workers}", "gateway.port=0", *assignments]
    command += [part for value in values for part in ("--set", value)]
    if (location / "poses.txt").is_file():
        command += ["--ground-truth", str(location / "poses.txt")]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(done.stderr)
    metrics: dict[str, object] = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    return metrics


def stages(metrics: dict[str, object]) -> str:
    seconds = metrics["stage_seconds"]
    assert isinstance(seconds, dict)
    totals: dict[str, float] = defaultdict(float)
    for name, value in seconds.items():
        if name.startswith("prediction: "):
            totals[name.removeprefix("prediction: ")] += value
    return ", ".join(f"{name} {value:.1f}" for name, value in sorted(totals.items(), key=lambda item: -item[1]))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequences", nargs="*", default=SEQUENCES)
    parser.add_argument("--workers", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--set", action="append", default=[], dest="assignments")
    arguments = parser.parse_args()
    print(f"{os.cpu_count()} cores")
    print(f"{'sequence':>24} {'workers':>8} {'video s':>8} {'start s':>8} {'run s':>8} {'ATE m':>8}  prediction, s")
    for name in arguments.sequences:
        location = Path(name) if Path(name).exists() else DATA / name
        if not location.exists():
            print(f"{name}: not there, left out (set VGGT_MOTION_DATA)")
            continue
        for workers in arguments.workers:
            with tempfile.TemporaryDirectory() as folder:
                metrics = run(location, workers, arguments.assignments, Path(folder) / "run")
            truth = metrics.get("ground_truth")
            error = truth["ate_rmse_m"] if isinstance(truth, dict) else float("nan")
            start, wall = (float(str(metrics[key])) for key in ("start_up_seconds", "wall_seconds"))
            print(
                f"{location.name:>24} {workers:>8} {float(str(metrics['video_seconds'])):>8.1f} {start:>8.1f} "
                f"{wall - start:>8.1f} {error:>8.3f}  {stages(metrics)}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
