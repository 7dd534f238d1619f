"""Keyframe selection: static pruning and the choice by viewpoint change (paper section 3.1, Algorithm 1 step 1).

Repairs of DESIGN 3.2: the first and the last readable frame are keyframes; boundary keyframes of a stop become I_last
too; of a stop exactly the first and the last frame stay, and the last is known only when motion resumes or the stream
ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.config import FrontendConfig
from vggt_motion.frontend.flow import CellGrid, Flow, Grey, at_width, median
from vggt_motion.records import DropReason, MotionState
from vggt_motion.sources.source import Frame

STOP_MAX_FRAMES = 10_000  # a longer stop gets a boundary in between, or a parked camera would fill the memory

ROTATION_WEIGHT = 0.3  # a common shift of 20 px at the default threshold: 6 degrees with KITTI's lens

# A truck ahead that fills half of the view: up to the median the displacements are its own, far below those of the rest
COMPANION_SHARE = 0.4
COMPANION_RATIO = (
    8.0  # of the upper quartile to that quantile; on open roads it is not reached before a keyframe is due
)

_STRIDE = 2  # every second cell in both directions: 480 points at 320x97, of which a median needs no more
_RESEED_SHARE = 0.7  # of the points; with fewer left their middle is what few outliers say


@dataclass(frozen=True)
class Candidate:
    """A frame with its motion state, ready to be selected or dropped.

    Attributes:
        frame: the encoded frame.
        pixels: working image (h, w).
        width_px: of the full image.
        height_px: of the full image.
        state: motion state.
        flow_cells: (rows, columns, 2) flow from the frame before to this one, px; None for the first frame.
        usable: (rows, columns), cells with texture that are neither masked nor fixed to the camera.
        fixed: (rows, columns), cells that are fixed to the camera, as far as is known.
    """

    frame: Frame
    pixels: Grey
    width_px: int
    height_px: int
    state: MotionState
    flow_cells: Flow | None
    usable: npt.NDArray[np.bool_]
    fixed: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Selected:
    """The verdict on one frame; verdicts come in frame order.

    Attributes:
        candidate: the frame.
        drop_reason: None for a keyframe.
        parallax_px: accumulated parallax against the last keyframe before this frame, px of the working image.
        zero_motion_copy_of: frame index of the keyframe at the other end of the stop.
    """

    candidate: Candidate
    drop_reason: DropReason | None
    parallax_px: float
    zero_motion_copy_of: int | None = None

    @property
    def is_keyframe(self) -> bool:
        """Whether the frame is kept."""
        return self.drop_reason is None


class ParallaxTracker:
    """Parallax against the last keyframe, Palx(I_t, I_last), beyond the reach of the flow method.

    A lattice of points is laid on the textured cells of the keyframe and carried along by the flow between consecutive
    frames: that is small and thus reliable however far the keyframe is.

    The parallax is the median length of the points' displacements without their common shift, or ``ROTATION_WEIGHT``
    of the common shift, whichever is larger. The common shift is what rotation does to an image; it moves everything
    and tells nothing about depth. With the plain median a turn makes every frame a keyframe, with a baseline of 0.4 m
    on KITTI 00 where straight driving has 2 m; without the shift a camera that only rotates would never get one.

    Behind a truck that fills half of the view the median is the truck's, which hardly moves, while the rest rushes by.
    Where the displacements part like that, far more than depth makes them, their upper quartile stands for the median.

    Points that have left the image are the near ones; they rank above those that are left. Without them the median
    would come to a halt at what the horizon moves, as it did for a second on a motorway. When too many have left,
    what was reached is kept and new points are laid.
    """

    def __init__(self, grid: CellGrid, shape: tuple[int, int]) -> None:
        """Set up for working images of ``shape`` (h, w)."""
        self._grid = grid
        self._centres = grid.centres_px().reshape(grid.rows, grid.columns, 2)[::_STRIDE, ::_STRIDE].reshape(-1, 2)
        self._limit = np.array([shape[1] - 1, shape[0] - 1], np.float32)
        self._seeds = self._positions = self._centres
        self._seed_count = len(self._centres)
        self._reached_px = 0.0
        self._reached_share = 1.0

    def restart(self, usable: npt.NDArray[np.bool_]) -> None:
        """Begin anew at a keyframe with these usable cells (rows, columns)."""
        self._reached_px = 0.0
        self._reached_share = 1.0
        self._lay_points(usable)

    def advance(self, flow_cells: Flow, usable: npt.NDArray[np.bool_], fixed: npt.NDArray[np.bool_]) -> None:
        """Carry the points to the next frame.

        Args:
            flow_cells: (rows, columns, 2) px, from the frame where the points are to the next one.
            usable: cells of the next frame, for new points.
            fixed: cells that are known by now to be fixed to the camera: points there never were of the scene.
        """
        grid = self._grid
        lattice = (self._positions - grid.offset_px) / grid.step
        step = cv2.remap(flow_cells, lattice[:, None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        nearest = np.rint(lattice).astype(np.intp)
        column, row = np.clip(nearest[:, 0], 0, grid.columns - 1), np.clip(nearest[:, 1], 0, grid.rows - 1)
        is_scene = ~fixed[row, column]
        self._seed_count -= len(is_scene) - int(np.count_nonzero(is_scene))
        positions = self._positions + np.asarray(step, np.float32)[:, 0]
        stays = is_scene & ((positions >= 0) & (positions <= self._limit)).all(axis=1)
        self._positions, self._seeds = positions[stays], self._seeds[stays]
        if len(self._positions) < _RESEED_SHARE * self._seed_count or self._seed_count <= 0:
            self._reached_px, self._reached_share = self.parallax_px, self.covisible_share
            self._lay_points(usable)

    @property
    def parallax_px(self) -> float:
        """Parallax since the keyframe, px of the working image."""
        if len(self._positions) == 0:
            return self._reached_px
        displacement = self._positions - self._seeds
        common_x, common_y = median(displacement[:, 0]), median(displacement[:, 1])
        lengths = np.hypot(displacement[:, 0] - common_x, displacement[:, 1] - common_y)
        last = len(lengths) - 1  # quantiles are of all points, those that have left being the last
        ranks = [min(int(share * self._seed_count), last) for share in (COMPANION_SHARE, 0.5, 0.75)]
        companion, spread, quartile = (float(length) for length in np.partition(lengths, ranks)[ranks])
        if quartile > COMPANION_RATIO * companion:
            spread = quartile
        return self._reached_px + max(spread, ROTATION_WEIGHT * math.hypot(common_x, common_y))

    @property
    def covisible_share(self) -> float:
        """Share of the keyframe's points that are still in the image."""
        return self._reached_share * len(self._positions) / max(1, self._seed_count)

    def _lay_points(self, usable: npt.NDArray[np.bool_]) -> None:
        chosen = usable[::_STRIDE, ::_STRIDE].reshape(-1)
        self._seeds = self._positions = self._centres[chosen] if chosen.any() else self._centres
        self._seed_count = len(self._seeds)


