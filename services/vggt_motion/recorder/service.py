"""The recorder as a service: frames from the image keys, records and payloads from the ledger, views of what they say.

What the file holds is decided by the file alone: after a restart, streams go on at the record that it lacks, and no
frame is written twice. Frames that only went by while no recorder was there are taken from the ledger where they are
keyframes; the others are counted as missing. On a full disk the recorder waits, and with it whoever publishes frames
blocking.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import cv2

from vggt_motion.backend.state import LogState
from vggt_motion.bus import codec
from vggt_motion.bus.follow import Followed
from vggt_motion.bus.images import decode_image
from vggt_motion.bus.log import RECORD_OF_STREAM, LogFollower, LogRecord
from vggt_motion.bus.logs import is_told
from vggt_motion.bus.service import ServiceContext, run_service
from vggt_motion.bus.session import Sample
from vggt_motion.config import Config
from vggt_motion.errors import (
    BusUnavailableError,
    CodecError,
    DiskFullError,
    InputError,
    LedgerError,
    RequestRefusedError,
    VggtMotionError,
)
from vggt_motion.recorder.payloads import RecentPayloads
from vggt_motion.recorder.record import FrameId, Recording, RecordingClosedError
from vggt_motion.recorder.views import ViewWriter, drawn_map, drawn_trajectory
from vggt_motion.records import (
    BlobRef,
    Keyframe,
    LogEntry,
    Segment,
    Stream,
    SubmapGeometry,
)
from vggt_motion.sources.source import Frame

_log = logging.getLogger(__name__)
RECORDING_FILE = "run.mcap"
_REPORT_S = 1.0
_PATIENT_S = 0.5  # between two looks for images of keyframes
_RECORDS_A_TURN = 100
_BLOBS_A_TURN = 32
_FRAME_PATIENCE_S = 1.0  # a keyframe's record may overtake its image
_BLOB_PATIENCE_S = 2.0
_VIEW_REST = 9.0  # after making views, rest for so many times as long: they may not cost more than a share of a core
_VIEW_IDLE_S = 5.0
_HELD_BYTES = 64 * 2**20
_DISK_RETRY_S = 1.0


def main(config: Config, *, directory: Path) -> int:
    """Record the session into ``directory/run.mcap`` until told to stop; returns the exit code of the process."""

    def body(context: ServiceContext) -> None:
        cv2.setNumThreads(1)  # the views are made at leisure, beside the computing that others wait for
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot write to {directory}: {error.strerror or error}") from error
        recorder = _opened(context, directory / RECORDING_FILE)
        if recorder is not None:
            recorder.serve()

    return run_service("recorder", config, body)


def _opened(context: ServiceContext, path: Path) -> _Recorder | None:
    while not context.stopping.is_set():
        try:
            return _Recorder(context, path)
        except DiskFullError as error:
            context.set_health("waiting", str(error))
            context.stopping.wait(_DISK_RETRY_S)
    return None


class _Recorder:
    def __init__(self, context: ServiceContext, path: Path) -> None:
        self._context = context
        self._path = path
        self._log = LogState()
        self._recording = Recording.open(
            path,
            chunk_bytes=context.config.recorder.chunk_bytes,
            on_entry=self._remember_entry,
            wait_for_space=self._wait_for_space,
        )
        self._payloads = RecentPayloads(_HELD_BYTES)
        self._views = _ViewThread(context, self._recording, self._payloads)
        self._failure: OSError | None = None  # of a thread; the main loop ends the service
        self._refused_images = 0
        self._pending_keyframes: dict[str, tuple[Keyframe, int, float]] = {}  # id -> record, sequence, time seen
        self._expected_frames: dict[tuple[str, int], int] = {}  # camera and epoch -> frames that segments list
        self._held: dict[Stream, Followed[LogRecord]] = {}  # its payloads could not be fetched yet

    def serve(self) -> None:
        context = self._context
        threading.Thread(target=self._flush_regularly, name="recorder-flush", daemon=True).start()
        self._take_up()
        # Over a link of its own: a slow disk then holds up whoever publishes blocking, and not our own requests.
        images = context.bus.subscribe(context.bus.keys.all_images(), self._on_image, history=True, isolated=True)
        positions = {stream: self._recording.position(stream.value) for stream in RECORD_OF_STREAM}
        follower = LogFollower(context.bus, positions)
        context.stopping.wakes(follower.wake)
        self._views.start(on_done=follower.wake)
        try:
            next_report, was_complete = 0.0, False
            while not context.stopping.is_set():
                count = self._follow(follower)
                self._fill_keyframes()
                self._check()
                is_complete = self._is_complete
                if time.monotonic() >= next_report or is_complete != was_complete:
                    next_report, was_complete = time.monotonic() + _REPORT_S, is_complete
                    # a change of state is sent soon: whoever waits for the recording waits hardly longer than it takes
                    self._report("idle" if is_complete else "working")
                if count == 0:
                    follower.wait(_PATIENT_S if self._pending_keyframes else _REPORT_S)
            self._follow(follower, keep_going=False)
        except OSError as error:
            self._failure = error
        finally:
            images.close()
            follower.close()
            self._finish()

    def _finish(self) -> None:
        try:
            if self._failure is None:
                self._recording.close()
        except OSError as error:
            self._failure = error
        if self._failure is not None:
            self._recording.abandon()
            raise DiskFullError(f"cannot write {self._path}: {self._failure.strerror}") from self._failure
        self._report("ended")

    def _wait_for_space(self, error: OSError) -> bool:
        self._context.set_health("waiting", f"cannot write {self._path}: {error.strerror}")
        return not self._context.stopping.wait(_DISK_RETRY_S)

    # --- what the file says already ---

    def _remember_entry(self, stream: str, _: int, payload: bytes) -> None:
        cls = RECORD_OF_STREAM.get(Stream(stream))
        if cls is None:
            return
        try:
            self._log.apply(codec.decode(cls, payload))
        except CodecError as error:
            _log.warning("record in the file cannot be read", extra={"stream": stream, "reason": str(error)})

    def _take_up(self) -> None:
        """What a recorder before this one had not come to."""
        for sequence, keyframe in enumerate(self._log.keyframes.values()):
            self._expect_frame(keyframe, sequence)
        for segment in self._log.segments.values():
            self._expect_segment(segment)
        self._views.offer(self._log)

    # --- frames ---

    def _on_image(self, sample: Sample) -> None:
        camera = sample.key.split("/")[-2]
        try:
            payload = sample.payload
            image = decode_image(payload, sample.attachment)
            if image.header is None or not image.header.is_accepted:
                # Which of these the frontend takes, and under which number, its segments will say.
                self._recording.add_unnumbered_frame(camera, image.encoded, image.media_type, image.capture_time_ns)
            else:
                frame_id = FrameId(camera, image.header.epoch, image.header.frame_index)
                self._recording.add_image(frame_id, image.capture_time_ns, payload)
                self._payloads.put(frame_id, image.encoded)
        except CodecError as error:
            self._refused_images += 1
            if is_told(self._refused_images):
                _log.warning(
                    "image refused", extra={"key": sample.key, "count": self._refused_images, "reason": str(error)}
                )
        except RecordingClosedError:
            return
        except OSError as error:
            self._failure = error

    def _expect_frame(self, keyframe: Keyframe, sequence: int) -> None:
        if not self._recording.has_frame(keyframe.camera, keyframe.epoch, keyframe.frame_index):
            self._pending_keyframes[keyframe.keyframe_id] = (keyframe, sequence, time.monotonic())

    def _expect_segment(self, segment: Segment) -> None:
        listed = self._expected_frames
        place = (segment.camera, segment.epoch)
        listed[place] = max(listed.get(place, 0), segment.frames[-1].frame_index + 1 if segment.frames else 0)

    def _fill_keyframes(self) -> None:
        """Take from the ledger the images of keyframes that did not come over the image key."""
        for keyframe_id, (keyframe, _, since) in list(self._pending_keyframes.items()):
            frame_id = FrameId(keyframe.camera, keyframe.epoch, keyframe.frame_index)
            if not self._recording.has_frame(frame_id.camera, frame_id.epoch, frame_id.index):
                if time.monotonic() - since < _FRAME_PATIENCE_S:
                    continue
                try:
                    data = dict(self._fetched([keyframe.image])).get(keyframe.image)
                except BusUnavailableError:
                    return
                if data is not None and self._recording.is_numbered(keyframe.camera):
                    frame = Frame(frame_id.index, keyframe.capture_time_ns, data, keyframe.image.media_type)
                    self._recording.add_frame(frame_id, frame)
                elif data is not None:
                    # Which of the unnumbered frames it is cannot be told: its bytes are kept as a payload.
                    self._recording.add_blob(keyframe.image, data)
            del self._pending_keyframes[keyframe_id]

    # --- records ---

    def _follow(self, log: LogFollower, *, keep_going: bool = True) -> int:
        """Write what has come, a bounded number of records a turn; returns how many."""
        count = 0
        is_new_graph = is_more_of_it = False
        for stream, follower in log.followers.items():
            for _ in range(_RECORDS_A_TURN):
                followed = self._held.pop(stream, None) or follower.next(0.0)
                if followed is None or (keep_going and self._context.stopping.is_set()):
                    break
                try:
                    self._record(followed)
                except BusUnavailableError:
                    self._held[stream] = followed
                    break
                count += 1
                is_new_graph |= stream is Stream.GRAPH
                is_more_of_it |= stream in (Stream.KEYFRAME, Stream.SEGMENT, Stream.SUBMAP)
        graph = self._log.latest_graph()
        # The streams are not ordered mutually: what the final graph speaks of may come after it.
        if graph is not None and (is_new_graph or (is_more_of_it and graph.is_final)):
            self._views.offer(self._log)
        return count

    def _record(self, followed: Followed[LogRecord]) -> None:
        record, stream = followed.record, followed.entry.stream
        expected = self._recording.position(stream)
        if followed.sequence > expected:
            # The follower passes over what it cannot decode; the file keeps it.
            for entry in self._context.ledger.read(stream, expected, followed.sequence - expected):
                self._recording.add_entry(entry)
        if not isinstance(record, Keyframe):
            refs = [ref for ref in codec.blob_refs(record) if not self._recording.has_blob(ref)]
            for ref, data in self._fetched(refs):
                self._recording.add_blob(ref, data)
        self._recording.add_entry(followed.entry, self._capture_time_ns(record, followed.entry))
        self._log.apply(record)
        match record:
            case Keyframe():
                self._expect_frame(record, followed.sequence)
            case Segment():
                self._expect_segment(record)
            case _:
                pass

    def _fetched(self, refs: Sequence[BlobRef]) -> Iterator[tuple[BlobRef, bytes]]:
        """Payloads from the ledger, those that it has."""
        for first in range(0, len(refs), _BLOBS_A_TURN):
            some = refs[first : first + _BLOBS_A_TURN]
            try:
                found = list(zip(some, self._context.ledger.blobs(some, patience_s=_BLOB_PATIENCE_S), strict=True))
            except (RequestRefusedError, LedgerError) as error:
                if len(some) == 1:
                    _log.error(
                        "payload missing in the recording", extra={"sha256": some[0].sha256, "reason": str(error)}
                    )
                    continue
                found = [pair for ref in some for pair in self._fetched([ref])]
            for ref, data in found:
                self._payloads.put(ref.sha256, data)
                yield ref, data

    def _capture_time_ns(self, record: LogRecord, entry: LogEntry) -> int | None:
        """The moment of the video that a record speaks of: that of its last keyframe."""
        match record:
            case Keyframe():
                time_ns: int | None = record.capture_time_ns
            case Segment():
                time_ns = record.frames[-1].capture_time_ns if record.frames else None
            case SubmapGeometry():
                last = self._log.keyframes.get(record.spec.base_keyframe_ids[-1])
                time_ns = last.capture_time_ns if last is not None else None
            case _:
                time_ns = entry.append_time_ns
        return time_ns if time_ns is not None and time_ns >= 0 else None

    # --- keeping up ---

    def _flush_regularly(self) -> None:
        while not self._context.stopping.wait(self._context.config.recorder.flush_interval_s):
            try:
                self._recording.flush()
            except OSError as error:
                self._failure = error
                return

    def _check(self) -> None:
        failure = self._failure or self._views.failure
        if isinstance(failure, OSError):
            raise failure
        if failure is not None:
            raise failure

    @property
    def _is_complete(self) -> bool:
        """Whether the final graph is in the file, with all that was there before it and what it looks like."""
        graph = self._log.latest_graph()
        return graph is not None and graph.is_final and not self._pending_keyframes and self._views.is_done

    def _report(self, state: str) -> None:
        recording = self._recording
        pending = len(self._pending_keyframes)
        missing = sum(self._expected_frames.values()) - recording.frame_count
        counters: dict[str, float] = {
            "frames": recording.frame_count,
            "missing_frames": max(0, missing),
            "refused_images": self._refused_images,
            "pending_keyframes": pending,
        }
        for stream in RECORD_OF_STREAM:
            counters[f"position_{stream.value}"] = recording.position(stream.value)
        # A position stands for everything that follows from the records before it: images, and the final views.
        if pending:
            counters["position_keyframe"] = min(sequence for _, sequence, _ in self._pending_keyframes.values())
        if not self._views.is_done:
            counters["position_graph"] = max(0, recording.position(Stream.GRAPH.value) - 1)
        self._context.set_health(state, f"{recording.frame_count} frames in {self._path.name}", **counters)


class _ViewThread:
    """Makes the views beside the recording: of the newest graph only, and at leisure until the graph is final."""

    def __init__(self, context: ServiceContext, recording: Recording, payloads: RecentPayloads) -> None:
        self._context = context
        self._recording = recording
        self._payloads = payloads
        self._writer = ViewWriter(recording)
        self._changed = threading.Condition()
        self._offered: LogState | None = None
        self._is_busy = False
        self.failure: OSError | None = None

    def start(self, on_done: Callable[[], None]) -> None:
        """``on_done`` is called, from the thread, whenever :attr:`is_done` may have become true."""
        threading.Thread(target=self._run, args=(on_done,), name="recorder-views", daemon=True).start()

    @property
    def is_done(self) -> bool:
        """Whether there is nothing to show that is not in the file; live graphs may be passed over."""
        with self._changed:
            offered = self._offered.latest_graph() if self._offered is not None else None
            return not self._is_busy and (offered is None or not offered.is_final)

    def offer(self, log: LogState) -> None:
        """Ask for views of a log; shallow copies are taken."""
        if log.latest_graph() is None:
            return
        copy = LogState(dict(log.keyframes), dict(log.segments), dict(log.submaps), {}, {}, dict(log.graphs), {})
        with self._changed:
            self._offered = copy
            self._changed.notify_all()

    def _run(self, on_done: Callable[[], None]) -> None:
        while not self._context.stopping.is_set():
            with self._changed:
                if self._offered is None:
                    self._changed.wait(_VIEW_IDLE_S)
                    continue
                log, self._offered = self._offered, None
                graph = log.latest_graph()
                is_final = graph is not None and graph.is_final
                self._is_busy = is_final
            begin = time.monotonic()
            try:
                self._make(log)
            except RecordingClosedError:
                return
            except OSError as error:
                self.failure = error
                return
            except VggtMotionError as error:
                _log.warning("views not recorded", extra={"reason": str(error)})
            finally:
                with self._changed:
                    self._is_busy = False
                on_done()
            self._rest(_VIEW_REST * (time.monotonic() - begin))

    def _rest(self, seconds: float) -> None:
        """Pause, unless the final graph comes."""
        with self._changed:
            self._changed.wait_for(self._is_urgent, seconds)

    def _is_urgent(self) -> bool:
        graph = self._offered.latest_graph() if self._offered is not None else None
        return self._context.stopping.is_set() or (graph is not None and graph.is_final)

    def _make(self, log: LogState) -> None:
        graph = log.latest_graph()
        if graph is None:
            return
        backend = self._context.config.backend
        with self._context.numerics:
            trajectory = drawn_trajectory(log, graph, backend)
        self._writer.add_trajectory(trajectory)
        if self._writer.wants_map(trajectory):
            frame_ids = {
                keyframe.image.sha256: FrameId(keyframe.camera, keyframe.epoch, keyframe.frame_index)
                for keyframe in log.keyframes.values()
            }
            read_blob = functools.partial(self._read_blob, frame_ids)
            with self._context.numerics:
                points = drawn_map(log, graph, trajectory, backend, read_blob)
            self._writer.add_map(points, trajectory)

    def _read_blob(self, frame_ids: Mapping[str, FrameId], ref: BlobRef) -> bytes:
        """A payload; ``frame_ids`` says which frame an image is, by its SHA-256."""
        with self._context.numerics.paused():
            return self._payload(frame_ids, ref)

    def _payload(self, frame_ids: Mapping[str, FrameId], ref: BlobRef) -> bytes:
        held = self._payloads.get(ref.sha256)
        if held is not None:
            return held
        frame = self._payloads.get(frame_ids.get(ref.sha256))
        if frame is not None and hashlib.sha256(frame).hexdigest() == ref.sha256:
            return frame
        return self._context.ledger.blob(ref, patience_s=_BLOB_PATIENCE_S)
