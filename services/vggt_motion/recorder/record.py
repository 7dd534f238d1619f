"""Writing a recording: one MCAP file that holds the frames, the whole log with its payloads, and views for people.

Lossless part, from which a session can be read back:

- ``/camera/<name>/image``: the frames, message sequence = frame index, publish time = capture time; the channel's
  metadata name the camera and its epoch, and whether the publisher numbered the frames (see ``NUMBERED``).
- ``/vggt_motion/log/<stream>``: the records of the ledger's streams as they are on the wire, message sequence = the
  ledger's sequence number. The record's id is part of the record.
- ``/vggt_motion/blob``: payloads that records refer to (depth, masks), as messages and not as attachments: they lie in
  chunks with a checksum, before the record that needs them, every MCAP tool that filters, splits or recovers by topic
  keeps them, and they stream. Attachments stand outside chunks, end the open chunk each time, and are listed in the
  summary one by one. Images of keyframes are not stored again: the frame is in the file.

Views: ``/pose``, ``/trajectory``, ``/map``, ``/tf`` (``recorder/views.py`` makes them).

The file is flushed and synchronised by its owner at intervals; a file that was broken off is read up to its last whole
chunk into a new file, which then takes its place and is continued. On a full disk whoever writes waits for space.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
import zlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from io import BufferedWriter
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from google.protobuf.message import DecodeError
from mcap.writer import CompressionType, IndexType, Writer

from vggt_motion import __version__
from vggt_motion.disk import NO_SPACE, PatientFile, sync_folder
from vggt_motion.errors import CodecError, DiskFullError, InputError, SourceError, VggtMotionError
from vggt_motion.foxglove import MAP_FRAME, MAP_FROM_WORLD, WORLD_FRAME, decode_image, encode_image, frame_transform
from vggt_motion.recorder import schemas
from vggt_motion.recorder.container import MAGIC, McapScanner, StoredMessage
from vggt_motion.recorder.indexset import IndexSet
from vggt_motion.records import BlobRef, LogEntry
from vggt_motion.sources.source import Frame
from vggt_motion.v1 import recording_pb2

_log = logging.getLogger(__name__)

LOG_TOPIC = "/vggt_motion/log/"
BLOB_TOPIC = "/vggt_motion/blob"
POSE_TOPIC = "/pose"
TRAJECTORY_TOPIC = "/trajectory"
MAP_TOPIC = "/map"
TRANSFORM_TOPIC = "/tf"

# Keys of the metadata of an image channel.
CAMERA, EPOCH, NUMBERED = "camera", "epoch", "numbered"

_Key = TypeVar("_Key")
_MAX_SEQUENCE = 2**32 - 1
_RECENT = 4096  # blobs, and frames without a number, are recognised among so many of the latest


def image_topic(camera: str) -> str:
    """Topic of a camera's frames."""
    return f"/camera/{camera}/image"


@dataclass(frozen=True)
class FrameId:
    """Which frame of which camera; numbered by who published it, or by the recorder in the order of arrival."""

    camera: str
    epoch: int
    index: int


@dataclass(frozen=True)
class _Channel:
    topic: str
    schema: str
    metadata: tuple[tuple[str, str], ...] = ()


class RecordingClosedError(VggtMotionError):
    """The file has been closed meanwhile; what was to be added is not in it."""


