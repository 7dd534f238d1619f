"""Ways to find corresponding points between keyframes, held against the epipolar geometry of the true poses.

    python tests/benchmarks/bench_correspondences.py [SEQUENCE ...]

The keyframes are those that the frontend takes, at the predictor's working width, in groups as long as a submap. For
each step between neighbours, in turns and straight on: how many matches, which share lies within 1.5 px of the true
epipolar line (the poses and the given intrinsics know nothing of images; a random match lies there in one of about
fifty cases), and how many of the image's 60 parts hold three right ones. A weak step decides over a submap, so the
worst tenth is shown beside the median. Milliseconds are for a step, everything that images share counted once.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parent))
from bench_sfm import DATA, truth_of
from derived_sequences import KITTI_CAMERAS

from vggt_motion.config import Config
from vggt_motion.frontend.pipeline import FrontendPipeline
from vggt_motion.inference.predictor import KeyframeImage
from vggt_motion.inference.sfm import images, tracks
from vggt_motion.sources.registry import open_source

Array = npt.NDArray[np.float64]
Pairs = list[tuple[Array, Array]]  # per step, pixels (M, 2) in the first and in the second image

CAMERAS = {**KITTI_CAMERAS, "redkitchen_first400": (585.0, 320.0, 240.0)}  # the data sets' own
GROUP = 17  # keyframes of a submap
EPIPOLAR_PX = 1.5
TURN_DEG = 3.0  # over one step
PARTS_ACROSS, PARTS_DOWN, MIN_IN_PART = 12, 5, 3
LK_LEVELS = 4
ROUND_TRIP_PX = 0.7
ORB_FEATURES = 2000
RATIO = 0.85


def of_tracks(found: tracks.Tracks, count: int) -> Pairs:
    return [found.between(a, a + 1)[1:] for a in range(count - 1)]


def followed(working: images.WorkingImages) -> Pairs:
    return of_tracks(tracks.follow(working, range(len(working.grey))), len(working.grey))


def matched(working: images.WorkingImages) -> Pairs:
    return of_tracks(tracks.match(working, range(len(working.grey)), 1), len(working.grey))


def pyramid_only(working: images.WorkingImages) -> Pairs:
    """Lucas and Kanade over an image pyramid, there and back, without a guess from dense flow."""
    pairs = []
    for a, b in itertools.pairwise(working.grey):
        corners = cv2.goodFeaturesToTrack(a, 900, 0.005, 7, blockSize=5)
        there, found, _ = cv2.calcOpticalFlowPyrLK(a, b, corners, None, winSize=(15, 15), maxLevel=LK_LEVELS)
        back, returned, _ = cv2.calcOpticalFlowPyrLK(b, a, there, None, winSize=(15, 15), maxLevel=LK_LEVELS)
        keep = (found.ravel() > 0) & (returned.ravel() > 0)
        keep &= np.linalg.norm((back - corners).reshape(-1, 2), axis=1) < ROUND_TRIP_PX
        pairs.append((corners.reshape(-1, 2)[keep].astype(np.float64), there.reshape(-1, 2)[keep].astype(np.float64)))
    return pairs


def orb(working: images.WorkingImages) -> Pairs:
    """ORB, mutual matches that pass the ratio test."""
    detector = cv2.ORB_create(ORB_FEATURES)
    features = [detector.detectAndCompute(grey, None) for grey in working.grey]
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    pairs = []
    for (points_a, a), (points_b, b) in itertools.pairwise(features):
        back = {match.queryIdx: match.trainIdx for match in matcher.match(b, a)}
        good = [
            best
            for best, second in matcher.knnMatch(a, b, k=2)
            if best.distance < RATIO * second.distance and back[best.trainIdx] == best.queryIdx
        ]
        pairs.append(
            (
                np.array([points_a[match.queryIdx].pt for match in good]).reshape(-1, 2),
                np.array([points_b[match.trainIdx].pt for match in good]).reshape(-1, 2),
            )
        )
    return pairs


WAYS: dict[str, Callable[[images.WorkingImages], Pairs]] = {
    "corners, dense flow, Lucas-Kanade (ours)": followed,
    "SIFT, epipolar check (ours where those break)": matched,
    "corners, Lucas-Kanade over a pyramid": pyramid_only,
    "ORB, mutual, ratio test": orb,
}


def keyframes_of(location: Path) -> list[tuple[int, KeyframeImage]]:
    """The frontend's choice: frame indices and images."""
    indices: list[int] = []
    pipeline = FrontendPipeline(
        Config().frontend,
        "front",
        on_trace=lambda trace: indices.append(trace.frame_index) if trace.is_keyframe else None,
    )
    encoded = {}
    for frame in open_source(str(location)).frames():
        encoded[frame.index] = frame.encoded
        pipeline.push(frame)
    pipeline.finish()
    decoded = {index: cv2.imdecode(np.frombuffer(encoded[index], np.uint8), cv2.IMREAD_COLOR_RGB) for index in indices}
    return [(index, KeyframeImage(str(index), 0, np.asarray(decoded[index], dtype=np.uint8))) for index in indices]


