"""The one place that knows which kinds of source there are: a location (path or address) becomes an opened source.

A kind is a test on the location and an opener ``(location, selection) -> Source`` named as ``module:function``,
imported only when chosen. The first kind whose test passes is taken.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vggt_motion.errors import SourceError
from vggt_motion.sources.camera import is_device, is_stream
from vggt_motion.sources.image_folder import ImageFolder, times_beside
from vggt_motion.sources.kitti import KittiFolder, camera_folder
from vggt_motion.sources.selection import DEFAULT_NOMINAL_RATE_HZ, Selection
from vggt_motion.sources.source import Source


@dataclass(frozen=True)
class SourceKind:
    """One kind of source."""

    name: str
    matches: Callable[[str], bool]
    opener: str  # "module:function", called with (location: str, selection: Selection)


def is_on_bus(location: str) -> bool:
    """Whether the frames come from the bus already, so that publishing them there would be an echo."""
    return location.startswith("zenoh:")


SOURCE_KINDS: tuple[SourceKind, ...] = (
    SourceKind("zenoh", is_on_bus, "vggt_motion.sources.zenoh:open_zenoh"),
    SourceKind("stream", is_stream, "vggt_motion.sources.camera:open_stream"),
    SourceKind("camera", is_device, "vggt_motion.sources.camera:open_device"),
    SourceKind("mcap", lambda location: location.lower().endswith(".mcap"), "vggt_motion.sources.mcap:open_mcap"),
    SourceKind("folder", lambda location: Path(location).is_dir(), "vggt_motion.sources.registry:open_folder"),
    SourceKind("video", lambda _: True, "vggt_motion.sources.registry:open_video"),
)


def open_source(
    location: str,
    *,
    start: int = 0,
    end: int | None = None,
    stride: int = 1,
    nominal_rate_hz: float = DEFAULT_NOMINAL_RATE_HZ,
) -> Source:
    """Open whatever the location names.

    Args:
        location: image folder, KITTI sequence folder, video file, ``.mcap`` recording, ``zenoh:CAMERA``, the URL of a
            stream (``rtsp://...``), or a camera at this machine (``camera:0``).
        start: first frame taken.
        end: first frame not taken any more; None = all.
        stride: every so many frames.
        nominal_rate_hz: frame rate assumed for a folder without a file of times.

    Raises:
        SourceError: nothing readable there; the message says what is wrong.
        InputError: the selection is malformed.
    """
    selection = Selection(start, end, stride, nominal_rate_hz)
    if not location:
        raise SourceError("no source given")
    kind = next(kind for kind in SOURCE_KINDS if kind.matches(location))
    module_name, function = kind.opener.split(":")
    source: Source = getattr(importlib.import_module(module_name), function)(location, selection)
    return source


def open_folder(location: str, selection: Selection) -> Source:
    """A folder of images, or a sequence folder with the images below it."""
    folder = Path(location)
    camera = camera_folder(folder)
    if camera is not None:
        return KittiFolder(folder, camera, selection)
    return ImageFolder(folder, selection, times_path=times_beside(folder))


def open_video(location: str, selection: Selection) -> Source:
    """A video file."""
    from vggt_motion.sources.video import VideoFile

    path = Path(location)
    if not path.exists():
        raise SourceError(f"no such file or folder: {location}")
    return VideoFile(path, selection)
