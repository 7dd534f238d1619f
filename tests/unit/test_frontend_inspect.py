"""``inspect``: the table says what the pipeline decided, the picture and the page open."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from vggt_motion.config import Config
from vggt_motion.errors import InputError, SourceError
from vggt_motion.evaluation.inspect import CSV_COLUMNS, inspect
from vggt_motion.frontend.pipeline import FrameTrace, FrontendPipeline
from vggt_motion.sources.registry import open_source


@pytest.fixture(scope="module")
def sequence() -> Path:
    return Path(__file__).resolve().parents[1] / "data" / "kitti_06_first51"


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
        assert reader.fieldnames is not None and tuple(reader.fieldnames) == CSV_COLUMNS
    return rows


def test_the_table_is_what_the_pipeline_decided(sequence: Path, tmp_path: Path) -> None:
    found = inspect(str(sequence), Config(), tmp_path / "new" / "folder")
    traces: list[FrameTrace] = []
    pipeline = FrontendPipeline(Config().frontend, "front", on_trace=traces.append)
    for frame in open_source(str(sequence)).frames():
        pipeline.push(frame)
    pipeline.finish()
    rows = _rows(found.table)
    assert [int(row["frame_index"]) for row in rows] == list(range(51))
    assert [row["state"] for row in rows] == [trace.state.value for trace in traces]
    assert [row["is_keyframe"] == "1" for row in rows] == [trace.is_keyframe for trace in traces]
    for row, trace in zip(rows, traces, strict=True):
        assert float(row["capture_time_s"]) == pytest.approx(trace.capture_time_ns * 1e-9, abs=1e-9)
        assert float(row["yaw_px_per_100ms"]) == pytest.approx(trace.profile.yaw_px, abs=1e-5)
        assert float(row["static_ratio"]) == pytest.approx(trace.profile.static_ratio, abs=1e-5)
    segments = [int(row["segment"]) for row in rows]
    assert segments == sorted(segments) and segments[-1] + 1 == len(found.segments) == pipeline.segment_count
    assert found.frame_count == 51 and found.keyframe_count == pipeline.keyframe_count
    assert found.truncated == ""


def test_picture_and_page_open_and_need_nothing_else(sequence: Path, tmp_path: Path) -> None:
    found = inspect(str(sequence), Config(), tmp_path, end=30)
    picture = cv2.imread(str(found.png))
    assert picture is not None and picture.shape[1] > 1000
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 1000  # photographs are in it
    page = found.page.read_text()
    # the big picture, and first and last keyframe of each submap
    assert page.count("<img") == 1 + 2 * len(found.segments)
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)
    assert "<script" not in page


def test_two_inspections_write_the_same_files(sequence: Path, tmp_path: Path) -> None:
    a = inspect(str(sequence), Config(), tmp_path / "a", end=12)
    b = inspect(str(sequence), Config(), tmp_path / "b", end=12)
    for one, other in ((a.png, b.png), (a.page, b.page), (a.table, b.table)):
        assert one.read_bytes() == other.read_bytes()


def test_a_source_that_ends_early_is_shown_as_far_as_it_goes(sequence: Path, tmp_path: Path) -> None:
    folder = tmp_path / "<b>cut"
    folder.mkdir()
    for k in range(10):
        (folder / f"{k}.jpg").write_bytes((sequence / "image_0" / f"{k:06d}.jpg").read_bytes())
    (folder / "10.jpg").write_text("no image")
    found = inspect(str(folder), Config(), tmp_path / "out")
    assert found.frame_count == 10
    assert "frame 10" in found.truncated
    page = found.page.read_text()
    assert "The source ended early" in page
    assert "<b>cut" not in page and "&lt;b&gt;cut" in page


def test_one_frame(sequence: Path, tmp_path: Path) -> None:
    found = inspect(str(sequence), Config(), tmp_path, end=1)
    assert len(_rows(found.table)) == 1


def test_nothing_to_read_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(SourceError):
        inspect(str(tmp_path), Config(), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_unwritable_folder_is_one_clear_line(sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="cannot write to"):
        inspect(str(sequence), Config(), tmp_path / "file", end=2)
