"""The report of a run: one HTML file that needs nothing else, neither network nor script.

Every text from outside is escaped.
"""

from __future__ import annotations

import base64
import html
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from vggt_motion.evaluation import map_plots, plots
from vggt_motion.evaluation.plot_style import to_png, to_svg
from vggt_motion.evaluation.report_data import MetricTree, MetricValue, ReportData
from vggt_motion.evaluation.report_style import CSS
from vggt_motion.records import Constraint, Event, EventKind, JobReport, Segment, SubmapGeometry, SubmapVerdict

FILE_NAME = "report.html"

_UNKNOWN = "\N{EN DASH}"
_MAX_SVG_BYTES = 1_000_000  # drawn finer than a screen shows: pixels are smaller then
_MAX_ROWS = 200  # of any table or list: a page must open, however long the drive was
_VERDICTS = {
    SubmapVerdict.GOOD: ("good", "good"),
    SubmapVerdict.LOW_QUALITY: ("low quality", "doubtful"),
    SubmapVerdict.ROTATION_ONLY: ("rotation only", "doubtful"),
    SubmapVerdict.FAILED: ("failed", "bad"),
}
# What a person looks at first; everything else is in the table.
_HEADLINES = {
    "ate_rmse_m": ("ATE, RMSE", "m"),
    "drift_ate_percent": ("drift, ATE / length", "%"),
    "t_rel_percent": ("KITTI t_rel", "%"),
    "wall_seconds": ("wall time", "s"),
}


def write_report(out: Path, data: ReportData) -> Path:
    """Write ``report.html`` into a directory, whole or not at all, and return its path.

    Raises:
        OSError: the directory is missing or not writable, or the disk is full.
    """
    path = out / FILE_NAME
    unfinished = out / f".{FILE_NAME}.part"
    unfinished.write_text(render_report(data), encoding="utf-8", errors="replace")
    unfinished.replace(path)
    return path


def render_report(data: ReportData) -> str:
    """The page as text: the same data gives the same text."""
    sections: tuple[tuple[str, str, Callable[[ReportData], str]], ...] = (
        ("summary", "Summary", _summary),
        ("trajectory", "Trajectory", _trajectory),
        ("motion", "Motion over time", _motion),
        ("map", "Map", _map),
        ("constraints", "Constraints between submaps", _constraints),
        ("submaps", "Submaps", _submaps),
        ("timing", "Time per stage", _timing),
        ("events", "Warnings, dead jobs and breaks", _events),
        ("configuration", "Configuration and versions", _configuration),
    )
    body = "".join(
        f'<section id="{name}">\n<h2>{title}</h2>\n{make(data)}</section>\n' for name, title, make in sections
    )
    links = "".join(f'<a href="#{name}">{title}</a>' for name, title, _ in sections)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        # The browser itself refuses whatever this page would load or run.
        '<meta http-equiv="Content-Security-Policy" '
        "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>VGGT-Motion: {_text(data.source)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n"
        f'<header><h1>VGGT-Motion run</h1>\n<p class="muted">{_text(data.source)}<br>{_text(data.created)}</p>\n'
        f"<nav>{links}</nav></header>\n"
        f"<main>\n{body}</main>\n"
        f"<footer>Written by VGGT-Motion {_text(data.versions.get('vggt-motion', ''))}. "
        "This file needs no other one and loads nothing.</footer>\n"
        "</body>\n</html>\n"
    )


_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff\u202a-\u202e\u2066-\u2069]")


def _text(value: object) -> str:
    """Text for an element or a quoted attribute; controls, lone surrogates and direction overrides become U+FFFD."""
    return html.escape(_CONTROL.sub("\ufffd", str(value)), quote=True)


def _number(value: float, digits: int = 4) -> str:
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    if math.isnan(value):
        return _UNKNOWN
    return f"{value:.{digits}g}" if abs(value) < 1e5 else f"{value:,.0f}".replace(",", "\u202f")


def _figure(figure: Figure, name: str, alternative: str, caption: str = "", is_photo: bool = False) -> str:
    media, payload = "image/svg+xml", b"" if is_photo else to_svg(figure)
    if is_photo or len(payload) > _MAX_SVG_BYTES:
        media, payload = "image/png", to_png(figure, 125)
    width_px = round(float(figure.get_size_inches()[0]) * 105)
    encoded = base64.b64encode(payload).decode("ascii")
    note = f"<figcaption>{_text(caption)}</figcaption>" if caption else ""
    picture = f'<img width="{width_px}" alt="{_text(alternative)}" src="data:{media};base64,{encoded}">'
    return f'<figure id="figure-{name}">{picture}{note}</figure>\n'


