"""Whether the camera stands: S_static(t) > tau_static of paper eq. 3, made to hold in traffic (DESIGN 3.1).

The static ratio between consecutive frames alone errs both ways: while we stand, a lorry that crosses makes half of the
image move; while we creep, or drive at 60 frames/s, hardly a pixel moves by 0.7 px in one frame. So standing is a state
with memory, entered and left on different evidence:

- **Entered** when the smoothed static ratio exceeds tau_static, as printed, *and* the image has not shifted against the
  one of ``LOOKBACK_S`` before. The longer baseline tells creeping and high frame rates from standing.
- **Left** when the image has shifted against the frame at which the stop began, the *reference*. Passing traffic does
  not do this: it hides the background for a moment, and what it hides fails the forward-backward check and has no
  vote; then the background is where it was. A camera that drives off shifts everything that is not far away, and a
  creeping one adds up against the fixed reference. A median shift of tau_flow is enough when most of the image moves
  between consecutive frames as well; without that it must be larger, so that a car that rocks on its suspension, or
  rolls on by half a metre at a light, still stands.

A shift is judged by two quantiles: the median, and the upper quartile with a larger bound, for a view that is mostly
sky. Who has a vote decides more than the bounds do: cells with texture, that the ego mask leaves, that were not learned
to be fixed to the camera (``overlay.py``), and whose flow is either next to nothing or explains the image better than
no motion (``MotionProof``). The last is what noise, compression flicker and the dark need: there DIS finds flow of a
pixel between images of a standing camera. Changes of exposure it does not see, as its patches are mean-normalised; that
holds for bands of lamplight that a rolling shutter draws across the image too, as long as they are wider than a patch.

Exact repeats of a frame say nothing: in a drive they are a slow camera in a faster file, at a stop they are an encoder
that saves its work. They have no weight in the static ratio (``motion.py``); only where nothing else came does the
camera stand.

What is asked of the flow is thus consistency with one camera motion, none at all, over a baseline that grows. Other
motions need not be fitted for that (what such a fit is worth for turning is said in ``motion.py``).

The two errors do not cost the same. Motion that is called standing loses poses; standing that is called straight motion
costs next to nothing, as without parallax no frame becomes a keyframe. In doubt the camera moves.
"""

from __future__ import annotations

from collections import deque

import numpy as np
import numpy.typing as npt

from vggt_motion.frontend.flow import CellGrid, DenseFlow, Flow, Grey, MotionProof

LOOKBACK_S = 0.5
CHECK_INTERVAL_S = 0.2  # between two comparisons over a long baseline, which cost one or two flows each
EXIT_SHIFT_OVER_STATIC = 3.0  # of tau_flow: 2.1 px at 320 px, 0.4-0.5 m of forward motion on KITTI
EXIT_STATIC_RATIO = 0.6  # below it most of the image moves: then a shift of tau_flow is enough
UPPER_QUARTILE_FACTOR = 2.5  # the bound on the upper quartile over that on the median

_MIN_VOTES_SHARE = 0.05  # of all cells; with fewer votes nothing has shifted


