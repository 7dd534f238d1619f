"""The plots of the report about the trajectory and the run, one function each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter

from vggt_motion.evaluation.plot_style import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PART_COLORS,
    PURPLE,
    SKY,
    VERMILION,
    WIDTH_IN,
    YELLOW,
    Plan,
    finite,
    legend_above,
    mark_ends,
    panel_inches,
    styled,
    to_png,
)
from vggt_motion.evaluation.report_data import ComponentTrack, GroundTruth, MotionScores
from vggt_motion.geometry.track import PoseTrack
from vggt_motion.records import Constraint, ConstraintKind, MotionState, Segment, SubmapGeometry

STATE_COLORS = {MotionState.STATIC: "#8c959f", MotionState.TURNING: ORANGE, MotionState.LINEAR: SKY}
STATE_NAMES = {MotionState.STATIC: "standing", MotionState.TURNING: "turning", MotionState.LINEAR: "straight"}

_MAX_DRAWN_POSES = 6000  # more is finer than the picture and makes the file heavy
_MAX_PANELS = 6


def _plan_of(positions: npt.NDArray[np.floating]) -> Plan:
    span = np.ptp(positions, axis=0) if len(positions) else np.zeros(3)
    return Plan(is_turned=bool(span[2] > 1.3 * span[0]))


def _frame_axes(
    axes: Any, plan: Plan, positions: npt.NDArray[np.floating], min_ratio: float, shape: float | None = None
) -> float:
    """Set equal, padded limits around positions (N, 3); returns height over width, ``shape`` where one is given."""
    h, v = plan.horizontal(positions), plan.vertical(positions)
    span = max(float(np.ptp(h)), float(np.ptp(v)), 1e-6)
    width, height = (max(float(np.ptp(value)), min_ratio * span) + 0.08 * span for value in (h, v))
    if shape is not None:
        width, height = max(width, height / shape), max(height, width * shape)
    middle_h, middle_v = (0.5 * (float(value.min()) + float(value.max())) for value in (h, v))
    axes.set_xlim(middle_h - 0.5 * width, middle_h + 0.5 * width)
    low, high = middle_v - 0.5 * height, middle_v + 0.5 * height
    axes.set_ylim((high, low) if plan.is_turned else (low, high))
    axes.set_aspect("equal", adjustable="box")
    return height / width


def _thinned(track: PoseTrack) -> PoseTrack:
    if len(track) <= _MAX_DRAWN_POSES:
        return track
    return track.subset(np.unique(np.linspace(0, len(track) - 1, _MAX_DRAWN_POSES).round().astype(np.int64)))


def _head_room(values: npt.ArrayLike) -> float:
    """Upper end of an axis that starts at 0."""
    array = np.asarray(values, np.float64)
    array = array[np.isfinite(array)]
    return 1.12 * float(array.max()) if len(array) and array.max() > 0.0 else 1.0


@styled()
def trajectory_figure(frames: ComponentTrack, keyframes: ComponentTrack, length_unit: str) -> Figure:
    """The trajectory from above: a line through all frames, a dot per keyframe; a panel for each unconnected part."""
    whole = [(component, finite(track)) for component, track in frames.parts()]
    parts = sorted((part for part in whole if len(part[1])), key=lambda part: -len(part[1]))[:_MAX_PANELS]
    parts.sort(key=lambda part: part[0])
    dots = dict(keyframes.parts())
    figure = Figure(layout="constrained")
    plan = Plan(is_turned=all(_plan_of(track.positions).is_turned for _, track in parts))
    columns = 1 if plan.is_turned or len(parts) <= 1 else 2
    shape = 0.75 if columns == 2 else None  # side by side: panels of one size, however the parts are shaped
    rows = max(1, -(-len(parts) // columns))
    grid = figure.subplots(rows, columns, squeeze=False)
    width = (WIDTH_IN - 0.8) / columns
    heights = [1.7]
    for place, axes in enumerate(grid.flat):
        if place >= len(parts):
            axes.set_visible(False)
            continue
        component, track = parts[place]
        count, positions = len(track), _thinned(track).positions
        color = PART_COLORS[place % len(PART_COLORS)]
        axes.plot(plan.horizontal(positions), plan.vertical(positions), "-", color=color, lw=2, label="all frames")
        if component in dots:
            at = _thinned(finite(dots[component])).positions
            axes.plot(
                plan.horizontal(at), plan.vertical(at), ".", color=color, ms=7, mec="white", mew=0.5, label="keyframes"
            )
        doubtful = frames.doubtful_part(component)
        if doubtful is not None and len(finite(doubtful)):
            at = _thinned(finite(doubtful)).positions
            axes.plot(plan.horizontal(at), plan.vertical(at), "o", mfc="none", mec="#c62828", ms=9, label="doubtful")
        mark_ends(axes, plan, positions, is_labelled=True)
        heights.append(panel_inches(_frame_axes(axes, plan, positions, 0.12, shape), width))
        plan.label(axes, length_unit)
        if len(parts) > 1:
            axes.set_title(f"part from submap {component} ({count} frames)")
            if place == 0:
                axes.legend(loc="best", ncols=2)
        else:
            legend_above(axes)
    figure.set_size_inches(WIDTH_IN, rows * (max(heights) + 0.75))
    return figure


def _aligned(frames: ComponentTrack, truth: GroundTruth) -> list[tuple[int, PoseTrack]]:
    """Parts of the estimate in the frame of the truth, metres."""
    out = []
    for component, track in frames.parts():
        alignment = truth.truth_from_component.get(component)
        track = finite(track)
        if alignment is None or not len(track):
            continue
        moved = np.array([alignment.act_pose(pose) for pose in track.world_from_camera])
        out.append((component, PoseTrack(track.times_ns, moved)))
    return out


def _position_errors(estimate: PoseTrack, truth: PoseTrack) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Distance travelled by the truth and position error, metres, where both have a pose at the same time (to 1 ms)."""
    order = np.argsort(truth.times_ns, kind="stable")
    times = truth.times_ns[order]
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth.positions[order], axis=0), axis=1))])
    place = np.clip(np.searchsorted(times, estimate.times_ns), 1, max(len(times) - 1, 1))
    if len(times) < 2:
        return np.zeros(0), np.zeros(0)
    place = np.where(estimate.times_ns - times[place - 1] < times[place] - estimate.times_ns, place - 1, place)
    matched = np.abs(times[place] - estimate.times_ns) <= 1_000_000
    error = np.linalg.norm(estimate.positions - truth.positions[order][place], axis=1)
    return travelled[place][matched], error[matched]