def _none(text: str) -> str:
    return f'<p class="muted">{_text(text)}</p>\n'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], numeric: frozenset[int] = frozenset()) -> str:
    """A table of cells that are HTML already."""

    def cells(tag: str, row: Sequence[str]) -> str:
        kinds = (' class="number"' if place in numeric else "" for place in range(len(row)))
        return "".join(f"<{tag}{kind}>{cell}</{tag}>" for kind, cell in zip(kinds, row, strict=True))

    body = "".join(f"<tr>{cells('td', row)}</tr>\n" for row in rows[:_MAX_ROWS])
    more = _none(f"… and {len(rows) - _MAX_ROWS} more.") if len(rows) > _MAX_ROWS else ""
    table = f"<table><thead><tr>{cells('th', head)}</tr></thead><tbody>\n{body}</tbody></table>"
    return f'<div class="scroll">{table}</div>\n{more}'


def _list(items: Sequence[str]) -> str:
    """A bounded list of items that are HTML already."""
    more = _none(f"… and {len(items) - _MAX_ROWS} more.") if len(items) > _MAX_ROWS else ""
    return f'<ul class="plain">{"".join(f"<li>{item}</li>" for item in items[:_MAX_ROWS])}</ul>\n{more}'


def _flat(metrics: MetricTree, prefix: str = "") -> Iterable[tuple[str, MetricValue]]:
    for name, value in metrics.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        elif value is None or isinstance(value, float | int | str):
            yield f"{prefix}{name}", value


def _metric_cell(value: MetricValue) -> str:
    if value is None:
        return _UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    return _number(value) if isinstance(value, int | float) else _text(value)


def _newest(submaps: Sequence[SubmapGeometry]) -> list[SubmapGeometry]:
    """The last revision of each submap, in order of the index."""
    newest: dict[int, SubmapGeometry] = {}
    for submap in submaps:
        known = newest.get(submap.spec.submap_index)
        if known is None or submap.spec.revision >= known.spec.revision:
            newest[submap.spec.submap_index] = submap
    return [newest[index] for index in sorted(newest)]


def _card(name: str, value: str, unit: str = "", note: str = "") -> str:
    unit_part = f" <small>{_text(unit)}</small>" if unit else ""
    note_part = f'<dd class="note">{_text(note)}</dd>' if note else ""
    return f'<div class="card"><dt>{_text(name)}</dt><dd>{value}{unit_part}</dd>{note_part}</div>'


def _notice(text: str, is_bad: bool = False, link: str = "") -> str:
    more = f' <a href="#events">{_text(link)}</a>.' if link else ""
    return f'<p class="notice{" bad" if is_bad else ""}">{_text(text)}{more}</p>\n'


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _path_length(data: ReportData) -> float:
    return sum(track.path_length() for _, track in data.frames.parts())


def _entries(segments: Sequence[Segment]) -> int:
    return sum(len(segment.frames) for segment in segments)


def _summary(data: ReportData) -> str:
    newest = _newest(data.submaps)
    good = sum(submap.verdict == SubmapVerdict.GOOD for submap in newest)
    accepted = sum(constraint.accepted for constraint in data.constraints)
    keyframes = sum(len(segment.base_keyframe_ids) for segment in data.segments)
    cards = [
        _card("frames", _number(_entries(data.segments)), note=f"{_number(len(data.frames))} with a pose"),
        _card("keyframes", _number(keyframes)),
        _card("submaps", _number(len(newest)), note=f"{_number(good)} good"),
        _card("constraints", _number(len(data.constraints)), note=f"{_number(accepted)} accepted"),
        _card("path length", _number(_path_length(data)), data.length_unit),
    ]
    flat = list(_flat(data.metrics))
    parts = len(np.unique(data.frames.components))
    for path, value in flat:
        name = path.rpartition(".")[2]
        if name in _HEADLINES and isinstance(value, float) and math.isfinite(value):
            label, unit = _HEADLINES[name]
            note = "largest part only" if unit != "s" and parts > 1 else ""
            cards.append(_card(label, _number(value, 3), unit, note))
    breaks = data.graph.breaks if data.graph is not None else ()
    if breaks:
        cards.append(_card("breaks", _number(len(breaks))))
    out = f'<dl class="cards">{"".join(cards)}</dl>\n'
    if not len(data.frames):
        out += _notice("No trajectory could be made; the events below say why.", is_bad=True)
    elif breaks:
        where = _plural(len(breaks), "place")
        text = f"The trajectory is broken in {where}: its parts have no common frame and scale."
        out += _notice(text, is_bad=True, link="Where and why")
    if data.dead_jobs:
        out += _notice(f"{_plural(len(data.dead_jobs), 'job')} could not be done by any worker.", link="Which and why")
    if data.graph is not None and not data.graph.is_final:
        out += _notice("The run was stopped before its final solve: this is the last live estimate.")
    if flat:
        rows = [[f"<code>{_text(path)}</code>", _metric_cell(value)] for path, value in flat]
        table = _table(("metric, as in metrics.json", "value"), rows)
        out += f"<details><summary>All metrics ({len(rows)})</summary>{table}</details>\n"
    return out