def camera_of(location: Path, working: images.WorkingImages, width_px: int) -> Array:
    """The given intrinsics (3, 3) at the working size."""
    focal, cx, cy = CAMERAS[location.name]
    scale = working.width_px / width_px
    return np.array(
        [
            [scale * focal, 0.0, scale * (cx + 0.5) - 0.5],
            [0.0, scale * focal, scale * (cy + 0.5) - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )


def is_right(
    at_a: Array, at_b: Array, world_from_a: Array, world_from_b: Array, camera: Array
) -> npt.NDArray[np.bool_]:
    """Which matches lie on the true epipolar lines, by the Sampson distance (Hartley and Zisserman, 11.4.3)."""
    b_from_a = np.linalg.inv(world_from_b) @ world_from_a
    x, y, z = b_from_a[:3, 3]
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    inverse = np.linalg.inv(camera)
    fundamental = inverse.T @ skew @ b_from_a[:3, :3] @ inverse
    ones = np.ones((len(at_a), 1))
    a, b = np.hstack([at_a, ones]), np.hstack([at_b, ones])
    line_b, line_a = a @ fundamental.T, b @ fundamental
    gradient = np.sqrt((line_b[:, :2] ** 2).sum(axis=1) + (line_a[:, :2] ** 2).sum(axis=1))
    return np.asarray(np.abs((b * line_b).sum(axis=1)) < EPIPOLAR_PX * gradient)


def covered_parts(at: Array, working: images.WorkingImages) -> int:
    """Parts of the image with enough points."""
    counts, *_ = np.histogram2d(
        at[:, 0], at[:, 1], (PARTS_ACROSS, PARTS_DOWN), ((0, working.width_px), (0, working.height_px))
    )
    return int((counts >= MIN_IN_PART).sum())


def report(location: Path) -> None:
    """One table."""
    truth = truth_of(location)
    chosen = keyframes_of(location)
    rows: dict[tuple[str, str], list[tuple[float, float, float, float]]] = {}
    for begin in range(0, len(chosen) - 1, GROUP - 1):
        group = chosen[begin : begin + GROUP]
        working = images.prepare([image for _, image in group], None, Config().inference.sfm.width_px)
        camera = camera_of(location, working, group[0][1].pixels.shape[1])
        for name, way in WAYS.items():
            started = time.perf_counter()
            pairs = way(working)
            ms = 1e3 * (time.perf_counter() - started) / (len(group) - 1)
            for ((a, _), (b, _)), (at_a, at_b) in zip(itertools.pairwise(group), pairs, strict=True):
                turned = truth[a][:3, :3].T @ truth[b][:3, :3]
                degrees = np.degrees(np.arccos(np.clip(0.5 * (np.trace(turned) - 1.0), -1.0, 1.0)))
                right = is_right(at_a, at_b, truth[a], truth[b], camera)
                share = 100.0 * float(right.mean()) if len(right) else 0.0
                row = (float(right.sum()), share, float(covered_parts(at_a[right], working)), ms)
                rows.setdefault(("turning" if degrees > TURN_DEG else "straight", name), []).append(row)
    print(f"\n{location.name}: {len(chosen)} keyframes")
    print(f"  {'':>58} steps   right: median  worst 10%   share %   parts: median  worst 10%   ms a step")
    for (motion, name), found in sorted(rows.items(), key=lambda item: (item[0][0], list(WAYS).index(item[0][1]))):
        values = np.array(found)
        median, worst = np.median(values, axis=0), np.percentile(values, 10, axis=0)
        print(
            f"  {motion:>9} {name:<48} {len(found):>5} {median[0]:>15.0f} {worst[0]:>10.0f} {median[1]:>9.1f}"
            f" {median[2]:>15.0f} {worst[2]:>10.0f} {median[3]:>11.1f}"
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="*", default=list(CAMERAS))
    for name in parser.parse_args().sequences:
        report(DATA / name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
