"""Errors of the edges between submaps of real drives, against ground truth: what the simulated graphs are given.

    python tests/benchmarks/bench_edges.py [SEQUENCE ...]

Each submap is laid on the ground truth by its cameras (mean rotation, least-squares scale and place); an edge's error
is the difference between what was registered and what these say, so that it holds the submaps' own bending too.
Drives are those with ground truth in VGGT_MOTION_DATA, with the default predictor and configuration.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import graphs
from conftest import evaluation_data
from vggt_motion.backend import planner
from vggt_motion.config import load_config
from vggt_motion.evaluation.offline import run_offline
from vggt_motion.evaluation.trajectory_io import read_kitti
from vggt_motion.geometry import se3, sim3, umeyama
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import SubmapGeometry

SEQUENCES = ("kitti_00_first200", "kitti_06_first51", "kitti_01_first51")


def world_from_submap(geometry: SubmapGeometry, truth: np.ndarray) -> Sim3:
    """The submap laid on the true poses (N, 4, 4) of its keyframes' frame numbers."""
    places = [int(frame.keyframe_id.rsplit("/", 1)[1]) for frame in geometry.frames]
    found = np.array([frame.submap_from_camera for frame in geometry.frames])
    rotation = se3.nearest_rotation(sum(t[:3, :3] @ f[:3, :3].T for t, f in zip(truth[places], found, strict=True)))
    source, target = found[:, :3, 3] @ rotation.T, truth[places][:, :3, 3]
    moments = umeyama.moments(source, target, np.ones(len(source)))
    spread = source - moments.mean_source
    scale = float(np.sum(spread * (target - moments.mean_target)) / np.sum(spread**2))
    return Sim3(rotation, moments.mean_target - scale * moments.mean_source, scale)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequences", nargs="*", default=SEQUENCES)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    rows = []
    print("| drive | edge | anchor | rotation deg | translation m | scale % |")
    print("|---|---|---|---:|---:|---:|")
    for name in arguments.sequences:
        location = evaluation_data() / name
        if not (location / "poses.txt").is_file():
            print(f"{name}: not there, left out (set VGGT_MOTION_DATA)")
            continue
        truth = read_kitti(location / "poses.txt").world_from_camera
        state = run_offline(str(location), load_config()).state
        placed = {index: world_from_submap(g, truth) for index, g in state.usable_submaps().items()}
        for constraint in planner.current_constraints(state):
            if not constraint.accepted:
                continue
            i, j = constraint.spec.i, constraint.spec.j
            error = sim3.log(constraint.j_from_i @ placed[i].inverse() @ placed[j])
            error[3:6] *= placed[j].scale
            rows.append(error)
            rotation, translation = np.degrees(np.linalg.norm(error[:3])), np.linalg.norm(error[3:6])
            anchor = constraint.attempts[-1].anchor
            scale = 100 * abs(error[6])
            print(f"| {name} | {i}-{j} | {anchor} | {rotation:.2f} | {translation:.3f} | {scale:.2f} |", flush=True)
    if not rows:
        return
    errors = np.array(rows)
    rms = [float(np.sqrt(np.mean(errors[:, part] ** 2))) for part in (slice(0, 3), slice(3, 6), slice(6, 7))]
    print(f"\nRMS per axis of {len(rows)} edges: {rms[0]:.4f} rad, {rms[1]:.3f} m, {rms[2]:.4f} of log-scale")
    given = graphs.EDGE_SIGMA[[0, 3, 6]]
    print(f"The simulated graphs are given: {given[0]:.4f} rad, {given[1]:.3f} m, {given[2]:.4f} of log-scale")


if __name__ == "__main__":
    main()