@styled()
def overlay_figure(frames: ComponentTrack, truth: GroundTruth) -> Figure:
    """The aligned trajectory over the ground truth from above, and its position error along the way."""
    reference = _thinned(finite(truth.track))
    parts = _aligned(frames, truth)
    everything = np.concatenate([reference.positions, *(track.positions for _, track in parts)])
    figure = Figure(layout="constrained")
    plan = _plan_of(everything)
    span = np.maximum(np.ptp(everything, axis=0), 1e-6)
    long, short = (span[2], span[0]) if plan.is_turned else (span[0], span[2])
    tall = panel_inches(
        (max(short, 0.12 * max(long, short)) + 0.08 * long) / (1.08 * max(long, 0.12 * short)), WIDTH_IN - 0.9
    )
    above, below = figure.subplots(2, 1, height_ratios=[tall, 1.9])
    figure.set_size_inches(WIDTH_IN, tall + 1.9 + 1.4)
    h, v = plan.horizontal(reference.positions), plan.vertical(reference.positions)
    above.plot(h, v, "-", color=INK, lw=4.5, alpha=0.28, solid_capstyle="round", label="ground truth")
    largest: list[float] = []
    for place, (component, track) in enumerate(parts):
        drawn = _thinned(track).positions
        color = PART_COLORS[place % len(PART_COLORS)]
        label = "estimate, aligned" if len(parts) == 1 else f"part from submap {component}"
        above.plot(
            plan.horizontal(drawn),
            plan.vertical(drawn),
            "-",
            color=color,
            lw=1.8,
            label=label if place < _MAX_PANELS else None,
        )
        distance, error = _position_errors(track, truth.track)
        largest.extend(error)
        below.plot(distance, error, "-", color=color, lw=1.6)
        if len(error):
            rms = float(np.sqrt(np.mean(error**2)))
            below.hlines(rms, distance.min(), distance.max(), color=color, lw=1, ls=(0, (4, 3)))
            below.annotate(
                f"RMSE {rms:.3g} m",
                (float(distance.max()), rms),
                xytext=(-4, 3),
                textcoords="offset points",
                ha="right",
                va="bottom",
                color=color,
                fontsize=9.5,
                bbox={"fc": "white", "ec": "none", "alpha": 0.8, "pad": 1.0},
            )
    mark_ends(above, plan, reference.positions, is_labelled=True)
    _frame_axes(above, plan, everything, 0.12)
    plan.label(above, "m")
    legend_above(above)
    below.set_xlabel("distance travelled (m)")
    below.set_ylabel("position error (m)")
    below.set_ylim(0.0, _head_room(largest))
    below.margins(x=0.01)
    return figure