def _trajectory(data: ReportData) -> str:
    if not len(data.frames):
        return _none("No trajectory.")
    parts = len(np.unique(data.frames.components))
    out = ""
    if data.ground_truth is not None and data.ground_truth.truth_from_component:
        out += _figure(
            plots.overlay_figure(data.frames, data.ground_truth),
            "overlay",
            "Trajectory from above over the ground truth, and its position error along the way",
            "The estimate after alignment to the ground truth by rotation, translation and scale, seen from above; "
            "below, the distance between both along the way.",
        )
        if parts == 1:
            return out
    caption = "Seen from above, on the plane of the world's x and z axes; both axes have the same scale."
    if parts > 1:
        caption += " Parts that are not connected have no common frame or scale and are drawn apart."
    return out + _figure(
        plots.trajectory_figure(data.frames, data.keyframes, data.length_unit),
        "trajectory",
        "Trajectory from above",
        caption,
    )


def _motion(data: ReportData) -> str:
    if not _entries(data.segments):
        return _none("No frames were classified.")
    counts: dict[str, int] = {}
    for segment in data.segments:
        for entry in segment.frames:
            counts[plots.STATE_NAMES[entry.state]] = counts.get(plots.STATE_NAMES[entry.state], 0) + 1
    total = _entries(data.segments)
    shares = ", ".join(f"{name} {100.0 * count / total:.0f} %" for name, count in sorted(counts.items()))
    return _figure(
        plots.motion_figure(data.segments, data.frames, data.motion_scores, data.length_unit),
        "motion",
        "Motion state of every frame over time, with keyframes and submap borders, speed and yaw rate",
        f"Share of frames: {shares}. Speed and yaw rate are those of the estimated trajectory; "
        "the shading repeats the motion state.",
    )


def _map(data: ReportData) -> str:
    if data.cloud is None or not len(data.cloud.points):
        return _none("No map was made.")
    out = _figure(
        map_plots.map_figure(data.cloud, data.frames, data.length_unit),
        "map",
        "The map's points from above with the trajectory",
        f"{_number(len(data.cloud.points))} points from above, cut open above the camera; "
        "the far surroundings are left out.",
        is_photo=True,
    )
    if data.camera_view is not None:
        out += _figure(
            map_plots.camera_view_figure(data.cloud, data.camera_view),
            "camera",
            "The map's points as a camera sees them, beside the recorded frame",
            "The map drawn from one of its cameras: where it is right, it looks like the recorded frame. "
            "Dark is where nothing is known.",
            is_photo=True,
        )
    return out


def _edge_label(constraint: Constraint) -> str:
    spec = constraint.spec
    return f"{spec.i} → {spec.j}{' loop' if spec.kind == 'loop' else ''}"


def _constraints(data: ReportData) -> str:
    if not data.constraints:
        return _none("No constraints: there is one submap, or none.")
    ordered = sorted(data.constraints, key=lambda c: (c.spec.kind, c.spec.j, c.spec.i))
    out = _figure(
        plots.edges_figure(ordered, data.min_inlier_ratio),
        "edges",
        "Inlier ratio, median residual and scale of each constraint",
        "Inlier ratio and residual say how well the point maps of two submaps agree in their shared frames. "
        "The scale tells how the arbitrary units of neighbours differ.",
    )
    refused = [constraint for constraint in ordered if not constraint.accepted]
    if refused:
        rows = [[_text(_edge_label(c)), f"{c.inlier_ratio:.2f}", _text(c.reason)] for c in refused]
        out += f"<h3>Refused</h3>\n{_table(('edge', 'inlier ratio', 'reason'), rows, frozenset({1}))}"
    return out


