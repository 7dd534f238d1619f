"""Hard sequences made of the evaluation data and of closed-form scenes: lenses, small images, stops, turns on the spot.

Each is an image folder with ``poses.txt`` and ``times.txt``, like the evaluation data, written into a folder of the
caller's choice; the same call writes the same bytes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # helpers of the tests

import sfm_scene
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics, pixel_rays

Image = npt.NDArray[np.uint8]
Array = npt.NDArray[np.float64]
Frames = Iterator[tuple[Image, Array]]

KITTI_CAMERAS = {  # focal length and principal point of the rectified images, by the calibration of the benchmark
    "kitti_00_first200": (718.856, 607.1928, 185.2157),
    "kitti_01_first51": (718.856, 607.1928, 185.2157),
    "kitti_06_first51": (707.0912, 601.8873, 183.1104),
}

_KITTI_LENS = (-0.3728, 0.2037, 0.00222, 0.00138, -0.0722)  # k1, k2, p1, p2, k3 of the raw recordings


def _recorded(data: Path, name: str) -> Frames:
    rows = np.loadtxt(data / name / "poses.txt").reshape(-1, 3, 4)
    for file, pose in zip(sorted((data / name / "image_0").iterdir()), rows, strict=True):
        yield np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), dtype=np.uint8), pose


def _distorted(data: Path, name: str, k1: float = -0.3) -> Frames:
    """As an unrectified camera sees it: barrel distortion about the same centre, cropped to what is known."""
    focal, cx, cy = KITTI_CAMERAS[name]
    maps: tuple[Array, Array] | None = None
    for image, pose in _recorded(data, name):
        height, width = image.shape
        if maps is None:
            edge = (width - 1 - cx) / focal
            half = int(focal * edge * (1.0 + k1 * edge * edge))
            top = (height - 1 - cy) / focal
            half_height = int(focal * top * (1.0 + k1 * top * top))
            camera = Intrinsics(focal, focal, half, half_height, 2 * half, 2 * half_height, k1)
            rays = pixel_rays(camera)
            maps = focal * rays[..., 0] + cx, focal * rays[..., 1] + cy
        mapped = cv2.remap(image, maps[0].astype(np.float32), maps[1].astype(np.float32), cv2.INTER_CUBIC)
        yield np.asarray(mapped, dtype=np.uint8), pose


def _unrectified(data: Path, name: str) -> Frames:
    """Through the lens of KITTI's own camera 0 as it was calibrated, five coefficients, cropped to what is known."""
    focal, cx, cy = KITTI_CAMERAS[name]
    half, half_height = int(0.672 * focal), int(0.245 * focal)
    u, v = np.meshgrid(np.arange(2.0 * half), np.arange(2.0 * half_height))
    seen_x, seen_y = (u - half + 6.0) / focal, (v - half_height + 8.0) / focal
    k1, k2, p1, p2, k3 = _KITTI_LENS
    x, y = seen_x, seen_y
    for _ in range(100):  # a fixed point, as the lens has no inverse in closed form
        square = x * x + y * y
        factor = 1.0 + square * (k1 + square * (k2 + square * k3))
        aside = 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
        down = p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
        x, y = (seen_x - aside) / factor, (seen_y - down) / factor
    maps = (focal * x + cx).astype(np.float32), (focal * y + cy).astype(np.float32)
    for image, pose in _recorded(data, name):
        yield np.asarray(cv2.remap(image, *maps, cv2.INTER_CUBIC), dtype=np.uint8), pose


def _small(data: Path, name: str) -> Frames:
    for image, pose in _recorded(data, name):
        yield np.asarray(cv2.resize(image, (416, 128), interpolation=cv2.INTER_AREA), dtype=np.uint8), pose


def _with_stop(data: Path, name: str, at: int, length: int) -> Frames:
    """One frame again and again, each time with the noise of a sensor, then on."""
    rng = np.random.default_rng(0)
    for index, (image, pose) in enumerate(_recorded(data, name)):
        yield image, pose
        if index == at:
            for _ in range(length):
                noisy = image + rng.normal(0.0, 2.0, image.shape)
                yield np.clip(np.rint(noisy), 0, 255).astype(np.uint8), pose


Box = tuple[int, int, int, int]  # left, top, width, height in px


def _with_a_truck(data: Path, name: str, box: Callable[[int, int, int], Box | None]) -> Frames:
    """The back of a truck that moves along, at ``box(index, width, height)`` of each image."""
    back = sfm_scene.texture(11, 256)
    for index, (image, pose) in enumerate(_recorded(data, name)):
        height, width = image.shape
        where = box(index, width, height)
        covered = image.copy()
        if where is not None:
            left, top, across, down = where
            visible = covered[top : top + down, max(left, 0) : max(left + across, 0)]
            visible[:] = cv2.resize(back, (across, down))[: visible.shape[0], -min(left, 0) :][:, : visible.shape[1]]
        yield covered, pose


def _ahead(index: int, width: int, height: int) -> Box:
    """Half of the image: it keeps its distance, but for a sway."""
    sway = round(5 * np.sin(0.2 * index))
    across = width // 2 + round(6 * np.sin(0.3 * index))
    return width // 4 + sway, round(0.06 * height), across, round(0.86 * height)


def _beside(index: int, width: int, height: int) -> Box:
    """The left half, as on the next lane."""
    return round(5 * np.sin(0.2 * index)) - 10, round(0.06 * height), width // 2 + 10, round(0.86 * height)


def _for_a_while(index: int, width: int, height: int) -> Box | None:
    """Comes in from the left within a second, stays ahead for a second, goes on to the right."""
    if not 10 <= index <= 40:
        return None
    left, top, across, down = _ahead(index, width, height)
    return left - max(20 - index, 0) * width // 14 + max(index - 30, 0) * width // 14, top, across, down


