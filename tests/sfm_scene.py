"""A textured scene in closed form: images, exact depth and exact poses for the structure-from-motion predictor."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, pixel_rays, project
from vggt_motion.inference.predictor import KeyframeImage
from vggt_motion.inference.sfm.bundle import Observations, Scene

Array = npt.NDArray[np.float64]

SKY = 215
_OVERSAMPLING = 2


@dataclass(frozen=True)
class Rectangle:
    """A textured rectangle: centre (3,), two half axes (3,) that span it."""

    centre: tuple[float, float, float]
    along: tuple[float, float, float]
    across: tuple[float, float, float]
    texels_per_unit: float = 24.0


def street() -> list[Rectangle]:
    """Ground 1.6 below, broken walls on both sides, boxes beside the road; above them nothing: sky. y is down."""
    rectangles = [Rectangle((0.0, 1.6, 30.0), (12.0, 0.0, 0.0), (0.0, 0.0, 60.0), 10.0)]
    for k in range(9):
        z = -4.0 + 9.0 * k
        rectangles.append(Rectangle((-6.0 - (k % 3), -1.0, z), (0.0, 0.0, 4.5), (0.0, 2.6, 0.0), 12.0))
        rectangles.append(Rectangle((7.0 + (k % 2), -1.4, z), (0.0, 0.0, 4.5), (0.0, 3.0, 0.0), 12.0))
        rectangles.append(Rectangle((-4.4 if k % 2 else 5.0, 0.7, z + 3.0), (1.0, 0.0, 0.0), (0.0, 0.9, 0.0)))
    return rectangles


def wall() -> list[Rectangle]:
    """One plane, seen slightly from the side."""
    return [Rectangle((0.0, 0.0, 8.0), (30.0, 0.0, 6.0), (0.0, 20.0, 0.0), 14.0)]


def texture(seed: int = 3, side: int = 1024) -> npt.NDArray[np.uint8]:
    """Band-limited noise that repeats at its border."""
    rng = np.random.default_rng(seed)
    total = np.zeros((side, side))
    for cells, weight in ((16, 0.5), (64, 0.8), (256, 1.0)):
        coarse = rng.normal(size=(cells, cells))
        padded = np.pad(coarse, 2, mode="wrap")
        scale = side // cells
        fine = cv2.resize(padded, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        total += weight * fine[2 * scale : 2 * scale + side, 2 * scale : 2 * scale + side]
    spread = 128.0 + 42.0 * total / total.std()
    return np.clip(spread, 0, 255).astype(np.uint8)


_TEXTURE = texture()


def render(
    rectangles: list[Rectangle], world_from_camera: Array, camera: Intrinsics
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float64]]:
    """Image (H, W, 3) and depth (H, W) along the optical axis, infinite in the sky."""
    fine = camera.resized(camera.width_px * _OVERSAMPLING, camera.height_px * _OVERSAMPLING)
    grey, _ = _cast(rectangles, world_from_camera, fine)
    image = cv2.resize(grey, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)
    _, depth = _cast(rectangles, world_from_camera, camera)
    return np.repeat(np.rint(image).astype(np.uint8)[..., None], 3, axis=2), depth


def _cast(rectangles: list[Rectangle], world_from_camera: Array, camera: Intrinsics) -> tuple[Array, Array]:
    rays = pixel_rays(camera) @ world_from_camera[:3, :3].T
    origin = world_from_camera[:3, 3]
    depth = np.full(rays.shape[:2], np.inf)
    grey = np.full(rays.shape[:2], float(SKY))
    for number, rectangle in enumerate(rectangles):
        centre, along, across = (np.array(part) for part in (rectangle.centre, rectangle.along, rectangle.across))
        normal = np.cross(along, across)
        with np.errstate(divide="ignore", invalid="ignore"):
            hit = ((centre - origin) @ normal) / (rays @ normal)
            offset = origin + rays * hit[..., None] - centre
            a = offset @ along / (along @ along)
            b = offset @ across / (across @ across)
            seen = (hit > 0.05) & (hit < depth) & (np.abs(a) <= 1.0) & (np.abs(b) <= 1.0)
        if not seen.any():
            continue
        scale = rectangle.texels_per_unit
        u = np.where(seen, a, 0.0) * np.linalg.norm(along) * scale + 137.0 * number
        v = np.where(seen, b, 0.0) * np.linalg.norm(across) * scale + 71.0 * number
        colour = cv2.remap(
            _TEXTURE, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
        )
        depth = np.where(seen, hit, depth)
        grey = np.where(seen, colour, grey)
    return grey, depth


def drive(count: int, step: float = 0.8, turn_deg: float = 0.0) -> list[Array]:
    """Poses ``world_from_camera`` forwards along z, turning to the right by ``turn_deg`` in all."""
    poses = []
    position, yaw = np.array([0.0, 0.0, 0.0]), 0.0
    for k in range(count):
        rotation = se3.so3_exp(np.array([0.0, yaw, 0.0])) @ se3.so3_exp(np.array([0.004 * np.sin(2.0 * k), 0.0, 0.0]))
        poses.append(se3.make(rotation, position.copy()))
        yaw += np.radians(turn_deg) / max(count - 1, 1)
        position = position + step * np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    return poses


def keyframes(
    rectangles: list[Rectangle], poses: list[Array], camera: Intrinsics
) -> tuple[list[KeyframeImage], list[npt.NDArray[np.float64]]]:
    """Images of a drive, and their depth."""
    rendered = [render(rectangles, pose, camera) for pose in poses]
    images = [KeyframeImage(f"front/0/{k:08d}", k * 100_000_000, image) for k, (image, _) in enumerate(rendered)]
    return images, [depth for _, depth in rendered]


def synthetic_problem(
    poses: list[Array], camera: Intrinsics, count: int = 300, noise_px: float = 0.0, seed: int = 0
) -> tuple[Scene, Observations]:
    """Points before a drive's cameras, exactly where they are, and where the cameras see them.

    The pixels are relative to the middle of the image, as the predictor keeps them.
    """
    rng = np.random.default_rng(seed)
    world_from_first = poses[0]
    points = np.column_stack([rng.uniform(-8, 8, count), rng.uniform(-3, 2, count), rng.uniform(4, 40, count)])
    points = se3.act(world_from_first, points)
    middle = np.array([0.5 * (camera.width_px - 1), 0.5 * (camera.height_px - 1)])
    point, frame, pixel = [], [], []
    for index, pose in enumerate(poses):
        seen = project(se3.act(se3.inverse(pose), points), camera)
        with np.errstate(invalid="ignore"):
            inside = np.all((seen >= 0) & (seen <= 2 * middle), axis=1)
        point.append(np.flatnonzero(inside))
        frame.append(np.full(int(inside.sum()), index))
        pixel.append(seen[inside] - middle + noise_px * rng.normal(size=(int(inside.sum()), 2)))
    cameras = np.stack([se3.inverse(pose) for pose in poses])
    scene = Scene(
        cameras[:, :3, :3].copy(),
        cameras[:, :3, 3].copy(),
        points,
        camera.fx,
        camera.k1,
        camera.cx - middle[0],
        camera.cy - middle[1],
        radial_shape=camera.k2 / camera.k1**2 if camera.k2 != 0.0 else 0.0,
    )
    return scene, Observations.build(np.concatenate(point), np.concatenate(frame), np.concatenate(pixel), count)


def position_error(estimated: list[Array], truth: list[Array]) -> float:
    """Root mean square distance of positions (N, 3) after the best similarity, as a share of the path length."""
    source, target = np.stack(estimated), np.stack(truth)
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    d = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ d @ vt
    scale = np.trace(np.diag(s) @ d) / (a**2).sum()
    errors = np.linalg.norm(scale * a @ rotation.T - b, axis=1)
    return float(np.sqrt((errors**2).mean()) / np.linalg.norm(np.diff(target, axis=0), axis=1).sum())
