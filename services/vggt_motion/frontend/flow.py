"""Grey working images and dense optical flow between them (paper section 3.1, F_t; DESIGN 3.1).

All pixel thresholds of the frontend are meant at a width of 320 px. The working image may be wider or narrower
(``flow_width_px``); :func:`at_width` scales a threshold to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.errors import CodecError, SourceError, SourceTruncatedError
from vggt_motion.sources.encoded import checked_media_type
from vggt_motion.sources.source import Frame

Grey = npt.NDArray[np.uint8]
Flow = npt.NDArray[np.float32]

REFERENCE_WIDTH_PX = 320
CELL_PX = 4  # at the reference width; DIS "fast" solves on a quarter of the resolution, finer sampling repeats itself

_MIN_HEIGHT_PX = 48  # DIS "fast" reads outside its buffers below 32 rows (OpenCV 4 and 5)


def at_width(threshold_px: float, flow_width_px: int) -> float:
    """A threshold given at 320 px, in pixels of the working image."""
    return threshold_px * flow_width_px / REFERENCE_WIDTH_PX


def median(values: npt.NDArray[np.floating]) -> float:
    """Median of (N,) finite values, N > 0; several times faster than numpy's on so few."""
    low, high = (values.size - 1) // 2, values.size // 2
    ordered = np.partition(values, (low, high))
    return 0.5 * (float(ordered[low]) + float(ordered[high]))


@dataclass(frozen=True)
class GreyFrame:
    """A decoded frame.

    ``pixels`` (h, w) uint8 at the working width; ``width_px`` and ``height_px`` are those of the full image as decoded
    (an orientation tag in the file is obeyed, as every later decoder does).
    """

    pixels: Grey
    width_px: int
    height_px: int


class GreyDecoder:
    """Decodes each frame once, as grey, and checks that all have one size."""

    def __init__(self, flow_width_px: int) -> None:
        self._flow_width_px = flow_width_px
        self._size: tuple[int, int] | None = None  # width, height of the first frame

    def decode(self, frame: Frame) -> GreyFrame:
        """Decode a frame and reduce it to the working width.

        Raises:
            SourceError: the very first frame is not readable or too large.
            SourceTruncatedError: a later frame is not readable, too large or has another size; the message names it.
        """
        try:
            full = _decode_grey(frame.encoded)
        except CodecError as error:
            message = f"frame {frame.index} is {error}"
            if self._size is None:
                raise SourceError(message) from error
            raise SourceTruncatedError(f"{message}; the {frame.index} frames before it are used") from error
        height, width = full.shape
        if self._size is None:
            self._size = (width, height)
        elif self._size != (width, height):
            raise SourceTruncatedError(
                f"frame {frame.index} is {width}x{height}, the frames before it are {self._size[0]}x{self._size[1]}; "
                f"the input ends there and the {frame.index} frames before it are used"
            )
        return GreyFrame(resize_grey(full, self._flow_width_px), width, height)


def _decode_grey(encoded: bytes) -> Grey:
    checked_media_type(encoded)
    try:
        pixels = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise CodecError("not a readable image")
    return np.asarray(pixels, np.uint8)


def resize_grey(full: Grey, width_px: int) -> Grey:
    """Resize (H, W) to the working width, keeping the aspect; averaging where it shrinks, so that nothing aliases."""
    height, width = full.shape
    if width == width_px:
        return full
    size = (width_px, max(1, round(height * width_px / width)))
    interpolation = cv2.INTER_AREA if width > width_px else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(full, size, interpolation=interpolation), np.uint8)


class DenseFlow:
    """Dense inverse search flow (Kroeger et al., ECCV 2016; OpenCV ``DISOpticalFlow``, preset "fast")."""

    def __init__(self) -> None:
        self._dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)

    def between(self, source: Grey, target: Grey) -> Flow:
        """Flow (h, w, 2) in px: what is at ``u`` in ``source`` is at ``u + flow[u]`` in ``target``, x before y.

        Depends on the two images only: no state is kept between calls.
        """
        height = source.shape[0]
        missing = _MIN_HEIGHT_PX - height
        if missing > 0:
            source = cv2.copyMakeBorder(source, 0, missing, 0, 0, cv2.BORDER_REPLICATE)  # type: ignore[assignment]
            target = cv2.copyMakeBorder(target, 0, missing, 0, 0, cv2.BORDER_REPLICATE)  # type: ignore[assignment]
        flow = self._dis.calc(source, target, None)  # type: ignore[call-overload]
        return np.asarray(flow[:height], np.float32)