def _submaps(data: ReportData) -> str:
    newest = _newest(data.submaps)
    if not newest:
        return _none("No submap was predicted.")
    # What needs attention comes first, so that a cut table never hides it.
    ordered = sorted(newest, key=lambda submap: (submap.verdict == SubmapVerdict.GOOD, submap.spec.submap_index))
    rows = []
    for submap in ordered:
        name, kind = _VERDICTS[submap.verdict]
        quality = submap.quality
        revision = f" (r{submap.spec.revision})" if submap.spec.revision > 1 else ""
        rows.append(
            [
                f"{submap.spec.submap_index}{revision}",
                f'<span class="chip {kind}">{name}</span>',
                f"{len(submap.frames)} of {len(submap.spec.keyframe_ids)}",
                _number(quality.mean_reprojection_error_px, 3),
                _number(quality.median_parallax_deg, 3),
                _number(quality.focal_over_width, 4),
                _number(sum(submap.stage_seconds.values()), 3),
                _text(submap.reason),
            ]
        )
    models = ", ".join(sorted({submap.model for submap in newest}))
    counts = ", ".join(
        f"{sum(submap.verdict == verdict for submap in newest)} {name}"
        for verdict, (name, _) in _VERDICTS.items()
        if any(submap.verdict == verdict for submap in newest)
    )
    head = (
        "submap",
        "verdict",
        "keyframes",
        "reprojection (px)",
        "parallax (°)",
        "focal / width",
        "time (s)",
        "reason",
    )
    return f"<p>{_text(counts)}; predictor {_text(models)}.</p>\n{_table(head, rows, frozenset({3, 4, 5, 6}))}"


def _timing(data: ReportData) -> str:
    out = ""
    if data.stage_seconds:
        out += _figure(
            plots.stages_figure(data.stage_seconds),
            "stages",
            "Time of each stage of the run",
            "Stages run side by side, so they do not add up.",
        )
    if any(submap.stage_seconds for submap in data.submaps):
        out += _figure(
            plots.submap_times_figure(data.submaps),
            "submap-times",
            "Time of the predictor's stages for each submap",
            "Prediction of each submap.",
        )
    return out or _none("No times were taken.")


def _event_item(event: Event) -> str:
    detail = "; ".join(f"{key}: {value}" for key, value in sorted(event.detail.items()) if key != "traceback")
    out = _text(event.message) + (f' <span class="muted">({_text(detail)})</span>' if detail else "")
    return out + _traceback(event.detail.get("traceback", ""))


def _traceback(text: str) -> str:
    return f"<details><summary>traceback</summary><pre>{_text(text)}</pre></details>" if text else ""


def _job_item(job: JobReport) -> str:
    counts = f"{_plural(job.failure_count, 'failure')}, {_plural(job.lost_lease_count, 'lost lease')}"
    note = f'<span class="muted">({_text(counts)}, last worker {_text(job.worker or "unknown")})</span>'
    return f"<strong>{_text(job.job_id)}</strong>: {_text(job.last_reason)} {note}{_traceback(job.last_traceback)}"


def _events(data: ReportData) -> str:
    breaks = data.graph.breaks if data.graph is not None else ()
    groups: list[tuple[str, list[str]]] = [("Breaks", [_text(line) for line in breaks])]
    jobs = [_job_item(job) for job in data.dead_jobs]
    known = {job.job_id for job in data.dead_jobs}
    dead = [event for event in data.events if event.kind == EventKind.JOB_DEAD]
    jobs += [_event_item(event) for event in dead if event.detail.get("job_id") not in known]
    groups.append(("Dead jobs", jobs))
    warnings = [event for event in data.events if event.kind == EventKind.WARNING]
    told = {*breaks, *(event.message for event in warnings)}
    lines = [_event_item(event) for event in warnings] + [_text(line) for line in data.warnings if line not in told]
    groups.append(("Warnings", lines))
    out = "".join(f"<h3>{title} ({len(items)})</h3>\n{_list(items)}" for title, items in groups if items)
    out = out or _none("None: no warning, no dead job, no break.")
    others = [event for event in data.events if event.kind not in (EventKind.WARNING, EventKind.JOB_DEAD)]
    if others:
        items = [f"{_text(event.kind.value)}: {_event_item(event)}" for event in others]
        out += f"<details><summary>Other events ({len(others)})</summary>{_list(items)}</details>\n"
    return out


def _configuration(data: ReportData) -> str:
    rows = [[_text(name), _text(version)] for name, version in sorted(data.versions.items())]
    versions = _table(("package", "version"), rows) if rows else ""
    configuration = (
        f"<details open><summary>Effective configuration</summary><pre>{_text(data.config_yaml)}</pre></details>\n"
        if data.config_yaml
        else ""
    )
    return configuration + versions or _none("Not given.")
