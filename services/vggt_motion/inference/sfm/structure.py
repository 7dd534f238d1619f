"""Camera poses, points and focal length of one submap from matched features, by pycolmap's global mapping."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vggt_motion.inference.sfm.library import load_pycolmap

_LOG = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]
Pair = tuple[int, int]

_MIN_PAIR_MATCHES = 20
_EPIPOLAR_PX = 1.5


@dataclass(frozen=True)
class Structure:
    """A solved submap. Pixels are those of the working images; pixel centres lie at whole numbers."""

    camera_from_submap: dict[int, Array]  # position -> (4, 4)
    focal_px: float
    points: Array  # (P, 3), submap units
    observation_point: npt.NDArray[np.int64]  # (O,) index into points
    observation_position: npt.NDArray[np.int64]  # (O,) position of the frame
    observation_pixel: Array  # (O, 2)
    reprojection_px: float  # mean
    median_parallax_deg: float
    match_inlier_ratio: float  # of the matches that agree with the two-view geometry of their pair


def solve_global(
    points: Mapping[int, npt.NDArray[np.float32]],
    matches: Mapping[Pair, npt.NDArray[np.int64]],
    width_px: int,
    height_px: int,
    focal_px: float | None,
    is_focal_held: bool,
    seed: int,
) -> Structure | None:
    """Solve a submap by COLMAP's global mapping (GLOMAP); the same input gives the same bits.

    Args:
        points: position -> features (N, 2) in pixels.
        matches: pair of positions -> matched feature indices (M, 2).
        width_px: image width.
        height_px: image height.
        focal_px: start value, None to calibrate from the fundamental matrices.
        is_focal_held: do not refine the focal length.
        seed: of everything random.

    Returns:
        None where no model of at least three frames was found.
    """
    pycolmap: Any = load_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL
    pycolmap.set_random_seed(seed)
    positions = sorted(points)
    with tempfile.TemporaryDirectory(prefix="vggt-motion-sfm-") as folder:
        path = Path(folder) / "submap.db"
        matched, agreed = _write_database(pycolmap, path, points, matches, width_px, height_px, focal_px, seed)
        if focal_px is None:
            options = pycolmap.ViewGraphCalibrationOptions()
            options.random_seed = seed
            pycolmap.calibrate_view_graph(str(path), options)
        output = Path(folder) / "models"
        output.mkdir()
        try:
            models = pycolmap.global_mapping(
                str(path), folder, str(output), _mapping_options(pycolmap, seed, is_focal_held)
            )
        except (RuntimeError, ValueError) as error:
            _LOG.info("global mapping gave up: %s", " ".join(str(error).split()))
            return None
    usable = [model for model in models.values() if model.num_reg_images() >= 3 and model.num_points3D() >= 20]
    if not usable:
        return None
    model = max(usable, key=lambda candidate: (candidate.num_reg_images(), candidate.num_points3D()))
    return _read_model(model, positions, agreed / max(matched, 1))


def _write_database(
    pycolmap: Any,
    path: Path,
    points: Mapping[int, npt.NDArray[np.float32]],
    matches: Mapping[Pair, npt.NDArray[np.int64]],
    width_px: int,
    height_px: int,
    focal_px: float | None,
    seed: int,
) -> tuple[int, int]:
    """Fill the database; returns how many matches there were and how many agreed with their pair's geometry."""
    start = focal_px if focal_px is not None else 0.9 * width_px
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId.SIMPLE_PINHOLE, start, width_px, height_px)
    camera.has_prior_focal_length = focal_px is not None
    database = pycolmap.Database.open(str(path))
    matched = agreed = 0
    try:
        database.write_camera(camera, True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, True)
        colmap_points = {position: pixels.astype(np.float64) + 0.5 for position, pixels in points.items()}
        for position in sorted(points):
            image = pycolmap.Image(name=f"{position:06d}", camera_id=1, image_id=position + 1)
            image.frame_id = position + 1
            frame = pycolmap.Frame(frame_id=position + 1, rig_id=1)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, True)
            database.write_image(image, True)
            database.write_keypoints(position + 1, colmap_points[position].astype(np.float32))
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.max_error = _EPIPOLAR_PX
        options.ransac.random_seed = seed
        options.compute_relative_pose = True
        options.detect_watermark = False
        for (a, b), pair_matches in sorted(matches.items()):
            if len(pair_matches) < _MIN_PAIR_MATCHES:
                continue
            indices = pair_matches.astype(np.uint32)
            geometry = pycolmap.estimate_two_view_geometry(
                camera, colmap_points[a], camera, colmap_points[b], indices, options
            )
            matched += len(indices)
            agreed += len(geometry.inlier_matches)
            database.write_matches(a + 1, b + 1, indices)
            database.write_two_view_geometry(a + 1, b + 1, geometry)
    finally:
        database.close()
    return matched, agreed


