"""Point tracks through the keyframes of a submap: corners followed by Lucas-Kanade that starts from dense flow.

Shi and Tomasi, "Good Features to Track" (1994); Kroeger et al., "Fast Optical Flow using Dense Inverse Search" (2016).
"""

from __future__ import annotations

import hashlib
import itertools
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.inference.sfm import features, parallel
from vggt_motion.inference.sfm.images import GreyImage, WorkingImages

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Points = npt.NDArray[np.float32]

_MAX_CORNERS = 1200
_CORNER_QUALITY = 0.002
_CORNER_DISTANCE_PX = 7
_CORNER_BLOCK_PX = 5
_WINDOW_PX = 15
_PYRAMID_LEVELS = 1
_ROUND_TRIP_PX = 0.7
_BORDER_PX = 4
_CELLS_ACROSS = 10
_MIN_IN_CELL = 3
_MIN_FOLLOWED = 130  # fewer tracks over a step are helped out by feature matches
_SAME_POINT_PX = 1.0
_MIN_EPIPOLAR_MATCHES = 16
_EPIPOLAR_PX = 1.5
_REMEMBERED = 16  # tracks of so many submaps, some hundred kilobytes each


@dataclass(frozen=True)
class Tracks:
    """Observations of points, sorted by point and frame; pixels of the working image, centres at whole numbers."""

    point: Index  # (O,) 0 .. count - 1
    frame: Index  # (O,) position of the keyframe
    pixel: Array  # (O, 2)
    count: int
    lost_frame: Index = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # (L,) last frame of what got lost
    lost_pixel: Array = field(
        default_factory=lambda: np.zeros((0, 2))
    )  # (L, 2) where it was; corners never followed too

    def between(self, a: int, b: int) -> tuple[Index, Array, Array]:
        """Points seen in both frames, and where: indices (M,), pixels (M, 2) in ``a`` and in ``b``."""
        in_a, in_b = np.flatnonzero(self.frame == a), np.flatnonzero(self.frame == b)
        shared, at_a, at_b = np.intersect1d(self.point[in_a], self.point[in_b], assume_unique=True, return_indices=True)
        return shared, self.pixel[in_a[at_a]], self.pixel[in_b[at_b]]

    def joined(self, other: Tracks) -> Tracks:
        """These and others, which are taken for other points; what got lost is not carried over."""
        return Tracks(
            np.concatenate([self.point, self.count + other.point]),
            np.concatenate([self.frame, other.frame]),
            np.concatenate([self.pixel, other.pixel]),
            self.count + other.count,
        )


def vanished_share(tracks: Tracks, positions: Sequence[int], width_px: int) -> float:
    """Share of the image's parts that lose most of their points over a step between frames (median over the steps).

    A camera that only turns keeps what it sees, but for what leaves at the side; one that drives behind a truck loses
    nearly everything but the truck.
    """
    shares = []
    cell_px = width_px / _CELLS_ACROSS
    for a, b in itertools.pairwise(positions):
        _, kept, _ = tracks.between(a, b)
        lost = tracks.lost_pixel[tracks.lost_frame == a]
        cells = np.floor(np.concatenate([kept, lost]) / cell_px).astype(np.int64)
        if not len(cells):
            continue
        _, index = np.unique(cells, axis=0, return_inverse=True)
        total = np.bincount(index.ravel())
        gone = np.bincount(index.ravel()[len(kept) :], minlength=len(total))
        counted = total >= _MIN_IN_CELL
        if counted.any():
            shares.append(float((gone[counted] > 0.5 * total[counted]).mean()))
    return float(np.median(shares)) if shares else 0.0