class Strategy(Protocol):
    """When a moving frame becomes a keyframe."""

    drop_reason: DropReason

    def is_due(self, frame_index: int, last_index: int, tracker: ParallaxTracker) -> bool:
        """Whether the frame is to be kept, given the last keyframe and the motion since."""
        ...


class Dense:
    """Every frame."""

    drop_reason = DropReason.STRATEGY

    def is_due(self, frame_index: int, last_index: int, tracker: ParallaxTracker) -> bool:
        """Always."""
        return True


@dataclass(frozen=True)
class Uniform:
    """Every so many frames."""

    stride: int
    drop_reason = DropReason.STRATEGY

    def is_due(self, frame_index: int, last_index: int, tracker: ParallaxTracker) -> bool:
        """By distance in frames."""
        return frame_index - last_index >= self.stride


@dataclass(frozen=True)
class Covisibility:
    """When too little of the last keyframe is still in view."""

    ratio: float
    drop_reason = DropReason.LOW_PARALLAX

    def is_due(self, frame_index: int, last_index: int, tracker: ParallaxTracker) -> bool:
        """By the share of points still in the image."""
        return tracker.covisible_share < self.ratio


@dataclass(frozen=True)
class Parallax:
    """When the image has shifted enough against the last keyframe (Algorithm 1)."""

    threshold_px: float  # of the working image
    drop_reason = DropReason.LOW_PARALLAX

    def is_due(self, frame_index: int, last_index: int, tracker: ParallaxTracker) -> bool:
        """By the median displacement."""
        return tracker.parallax_px > self.threshold_px


