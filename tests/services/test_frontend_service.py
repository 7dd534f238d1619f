"""The frontend's process against a real router and a real ledger, on loopback."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from bus_processes import (
    EXIT_LIMIT_S,
    SESSION,
    connect,
    wait_until,
    wait_until_heard,
    wait_until_known,
    wait_until_unheard,
)
from vggt_motion.bus import codec
from vggt_motion.bus.images import ImageHeader, ReceivedImage, decode_image, encode_image
from vggt_motion.bus.ledger import LedgerClient
from vggt_motion.bus.liveliness import ServiceWatch
from vggt_motion.bus.session import Bus, Sample
from vggt_motion.config import FrontendConfig
from vggt_motion.errors import BusError
from vggt_motion.frontend.pipeline import FrontendPipeline, KeyframeOutput, SegmentOutput
from vggt_motion.records import BlobRef, Event, EventKind, Keyframe, Segment, Stream
from vggt_motion.sources.registry import open_source

pytestmark = pytest.mark.timeout(120)


class Services:
    """Router (of the fixture), a ledger, and frontends on demand."""

    def __init__(self, folder: Path, endpoint: str, bus: Bus) -> None:
        self.folder = folder
        self.bus = bus
        self.ledger = LedgerClient(bus)
        self._endpoint = endpoint
        self._children: list[subprocess.Popen[bytes]] = []
        self.start("ledger", "--directory", str(folder / "ledger"))
        wait_until(self._answers)

    def _answers(self) -> bool:
        try:
            return self.ledger.status().is_accepting
        except BusError:
            return False

    def start(self, name: str, *arguments: str) -> subprocess.Popen[bytes]:
        environment = {
            **os.environ,
            "VGGT_MOTION_BUS__ENDPOINT": self._endpoint,
            "VGGT_MOTION_BUS__SESSION": SESSION,
            "VGGT_MOTION_SPOOL__DIRECTORY": str(self.folder / "spool"),
        }
        log = (self.folder / f"{name}.log").open("wb")
        command = [sys.executable, "-m", "vggt_motion", "serve", name, *arguments]
        child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment)
        log.close()
        self._children.append(child)
        return child

    def frontend(self, source: Path | str, *arguments: str) -> subprocess.Popen[bytes]:
        return self.start("frontend", "--source", str(source), *arguments)

    def last_line(self) -> str:
        text = (self.folder / "frontend.log").read_text()
        assert "Traceback" not in text
        return text.strip().splitlines()[-1]

    def records(self, stream: Stream, cls: type) -> list:
        entries, position = [], 0
        while page := self.ledger.read(stream, position):
            entries += page
            position += len(page)
        return [codec.decode(cls, entry.payload) for entry in entries]

    def events(self) -> list[Event]:
        return self.records(Stream.EVENT, Event)

    def keyframes(self) -> list[Keyframe]:
        return self.records(Stream.KEYFRAME, Keyframe)

    def segments(self) -> list[Segment]:
        return self.records(Stream.SEGMENT, Segment)

    def close(self) -> None:
        for child in self._children:
            if child.poll() is None:
                child.kill()
                child.wait(10)


@pytest.fixture
def services(tmp_path: Path, endpoint: str, bus: Bus) -> Iterator[Services]:
    started = Services(tmp_path, endpoint, bus)
    yield started
    started.close()


@pytest.fixture
def sequence(sample_dir: Path) -> Path:
    return sample_dir / "kitti_06_first51"


def expected(source: Path) -> tuple[list[Keyframe], list[Segment]]:
    """What the pure pipeline makes of the source, in this process."""
    pipeline = FrontendPipeline(FrontendConfig(), "front")
    outputs = [output for frame in open_source(str(source)).frames() for output in pipeline.push(frame)]
    outputs += pipeline.finish()
    keyframes = [output.keyframe for output in outputs if isinstance(output, KeyframeOutput)]
    return keyframes, [output.segment for output in outputs if isinstance(output, SegmentOutput)]


def long_sequence(sequence: Path, folder: Path, laps: int) -> Path:
    """The sequence there and back again several times, so that there is time to disturb the frontend."""
    images = sorted((sequence / "image_0").glob("*.jpg"))
    folder.mkdir()
    for position, image in enumerate((images + images[::-1]) * laps):
        (folder / f"{position:06d}.jpg").symlink_to(image)
    return folder


def test_a_folder_becomes_records_blobs_and_images(services: Services, sequence: Path) -> None:
    received: list[ReceivedImage] = []
    services.bus.subscribe(
        services.bus.keys.image("front"),
        lambda sample: received.append(decode_image(sample.payload, sample.attachment)),
        history=True,
    )
    assert services.frontend(sequence).wait(60) == 0
    keyframes, segments = expected(sequence)
    assert services.keyframes() == keyframes
    assert services.segments() == segments
    for keyframe in keyframes:
        image = sequence / "image_0" / f"{keyframe.frame_index:06d}.jpg"
        assert services.ledger.blob(keyframe.image) == image.read_bytes()
    started, ended = services.events()
    assert (started.event_id, started.kind) == ("session_started", EventKind.SESSION_STARTED)
    assert started.detail["fingerprint"] == open_source(str(sequence)).fingerprint
    assert (ended.event_id, ended.kind) == ("stream_ended", EventKind.STREAM_ENDED)
    assert ended.detail == {"frame_count": "51", "segment_count": str(len(segments))}
    wait_until(lambda: len(received) >= 51)
    frames = list(open_source(str(sequence)).frames())
    assert [image.encoded for image in received] == [frame.encoded for frame in frames]
    assert [image.capture_time_ns for image in received] == [frame.capture_time_ns for frame in frames]
    assert [image.header.frame_index for image in received if image.header is not None] == list(range(51))


def test_a_second_run_changes_nothing(services: Services, sequence: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert services.frontend(sequence).wait(60) == 0
    before = services.ledger.status().positions
    # the same folder by another name: its description differs, its fingerprint does not
    monkeypatch.chdir(sequence.parent)
    assert services.frontend(sequence.name).wait(60) == 0
    assert services.ledger.status().positions == before


def test_another_source_in_the_same_session_is_refused(services: Services, sequence: Path) -> None:
    assert services.frontend(sequence).wait(60) == 0
    assert services.frontend(sequence, "--stride", "2").wait(60) == 2
    assert "the session holds another source" in services.last_line()


def test_killed_and_restarted(services: Services, sequence: Path, tmp_path: Path) -> None:
    source = long_sequence(sequence, tmp_path / "long", 5)
    for wanted in (5, 25):
        child = services.frontend(source)
        wait_until(lambda count=wanted: services.ledger.read(Stream.KEYFRAME, count, 1))
        child.send_signal(signal.SIGKILL)
        child.wait(10)
    assert not [event for event in services.events() if event.kind is EventKind.STREAM_ENDED]
    assert services.frontend(source).wait(60) == 0
    keyframes, segments = expected(source)
    assert services.keyframes() == keyframes
    assert services.segments() == segments
    assert [event.event_id for event in services.events()] == ["session_started", "stream_ended"]


def test_told_to_stop_it_ends_soon_and_leaves_the_stream_open(
    services: Services, sequence: Path, tmp_path: Path
) -> None:
    child = services.frontend(long_sequence(sequence, tmp_path / "long", 20))
    wait_until(lambda: services.ledger.read(Stream.KEYFRAME, 5, 1))
    begin = time.monotonic()
    child.terminate()
    assert child.wait(10) == 0
    assert time.monotonic() - begin < EXIT_LIMIT_S
    assert [event.kind for event in services.events()] == [EventKind.SESSION_STARTED]


def test_truncated_input_is_finished_and_says_so(services: Services, sequence: Path, tmp_path: Path) -> None:
    source = long_sequence(sequence, tmp_path / "cut", 1)
    (source / "000020.jpg").unlink()
    (source / "000020.jpg").write_text("not an image")
    assert services.frontend(source).wait(60) == 3
    line = services.last_line()
    assert "frame 20" in line and "000020.jpg is not a readable image" in line
    ended = services.events()[-1]
    assert ended.kind is EventKind.STREAM_ENDED
    assert ended.detail["frame_count"] == "20" and "frame 20" in ended.detail["truncated"]
    assert sum(len(segment.frames) for segment in services.segments()) == 20
    assert services.keyframes()[-1].frame_index == 19


def test_a_size_change_ends_the_input_there(services: Services, sequence: Path, tmp_path: Path) -> None:
    source = long_sequence(sequence, tmp_path / "sizes", 1)
    (source / "000030.jpg").unlink()
    assert cv2.imwrite(str(source / "000030.jpg"), np.zeros((120, 160), np.uint8))
    assert services.frontend(source).wait(60) == 3
    assert "frame 30 is 160x120" in services.last_line()
    assert services.events()[-1].detail["frame_count"] == "30"


def test_no_readable_frame(services: Services, tmp_path: Path) -> None:
    folder = tmp_path / "text"
    folder.mkdir()
    (folder / "0.jpg").write_text("hello")
    assert services.frontend(folder).wait(60) == 2
    assert "0.jpg is not a readable image" in services.last_line()
    assert services.keyframes() == []
    assert services.frontend(tmp_path / "missing").wait(60) == 2


def test_ego_mask_travels_as_a_blob(services: Services, sequence: Path, tmp_path: Path) -> None:
    first = cv2.imread(str(sequence / "image_0" / "000000.jpg"), cv2.IMREAD_GRAYSCALE)
    assert first is not None
    pixels = np.zeros(first.shape, np.uint8)
    pixels[-20:] = 255
    mask = tmp_path / "mask.png"
    assert cv2.imwrite(str(mask), pixels)
    assert services.frontend(sequence, "--ego-mask", str(mask)).wait(60) == 0
    refs = {segment.ego_mask for segment in services.segments()}
    assert len(refs) == 1
    (ref,) = refs
    assert isinstance(ref, BlobRef) and ref.media_type == "image/png"
    blob = services.ledger.blob(ref)
    assert hashlib.sha256(blob).hexdigest() == ref.sha256
    stored = cv2.imdecode(np.frombuffer(blob, np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(stored, pixels)


def test_a_mask_of_another_size_is_refused(services: Services, sequence: Path, tmp_path: Path) -> None:
    mask = tmp_path / "mask.png"
    assert cv2.imwrite(str(mask), np.zeros((10, 10), np.uint8))
    assert services.frontend(sequence, "--ego-mask", str(mask)).wait(60) == 2
    assert "ego mask" in services.last_line()


def test_ledger_killed_meanwhile(services: Services, sequence: Path, tmp_path: Path) -> None:
    source = long_sequence(sequence, tmp_path / "long", 5)
    child = services.frontend(source)
    wait_until(lambda: services.ledger.read(Stream.KEYFRAME, 5, 1))
    ledger = services._children[0]
    ledger.kill()
    ledger.wait(10)
    time.sleep(1.0)
    assert child.poll() is None
    services.start("ledger", "--directory", str(services.folder / "ledger"))
    assert child.wait(60) == 0
    keyframes, segments = expected(source)
    assert services.keyframes() == keyframes
    assert services.segments() == segments


def test_status_while_it_works(services: Services, sequence: Path, tmp_path: Path) -> None:
    watch = ServiceWatch(services.bus)
    child = services.frontend(long_sequence(sequence, tmp_path / "long", 10))

    def counters() -> dict[str, float]:
        for (name, _), report in watch.services().items():
            if name == "frontend" and report is not None:
                return dict(report.counters)
        return {}

    wait_until(lambda: counters().get("frames", 0) > 20)
    now = counters()
    assert {"keyframes", "segments", "static_frames", "turning_frames", "linear_frames"} <= now.keys()
    assert now["smoothing_delay_frames"] == FrontendConfig().smoothing_lookahead_frames
    assert now["smoothing_delay_s"] == pytest.approx(now["smoothing_delay_frames"] / 10.0, rel=0.1)
    child.terminate()
    child.wait(10)


def test_frames_from_the_bus_are_not_published_again(services: Services, sequence: Path, tmp_path: Path) -> None:
    """A replay feeds the frontend over the image key: same records, and each frame is on the key once."""
    heard: list[Sample] = []
    child = services.frontend("zenoh:front")
    with connect(services._endpoint) as camera:
        publisher = camera.publisher(camera.keys.image("front"), blocking=True, history=8)
        wait_until_heard(camera, camera.keys.image("front"))  # by the frontend: we do not listen yet
        services.bus.subscribe(services.bus.keys.image("front"), heard.append)
        wait_until_known(services.bus)
        frames = list(open_source(str(sequence)).frames())
        stop = threading.Event()
        for frame in frames:
            header = ImageHeader(0, frame.index, is_last=frame.index == len(frames) - 1)
            publisher.put(encode_image(frame, "front"), attachment=header.encode())
            stop.wait(0.02)
        assert child.wait(60) == 0
    keyframes, segments = expected(sequence)
    assert services.keyframes() == keyframes
    assert services.segments() == segments
    wait_until(lambda: len(heard) >= len(frames))
    assert len(heard) == len(frames)


def _is_silent(watch: ServiceWatch) -> bool:
    report = watch.newest_report("frontend")
    return (
        report is not None
        and report.state == "waiting"
        and "no frame comes from" in report.detail
        and report.counters["silent_s"] >= 2.0
    )


def test_a_restarted_live_camera_begins_a_new_epoch(services: Services, sequence: Path) -> None:
    frames = list(open_source(str(sequence)).frames())
    watch = ServiceWatch(services.bus)
    with connect(services._endpoint) as camera:
        for epoch in range(2):
            child = services.frontend("zenoh:front")
            publisher = camera.publisher(camera.keys.image("front"), blocking=True, history=8)
            wait_until_heard(camera, camera.keys.image("front"))
            for frame in frames[:20]:
                publisher.put(encode_image(frame, "front"), attachment=ImageHeader(epoch, frame.index).encode())
                time.sleep(0.02)
            wait_until(lambda wanted=epoch: any(k.epoch == wanted for k in services.keyframes()))
            if epoch == 0:
                wait_until(lambda: _is_silent(watch))  # a camera that has stalled is seen in the status
            publisher.close()
            child.terminate()
            assert child.wait(10) == 0
            wait_until(lambda: watch.missing({"frontend": 1}))
            wait_until_unheard(camera, camera.keys.image("front"))
    epochs = {keyframe.epoch for keyframe in services.keyframes()}
    assert epochs == {0, 1}
    assert [event.event_id for event in services.events()] == ["session_started", "session_started/1"]


def test_a_live_camera_loses_no_keyframe_while_the_ledger_is_down(services: Services, sequence: Path) -> None:
    """Frames without numbers, as a bridge sends them: whoever does not take them in time loses them."""
    frames = list(open_source(str(sequence)).frames())
    ledger = services._children[0]
    watch = ServiceWatch(services.bus)
    child = services.frontend("zenoh:front")

    def counter(name: str) -> float:
        report = watch.newest_report("frontend")
        return 0.0 if report is None else report.counters.get(name, 0.0)

    with connect(services._endpoint) as camera:
        publisher = camera.publisher(camera.keys.image("front"), blocking=False, history=8)
        wait_until_heard(camera, camera.keys.image("front"))
        for number, frame in enumerate(frames):
            if number == 5:
                ledger.kill()
                ledger.wait(10)
            # Not faster than a busy machine takes them: of more than eight that wait, the frontend drops some.
            wait_until(lambda wanted=number - 6: counter("frames") >= wanted)
            publisher.put(encode_image(frame, "front"))
        wait_until(lambda: counter("spooled_records") > 3)
        services.start("ledger", "--directory", str(services.folder / "ledger"))
        wanted = [keyframe.image for keyframe in expected(sequence)[0]]

        def stored() -> list[BlobRef]:
            try:
                return [keyframe.image for keyframe in services.keyframes()]
            except BusError:
                return []

        # The last frames wait for the look-ahead.
        wait_until(lambda: len(stored()) >= len(wanted) - 6, 60.0)
        found = stored()  # once: the next look may find one more
        assert found == wanted[: len(found)]
        report = watch.newest_report("frontend")
    assert report is not None
    assert report.counters["spool_full_waits"] == 0
    assert not any(count for name, count in report.counters.items() if "dropped" in name)
    child.terminate()
    assert child.wait(10) == 0
