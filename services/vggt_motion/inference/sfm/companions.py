"""What moves along and fills much of the view, as a truck ahead: where it is, before anything is solved.

It hardly moves in the image, and what moves so is one piece: one similarity takes its corners from a keyframe to the
next. So does the far background, and in a turn on the spot the whole scene; which of the two it is, geometry has to say
(``predictor.py``). Only where so much of the image moves so that it could be mistaken for the scene is it looked into.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.inference.sfm import features
from vggt_motion.inference.sfm.images import WorkingImages
from vggt_motion.inference.sfm.tracks import Tracks

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

_SIMILARITY_PX = 1.5
_MIN_MATCHES = 12
_CELLS_ACROSS = 10
_MIN_IN_CELL = 3
_MIN_SHARE = 0.3  # of the image's parts; on open roads it is 0.05 to 0.2, in turns up to 0.4, behind a truck half
_MIN_STEPS = 2
_MIN_SIMILAR = 20  # matched features by which it is found again
_MIN_SIMILAR_SHARE = 0.5
_MIN_LEFT = 0.02  # of the image; what is left of it then is no matter
_PLANE_PX = 2.0
_FLAT_SHARE = 0.85
_REACH_OVER_WIDTH = 0.05  # around a corner of it, the image belongs to it unless another corner is nearer
_MARGIN_OVER_WIDTH = 0.015  # beyond it: corners at its edge belong to nothing


@dataclass(frozen=True)
class Companion:
    """A part of the image that moves as one piece.

    Attributes:
        points: (count,) points of the tracks that belong to it wherever it was found, and once at least.
        others: (count,) points that never do, and were followed beside it once at least.
        hidden: position of the keyframe -> (H, W), where it hides the scene.
    """

    points: Mask
    others: Mask
    hidden: dict[int, Mask]


def find(tracks: Tracks, positions: Sequence[int], working: WorkingImages) -> Companion | None:
    """The piece that fills the most of the image, None where none fills enough of it over enough steps.

    Args:
        tracks: through all of ``positions``, with the corners that got lost.
        positions: the keyframes in time order.
        working: the images of the tracks.
    """
    width_px, shape = working.width_px, (working.height_px, working.width_px)
    inside = np.zeros(tracks.count, dtype=np.int64)
    outside = np.zeros(tracks.count, dtype=np.int64)
    steps = 0
    own: dict[int, list[Array]] = {position: [] for position in positions}
    others: dict[int, list[Array]] = {position: [] for position in positions}
    for a, b in itertools.pairwise(positions):
        points, at_a, at_b = tracks.between(a, b)
        lost = tracks.lost_pixel[tracks.lost_frame == a]
        if len(points) < _MIN_MATCHES:
            continue
        moves_along = _one_piece(at_a, at_b)
        if _share(at_a, moves_along, lost, width_px) < _MIN_SHARE:
            continue
        steps += 1
        inside[points[moves_along]] += 1
        outside[points[~moves_along]] += 1
        others[a].append(lost)
        for position, at in ((a, at_a), (b, at_b)):
            own[position].append(at[moves_along])
            others[position].append(at[~moves_along])
    if steps < min(_MIN_STEPS, len(positions) - 1) or steps == 0:
        return None
    hidden = {p: _around(np.concatenate(own[p]), np.concatenate(others[p]), shape) for p in positions if own[p]}
    return Companion((inside > 0) & (outside == 0), (outside > 0) & (inside == 0), hidden)


def followed_on(companion: Companion, positions: Sequence[int], working: WorkingImages) -> Companion:
    """The same, with where it is in the keyframes before and after those in which it was found.

    There it comes in or leaves, faster than tracks follow.
    """
    hidden = dict(companion.hidden)
    for order in (list(positions), list(positions)[::-1]):
        for a, b in itertools.pairwise(order):
            if a in hidden and b not in hidden:
                moved = _found_again(working, a, b, hidden[a])
                if moved is not None:
                    hidden[b] = moved
    return replace(companion, hidden=hidden)


def _found_again(working: WorkingImages, a: int, b: int, mask: Mask) -> Mask | None:
    """Where (H, W) that is in ``b`` which ``mask`` shows in ``a``; None where it is not seen."""
    before, after = features.detect(working.grey[a], mask), features.detect(working.grey[b], working.usable)
    rows = features.match(before, after)
    if len(rows) < _MIN_SIMILAR:
        return None
    at_a, at_b = before.points[rows[:, 0]], after.points[rows[:, 1]]
    model, agreeing = cv2.estimateAffinePartial2D(
        at_a, at_b, method=cv2.RANSAC, ransacReprojThreshold=_SIMILARITY_PX, maxIters=1000, confidence=0.999
    )
    if model is None or agreeing.sum() < max(_MIN_SIMILAR, _MIN_SIMILAR_SHARE * len(rows)):
        return None
    height, width = mask.shape
    moved = cv2.warpAffine(mask.astype(np.uint8), model, (width, height), flags=cv2.INTER_NEAREST) > 0
    return np.asarray(moved) if moved.mean() > _MIN_LEFT else None


def is_flat(tracks: Tracks, positions: Sequence[int]) -> bool:
    """Whether what the tracks follow may be one plane, as the side of something that passes."""
    shares = []
    for a, b in itertools.pairwise(positions):
        _, at_a, at_b = tracks.between(a, b)
        if len(at_a) >= _MIN_MATCHES:
            _, agreeing = cv2.findHomography(at_a, at_b, cv2.RANSAC, _PLANE_PX)
            shares.append(0.0 if agreeing is None else float(np.mean(agreeing)))
    return bool(shares) and float(np.median(shares)) > _FLAT_SHARE


def _one_piece(at_a: Array, at_b: Array) -> Mask:
    """Points (N,) that the similarity moves which moves the most of them."""
    model, agreeing = cv2.estimateAffinePartial2D(
        at_a, at_b, method=cv2.RANSAC, ransacReprojThreshold=_SIMILARITY_PX, maxIters=1000, confidence=0.999
    )
    return np.zeros(len(at_a), dtype=np.bool_) if model is None else np.asarray(agreeing.ravel() > 0)


def _share(followed: Array, moves_along: Mask, lost: Array, width_px: int) -> float:
    """Share of the image's parts most of whose corners move along; lost ones do not."""
    cells = np.floor(np.concatenate([followed, lost]) / (width_px / _CELLS_ACROSS)).astype(np.int64)
    _, index = np.unique(cells, axis=0, return_inverse=True)
    total = np.bincount(index.ravel())
    along = np.bincount(index.ravel()[: len(followed)][moves_along], minlength=len(total))
    counted = total >= _MIN_IN_CELL
    return float((along[counted] > 0.5 * total[counted]).mean()) if counted.any() else 0.0


def _around(own: Array, others: Array, shape: tuple[int, int]) -> Mask:
    """Pixels (H, W) that are nearer to a corner of the piece than to any other, and near to it."""
    near = _distance(own, shape)
    margin = max(3, round(_MARGIN_OVER_WIDTH * shape[1]))
    mask = (near < _REACH_OVER_WIDTH * shape[1]) & (near < _distance(others, shape))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def _distance(points: Array, shape: tuple[int, int]) -> npt.NDArray[np.float32]:
    """Distance (H, W) to the nearest of the points."""
    empty = np.ones(shape, dtype=np.uint8)
    if not len(points):
        return np.full(shape, np.inf, dtype=np.float32)
    column = np.clip(np.rint(points[:, 0]).astype(np.int64), 0, shape[1] - 1)
    row = np.clip(np.rint(points[:, 1]).astype(np.int64), 0, shape[0] - 1)
    empty[row, column] = 0
    return np.asarray(cv2.distanceTransform(empty, cv2.DIST_L2, 3), dtype=np.float32)
