"""Export to COLMAP's model files, text or binary: cameras, keyframe poses, and map points with their tracks.

The format is documented at colmap.github.io/format.html, and is what splat trainers read. The map is dense depth and
not features: a point's track are the keyframes whose own depth map has it on the surface, at the pixel where it falls.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.backend.map import MapFrame, PointMap
from vggt_motion.backend.trajectory import Trajectory, TrajectoryPose
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, fold_radius, project
from vggt_motion.records import Keyframe, SubmapGeometry

_PINHOLE, _SIMPLE_RADIAL, _OPENCV = 1, 2, 4  # COLMAP's model ids
# A point is on a keyframe's surface where its depth differs by less than this share, else it is hidden or elsewhere.
_MAX_DEPTH_DIFFERENCE = 0.05
_MIN_TRACK_LENGTH = 2  # a point that one image alone sees is no evidence
_SUFFIXES = {"image/jpeg": ".jpg", "image/png": ".png"}


@dataclass(frozen=True)
class ColmapImage:
    """One posed image."""

    keyframe_id: str
    name: str  # file name, relative to the folder of the images
    intrinsics: Intrinsics  # of the image file
    world_from_camera: npt.NDArray[np.float64]  # (4, 4)


@dataclass(frozen=True)
class ColmapModel:
    """Images, points, and which image sees which point where."""

    images: tuple[ColmapImage, ...]
    points: npt.NDArray[np.float32]  # (N, 3) world units
    colors: npt.NDArray[np.uint8]  # (N, 3) RGB
    image_of: npt.NDArray[np.int32]  # (M,) of each observation, place in ``images``, ascending
    point_of: npt.NDArray[np.int32]  # (M,) place in ``points``
    pixels: npt.NDArray[np.float64]  # (M, 2) of the image file, pixel centres at whole numbers


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
                keyframe.keyframe_id,
                image_name(keyframe),
                intrinsics.resized(keyframe.width_px, keyframe.height_px),
                frame.world_from_camera,
            )
        )
    return images


def image_name(keyframe: Keyframe) -> str:
    """File name of a keyframe's image: its id with the suffix of its encoding, flat."""
    return keyframe.keyframe_id.replace("/", "_") + _SUFFIXES.get(keyframe.image.media_type, "")


def build_model(
    images: Sequence[ColmapImage], points: PointMap, frames: Iterable[MapFrame], *, scale: float, max_per_image: int
) -> ColmapModel:
    """Find the tracks of the map's points, and leave out those that fewer than two images see.

    Args:
        images: posed.
        points: the map, world units.
        frames: keyframes with depth, as the map was made from, in any order; one at a time is held.
        scale: world units per unit of the graph (``Trajectory.scale``).
        max_per_image: most observations of one image. The same points are favoured in all of them, so that tracks
            stay long.
    """
    place = {image.keyframe_id: n for n, image in enumerate(images)}
    # which points are favoured must depend neither on their place in the world nor on the run
    rank = np.random.default_rng(0).permutation(len(points.points))
    world = points.points.astype(np.float64)
    found: dict[int, tuple[npt.NDArray[np.int32], npt.NDArray[np.float64]]] = {}
    for frame in frames:
        number = place.get(frame.keyframe_id)
        if number is None:
            continue
        seen, pixels = _visible(world, images[number], frame, scale)
        if len(seen) > max_per_image:
            chosen = np.sort(np.argpartition(rank[seen], max_per_image)[:max_per_image])
            seen, pixels = seen[chosen], pixels[chosen]
        found[number] = (seen.astype(np.int32), pixels)
    numbers = sorted(found)
    image_of = np.repeat(np.array(numbers, np.int32), [len(found[n][0]) for n in numbers])
    point_of = np.concatenate([np.zeros(0, np.int32), *(found[n][0] for n in numbers)])
    pixels = np.concatenate([np.zeros((0, 2)), *(found[n][1] for n in numbers)])
    kept = np.bincount(point_of, minlength=len(world)) >= _MIN_TRACK_LENGTH
    renumbered = np.cumsum(kept, dtype=np.int32) - 1
    of_kept = kept[point_of]
    return ColmapModel(
        tuple(images),
        points.points[kept],
        points.colors[kept],
        image_of[of_kept],
        renumbered[point_of[of_kept]],
        pixels[of_kept],
    )


