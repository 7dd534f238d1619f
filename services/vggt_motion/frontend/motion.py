"""Motion state from optical flow: scores, smoothing, classification (paper eq. 1 to 3, DESIGN 3.1).

Everything here is a causal computation with a fixed look-ahead, fed frame by frame, so that a live stream and a file
give the same states. What decides about standing is in ``standing.py``.

The yaw score is the common shift of the middle of the image, in pixels: without calibration the angle is not known.
tau_turn = 1.6 px per 0.1 s is 5 degrees/s for KITTI's field of view of 81 degrees and 3 for one of 57 degrees. On the
road that is enough. A camera in the hand, close to what it sees, shifts the image by moving sideways as well, and this
score does not tell that from turning (F1 0.65 on RedKitchen; the true yaw rate behind the same threshold in pixels has
0.86). A fit of rotation and direction of translation to the flow does, to 0.82, but on a road, where sideways motion
and turning look alike, it is worse (KITTI 00: 0.60 where the shift has 0.98), and it costs more than DIS itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vggt_motion.frontend.flow import Flow, median
from vggt_motion.records import MotionState

RATE_INTERVAL_S = (
    0.1  # turning scores are flow per 0.1 s, the frame interval of KITTI: they then do not depend on the rate
)

_MIN_TEXTURED_SHARE = 0.02
# Static ratios that noise can have changed so much that it matters; below, no noise is as strong: something moves.
_AMBIGUOUS_RATIOS = (0.2, 0.97)


@dataclass(frozen=True)
class FlowMeasures:
    """What the flow between the previous frame and this one says.

    Attributes:
        static_ratio: share of quasi-static cells among those that have a vote (eq. 1 on cells with texture whose flow
            is either quasi-static or proven), in [0, 1].
        lateral_px: mean of |f_x| over all cells (eq. 2), px of the working image.
        yaw_px: median of f_x over the textured cells, signed, px of the working image; positive when the scene moves
            to the right, i.e. the camera turns left.
        interval_s: time between the two frames.
        is_repeat: the two images are identical, pixel for pixel; nothing is known of the motion between them.
    """

    static_ratio: float
    lateral_px: float
    yaw_px: float
    interval_s: float
    is_repeat: bool


def measure_flow(
    flow_cells: Flow,
    textured: npt.NDArray[np.bool_],
    *,
    static_flow_px: float,
    interval_s: float,
    is_repeat: bool = False,
    prove_motion: Callable[[], npt.NDArray[np.bool_]] | None = None,
) -> FlowMeasures:
    """Static ratio and both turning scores of one flow field.

    Only cells with texture count for the static ratio and the yaw score: in the dark, in the sky and on a plain road
    the flow is a guess that is drawn to zero, and would make a night drive stand still. For the yaw score the middle
    of the image
    counts: there forward motion moves things least, and a turn moves them as much as at the sides.

    Args:
        flow_cells: (rows, columns, 2) px.
        textured: (rows, columns), cells to be believed.
        static_flow_px: tau_flow.
        interval_s: time between the two frames, positive.
        is_repeat: the images were identical.
        prove_motion: gives the cells (rows, columns) whose flow is more than noise; the others, if they are not
            quasi-static, have no vote in the static ratio. Only called where that can matter.
    """
    f_x = flow_cells[..., 0]
    believed = _or_all(textured)
    columns = f_x.shape[1]
    middle = slice(columns // 4, columns - columns // 4)
    is_static = is_quasi_static(flow_cells, static_flow_px)
    static_ratio = float(np.mean(is_static[believed]))
    if prove_motion is not None and _AMBIGUOUS_RATIOS[0] < static_ratio < _AMBIGUOUS_RATIOS[1]:
        votes = believed & (is_static | prove_motion())
        static_ratio = float(np.mean(is_static[votes]))
    return FlowMeasures(
        static_ratio=static_ratio,
        lateral_px=float(np.mean(np.abs(f_x))),
        yaw_px=median(f_x[:, middle][_or_all(textured[:, middle])]),
        interval_s=interval_s,
        is_repeat=is_repeat,
    )


def _or_all(textured: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """The textured cells, or all where there is next to no texture."""
    return textured if textured.mean() >= _MIN_TEXTURED_SHARE else np.ones_like(textured)


def is_quasi_static(flow_cells: Flow, static_flow_px: float) -> npt.NDArray[np.bool_]:
    """Where the flow (..., 2) is shorter than tau_flow (the indicator of eq. 1)."""
    return np.asarray(np.einsum("...i,...i->...", flow_cells, flow_cells) < static_flow_px**2)


@dataclass(frozen=True)
class MotionProfile:
    """Smoothed scores of one frame, S_static(t) and S_turn(t), before thresholds.

    Attributes:
        static_ratio: in [0, 1].
        lateral_px: mean |f_x| per 0.1 s.
        yaw_px: signed common shift per 0.1 s.
        has_evidence: False where every flow in the window was between identical images; the rest is then static.
    """

    static_ratio: float
    lateral_px: float
    yaw_px: float
    has_evidence: bool


class ProfileSmoother:
    """Temporal Gaussian smoothing with a fixed look-ahead.

    The profile of frame t is the weighted mean over the measures of frames t - n ... t + n, cut off at the ends of
    the stream and normalised; n is the look-ahead. Turning scores are sums of flow over sums of time: dropped frames,
    jitter of the time stamps and repeated images then change nothing. Repeated images are no evidence of standing and
    get no weight in the static ratio.
    """

    def __init__(self, sigma_frames: float, lookahead_frames: int) -> None:
        """Set the window.

        Args:
            sigma_frames: standard deviation; 0 = no smoothing.
            lookahead_frames: n. The profile of a frame is known when so many frames after it have come.
        """
        self.lookahead_frames = lookahead_frames
        offsets = np.arange(-lookahead_frames, lookahead_frames + 1, dtype=np.float64)
        if sigma_frames > 0:
            self._weights = np.exp(-0.5 * (offsets / sigma_frames) ** 2)
        else:
            self._weights = (offsets == 0).astype(np.float64)
        self._window: deque[FlowMeasures | None] = deque([None] * len(self._weights), maxlen=len(self._weights))
        self._pushed = 0

    def push(self, measures: FlowMeasures | None) -> MotionProfile | None:
        """Take the measures of the next frame (None for the first, which has no flow).

        Returns:
            The profile of the frame that is ``lookahead_frames`` behind, or None while there is no such frame yet.
        """
        self._window.append(measures)
        self._pushed += 1
        return self._profile() if self._pushed > self.lookahead_frames else None

    def finish(self) -> Iterator[MotionProfile]:
        """The profiles of the frames that are still waiting for their look-ahead, in order."""
        for _ in range(self.lookahead_frames):
            profile = self.push(None)
            if profile is not None:
                yield profile

    def _profile(self) -> MotionProfile:
        weight_sum = static = seconds = lateral = yaw = 0.0
        for weight, measures in zip(self._weights, self._window, strict=True):
            if measures is None or weight == 0.0:
                continue
            seconds += weight * measures.interval_s
            lateral += weight * measures.lateral_px
            yaw += weight * measures.yaw_px
            if not measures.is_repeat:
                weight_sum += weight
                static += weight * measures.static_ratio
        if weight_sum == 0.0:
            return MotionProfile(static_ratio=1.0, lateral_px=0.0, yaw_px=0.0, has_evidence=False)
        per_interval = RATE_INTERVAL_S / seconds
        return MotionProfile(static / weight_sum, lateral * per_interval, yaw * per_interval, has_evidence=True)


def turning_score_px(profile: MotionProfile, score: str) -> float:
    """The score that is compared with tau_turn.

    Args:
        profile: smoothed scores of the frame.
        score: ``"yaw"`` (absolute common shift) or ``"lateral"`` (eq. 2, as printed).
    """
    return abs(profile.yaw_px) if score == "yaw" else profile.lateral_px


def classify(profile: MotionProfile, *, is_standing: bool, score: str, turning_flow_px: float) -> MotionState:
    """Hierarchical classification (eq. 3): standing before turning before straight.

    Args:
        profile: smoothed scores of the frame.
        is_standing: the verdict of the standing detector, which replaces S_static(t) > tau_static.
        score: ``"yaw"`` or ``"lateral"``.
        turning_flow_px: tau_turn for that score, px of the working image per 0.1 s.
    """
    if is_standing:
        return MotionState.STATIC
    return MotionState.TURNING if turning_score_px(profile, score) > turning_flow_px else MotionState.LINEAR