def write_overlay_png(path: Path, frames: ComponentTrack, truth: GroundTruth) -> None:
    """Write the trajectory over the ground truth as a PNG file.

    Raises:
        OSError: the file cannot be written.
    """
    path.write_bytes(to_png(overlay_figure(frames, truth)))


def _state_runs(segments: Sequence[Segment]) -> list[tuple[float, float, MotionState]]:
    """Intervals (begin, end) of equal state, seconds since the first frame; a frame reaches to the next one."""
    entries = [entry for segment in segments for entry in segment.frames]
    if not entries:
        return []
    times = np.array([entry.capture_time_ns for entry in entries], np.int64)
    seconds = (times - times[0]) / 1e9
    period = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.1
    ends = np.append(seconds[1:], seconds[-1] + period)
    runs: list[tuple[float, float, MotionState]] = []
    for begin, end, entry in zip(seconds, ends, entries, strict=True):
        if runs and runs[-1][2] == entry.state:
            runs[-1] = (runs[-1][0], float(end), entry.state)
        else:
            runs.append((float(begin), float(end), entry.state))
    return runs


def _rates(frames: ComponentTrack) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Mid times (ns), speed (world units/s) and yaw rate (degrees/s, right is positive) between successive frames."""
    track = frames.track
    dt = np.diff(track.times_ns) / 1e9
    valid = (dt > 0) & (np.diff(frames.components) == 0)
    step = np.where(valid, dt, np.nan)
    speed = np.linalg.norm(np.diff(track.positions, axis=0), axis=1) / step
    rotation = track.world_from_camera[:, :3, :3]
    # The next optical axis in the present camera (x right, z ahead): its heading is the yaw of the step.
    ahead = np.einsum("nji,nj->ni", rotation[:-1], rotation[1:, :, 2])
    yaw = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 2])) / step
    return (track.times_ns[:-1] + np.diff(track.times_ns) // 2), speed, yaw


@styled()
def motion_figure(
    segments: Sequence[Segment], frames: ComponentTrack, scores: MotionScores | None, length_unit: str
) -> Figure:
    """Motion states, keyframes and submap borders over time, above what the trajectory says about speed and turning."""
    runs = _state_runs(segments)
    row_names = ["speed", "yaw"] + (["static", "turning"] if scores is not None else [])
    figure = Figure(figsize=(WIDTH_IN, 1.15 + 1.55 * len(row_names) + 0.6), layout="constrained")
    axes = figure.subplots(1 + len(row_names), 1, sharex=True, height_ratios=[0.75] + [1.5] * len(row_names))
    band = axes[0]
    origin = segments[0].frames[0].capture_time_ns if segments and segments[0].frames else 0
    for state in MotionState:
        bars = [(begin, end - begin) for begin, end, found in runs if found == state]
        if bars:
            band.broken_barh(
                bars, (0.35, 0.65), facecolors=STATE_COLORS[state], label=f"{state.value}  {STATE_NAMES[state]}"
            )
            for row in axes[1:]:
                for begin, width in bars:
                    row.axvspan(begin, begin + width, color=STATE_COLORS[state], alpha=0.13, lw=0)
    ticks = [(e.capture_time_ns - origin) / 1e9 for segment in segments for e in segment.frames if e.is_keyframe]
    band.vlines(
        ticks,
        0.0,
        0.27,
        color=INK,
        lw=float(np.clip(150.0 / max(len(ticks), 1), 0.2, 1.1)),
        label=f"keyframes ({len(ticks)})",
    )
    closed = [(segment.frames[-1].capture_time_ns - origin) / 1e9 for segment in segments if segment.frames]
    for place, time_s in enumerate(closed[:-1]):
        band.vlines(
            time_s,
            -0.05,
            1.12,
            color=INK,
            lw=1.2 if len(closed) < 40 else 0.6,
            ls=":",
            label=f"submap borders ({len(closed) - 1})" if not place else None,
        )
    band.set_ylim(-0.05, 1.12)
    band.set_yticks([])
    band.grid(False)
    band.spines["left"].set_visible(False)
    legend_above(band)
    times, speed, yaw = _rates(frames)
    seconds = (times - origin) / 1e9
    axes[1].plot(seconds, speed, color=BLUE, lw=1.5)
    axes[1].set_ylabel(f"speed\n({length_unit}/s)")
    axes[1].set_ylim(0.0, _head_room(speed))
    axes[2].plot(seconds, yaw, color=BLUE, lw=1.5)
    axes[2].axhline(0.0, color=MUTED, lw=0.8)
    axes[2].set_ylabel("yaw rate (°/s)\nright is +")
    if scores is not None:
        seconds = (scores.times_ns - origin) / 1e9
        axes[3].plot(seconds, scores.static_ratio, color=BLUE, lw=1.5)
        axes[3].set_ylabel("static\nratio")
        axes[3].set_ylim(-0.03, 1.03)
        axes[4].plot(seconds, scores.turning_px, color=BLUE, lw=1.5)
        axes[4].set_ylabel("turning\nscore (px)")
    axes[-1].set_xlabel("time since the first frame (s)")
    if runs:
        axes[-1].set_xlim(runs[0][0], runs[-1][1])
    figure.align_ylabels(axes[1:])
    return figure


@styled()
def edges_figure(constraints: Sequence[Constraint], min_inlier_ratio: float | None) -> Figure:
    """Inlier ratio, residual and scale of every constraint, at the index of its later submap."""
    figure = Figure(figsize=(WIDTH_IN, 6.2), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, sharex=True)
    groups = (
        (ConstraintKind.ADJACENT, True, "o", BLUE, "adjacent, accepted"),
        (ConstraintKind.LOOP, True, "D", PURPLE, "loop, accepted"),
        (ConstraintKind.ADJACENT, False, "X", VERMILION, "adjacent, refused"),
        (ConstraintKind.LOOP, False, "P", ORANGE, "loop, refused"),
    )
    for kind, is_accepted, marker, color, label in groups:
        group = [c for c in constraints if c.spec.kind == kind and c.accepted == is_accepted]
        if not group:
            continue
        j = [c.spec.j for c in group]
        look: dict[str, Any] = {"marker": marker, "ls": "none", "ms": 7, "color": color, "mec": "white", "mew": 0.6}
        top.plot(j, [c.inlier_ratio for c in group], **look, label=f"{label} ({len(group)})")
        middle.plot(j, [100.0 * c.median_relative_residual for c in group], **look)
        if is_accepted:
            bottom.plot(j, [c.j_from_i.scale for c in group], **look)
    if min_inlier_ratio is not None:
        top.axhline(
            min_inlier_ratio, color=VERMILION, lw=1.2, ls=(0, (4, 3)), label=f"least accepted ({min_inlier_ratio:g})"
        )
    top.set_ylim(-0.03, 1.05)
    top.set_ylabel("inlier ratio")
    legend_above(top)
    middle.set_ylabel("median residual\n(% of depth)")
    middle.set_ylim(0.0, _head_room([100.0 * c.median_relative_residual for c in constraints]))
    scales = np.array([c.j_from_i.scale for c in constraints if c.accepted])
    bottom.set_yscale("log", base=2)
    reach = max(1.3, 1.1 * float(np.exp(np.abs(np.log(scales)).max()))) if len(scales) and (scales > 0).all() else 1.3
    bottom.set_ylim(1.0 / reach, reach)
    steps = np.array([1 / 16, 1 / 8, 1 / 4, 1 / 2, 1 / 1.5, 1 / 1.2, 1.0, 1.2, 1.5, 2, 4, 8, 16])
    inside = steps[(steps >= 1.0 / reach) & (steps <= reach)]
    bottom.set_yticks(inside, [f"{value:.2g}" for value in inside])
    bottom.yaxis.set_minor_formatter(NullFormatter())
    bottom.minorticks_off()
    bottom.axhline(1.0, color=MUTED, lw=0.8)
    bottom.set_ylabel("scale of the edge\n(unit of i in unit of j)")
    bottom.set_xlabel("index j of the later submap")
    bottom.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    last = max((c.spec.j for c in constraints), default=1)
    bottom.set_xlim(min((c.spec.j for c in constraints), default=0) - 0.5, last + 0.5)
    figure.align_ylabels([top, middle, bottom])
    return figure


@styled()
def stages_figure(stage_seconds: Mapping[str, float]) -> Figure:
    """Wall time of the stages of a run."""
    names, values = list(stage_seconds), np.array(list(stage_seconds.values()), np.float64)
    figure = Figure(figsize=(WIDTH_IN, 0.9 + 0.36 * max(len(names), 1)), layout="constrained")
    axes = figure.subplots()
    axes.barh(np.arange(len(names)), values, color=BLUE, height=0.62)
    axes.set_yticks(np.arange(len(names)), [_short(name) for name in names])
    axes.invert_yaxis()
    for place, value in enumerate(values):
        axes.annotate(
            f"{value:.3g} s", (value, place), xytext=(5, 0), textcoords="offset points", va="center", fontsize=9.5
        )
    axes.set_xlim(0.0, 1.12 * max(float(np.nanmax(values, initial=0.0)), 1e-9))
    axes.grid(False, axis="y")
    axes.set_xlabel("seconds")
    return figure


@styled()
def submap_times_figure(submaps: Sequence[SubmapGeometry]) -> Figure:
    """Time of the predictor's stages for each submap, stacked."""
    shown = sorted(submaps, key=lambda submap: (submap.spec.submap_index, submap.spec.revision))
    stages = list(dict.fromkeys(name for submap in shown for name in submap.stage_seconds))
    figure = Figure(figsize=(WIDTH_IN, 3.0), layout="constrained")
    axes = figure.subplots()
    base = np.zeros(len(shown))
    palette = (BLUE, SKY, GREEN, ORANGE, VERMILION, PURPLE, YELLOW, "#8c959f")
    for place, stage in enumerate(stages):
        values = np.array([submap.stage_seconds.get(stage, 0.0) for submap in shown])
        axes.bar(
            np.arange(len(shown)),
            values,
            bottom=base,
            width=0.6 if len(shown) < 60 else 1.0,
            color=palette[place % len(palette)],
            hatch="" if place < len(palette) else "///",
            label=_short(stage),
        )
        base += values
    labels = [f"{s.spec.submap_index}" + (f"·r{s.spec.revision}" if s.spec.revision > 1 else "") for s in shown]
    axes.xaxis.set_major_locator(MaxNLocator(nbins=24, integer=True))
    axes.xaxis.set_major_formatter(
        FuncFormatter(lambda x, _: labels[int(x)] if 0 <= x < len(labels) and x == int(x) else "")
    )
    axes.set_xlim(-0.6, len(shown) - 0.4)
    axes.set_xlabel("submap")
    axes.set_ylabel("seconds")
    axes.grid(False, axis="x")
    legend_above(axes)
    return figure


def _short(text: str, limit: int = 40) -> str:
    return text if len(text) <= limit else text[: limit - 1] + "…"
