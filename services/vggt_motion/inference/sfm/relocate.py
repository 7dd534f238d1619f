"""Loop keyframes placed in a solved submap (DESIGN 3.3): seen long before or after, so found again by features.

They take no part in the structure: a wrong injection then costs nothing but itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, undistort_rays
from vggt_motion.inference.sfm import bundle, features, growth
from vggt_motion.inference.sfm.bundle import Scene
from vggt_motion.inference.sfm.depth import DepthMap
from vggt_motion.inference.sfm.images import WorkingImages

Array = npt.NDArray[np.float64]

_MIN_CONFIDENCE = 0.2
_RANSAC_PX = 3.0
_INLIER_PX = 2.0
_MIN_INLIERS = 25
_MIN_INLIER_SHARE = 0.3


@dataclass(frozen=True)
class Located:
    """A loop keyframe in the submap."""

    camera_from_submap: Array  # (4, 4)
    points_camera: Array  # (N, 3) what it sees, in its own frame
    neighbours: tuple[int, ...]  # keyframes that share most with it, best first
    inlier_share: float


def locate(
    working: WorkingImages,
    loop_positions: Sequence[int],
    camera_from_submap: Mapping[int, Array],
    maps: Mapping[int, DepthMap],
    camera: Intrinsics,
    scene: Scene,
) -> dict[int, Located]:
    """Place loop keyframes by matches with the submap's own ones, whose depth is known.

    Args:
        working: images by position.
        loop_positions: what to place.
        camera_from_submap: poses of the submap's own keyframes.
        maps: their depth.
        camera: of the working images.
        scene: its shared camera is the one of ``camera``, relative to the middle of the image.

    Returns:
        The ones that were found; the others have nothing in common with the submap, or too little.
    """
    own = {position: features.detect(working.grey[position], working.usable) for position in sorted(maps)}
    located = {}
    for loop in loop_positions:
        detected = features.detect(working.grey[loop], working.usable)
        pixels, points, sources = _correspondences(detected, own, camera_from_submap, maps, camera)
        found = _resect(pixels, points, camera, scene)
        if found is None:
            continue
        pose, inliers = found
        owners, counts = np.unique(sources[inliers], return_counts=True)
        order = np.argsort(-counts, kind="stable")
        located[loop] = Located(
            camera_from_submap=pose,
            points_camera=se3.act(pose, points[inliers]),
            neighbours=tuple(int(owner) for owner in owners[order]),
            inlier_share=float(inliers.mean()),
        )
    return located


def _correspondences(
    detected: features.Features,
    own: Mapping[int, features.Features],
    camera_from_submap: Mapping[int, Array],
    maps: Mapping[int, DepthMap],
    camera: Intrinsics,
) -> tuple[Array, Array, npt.NDArray[np.int64]]:
    """Pixels (N, 2) of the loop keyframe, points (N, 3) in the submap, and the keyframe (N,) that tells their depth."""
    pixels, points, sources = [np.zeros((0, 2))], [np.zeros((0, 3))], [np.zeros(0, dtype=np.int64)]
    for position, theirs in own.items():
        rows = features.match(detected, theirs)
        if not len(rows):
            continue
        at = theirs.points[rows[:, 1]].astype(np.float64)
        depth, confidence = maps[position].depth, maps[position].confidence
        # areas of pixels aligned, as in Intrinsics.resized
        column = ((at[:, 0] + 0.5) * depth.shape[1] / camera.width_px).astype(np.int64)
        row = ((at[:, 1] + 0.5) * depth.shape[0] / camera.height_px).astype(np.int64)
        row, column = np.clip(row, 0, depth.shape[0] - 1), np.clip(column, 0, depth.shape[1] - 1)
        known = confidence[row, column] > _MIN_CONFIDENCE
        x, y = (at[known, 0] - camera.cx) / camera.fx, (at[known, 1] - camera.cy) / camera.fy
        x, y = undistort_rays(x, y, camera.k1, camera.k2)
        rays = np.column_stack([x, y, np.ones(len(x))])
        in_camera = rays * depth[row[known], column[known], None].astype(np.float64)
        pixels.append(detected.points[rows[known, 0]].astype(np.float64))
        points.append(se3.act(se3.inverse(camera_from_submap[position]), in_camera))
        sources.append(np.full(int(known.sum()), position, dtype=np.int64))
    return np.concatenate(pixels), np.concatenate(points), np.concatenate(sources)


def _resect(
    pixels: Array, points: Array, camera: Intrinsics, scene: Scene
) -> tuple[Array, npt.NDArray[np.bool_]] | None:
    if len(pixels) < _MIN_INLIERS:
        return None
    x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
    x, y = undistort_rays(x, y, camera.k1, camera.k2)
    rays = np.column_stack([x, y])
    cv2.setRNGSeed(0)  # the generator is the library's own and remembers earlier calls
    solved, vector, translation, _ = cv2.solvePnPRansac(
        points,
        rays,
        np.eye(3),
        None,
        iterationsCount=300,
        reprojectionError=_RANSAC_PX / camera.fx,
        confidence=0.999,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not solved:
        return None
    rotation = np.asarray(cv2.Rodrigues(vector)[0], dtype=np.float64)
    offset = np.asarray(translation, dtype=np.float64).ravel()
    middle = np.array([0.5 * (camera.width_px - 1), 0.5 * (camera.height_px - 1)])
    centred = pixels - middle
    # the refinement widens its kernel at first: start it from the points that the sample agrees with
    start = _errors(rotation, offset, points, centred, scene) < 2.0 * _RANSAC_PX
    if start.sum() < _MIN_INLIERS:
        return None
    _, rotation, moved = growth.refine_pose(
        rotation, offset, points[start], centred[start], scene.shared, growth.WIDE_TO_NARROW
    )
    inliers = _errors(rotation, moved, points, centred, scene) < _INLIER_PX
    if inliers.sum() < _MIN_INLIERS or inliers.mean() < _MIN_INLIER_SHARE:
        return None
    return se3.make(rotation, moved), inliers


def _errors(rotation: Array, translation: Array, points: Array, pixels: Array, scene: Scene) -> Array:
    """Reprojection errors (N,) in pixels."""
    moved = points @ rotation.T + translation
    z = np.where(moved[:, 2] > 1e-9, moved[:, 2], np.nan)
    x, y = moved[:, 0] / z, moved[:, 1] / z
    factor = scene.focal_px * bundle.radial_factor(scene, x * x + y * y)
    error = np.hypot(x * factor + scene.principal_u - pixels[:, 0], y * factor + scene.principal_v - pixels[:, 1])
    return np.asarray(np.where(np.isfinite(error), error, np.inf))
