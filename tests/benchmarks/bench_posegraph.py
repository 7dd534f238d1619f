"""Pose graph: error and time along real roads, live updates, false loops (paper section 3.3).

    python tests/benchmarks/bench_posegraph.py [--quick]

Roads are KITTI's ground truth (VGGT_MOTION_DATA/kitti_trajectories), one submap every 38 m, driven in laps. Edge
errors are those of real submaps. Times are processor times of one thread.
"""

from __future__ import annotations

import argparse
import sys
import time
from itertools import product
from pathlib import Path

import gtsam
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import graphs
from conftest import evaluation_data
from vggt_motion.backend import factors, posegraph
from vggt_motion.backend.incremental import LiveGraph
from vggt_motion.config import BackendConfig
from vggt_motion.evaluation import trajectory_io
from vggt_motion.records import Constraint, ConstraintKind

SUBMAP_STEP_M = 38.0  # twelve keyframes of KITTI 00
CONFIG = BackendConfig()


def road(name: str) -> np.ndarray:
    """Poses (N, 4, 4) every SUBMAP_STEP_M along a road."""
    track = trajectory_io.read_kitti(evaluation_data() / "kitti_trajectories" / f"{name}.txt")
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(track.positions, axis=0), axis=1))])
    places = np.searchsorted(travelled, np.arange(0.0, travelled[-1], SUBMAP_STEP_M))
    return track.world_from_camera[places]


def solve(
    drive: graphs.SimulatedDrive, constraints: list[Constraint], config: BackendConfig = CONFIG
) -> tuple[float, float]:
    """Error in metres and time in seconds of a batch solve."""
    started = time.process_time()
    update = posegraph.solve(drive.nodes, constraints, config, revision=1, is_final=True)
    return graphs.position_error(drive, graphs.poses_of(update)), time.process_time() - started


def bench_size(sizes: list[tuple[int, int]]) -> None:
    print("\nError before and after, and time of the batch solve; no false loops")
    print("| road | submaps | loops | error of the chain m | error m | time s |")
    print("|---|---:|---:|---:|---:|---:|")
    times: dict[int, list[float]] = {}
    for (count, loops), name in product(sizes, ("05", "06", "07", "09")):
        if count > 1000 and name != "05":
            continue
        drive = graphs.simulate(road(name), count, loops, 0.0, seed=0)
        chain = posegraph.chain(drive.nodes, drive.constraints)
        before = graphs.position_error(drive, [chain[k] for k in range(count)])
        after, seconds = solve(drive, list(drive.constraints))
        times.setdefault(count, []).append(seconds)
        print(
            f"| {name} | {count} | {len(drive.true_loops)} | {before:.1f} | {after:.2f} | {seconds:.3f} |", flush=True
        )
    sizes_done = np.log(list(times))
    exponent = np.polyfit(sizes_done, np.log([np.median(times[count]) for count in times]), 1)[0]
    print(f"time grows with the number of submaps to the power of {exponent:.2f} (loops: one per 20 submaps)")


def bench_live(count: int, loops: int, last: int) -> None:
    drive = graphs.simulate(road("05"), count, loops, 0.0, seed=0)
    first = count - last
    bench_warm_batch(drive, count)
    live = LiveGraph(CONFIG)
    live.add(drive.nodes[:first], [c for c in drive.constraints if c.spec.j < first])
    times: dict[bool, list[float]] = {False: [], True: []}
    for k in range(first, count):
        new = [c for c in drive.constraints if c.spec.j == k]
        started = time.process_time()
        live.add([(k, 1)], new)
        live.pose(k)
        times[any(c.spec.kind is ConstraintKind.LOOP for c in new)].append(time.process_time() - started)
    started = time.process_time()
    update = live.snapshot(1)
    snapshot = time.process_time() - started
    print(f"\nLive updates at {count} submaps with {len(drive.true_loops)} loops (the last {last} submaps)")
    print("| update | number | median ms | 95 % ms | max ms |")
    print("|---|---:|---:|---:|---:|")
    for has_loop, name in ((False, "without a loop"), (True, "with a loop")):
        values = 1e3 * np.array(times[has_loop])
        tail, worst = np.percentile(values, 95), values.max()
        print(f"| {name} | {len(values)} | {np.median(values):.1f} | {tail:.1f} | {worst:.1f} |")
    error, seconds = solve(drive, list(drive.constraints))
    live_error = graphs.position_error(drive, graphs.poses_of(update))
    print(f"whole live graph: {1e3 * snapshot:.0f} ms, error {live_error:.2f} m")
    print(f"fresh batch: {seconds:.2f} s, {error:.2f} m")