def _visible(
    world: npt.NDArray[np.float64], image: ColmapImage, frame: MapFrame, scale: float
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.float64]]:
    """Which points (M,) lie on the surface that a keyframe sees, and their pixels (M, 2) in the image file."""
    in_camera = se3.act(se3.inverse(image.world_from_camera), world)
    height, width = frame.depth.shape
    # only a camera without distortion sees as far aside as its formula: what folds back into the image is not in it
    inside = _within_field(in_camera, frame.intrinsics)
    candidates = np.flatnonzero(inside)
    on_lattice = project(in_camera[candidates], frame.intrinsics)
    on_image = ((on_lattice >= -0.5) & (on_lattice < np.array([width, height]) - 0.5)).all(axis=1)
    candidates = candidates[on_image]
    columns, rows = (np.rint(on_lattice[on_image, axis]).astype(np.intp) for axis in (0, 1))
    depth = frame.depth[rows, columns].astype(np.float64) * frame.world_from_submap.scale * scale
    with np.errstate(divide="ignore", invalid="ignore"):
        on_surface = np.abs(in_camera[candidates, 2] / depth - 1.0) <= _MAX_DEPTH_DIFFERENCE
    candidates = candidates[on_surface & (frame.confidence[rows, columns] > 0.0)]
    pixels = project(in_camera[candidates], image.intrinsics)
    size = np.array([image.intrinsics.width_px, image.intrinsics.height_px])
    on_file = ((pixels >= -0.5) & (pixels < size - 0.5)).all(axis=1)
    return candidates[on_file], pixels[on_file]


def _within_field(in_camera: npt.NDArray[np.float64], camera: Intrinsics) -> npt.NDArray[np.bool_]:
    """Points (N, 3) before the camera, and within the radius at which a barrel distortion folds back."""
    before = in_camera[:, 2] > 0.0
    fold = fold_radius(camera.k1, camera.k2)
    radius = np.hypot(in_camera[:, 0], in_camera[:, 1])
    return np.asarray(before & (radius < fold * np.maximum(in_camera[:, 2], 0.0))) if np.isfinite(fold) else before


def without_distortion(image: ColmapImage) -> ColmapImage:
    """The image as :func:`undistort` makes it, a PNG of a pinhole camera: what many splat trainers ask for."""
    if image.intrinsics.k1 == 0.0 and image.intrinsics.k2 == 0.0:
        return image
    return replace(
        image, name=str(Path(image.name).with_suffix(".png")), intrinsics=replace(image.intrinsics, k1=0.0, k2=0.0)
    )


def undistort(pixels: npt.NDArray[np.uint8], camera: Intrinsics) -> npt.NDArray[np.uint8]:
    """An image (H, W, 3) of a camera as a camera without distortion takes it; black where it saw nothing."""
    u, v = np.meshgrid(np.arange(camera.width_px, dtype=np.float64), np.arange(camera.height_px, dtype=np.float64))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    source = project(rays, camera).astype(np.float32)
    inside = _within_field(rays.reshape(-1, 3), camera).reshape(u.shape)
    source[~inside] = -1e6
    return np.asarray(cv2.remap(pixels, source[..., 0], source[..., 1], cv2.INTER_LINEAR), dtype=np.uint8)


def write_colmap(directory: Path, model: ColmapModel, form: Literal["text", "binary"] = "binary") -> None:
    """Write ``cameras``, ``images`` and ``points3D`` into a folder, which is made if needed.

    Images of equal intrinsics share a camera. Pixel centres move from whole numbers to COLMAP's halves. A model in the
    other form that is there already is removed: readers would take it for this one.
    """
    directory.mkdir(parents=True, exist_ok=True)
    for name in ("cameras", "images", "points3D", "rigs", "frames"):
        for suffix in (".txt", ".bin"):
            (directory / f"{name}{suffix}").unlink(missing_ok=True)
    cameras: dict[Intrinsics, int] = {}
    for image in model.images:
        cameras.setdefault(image.intrinsics, len(cameras) + 1)
    if form == "text":
        _write_text(directory, cameras, model)
    else:
        _write_binary(directory, cameras, model)


def _parameters(camera: Intrinsics) -> tuple[int, str, list[float]]:
    """Model id, name and parameters."""
    cx, cy = camera.cx + 0.5, camera.cy + 0.5
    if camera.k1 == 0.0 and camera.k2 == 0.0:
        return _PINHOLE, "PINHOLE", [camera.fx, camera.fy, cx, cy]
    if camera.fx == camera.fy and camera.k2 == 0.0:
        return _SIMPLE_RADIAL, "SIMPLE_RADIAL", [camera.fx, cx, cy, camera.k1]
    return _OPENCV, "OPENCV", [camera.fx, camera.fy, cx, cy, camera.k1, camera.k2, 0.0, 0.0]


