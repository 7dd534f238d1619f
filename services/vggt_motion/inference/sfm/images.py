"""Keyframes as the predictor works on them: grey, and no wider than the working width."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.inference.predictor import KeyframeImage

GreyImage = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class WorkingImages:
    """Grey images (H, W) uint8 of one size, and where pixels may be used."""

    grey: tuple[GreyImage, ...]
    usable: npt.NDArray[np.bool_]  # (H, W), False on the vehicle and on overlays
    width_px: int
    height_px: int
    hidden: Mapping[int, npt.NDArray[np.bool_]] = field(default_factory=dict)  # position -> (H, W) of no use there

    def usable_at(self, position: int) -> npt.NDArray[np.bool_]:
        """Where pixels (H, W) of one image may be used."""
        return self.usable & ~self.hidden[position] if position in self.hidden else self.usable


def fitted_size(width_px: int, height_px: int, max_width_px: int) -> tuple[int, int]:
    """Width and height of an image reduced, never enlarged, to at most ``max_width_px``."""
    if width_px <= max_width_px:
        return width_px, height_px
    return max_width_px, max(1, round(height_px * max_width_px / width_px))


def reduce_image(image: npt.NDArray[np.uint8], width_px: int, height_px: int) -> npt.NDArray[np.uint8]:
    """The image resized by area averaging, so that fine texture does not alias."""
    if image.shape[1] == width_px and image.shape[0] == height_px:
        return image
    return np.asarray(cv2.resize(image, (width_px, height_px), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def prepare(
    images: Sequence[KeyframeImage],
    ego_mask: npt.NDArray[np.bool_] | None,
    max_width_px: int,
    fx_over_fy: float = 1.0,
) -> WorkingImages:
    """Grey working images of the keyframes, all of the first one's size, with square pixels."""
    height, width = images[0].pixels.shape[:2]
    working_width, working_height = fitted_size(width, max(1, round(height * fx_over_fy)), max_width_px)
    grey = tuple(
        reduce_image(
            np.asarray(cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY), dtype=np.uint8), working_width, working_height
        )
        for image in images
    )
    return WorkingImages(grey, usable_pixels(ego_mask, working_width, working_height), working_width, working_height)


def usable_pixels(ego_mask: npt.NDArray[np.bool_] | None, width_px: int, height_px: int) -> npt.NDArray[np.bool_]:
    """(H, W) mask, False wherever any masked pixel falls into."""
    if ego_mask is None:
        return np.ones((height_px, width_px), dtype=np.bool_)
    share = cv2.resize(ego_mask.astype(np.float32), (width_px, height_px), interpolation=cv2.INTER_AREA)
    nearest = cv2.resize(ego_mask.astype(np.uint8), (width_px, height_px), interpolation=cv2.INTER_NEAREST)
    return np.asarray((share <= 0.0) & (nearest == 0), dtype=np.bool_)
