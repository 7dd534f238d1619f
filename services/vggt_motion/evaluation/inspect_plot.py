"""The picture of ``vggt-motion inspect``: scores, states, keyframes, submap borders and what was seen there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.offsetbox import AnnotationBbox, OffsetImage

from vggt_motion.config import FrontendConfig
from vggt_motion.evaluation.plot_style import BLUE, GREEN, INK, MUTED, PURPLE, VERMILION, legend_above, styled
from vggt_motion.evaluation.plots import STATE_COLORS, STATE_NAMES
from vggt_motion.frontend.pipeline import FrameTrace
from vggt_motion.records import MotionState, Segment

_WIDTH_IN = 14.0
_MAX_THUMBNAILS = 7  # that stand side by side; the page shows them all
_LEGEND_SHARE = 0.22  # of the height of a panel
_MAX_DRAWN = 6000  # more is finer than the picture
_MAX_SHADED = 400  # runs of a state; with more the shade is a blur and the file slow

Picture = npt.NDArray[np.uint8]  # (H, W, 3) RGB


def seconds_of(traces: Sequence[FrameTrace]) -> npt.NDArray[np.float64]:
    """Capture times (N,) in seconds after the first frame."""
    times = np.array([trace.capture_time_ns for trace in traces], np.int64)
    return np.asarray((times - times[0]) * 1e-9, np.float64)


@styled()
def inspect_figure(
    traces: Sequence[FrameTrace],
    segments: Sequence[Segment],
    pictures: Sequence[tuple[int, Picture]],
    config: FrontendConfig,
    title: str,
) -> Figure:
    """Draw a whole sequence.

    Args:
        traces: of all frames, in order; at least one.
        segments: of the sequence.
        pictures: frame index and thumbnail of the first keyframe of each segment.
        config: section ``frontend``, for the thresholds.
        title: what was inspected.
    """
    seconds = seconds_of(traces)
    end = float(seconds[-1]) if seconds[-1] > 0 else 1.0
    figure = Figure(figsize=(_WIDTH_IN, 10.6), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=12)
    rows = figure.subplots(5, 1, sharex=True, height_ratios=[1.2, 0.75, 1.3, 1.5, 1.3])
    # after the last frame there is a little room, so that its keyframe is seen
    rows[0].set_xlim(0.0, 1.005 * end)
    borders = [seconds[segment.frames[-1].frame_index] for segment in segments[:-1]]
    _draw_pictures(rows[0], seconds, pictures, end)
    _draw_band(rows[1], traces, seconds, borders)
    runs = _state_runs(traces, seconds)
    kept = np.unique(np.linspace(0, len(traces) - 1, min(len(traces), _MAX_DRAWN)).round().astype(int))
    for axes in rows[2:]:
        _shade(axes, runs)
        for border in borders:
            axes.axvline(border, color=INK, lw=0.9 if len(borders) < 40 else 0.4, ls=":")

    def series(values: Sequence[float]) -> npt.NDArray[np.float64]:
        return np.array(values, np.float64).take(kept)

    scale = config.flow_width_px / 320.0
    axes = rows[2]
    axes.plot(seconds[kept], series([t.profile.static_ratio for t in traces]), color=BLUE, lw=1.3)
    axes.axhline(config.static_ratio, color=VERMILION, lw=1.0, ls="--", label=f"threshold {config.static_ratio:g}")
    axes.set_ylim(-0.03, 1.03)
    axes.set_yticks(np.linspace(0.0, 1.0, 6))
    axes.set_ylabel("static ratio")
    axes = rows[3]
    axes.plot(seconds[kept], series([t.profile.yaw_px for t in traces]), color=BLUE, lw=1.3, label="common shift")
    axes.plot(
        seconds[kept], series([t.profile.lateral_px for t in traces]), color=MUTED, lw=1.0, label="mean |fx| (paper)"
    )
    threshold = config.turning_flow_px * scale
    signs = (1.0, -1.0) if config.turning_score == "yaw" else (1.0,)
    for place, sign in enumerate(signs):
        name = f"threshold of {config.turning_score} {threshold:g}" if place == 0 else None
        axes.axhline(sign * threshold, color=VERMILION, lw=1.0, ls="--", label=name)
    axes.set_ylabel("turning, px per 0.1 s")
    axes = rows[4]
    axes.plot(seconds[kept], series([t.parallax_px for t in traces]), color=PURPLE, lw=1.0, label="since the keyframe")
    if config.selection == "parallax":
        parallax = config.parallax_px * scale
        axes.axhline(parallax, color=VERMILION, lw=1.0, ls="--", label=f"threshold {parallax:g}")
    axes.set_ylabel("parallax, px")
    axes.set_xlabel("time after the first frame, s")
    for axes in rows[2:]:
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + _LEGEND_SHARE * (high - low))  # the legend hides no curve
        axes.legend(loc="upper right", fontsize=8.5, ncols=3)
    return figure


def _state_runs(
    traces: Sequence[FrameTrace], seconds: npt.NDArray[np.float64]
) -> list[tuple[float, float, MotionState]]:
    """Stretches of one state: begin, end (the next one's begin), state."""
    starts = [k for k, trace in enumerate(traces) if k == 0 or trace.state is not traces[k - 1].state]
    step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 1.0
    ends = [float(seconds[k]) for k in starts[1:]] + [float(seconds[-1]) + step]
    return [(float(seconds[k]), end, traces[k].state) for k, end in zip(starts, ends, strict=True)]


def _shade(axes: Any, runs: Sequence[tuple[float, float, MotionState]]) -> None:
    if len(runs) > _MAX_SHADED:
        return
    for begin, end, state in runs:
        axes.axvspan(begin, end, color=STATE_COLORS[state], alpha=0.15, lw=0)


def _draw_band(
    axes: Any, traces: Sequence[FrameTrace], seconds: npt.NDArray[np.float64], borders: Sequence[float]
) -> None:
    counts = {state: sum(trace.state is state for trace in traces) for state in MotionState}
    for state in MotionState:
        bars = [(begin, end - begin) for begin, end, found in _state_runs(traces, seconds) if found is state]
        if bars:
            share = f"{100.0 * counts[state] / len(traces):.0f}%"
            label = f"{state.value}  {STATE_NAMES[state]} {share}"
            axes.broken_barh(bars, (0.4, 0.6), facecolors=STATE_COLORS[state], label=label)
    ticks = [second for second, trace in zip(seconds, traces, strict=True) if trace.is_keyframe]
    width = float(np.clip(220.0 / max(len(ticks), 1), 0.2, 1.1))
    axes.vlines(ticks, 0.0, 0.32, color=GREEN, lw=width, label=f"keyframes ({len(ticks)} of {len(traces)})")
    for place, border in enumerate(borders):
        name = f"submap borders ({len(borders)})" if place == 0 else None
        axes.vlines(border, -0.05, 1.12, color=INK, lw=1.3 if len(borders) < 40 else 0.6, ls=":", label=name)
    axes.set_ylim(-0.05, 1.12)
    axes.set_yticks([])
    axes.grid(False)
    axes.spines["left"].set_visible(False)
    legend_above(axes)


def _draw_pictures(
    axes: Any, seconds: npt.NDArray[np.float64], pictures: Sequence[tuple[int, Picture]], end: float
) -> None:
    """Thumbnails side by side, each with a line to the moment at which it was taken."""
    axes.set_ylim(0.0, 1.0)
    axes.axis("off")
    if not pictures:
        return
    chosen = np.unique(np.linspace(0, len(pictures) - 1, min(len(pictures), _MAX_THUMBNAILS)).round().astype(int))
    slots = (np.arange(len(chosen)) + 0.5) / len(chosen)
    for slot, place in zip(slots, chosen, strict=True):
        index, picture = pictures[int(place)]
        zoom = min(1.0, 0.92 * _WIDTH_IN * 72.0 / _MAX_THUMBNAILS / picture.shape[1], 88.0 / picture.shape[0])
        axes.add_artist(
            AnnotationBbox(
                OffsetImage(picture, zoom=zoom),
                (float(seconds[index]), 0.0),
                xybox=(slot * end, 0.56),
                frameon=False,
                arrowprops={"arrowstyle": "-", "color": MUTED, "lw": 0.8},
            )
        )
        axes.annotate(
            f"frame {index}",
            (slot * end, 0.56),
            (0.0, 0.5 * zoom * picture.shape[0] + 3.0),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=8.5,
            color=INK,
        )