def bench_warm_batch(drive: graphs.SimulatedDrive, count: int) -> None:
    """The rival of the live graph: all factors once more, from where the last solve ended."""
    start = posegraph.chain(drive.nodes, drive.constraints)
    edges = [posegraph.to_edge(c, CONFIG) for c in drive.constraints]
    before = [edge for edge in edges if edge.j < count - 1]
    known = {index: pose for index, pose in start.items() if index < count - 1}
    solved = factors.optimise(known, before, is_metric=False, relative_tolerance=1e-6)
    newest = next(edge for edge in edges if (edge.i, edge.j) == (count - 2, count - 1))
    warm = dict(solved.poses) | {count - 1: solved.poses[count - 2] @ newest.j_from_i.inverse()}
    far = max((edge for edge in edges if edge.j - edge.i > 1), key=lambda edge: edge.j)
    print(f"\nWarm-started batch at {count} submaps, Levenberg-Marquardt to a relative decrease of 1e-3")
    for name, used, poses in (
        ("one submap more", [*before, newest], warm),
        ("one loop more", [e for e in edges if e is not far], warm),
    ):
        if name == "one loop more":
            poses = dict(factors.optimise(poses, used, is_metric=False, relative_tolerance=1e-6).poses)
            used = edges
        started = time.process_time()
        factors.optimise(poses, used, is_metric=False, relative_tolerance=1e-3)
        print(f"{name}: {1e3 * (time.process_time() - started):.0f} ms")


def gnc_error(drive: graphs.SimulatedDrive) -> float:
    """Error under GTSAM's graduated non-convexity (Yang et al., RA-L 2020), adjacent edges known to be true."""
    start = posegraph.chain(drive.nodes, drive.constraints)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    known = []
    for constraint in drive.constraints:
        if constraint.spec.kind is ConstraintKind.ADJACENT:
            known.append(graph.size())
        edge = posegraph.to_edge(constraint, CONFIG)
        graph.add(factors.between(edge, factors.gaussian(edge, 7), 7))
    known.append(graph.size())
    factors.add_prior(graph, 0, start[0], 7)
    for index, pose in start.items():
        factors.insert_pose(values, index, pose, 7)
    parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    parameters.setKnownInliers(known)
    solved = gtsam.GncLMOptimizer(graph, values, parameters).optimize()
    return graphs.position_error(drive, [factors.estimated(solved, k, 7) for k in range(len(drive.truth))])


def bench_false_loops(count: int, loops: int, seeds: int, *, with_gnc: bool) -> None:
    print(f"\nFalse loops: {count} submaps, {loops} loops; error divided by that of Huber without the false ones")
    print("| false | method | median | worst | above 1.2 |")
    print("|---:|---|---:|---:|---:|")
    huber = CONFIG.model_copy(update={"loop_loss": "huber"})
    for share in (0.1, 0.3, 0.5):
        ratios: dict[str, list[float]] = {}
        for name, seed in product(("05", "06", "07", "09"), range(seeds)):
            drive = graphs.simulate(road(name), count, loops, share, seed=seed)
            clean, _ = solve(drive, drive.without_false_loops(), huber)
            for loss in ("huber", "cauchy", "cauchy_gate"):
                config = CONFIG.model_copy(update={"loop_loss": loss})
                ratios.setdefault(loss, []).append(solve(drive, list(drive.constraints), config)[0] / clean)
            if with_gnc:
                ratios.setdefault("gnc (GTSAM)", []).append(gnc_error(drive) / clean)
        for method, values in ratios.items():
            worse = sum(value > 1.2 for value in values)
            print(
                f"| {share:.0%} | {method} | {np.median(values):.2f} | {max(values):.2f} | {worse} of {len(values)} |",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="leave out 10,000 submaps")
    arguments = parser.parse_args()
    if not (evaluation_data() / "kitti_trajectories").is_dir():
        print(f"no roads at {evaluation_data()}: set VGGT_MOTION_DATA")
        return
    sizes = [(100, 5), (1000, 50)] if arguments.quick else [(100, 5), (1000, 50), (10_000, 500)]
    bench_size(sizes)
    bench_live(*((1000, 50, 200) if arguments.quick else (10_000, 500, 1000)))
    bench_false_loops(100, 20, 4, with_gnc=True)
    bench_false_loops(1000, 100, 2, with_gnc=False)


if __name__ == "__main__":
    main()
