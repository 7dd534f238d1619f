"""SIFT features of keyframes and their mutual matches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.inference.sfm.images import GreyImage

_MAX_FEATURES = 2000
_CONTRAST_THRESHOLD = 0.015
_RATIO = 0.85


@dataclass(frozen=True)
class Features:
    """Features of one image: positions (N, 2) float32 in pixels, descriptors (N, 128) float32 of whole numbers."""

    points: npt.NDArray[np.float32]
    descriptors: npt.NDArray[np.float32]


def detect(image: GreyImage, usable: npt.NDArray[np.bool_]) -> Features:
    """SIFT features on usable pixels."""
    create: Any = getattr(cv2, "SIFT_create")  # noqa: B009  -- missing in the stubs of OpenCV 5
    detector = create(nfeatures=_MAX_FEATURES, contrastThreshold=_CONTRAST_THRESHOLD)
    keypoints, descriptors = detector.detectAndCompute(image, usable.astype(np.uint8) * 255)
    if not keypoints or descriptors is None:
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
    points = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float32)
    # one position can carry several orientations: the first (strongest) stands for it, or a match would be ambiguous
    _, first = np.unique(points, axis=0, return_index=True)
    first.sort()
    # RootSIFT, rounded to whole numbers: their products are exact in float32, so that no order of summation shows
    rooted = np.sqrt(descriptors[first] / np.maximum(descriptors[first].sum(axis=1, keepdims=True), 1e-6))
    return Features(points[first], np.asarray(np.rint(rooted * 255.0), dtype=np.float32))


def match(a: Features, b: Features) -> npt.NDArray[np.int64]:
    """Mutually nearest features (M, 2) of two images, indices in ``a`` and in ``b``, that pass the ratio test."""
    if len(a.points) < 2 or len(b.points) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    similarity = a.descriptors @ b.descriptors.T
    rows = np.arange(len(a.points))
    best = similarity.argmax(axis=1)
    best_value = similarity[rows, best]
    back = similarity.argmax(axis=0)
    similarity[rows, best] = -1.0
    second_value = similarity.max(axis=1)
    norm = 255.0**2
    distance = np.sqrt(np.maximum(2.0 - 2.0 * best_value / norm, 0.0))
    second_distance = np.sqrt(np.maximum(2.0 - 2.0 * second_value / norm, 1e-9))
    keep = (back[best] == rows) & (distance < _RATIO * second_distance)
    return np.stack([rows[keep], best[keep]], axis=1)
