"""Registration: cost of one pair, cost against the whole overlap, and accuracy per anchor (paper section 3.2).

    python tests/benchmarks/bench_registration.py [--pairs 12]

Times are processor times of one thread, so that other work on the machine does not count; ratios come from the same
run.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from street import CAMERA, drive, view
from vggt_motion.config import RegistrationConfig
from vggt_motion.geometry import se3, sim3
from vggt_motion.geometry.projection import unproject
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import ConstraintKind, RegistrationSpec
from vggt_motion.registration import sim3 as estimation
from vggt_motion.registration.anchors import AnchorView, SharedFrame, register
from vggt_motion.registration.sim3 import Sim3Estimate, estimate_sim3

OVERLAP = 30  # frames, the peers' overlap
FIXED_PASSES = 6
DEPTH_NOISE = 0.02
OUTLIERS = 0.1
BOUNDARY_BIAS = 0.06  # of the depth, at the outermost frame of a submap
CAMERA_ROTATION_RAD, CAMERA_CENTRE_M = 0.0005, 0.01


def overlap(seed: int, count: int = OVERLAP) -> tuple[list[SharedFrame], Sim3, float]:
    """The overlap of two submaps with realistic errors, the true ``j_from_i`` and units of j per metre.

    Depth noise is proportional to depth, and half of it is smooth over the image; a tenth of the pixels are outliers.
    The local scale of a submap drifts towards its ends, with the third power of the place in the overlap, and takes
    depths and camera steps along: submap i shrinks towards its end, submap j is too large at its start (the contextual
    asymmetry that the paper describes). The truth is the transform between the undisturbed inner parts.
    """
    rng = np.random.default_rng(seed)
    i_from_world = sim3.exp(rng.normal(0, [0.5, 0.5, 0.5, 5, 5, 5, 0.3]))
    j_from_world = sim3.exp(rng.normal(0, [0.5, 0.5, 0.5, 5, 5, 5, 0.3]))
    poses = drive(count, 1.0)
    places = np.linspace(0.0, 1.0, count)
    biases = -BOUNDARY_BIAS * places**3, BOUNDARY_BIAS * (1.0 - places) ** 3
    steps = np.diff([pose[:3, 3] for pose in poses], axis=0)
    warps = [
        np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (b[1:] + b[:-1])[:, None] * steps, axis=0)]) for b in biases
    ]
    warps[1] -= warps[1][-1]  # submap j is right at its inner end
    frames = []
    for k, pose in enumerate(poses):
        views = []
        for submap_from_world, bias, warp in zip((i_from_world, j_from_world), biases, warps, strict=True):
            exact = view(pose, submap_from_world)
            factor = 1.0 + bias[k] + depth_noise(rng, exact.depth.shape)
            drifted = pose.copy()
            drifted[:3, 3] += warp[k]
            shaken = se3.exp(rng.normal(0, [CAMERA_ROTATION_RAD] * 3 + [CAMERA_CENTRE_M * submap_from_world.scale] * 3))
            submap_from_camera = submap_from_world.act_pose(drifted) @ shaken
            views.append(
                AnchorView((exact.depth * factor).astype(np.float32), exact.confidence, CAMERA, submap_from_camera)
            )
        frames.append(SharedFrame(f"k{k}", views[0], views[1]))
    return frames, j_from_world @ i_from_world.inverse(), j_from_world.scale


def depth_noise(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Relative depth errors (H, W): white and smooth noise in equal parts, and outliers."""
    rows, columns = np.linspace(0, 4, shape[0]), np.linspace(0, 12, shape[1])
    coarse = rng.normal(size=(6, 14))
    r, c = rows.astype(int), columns.astype(int)
    fr, fc = (rows - r)[:, None], (columns - c)[None, :]
    smooth = (
        coarse[r][:, c] * (1 - fr) * (1 - fc)
        + coarse[r + 1][:, c] * fr * (1 - fc)
        + coarse[r][:, c + 1] * (1 - fr) * fc
        + coarse[r + 1][:, c + 1] * fr * fc
    )
    noise = DEPTH_NOISE * (rng.normal(size=shape) + smooth) / np.sqrt(2)
    return noise + np.where(rng.random(shape) < OUTLIERS, rng.uniform(0.2, 1.5, shape), 0.0)


