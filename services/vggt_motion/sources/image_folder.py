"""A folder of images: file bytes passed through, in natural order of the names."""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Iterator
from pathlib import Path

from vggt_motion.errors import CodecError, SourceError, SourceTruncatedError
from vggt_motion.sources.encoded import checked_media_type, is_jpeg_or_png, transcode_to_png
from vggt_motion.sources.selection import Selection
from vggt_motion.sources.source import Frame
from vggt_motion.sources.timing import NANOSECONDS, TimestampRepair, median_interval_ns, read_times

_log = logging.getLogger(__name__)

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"})
TIME_FILES = ("times.txt", "timestamps.txt")

_DIGITS = re.compile(r"(\d+)")


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key under which ``frame9`` comes before ``frame10``."""
    parts = _DIGITS.split(name)
    return tuple((0, int(part), part) if index % 2 else (1, 0, part) for index, part in enumerate(parts))


def list_images(folder: Path) -> list[Path]:
    """Image files of a folder, by suffix, in natural order; hidden files are passed over."""
    files = [
        p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".") and p.is_file()
    ]
    return sorted(files, key=lambda path: natural_key(path.name))


class ImageFolder:
    """Frames from image files.

    JPEG and PNG files are passed through byte for byte; other formats are encoded once, as PNG. Capture times come
    from a file of times where there is one, else from the nominal rate. A file that is no image ends the input there.
    """

    is_live = False

    def __init__(
        self, folder: Path, selection: Selection, *, times_path: Path | None = None, kind: str = "image folder"
    ) -> None:
        """Open the folder.

        Args:
            folder: holds the image files.
            selection: which of them to take.
            times_path: one time per image file; None = nominal rate.
            kind: for the description.

        Raises:
            SourceError: the folder cannot be read, holds no image, or the selection is empty.
        """
        try:
            files = list_images(folder)
        except OSError as error:
            raise SourceError(f"cannot read folder {folder}: {error.strerror or error}") from error
        if not files:
            raise SourceError(f"no images in {folder} (looked for {', '.join(sorted(IMAGE_SUFFIXES))})")
        nominal_ns = round(NANOSECONDS / selection.nominal_rate_hz)
        times_ns = _times(times_path, len(files), nominal_ns)
        self._files = list(selection.of(files))
        self._times_ns = list(selection.of(times_ns))
        if not self._files:
            raise SourceError(f"frames {selection} select nothing: {folder} has {len(files)} images")
        self._interval_ns = median_interval_ns(self._times_ns, nominal_ns * selection.stride)
        self.frame_count: int | None = len(self._files)
        self.frame_rate_hz: float | None = NANOSECONDS / self._interval_ns
        self.description = f"{kind} {folder}: {len(self._files)} of {len(files)} images"
        self.fingerprint = _fingerprint(files, times_path, selection)

    def frames(self) -> Iterator[Frame]:
        """The frames in time order; see :class:`vggt_motion.sources.source.Source`."""
        repair = TimestampRepair(self._interval_ns, self.description)
        for index, (path, time_ns) in enumerate(zip(self._files, self._times_ns, strict=True)):
            try:
                encoded, media_type = _read(path)
            except SourceError as error:
                if index == 0:
                    raise
                raise SourceTruncatedError(f"frame {index}: {error}; the {index} frames before it are used") from error
            yield Frame(index=index, capture_time_ns=repair(time_ns), encoded=encoded, media_type=media_type)

    def close(self) -> None:
        """Nothing is held open."""


def _read(path: Path) -> tuple[bytes, str]:
    try:
        encoded = path.read_bytes()
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror or error}") from error
    try:
        if not is_jpeg_or_png(encoded):
            encoded = transcode_to_png(encoded)
        return encoded, checked_media_type(encoded)
    except CodecError as error:
        raise SourceError(f"{path} is {error}") from error


def _times(path: Path | None, image_count: int, nominal_ns: int) -> list[int]:
    times = read_times(path) if path is not None else []
    missing = image_count - len(times)
    if missing > 0:
        if times:
            _log.warning(
                "%s has %d times for %d images; the rest is continued at the median interval",
                path,
                len(times),
                image_count,
            )
        step = median_interval_ns(times, nominal_ns)
        start = times[-1] + step if times else 0
        times.extend(start + step * k for k in range(missing))
    return times[:image_count]


def _fingerprint(files: list[Path], times_path: Path | None, selection: Selection) -> str:
    """Names and sizes of all files, the bytes of the first and the last, and the times."""
    digest = hashlib.sha256()
    try:
        for path in files:
            digest.update(f"{path.name}\0{path.stat().st_size}\0".encode(errors="surrogateescape"))
        for path in (files[0], files[-1], *([times_path] if times_path is not None else [])):
            digest.update(path.read_bytes())
    except OSError as error:
        raise SourceError(f"cannot read {error.filename}: {error.strerror or error}") from error
    return f"images:{digest.hexdigest()}:{selection}:{selection.nominal_rate_hz:g}Hz"


def times_beside(folder: Path) -> Path | None:
    """The file of times in a folder of images or in the folder above it."""
    for candidate in (folder, folder.parent):
        for name in TIME_FILES:
            if (candidate / name).is_file():
                return candidate / name
    return None
