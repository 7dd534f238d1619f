"""The report as a browser reads it: whole, self-contained, with hostile text as text."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vggt_motion.config import Config
from vggt_motion.evaluation.report import FILE_NAME, render_report, write_report
from vggt_motion.evaluation.report_data import (
    CameraView,
    ComponentTrack,
    GroundTruth,
    MotionScores,
    PointCloud,
    ReportData,
    empty_track,
)
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.geometry.track import PoseTrack
from vggt_motion.records import (
    BlobRef,
    Constraint,
    ConstraintKind,
    DropReason,
    Event,
    EventKind,
    FrameEntry,
    FrameGeometry,
    GraphUpdate,
    JobKind,
    JobReport,
    JobState,
    MotionState,
    RegistrationSpec,
    ScaleKind,
    Segment,
    SubmapGeometry,
    SubmapQuality,
    SubmapSpec,
    SubmapVerdict,
)

SECTIONS = ["summary", "trajectory", "motion", "map", "constraints", "submaps", "timing", "events", "configuration"]
VOID = {"meta", "img", "br"}
FRAMES_PER_SEGMENT = 6


class Page(HTMLParser):
    """Collects elements, and fails on tags that do not nest."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.elements: list[tuple[str, Mapping[str, str | None]]] = []
        self.text_of: dict[str, str] = {}  # section id -> text
        self._section = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "section":
            self._section = str(dict(attrs)["id"])

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] != ["style"]:
            self.text_of[self._section] = self.text_of.get(self._section, "") + data

    def attributes(self, tag: str, name: str) -> list[str]:
        return [str(attributes[name]) for found, attributes in self.elements if found == tag and name in attributes]


def keyframe(index: int) -> str:
    return f"front/0/{index:08d}"


def segment(index: int) -> Segment:
    begin = index * FRAMES_PER_SEGMENT
    entries = tuple(
        FrameEntry(i, i * 100_000_000, MotionState.LINEAR, i % 2 == 0, None if i % 2 == 0 else DropReason.LOW_PARALLAX)
        for i in range(begin, begin + FRAMES_PER_SEGMENT)
    )
    base = tuple(keyframe(entry.frame_index) for entry in entries if entry.is_keyframe)
    return Segment(index, "front", 0, base, (), entries, "budget")


def submap(
    index: int, verdict: SubmapVerdict = SubmapVerdict.GOOD, reason: str = "", revision: int = 1, stage: str = "mapping"
) -> SubmapGeometry:
    blob = BlobRef("0" * 64, 1, "application/vnd.vggt-motion.depth")
    spec = SubmapSpec(index, revision, (), segment(index).base_keyframe_ids)
    frames = (
        ()
        if verdict == SubmapVerdict.FAILED
        else tuple(
            FrameGeometry(name, Intrinsics.centred(100.0, 31, 21), np.eye(4), blob) for name in spec.keyframe_ids
        )
    )
    quality = SubmapQuality(len(frames), 0.27, 0.8, 3.0, float("nan"), float("inf"))
    return SubmapGeometry(spec, verdict, reason, ScaleKind.RELATIVE, "sfm", frames, quality, {stage: 2.5})


def edge(j: int, accepted: bool = True, reason: str = "") -> Constraint:
    spec = RegistrationSpec(j - 1, j, 1, 1, ConstraintKind.ADJACENT, (keyframe(6 * j),))
    return Constraint(spec, accepted, reason, Sim3(scale=1.1), 0.9 if accepted else 0.31, 0.01, np.eye(7), 1000)


def track(count: int) -> ComponentTrack:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.arange(count)
    return ComponentTrack(PoseTrack(np.arange(count) * 100_000_000, poses), np.zeros(count, np.int64))


