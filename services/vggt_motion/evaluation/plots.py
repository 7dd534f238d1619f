"""The plots of the report, one function each, as Matplotlib figures that no window is opened for.

Colours are those of Okabe and Ito, which colour-blind readers tell apart; nothing is told by colour alone. Text that
came from outside is never read as mathematics.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter

from vggt_motion.evaluation import render
from vggt_motion.evaluation.report_data import CameraView, ComponentTrack, GroundTruth, MotionScores, PointCloud
from vggt_motion.geometry.track import PoseTrack
from vggt_motion.records import Constraint, ConstraintKind, MotionState, Segment, SubmapGeometry

BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY, YELLOW = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#56B4E9",
    "#F0E442",
)
INK, MUTED, GRID = "#1b1f24", "#6a737d", "#e3e6ea"
PART_COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
STATE_COLORS = {MotionState.STATIC: "#8c959f", MotionState.TURNING: ORANGE, MotionState.LINEAR: SKY}
STATE_NAMES = {MotionState.STATIC: "standing", MotionState.TURNING: "turning", MotionState.LINEAR: "straight"}

_MAX_DRAWN_POSES = 6000  # more is finer than the picture and makes the file heavy
_MAX_PANELS = 6
_WIDTH_IN = 9.6

_STYLE: dict[Any, Any] = {
    "font.size": 10.5,
    "font.family": "sans-serif",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlesize": 11.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": GRID,
    "legend.fontsize": 9.5,
    "svg.fonttype": "path",
    "svg.hashsalt": "vggt_motion",  # without it the identifiers in the file differ from run to run
    "figure.facecolor": "white",
    "text.parse_math": False,
}


@contextmanager
def _style() -> Iterator[None]:
    """Our look, for whatever builds or writes a figure."""
    with matplotlib.rc_context(_STYLE):
        yield


@_style()
def to_svg(figure: Figure) -> bytes:
    """The figure as an SVG file, the same bytes for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


@_style()
def to_png(figure: Figure, dots_per_inch: int = 160) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png", dpi=dots_per_inch, metadata={"Software": None})
    return buffer.getvalue()