def errors(got: Sim3, truth: Sim3, at: np.ndarray, j_per_metre: float) -> tuple[float, float, float]:
    """Rotation (degrees), translation at a point of frame j (metres), scale (%)."""
    delta = got @ truth.inverse()
    return (
        float(np.degrees(np.linalg.norm(se3.so3_log(delta.rotation)))),
        float(np.linalg.norm(delta.act(at) - at)) / j_per_metre,
        100.0 * abs(float(np.log(delta.scale))),
    )


def cost(function: Callable[[], object], repeats: int) -> float:
    """Median processor time of a call, seconds."""
    function()
    times = []
    for _ in range(repeats):
        started = time.process_time()
        function()
        times.append(time.process_time() - started)
    return float(np.median(times))


def points_of(frames: list[SharedFrame]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of both sides (N, 3) and depth (N,), float32, all pixels."""
    sides = [
        np.concatenate([se3.act(v.submap_from_camera, unproject(v.depth, CAMERA)).reshape(-1, 3) for v in views])
        for views in ([f.in_i for f in frames], [f.in_j for f in frames])
    ]
    depth = np.concatenate([f.in_j.depth.ravel() for f in frames])
    return sides[0].astype(np.float32), sides[1].astype(np.float32), depth


def fixed_passes(
    estimator: Callable[..., tuple[Callable[[], Sim3Estimate], int]], one: list[SharedFrame], full: list[SharedFrame]
) -> tuple[float, float]:
    """Seconds of one anchor and of the whole overlap, with the same number of passes over all points."""
    kept = estimation._CONVERGED
    estimation._CONVERGED = 0.0
    try:
        calls = [estimator(frames, max_iterations=FIXED_PASSES)[0] for frames in (one, full)]
        assert all(call().iterations == FIXED_PASSES for call in calls)
        return cost(calls[0], 40), cost(calls[1], 5)
    finally:
        estimation._CONVERGED = kept


def bench_cost() -> None:
    frames, truth, _ = overlap(0)
    config = RegistrationConfig(confidence_value=0.0)
    middle = [frames[OVERLAP // 2]]
    start = sim3.exp(np.random.default_rng(1).normal(0, 0.02, 7)) @ truth

    def estimator(chosen: list[SharedFrame], **changes: int) -> tuple[Callable[[], Sim3Estimate], int]:
        settings = config.model_copy(update=changes)
        x, y, depth = points_of(chosen)
        weights = np.ones(len(x), np.float32)
        return lambda: estimate_sim3(x, y, weights, depth, start, settings, frame_count=len(chosen)), len(x)

    one, one_points = estimator(middle)
    full, full_points = estimator(frames)
    x, y, depth = points_of(middle)
    one_s, full_s = cost(one, 40), cost(full, 5)
    iterations, full_iterations = one().iterations, full().iterations
    passes = iterations + 2  # gathering, the iterations, the score
    fixed_s, fixed_full_s = fixed_passes(estimator, middle, frames)
    read_s = cost(lambda: [array.sum() for _ in range(passes) for array in (x, y, depth, depth)], 40)
    print("\nEstimator alone (closed form re-weighted until it stands still, 7x7 information), one thread")
    print("| anchor | points | iterations | ms | times window1 |")
    print("|---|---:|---:|---:|---:|")
    print(f"| window1 | {one_points} | {iterations} | {1e3 * one_s:.2f} | 1 |")
    print(f"| full, {OVERLAP} frames | {full_points} | {full_iterations} | {1e3 * full_s:.1f} | {full_s / one_s:.1f} |")
    print(f"| window1 | {one_points} | exactly {FIXED_PASSES} | {1e3 * fixed_s:.2f} | 1 |")
    print(
        f"| full, {OVERLAP} frames | {full_points} | exactly {FIXED_PASSES} | {1e3 * fixed_full_s:.1f} "
        f"| {fixed_full_s / fixed_s:.1f} |"
    )
    print(
        f"Reading the arrays {passes} times: {1e3 * read_s:.2f} ms; window1 takes {one_s / read_s:.1f} times as long."
    )

    spec = RegistrationSpec(0, 1, 1, 1, ConstraintKind.ADJACENT, tuple(frame.keyframe_id for frame in frames))
    print("\nWhole registration from depth maps (masks, unprojection, start, estimate, cameras), one thread")
    print("| anchor | ms | times window1 |")
    print("|---|---:|---:|")
    base = 0.0
    for anchor, repeats in (("window1", 20), ("window3", 10), ("window5", 5), ("full", 2)):
        chosen = config.model_copy(update={"anchor": anchor})
        seconds = cost(lambda chosen=chosen: register(spec, frames, chosen), repeats)  # type: ignore[misc]
        base = base or seconds
        print(f"| {anchor} | {1e3 * seconds:.1f} | {seconds / base:.1f} |")


def bench_accuracy(pairs: int, count: int) -> None:
    print(f"\nTransform error against truth, overlap of {count} frames, {pairs} pairs (RMS)")
    print("| anchor | estimate | rotation deg | translation m | scale % |")
    print("|---|---|---:|---:|---:|")
    baseline = {"residual": "absolute", "max_iterations": 5, "scale_rule": "least_squares"}
    rows: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    for seed in range(pairs):
        frames, truth, per_metre = overlap(seed, count)
        ids = tuple(frame.keyframe_id for frame in frames)
        spec = RegistrationSpec(0, 1, 1, 1, ConstraintKind.ADJACENT, ids)
        middle = count // 2
        at = frames[middle].in_j.submap_from_camera[:3, 3]
        for anchor, size in (("window1", 1), ("window3", 3), ("window5", 5), ("full", count)):
            low = max(0, middle - size // 2)
            chosen = frames[low : low + size]
            x, y, depth = points_of(chosen)
            for name, update in (("points", {}), ("points, peers' loss", baseline)):
                if update and anchor != "full":
                    continue
                config = RegistrationConfig(confidence_value=0.0).model_copy(update=update)
                start = sim3.exp(np.random.default_rng(seed).normal(0, 0.01, 7)) @ truth
                got = estimate_sim3(x, y, np.ones(len(x)), depth, start, config, frame_count=size)
                rows.setdefault((anchor, name), []).append(errors(got.j_from_i, truth, at, per_metre))
            constraint = register(spec, frames, RegistrationConfig(confidence_value=0.0, anchor=anchor))
            assert constraint.accepted and constraint.attempts[0].outcome == "accepted", constraint.reason
            rows.setdefault((anchor, "points and cameras"), []).append(
                errors(constraint.j_from_i, truth, at, per_metre)
            )
    for (anchor, name), values in sorted(rows.items(), key=lambda item: (item[0][1], len(item[0][0]), item[0][0])):
        rotation, translation, scale = np.sqrt(np.mean(np.square(values), axis=0))
        print(f"| {anchor} | {name} | {rotation:.3f} | {translation:.3f} | {scale:.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=8)
    arguments = parser.parse_args()
    print(f"depth noise {DEPTH_NOISE:.0%}, outliers {OUTLIERS:.0%}, bias at submap ends {BOUNDARY_BIAS:.0%}")
    bench_cost()
    bench_accuracy(arguments.pairs, OVERLAP)
    bench_accuracy(arguments.pairs, 5)


if __name__ == "__main__":
    main()