def _pose(image: ColmapImage) -> list[float]:
    """``camera_from_world`` as quaternion (w, x, y, z) and translation."""
    camera_from_world = se3.inverse(image.world_from_camera)
    quaternion: list[float] = se3.quaternion_from_rotation(camera_from_world[:3, :3]).tolist()
    translation: list[float] = camera_from_world[:3, 3].tolist()
    return quaternion + translation


def _bounds(model: ColmapModel) -> npt.NDArray[np.intp]:
    """First observation of each image, and their number (I + 1,)."""
    return np.searchsorted(model.image_of, np.arange(len(model.images) + 1))


def _tracks(model: ColmapModel) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.intp]]:
    """Pairs (M, 2) of image number (from 1) and place among its observations, by point; and bounds (N + 1,)."""
    order = np.argsort(model.point_of, kind="stable")
    place = np.arange(len(model.image_of)) - _bounds(model)[model.image_of]
    pairs = np.stack([model.image_of + 1, place], axis=1).astype(np.uint32)[order]
    return pairs, np.searchsorted(model.point_of[order], np.arange(len(model.points) + 1))


def _write_text(directory: Path, cameras: Mapping[Intrinsics, int], model: ColmapModel) -> None:
    with (directory / "cameras.txt").open("w", encoding="ascii") as file:
        file.write("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n")
        for camera, number in cameras.items():
            _, name, parameters = _parameters(camera)
            values = " ".join(map(repr, parameters))
            file.write(f"{number} {name} {camera.width_px} {camera.height_px} {values}\n")
    bounds = _bounds(model).tolist()
    with (directory / "images.txt").open("w", encoding="utf-8") as file:
        file.write("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D[] as (X, Y, POINT3D_ID)\n")
        for number, image in enumerate(model.images, start=1):
            values = " ".join(map(repr, _pose(image)))
            file.write(f"{number} {values} {cameras[image.intrinsics]} {image.name}\n")
            own = slice(bounds[number - 1], bounds[number])
            seen = zip((model.pixels[own] + 0.5).tolist(), (model.point_of[own] + 1).tolist(), strict=True)
            file.write(" ".join(f"{x!r} {y!r} {point}" for (x, y), point in seen) + "\n")
    pairs, ends = _tracks(model)
    with (directory / "points3D.txt").open("w", encoding="ascii") as file:
        file.write("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n")
        for number, (point, color) in enumerate(zip(model.points.tolist(), model.colors.tolist(), strict=True)):
            track = " ".join(map(str, pairs[ends[number] : ends[number + 1]].ravel().tolist()))
            values = " ".join(map(repr, point))
            file.write(f"{number + 1} {values} {' '.join(map(str, color))} 0 {track}\n")


def _write_binary(directory: Path, cameras: Mapping[Intrinsics, int], model: ColmapModel) -> None:
    with (directory / "cameras.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(cameras)))
        for camera, number in cameras.items():
            kind, _, parameters = _parameters(camera)
            file.write(struct.pack("<IiQQ", number, kind, camera.width_px, camera.height_px))
            file.write(struct.pack(f"<{len(parameters)}d", *parameters))
    bounds = _bounds(model).tolist()
    with (directory / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(model.images)))
        for number, image in enumerate(model.images, start=1):
            own = slice(bounds[number - 1], bounds[number])
            seen = np.empty(own.stop - own.start, dtype=[("xy", "<f8", 2), ("point", "<u8")])
            seen["xy"], seen["point"] = model.pixels[own] + 0.5, model.point_of[own] + 1
            file.write(struct.pack("<I7dI", number, *_pose(image), cameras[image.intrinsics]))
            file.write(image.name.encode() + b"\0" + struct.pack("<Q", len(seen)))
            file.write(seen.tobytes())
    pairs, ends = _tracks(model)
    track_bytes = pairs.astype("<u4").tobytes()
    with (directory / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(model.points)))
        rows = zip(model.points.tolist(), model.colors.tolist(), ends[:-1].tolist(), ends[1:].tolist(), strict=True)
        for number, (point, color, first, last) in enumerate(rows, start=1):
            file.write(struct.pack("<Q3d3BdQ", number, *point, *color, 0.0, last - first))
            file.write(track_bytes[8 * first : 8 * last])