@dataclass(frozen=True)
class _Plan:
    """Which world axes lie on the paper: x right and z up or, for a drive much longer ahead, z right and x down."""

    is_turned: bool

    def horizontal(self, positions: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        return positions[:, 2] if self.is_turned else positions[:, 0]

    def vertical(self, positions: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        return positions[:, 0] if self.is_turned else positions[:, 2]

    def label(self, axes: Any, unit: str, horizontal: bool = True) -> None:
        ahead, right = f"ahead of the first camera, z ({unit})", f"to the right, x ({unit})"
        if horizontal:
            axes.set_xlabel(ahead if self.is_turned else right)
        axes.set_ylabel(right if self.is_turned else ahead)


def _plan_of(positions: npt.NDArray[np.floating]) -> _Plan:
    span = np.ptp(positions, axis=0) if len(positions) else np.zeros(3)
    return _Plan(is_turned=bool(span[2] > 1.3 * span[0]))


def _frame_axes(
    axes: Any, plan: _Plan, positions: npt.NDArray[np.floating], min_ratio: float, shape: float | None = None
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


def _mark_ends(axes: Any, plan: _Plan, positions: npt.NDArray[np.floating], is_labelled: bool) -> None:
    h, v = plan.horizontal(positions), plan.vertical(positions)
    axes.plot(h[0], v[0], "o", ms=9, mfc="white", mec=INK, mew=1.8, zorder=6, label="start" if is_labelled else None)
    axes.plot(h[-1], v[-1], "s", ms=8, mfc=INK, mec="white", mew=1.2, zorder=6, label="end" if is_labelled else None)


def _legend_above(axes: Any) -> None:
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5, frameon=False, borderaxespad=0.1, handlelength=1.4
    )


def _head_room(values: npt.ArrayLike) -> float:
    """Upper end of an axis that starts at 0."""
    array = np.asarray(values, np.float64)
    array = array[np.isfinite(array)]
    return 1.12 * float(array.max()) if len(array) and array.max() > 0.0 else 1.0


def _finite(track: PoseTrack) -> PoseTrack:
    return track.subset(np.flatnonzero(np.isfinite(track.world_from_camera).all(axis=(1, 2))))


def _panel_inches(ratio: float, width: float, lowest: float = 1.7, highest: float = 7.2) -> float:
    return float(np.clip(ratio * width, lowest, highest))


@_style()
def trajectory_figure(frames: ComponentTrack, keyframes: ComponentTrack, length_unit: str) -> Figure:
    """The trajectory from above: a line through all frames, a dot per keyframe; a panel for each unconnected part."""
    whole = [(component, _finite(track)) for component, track in frames.parts()]
    parts = sorted((part for part in whole if len(part[1])), key=lambda part: -len(part[1]))[:_MAX_PANELS]
    parts.sort(key=lambda part: part[0])
    dots = dict(keyframes.parts())
    figure = Figure(layout="constrained")
    columns = min(len(parts), 2) if len(parts) > 1 else 1
    rows = -(-len(parts) // columns) if parts else 1
    grid = figure.subplots(rows, columns, squeeze=False)
    width = (_WIDTH_IN - 0.8) / columns
    heights = [1.7]
    for place, axes in enumerate(grid.flat):
        if place >= len(parts):
            axes.set_visible(False)
            continue
        component, track = parts[place]
        count, positions = len(track), _thinned(track).positions
        plan = _plan_of(positions) if len(parts) == 1 else _Plan(is_turned=False)
        color = PART_COLORS[place % len(PART_COLORS)]
        axes.plot(plan.horizontal(positions), plan.vertical(positions), "-", color=color, lw=2, label="all frames")
        if component in dots:
            at = _thinned(_finite(dots[component])).positions
            axes.plot(
                plan.horizontal(at), plan.vertical(at), ".", color=color, ms=7, mec="white", mew=0.5, label="keyframes"
            )
        _mark_ends(axes, plan, positions, is_labelled=True)
        shape = None if len(parts) == 1 else 0.75  # panels of one size, however the parts are shaped
        heights.append(_panel_inches(_frame_axes(axes, plan, positions, 0.12, shape), width))
        plan.label(axes, length_unit)
        if len(parts) > 1:
            axes.set_title(f"part from submap {component} ({count} frames)")
            if place == 0:
                axes.legend(loc="best", ncols=2)
        else:
            _legend_above(axes)
    figure.set_size_inches(_WIDTH_IN, rows * (max(heights) + 0.75))
    return figure


def _aligned(frames: ComponentTrack, truth: GroundTruth) -> list[tuple[int, PoseTrack]]:
    """Parts of the estimate in the frame of the truth, metres."""
    out = []
    for component, track in frames.parts():
        alignment = truth.truth_from_component.get(component)
        track = _finite(track)
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


@_style()
def overlay_figure(frames: ComponentTrack, truth: GroundTruth) -> Figure:
    """The aligned trajectory over the ground truth from above, and its position error along the way."""
    reference = _thinned(_finite(truth.track))
    parts = _aligned(frames, truth)
    everything = np.concatenate([reference.positions, *(track.positions for _, track in parts)])
    figure = Figure(layout="constrained")
    plan = _plan_of(everything)
    span = np.maximum(np.ptp(everything, axis=0), 1e-6)
    long, short = (span[2], span[0]) if plan.is_turned else (span[0], span[2])
    tall = _panel_inches(
        (max(short, 0.12 * max(long, short)) + 0.08 * long) / (1.08 * max(long, 0.12 * short)), _WIDTH_IN - 0.9
    )
    above, below = figure.subplots(2, 1, height_ratios=[tall, 1.9])
    figure.set_size_inches(_WIDTH_IN, tall + 1.9 + 1.4)
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
    _mark_ends(above, plan, reference.positions, is_labelled=True)
    _frame_axes(above, plan, everything, 0.12)
    plan.label(above, "m")
    _legend_above(above)
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


@_style()
def motion_figure(
    segments: Sequence[Segment], frames: ComponentTrack, scores: MotionScores | None, length_unit: str
) -> Figure:
    """Motion states, keyframes and submap borders over time, above what the trajectory says about speed and turning."""
    runs = _state_runs(segments)
    row_names = ["speed", "yaw"] + (["static", "turning"] if scores is not None else [])
    figure = Figure(figsize=(_WIDTH_IN, 1.15 + 1.55 * len(row_names) + 0.6), layout="constrained")
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
    _legend_above(band)
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


@_style()
def edges_figure(constraints: Sequence[Constraint], min_inlier_ratio: float | None) -> Figure:
    """Inlier ratio, residual and scale of every constraint, at the index of its later submap."""
    figure = Figure(figsize=(_WIDTH_IN, 6.2), layout="constrained")
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
    _legend_above(top)
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


@_style()
def stages_figure(stage_seconds: Mapping[str, float]) -> Figure:
    """Wall time of the stages of a run."""
    names, values = list(stage_seconds), np.array(list(stage_seconds.values()), np.float64)
    figure = Figure(figsize=(_WIDTH_IN, 0.9 + 0.36 * max(len(names), 1)), layout="constrained")
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


@_style()
def submap_times_figure(submaps: Sequence[SubmapGeometry]) -> Figure:
    """Time of the predictor's stages for each submap, stacked."""
    shown = sorted(submaps, key=lambda submap: (submap.spec.submap_index, submap.spec.revision))
    stages = list(dict.fromkeys(name for submap in shown for name in submap.stage_seconds))
    figure = Figure(figsize=(_WIDTH_IN, 3.0), layout="constrained")
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
    _legend_above(axes)
    return figure


def _short(text: str, limit: int = 40) -> str:
    return text if len(text) <= limit else text[: limit - 1] + "…"


@_style()
def map_figure(cloud: PointCloud, frames: ComponentTrack, length_unit: str) -> Figure:
    """The map from above with the trajectory drawn into it."""
    path = np.concatenate(
        [_finite(track).positions for component, track in frames.parts() if component == cloud.component]
        or [np.zeros((0, 3))]
    )
    bounds = _map_bounds(cloud.points, path)
    plan = _Plan(is_turned=bounds[3] - bounds[2] > 1.3 * (bounds[1] - bounds[0]))
    ceiling = _ceiling(cloud.points, path, bounds)
    width_px = (
        1000 if not plan.is_turned else int(np.clip(1000 * (bounds[1] - bounds[0]) / (bounds[3] - bounds[2]), 60, 1000))
    )
    view = render.plan_view(cloud.points, cloud.colors, bounds, width_px, ceiling)
    figure = Figure(layout="constrained")
    axes = figure.subplots()
    if plan.is_turned:
        # z to the right and x down: rows of the picture become columns, from near to far.
        axes.imshow(
            view.image[::-1].transpose(1, 0, 2),
            extent=(bounds[2], bounds[3], bounds[1], bounds[0]),
            interpolation="antialiased",
        )
        ratio = (bounds[1] - bounds[0]) / (bounds[3] - bounds[2])
    else:
        axes.imshow(view.image, extent=bounds, interpolation="antialiased")
        ratio = (bounds[3] - bounds[2]) / (bounds[1] - bounds[0])
    if len(path):
        axes.plot(plan.horizontal(path), plan.vertical(path), "-", color=ORANGE, lw=1.6, label="trajectory")
        _mark_ends(axes, plan, path, is_labelled=True)
        _legend_above(axes)
    axes.grid(False)
    plan.label(axes, length_unit)
    figure.set_size_inches(_WIDTH_IN, _panel_inches(ratio, _WIDTH_IN - 0.9) + 0.7)
    return figure


def _map_bounds(points: npt.NDArray[np.floating], path: npt.NDArray[np.floating]) -> tuple[float, float, float, float]:
    """x_min, x_max, z_min, z_max: the drive and what lies beside it; the few points at the horizon must not rule."""
    plane = np.asarray(points[:, [0, 2]], np.float64)
    plane = plane[np.isfinite(plane).all(axis=1)]
    low, high = np.percentile(plane, [1.0, 99.0], axis=0) if len(plane) else (np.full(2, -1.0), np.full(2, 1.0))
    if len(path):
        inner_low, inner_high = path[:, [0, 2]].min(axis=0), path[:, [0, 2]].max(axis=0)
        margin = 0.3 * max(float((inner_high - inner_low).max()), 1e-6)
        low = np.minimum(np.maximum(low, inner_low - margin), inner_low - 0.05 * margin)
        high = np.maximum(np.minimum(high, inner_high + margin), inner_high + 0.05 * margin)
    high = np.maximum(high, low + 1e-3 * max(float((high - low).max()), 1e-3))
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _ceiling(
    points: npt.NDArray[np.floating], path: npt.NDArray[np.floating], bounds: tuple[float, float, float, float]
) -> float | None:
    """Height (y) above which the map is cut open, lest bridges and tree tops hide the road; None without a path."""
    if not len(path):
        return None
    y = np.asarray(points[:, 1], np.float64)
    y = y[np.isfinite(y)]
    below = y[y > float(path[:, 1].max())]
    if not len(below):
        return None
    camera_height = float(np.percentile(below, 90)) - float(np.median(path[:, 1]))
    return float(path[:, 1].min()) - 2.0 * max(camera_height, 0.0)


@_style()
def camera_view_figure(cloud: PointCloud, view: CameraView) -> Figure:
    """The map as one camera sees it, beside what it recorded."""
    target_width = 960
    scale = target_width / view.intrinsics.width_px
    intrinsics = view.intrinsics.resized(target_width, max(1, round(view.intrinsics.height_px * scale)))
    picture = render.camera_view(
        cloud.points, cloud.colors, view.world_from_camera, intrinsics, _point_size(cloud, view)
    )
    pictures = [("map, drawn from the camera", picture)]
    if view.image is not None:
        pictures.insert(0, (f"recorded frame {view.frame_index}", view.image))
    ratio = intrinsics.height_px / intrinsics.width_px
    is_wide = ratio < 0.5
    rows, columns = (len(pictures), 1) if is_wide else (1, len(pictures))
    width = _WIDTH_IN / columns
    figure = Figure(figsize=(_WIDTH_IN, rows * (ratio * width + 0.32)), layout="constrained")
    for axes, (title, pixels) in zip(figure.subplots(rows, columns, squeeze=False).flat, pictures, strict=True):
        axes.imshow(pixels, interpolation="antialiased")
        axes.set_title(title)
        axes.set_axis_off()
    return figure


def _point_size(cloud: PointCloud, view: CameraView) -> float:
    """Edge of a point in world units: about a pixel and a half at the median distance of what the camera sees."""
    offset = np.asarray(cloud.points, np.float64) - view.world_from_camera[:3, 3]
    depth = offset @ view.world_from_camera[:3, 2]
    seen = depth[np.isfinite(depth) & (depth > 0)]
    return 1.5 * float(np.median(seen)) / view.intrinsics.fx if len(seen) else 1e-3
