"""``vggt-motion inspect``: what the frontend sees in a source, and what it decides, without any other service."""

from __future__ import annotations

import base64
import csv
import html
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.config import Config
from vggt_motion.errors import InputError, SourceTruncatedError
from vggt_motion.evaluation.inspect_plot import Picture, inspect_figure
from vggt_motion.evaluation.plot_style import to_png
from vggt_motion.evaluation.plots import STATE_NAMES
from vggt_motion.evaluation.report_style import CSS
from vggt_motion.frontend.pipeline import FrameTrace, FrontendPipeline, KeyframeOutput, Output
from vggt_motion.records import Keyframe, MotionState, Segment
from vggt_motion.sources.registry import open_source

PNG_NAME, HTML_NAME, CSV_NAME = "inspect.png", "inspect.html", "inspect.csv"

_THUMBNAIL_WIDTH_PX = 240
_MAX_BORDERS_ON_PAGE = 200  # a page must open, however long the drive was

CSV_COLUMNS = (
    "frame_index",
    "capture_time_s",
    "state",
    "is_keyframe",
    "drop_reason",
    "static_ratio",
    "yaw_px_per_100ms",
    "lateral_px_per_100ms",
    "parallax_px",
    "segment",
    "zero_motion_copy_of",
)


@dataclass(frozen=True)
class Inspection:
    """What was found; the files are written."""

    frame_count: int
    keyframe_count: int
    segments: tuple[Segment, ...]
    state_counts: dict[MotionState, int]
    truncated: str  # why the source ended early; empty when it did not
    png: Path
    page: Path
    table: Path


@dataclass
class _Collected:
    traces: list[FrameTrace] = field(default_factory=list)
    keyframes: list[Keyframe] = field(default_factory=list)
    segments: list[Segment] = field(default_factory=list)
    first_pictures: list[tuple[int, bytes]] = field(default_factory=list)  # of each segment: frame index, JPEG
    last_pictures: list[tuple[int, bytes]] = field(default_factory=list)
    _newest: KeyframeOutput | None = None

    def take(self, outputs: list[Output]) -> None:
        """Keep thumbnails of the first and the last keyframe of each segment; the images go."""
        for output in outputs:
            if isinstance(output, KeyframeOutput):
                self.keyframes.append(output.keyframe)
                if len(self.first_pictures) == len(self.segments):
                    self.first_pictures.append((output.keyframe.frame_index, _thumbnail(output.encoded)))
                self._newest = output
            else:
                assert self._newest is not None
                self.segments.append(output.segment)
                self.last_pictures.append((self._newest.keyframe.frame_index, _thumbnail(self._newest.encoded)))


def inspect(
    source: str,
    config: Config,
    out: Path,
    *,
    start: int = 0,
    end: int | None = None,
    stride: int = 1,
    ego_mask: npt.NDArray[np.generic] | None = None,
) -> Inspection:
    """Run the frontend over a source and write ``inspect.png``, ``inspect.html`` and ``inspect.csv``.

    A source that ends early is shown as far as it goes; ``truncated`` then says why.

    Args:
        source: as for ``vggt-motion run``.
        config: sections ``frontend`` and ``run`` are used.
        out: folder for the files; made if it is not there.
        start: first frame.
        end: first frame not taken any more.
        stride: every so many frames.
        ego_mask: (H, W) of the full image, non-zero = never to be used.

    Raises:
        SourceError: nothing readable in the source.
        InputError: ``out`` cannot be written.
    """
    opened = open_source(source, start=start, end=end, stride=stride, nominal_rate_hz=config.run.nominal_rate_hz)
    collected = _Collected()
    pipeline = FrontendPipeline(config.frontend, config.run.camera, 0, ego_mask, on_trace=collected.traces.append)
    truncated = ""
    try:
        for frame in opened.frames():
            collected.take(pipeline.push(frame))
    except SourceTruncatedError as error:
        truncated = str(error)
    finally:
        opened.close()
    collected.take(pipeline.finish())
    pictures = [(index, _decode(data)) for index, data in collected.first_pictures]
    figure = inspect_figure(collected.traces, collected.segments, pictures, config.frontend, opened.description)
    png = to_png(figure, 120)
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / PNG_NAME).write_bytes(png)
        page = _page(collected, config, opened.description, truncated, png)
        (out / HTML_NAME).write_text(page, encoding="utf-8", errors="replace")
        _write_table(out / CSV_NAME, collected)
    except OSError as error:
        raise InputError(f"cannot write to {out}: {error.strerror or error}") from error
    return Inspection(
        frame_count=pipeline.frame_count,
        keyframe_count=pipeline.keyframe_count,
        segments=tuple(collected.segments),
        state_counts=dict(pipeline.state_counts),
        truncated=truncated,
        png=out / PNG_NAME,
        page=out / HTML_NAME,
        table=out / CSV_NAME,
    )