@dataclass(frozen=True)
class CellGrid:
    """The lattice of cells on which flow and texture are looked at; a cell is ``step`` x ``step`` px."""

    step: int
    rows: int
    columns: int

    @classmethod
    def of(cls, shape: tuple[int, ...], flow_width_px: int) -> CellGrid:
        """Grid for working images of ``shape`` (h, w)."""
        step = max(1, round(CELL_PX * flow_width_px / REFERENCE_WIDTH_PX))
        return cls(step, max(1, shape[0] // step), max(1, shape[1] // step))

    @property
    def offset_px(self) -> int:
        """Position of the first cell's sample in the working image, both axes."""
        return self.step // 2

    def sample(self, flow: Flow) -> Flow:
        """Flow at the cell centres, (rows, columns, 2) in px of the working image; a copy."""
        first, step = self.offset_px, self.step
        return np.ascontiguousarray(flow[first::step, first::step][: self.rows, : self.columns])

    def mean(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        """Mean of an image (h, w) over each cell, (rows, columns)."""
        cropped = image[: self.rows * self.step, : self.columns * self.step].astype(np.float32)
        return np.asarray(cv2.resize(cropped, (self.columns, self.rows), interpolation=cv2.INTER_AREA), np.float32)

    def centres_px(self) -> npt.NDArray[np.float32]:
        """Cell centres (rows * columns, 2), x before y, in px of the working image."""
        y, x = np.mgrid[0 : self.rows, 0 : self.columns].astype(np.float32)
        centres = np.stack([x, y], axis=-1).reshape(-1, 2) * self.step + self.offset_px
        return np.asarray(centres, np.float32)


def gradient_cells(pixels: Grey, grid: CellGrid) -> npt.NDArray[np.float32]:
    """Mean absolute grey difference between neighbouring pixels in each cell, (rows, columns), both directions summed.

    Where it is small, flow is a guess of the smoothness term and says nothing about motion.
    """
    gradient = np.zeros_like(pixels)
    gradient[:, :-1] = cv2.absdiff(pixels[:, 1:], pixels[:, :-1])
    vertical = cv2.absdiff(pixels[1:], pixels[:-1])
    gradient[:-1] = cv2.add(gradient[:-1], vertical)
    return grid.mean(gradient)


class MotionProof:
    """Whether the flow says more than noise: it must explain the second image better than no motion does.

    In the dark, and where a codec flickers, DIS finds flow of a pixel or more between images of a standing camera.
    Where something really moves, following it takes away most of the difference between the images; where nothing
    does, both differences are the noise. Measured: with tau = 0.8 a standing camera keeps 0.92 to 1.0 of its votes
    static down to 8% of the contrast, where the plain ratio falls to 0.45, and no driving one gains more than 0.15.
    """

    _EXPLAINED_SHARE = 0.8
    _STRIDE = 2  # every second pixel in both directions is looked at
    _EXPOSURE = 7  # of those; differences of brightness over wider areas are the camera's, not the scene's
    _SMOOTHING = 5

    def __init__(self, grid: CellGrid, shape: tuple[int, ...]) -> None:
        """Set up for working images of ``shape`` (h, w)."""
        self._grid = grid
        self._y, self._x = np.mgrid[0 : shape[0] : self._STRIDE, 0 : shape[1] : self._STRIDE].astype(np.float32)

    def cells(self, source: Grey, target: Grey, flow: Flow) -> npt.NDArray[np.bool_]:
        """Where ``flow`` (h, w, 2) explains ``target`` better than no motion: cells (rows, columns) of ``source``."""
        every = slice(None, None, self._STRIDE)
        column, row = self._x + flow[every, every, 0], self._y + flow[every, every, 1]
        followed = cv2.remap(target, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        thin = source[every, every]
        moved = self._difference(thin, np.asarray(followed, np.uint8))
        return np.asarray(moved < self._EXPLAINED_SHARE * self._difference(thin, target[every, every]))

    def _difference(self, a: Grey, b: Grey) -> npt.NDArray[np.float32]:
        difference = a.astype(np.float32) - b
        difference -= cv2.blur(difference, (self._EXPOSURE, self._EXPOSURE))
        smooth = cv2.blur(np.abs(difference), (self._SMOOTHING, self._SMOOTHING))
        size = (self._grid.columns, self._grid.rows)
        return np.asarray(cv2.resize(smooth, size, interpolation=cv2.INTER_AREA), np.float32)