class Recording:
    """One MCAP file being written. Safe to use from several threads."""

    def __init__(
        self, path: Path, *, chunk_bytes: int, wait_for_space: Callable[[OSError], bool], clock: Callable[[], int]
    ) -> None:
        """Use :meth:`open`."""
        self.path = path
        self._wait_for_space = wait_for_space
        self._clock = clock
        self._chunk_bytes = chunk_bytes
        self._lock = threading.RLock()
        self._last_log_time_ns = 0
        self._is_dirty = False
        self._is_closed = False
        self._channels: dict[_Channel, int] = {}
        self._schemas: dict[str, int] = {}
        self._positions: dict[str, int] = {}
        self._frames: dict[tuple[str, int], IndexSet] = {}
        self._unnumbered_counts: dict[str, int] = {}
        self._posed: dict[tuple[str, int], IndexSet] = {}
        self._view_revisions: dict[str, int] = {}
        self._recent_blobs: OrderedDict[str, None] = OrderedDict()
        self._recent_frames: OrderedDict[tuple[str, int, int], None] = OrderedDict()

    @classmethod
    def open(
        cls,
        path: Path,
        *,
        chunk_bytes: int,
        on_entry: Callable[[str, int, bytes], None] | None = None,
        wait_for_space: Callable[[OSError], bool] = lambda _: False,
        clock: Callable[[], int] = time.time_ns,
    ) -> Recording:
        """Begin a recording, or continue the one that is there, whole or broken off.

        Args:
            path: the file.
            chunk_bytes: size at which a chunk is written.
            on_entry: called with (stream, sequence, payload) for each record of the log that is in the file already.
            wait_for_space: called whenever the disk is full, by whoever writes, and waits a while; False: give up.
            clock: wall clock in nanoseconds, for the time of reception.

        Raises:
            InputError: there is a file of another kind, or none can be written there.
            DiskFullError: there is no space; what was there is as it was.
        """
        recording = cls(path, chunk_bytes=chunk_bytes, wait_for_space=wait_for_space, clock=clock)
        try:
            if _has_content(path):
                recording._continue(on_entry)
            else:
                recording._begin(path)
                recording._add_upright_frame()
        except OSError as error:
            kind = DiskFullError if error.errno in NO_SPACE else InputError
            raise kind(f"cannot write the recording {path}: {error.strerror or error}") from error
        return recording

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def position(self, stream: str) -> int:
        """Number of records of a stream in the file; the sequence number that comes next."""
        with self._lock:
            return self._positions.get(stream, 0)

    @property
    def frame_count(self) -> int:
        """Number of frames in the file, of all cameras and epochs."""
        with self._lock:
            return sum(len(indices) for indices in self._frames.values()) + sum(self._unnumbered_counts.values())

    def has_frame(self, camera: str, epoch: int, index: int) -> bool:
        """Whether a numbered frame is in the file."""
        with self._lock:
            return index in self._frames.get((camera, epoch), ())

    def is_numbered(self, camera: str) -> bool:
        """Whether the frames of a camera carry the numbers of the frontend (true until one arrives without)."""
        with self._lock:
            return camera not in self._unnumbered_counts

    def has_pose(self, frame_id: FrameId) -> bool:
        """Whether the pose of a keyframe is in the file."""
        with self._lock:
            return frame_id.index in self._posed.get((frame_id.camera, frame_id.epoch), ())

    def view_revision(self, topic: str) -> int:
        """Revision of the graph that the last message of ``/trajectory`` or ``/map`` shows; -1 without one."""
        with self._lock:
            return self._view_revisions.get(topic, -1)

    @property
    def log_time_ns(self) -> int:
        """Time of reception of the last message."""
        return self._last_log_time_ns

    def add_frame(self, frame_id: FrameId, frame: Frame) -> bool:
        """Record a frame that its publisher numbered.

        Returns:
            False if that frame is in the file already.

        Raises:
            CodecError: the frame cannot be described in Foxglove's terms.
        """
        payload = encode_image(frame.encoded, frame.media_type, frame.capture_time_ns, frame_id.camera)
        return self.add_image(frame_id, frame.capture_time_ns, payload)

    def add_image(self, frame_id: FrameId, capture_time_ns: int, payload: bytes) -> bool:
        """As :meth:`add_frame`, of a foxglove.CompressedImage that is recorded as it came.

        Raises:
            CodecError: its index is out of range.
        """
        if not 0 <= frame_id.index <= _MAX_SEQUENCE:
            raise CodecError(f"frame index {frame_id.index} is out of range")
        with self._lock:
            known = self._frames.setdefault((frame_id.camera, frame_id.epoch), IndexSet())
            if frame_id.index in known:
                return False
            self._add(_image_channel(frame_id.camera, frame_id.epoch), frame_id.index, capture_time_ns, payload)
            known.add(frame_id.index)
        return True

    def add_unnumbered_frame(self, camera: str, encoded: bytes, media_type: str, capture_time_ns: int) -> bool:
        """Record a frame from a publisher that does not number them, in the order of arrival.

        Returns:
            False if the very same frame (time and bytes) came shortly before.

        Raises:
            CodecError: the frame cannot be described in Foxglove's terms.
        """
        payload = encode_image(encoded, media_type, capture_time_ns, camera)
        with self._lock:
            if not self._is_new_frame(camera, capture_time_ns, encoded):
                return False
            index = self._unnumbered_counts.get(camera, 0)
            self._add(_image_channel(camera, None), index & _MAX_SEQUENCE, capture_time_ns, payload)
            self._unnumbered_counts[camera] = index + 1
        return True

    def add_entry(self, entry: LogEntry, capture_time_ns: int | None = None) -> bool:
        """Record a record of the log; its blobs go first.

        Args:
            entry: the record as the ledger delivers it.
            capture_time_ns: the moment of the video that it belongs to; None = unknown.

        Returns:
            False if it is in the file already.

        Raises:
            ValueError: a record before it is missing.
        """
        is_known_type = entry.payload_type in schemas.known_types()
        payload = entry.payload if is_known_type else _log_entry_message(entry)
        channel = _Channel(LOG_TOPIC + entry.stream, entry.payload_type if is_known_type else schemas.LOG_ENTRY)
        with self._lock:
            expected = self._positions.get(entry.stream, 0)
            if entry.sequence < expected:
                return False
            if entry.sequence > expected:
                raise ValueError(f"record {entry.sequence} of stream {entry.stream} came before record {expected}")
            self._add(channel, entry.sequence & _MAX_SEQUENCE, capture_time_ns, payload)
            self._positions[entry.stream] = expected + 1
        return True

    def has_blob(self, ref: BlobRef) -> bool:
        """Whether a payload is among the latest in the file."""
        with self._lock:
            return ref.sha256 in self._recent_blobs

    def add_blob(self, ref: BlobRef, data: bytes) -> bool:
        """Record a payload of the blob store; False if it is among the latest in the file."""
        message = recording_pb2.Blob(schema_version=1, data=data)
        message.ref.sha256, message.ref.size_bytes, message.ref.media_type = ref.sha256, ref.size_bytes, ref.media_type
        with self._lock:
            if ref.sha256 in self._recent_blobs:
                self._recent_blobs.move_to_end(ref.sha256)
                return False
            self._add(_Channel(BLOB_TOPIC, schemas.BLOB), 0, None, message.SerializeToString())
            _remember(self._recent_blobs, ref.sha256)
        return True

    def add_pose(self, frame_id: FrameId, payload: bytes, capture_time_ns: int) -> None:
        """Record a foxglove.PoseInFrame of a keyframe."""
        channel = _Channel(POSE_TOPIC, schemas.POSE, _metadata(frame_id.camera, frame_id.epoch))
        with self._lock:
            self._add(channel, frame_id.index, capture_time_ns, payload)
            self._posed.setdefault((frame_id.camera, frame_id.epoch), IndexSet()).add(frame_id.index)

    def add_trajectory(self, revision: int, payload: bytes, capture_time_ns: int) -> None:
        """Record a foxglove.PosesInFrame of all keyframes at one revision of the graph."""
        with self._lock:
            self._add(_Channel(TRAJECTORY_TOPIC, schemas.TRAJECTORY), revision, capture_time_ns, payload)
            self._view_revisions[TRAJECTORY_TOPIC] = revision

    def add_map(self, revision: int, payload: bytes, capture_time_ns: int) -> None:
        """Record a foxglove.PointCloud of the map at one revision of the graph."""
        with self._lock:
            self._add(_Channel(MAP_TOPIC, schemas.POINTS), revision, capture_time_ns, payload)
            self._view_revisions[MAP_TOPIC] = revision

    def add_transform(self, payload: bytes, capture_time_ns: int) -> None:
        """Record a foxglove.FrameTransform."""
        self._add(_Channel(TRANSFORM_TOPIC, schemas.TRANSFORM), 0, capture_time_ns, payload)

    def flush(self) -> None:
        """End the open chunk and make everything so far durable; what comes after may be lost with the process."""
        with self._lock:
            if self._is_closed or not self._is_dirty:
                return
            self._writer.flush()  # type: ignore[no-untyped-call]
            os.fsync(self._file.fileno())
            self._is_dirty = False

    def close(self) -> None:
        """Write the summary and close the file; safe to call twice."""
        with self._lock:
            if self._is_closed:
                return
            self._is_closed = True
            try:
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._file.flush()
                os.fsync(self._file.fileno())
            finally:
                self._file.close()

    def abandon(self) -> None:
        """Close the file as it is, for an owner that cannot go on writing; it is repaired when opened again."""
        with self._lock:
            self._is_closed = True
            with contextlib.suppress(OSError):
                self._file.close()

    def _begin(self, path: Path) -> None:
        self._file = BufferedWriter(PatientFile(path, self._wait_for_space))
        # The library lists index groups in the summary even when they are empty, which other readers call an error:
        # so the indexes of attachments and metadata, which we never write, are off, and no file is without a message.
        self._writer = Writer(
            self._file,
            chunk_size=self._chunk_bytes,
            # Frames and payloads are compressed already: zstd took 2 % off, for more time than checksums and copies.
            compression=CompressionType.NONE,
            index_types=IndexType.CHUNK | IndexType.MESSAGE,
        )
        self._writer.start(profile="", library=f"vggt-motion {__version__}")
        self._writer.flush()  # type: ignore[no-untyped-call]
        os.fsync(self._file.fileno())
        sync_folder(path.parent)

    def _add_upright_frame(self) -> None:
        self.add_transform(frame_transform(MAP_FROM_WORLD, MAP_FRAME, WORLD_FRAME, 0), 0)

    def _continue(self, on_entry: Callable[[str, int, bytes], None] | None) -> None:
        try:
            scanner = McapScanner(self.path)
        except SourceError as error:
            raise InputError(f"{error}; it is in the way of the recording") from error
        scratch = self.path.with_name(self.path.name + ".repair")
        self._begin(scratch)
        try:
            for message in scanner.messages():
                self._take_over(message, on_entry)
        except (CodecError, DecodeError, KeyError, ValueError) as error:
            self.abandon()
            scratch.unlink()
            raise InputError(f"{self.path} is no recording of this program and is in the way of the new one") from error
        except OSError:
            self.abandon()
            scratch.unlink(missing_ok=True)
            raise
        finally:
            scanner.close()
        if not self._channels:
            self._add_upright_frame()
        self.flush()
        scratch.replace(self.path)
        sync_folder(self.path.parent)
        if scanner.damage is not None:
            _log.warning("%s was broken off (%s): continued from its last whole chunk", self.path, scanner.damage)

    def _take_over(self, message: StoredMessage, on_entry: Callable[[str, int, bytes], None] | None) -> None:
        """Copy a message of the file that is continued, and learn from it what is recorded."""
        channel = message.channel
        metadata = channel.metadata
        if CAMERA in metadata:
            camera, epoch = metadata[CAMERA], int(metadata[EPOCH])
            if channel.topic == POSE_TOPIC:
                self._posed.setdefault((camera, epoch), IndexSet()).add(message.sequence)
            elif metadata.get(NUMBERED) == "true":
                if not self._frames.setdefault((camera, epoch), IndexSet()).add(message.sequence):
                    return
            else:
                encoded, _, capture_time_ns = decode_image(message.data)
                if not self._is_new_frame(camera, capture_time_ns, encoded):
                    return
                self._unnumbered_counts[camera] = self._unnumbered_counts.get(camera, 0) + 1
        elif channel.topic.startswith(LOG_TOPIC):
            stream = channel.topic.removeprefix(LOG_TOPIC)
            if message.sequence != self._positions.get(stream, 0) & _MAX_SEQUENCE:
                return
            if on_entry is not None and channel.schema_name != schemas.LOG_ENTRY:
                on_entry(stream, self._positions.get(stream, 0), message.data)
            self._positions[stream] = self._positions.get(stream, 0) + 1
        elif channel.topic == BLOB_TOPIC:
            _remember(self._recent_blobs, recording_pb2.Blob.FromString(message.data).ref.sha256)
        elif channel.topic in (TRAJECTORY_TOPIC, MAP_TOPIC):
            self._view_revisions[channel.topic] = message.sequence
        self._last_log_time_ns = max(self._last_log_time_ns, message.log_time_ns)
        own = _Channel(channel.topic, channel.schema_name, tuple(sorted(metadata.items())))
        self._write(own, message.sequence, message.log_time_ns, message.publish_time_ns, message.data)

    def _is_new_frame(self, camera: str, capture_time_ns: int, encoded: bytes) -> bool:
        identity = (camera, capture_time_ns, zlib.crc32(encoded))
        if identity in self._recent_frames:
            return False
        _remember(self._recent_frames, identity)
        return True

    def _add(self, channel: _Channel, sequence: int, publish_time_ns: int | None, payload: bytes) -> None:
        with self._lock:
            if self._is_closed:
                raise RecordingClosedError(f"{self.path} is closed")
            # Clocks step back; the log of a recording does not.
            self._last_log_time_ns = max(self._last_log_time_ns, self._clock())
            publish = self._last_log_time_ns if publish_time_ns is None else publish_time_ns
            self._write(channel, sequence, self._last_log_time_ns, publish, payload)

    def _write(self, channel: _Channel, sequence: int, log_time_ns: int, publish_time_ns: int, payload: bytes) -> None:
        channel_id = self._channels.get(channel)
        if channel_id is None:
            channel_id = self._channels[channel] = self._writer.register_channel(
                channel.topic, "protobuf", self._schema_id(channel.schema), dict(channel.metadata)
            )
        self._is_dirty = True
        self._writer.add_message(channel_id, log_time_ns, payload, publish_time_ns, sequence)

    def _schema_id(self, name: str) -> int:
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, "protobuf", schemas.schema_data(name))
        return self._schemas[name]