def full_data(text: str = "plain") -> ReportData:
    """A run of two submaps with every optional part; ``text`` stands wherever text comes from outside."""
    frames = track(2 * FRAMES_PER_SEGMENT)
    cloud = PointCloud(np.random.default_rng(0).uniform(-3, 9, (500, 3)), np.full((500, 3), 120, np.uint8))
    times = frames.track.times_ns
    return ReportData(
        source=f"folder {text}",
        created="2026-01-02T03:04:05Z",
        length_unit="m",
        segments=(segment(0), segment(1)),
        submaps=(submap(0), submap(1, SubmapVerdict.FAILED, f"no tracks {text}", stage=text)),
        constraints=(edge(1, accepted=False, reason=f"refused {text}"),),
        graph=GraphUpdate(1, True, (), (), (f"between 0 and 1 {text}",)),
        keyframes=track(6),
        frames=frames,
        ground_truth=GroundTruth(frames.track, {0: Sim3.identity()}),
        cloud=cloud,
        camera_view=CameraView(3, np.eye(4), Intrinsics.centred(100.0, 62, 20), np.zeros((20, 62, 3), np.uint8)),
        motion_scores=MotionScores(times, np.zeros(len(times)), np.ones(len(times))),
        metrics={"ate": {"ate_rmse_m": 0.123456, "note": text}, "drift_ate_percent": 0.928, text: 1, "lost_s": None},
        stage_seconds={"frontend": 1.5, text: 2.0},
        events=(
            Event("e0", EventKind.SESSION_STARTED, f"started {text}", 0),
            Event("e1", EventKind.WARNING, f"careful {text}", 0, {text: text}),
            Event("e2", EventKind.JOB_DEAD, f"dead {text}", 0, {"job_id": "job/other", "traceback": f"trace {text}"}),
        ),
        dead_jobs=(
            JobReport("submap/000001/r1", JobKind.PREDICT, JobState.DEAD, 3, 1, text, f"reason {text}", f"tb {text}"),
        ),
        min_inlier_ratio=0.5,
        config_yaml=Config().to_yaml() + f"# {text}\n",
        versions={"vggt-motion": "1.2.3", "numpy": text},
    )


@pytest.fixture(scope="module")
def page() -> Page:
    return Page(render_report(full_data()))


def test_every_section_is_there_and_reachable(page: Page) -> None:
    assert page.attributes("section", "id") == SECTIONS
    assert page.attributes("a", "href")[: len(SECTIONS)] == [f"#{name}" for name in SECTIONS]


def test_every_plot_is_there_and_says_what_it_shows(page: Page) -> None:
    names = [name.removeprefix("figure-") for name in page.attributes("figure", "id")]
    assert names == ["overlay", "motion", "map", "camera", "edges", "stages", "submap-times"]
    assert all(len(text) > 20 for text in page.attributes("img", "alt"))


def test_pictures_are_inside_the_file_and_readable(page: Page) -> None:
    for source in page.attributes("img", "src"):
        head, _, payload = source.partition(";base64,")
        data = base64.b64decode(payload, validate=True)
        if head == "data:image/png":
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            assert picture is not None and picture.std() > 5.0
        else:
            assert head == "data:image/svg+xml"
            root = ElementTree.fromstring(data)
            assert root.tag.endswith("svg")
            assert len(root.findall(".//{http://www.w3.org/2000/svg}path")) > 20


def test_page_loads_and_runs_nothing(page: Page) -> None:
    assert not {tag for tag, _ in page.elements} & {
        "script",
        "link",
        "iframe",
        "object",
        "embed",
        "form",
        "base",
        "video",
    }
    for tag, attributes in page.elements:
        assert not [
            name for name in attributes if name.startswith("on") or name in ("srcset", "style", "background")
        ], tag
        assert str(attributes.get("src", "data:")).startswith("data:image/") or "src" not in attributes
        assert str(attributes.get("href", "#")).startswith("#")
    policies = [a["content"] for tag, a in page.elements if a.get("http-equiv") == "Content-Security-Policy"]
    assert policies == ["default-src 'none'; img-src data:; style-src 'unsafe-inline'"]


