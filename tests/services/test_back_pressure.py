"""What is too fast or refused is held where it belongs: on the side of the camera, bounded, visible, without a loss."""

from __future__ import annotations

import itertools
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from live_session import LiveSession, Service, live_session, wait_for
from vggt_motion.bus import codec
from vggt_motion.bus.images import encode_image
from vggt_motion.config import FrontendConfig
from vggt_motion.disk import free_space
from vggt_motion.errors import BusError
from vggt_motion.frontend.pipeline import FrontendPipeline, KeyframeOutput
from vggt_motion.records import Event, EventKind, Keyframe, Stream
from vggt_motion.sources.registry import open_source
from vggt_motion.sources.source import Frame

pytestmark = pytest.mark.timeout(240)
RATE_HZ = 30.0


@pytest.fixture(scope="module")
def frames(sample_dir: Path) -> list[Frame]:
    return list(open_source(str(sample_dir / "kitti_06_first51")).frames())


@contextmanager
def camera(session: LiveSession, frames: list[Frame]) -> Iterator[list[int]]:
    """A camera that sends 30 frames a second, there and back, without numbers, and waits for nobody."""
    stopping, sent = threading.Event(), [0]
    publisher = session.bus.publisher(session.bus.keys.image("front"), blocking=False, history=8)

    def send() -> None:
        for frame in itertools.cycle(frames + frames[::-1]):
            publisher.put(encode_image(frame, "front"))
            sent[0] += 1
            if stopping.wait(1.0 / RATE_HZ):
                return

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    try:
        yield sent
    finally:
        stopping.set()
        thread.join()
        publisher.close()


def counters(session: LiveSession, service: Service) -> dict[str, float]:
    report = session.report_of(service)
    return {} if report is None else dict(report.counters)


def records(session: LiveSession, stream: Stream, cls: type) -> list[Any]:
    entries, position = [], 0
    while page := session.ledger.read(stream.value, position, patience_s=60.0):
        entries += page
        position += len(page)
    return [codec.decode(cls, entry.payload) for entry in entries]


def is_settled(session: LiveSession, frontend: Service) -> bool:
    """Whether the frontend has made no keyframe that the ledger does not have."""
    now = counters(session, frontend)
    try:
        stored = session.ledger.status().position("keyframe")
    except BusError:
        return False
    return now.get("spooled_records", 1.0) == 0 and stored > 0 and stored == now["keyframes"]


def test_a_full_spool_is_bounded_holds_every_keyframe_and_lets_frames_go_by(
    tmp_path: Path, frames: list[Frame]
) -> None:
    max_bytes = 8 * max(len(frame.encoded) for frame in frames)
    spool = tmp_path / "spool"
    with live_session(tmp_path, spool={"directory": str(spool), "max_bytes": max_bytes}) as session:
        ledger = session.services[1]
        frontend = session.start("frontend", "--source", "zenoh:front")
        largest = 0

        def spooled_bytes() -> int:
            return sum(path.stat().st_size for path in list(spool.rglob("*.request")) if path.exists())

        with camera(session, frames) as sent:
            wait_for(lambda: session.ledger.status().position("keyframe") > 3, "keyframes")
            ledger.process.send_signal(signal.SIGSTOP)

            def is_full() -> bool:
                nonlocal largest
                largest = max(largest, spooled_bytes())
                now = counters(session, frontend)
                return now.get("spool_full_waits", 0) >= 1 and now.get("dropped_frames", 0) > 30

            wait_for(is_full, "a full spool")
            report = session.report_of(frontend)
            assert report is not None
            assert (report.state, "the spool or its disk is full" in report.detail) == ("waiting", True)
            ledger.process.send_signal(signal.SIGCONT)
            before = counters(session, frontend)["keyframes"]
            wait_for(lambda: counters(session, frontend).get("keyframes", 0) > before + 5, "more keyframes")
        assert max_bytes / 2 < largest <= max_bytes
        wait_for(lambda: is_settled(session, frontend), "all keyframes in the ledger")
        keyframes = records(session, Stream.KEYFRAME, Keyframe)
        known = {codec.blob_ref(frame.encoded, frame.media_type).sha256 for frame in frames}
        assert {keyframe.image.sha256 for keyframe in keyframes} <= known
        assert [keyframe.frame_index for keyframe in keyframes] == sorted({k.frame_index for k in keyframes})
        dropped = counters(session, frontend)["dropped_frames"]
        assert counters(session, frontend)["frames"] + dropped <= sent[0]
        assert frontend.stop() == 0, frontend.text()