def _remember(recent: OrderedDict[_Key, None], key: _Key) -> None:
    recent[key] = None
    while len(recent) > _RECENT:
        recent.popitem(last=False)


def _metadata(camera: str, epoch: int | None) -> tuple[tuple[str, str], ...]:
    """Metadata of a camera's channels; ``epoch`` None = the publisher does not number its frames."""
    return ((CAMERA, camera), (EPOCH, str(epoch or 0)), (NUMBERED, "false" if epoch is None else "true"))


def _image_channel(camera: str, epoch: int | None) -> _Channel:
    return _Channel(image_topic(camera), schemas.IMAGE, _metadata(camera, epoch))


def _log_entry_message(entry: LogEntry) -> bytes:
    # A type that this version does not know is kept in its envelope, so that nothing of the log is missing.
    from vggt_motion.v1 import ledger_pb2

    return ledger_pb2.LogEntry(
        schema_version=1,
        stream=entry.stream,
        sequence=entry.sequence,
        record_id=entry.record_id,
        payload_type=entry.payload_type,
        payload=entry.payload,
        append_time_ns=entry.append_time_ns,
    ).SerializeToString()


def _has_content(path: Path) -> bool:
    """Whether a file is there with more in it than the beginning of the mark that every MCAP file begins with."""
    try:
        with path.open("rb") as file:
            head = file.read(len(MAGIC) + 1)
    except FileNotFoundError:
        return False
    return not MAGIC.startswith(head)