class _Memory:
    """The tracks found last.

    They depend on the images alone, and a submap is often predicted twice: with what is known of the camera by then.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._found: OrderedDict[tuple[object, ...], Tracks] = OrderedDict()

    def recall(
        self, find: Callable[[], Tracks], working: WorkingImages, positions: Sequence[int], *how: object
    ) -> Tracks:
        digest = hashlib.blake2b()
        for position in positions:
            digest.update(working.grey[position].tobytes())
            digest.update(working.usable_at(position).tobytes())
        key = (*how, working.width_px, working.height_px, tuple(positions), digest.digest())
        with self._lock:
            known = self._found.pop(key, None)
        tracks = known if known is not None else find()
        with self._lock:
            self._found[key] = tracks
            while len(self._found) > _REMEMBERED:
                self._found.popitem(last=False)
        return tracks


_MEMORY = _Memory()


def follow(working: WorkingImages, positions: Sequence[int]) -> Tracks:
    """Follow corners from keyframe to keyframe; new ones start where none is left."""
    return _MEMORY.recall(lambda: _follow(working, positions), working, positions, "follow")


def _follow(working: WorkingImages, positions: Sequence[int]) -> Tracks:
    height, width = working.height_px, working.width_px
    ids = np.zeros(0, dtype=np.int64)
    pixels = np.zeros((0, 2), dtype=np.float32)
    next_id = 0
    rows: list[tuple[Index, int, Points]] = []
    lost: list[tuple[int, Points]] = []
    flows = _flows(working, positions)
    for (a, b), flow in zip(itertools.pairwise(positions), flows, strict=True):
        fresh = _corners(working.grey[a], working.usable_at(a), pixels)
        ids = np.concatenate([ids, np.arange(next_id, next_id + len(fresh))])
        pixels = np.concatenate([pixels, fresh])
        rows.append((ids[len(ids) - len(fresh) :], a, fresh))
        next_id += len(fresh)
        moved, kept = _track(working.grey[a], working.grey[b], pixels, pixels + _sample(flow, pixels))
        inside = np.all((moved >= _BORDER_PX) & (moved <= np.array([width, height]) - 1 - _BORDER_PX), axis=1)
        kept &= inside
        nearest = np.rint(np.where(inside[:, None], moved, 0.0)).astype(np.int64)
        kept &= working.usable_at(b)[nearest[:, 1], nearest[:, 0]]
        followed, landed = ids[kept], moved[kept]
        lost.append((a, pixels[~kept]))
        rows.append((followed, b, landed))
        if len(followed) < _MIN_FOLLOWED:
            # too large a step for tracking: features do not care how far they moved
            matched_ids, new_at_a, at_b = _rejoin(working, a, b, ids[~kept], pixels[~kept], next_id)
            rows.append((np.arange(next_id, next_id + len(new_at_a)), a, new_at_a))
            rows.append((matched_ids, b, at_b))
            next_id += len(new_at_a)
            followed, landed = np.concatenate([followed, matched_ids]), np.concatenate([landed, at_b])
        ids, pixels = followed, landed
    return replace(
        _assemble(rows),
        lost_frame=np.concatenate([np.full(len(where), a, dtype=np.int64) for a, where in lost]),
        lost_pixel=np.concatenate([where for _, where in lost]).astype(np.float64),
    )


def _flows(working: WorkingImages, positions: Sequence[int]) -> list[npt.NDArray[np.float32]]:
    """Dense flow (H, W, 2) between neighbours."""
    create: Any = getattr(cv2, "DISOpticalFlow_create")  # noqa: B009  -- missing in the stubs of OpenCV 5

    def flow(pair: tuple[int, int]) -> npt.NDArray[np.float32]:
        estimator = create(cv2.DISOPTICAL_FLOW_PRESET_FAST)  # holds buffers: one for each call
        return np.asarray(estimator.calc(working.grey[pair[0]], working.grey[pair[1]], None), dtype=np.float32)

    return parallel.each(flow, list(itertools.pairwise(positions)))


def match(working: WorkingImages, positions: Sequence[int], reach: int = 4) -> Tracks:
    """Tracks of features matched between all frames up to ``reach`` apart: slower than following, but sure-footed."""
    return _MEMORY.recall(lambda: _match(working, positions, reach), working, positions, "match", reach)


def _match(working: WorkingImages, positions: Sequence[int], reach: int) -> Tracks:
    found = parallel.each(
        lambda position: features.detect(working.grey[position], working.usable_at(position)), positions
    )
    detected = dict(zip(positions, found, strict=True))
    offset = dict(zip(positions, np.cumsum([0, *(len(detected[p].points) for p in positions)]), strict=False))
    total = sum(len(found.points) for found in detected.values())
    parent = np.arange(total)

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = int(parent[node])
        return node

    for index, a in enumerate(positions):
        for b in positions[index + 1 : index + 1 + reach]:
            rows = features.match(detected[a], detected[b])
            agreeing = _epipolar_inliers(detected[a].points[rows[:, 0]], detected[b].points[rows[:, 1]])
            for row_a, row_b in rows[agreeing]:
                first, second = root(int(offset[a] + row_a)), root(int(offset[b] + row_b))
                parent[max(first, second)] = min(first, second)
    roots = np.array([root(node) for node in range(total)], dtype=np.int64)
    frame = np.concatenate([np.full(len(detected[p].points), p) for p in positions])
    pixel = np.concatenate([detected[p].points for p in positions])
    # a track that shows twice in one frame holds two points at least
    seen, count = np.unique(np.stack([roots, frame], axis=1), axis=0, return_counts=True)
    ambiguous = np.isin(roots, seen[count > 1, 0])
    kept = ~ambiguous
    rows_by_frame = [(roots[kept & (frame == p)], int(p), pixel[kept & (frame == p)]) for p in positions]
    return _assemble(rows_by_frame)


def _epipolar_inliers(at_a: Points, at_b: Points) -> npt.NDArray[np.bool_]:
    if len(at_a) < _MIN_EPIPOLAR_MATCHES:
        return np.zeros(len(at_a), dtype=np.bool_)
    cv2.setRNGSeed(0)  # the generator is the library's own and remembers earlier calls
    try:
        _, mask = cv2.findFundamentalMat(at_a, at_b, cv2.USAC_ACCURATE, _EPIPOLAR_PX, 0.999, 2000)
    except cv2.error:  # its local optimisation can end without a model, which it then asserts on
        _, mask = cv2.findFundamentalMat(at_a, at_b, cv2.FM_RANSAC, _EPIPOLAR_PX, 0.999, 2000)
    return np.zeros(len(at_a), dtype=np.bool_) if mask is None else np.asarray(mask.ravel() > 0)


def _rejoin(
    working: WorkingImages, a: int, b: int, lost_ids: Index, lost: Points, next_id: int
) -> tuple[Index, Points, Points]:
    """Continue lost tracks, and begin new ones, by matched features.

    Returns:
        ids (M,) of the matches, lost ones first taken up again, the rest numbered from ``next_id``; where the new ones
        are in ``a``; where all are in ``b``.
    """
    features_a = features.detect(working.grey[a], working.usable_at(a))
    features_b = features.detect(working.grey[b], working.usable_at(b))
    rows = features.match(features_a, features_b)
    at_a, at_b = features_a.points[rows[:, 0]], features_b.points[rows[:, 1]]
    ids = np.full(len(rows), -1, dtype=np.int64)
    if len(lost) and len(rows):
        distance = np.linalg.norm(at_a[:, None] - lost[None], axis=2)
        nearest = distance.argmin(axis=1)
        for row in np.flatnonzero(distance[np.arange(len(rows)), nearest] < _SAME_POINT_PX):
            if lost_ids[nearest[row]] not in ids:
                ids[row] = lost_ids[nearest[row]]
    order = np.argsort(ids < 0, kind="stable")
    ids, at_a, at_b = ids[order], at_a[order], at_b[order]
    fresh = ids < 0
    ids[fresh] = np.arange(next_id, next_id + int(fresh.sum()))
    return ids, at_a[fresh], at_b


def _corners(image: GreyImage, usable: npt.NDArray[np.bool_], taken: Points) -> Points:
    mask = usable.astype(np.uint8) * 255
    for x, y in np.rint(taken).astype(int):
        cv2.circle(mask, (int(x), int(y)), _CORNER_DISTANCE_PX, 0, -1)
    room = _MAX_CORNERS - len(taken)
    if room <= 0:
        return np.zeros((0, 2), dtype=np.float32)
    corners = cv2.goodFeaturesToTrack(
        image, room, _CORNER_QUALITY, _CORNER_DISTANCE_PX, mask=mask, blockSize=_CORNER_BLOCK_PX
    )
    if corners is None:
        return np.zeros((0, 2), dtype=np.float32)
    return np.asarray(corners, dtype=np.float32).reshape(-1, 2)


def _sample(flow: npt.NDArray[np.float32], pixels: Points) -> Points:
    if not len(pixels):
        return np.zeros((0, 2), dtype=np.float32)
    sampled = cv2.remap(flow, pixels[:, 0], pixels[:, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled, dtype=np.float32).reshape(-1, 2)


def _track(a: GreyImage, b: GreyImage, pixels: Points, guess: Points) -> tuple[Points, npt.NDArray[np.bool_]]:
    """Positions in ``b``, and which of them came back to where they started."""
    if not len(pixels):
        return pixels, np.zeros(0, dtype=np.bool_)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02)
    size = (_WINDOW_PX, _WINDOW_PX)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW

    def there_and_back(some: slice) -> tuple[Points, npt.NDArray[np.uint8], Points, npt.NDArray[np.uint8]]:
        start, to = pixels[some].copy(), guess[some].astype(np.float32)
        there, found, _ = cv2.calcOpticalFlowPyrLK(
            a, b, start, to, winSize=size, maxLevel=_PYRAMID_LEVELS, criteria=criteria, flags=flags
        )
        back, returned, _ = cv2.calcOpticalFlowPyrLK(
            b, a, there, start.copy(), winSize=size, maxLevel=_PYRAMID_LEVELS, criteria=criteria, flags=flags
        )
        return tuple(np.asarray(part) for part in (there, found, back, returned))  # type: ignore[return-value]

    half = len(pixels) // 2
    halves = [some for some in (slice(0, half), slice(half, None)) if len(pixels[some])]
    parts = parallel.each(there_and_back, halves)  # no point's track depends on another's
    moved, found, back, returned = (np.concatenate([part[k] for part in parts]) for k in range(4))
    close = np.linalg.norm(back - pixels, axis=1) < _ROUND_TRIP_PX
    return np.asarray(moved, dtype=np.float32), np.asarray(
        (found.ravel() > 0) & (returned.ravel() > 0) & close & np.isfinite(moved).all(axis=1), dtype=np.bool_
    )


def _assemble(rows: Sequence[tuple[Index, int, Points]]) -> Tracks:
    """Tracks of at least two frames, numbered without gaps."""
    point = np.concatenate([ids for ids, _, _ in rows]) if rows else np.zeros(0, dtype=np.int64)
    frames = [np.full(len(ids), position) for ids, position, _ in rows]
    frame = np.concatenate(frames) if rows else np.zeros(0, dtype=np.int64)
    pixel = np.concatenate([p for _, _, p in rows]).astype(np.float64) if rows else np.zeros((0, 2))
    lengths = np.bincount(point) if len(point) else np.zeros(0, dtype=np.int64)
    keep = lengths[point] >= 2
    number = np.cumsum(lengths >= 2) - 1
    point, frame, pixel = number[point[keep]], frame[keep], pixel[keep]
    order = np.lexsort((frame, point))
    return Tracks(point[order].astype(np.int64), frame[order].astype(np.int64), pixel[order], int((lengths >= 2).sum()))