def test_slow_workers_hold_up_no_camera_and_the_lag_is_shown(tmp_path: Path, frames: list[Frame]) -> None:
    """No worker at all is the slowest: all keyframes are stored, jobs wait, and the status tells how far behind."""
    spool = {"directory": str(tmp_path / "spool")}
    with live_session(tmp_path, spool=spool) as session:
        gateway = session.started("gateway")
        session.start("backend")
        frontend = session.start("frontend", "--source", "zenoh:front")
        url = f"http://127.0.0.1:{int(counters(session, gateway)['port'])}/api/v1/status"
        with camera(session, frames):

            def lag() -> Any:
                found = httpx.get(url, timeout=60).json()["lag"]
                return found if found["jobs_waiting"] >= 2 and found["submaps"] >= 3 else None

            first = wait_for(lag, "the lag")
            wait_for(lambda: (now := lag()) and now["keyframes"] > first["keyframes"], "more of it")
        wait_for(lambda: is_settled(session, frontend), "all keyframes in the ledger")
        assert counters(session, frontend)["spool_full_waits"] == 0


def test_a_spooled_record_that_is_refused_is_set_aside_and_holds_up_nothing(
    tmp_path: Path, frames: list[Frame]
) -> None:
    root = tmp_path / "spool"
    with live_session(tmp_path, spool={"directory": str(root)}) as session:
        ledger_id = session.ledger.status().ledger_id
        assert len(ledger_id) == 32
        ours, other = root / "test" / "front" / ledger_id, root / "test" / "front" / ("0" * 32)
        for folder in (ours, other):
            folder.mkdir(parents=True)
            (folder / "000000000000.request").write_bytes(b"no request at all")
        frontend = session.start("frontend", "--source", "zenoh:front")
        with camera(session, frames):
            wait_for(lambda: session.ledger.status().position("keyframe") > 3, "keyframes")
        wait_for(lambda: counters(session, frontend).get("refused_records") == 1, "the count")
        (kept,) = (ours / "refused").iterdir()
        assert kept.read_bytes() == b"no request at all"
        warnings = [event for event in records(session, Stream.EVENT, Event) if event.kind is EventKind.WARNING]
        assert len(warnings) == 1 and "a record of the camera was refused" in warnings[0].message
        assert (other / "000000000000.request").read_bytes() == b"no request at all", "it waits for another ledger"
        assert "records for another ledger" in frontend.text()
        assert frontend.process.poll() is None


def test_thinning_lets_frames_of_a_file_go_by_while_the_disk_is_full(
    tmp_path: Path, sample_dir: Path, frames: list[Frame]
) -> None:
    """As a camera's would have: as many as the wait was long."""
    reserve_bytes = free_space(tmp_path) * 3 // 2  # below it, but not below the half that is for everything but input
    with live_session(
        tmp_path,
        frontend={"disk_policy": "thin"},
        ledger={"reserve_bytes": reserve_bytes},
        run={"nominal_rate_hz": 10.0},
    ) as session:
        frontend = session.start("frontend", "--source", str(sample_dir / "kitti_06_first51" / "image_0"))
        begin = time.monotonic()
        report = wait_for(
            lambda: (r := session.report_of(frontend)) is not None and r.state == "waiting" and r, "a refused keyframe"
        )
        assert "keeps" in report.detail and session.ledger.status().position("keyframe") == 0
        time.sleep(1.5)
        session.services[1].kill()
        text = session.config_file.read_text(encoding="utf-8")
        session.config_file.write_text(text.replace(str(reserve_bytes), "0"), encoding="utf-8")
        session.start("ledger", "--directory", str(tmp_path / "ledger"))
        assert frontend.process.wait(60) == 0, frontend.text()
        waited_s = time.monotonic() - begin
        keyframes = records(session, Stream.KEYFRAME, Keyframe)
        (ended,) = (e for e in records(session, Stream.EVENT, Event) if e.kind is EventKind.STREAM_ENDED)
    went_by = len(frames) - int(ended.detail["frame_count"])
    assert 15 <= went_by <= 10.0 * waited_s + 1
    pipeline = FrontendPipeline(FrontendConfig(), "front")
    whole = [output for frame in frames for output in pipeline.push(frame)] + list(pipeline.finish())
    assert 2 <= len(keyframes) < sum(isinstance(output, KeyframeOutput) for output in whole)
    assert keyframes[0].frame_index == 0
