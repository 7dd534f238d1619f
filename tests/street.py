"""A street in closed form (ground, two walls, a far end): exact depth maps for tests and benchmarks."""

from __future__ import annotations

import numpy as np

from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, pixel_rays
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.registration.anchors import AnchorView

# KITTI's field of view on the lattice of 80,000 pixels
CAMERA = Intrinsics.centred(0.58 * 512, 512, 156)
SMALL_CAMERA = Intrinsics.centred(0.58 * 160, 160, 48)


def street_depth(world_from_camera: np.ndarray, camera: Intrinsics, far_m: float = 80.0) -> np.ndarray:
    """Depth (H, W) of ground 1.6 m below the world's origin (y down), walls at x = -7 and 9 m, a wall at z = far_m."""
    rays = pixel_rays(camera) @ world_from_camera[:3, :3].T
    origin = world_from_camera[:3, 3]
    depth = np.full(rays.shape[:2], np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis, offset in ((1, 1.6), (0, -7.0), (0, 9.0), (2, far_m)):
            hit = (offset - origin[axis]) / rays[..., axis]
            depth = np.where((hit > 0.1) & (hit < depth), hit, depth)
    return depth


def view(
    world_from_camera: np.ndarray,
    submap_from_world: Sim3,
    camera: Intrinsics = CAMERA,
    depth_factor: np.ndarray | float = 1.0,
) -> AnchorView:
    """The exact view of a camera in a submap, with depth multiplied by ``depth_factor``."""
    depth = (submap_from_world.scale * street_depth(world_from_camera, camera) * depth_factor).astype(np.float32)
    return AnchorView(depth, np.ones(depth.shape, np.float32), camera, submap_from_world.act_pose(world_from_camera))


def drive(count: int, step_m: float = 1.5) -> list[np.ndarray]:
    """Poses ``world_from_camera`` of a drive along the street with a slight sway."""
    return [
        se3.make(
            se3.so3_exp(np.array([0.004 * np.sin(k), 0.02 * np.sin(0.7 * k), 0.0])),
            np.array([0.1 * np.sin(k), 0.0, step_m * k]),
        )
        for k in range(count)
    ]