def test_numbers_and_reasons_stand_where_they_belong(page: Page) -> None:
    summary = " ".join(page.text_of["summary"].split())
    for phrase in (
        "frames12 12 with a pose".replace(" ", ""),
        "submaps21good",
        "constraints10accepted",
        "pathlength11m",
    ):
        assert phrase in summary.replace(" ", "")
    assert "ATE, RMSE0.123 m" in summary and "drift, ATE / length0.928 %" in summary
    assert "ate.ate_rmse_m0.1235" in summary
    assert "broken in 1 place:" in summary and "1 job could not be done" in summary
    assert "refused plain" in page.text_of["constraints"]
    assert "1 good, 1 failed; predictor sfm." in page.text_of["submaps"]
    assert "no tracks plain" in page.text_of["submaps"]
    events = page.text_of["events"]
    assert "Breaks (1)" in events and "Dead jobs (2)" in events and "Warnings (1)" in events
    assert "between 0 and 1 plain" in events and "3 failures, 1 lost lease" in events
    assert "flow_width_px: 320" in page.text_of["configuration"] and "1.2.3" in page.text_of["configuration"]


HOSTILE = [
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "' onload='alert(1)",
    "</pre></section><iframe src=http://example.org></iframe>",
    "<!-- ]]> -->",
    "&lt;b&gt; &amp; &#60;",
    r"$\frac{1}{2",
    "{0} %s \\x41",
    "ünï ✓",
]


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_text_stays_text(page: Page, text: str) -> None:
    hostile = Page(render_report(full_data(text)))
    assert [tag for tag, _ in hostile.elements] == [tag for tag, _ in page.elements]
    assert [sorted(attributes) for _, attributes in hostile.elements] == [
        sorted(attributes) for _, attributes in page.elements
    ]
    for section in ("summary", "constraints", "submaps", "events", "configuration"):
        assert text in hostile.text_of[section]
    assert f"folder {text}" in hostile.text_of[""]


@settings(deadline=None, max_examples=60)
@given(text=st.text(max_size=40))
def test_any_text_leaves_the_page_whole(text: str) -> None:
    data = dataclasses.replace(
        empty_data(),
        source=text,
        config_yaml=text,
        events=(Event(text, EventKind.WARNING, text, 0, {text: text, "traceback": text}),),
        versions={text: text},
    )
    page = Page(render_report(data))
    assert page.attributes("section", "id") == SECTIONS
    assert not {tag for tag, _ in page.elements} & {"script", "img", "iframe"}


def test_control_characters_and_direction_overrides_are_made_visible(tmp_path: Path) -> None:
    data = dataclasses.replace(empty_data(), source="a\x00b\x1bc\u202ed\udc80e")
    text = write_report(tmp_path, data).read_bytes().decode("utf-8")
    assert "a\ufffdb\ufffdc\ufffdd\ufffde" in text


def empty_data() -> ReportData:
    return ReportData("nothing", "2026-01-02T03:04:05Z", "units", (), (), (), None, empty_track(), empty_track())


def test_run_without_a_result_says_so_in_every_section() -> None:
    page = Page(render_report(empty_data()))
    assert page.attributes("section", "id") == SECTIONS
    assert page.attributes("img", "src") == []
    assert "No trajectory could be made" in page.text_of["summary"]
    phrases = {"trajectory": "No trajectory", "map": "No map", "submaps": "No submap", "constraints": "No constraints"}
    for section, phrase in phrases.items():
        assert phrase in page.text_of[section]
    assert "None: no warning, no dead job, no break." in page.text_of["events"]


def test_unfinished_run_is_marked() -> None:
    data = dataclasses.replace(full_data(), graph=GraphUpdate(4, False, (), ()))
    assert "stopped before its final solve" in Page(render_report(data)).text_of["summary"]


