"""The cameras of the shared frames as witnesses of the transform, beside their points.

Where two submaps agree on the focal length, points and cameras give the same transform. Where they do not, a depth
map seen through the wrong focal length is bent, and the similarity that fits it best turns and shifts the cameras off
each other; the chain of submaps then kinks at every edge. Measured on KITTI 00 with a focal length per submap that is
free: the rotation error of an edge falls from 3.3 to 0.9 degrees and no edge is refused, while edges of equal focal
length do not change (DESIGN 3.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vggt_motion.errors import RegistrationError
from vggt_motion.geometry import se3, sim3
from vggt_motion.geometry.sim3 import Sim3

Array = npt.NDArray[np.float64]

_MAX_FUSE_ITERATIONS = 10
_NEGLIGIBLE_DECREASE = 1e-8
# Standard deviations of a single camera within its submap: what too few cameras cannot tell, and the best that is
# believed.
_SIGMA_ROTATION_RAD = 0.005
_SIGMA_ROTATION_FLOOR_RAD = 1e-3
_SIGMA_CENTRE_OVER_DEPTH = 0.01
_SIGMA_CENTRE_FLOOR_OVER_BASELINE = 0.01
_MIN_SCATTER_CAMERAS = 3
# Where no depth map can be trusted, cameras that agree as well as this carry an edge alone.
_MAX_ALONE_ROTATION_RAD = 0.02
_MAX_ALONE_CENTRE_OVER_BASELINE = 0.05


@dataclass(frozen=True)
class CameraWitnesses:
    """Poses of the shared cameras in both submaps and how far they can be trusted."""

    i_from_camera: Array  # (K, 4, 4), units of submap i
    j_from_camera: Array  # (K, 4, 4), units of submap j
    sigma_rotation_rad: float  # of one camera and axis
    sigma_centre: float  # of one camera and axis, units of submap j


def mean_rotation(i_from_camera: Array, j_from_camera: Array) -> Array:
    """Rotation (3, 3) of ``j_from_i`` from cameras (K, 4, 4) that both submaps hold: the chordal mean."""
    return se3.nearest_rotation(np.einsum("kab,kcb->ac", j_from_camera[:, :3, :3], i_from_camera[:, :3, :3]))


def witnesses(
    i_from_camera: Sequence[Array], j_from_camera: Sequence[Array], typical_depth_j: float
) -> CameraWitnesses:
    """Judge the cameras by how well the two submaps agree on them, up to a similarity.

    Args:
        i_from_camera: K poses (4, 4) in submap i.
        j_from_camera: the same cameras in submap j.
        typical_depth_j: median depth of the points, units of submap j; the yardstick where cameras are too few.
    """
    in_i, in_j = np.array(i_from_camera), np.array(j_from_camera)
    count = len(in_i)
    rotation = mean_rotation(in_i, in_j)
    from_mean_i, from_mean_j = (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (in_i, in_j))
    spread_i, spread_j = (float(np.sqrt((centres**2).sum())) for centres in (from_mean_i, from_mean_j))
    if count < _MIN_SCATTER_CAMERAS or spread_i == 0.0 or spread_j == 0.0:
        return CameraWitnesses(in_i, in_j, _SIGMA_ROTATION_RAD, _SIGMA_CENTRE_OVER_DEPTH * typical_depth_j)
    turns = _rotation_errors(rotation, in_i, in_j)
    offsets = (spread_j / spread_i) * from_mean_i @ rotation.T - from_mean_j
    baseline = float(np.linalg.norm(from_mean_j, axis=1).max())
    return CameraWitnesses(
        in_i,
        in_j,
        max(float(np.sqrt((turns**2).sum() / (3 * count - 3))), _SIGMA_ROTATION_FLOOR_RAD),
        max(float(np.sqrt((offsets**2).sum() / (3 * count - 4))), _SIGMA_CENTRE_FLOOR_OVER_BASELINE * baseline),
    )


def align(i_from_camera: Sequence[Array], j_from_camera: Sequence[Array], *, fix_scale: bool) -> tuple[Sim3, Array]:
    """Transform and information (7, 7) from the cameras alone, the last resort before a trajectory breaks.

    Raises:
        RegistrationError: there are too few cameras, they do not move, or the submaps disagree on them.
    """
    if len(i_from_camera) < _MIN_SCATTER_CAMERAS:
        raise RegistrationError(f"{len(i_from_camera)} shared cameras, {_MIN_SCATTER_CAMERAS} are needed")
    in_i, in_j = np.array(i_from_camera), np.array(j_from_camera)
    centre_i, centre_j = (poses[:, :3, 3].mean(axis=0) for poses in (in_i, in_j))
    spread_i, spread_j = (
        float(np.sqrt(((poses[:, :3, 3] - centre) ** 2).sum()))
        for poses, centre in ((in_i, centre_i), (in_j, centre_j))
    )
    if not (spread_i > 0.0 and spread_j > 0.0):
        raise RegistrationError("the shared cameras do not move")
    scale = 1.0 if fix_scale else spread_j / spread_i
    rotation = mean_rotation(in_i, in_j)
    start = Sim3(rotation, centre_j - scale * (rotation @ centre_i), scale)
    judged = witnesses(i_from_camera, j_from_camera, spread_j)
    baseline = float(np.linalg.norm(in_j[:, :3, 3] - centre_j, axis=1).max())
    relative = judged.sigma_centre / baseline
    if judged.sigma_rotation_rad > _MAX_ALONE_ROTATION_RAD or relative > _MAX_ALONE_CENTRE_OVER_BASELINE:
        raise RegistrationError(
            f"the submaps disagree on the shared cameras by {np.degrees(judged.sigma_rotation_rad):.1f} degrees "
            f"and {100 * relative:.0f} % of their distance"
        )
    return fuse(start, np.zeros((7, 7)), judged, fix_scale=fix_scale)


def fuse(j_from_i: Sim3, information: Array, cameras: CameraWitnesses, *, fix_scale: bool) -> tuple[Sim3, Array]:
    """Weigh what the points say against what the cameras say (Gauss-Newton on the left perturbation).

    Args:
        j_from_i: estimate of the points.
        information: its (7, 7) information, frame j.
        cameras: the witnesses.
        fix_scale: keep the scale as it is.

    Returns:
        The transform of least total error, and the sum (7, 7) of both informations.
    """
    size = 6 if fix_scale else 7
    current = j_from_i
    centres_i, centres_j = cameras.i_from_camera[:, :3, 3], cameras.j_from_camera[:, :3, 3]
    jacobian = np.zeros((len(centres_i), 6, 7))
    jacobian[:, :3, :3] = np.eye(3)
    jacobian[:, 3:, 3:6] = np.eye(3)
    weight = np.array([cameras.sigma_rotation_rad**-2] * 3 + [cameras.sigma_centre**-2] * 3)
    total = information
    for _ in range(_MAX_FUSE_ITERATIONS):
        centres = current.act(centres_i)
        jacobian[:, 3:, :3] = np.cross(centres[:, None, :], np.eye(3))  # -skew(centre)
        jacobian[:, 3:, 6] = centres
        turns = _rotation_errors(current.rotation, cameras.i_from_camera, cameras.j_from_camera)
        errors = np.concatenate([turns, centres - centres_j], axis=1)
        total = information + np.einsum("kia,i,kib->ab", jacobian, weight, jacobian)
        gradient = information @ sim3.log(current @ j_from_i.inverse())
        gradient += np.einsum("kia,i,ki->a", jacobian, weight, errors)
        step = np.zeros(7)
        step[:size] = -np.linalg.solve(total[:size, :size], gradient[:size])
        current = sim3.exp(step) @ current
        # the expected decrease of the cost: below it no step is worth a fraction of a standard deviation
        if float(-gradient @ step) < _NEGLIGIBLE_DECREASE:
            break
    return current, total


def _rotation_errors(rotation: Array, i_from_camera: Array, j_from_camera: Array) -> Array:
    """Rotation vectors (K, 3), in frame j, from where j has each camera to where ``rotation`` puts it from i."""
    errors = rotation @ i_from_camera[:, :3, :3] @ j_from_camera[:, :3, :3].transpose(0, 2, 1)
    axis = 0.5 * np.stack(
        [errors[:, 2, 1] - errors[:, 1, 2], errors[:, 0, 2] - errors[:, 2, 0], errors[:, 1, 0] - errors[:, 0, 1]],
        axis=1,
    )
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(errors, axis1=1, axis2=2) - 1.0))
    return np.asarray(axis * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)[:, None], dtype=np.float64)
