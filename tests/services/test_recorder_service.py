"""The recorder as a process, with a real router and a real ledger."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from mcap.reader import make_reader

from bus_processes import wait_until_heard
from live_session import LiveSession, Service, live_session, wait_for
from synthetic_session import FRAME_INTERVAL_NS, Session, world_from_camera
from vggt_motion.bus import codec
from vggt_motion.bus.images import ImageHeader, encode_image
from vggt_motion.bus.pubsub import Publisher
from vggt_motion.recorder.container import McapScanner
from vggt_motion.records import Stream
from vggt_motion.sources.mcap import McapSource
from vggt_motion.sources.selection import Selection
from vggt_motion.sources.source import Frame
from vggt_motion.v1 import recording_pb2

IMAGE_KEY_ENCODING = "application/protobuf;foxglove.CompressedImage"


@pytest.fixture(scope="module")
def session() -> Session:
    pixels = np.full((20, 32, 3), 90, dtype=np.uint8)
    return Session(4, cv2.imencode(".png", pixels)[1].tobytes(), "image/png")


def frame(session: Session, index: int) -> Frame:
    """Keyframes show what the ledger holds of them; the others are each different."""
    if index % 2 == 0:
        return Frame(index, index * FRAME_INTERVAL_NS, session.image, "image/png")
    pixels = np.random.default_rng(index).integers(0, 255, (20, 32, 3), dtype=np.uint8)
    return Frame(index, index * FRAME_INTERVAL_NS, cv2.imencode(".jpg", pixels)[1].tobytes(), "image/jpeg")


def publish(publisher: Publisher, session: Session, indices: range, epoch: int = 0) -> None:
    for index in indices:
        publisher.put(encode_image(frame(session, index), "front"), attachment=ImageHeader(epoch, index).encode())


def started_recorder(live: LiveSession, directory: Path) -> Service:
    """A recorder that hears what is published next."""
    recorder = live.started("recorder", "--directory", str(directory))
    wait_until_heard(live.bus, live.bus.keys.image("front"))
    return recorder


def camera(live: LiveSession, history: int = 16) -> Publisher:
    return live.bus.publisher(live.bus.keys.image("front"), blocking=True, history=history, encoding=IMAGE_KEY_ENCODING)


def is_caught_up(live: LiveSession, recorder: Service, frame_count: int) -> bool:
    report = live.report_of(recorder)
    status = live.ledger.status()
    return report is not None and all(
        [report.counters.get("frames", 0) >= frame_count]
        + [report.counters.get(f"position_{s.value}", 0) >= status.position(s.value) for s in Stream]
    )


def log_of(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    with path.open("rb") as file:
        found: dict[str, list[tuple[int, bytes]]] = {}
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
            found.setdefault(channel.topic, []).append((message.sequence, message.data))
        return found


def assert_complete(path: Path, live: LiveSession, session: Session) -> dict[str, list[tuple[int, bytes]]]:
    """The doctor is content; frames and log are all there, once, byte for byte; payloads too."""
    command = [str(Path(sys.executable).parent / "pymcap-cli"), "doctor", "--strict-message-order", "--format", "jsonl"]
    result = subprocess.run([*command, str(path)], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout
    assert [f for f in map(json.loads, result.stdout.splitlines()) if f.get("severity") in ("error", "warning")] == []
    assert list(McapSource(path, Selection()).frames()) == [frame(session, k) for k in range(session.frame_count)]
    found = log_of(path)
    for stream in Stream:
        entries = live.ledger.read(stream.value, 0)
        assert found.get(f"/vggt_motion/log/{stream.value}", []) == [(e.sequence, e.payload) for e in entries]
    payloads = {recording_pb2.Blob.FromString(data).ref.sha256 for _, data in found["/vggt_motion/blob"]}
    depth = {ref.sha256 for submap in session.submaps for ref in codec.blob_refs(submap)}
    assert payloads == depth
    return found


def test_everything_is_recorded_also_what_was_before(tmp_path: Path, session: Session) -> None:
    with live_session(tmp_path) as live:
        early = range(10)
        publisher = camera(live)
        publish(publisher, session, early)
        live.append(session)
        recorder = started_recorder(live, tmp_path)
        publish(publisher, session, range(10, session.frame_count))
        wait_for(lambda: is_caught_up(live, recorder, session.frame_count), "catching up")
        assert recorder.stop() == 0, recorder.text()
        found = assert_complete(tmp_path / "run.mcap", live, session)
    poses = [PoseInFrame.FromString(data) for _, data in found["/pose"]]
    assert [sequence for sequence, _ in found["/pose"]] == [k.frame_index for k in session.keyframes]
    for keyframe, pose in zip(session.keyframes, poses, strict=True):
        assert pose.timestamp.seconds * 10**9 + pose.timestamp.nanos == keyframe.capture_time_ns
        position = [pose.pose.position.x, pose.pose.position.y, pose.pose.position.z]
        np.testing.assert_allclose(position, world_from_camera(keyframe.frame_index)[:3, 3], atol=1e-6)
    _, data = found["/trajectory"][-1]
    assert len(PosesInFrame.FromString(data).poses) == len(session.keyframes)
    cloud = PointCloud.FromString(found["/map"][-1][1])
    points = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_stride)
    assert len(points) > 100
    assert (points[:, 12:15] == 90).all()


def test_a_killed_recorder_goes_on_where_it_was(tmp_path: Path, session: Session) -> None:
    with live_session(tmp_path, recorder={"flush_interval_s": 0.1}) as live:
        publisher = camera(live, history=session.frame_count)
        recorder = started_recorder(live, tmp_path)
        half = session.frame_count // 2
        publish(publisher, session, range(half))
        wait_for(lambda: is_caught_up(live, recorder, half), "half of the frames")
        recorder.kill()
        scanner = McapScanner(tmp_path / "run.mcap")
        assert list(scanner.messages())
        assert scanner.damage is not None
        scanner.close()
        publish(publisher, session, range(half, session.frame_count))
        live.append(session)
        again = started_recorder(live, tmp_path)
        wait_for(lambda: is_caught_up(live, again, session.frame_count), "catching up")
        assert again.stop() == 0, again.text()
        assert_complete(tmp_path / "run.mcap", live, session)
        # A third one finds nothing to do and adds nothing.
        count = sum(map(len, log_of(tmp_path / "run.mcap").values()))
        third = started_recorder(live, tmp_path)
        wait_for(lambda: is_caught_up(live, third, session.frame_count), "catching up")
        assert third.stop() == 0
        assert sum(map(len, assert_complete(tmp_path / "run.mcap", live, session).values())) == count


def test_kills_at_any_moment_lose_and_repeat_nothing(tmp_path: Path, session: Session) -> None:
    """The recorder is killed again and again while frames and records come in."""
    seed = 7
    moments = np.random.default_rng(seed).uniform(0.0, 0.4, 4)
    with live_session(tmp_path, recorder={"flush_interval_s": 0.05}) as live:
        publisher = camera(live, history=session.frame_count)

        def drive() -> None:
            for index in range(session.frame_count):
                publish(publisher, session, range(index, index + 1))
                time.sleep(0.05)

        feeders = [threading.Thread(target=drive), threading.Thread(target=live.append, args=(session,))]
        recorder = started_recorder(live, tmp_path)
        for feeder in feeders:
            feeder.start()
        for moment in moments:
            time.sleep(moment)
            recorder.kill()
            recorder = started_recorder(live, tmp_path)
        for feeder in feeders:
            feeder.join()
        wait_for(lambda: is_caught_up(live, recorder, session.frame_count), f"catching up (seed {seed})")
        assert recorder.stop() == 0, recorder.text()
        assert_complete(tmp_path / "run.mcap", live, session)


def test_keyframes_that_never_came_are_taken_from_the_ledger(tmp_path: Path, session: Session) -> None:
    with live_session(tmp_path) as live:
        live.append(session)
        recorder = started_recorder(live, tmp_path)
        wait_for(lambda: is_caught_up(live, recorder, len(session.keyframes)), "the keyframes")
        report = live.report_of(recorder)
        assert report is not None
        assert report.counters["missing_frames"] == session.frame_count - len(session.keyframes)
        assert recorder.stop() == 0
    frames = list(McapSource(tmp_path / "run.mcap", Selection()).frames())
    assert [f.capture_time_ns for f in frames] == [k.capture_time_ns for k in session.keyframes]
    assert {f.encoded for f in frames} == {session.image}


def test_what_is_no_image_is_refused_and_counted(tmp_path: Path, session: Session) -> None:
    with live_session(tmp_path) as live:
        recorder = started_recorder(live, tmp_path)
        publisher = camera(live)
        publisher.put(b"\xff\xff\xff")
        publisher.put(encode_image(frame(session, 0), "front"), attachment=b"\xff\xff")
        real = frame(session, 1)
        size_at = real.encoded.index(b"\xff\xc0") + 5
        bomb = real.encoded[:size_at] + b"\x7d\x00\x7d\x00" + real.encoded[size_at + 4 :]
        for encoded, media_type in (
            (real.encoded[:-40], "image/jpeg"),
            (b"GIF89a" + bytes(100), "image/jpeg"),
            (session.image, "image/jpeg"),
            (bomb, "image/jpeg"),
        ):
            # under the number of a frame that comes after them
            payload = encode_image(Frame(1, real.capture_time_ns, encoded, media_type), "front")
            publisher.put(payload, attachment=ImageHeader(0, 1).encode())
        publish(publisher, session, range(3))

        def has_all() -> bool:
            report = live.report_of(recorder)
            return report is not None and (report.counters["frames"], report.counters["refused_images"]) == (3, 6)

        wait_for(has_all, "three frames and six refusals")
        assert recorder.stop() == 0
    frames = list(McapSource(tmp_path / "run.mcap", Selection()).frames())
    assert frames == [frame(session, index) for index in range(3)]


def test_a_folder_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    in_the_way = tmp_path / "file"
    in_the_way.write_text("a file, not a folder")
    with live_session(tmp_path) as live:
        recorder = live.start("recorder", "--directory", str(in_the_way))
        assert recorder.process.wait(60) == 2
        last = recorder.text().strip().splitlines()[-1]
        assert last.startswith(f"vggt-motion: recorder: cannot write to {in_the_way}")
        assert "Traceback" not in recorder.text()
