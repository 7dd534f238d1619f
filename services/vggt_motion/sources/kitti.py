"""Sequence folders as KITTI has them: images in a sub-folder, ``times.txt`` and perhaps ``poses.txt`` beside it."""

from __future__ import annotations

from pathlib import Path

from vggt_motion.sources.image_folder import ImageFolder, list_images, times_beside
from vggt_motion.sources.selection import Selection

# Colour first: the map then has colour. KITTI odometry, KITTI raw, and the names that other sequences use.
CAMERA_FOLDERS = (
    "image_2",
    "image_0",
    "image_02/data",
    "image_00/data",
    "image_3",
    "image_1",
    "rgb",
    "images",
    "image",
)


def camera_folder(sequence: Path) -> Path | None:
    """The sub-folder with the camera's images, or None where this is no such sequence."""
    for name in CAMERA_FOLDERS:
        folder = sequence / name
        if folder.is_dir() and list_images(folder):
            return folder
    return None


class KittiFolder(ImageFolder):
    """A KITTI sequence.

    ``ground_truth_path`` is its ``poses.txt`` (row-major 3x4 world_from_camera per frame, metres), None where absent.
    """

    def __init__(self, sequence: Path, camera: Path, selection: Selection) -> None:
        """Open the sequence.

        Args:
            sequence: holds ``times.txt`` (or raw KITTI's ``timestamps.txt`` in the camera's folder).
            camera: the folder with the images, as :func:`camera_folder` finds it.
            selection: which frames to take.

        Raises:
            SourceError: as :class:`ImageFolder`.
        """
        times_path = sequence / "times.txt"
        super().__init__(
            camera,
            selection,
            times_path=times_path if times_path.is_file() else times_beside(camera),
            kind="KITTI sequence",
        )
        poses = sequence / "poses.txt"
        self.ground_truth_path: Path | None = poses if poses.is_file() else None
