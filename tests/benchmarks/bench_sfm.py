"""The default predictor by itself: accuracy and time per submap, beside COLMAP's incremental mapping; its confidence.

    python tests/benchmarks/bench_sfm.py [SEQUENCE ...] [--no-colmap] [--no-depth]

Three tables: every submap of the sequences with ground truth (error of the keyframes' positions after Sim(3) alignment
as a share of the path, error of the rotation from first to last, focal length, seconds per stage); the same
keyframes at the same size by SIFT, sequential matching and pycolmap's incremental mapping on one thread; and the
relative error of depth against confidence, by the depth camera of 7-Scenes, whose place beside the colour camera is
fitted on keyframes that the table leaves out.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from vggt_motion.bus.depth import decode_depth
from vggt_motion.config import Config
from vggt_motion.evaluation.offline import OfflineRun, run_offline
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import unproject
from vggt_motion.inference.sfm.images import fitted_size, reduce_image
from vggt_motion.inference.sfm.library import load_pycolmap
from vggt_motion.records import SubmapGeometry

Array = npt.NDArray[np.float64]

DATA = Path(os.environ.get("VGGT_MOTION_DATA", Path(__file__).resolve().parents[2].parent / "shared" / "data"))
SEQUENCES = ("kitti_06_first51", "kitti_01_first51", "kitti_00_first200", "redkitchen_first400")
DEPTH_SEQUENCE = "redkitchen_first400"
DEPTH_STRIDE = 4  # every fourth frame has a reference
SMOOTH_WINDOW = np.ones((9, 9), dtype=np.uint8)
CONFIDENCE_EDGES = (0.001, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.01)


@dataclass(frozen=True)
class Alignment:
    """Positions after the best similarity."""

    rmse: float
    path: float


def align(estimated: Array, truth: Array) -> Alignment:
    """Of positions (N, 3) (Umeyama 1991)."""
    a, b = estimated - estimated.mean(axis=0), truth - truth.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = float((s * signs).sum() / max((a**2).sum(), 1e-12))
    errors = np.linalg.norm(scale * a @ (u * signs @ vt).T - b, axis=1)
    return Alignment(float(np.sqrt((errors**2).mean())), float(np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()))


def truth_of(location: Path) -> Array:
    """Poses (N, 4, 4)."""
    rows = np.loadtxt(location / "poses.txt").reshape(-1, 3, 4)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows
    return poses


def frame_index(keyframe_id: str) -> int:
    return int(keyframe_id.rsplit("/", 1)[1])


def submap_row(geometry: SubmapGeometry, truth: Array) -> str:
    quality = geometry.quality
    poses = [frame.submap_from_camera for frame in geometry.frames]
    exact = [truth[frame_index(frame.keyframe_id)] for frame in geometry.frames]
    error, turned, path = math.nan, math.nan, math.nan
    if len(poses) >= 3:
        aligned = align(np.stack([p[:3, 3] for p in poses]), np.stack([p[:3, 3] for p in exact]))
        error, path = 100.0 * aligned.rmse / max(aligned.path, 1e-9), aligned.path
        estimated = poses[0][:3, :3].T @ poses[-1][:3, :3]
        wanted = exact[0][:3, :3].T @ exact[-1][:3, :3]
        turned = math.degrees(float(np.linalg.norm(se3.so3_log(estimated.T @ wanted))))
    seconds = geometry.stage_seconds
    return (
        f"  {geometry.spec.submap_index:>3} r{geometry.spec.revision} {len(geometry.spec.keyframe_ids):>3} "
        f"{geometry.verdict.value:>13} {path:>8.2f} {error:>7.2f} {turned:>6.2f} "
        f"{quality.focal_over_width:>7.4f} {100 * quality.focal_relative_sigma:>6.1f} {quality.radial_k1:>7.3f} "
        f"{quality.mean_reprojection_error_px:>6.2f} {100 * quality.track_inlier_ratio:>5.0f} "
        f"{seconds.get('tracks_s', 0.0):>6.2f} {seconds.get('structure_s', 0.0):>6.2f} "
        f"{seconds.get('depth_s', 0.0):>6.2f} {len(quality.attempts):>4}"
    )


def report_submaps(name: str, run: OfflineRun, truth: Array) -> None:
    print(f"\n{name}: submaps")
    print(
        "  index    n       verdict   path m  error%  rot d   focal  +-%      k1     px  fit% tracks struct  depth ways"
    )
    for _, geometry in sorted(run.state.submaps.items()):
        print(submap_row(geometry, truth))


def compare_with_colmap(name: str, run: OfflineRun, truth: Array, config: Config) -> None:
    """Side by side: our whole method on this sequence, and incremental mapping of the same keyframes."""
    keyframes = sorted(run.state.keyframes.values(), key=lambda keyframe: keyframe.frame_index)
    images = {
        keyframe.frame_index: np.asarray(
            cv2.imdecode(np.frombuffer(run.blobs[keyframe.image.sha256], np.uint8), cv2.IMREAD_GRAYSCALE),
            dtype=np.uint8,
        )
        for keyframe in keyframes
    }
    seconds, centres = incremental(images, config.inference.sfm.width_px)
    ours = {
        frame.frame_index: np.asarray(frame.world_from_camera[:3, 3])
        for frame in run.trajectory.frames
        if frame.frame_index in images
    }
    print(f"\n{name}: {len(images)} keyframes            registered  seconds     ATE m (keyframes)")
    lines = []
    for label, spent, found in (
        ("this predictor and the pose graph", sum(run.seconds.values()), ours),
        ("SIFT + pycolmap incremental mapping", seconds, centres),
    ):
        shared = sorted(found)
        error = math.nan
        if len(shared) >= 3:
            error = align(np.stack([found[k] for k in shared]), np.stack([truth[k][:3, 3] for k in shared])).rmse
        lines.append((float(len(shared)), spent, error))
        print(f"  {label:<38} {len(shared):>6} {spent:>10.1f} {error:>12.3f}")
    (registered, spent, error), (their_registered, their_spent, their_error) = lines
    print(
        f"  {'ratio, theirs over ours':<38} {their_registered / max(registered, 1.0):>6.2f} "
        f"{their_spent / spent:>10.1f} {their_error / error:>12.2f}"
    )


def decoded(encoded: bytes) -> npt.NDArray[np.uint8]:
    """Grey image (H, W)."""
    return np.asarray(cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def incremental(images: Mapping[int, npt.NDArray[np.uint8]], width_px: int) -> tuple[float, dict[int, Array]]:
    """Seconds and camera centres (3,) of the largest model of pycolmap's own pipeline, one thread."""
    pycolmap: Any = load_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "images").mkdir()
        for index, image in images.items():
            height, width = image.shape
            size = fitted_size(width, height, width_px)
            cv2.imwrite(str(folder / "images" / f"{index:08d}.png"), reduce_image(image, *size))
        begin = time.perf_counter()
        database = folder / "database.db"
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.num_threads, extraction.use_gpu = 1, False
        pycolmap.extract_features(
            database, folder / "images", camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=extraction
        )
        matching = pycolmap.FeatureMatchingOptions()
        matching.num_threads, matching.use_gpu = 1, False
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap, pairing.quadratic_overlap = 6, False
        pycolmap.match_sequential(database, matching_options=matching, pairing_options=pairing)
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads, options.random_seed = 1, 0
        (folder / "models").mkdir()
        models = pycolmap.incremental_mapping(database, folder / "images", folder / "models", options)
        seconds = time.perf_counter() - begin
        if not models:
            return seconds, {}
        model = max(models.values(), key=lambda candidate: candidate.num_reg_images())
        centres = {}
        for image_id in model.reg_image_ids():
            image = model.image(image_id)
            centres[int(Path(image.name).stem)] = np.asarray(image.projection_center())
        return seconds, centres