class ShiftMeter:
    """Tells whether the image has shifted between two frames that need not be consecutive."""

    def __init__(self, flow: DenseFlow, grid: CellGrid, proof: MotionProof, static_flow_px: float) -> None:
        self._flow = flow
        self._grid = grid
        self._proof = proof
        self._static_flow_px = static_flow_px
        self._centres = grid.centres_px().reshape(grid.rows, grid.columns, 2)

    def has_shifted(
        self,
        source: Grey,
        target: Grey,
        usable: npt.NDArray[np.bool_],
        *,
        median_px: float,
        upper_quartile_px: float,
    ) -> bool:
        """Whether the median or the upper quartile of the cells' shifts is beyond its bound.

        Only cells that show the same thing in both frames have a vote in the end; that is looked into, by the flow
        back, when it matters.

        Args:
            source: working image (h, w).
            target: working image (h, w).
            usable: (rows, columns), cells of ``source`` with texture and outside the ego mask.
            median_px: bound, px of the working image.
            upper_quartile_px: bound, px of the working image.
        """

        def is_beyond(votes: npt.NDArray[np.bool_]) -> bool:
            if np.count_nonzero(votes) < _MIN_VOTES_SHARE * votes.size:
                return False
            median, quartile = np.percentile(lengths[votes], (50, 75))
            return bool(median > median_px or quartile > upper_quartile_px)

        flow = self._flow.between(source, target)
        cells = self._grid.sample(flow)
        lengths = np.hypot(cells[..., 0], cells[..., 1])
        if not is_beyond(usable):
            return False
        votes = usable & ((lengths < self._static_flow_px) | self._proof.cells(source, target, flow))
        return is_beyond(votes) and is_beyond(votes & self._returns(cells, self._flow.between(target, source)))

    def _returns(self, cells: Flow, backward: Flow) -> npt.NDArray[np.bool_]:
        """Forward-backward check: the cells whose content leads back to where it came from."""
        height, width = backward.shape[:2]
        landing = np.rint(self._centres + cells).astype(np.intp)
        column, row = landing[..., 0], landing[..., 1]
        is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        back = backward[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        error = np.hypot(*np.moveaxis(cells + back, -1, 0))
        length = np.hypot(cells[..., 0], cells[..., 1])
        return np.asarray(is_inside & (error < self._static_flow_px + 0.1 * length))


class StandingDetector:
    """The state machine described above, fed in frame order; the same input gives the same verdicts."""

    def __init__(self, meter: ShiftMeter, static_ratio: float, static_flow_px: float) -> None:
        """Set the thresholds.

        Args:
            meter: compares frames that are apart.
            static_ratio: tau_static.
            static_flow_px: tau_flow, px of the working image.
        """
        self._meter = meter
        self._static_ratio = static_ratio
        self._static_flow_px = static_flow_px
        self._reference: tuple[Grey, npt.NDArray[np.bool_]] | None = None  # image and usable cells, while standing
        self._recent: deque[tuple[int, Grey, npt.NDArray[np.bool_]]] = deque()  # time, image, usable cells
        self._next_check_ns = 0

    def decide(self, static_ratio: float, pixels: Grey, usable: npt.NDArray[np.bool_], capture_time_ns: int) -> bool:
        """Whether the camera stands at this frame.

        Args:
            static_ratio: smoothed, S_static(t).
            pixels: working image (h, w).
            usable: (rows, columns), cells with texture and outside the ego mask.
            capture_time_ns: of the frame.
        """
        self._remember(pixels, usable, capture_time_ns)
        is_due = capture_time_ns >= self._next_check_ns
        if self._reference is None:
            is_due = is_due and static_ratio > self._static_ratio
            if is_due and not self._has_shifted_lately(pixels):
                self._reference = (pixels, usable)
        else:
            is_due = is_due or static_ratio < EXIT_STATIC_RATIO
            if is_due and self._has_left(pixels, static_ratio):
                self._reference = None
        if is_due:
            self._next_check_ns = capture_time_ns + round(CHECK_INTERVAL_S * 1e9)
        return self._reference is not None

    def _remember(self, pixels: Grey, usable: npt.NDArray[np.bool_], capture_time_ns: int) -> None:
        """Keep what is younger than the look-back, and one frame that is not."""
        self._recent.append((capture_time_ns, pixels, usable))
        while len(self._recent) > 2 and capture_time_ns - self._recent[1][0] >= LOOKBACK_S * 1e9:
            self._recent.popleft()

    def _has_shifted_lately(self, pixels: Grey) -> bool:
        _, before, usable = self._recent[0]
        bound_px = self._static_flow_px
        return self._meter.has_shifted(
            before, pixels, usable, median_px=bound_px, upper_quartile_px=UPPER_QUARTILE_FACTOR * bound_px
        )

    def _has_left(self, pixels: Grey, static_ratio: float) -> bool:
        assert self._reference is not None
        reference, usable = self._reference
        bound_px = EXIT_SHIFT_OVER_STATIC * self._static_flow_px
        return self._meter.has_shifted(
            reference,
            pixels,
            usable,
            median_px=self._static_flow_px if static_ratio < EXIT_STATIC_RATIO else bound_px,
            upper_quartile_px=UPPER_QUARTILE_FACTOR * bound_px,
        )