def create_strategy(config: FrontendConfig) -> Strategy:
    """The strategy that ``frontend.selection`` names."""
    strategies: dict[str, Callable[[], Strategy]] = {
        "dense": Dense,
        "uniform": lambda: Uniform(config.uniform_stride),
        "covisibility": lambda: Covisibility(config.covisibility_ratio),
        "parallax": lambda: Parallax(at_width(config.parallax_px, config.flow_width_px)),
    }
    return strategies[config.selection]()


class KeyframeSelector:
    """Decides on each frame, in order; a dropped frame is held back by one, as the stream may end with it."""

    def __init__(
        self,
        strategy: Strategy,
        tracker: ParallaxTracker,
        *,
        static_pruning: bool,
    ) -> None:
        """Set up.

        Args:
            strategy: for moving frames (and for standing ones without pruning).
            tracker: measures the motion since the last keyframe.
            static_pruning: keep only the first and the last frame of a stop.
        """
        self._strategy = strategy
        self._tracker = tracker
        self._static_pruning = static_pruning
        self._last_index: int | None = None
        self._stop_first: Candidate | None = None
        self._stop_length = 0
        self._held: Selected | None = None  # the frame before, so far not a keyframe

    def push(self, candidate: Candidate) -> Iterator[Selected]:
        """Take the next frame; yields verdicts on it or on the frame before."""
        is_standing = self._static_pruning and candidate.state is MotionState.STATIC
        is_inside_stop = is_standing and self._stop_first is not None
        # inside a stop there is nothing to measure: its last frame is where the next stretch begins
        if candidate.flow_cells is not None and not is_inside_stop:
            self._tracker.advance(candidate.flow_cells, candidate.usable, candidate.fixed)
        if is_standing:
            yield from self._push_standing(candidate)
        else:
            yield from self._push_moving(candidate)

    def finish(self) -> Iterator[Selected]:
        """The last readable frame is always a keyframe."""
        if self._held is not None:
            yield self._keep_held()

    def _push_standing(self, candidate: Candidate) -> Iterator[Selected]:
        if self._stop_first is None:
            yield from self._drop_held()
            self._stop_first, self._stop_length = candidate, 1
            yield self._keep(candidate)
            return
        self._stop_length += 1
        if self._stop_length > STOP_MAX_FRAMES and self._held is not None:
            boundary = self._held.candidate
            yield self._keep_held()
            self._stop_first, self._stop_length = boundary, 2
        yield from self._drop_held()
        self._held = Selected(candidate, DropReason.STATIC, self._tracker.parallax_px)

    def _push_moving(self, candidate: Candidate) -> Iterator[Selected]:
        if self._stop_first is not None:
            if self._held is not None:
                yield self._keep_held()
                if candidate.flow_cells is not None:
                    # the tracker was taken to this frame already; the kept frame before it is where it has to start
                    self._tracker.advance(candidate.flow_cells, candidate.usable, candidate.fixed)
            self._stop_first = None
        yield from self._drop_held()
        index = candidate.frame.index
        if self._last_index is None or self._strategy.is_due(index, self._last_index, self._tracker):
            yield self._keep(candidate)
        else:
            self._held = Selected(candidate, self._strategy.drop_reason, self._tracker.parallax_px)

    def _keep(self, candidate: Candidate, copy_of: int | None = None, parallax_px: float | None = None) -> Selected:
        reached = self._tracker.parallax_px if parallax_px is None else parallax_px
        self._last_index = candidate.frame.index
        self._tracker.restart(candidate.usable)
        return Selected(candidate, None, reached, copy_of)

    def _keep_held(self) -> Selected:
        assert self._held is not None
        held, self._held = self._held, None
        copy_of = None if self._stop_first is None else self._stop_first.frame.index
        return self._keep(held.candidate, copy_of, held.parallax_px)

    def _drop_held(self) -> Iterator[Selected]:
        if self._held is not None:
            held, self._held = self._held, None
            yield held