@dataclass(frozen=True)
class Sample:
    """Depth of one keyframe beside the reference: a row per pixel, colour camera frame, submap units."""

    points: Array  # (N, 3)
    confidence: Array  # (N,)
    reference_m: npt.NDArray[np.float32]  # (H, W) of the depth camera, 0 where it is unknown or not smooth


def samples_of(run: OfflineRun, location: Path) -> list[Sample]:
    """Every keyframe of a run over every fourth frame, the ones that have a reference."""
    samples = []
    for geometry in run.state.usable_submaps().values():
        for keyframe_id in geometry.spec.base_keyframe_ids:
            frame = geometry.frame(keyframe_id)
            file = location / "depth" / f"{DEPTH_STRIDE * frame_index(keyframe_id):06d}.png"
            if frame is None or not file.is_file():
                continue
            depth, confidence = decode_depth(run.blobs[frame.depth.sha256])
            reference = cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000.0
            low, high = cv2.erode(reference, SMOOTH_WINDOW), cv2.dilate(reference, SMOOTH_WINDOW)
            reference[(low < 0.3) | (high > 20.0) | (high > 1.1 * low)] = 0.0
            known = depth > 0.0
            points = unproject(depth, frame.intrinsics)[known]
            samples.append(Sample(points, confidence[known].astype(np.float64), reference))
    return samples


