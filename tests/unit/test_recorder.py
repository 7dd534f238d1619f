"""The recording: round trip, doctor, repair after any truncation, and the recording as a source."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from full_disk import full_disk
from vggt_motion.errors import DiskFullError, InputError, SourceError, SourceTruncatedError
from vggt_motion.foxglove import (
    MAP_FROM_WORLD,
    decode_image,
    frame_transform,
    point_cloud,
    pose_in_frame,
    poses_in_frame,
)
from vggt_motion.geometry import se3
from vggt_motion.recorder import record, schemas
from vggt_motion.recorder.container import McapScanner
from vggt_motion.recorder.indexset import IndexSet
from vggt_motion.recorder.payloads import RecentPayloads
from vggt_motion.recorder.record import FrameId, Recording, image_topic
from vggt_motion.records import BlobRef, LogEntry
from vggt_motion.sources.mcap import McapSource
from vggt_motion.sources.registry import open_source
from vggt_motion.sources.selection import Selection
from vggt_motion.sources.source import Frame
from vggt_motion.v1 import event_pb2, ledger_pb2, recording_pb2, segment_pb2

CHUNK_BYTES = 20_000
FRAME_INTERVAL_NS = 103_700_000


def image(index: int) -> bytes:
    pixels = np.random.default_rng(index).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    return bytes(cv2.imencode(".jpg" if index % 2 else ".png", pixels)[1])


def frame(index: int) -> Frame:
    media_type = "image/jpeg" if index % 2 else "image/png"
    return Frame(index, index * FRAME_INTERVAL_NS, image(index), media_type)


def event_entry(sequence: int, message: str = "something happened") -> LogEntry:
    event = event_pb2.Event(schema_version=1, event_id=f"warning/{sequence}", kind=4, message=message, time_ns=5)
    return LogEntry("event", sequence, event.event_id, "vggt_motion.v1.Event", event.SerializeToString(), 0)


def blob(content: bytes) -> tuple[BlobRef, bytes]:
    return BlobRef(hashlib.sha256(content).hexdigest(), len(content), "application/vnd.vggt-motion.depth"), content


def write_session(path: Path, frame_count: int) -> None:
    """Frames, records and blobs, interleaved as in a run."""
    with Recording.open(path, chunk_bytes=CHUNK_BYTES) as recording:
        for index in range(frame_count):
            assert recording.add_frame(FrameId("front", 0, index), frame(index))
            recording.add_blob(*blob(b"depth %d" % index * 50))
            assert recording.add_entry(event_entry(index))


def read_all(path: Path) -> list[tuple[str, int, bytes]]:
    """With the reference reader, which needs a whole file; without the transform that every recording has first."""
    with path.open("rb") as file:
        (topic, *_), *rest = [
            (channel.topic, message.sequence, message.data)
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        ]
    assert topic == "/tf"
    return rest


def collect(path: Path) -> tuple[list[Frame], Exception | None]:
    """The frames that a file gives as a source, and how it ends."""
    frames: list[Frame] = []
    try:
        source = McapSource(path, Selection())
        for item in source.frames():
            frames.append(item)  # noqa: PERF402
    except (SourceError, SourceTruncatedError) as error:
        return frames, error
    return frames, None


def doctor(path: Path) -> list[dict[str, object]]:
    """Findings of pymcap-cli above the level of a remark; fails when the doctor does."""
    command = [str(Path(sys.executable).parent / "pymcap-cli"), "doctor", "--strict-message-order", "--format", "jsonl"]
    result = subprocess.run([*command, str(path)], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    findings = [json.loads(line) for line in result.stdout.splitlines() if line.startswith("{")]
    return [finding for finding in findings if finding.get("severity") in ("error", "warning")]


def test_round_trip_is_exact_and_the_doctor_is_content(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_session(path, 40)
    assert doctor(path) == []
    messages = read_all(path)
    frames = [(sequence, decode_image(data)) for topic, sequence, data in messages if topic == image_topic("front")]
    expected = [frame(index) for index in range(40)]
    assert frames == [(f.index, (f.encoded, f.media_type, f.capture_time_ns)) for f in expected]
    events = [(s, data) for topic, s, data in messages if topic == "/vggt_motion/log/event"]
    assert events == [(index, event_entry(index).payload) for index in range(40)]
    blobs = [recording_pb2.Blob.FromString(data) for topic, _, data in messages if topic == "/vggt_motion/blob"]
    assert all(hashlib.sha256(b.data).hexdigest() == b.ref.sha256 for b in blobs)
    assert len(blobs) == 40


def test_times_are_those_of_capture_and_reception(tmp_path: Path) -> None:
    clock = iter([500, 1000, 900, 2000])
    path = tmp_path / "run.mcap"
    with Recording.open(path, chunk_bytes=CHUNK_BYTES, clock=lambda: next(clock)) as recording:
        for index in range(3):
            recording.add_frame(FrameId("front", 0, index), frame(index))
    with path.open("rb") as file:
        times = [(m.publish_time, m.log_time) for _, c, m in make_reader(file).iter_messages() if c.topic != "/tf"]
    # A clock that steps back does not turn the order of the log round.
    assert times == [(0, 1000), (FRAME_INTERVAL_NS, 1000), (2 * FRAME_INTERVAL_NS, 2000)]


def test_every_schema_describes_itself(tmp_path: Path) -> None:
    """A reader that has nothing but the file can decode: descriptors come from the schema data alone."""
    for name in schemas.known_types():
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(schemas.schema_data(name)).file:
            pool.Add(file)
        assert message_factory.GetMessageClass(pool.FindMessageTypeByName(name))().SerializeToString() == b""


def test_views_decode_with_the_schemas_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    world_from_camera = se3.exp(np.array([0.2, -0.4, 0.1, 3.0, -1.0, 7.0]))
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 5.5, 6.25]])
    colours = np.array([[10, 20, 30], [200, 100, 0]], dtype=np.uint8)
    with Recording.open(path, chunk_bytes=CHUNK_BYTES) as recording:
        seventh = FrameId("front", 0, 7)
        recording.add_pose(seventh, pose_in_frame(world_from_camera, "world", 12_345_678_901), 12_345_678_901)
        recording.add_trajectory(2, poses_in_frame([np.eye(4), world_from_camera], "world", 5), 5)
        recording.add_map(2, point_cloud(points, colours, "world", 5), 5)
        recording.add_transform(frame_transform(world_from_camera, "world", "camera/front", 5), 5)
        assert recording.has_pose(seventh) and not recording.has_pose(FrameId("front", 0, 6))
        assert (recording.view_revision("/map"), recording.view_revision("/tf")) == (2, -1)
    assert doctor(path) == []
    decoded = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert channel.message_encoding == schema.encoding == "protobuf"
            assert channel.topic.startswith("/")
            pool = descriptor_pool.DescriptorPool()
            for file_proto in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                pool.Add(file_proto)
            cls = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            decoded[channel.topic] = (schema.name, cls.FromString(message.data), message)
    name, pose, message = decoded["/pose"]
    assert name == "foxglove.PoseInFrame"
    assert (pose.timestamp.seconds, pose.timestamp.nanos, message.sequence) == (12, 345_678_901, 7)
    q = pose.pose.orientation
    np.testing.assert_allclose(
        se3.rotation_from_quaternion(np.array([q.w, q.x, q.y, q.z])), world_from_camera[:3, :3], atol=1e-12
    )
    np.testing.assert_allclose(
        [pose.pose.position.x, pose.pose.position.y, pose.pose.position.z], world_from_camera[:3, 3]
    )
    assert decoded["/trajectory"][0] == "foxglove.PosesInFrame" and len(decoded["/trajectory"][1].poses) == 2
    cloud = decoded["/map"][1]
    assert decoded["/map"][0] == "foxglove.PointCloud"
    assert [(f.name, f.offset) for f in cloud.fields] == [
        ("x", 0), ("y", 4), ("z", 8), ("red", 12), ("green", 13), ("blue", 14), ("alpha", 15)
    ]  # fmt: skip
    rows = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_stride)
    np.testing.assert_array_equal(rows[:, :12].copy().view("<f4"), points.astype(np.float32))
    np.testing.assert_array_equal(rows[:, 12:15], colours)
    transform = decoded["/tf"][1]
    assert (transform.parent_frame_id, transform.child_frame_id) == ("world", "camera/front")


def test_the_map_frame_is_upright() -> None:
    """Forward of the camera is x, its left y, its up z; and it is a rotation."""
    np.testing.assert_allclose(MAP_FROM_WORLD[:3, :3] @ [0, 0, 1], [1, 0, 0])
    np.testing.assert_allclose(MAP_FROM_WORLD[:3, :3] @ [-1, 0, 0], [0, 1, 0])
    np.testing.assert_allclose(MAP_FROM_WORLD[:3, :3] @ [0, -1, 0], [0, 0, 1])
    assert np.linalg.det(MAP_FROM_WORLD[:3, :3]) == pytest.approx(1.0)


def test_what_is_there_is_not_written_twice(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recording.open(path, chunk_bytes=CHUNK_BYTES) as recording:
        assert recording.add_frame(FrameId("front", 0, 3), frame(3))
        assert not recording.add_frame(FrameId("front", 0, 3), frame(3))
        assert recording.add_frame(FrameId("front", 1, 3), frame(3))  # a restarted camera counts anew
        assert recording.add_frame(FrameId("rear", 0, 3), frame(3))
        assert recording.add_entry(event_entry(0))
        assert not recording.add_entry(event_entry(0))
        with pytest.raises(ValueError, match="before record 1"):
            recording.add_entry(event_entry(2))
        assert recording.add_blob(*blob(b"mask"))
        assert not recording.add_blob(*blob(b"mask"))
        assert (recording.frame_count, recording.position("event"), recording.position("graph")) == (3, 1, 0)
    assert {finding["code"] for finding in doctor(path)} == {"CHANNEL_TOPIC_DUPLICATE"}  # two epochs, one topic
    assert len(read_all(path)) == 5


def test_record_of_an_unknown_type_is_kept_in_its_envelope(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    entry = LogEntry("descriptor", 0, "descriptor/0", "vggt_motion.v9.Descriptor", b"\x01\x02", 77)
    with Recording.open(path, chunk_bytes=CHUNK_BYTES) as recording:
        recording.add_entry(entry)
    [(topic, _, data)] = read_all(path)
    kept = ledger_pb2.LogEntry.FromString(data)
    assert topic == "/vggt_motion/log/descriptor"
    assert (kept.record_id, kept.payload_type, kept.payload) == (entry.record_id, entry.payload_type, entry.payload)
    with Recording.open(path, chunk_bytes=CHUNK_BYTES) as recording:
        assert recording.position("descriptor") == 1


@pytest.fixture(scope="module")
def whole_recording(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    write_session(path, 30)
    return path.read_bytes()


@given(data=st.data())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_file_cut_anywhere_is_continued_without_loss_or_repeat(
    whole_recording: bytes, tmp_path: Path, data: st.DataObject
) -> None:
    """Whatever the cut, continuing the session from what the file says it has gives the whole session."""
    cut = data.draw(st.integers(0, len(whole_recording)))
    path = tmp_path / "run.mcap"
    path.write_bytes(whole_recording[:cut])
    seen: list[tuple[str, int, bytes]] = []
    with Recording.open(
        path,
        chunk_bytes=CHUNK_BYTES,
        on_entry=lambda stream, sequence, payload: seen.append((stream, sequence, payload)),
    ) as recording:
        assert seen == [("event", k, event_entry(k).payload) for k in range(recording.position("event"))]
        for index in range(30):
            recording.add_frame(FrameId("front", 0, index), frame(index))
            recording.add_blob(*blob(b"depth %d" % index * 50))
            recording.add_entry(event_entry(index))
        assert recording.frame_count == recording.position("event") == 30
    messages = read_all(path)
    assert sorted(s for topic, s, _ in messages if topic == image_topic("front")) == list(range(30))
    assert [s for topic, s, _ in messages if topic == "/vggt_motion/log/event"] == list(range(30))
    blobs = {
        recording_pb2.Blob.FromString(data).ref.sha256 for topic, _, data in messages if topic == "/vggt_motion/blob"
    }
    assert len(blobs) == 30
    frames = list(McapSource(path, Selection()).frames())
    assert frames == [frame(index) for index in range(30)]


@given(data=st.data())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_cut_file_as_a_source_gives_what_is_readable(
    whole_recording: bytes, tmp_path: Path, data: st.DataObject
) -> None:
    cut = data.draw(st.integers(0, len(whole_recording) - 1))
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole_recording[:cut])
    frames, error = collect(path)
    assert error is not None and "\n" not in str(error)
    assert frames == [frame(index) for index in range(len(frames))]
    assert isinstance(error, SourceTruncatedError) == bool(frames)


@given(data=st.data())
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_flipped_bytes_never_give_a_wrong_frame(whole_recording: bytes, tmp_path: Path, data: st.DataObject) -> None:
    content = bytearray(whole_recording)
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    path = tmp_path / "damaged.mcap"
    path.write_bytes(content)
    frames, error = collect(path)
    assert "\n" not in str(error)
    assert [f.encoded for f in frames] == [image(index) for index in range(len(frames))]


def test_hostile_chunks_are_refused_before_memory_is_spent(tmp_path: Path) -> None:
    import struct

    import zstandard

    bomb = zstandard.compress(b"\0" * (200 * 2**20))
    head = struct.pack("<QQQI", 0, 0, 100, 0) + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(bomb))
    record = struct.pack("<BQ", 6, len(head) + len(bomb)) + head + bomb
    huge = struct.pack("<BQ", 6, 2**40)
    for content in (record, huge):
        path = tmp_path / "bomb.mcap"
        path.write_bytes(b"\x89MCAP0\r\n" + content)
        scanner = McapScanner(path)
        assert list(scanner.messages()) == []
        assert scanner.damage is not None


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
def test_compressed_recordings_are_read_and_continued_as_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compression: CompressionType
) -> None:
    path = tmp_path / "run.mcap"
    with monkeypatch.context() as patch:
        patch.setattr(
            record, "Writer", lambda *args, **options: Writer(*args, **{**options, "compression": compression})
        )
        with Recording.open(path, chunk_bytes=3000) as recording:
            for index in range(4):
                recording.add_frame(FrameId("front", 0, index), frame(index))
    with path.open("rb") as file:
        chunks = [entry for entry in StreamReader(file, emit_chunks=True).records if isinstance(entry, Chunk)]
    assert {chunk.compression for chunk in chunks} == {"" if compression is CompressionType.NONE else "zstd"}
    assert list(open_source(str(path)).frames()) == [frame(index) for index in range(4)]
    with Recording.open(path, chunk_bytes=3000) as recording:
        recording.add_frame(FrameId("front", 0, 4), frame(4))
    assert list(open_source(str(path)).frames()) == [frame(index) for index in range(5)]


def test_source_needs_an_mcap_file_with_images(tmp_path: Path) -> None:
    text = tmp_path / "notes.mcap"
    text.write_text("these are notes")
    with pytest.raises(SourceError, match="is not an MCAP file"):
        open_source(str(text))
    with pytest.raises(SourceError, match="cannot read"):
        open_source(str(tmp_path / "missing.mcap"))
    other = tmp_path / "other.mcap"
    with other.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/chatter", "cdr", schema)
        writer.add_message(channel, 1, b"\0\1\2\3", 1)
        writer.finish()
    with pytest.raises(SourceError, match=r"no foxglove.CompressedImage messages \(topics: /chatter\)"):
        open_source(str(other))
    with pytest.raises(InputError, match="in the way"):
        Recording.open(other, chunk_bytes=CHUNK_BYTES)
    with pytest.raises(InputError, match="in the way"):
        Recording.open(text, chunk_bytes=CHUNK_BYTES)
    assert text.read_text() == "these are notes"
    assert list(tmp_path.glob("*.repair")) == []


def write_frames(recording: Recording, indices: range) -> None:
    for index in indices:
        recording.add_frame(FrameId("front", 0, index), frame(index))


def recorded_frames(path: Path) -> list[tuple[int, bytes]]:
    scanner = McapScanner(path)
    found = [(message.sequence, message.data) for message in scanner.messages() if "image" in message.channel.topic]
    assert scanner.damage is None
    scanner.close()
    return found


def test_on_a_full_disk_the_writer_waits_and_nothing_is_torn(tmp_path: Path) -> None:
    undisturbed, path = tmp_path / "undisturbed.mcap", tmp_path / "run.mcap"
    with Recording.open(undisturbed, chunk_bytes=3000) as recording:
        write_frames(recording, range(40))
    waits = 0

    def wait_for_space(_: OSError) -> bool:
        nonlocal waits
        waits += 1
        if waits == 3:
            disk.has_space_again()
        return True

    with (
        Recording.open(path, chunk_bytes=3000, wait_for_space=wait_for_space) as recording,
        full_disk(undisturbed.stat().st_size // 2) as disk,
    ):
        write_frames(recording, range(40))
    assert waits == 3
    assert recorded_frames(path) == recorded_frames(undisturbed)


def test_who_is_told_to_stop_on_a_full_disk_leaves_what_can_be_continued(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recording = Recording.open(path, chunk_bytes=3000)
    write_frames(recording, range(20))
    recording.flush()
    with full_disk(path.stat().st_size + 1000):
        with pytest.raises(OSError, match="File too large"):
            write_frames(recording, range(20, 60))
        recording.abandon()
    torn = path.read_bytes()
    with full_disk(2000), pytest.raises(DiskFullError, match="cannot write the recording"):
        Recording.open(path, chunk_bytes=3000)
    assert path.read_bytes() == torn
    assert list(tmp_path.iterdir()) == [path]
    with Recording.open(path, chunk_bytes=3000) as recording:
        assert all(recording.has_frame("front", 0, index) for index in range(20))
        write_frames(recording, range(60))
    assert [index for index, _ in recorded_frames(path)] == list(range(60))


def test_source_orders_by_number_and_selects(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recording.open(path, chunk_bytes=3000) as recording:
        for index in [0, 1, 4, 2, 5, 3, 6, 7]:
            recording.add_frame(FrameId("front", 0, index), frame(index))
    source = McapSource(path, Selection())
    assert source.frame_count == 8
    assert source.frame_rate_hz == pytest.approx(1e9 / FRAME_INTERVAL_NS)
    assert list(source.frames()) == [frame(index) for index in range(8)]
    every_third = list(McapSource(path, Selection(1, 8, 3)).frames())
    assert [f.index for f in every_third] == [0, 1, 2]
    assert [f.encoded for f in every_third] == [image(index) for index in (1, 4, 7)]
    with pytest.raises(SourceError, match="select nothing"):
        McapSource(path, Selection(start=8))


def test_fingerprint_follows_the_frames_and_not_the_file(tmp_path: Path) -> None:
    a, b, c = tmp_path / "a.mcap", tmp_path / "b.mcap", tmp_path / "c.mcap"
    write_session(a, 10)
    write_session(c, 11)
    with Recording.open(b, chunk_bytes=500) as recording:
        for index in reversed(range(10)):
            recording.add_frame(FrameId("front", 0, index), frame(index))
    assert McapSource(a, Selection()).fingerprint == McapSource(b, Selection()).fingerprint
    assert McapSource(a, Selection()).fingerprint != McapSource(c, Selection()).fingerprint
    assert McapSource(a, Selection()).fingerprint != McapSource(a, Selection(stride=2)).fingerprint


def test_frames_of_a_bridge_are_those_that_the_frontend_accepted(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    listed = [0, 2, 3]
    segment = segment_pb2.Segment(schema_version=1, index=0, camera="front")
    for number, index in enumerate(listed):
        segment.frames.add(frame_index=number, capture_time_ns=index * FRAME_INTERVAL_NS)
    entry = LogEntry("segment", 0, "segment/0", "vggt_motion.v1.Segment", segment.SerializeToString(), 0)
    with Recording.open(path, chunk_bytes=CHUNK_BYTES) as recording:
        for index in range(6):
            f = frame(index)
            assert recording.add_unnumbered_frame("front", f.encoded, f.media_type, f.capture_time_ns)
            assert not recording.add_unnumbered_frame("front", f.encoded, f.media_type, f.capture_time_ns)
        recording.add_entry(entry)
        assert not recording.is_numbered("front")
    frames = list(McapSource(path, Selection()).frames())
    assert [f.encoded for f in frames] == [image(index) for index in (0, 2, 3, 4, 5)]
    assert [f.index for f in frames] == [0, 1, 2, 3, 4]
    with Recording.open(path, chunk_bytes=CHUNK_BYTES) as again:
        f = frame(5)
        assert not again.add_unnumbered_frame("front", f.encoded, f.media_type, f.capture_time_ns)
        assert again.frame_count == 6


@pytest.mark.parametrize("stranger_numbers", [False, True])
def test_frames_of_a_stranger_on_the_same_key_are_not_taken_for_the_frontends(
    tmp_path: Path, stranger_numbers: bool
) -> None:
    """The segments list frames 0 to 5; one more was published in the other way."""
    path = tmp_path / "run.mcap"
    segment = segment_pb2.Segment(schema_version=1, index=0, camera="front")
    for index in range(6):
        segment.frames.add(frame_index=index, capture_time_ns=index * FRAME_INTERVAL_NS)
    entry = LogEntry("segment", 0, "segment/0", "vggt_motion.v1.Segment", segment.SerializeToString(), 0)
    with Recording.open(path, chunk_bytes=CHUNK_BYTES) as recording:
        for index in [77, *range(6)]:
            f = frame(index)
            if stranger_numbers == (index == 77):
                recording.add_frame(FrameId("front", 0, index), f)
            else:
                recording.add_unnumbered_frame("front", f.encoded, f.media_type, f.capture_time_ns)
        recording.add_entry(entry)
    assert list(McapSource(path, Selection()).frames()) == [frame(index) for index in range(6)]


def test_frames_of_a_bridge_without_times_are_all_taken(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    segment = segment_pb2.Segment(schema_version=1, index=0, camera="front")
    for number in range(3):
        segment.frames.add(frame_index=number, capture_time_ns=10**18 + number)  # the frontend's clock
    entry = LogEntry("segment", 0, "segment/0", "vggt_motion.v1.Segment", segment.SerializeToString(), 0)
    with Recording.open(path, chunk_bytes=CHUNK_BYTES) as recording:
        for index in range(4):
            assert recording.add_unnumbered_frame("front", image(index), frame(index).media_type, 0)
        recording.add_entry(entry)
    frames = list(McapSource(path, Selection()).frames())
    assert [f.encoded for f in frames] == [image(index) for index in range(4)]
    assert (np.diff([f.capture_time_ns for f in frames]) > 0).all()


def test_an_unreadable_image_ends_the_input_there(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recording.open(path, chunk_bytes=CHUNK_BYTES) as recording:
        for index in range(3):
            recording.add_frame(FrameId("front", 0, index), frame(index))
        recording.add_frame(FrameId("front", 0, 3), Frame(3, 3 * FRAME_INTERVAL_NS, image(3)[:-9], "image/jpeg"))
        recording.add_frame(FrameId("front", 0, 4), frame(4))
    frames = McapSource(path, Selection()).frames()
    assert [next(frames).index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(SourceTruncatedError, match="frame 3"):
        next(frames)


@given(st.lists(st.integers(0, 40)))
def test_index_set_is_a_set(numbers: list[int]) -> None:
    ours, reference = IndexSet(), set[int]()
    for number in numbers:
        assert ours.add(number) == (number not in reference)
        reference.add(number)
    assert len(ours) == len(reference)
    assert [n for n in range(-1, 42) if n in ours] == sorted(reference)


def test_an_empty_recording_is_a_good_file(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    Recording.open(path, chunk_bytes=CHUNK_BYTES).close()
    assert doctor(path) == []
    Recording.open(path, chunk_bytes=CHUNK_BYTES).close()
    assert read_all(path) == []
    with pytest.raises(SourceError, match=r"no foxglove\.CompressedImage"):
        McapSource(path, Selection())


def test_what_was_flushed_survives_the_process(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recording = Recording.open(path, chunk_bytes=2**20)
    for index in range(5):
        recording.add_frame(FrameId("front", 0, index), frame(index))
    recording.flush()
    recording.add_frame(FrameId("front", 0, 5), frame(5))
    frames, error = collect(path)  # what another process sees at this moment
    assert frames == [frame(index) for index in range(5)]
    assert isinstance(error, SourceTruncatedError)
    recording.close()
    assert len(collect(path)[0]) == 6


def test_recent_payloads_are_bounded_by_their_bytes_and_forget_what_was_not_asked_for() -> None:
    held = RecentPayloads(10)
    held.put("a", b"1234")
    held.put("b", b"1234")
    held.put("a", b"12")  # another length in its place
    held.put("c", b"1234")
    assert [held.get(key) for key in "abc"] == [b"12", b"1234", b"1234"]
    held.put("d", b"1")
    assert [held.get(key) for key in "abcd"] == [None, b"1234", b"1234", b"1"]
    held.put("e", bytes(11))  # more than all of it
    assert [held.get(key) for key in "abcde"] == [None] * 5
