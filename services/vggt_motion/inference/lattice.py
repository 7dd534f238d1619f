"""How a network's small image lies in the recorded one, and how its outputs come back to the whole image.

Networks want a fixed width and sides divisible by their patch, and cut what is too tall. A prediction has to cover the
whole image (same pixel, same ray): what was cut away comes back as depth 0, confidence 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.inference.predictor import KeyframeImage, PredictedFrame, Prediction, PredictionHints
from vggt_motion.records import ScaleKind, SubmapQuality, SubmapVerdict

_MIN_KNOWN_SHARE = 0.01


@dataclass(frozen=True)
class Lattice:
    """A resize of the whole image and a window of it that the network sees. Sizes in pixels."""

    width_px: int  # of the whole image after the resize
    height_px: int
    window_width_px: int  # of what the network sees
    window_height_px: int
    left_px: int = 0  # where the window begins in the resized image
    top_px: int = 0

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the resized image that the network sees."""
        return (
            slice(self.top_px, self.top_px + self.window_height_px),
            slice(self.left_px, self.left_px + self.window_width_px),
        )

    def whole(self, maps: npt.NDArray[np.generic]) -> npt.NDArray[np.float32]:
        """Maps (h, w) of the window laid into zeros of the whole image, (height_px, width_px) float32."""
        result = np.zeros((self.height_px, self.width_px), dtype=np.float32)
        result[self.window] = maps
        return result