def relative_errors(sample: Sample, mounting: Array, rounds: int = 4) -> tuple[Array, Array] | None:
    """Relative error of depth and confidence of the pixels that the depth camera sees; None where they are too few.

    Args:
        sample: of one keyframe.
        mounting: (6,) rotation vector and translation in metres, depth camera from colour camera.
        rounds: of the search for the scale of the keyframe, by which the movement depends on depth.
    """
    turned = sample.points @ se3.so3_exp(mounting[:3]).T
    height, width = sample.reference_m.shape
    scale = (
        1.0 / max(float(np.median(turned[:, 2])), 1e-9) * float(np.median(sample.reference_m[sample.reference_m > 0]))
    )
    for _ in range(rounds + 1):
        moved = scale * turned + mounting[3:]
        z = np.maximum(moved[:, 2], 1e-3)
        # 585 px is the depth camera's own focal length (README of the data set)
        u = np.rint(585.0 * moved[:, 0] / z + 319.5).astype(np.int64)
        v = np.rint(585.0 * moved[:, 1] / z + 239.5).astype(np.int64)
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        reference = np.where(inside, sample.reference_m[np.where(inside, v, 0), np.where(inside, u, 0)], 0.0)
        seen = reference > 0.0
        confident = seen & (sample.confidence > 0.5)
        if confident.sum() < 200:
            return None
        scale *= float(np.median(reference[confident] / z[confident]))
    return np.abs(z[seen] / reference[seen] - 1.0), sample.confidence[seen]


def fitted_mounting(samples: list[Sample]) -> Array:
    """How the depth camera sits beside the colour camera (6,), which the data set does not say."""
    thinned = [Sample(s.points[::23], s.confidence[::23], s.reference_m) for s in samples]

    def cost(mounting: Array) -> float:
        found = [errors for sample in thinned if (errors := relative_errors(sample, mounting)) is not None]
        return float(np.mean([np.minimum(error[c > 0.6], 0.1).mean() for error, c in found])) if found else 1.0

    mounting = np.zeros(6)
    for _ in range(2):
        simplex = np.vstack([mounting, mounting + np.diag([0.02, 0.02, 0.02, 0.03, 0.03, 0.03])])
        mounting = minimize(cost, mounting, method="Nelder-Mead", options={"initial_simplex": simplex}).x
    return np.asarray(mounting)


def report_depth(location: Path) -> None:
    """Relative error of depth by confidence, where the reference is smooth.

    The depth camera looks past the colour camera by degrees. How it is mounted is fitted on every second keyframe, by
    pixels of whatever error; the table is of the others.
    """
    samples = samples_of(run_offline(str(location), Config(), stride=DEPTH_STRIDE), location)
    if len(samples) < 4:
        print("too few frames with reference depth")
        return
    mounting = fitted_mounting(samples[::2])
    found = [errors for sample in samples[1::2] if (errors := relative_errors(sample, mounting)) is not None]
    error, confidence = (np.concatenate([pair[k] for pair in found]) for k in range(2))
    turned = np.degrees(np.linalg.norm(mounting[:3]))
    print(f"\n{location.name}: relative error of depth by confidence, {len(found)} frames, {len(error)} pixels")
    print(f"  depth camera turned by {turned:.1f} degrees, fitted on {len(samples[::2])} other frames")
    print("  confidence     share   median     84%     95%   above 10%")
    for low, high in itertools.pairwise(CONFIDENCE_EDGES):
        some = error[(confidence >= low) & (confidence < high)]
        if len(some) > 100:
            print(
                f"  {low:.2f} - {min(high, 1.0):.2f} {len(some) / len(error):>8.3f} {np.median(some):>8.4f} "
                f"{np.percentile(some, 84):>7.4f} {np.percentile(some, 95):>7.4f} {(some > 0.1).mean():>8.3f}"
            )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequences", nargs="*", default=SEQUENCES)
    parser.add_argument("--no-colmap", action="store_true", help="leave out the comparison, which takes minutes")
    parser.add_argument("--no-depth", action="store_true")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    config = Config()
    for name in arguments.sequences:
        location = DATA / name
        if not (location / "poses.txt").is_file():
            print(f"{name}: no such sequence with ground truth, left out (set VGGT_MOTION_DATA)")
            continue
        run, truth = run_offline(str(location), config), truth_of(location)
        report_submaps(name, run, truth)
        if not arguments.no_colmap:
            compare_with_colmap(name, run, truth, config)
        if name == DEPTH_SEQUENCE and not arguments.no_depth:
            report_depth(location)
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
