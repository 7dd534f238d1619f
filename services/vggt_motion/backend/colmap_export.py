"""Export to COLMAP's model files, text or binary: cameras, keyframe poses and map points.

The format is documented at colmap.github.io/format.html, and is what splat trainers read. Points have no tracks,
since the map is dense depth and not features: COLMAP's viewer shows them once its least track length is set to 0.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from vggt_motion.backend.map import PointMap
from vggt_motion.backend.trajectory import Trajectory, TrajectoryPose
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.records import Keyframe, SubmapGeometry

_PINHOLE, _SIMPLE_RADIAL = 1, 2  # COLMAP's model ids
_SUFFIXES = {"image/jpeg": ".jpg", "image/png": ".png"}


@dataclass(frozen=True)
class ColmapImage:
    """One posed image."""

    name: str  # file name, relative to the folder of the images
    intrinsics: Intrinsics  # of the image file
    world_from_camera: npt.NDArray[np.float64]  # (4, 4)


def collect_images(
    trajectory: Trajectory,
    keyframes: Sequence[Keyframe],
    submaps: Mapping[int, SubmapGeometry],
    component: int | None = None,
) -> list[ColmapImage]:
    """The keyframes that a submap solved, with its intrinsics on the recorded image.

    Args:
        trajectory: world poses.
        keyframes: names and sizes of the images.
        submaps: geometry per index; the lowest that holds a keyframe gives its intrinsics.
        component: which connected part, since parts share no frame; the one with most keyframes by default.
    """
    posed = [frame for frame in trajectory.keyframes if frame.world_from_camera is not None]
    if component is None:
        counts = {c: sum(frame.component == c for frame in posed) for c in trajectory.components}
        component = max(counts, key=lambda c: (counts[c], -c), default=0)
    by_place: dict[tuple[str, int, int], TrajectoryPose] = {(f.camera, f.epoch, f.frame_index): f for f in posed}
    solved: dict[str, Intrinsics] = {}
    for index in sorted(submaps):
        for geometry in submaps[index].frames:
            solved.setdefault(geometry.keyframe_id, geometry.intrinsics)
    images = []
    for keyframe in sorted(keyframes, key=lambda k: k.keyframe_id):
        frame = by_place.get((keyframe.camera, keyframe.epoch, keyframe.frame_index))
        intrinsics = solved.get(keyframe.keyframe_id)
        if frame is None or frame.component != component or frame.world_from_camera is None or intrinsics is None:
            continue
        images.append(
            ColmapImage(
                image_name(keyframe),
                intrinsics.resized(keyframe.width_px, keyframe.height_px),
                frame.world_from_camera,
            )
        )
    return images


def image_name(keyframe: Keyframe) -> str:
    """File name of a keyframe's image: its id with the suffix of its encoding, flat."""
    return keyframe.keyframe_id.replace("/", "_") + _SUFFIXES.get(keyframe.image.media_type, "")


def write_colmap(
    directory: Path, images: Sequence[ColmapImage], points: PointMap, form: Literal["text", "binary"] = "binary"
) -> None:
    """Write ``cameras``, ``images`` and ``points3D`` into a folder, which is made if needed.

    Images of equal intrinsics share a camera. Pixel centres move from whole numbers to COLMAP's halves.
    """
    directory.mkdir(parents=True, exist_ok=True)
    cameras: dict[Intrinsics, int] = {}
    for image in images:
        cameras.setdefault(image.intrinsics, len(cameras) + 1)
    if form == "text":
        _write_text(directory, cameras, images, points)
    else:
        _write_binary(directory, cameras, images, points)


def _parameters(camera: Intrinsics) -> tuple[int, str, list[float]]:
    """Model id, name and parameters. A distorted camera has one focal length in COLMAP's model: the mean."""
    cx, cy = camera.cx + 0.5, camera.cy + 0.5
    if camera.k1 == 0.0:
        return _PINHOLE, "PINHOLE", [camera.fx, camera.fy, cx, cy]
    return _SIMPLE_RADIAL, "SIMPLE_RADIAL", [0.5 * (camera.fx + camera.fy), cx, cy, camera.k1]


def _pose(image: ColmapImage) -> list[float]:
    """``camera_from_world`` as quaternion (w, x, y, z) and translation."""
    camera_from_world = se3.inverse(image.world_from_camera)
    quaternion: list[float] = se3.quaternion_from_rotation(camera_from_world[:3, :3]).tolist()
    translation: list[float] = camera_from_world[:3, 3].tolist()
    return quaternion + translation


def _write_text(
    directory: Path, cameras: Mapping[Intrinsics, int], images: Sequence[ColmapImage], points: PointMap
) -> None:
    with (directory / "cameras.txt").open("w", encoding="ascii") as file:
        file.write("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n")
        for camera, number in cameras.items():
            _, model, parameters = _parameters(camera)
            values = " ".join(map(repr, parameters))
            file.write(f"{number} {model} {camera.width_px} {camera.height_px} {values}\n")
    with (directory / "images.txt").open("w", encoding="utf-8") as file:
        file.write("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D[] as (X, Y, POINT3D_ID)\n")
        for number, image in enumerate(images, start=1):
            values = " ".join(map(repr, _pose(image)))
            file.write(f"{number} {values} {cameras[image.intrinsics]} {image.name}\n\n")
    with (directory / "points3D.txt").open("w", encoding="ascii") as file:
        file.write("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n")
        for number, (point, color) in enumerate(zip(points.points, points.colors, strict=True), start=1):
            x, y, z = point.tolist()
            r, g, b = color.tolist()
            file.write(f"{number} {x!r} {y!r} {z!r} {r} {g} {b} 0\n")


def _write_binary(
    directory: Path, cameras: Mapping[Intrinsics, int], images: Sequence[ColmapImage], points: PointMap
) -> None:
    with (directory / "cameras.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(cameras)))
        for camera, number in cameras.items():
            model, _, parameters = _parameters(camera)
            file.write(struct.pack("<IiQQ", number, model, camera.width_px, camera.height_px))
            file.write(struct.pack(f"<{len(parameters)}d", *parameters))
    with (directory / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(images)))
        for number, image in enumerate(images, start=1):
            file.write(struct.pack("<I7dI", number, *_pose(image), cameras[image.intrinsics]))
            file.write(image.name.encode() + b"\0" + struct.pack("<Q", 0))
    count = len(points.points)
    rows = np.zeros(
        count,
        dtype=[("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track_length", "<u8")],
    )
    rows["id"] = np.arange(1, count + 1)
    rows["xyz"], rows["rgb"] = points.points, points.colors
    with (directory / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", count))
        file.write(rows.tobytes())