def _mapping_options(pycolmap: Any, seed: int, is_focal_held: bool) -> Any:
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = 1
    options.random_seed = seed
    mapper = options.mapper
    mapper.num_threads = 1
    mapper.random_seed = seed
    mapper.rotation_averaging.random_seed = seed
    mapper.global_positioning.random_seed = seed
    mapper.global_positioning.use_gpu = False
    mapper.retriangulation.random_seed = seed
    mapper.bundle_adjustment.ceres.use_gpu = False
    mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    mapper.bundle_adjustment.refine_focal_length = not is_focal_held
    return options


def _read_model(model: Any, positions: Sequence[int], match_inlier_ratio: float) -> Structure:
    poses: dict[int, Array] = {}
    for image_id in sorted(model.reg_image_ids()):
        pose = np.eye(4)
        pose[:3] = model.image(image_id).cam_from_world().matrix()
        poses[image_id - 1] = pose
    point_ids = sorted(model.points3D)
    points = np.array([model.points3D[point_id].xyz for point_id in point_ids])
    rows: list[tuple[int, int, float, float]] = []
    errors: list[float] = []
    for index, point_id in enumerate(point_ids):
        point = model.points3D[point_id]
        errors.append(float(point.error))
        for element in point.track.elements:
            pixel = model.image(element.image_id).points2D[element.point2D_idx].xy
            rows.append((index, element.image_id - 1, float(pixel[0]) - 0.5, float(pixel[1]) - 0.5))
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    observed_point = table[:, 0].astype(np.int64)
    position = table[:, 1].astype(np.int64)
    return Structure(
        camera_from_submap=poses,
        focal_px=float(next(iter(model.cameras.values())).focal_length),
        points=points,
        observation_point=observed_point,
        observation_position=position,
        observation_pixel=table[:, 2:].copy(),
        reprojection_px=float(np.mean(errors)),
        median_parallax_deg=_median_parallax_deg(points, poses, observed_point, position),
        match_inlier_ratio=match_inlier_ratio,
    )


def _median_parallax_deg(
    points: Array, poses: Mapping[int, Array], index: npt.NDArray[np.int64], position: npt.NDArray[np.int64]
) -> float:
    """Median over the points of the angle between the rays of the first and the last frame that see each."""
    centres = np.zeros((max(poses) + 1, 3))
    for key, pose in poses.items():
        centres[key] = -pose[:3, :3].T @ pose[:3, 3]
    first = np.full(len(points), np.iinfo(np.int64).max)
    last = np.full(len(points), -1)
    np.minimum.at(first, index, position)
    np.maximum.at(last, index, position)
    ray_a, ray_b = points - centres[first], points - centres[last]
    cosine = (ray_a * ray_b).sum(axis=1) / np.maximum(
        np.linalg.norm(ray_a, axis=1) * np.linalg.norm(ray_b, axis=1), 1e-12
    )
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))