def _thumbnail(encoded: bytes) -> bytes:
    """A small JPEG of an encoded image."""
    pixels = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
    height, width = pixels.shape[:2]  # type: ignore[union-attr]  # the pipeline has decoded the same bytes
    size = (_THUMBNAIL_WIDTH_PX, max(1, round(height * _THUMBNAIL_WIDTH_PX / width)))
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)  # type: ignore[arg-type]
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()


def _decode(jpeg: bytes) -> Picture:
    pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8)  # type: ignore[arg-type]


def _write_table(path: Path, collected: _Collected) -> None:
    segment_of = {entry.frame_index: segment.index for segment in collected.segments for entry in segment.frames}
    copy_of = {keyframe.frame_index: keyframe.zero_motion_copy_of for keyframe in collected.keyframes}
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(CSV_COLUMNS)
        for trace in collected.traces:
            profile = trace.profile
            writer.writerow(
                (
                    trace.frame_index,
                    f"{trace.capture_time_ns * 1e-9:.9f}",
                    trace.state.value,
                    int(trace.is_keyframe),
                    trace.drop_reason.value if trace.drop_reason is not None else "",
                    f"{profile.static_ratio:.6f}",
                    f"{profile.yaw_px:.6f}",
                    f"{profile.lateral_px:.6f}",
                    f"{trace.parallax_px:.6f}",
                    segment_of[trace.frame_index],
                    copy_of.get(trace.frame_index) or "",
                )
            )


def _page(collected: _Collected, config: Config, description: str, truncated: str, png: bytes) -> str:
    def text(value: object) -> str:
        return html.escape(str(value), quote=True)

    def image(media: str, data: bytes, alternative: str) -> str:
        encoded = base64.b64encode(data).decode("ascii")
        return f'<img alt="{text(alternative)}" src="data:{media};base64,{encoded}">'

    counts = Counter(trace.state for trace in collected.traces)
    total = len(collected.traces)
    cards = [
        ("frames", f"{total}"),
        ("keyframes", f"{len(collected.keyframes)}"),
        ("submaps", f"{len(collected.segments)}"),
        *((STATE_NAMES[state], f"{100 * counts[state] / max(1, total):.1f}%") for state in MotionState),
    ]
    rows = []
    pairs = zip(collected.segments, collected.first_pictures, collected.last_pictures, strict=True)
    for segment, (first, first_jpeg), (last, last_jpeg) in list(pairs)[:_MAX_BORDERS_ON_PAGE]:
        states = Counter(entry.state for entry in segment.frames)
        mixture = ", ".join(f"{STATE_NAMES[state]} {states[state]}" for state in MotionState if states[state])
        rows.append(
            f'<tr><td class="number">{segment.index}</td>'
            f"<td>{image('image/jpeg', first_jpeg, f'frame {first}')}<br>frame {first}</td>"
            f"<td>{image('image/jpeg', last_jpeg, f'frame {last}')}<br>frame {last}</td>"
            f'<td class="number">{len(segment.base_keyframe_ids)}</td>'
            f'<td class="number">{len(segment.overlap_keyframe_ids)}</td>'
            f"<td>{text(mixture)}</td><td>{text(segment.closed_by.replace('_', ' '))}</td></tr>\n"
        )
    hidden = len(collected.segments) - len(rows)
    more = f'<p class="muted">{hidden} more submaps are in the table {CSV_NAME}.</p>' if hidden > 0 else ""
    notice = f'<p class="notice bad">The source ended early: {text(truncated)}</p>' if truncated else ""
    settings = "\n".join(f"{name}: {value}" for name, value in config.frontend.model_dump(mode="json").items())
    listed = "".join(f'<div class="card"><dt>{text(name)}</dt><dd>{text(value)}</dd></div>' for name, value in cards)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta http-equiv="Content-Security-Policy" '
        "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">\n"
        f"<title>VGGT-Motion frontend: {text(description)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n"
        f'<header><h1>What the frontend sees</h1>\n<p class="muted">{text(description)}</p></header>\n<main>\n{notice}'
        f'<dl class="cards">{listed}</dl>\n'
        "<h2>Scores, states and borders over time</h2>\n"
        f"<figure>{image('image/png', png, 'scores, states, keyframes and submap borders over time')}"
        "<figcaption>Pictures are the first keyframes of submaps. Scores are smoothed, in pixels of the working image "
        f"({config.frontend.flow_width_px} px wide).</figcaption></figure>\n"
        "<h2>Submaps</h2>\n<table><tr><th>submap</th><th>first keyframe</th><th>last keyframe</th><th>base</th>"
        f"<th>overlap</th><th>frames by state</th><th>closed by</th></tr>\n{''.join(rows)}</table>\n{more}"
        f"<h2>Configuration</h2>\n<pre>{text(settings)}</pre>\n</main>\n</body>\n</html>\n"
    )
