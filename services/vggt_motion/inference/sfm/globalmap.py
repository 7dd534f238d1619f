"""Another way to first poses: COLMAP's global mapping (GLOMAP), all cameras at once.

Slower than growing the submap frame by frame, and no better where both work; but it does not depend on an order in
which frames are placed, so it is tried where growth leaves doubts.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vggt_motion.inference.sfm.library import load_pycolmap
from vggt_motion.inference.sfm.tracks import Tracks

_LOG = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

_REACH = 4  # frames apart of the pairs whose geometry is estimated
_MIN_PAIR_MATCHES = 20
_EPIPOLAR_PX = 1.5


@dataclass(frozen=True)
class Placed:
    """Poses of the registered frames and the focal length in pixels."""

    camera_from_submap: dict[int, Array]  # position -> (4, 4)
    focal_px: float


def place(
    tracks: Tracks,
    positions: Sequence[int],
    width_px: int,
    height_px: int,
    focal_px: float,
    principal_px: tuple[float, float],
    is_known: bool,
    seed: int,
) -> Placed | None:
    """Place the frames; the same input gives the same bits (one thread, every seed set).

    Args:
        tracks: through the frames at ``positions``.
        positions: the frames.
        width_px: image width.
        height_px: image height.
        focal_px: start value.
        principal_px: principal point relative to the middle of the image.
        is_known: whether it may be trusted; if not it is calibrated from the fundamental matrices first.
        seed: of everything random.

    Returns:
        None where no model of at least three frames was found.
    """
    pycolmap: Any = load_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL
    pycolmap.set_random_seed(seed)
    with tempfile.TemporaryDirectory(prefix="vggt-motion-sfm-") as folder:
        path = Path(folder) / "submap.db"
        _write_database(pycolmap, path, tracks, positions, width_px, height_px, focal_px, principal_px, is_known, seed)
        output = Path(folder) / "models"
        output.mkdir()
        try:
            if not is_known:
                options = pycolmap.ViewGraphCalibrationOptions()
                options.random_seed = seed
                pycolmap.calibrate_view_graph(str(path), options)
            models = pycolmap.global_mapping(str(path), folder, str(output), _mapping_options(pycolmap, seed))
        except (RuntimeError, ValueError) as error:
            _LOG.info("global mapping gave up: %s", " ".join(str(error).split()))
            return None
    usable = [model for model in models.values() if model.num_reg_images() >= 3]
    if not usable:
        return None
    model = max(usable, key=lambda candidate: (candidate.num_reg_images(), candidate.num_points3D()))
    poses = {}
    for image_id in sorted(model.reg_image_ids()):
        pose = np.eye(4)
        pose[:3] = model.image(image_id).cam_from_world().matrix()
        poses[image_id - 1] = pose
    return Placed(poses, float(next(iter(model.cameras.values())).focal_length))


def _write_database(
    pycolmap: Any,
    path: Path,
    tracks: Tracks,
    positions: Sequence[int],
    width_px: int,
    height_px: int,
    focal_px: float,
    principal_px: tuple[float, float],
    is_known: bool,
    seed: int,
) -> None:
    model = pycolmap.CameraModelId.SIMPLE_PINHOLE
    camera = pycolmap.Camera.create_from_model_id(1, model, focal_px, width_px, height_px)
    camera.principal_point_x += principal_px[0]
    camera.principal_point_y += principal_px[1]
    camera.has_prior_focal_length = is_known
    rows = {position: np.flatnonzero(tracks.frame == position) for position in positions}
    # COLMAP has the corner of the first pixel at the origin, we its centre
    pixels = {position: tracks.pixel[rows[position]] + 0.5 for position in positions}
    database = pycolmap.Database.open(str(path))
    try:
        database.write_camera(camera, True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, True)
        for position in positions:
            image = pycolmap.Image(name=f"{position:06d}", camera_id=1, image_id=position + 1)
            image.frame_id = position + 1
            frame = pycolmap.Frame(frame_id=position + 1, rig_id=1)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, True)
            database.write_image(image, True)
            database.write_keypoints(position + 1, pixels[position].astype(np.float32))
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.max_error = _EPIPOLAR_PX
        options.ransac.random_seed = seed
        options.compute_relative_pose = True
        options.detect_watermark = False
        for index, a in enumerate(positions):
            for b in positions[index + 1 : index + 1 + _REACH]:
                _, in_a, in_b = np.intersect1d(
                    tracks.point[rows[a]], tracks.point[rows[b]], assume_unique=True, return_indices=True
                )
                if len(in_a) < _MIN_PAIR_MATCHES:
                    continue
                matches = np.stack([in_a, in_b], axis=1).astype(np.uint32)
                geometry = pycolmap.estimate_two_view_geometry(camera, pixels[a], camera, pixels[b], matches, options)
                database.write_matches(a + 1, b + 1, matches)
                database.write_two_view_geometry(a + 1, b + 1, geometry)
    finally:
        database.close()


def _mapping_options(pycolmap: Any, seed: int) -> Any:
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
    return options