def test_newest_revision_counts() -> None:
    data = dataclasses.replace(
        empty_data(), submaps=(submap(0, SubmapVerdict.FAILED, "first try"), submap(0, SubmapVerdict.GOOD, revision=2))
    )
    text = Page(render_report(data)).text_of["submaps"]
    assert "1 good; predictor sfm." in text and "0 (r2)" in text and "first try" not in text


def test_long_tables_are_cut_but_never_hide_a_failure() -> None:
    submaps = [submap(index) for index in range(1500)]
    submaps[1400] = submap(1400, SubmapVerdict.FAILED, "the one that failed")
    events = tuple(Event(f"w{i}", EventKind.WARNING, f"warning {i}", 0) for i in range(5000))
    data = dataclasses.replace(
        empty_data(), submaps=tuple(dataclasses.replace(s, stage_seconds={}) for s in submaps), events=events
    )
    text = render_report(data)
    page = Page(text)
    assert "the one that failed" in page.text_of["submaps"]
    assert "… and 1300 more." in page.text_of["submaps"] and "… and 4800 more." in page.text_of["events"]
    assert "Warnings (5000)" in page.text_of["events"]
    assert len(text) < 200_000


def test_parts_are_drawn_apart_also_beside_a_ground_truth() -> None:
    data = full_data()
    frames = ComponentTrack(data.frames.track, np.repeat([0, 1], FRAMES_PER_SEGMENT))
    page = Page(render_report(dataclasses.replace(data, frames=frames)))
    assert {"figure-overlay", "figure-trajectory"} <= set(page.attributes("figure", "id"))


def test_same_data_gives_the_same_file(tmp_path: Path) -> None:
    path = write_report(tmp_path, full_data())
    first = path.read_bytes()
    assert write_report(tmp_path, full_data()).read_bytes() == first
    assert [entry.name for entry in tmp_path.iterdir()] == [FILE_NAME]


def test_failed_write_keeps_the_report_that_was_there(tmp_path: Path) -> None:
    (tmp_path / FILE_NAME).write_text("earlier", encoding="utf-8")
    (tmp_path / f".{FILE_NAME}.part").mkdir()  # stands in the way of the new file, also for root
    with pytest.raises(IsADirectoryError):
        write_report(tmp_path, empty_data())
    assert (tmp_path / FILE_NAME).read_text(encoding="utf-8") == "earlier"


def test_warnings_are_told_once_whoever_tells_them() -> None:
    data = dataclasses.replace(
        empty_data(),
        graph=GraphUpdate(1, True, (), (), ("broken before submap 3",)),
        events=(Event("w", EventKind.WARNING, "careful", 0),),
        warnings=("careful", "broken before submap 3", "2 of 9 frames have no pose <b>"),
        metrics={"warnings": ["careful"], "count": 3},
    )
    page = Page(render_report(data))
    events = page.text_of["events"]
    assert "Breaks (1)" in events and "Warnings (2)" in events
    assert events.count("careful") == 1 and events.count("broken before submap 3") == 1
    assert "2 of 9 frames have no pose <b>" in events
    assert "All metrics (1)" in page.text_of["summary"]


def test_page_of_a_very_long_drive_stays_small() -> None:
    count = 60_000
    entries = tuple(FrameEntry(i, i * 100_000_000, MotionState("LT"[i // 40 % 2]), i % 3 == 0) for i in range(count))
    base = tuple(keyframe(entry.frame_index) for entry in entries if entry.is_keyframe)
    frames = track(count)
    frames.track.world_from_camera[:, 0, 3] = np.random.default_rng(1).normal(0.0, 1.0, count)
    data = dataclasses.replace(
        empty_data(), segments=(Segment(0, "front", 0, base, (), entries, "budget"),), frames=frames, keyframes=frames
    )
    text = render_report(data)
    assert len(text) < 4_000_000
    sources = Page(text).attributes("img", "src")
    assert any(source.startswith("data:image/png") for source in sources)