def _nearing(index: int, width: int, height: int) -> Box:
    """At first a quarter of the area, in the end twice as much and more."""
    across = round(width * (0.35 + 0.005 * index + 0.004 * np.sin(0.3 * index)))
    down = round(height * (0.62 + 0.005 * index))
    return (width - across) // 2 + round(5 * np.sin(0.2 * index)), round(0.95 * height) - down, across, down


def _room() -> list[sfm_scene.Rectangle]:
    rectangles = [
        sfm_scene.Rectangle((0.0, 1.3, 0.0), (6.0, 0.0, 0.0), (0.0, 0.0, 8.0)),
        sfm_scene.Rectangle((0.0, -1.6, 0.0), (6.0, 0.0, 0.0), (0.0, 0.0, 8.0)),
        sfm_scene.Rectangle((-4.0, 0.0, 0.0), (0.0, 0.0, 8.0), (0.0, 1.8, 0.0)),
        sfm_scene.Rectangle((4.5, 0.0, 0.0), (0.0, 0.0, 8.0), (0.0, 1.8, 0.0)),
        sfm_scene.Rectangle((0.0, 0.0, 6.5), (6.0, 0.0, 0.0), (0.0, 1.8, 0.0)),
        sfm_scene.Rectangle((0.0, 0.0, -7.0), (6.0, 0.0, 0.0), (0.0, 1.8, 0.0)),
    ]
    for k in range(8):
        angle = 0.4 + k * np.pi / 4
        x, z = 2.9 * np.sin(angle), 3.3 * np.cos(angle)
        along = (0.5 * np.cos(angle), 0.0, -0.5 * np.sin(angle))
        rectangles.append(sfm_scene.Rectangle((x, 0.6, z), along, (0.0, 0.7, 0.0), 40.0))
    return rectangles


def _on_the_spot(radius: float, turn_deg: float, steps: int) -> Frames:
    """In a room: forwards, a turn about a point ``radius`` behind the camera, forwards again."""
    camera = Intrinsics.centred(380.0, 480, 270)
    room = _room()
    position, yaw = np.array([0.3, 0.0, -3.0]), 0.0
    poses = []

    def keep() -> None:
        sway = se3.so3_exp(np.array([0.006 * np.sin(0.9 * len(poses)), 0.0, 0.004 * np.sin(0.5 * len(poses))]))
        poses.append(se3.make(se3.so3_exp(np.array([0.0, yaw, 0.0])) @ sway, position.copy()))

    for _ in range(30):
        position = position + 0.09 * np.array([np.sin(yaw), 0.0, np.cos(yaw)])
        keep()
    pivot = position - radius * np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    for _ in range(steps):
        yaw += np.radians(turn_deg) / steps
        position = pivot + radius * np.array([np.sin(yaw), 0.0, np.cos(yaw)])
        keep()
    for _ in range(30):
        position = position + 0.07 * np.array([np.sin(yaw), 0.0, np.cos(yaw)])
        keep()
    for pose in poses:
        image, _ = sfm_scene.render(room, pose, camera)
        yield np.ascontiguousarray(image[..., 0]), pose[:3]


_MAKERS: dict[str, Callable[[Path], Frames]] = {
    "kitti_06 unrectified k1=-0.3": lambda data: _distorted(data, "kitti_06_first51"),
    "kitti_01 unrectified k1=-0.3": lambda data: _distorted(data, "kitti_01_first51"),
    "kitti_00 unrectified k1=-0.3": lambda data: _distorted(data, "kitti_00_first200"),
    "kitti_06 through KITTI's own lens": lambda data: _unrectified(data, "kitti_06_first51"),
    "kitti_01 through KITTI's own lens": lambda data: _unrectified(data, "kitti_01_first51"),
    "kitti_00 through KITTI's own lens": lambda data: _unrectified(data, "kitti_00_first200"),
    "kitti_00 at 416x128": lambda data: _small(data, "kitti_00_first200"),
    "kitti_06 with a stop": lambda data: _with_stop(data, "kitti_06_first51", 24, 40),
    "kitti_00 with a stop in a turn": lambda data: _with_stop(data, "kitti_00_first200", 106, 40),
    "kitti_06 behind a truck": lambda data: _with_a_truck(data, "kitti_06_first51", _ahead),
    "kitti_06 beside a truck": lambda data: _with_a_truck(data, "kitti_06_first51", _beside),
    "kitti_06, a truck for a while": lambda data: _with_a_truck(data, "kitti_06_first51", _for_a_while),
    "kitti_06 nearing a truck": lambda data: _with_a_truck(data, "kitti_06_first51", _nearing),
    "kitti_00 behind a truck": lambda data: _with_a_truck(data, "kitti_00_first200", _ahead),
    "room, turning almost on the spot": lambda data: _on_the_spot(0.1, 180.0, 60),
    "room, turning on the spot": lambda data: _on_the_spot(0.0, 180.0, 60),
}
NAMES: Sequence[str] = tuple(_MAKERS)


def write(name: str, data: Path, folder: Path) -> Path:
    """Write one sequence below ``folder`` and return where it is."""
    location = folder / name.replace(" ", "_").replace(",", "").replace("'", "").replace("=", "")
    if (location / "poses.txt").is_file():
        return location
    (location / "image_0").mkdir(parents=True, exist_ok=True)
    rows = []
    for index, (image, pose) in enumerate(_MAKERS[name](data)):
        cv2.imwrite(str(location / "image_0" / f"{index:06d}.png"), image)
        rows.append(pose.reshape(-1))
    np.savetxt(location / "times.txt", 0.1 * np.arange(len(rows)))
    np.savetxt(location / "poses.txt", np.array(rows))
    return location