def fit_width(image_width_px: int, image_height_px: int, width_px: int, multiple_px: int) -> Lattice:
    """VGGT's own pre-processing: a fixed width, the height rounded to the patch, the middle of what is too tall."""
    height = max(multiple_px, round(image_height_px * (width_px / image_width_px) / multiple_px) * multiple_px)
    window_height = min(height, width_px)
    return Lattice(width_px, height, width_px, window_height, top_px=(height - window_height) // 2)


def fit_area(image_width_px: int, image_height_px: int, max_pixels: int, multiple_px: int) -> Lattice:
    """Both sides divisible by the patch, the shape kept as well as that allows, at most ``max_pixels``, nothing cut."""
    scale = min(1.0, (max_pixels / (image_width_px * image_height_px)) ** 0.5)
    columns = max(1, round(image_width_px * scale / multiple_px))
    rows = max(1, round(image_height_px * scale / multiple_px))
    while columns * rows * multiple_px**2 > max_pixels and columns * rows > 1:
        # Shorten the side that has been rounded up the most, so that the shape stays.
        if rows == 1 or (columns > 1 and columns * image_height_px > rows * image_width_px):
            columns -= 1
        else:
            rows -= 1
    width, height = columns * multiple_px, rows * multiple_px
    return Lattice(width, height, width, height)


def common_size(images: Sequence[KeyframeImage]) -> tuple[int, int] | str:
    """Width and height that all images share, or a line that says why they do not."""
    if not images:
        return "the submap has no images"
    height, width = images[0].pixels.shape[:2]
    for image in images:
        if image.pixels.shape[:2] != (height, width):
            other = f"{image.pixels.shape[1]}x{image.pixels.shape[0]}"
            return f"keyframe {image.keyframe_id} is {other}, the first of its submap {width}x{height}"
    return width, height


def failed(reason: str, scale_kind: ScaleKind, model: str, stage_seconds: dict[str, float] | None = None) -> Prediction:
    """A prediction without geometry and its reason."""
    nan = float("nan")
    return Prediction(
        frames=(),
        verdict=SubmapVerdict.FAILED,
        reason=reason,
        scale_kind=scale_kind,
        model=model,
        quality=SubmapQuality(0, nan, nan, nan, nan, nan),
        stage_seconds=stage_seconds or {},
    )


def assemble(
    lattice: Lattice,
    hints: PredictionHints,
    depth: npt.NDArray[np.floating],
    confidence: npt.NDArray[np.floating],
    pinhole: npt.NDArray[np.floating],
    submap_from_camera: npt.NDArray[np.floating],
    *,
    scale_kind: ScaleKind,
    model: str,
    stage_seconds: dict[str, float],
    sky: npt.NDArray[np.bool_] | None = None,
) -> Prediction:
    """Turn a network's arrays into a prediction: whole-image lattice, unknown pixels, own vehicle, sky, shared poses.

    Args:
        lattice: where the network's window lies.
        hints: of the submap; ego mask and zero-motion copies are used.
        depth: (S, h, w) along the optical axis, submap units; not finite or not positive means unknown.
        confidence: (S, h, w), brought to [0, 1] by the caller.
        pinhole: (S, 3, 3) matrices on the network's window, pixel (0, 0) being the centre of its first pixel.
        submap_from_camera: (S, 4, 4).
        scale_kind: unit of depth and translations.
        model: name and variant.
        stage_seconds: time per part.
        sky: (S, h, w), True where there is no surface.
    """
    count = len(depth)
    poses = np.asarray(submap_from_camera, dtype=np.float64)
    matrices = np.asarray(pinhole, dtype=np.float64)
    for name, values in (("poses", poses), ("intrinsics", matrices)):
        if not np.isfinite(values).all():
            return failed(f"the network returned {name} that are not numbers", scale_kind, model, stage_seconds)
    if (matrices[:, 0, 0] <= 0).any() or (matrices[:, 1, 1] <= 0).any():
        return failed("the network returned a camera without a field of view", scale_kind, model, stage_seconds)
    mask = None if hints.ego_mask is None else shrink_mask(hints.ego_mask, lattice.width_px, lattice.height_px)
    frames = []
    known_pixels = 0
    for position in range(count):
        valid = np.isfinite(depth[position]) & (depth[position] > 0) & np.isfinite(confidence[position])
        if sky is not None:
            valid &= ~sky[position]
        frame_depth = lattice.whole(np.where(valid, depth[position], 0.0))
        frame_confidence = lattice.whole(np.where(valid, np.clip(confidence[position], 0.0, 1.0), 0.0))
        if mask is not None:
            frame_depth[mask] = 0.0
            frame_confidence[mask] = 0.0
        known_pixels += int(np.count_nonzero(frame_depth))
        original = hints.zero_motion_copies.get(position, position)  # both ends of a stop share one pose
        frames.append(
            PredictedFrame(
                position=position,
                depth=frame_depth,
                confidence=frame_confidence,
                intrinsics=Intrinsics(
                    fx=float(matrices[position, 0, 0]),
                    fy=float(matrices[position, 1, 1]),
                    cx=float(matrices[position, 0, 2]) + lattice.left_px,
                    cy=float(matrices[position, 1, 2]) + lattice.top_px,
                    width_px=lattice.width_px,
                    height_px=lattice.height_px,
                ),
                submap_from_camera=se3.make(se3.nearest_rotation(poses[original, :3, :3]), poses[original, :3, 3]),
            )
        )
    if known_pixels < _MIN_KNOWN_SHARE * count * lattice.width_px * lattice.height_px:
        return failed("the network found depth almost nowhere", scale_kind, model, stage_seconds)
    return Prediction(
        frames=tuple(frames),
        verdict=SubmapVerdict.GOOD,
        reason="",
        scale_kind=scale_kind,
        model=model,
        quality=_quality(matrices[:, 0, 0] / lattice.width_px),
        stage_seconds=stage_seconds,
    )


def shrink_mask(mask: npt.NDArray[np.bool_], width_px: int, height_px: int) -> npt.NDArray[np.bool_]:
    """A mask of the recorded image on a smaller lattice: a pixel is masked if any part of it was."""
    rows = np.arange(height_px + 1) * mask.shape[0] // height_px
    columns = np.arange(width_px + 1) * mask.shape[1] // width_px
    ends_row = np.maximum(-(-np.arange(1, height_px + 1) * mask.shape[0] // height_px), rows[:-1] + 1)
    ends_column = np.maximum(-(-np.arange(1, width_px + 1) * mask.shape[1] // width_px), columns[:-1] + 1)
    total = np.zeros((mask.shape[0] + 1, mask.shape[1] + 1), dtype=np.int64)
    total[1:, 1:] = np.cumsum(np.cumsum(mask, axis=0), axis=1)
    top, bottom = rows[:-1][:, None], ends_row[:, None]
    left, right = columns[:-1][None, :], ends_column[None, :]
    return np.asarray(total[bottom, right] - total[top, right] - total[bottom, left] + total[top, left] > 0)


def _quality(focal_over_width: npt.NDArray[np.float64]) -> SubmapQuality:
    """What a network tells of itself: its focal length, the median over its frames, and not how well it knows it.

    How far its frames differ says nothing of the error that they have in common, so no sigma is claimed; without one
    the focal length stays out of the session's running estimate, of which a network could make no use.
    """
    nan = float("nan")
    return SubmapQuality(
        registered_frame_count=len(focal_over_width),
        mean_reprojection_error_px=nan,
        track_inlier_ratio=nan,
        median_parallax_deg=nan,
        focal_over_width=float(np.median(focal_over_width)),
        focal_relative_sigma=nan,
    )
