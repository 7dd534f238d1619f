"""The frontend as a process: frames from a source, keyframes and segments into the ledger (DESIGN sections 3.2 and 4).

Everything that it sends is acknowledged and idempotent. A restarted frontend of a file begins at frame 0 again and
sends the same records, which the ledger recognises; that of a live camera begins a new epoch.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.bus import codec
from vggt_motion.bus.images import ImageHeader, encode_image
from vggt_motion.bus.jobs import one_line
from vggt_motion.bus.ledger import append_request
from vggt_motion.bus.logs import is_told
from vggt_motion.bus.pubsub import Publisher
from vggt_motion.bus.retry import retry
from vggt_motion.bus.service import ServiceContext, run_service
from vggt_motion.config import Config
from vggt_motion.errors import (
    BusError,
    BusUnavailableError,
    DiskFullError,
    InputError,
    RefusalCode,
    RequestRefusedError,
    SourceError,
    SourceTruncatedError,
    VggtMotionError,
)
from vggt_motion.frontend.pipeline import FrontendPipeline, KeyframeOutput, Output
from vggt_motion.frontend.sender import LedgerSender
from vggt_motion.frontend.spool import Spool
from vggt_motion.records import BlobRef, Event, EventKind, MotionState, Stream
from vggt_motion.sources.encoded import PNG
from vggt_motion.sources.registry import is_on_bus, open_source
from vggt_motion.sources.selection import Selection
from vggt_motion.sources.source import Frame, Source, losses_of
from vggt_motion.sources.zenoh import open_zenoh

_log = logging.getLogger(__name__)

SESSION_STARTED_ID = "session_started"
STREAM_ENDED_ID = "stream_ended"

_IMAGE_ENCODING = "application/protobuf;foxglove.CompressedImage"
_HISTORY_FRAMES = 64  # for a recorder that joins late or loses its link for a moment
_REPORT_S = 0.2
_DISK_RETRY_S = 1.0
_SPOOL_POLL_S = 0.5
_SILENT_S = 2.0  # a live camera without a frame for so long has stalled, and the status says so
_RATE_FRAMES = 32  # frames over which the rate is measured that turns a delay in frames into seconds
_WARNING_PATIENCE_S = 10.0


def main(
    config: Config,
    *,
    source: str,
    start: int = 0,
    end: int | None = None,
    stride: int = 1,
    ego_mask: Path | None = None,
) -> int:
    """Run the frontend until its source ends or it is told to stop.

    Returns:
        Exit code: 0, 2 when no frame is readable, 3 when the source ended early.
    """

    def body(context: ServiceContext) -> None:
        # DIS and the decoders gain nothing from threads at these sizes, and the other services need the cores
        cv2.setNumThreads(1)
        mask = None if ego_mask is None else EgoMask(ego_mask)
        opened = _open(config, source, Selection(start, end, stride, config.run.nominal_rate_hz))
        with contextlib.closing(opened), _closed_on_stop(opened, context.stopping):
            _Frontend(context, opened, mask, publishes_frames=not is_on_bus(source)).run()

    return run_service("frontend", config, body)


def _open(config: Config, location: str, selection: Selection) -> Source:
    if is_on_bus(location):
        # by itself that source would look for the bus in the environment only
        return open_zenoh(location, selection, config)
    return open_source(
        location,
        start=selection.start,
        end=selection.end,
        stride=selection.stride,
        nominal_rate_hz=selection.nominal_rate_hz,
    )


class EgoMask:
    """The mask as pixels for the pipeline and as a PNG blob for the log."""

    def __init__(self, path: Path) -> None:
        """Read an image file.

        Raises:
            InputError: it is none.
        """
        try:
            content = path.read_bytes()
        except OSError as error:
            raise InputError(f"cannot read ego mask {path}: {error.strerror or error}") from error
        pixels = None
        with contextlib.suppress(cv2.error):  # empty, or larger than OpenCV may decode
            pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)
        if pixels is None:
            raise InputError(f"ego mask {path} is not a readable image")
        self.pixels: npt.NDArray[np.uint8] = np.asarray(pixels, np.uint8)  # (H, W), non-zero = never to be used
        self.png: bytes = cv2.imencode(".png", self.pixels)[1].tobytes()
        self.ref: BlobRef = codec.blob_ref(self.png, PNG)


class _Frontend:
    """Wires a source and the pure pipeline to the bus."""

    def __init__(
        self, context: ServiceContext, source: Source, mask: EgoMask | None, *, publishes_frames: bool
    ) -> None:
        self._context = context
        self._source = source
        self._mask = mask
        self._camera = context.config.run.camera
        self._publisher: Publisher | None = None
        if publishes_frames:
            self._publisher = context.bus.publisher(
                context.bus.keys.image(self._camera),
                blocking=not source.is_live,
                history=_HISTORY_FRAMES,
                encoding=_IMAGE_ENCODING,
            )
        self._thinned_count = 0
        self._unreadable_count = 0
        self._thin_until_ns: int | None = None
        self._newest_time_ns = 0
        self._capture_times_ns: deque[int] = deque(maxlen=_RATE_FRAMES)
        self._waiting_since: float | None = None  # for the source's next frame
        self._sender: LedgerSender | None = None
        self._outbox: _Outbox | None = None
        if source.is_live:
            self._outbox = _Outbox(context, self._camera)
            self._outbox.send_all()  # of a process before this one, and then the log says where it was
        elif (
            context.config.frontend.disk_policy == "wait"
        ):  # who lets frames go by must know at once that the disk is full
            self._sender = LedgerSender(context.ledger, lambda error: context.set_health("waiting", str(error)))
        self._epoch, first_segment = self._take_up() if source.is_live else (0, 0)
        self._pipeline = FrontendPipeline(
            context.config.frontend,
            self._camera,
            self._epoch,
            None if mask is None else mask.pixels,
            None if mask is None else mask.ref,
            first_segment=first_segment,
        )
        self._next_report = 0.0

    def run(self) -> None:
        """Send everything; raises SourceTruncatedError at the very end when the source ended early."""
        self._send_started()
        truncation: SourceTruncatedError | None = None
        is_over = threading.Event()
        if self._source.is_live:
            threading.Thread(target=self._watch, args=(is_over,), name="watch", daemon=True).start()
        try:
            for frame in self._arriving():
                if self._context.stopping.is_set():
                    return
                if self._is_thinned(frame):
                    continue
                try:
                    with self._context.numerics:
                        outputs = self._pipeline.push(frame)
                except (SourceError, SourceTruncatedError) as error:
                    if not self._source.is_live:
                        raise
                    self._refuse(error)  # one bad message must not end a camera's session
                    continue
                self._publish(frame)
                self._send(outputs)
                self._report("working")
        except SourceTruncatedError as error:
            truncation = error
        except SourceError:
            self._flush()
            raise
        finally:
            is_over.set()
        if self._context.stopping.is_set():
            return  # a live source that we closed, not one that ended
        with self._context.numerics:
            last = self._pipeline.finish()
        self._send(last)
        self._flush()
        self._send_ended(truncation)
        if self._outbox is not None:
            self._outbox.send_all()
        self._report("ended", is_due=True)
        if truncation is not None:
            raise truncation

    def _flush(self) -> None:
        """Return when all that was passed on is acknowledged."""
        if self._sender is not None and not self._context.stopping.is_set():
            self._sender.flush()

    def _arriving(self) -> Iterator[Frame]:
        """The source's frames; while one is waited for, that is known."""
        self._waiting_since = time.monotonic()
        frames = iter(self._source.frames())
        while True:
            with self._context.numerics:
                frame = next(frames, None)
            if frame is None:
                return
            self._waiting_since = None
            self._capture_times_ns.append(frame.capture_time_ns)
            yield frame
            self._waiting_since = time.monotonic()

    def _watch(self, is_over: threading.Event) -> None:
        """Count for the status while no frame of a live camera comes or none is taken, and say when it has stalled."""
        while not is_over.wait(_REPORT_S):
            self._context.set_counters(**self._counters())
            since = self._waiting_since
            if since is None or (silent_s := time.monotonic() - since) < _SILENT_S:
                continue
            detail = f"no frame comes from {self._source.description}"
            self._context.set_health("waiting", detail, silent_s=round(silent_s, 1))

    def _frame_interval_s(self) -> float | None:
        """As measured over the last frames: the rate of a live camera changes, and the bus knows none."""
        times = self._capture_times_ns
        if len(times) > 1:
            return (times[-1] - times[0]) * 1e-9 / (len(times) - 1)
        return None if self._source.frame_rate_hz is None else 1.0 / self._source.frame_rate_hz

    def _take_up(self) -> tuple[int, int]:
        """Epoch and first segment index of a live camera: after what an earlier process of it left in the log."""
        ledger = self._context.ledger
        epoch = first_segment = 0
        for stream in (Stream.EVENT, Stream.SEGMENT):
            position = 0
            while entries := ledger.read(stream, position, patience_s=self._context.config.bus.connect_timeout_s):
                position += len(entries)
                if stream is Stream.EVENT:
                    epoch += sum(entry.record_id.startswith(SESSION_STARTED_ID) for entry in entries)
            if stream is Stream.SEGMENT:
                first_segment = position
        return epoch, first_segment

    def _send_started(self) -> None:
        detail = {"source": self._source.description, "fingerprint": self._source.fingerprint}
        event_id = SESSION_STARTED_ID if self._epoch == 0 else f"{SESSION_STARTED_ID}/{self._epoch}"
        message = one_line(self._source.description)
        event = Event(event_id, EventKind.SESSION_STARTED, message, time.time_ns(), detail)
        try:
            self._append(Stream.EVENT, event_id, event)
        except RequestRefusedError as error:
            # a session that is continued may name its source in another way (a relative path); the fingerprint decides
            if error.code is not RefusalCode.CONFLICT or not self._is_known_source(event_id):
                raise

    def _is_known_source(self, event_id: str) -> bool:
        entries = self._context.ledger.read(Stream.EVENT, 0)
        known = next((codec.decode(Event, entry.payload) for entry in entries if entry.record_id == event_id), None)
        if known is None:
            return False
        if known.detail.get("fingerprint") != self._source.fingerprint:
            raise InputError(f"the session holds another source: {known.detail.get('source', 'unknown')}")
        return True

    def _send_ended(self, truncation: SourceTruncatedError | None) -> None:
        detail = {
            "frame_count": str(self._pipeline.frame_count),
            "segment_count": str(self._pipeline.segment_count),
        }
        if truncation is not None:
            detail["truncated"] = str(truncation)
        message = one_line(detail.get("truncated", ""))
        event = Event(STREAM_ENDED_ID, EventKind.STREAM_ENDED, message, time.time_ns(), detail)
        self._append(Stream.EVENT, STREAM_ENDED_ID, event)

    def _publish(self, frame: Frame) -> None:
        if self._publisher is not None:
            self._publisher.put(
                encode_image(frame, self._camera),
                timestamp_ns=time.time_ns(),
                attachment=ImageHeader(self._epoch, frame.index).encode(),
            )

    def _send(self, outputs: Sequence[Output]) -> None:
        for output in outputs:
            if isinstance(output, KeyframeOutput):
                keyframe = output.keyframe
                self._pass_on(Stream.KEYFRAME, keyframe.keyframe_id, keyframe, [output.encoded])
            else:
                segment = output.segment
                # the ledger knows the mask from the first segment on; it is small, and a restart must not forget it
                blobs = [] if self._mask is None else [self._mask.png]
                self._pass_on(Stream.SEGMENT, segment.record_id, segment, blobs)

    def _pass_on(self, stream: Stream, record_id: str, record: codec.Record, blobs: Sequence[bytes]) -> None:
        """Have a record appended, after those before it."""
        if self._sender is None:
            self._append(stream, record_id, record, blobs)
        else:
            self._sender.put(stream, record_id, record, blobs)

    def _append(self, stream: Stream, record_id: str, record: codec.Record, blobs: Sequence[bytes] = ()) -> None:
        """Append, waiting for ledger, link and space for as long as it takes; nothing is left out."""
        if self._outbox is not None:
            self._outbox.put(codec.encode(append_request(stream, record_id, record, blobs)))
            return
        since: float | None = None
        while True:
            try:
                self._context.ledger.append(stream, record_id, record, blobs)
                break
            except DiskFullError as error:
                since = since or time.monotonic()
                self._context.set_health("waiting", str(error))
                if self._context.stopping.wait(_DISK_RETRY_S):
                    raise
        if since is not None and self._context.config.frontend.disk_policy == "thin":
            self._thin_until_ns = self._newest_time_ns + round(1e9 * (time.monotonic() - since))

    def _refuse(self, error: VggtMotionError) -> None:
        self._unreadable_count += 1
        if is_told(self._unreadable_count):
            _log.warning("frame refused", extra={"count": self._unreadable_count, "reason": str(error)})
        self._report("working")

    def _is_thinned(self, frame: Frame) -> bool:
        """Whether a frame of a file goes by, as a camera's would have while the ledger had no space."""
        if self._thin_until_ns is not None and frame.capture_time_ns < self._thin_until_ns:
            self._thinned_count += 1
            return True
        self._thin_until_ns = None
        self._newest_time_ns = frame.capture_time_ns
        return False

    def _counters(self) -> dict[str, float]:
        pipeline = self._pipeline
        return {
            "frames": pipeline.frame_count,
            "keyframes": pipeline.keyframe_count,
            "segments": pipeline.segment_count,
            "static_frames": pipeline.state_counts[MotionState.STATIC],
            "turning_frames": pipeline.state_counts[MotionState.TURNING],
            "linear_frames": pipeline.state_counts[MotionState.LINEAR],
            "thinned_frames": self._thinned_count,
            "unreadable_frames": self._unreadable_count,
            **({} if self._outbox is None else self._outbox.counters()),
            **losses_of(self._source),
        }

    def _report(self, state: str, *, is_due: bool = False) -> None:
        now = time.monotonic()
        if not is_due and now < self._next_report:
            return
        self._next_report = now + _REPORT_S
        delay = self._pipeline.lookahead_frames
        interval_s = self._frame_interval_s()
        self._context.set_health(
            state,
            self._source.description,
            smoothing_delay_frames=delay,
            **({} if interval_s is None else {"smoothing_delay_s": delay * interval_s}),
            **({"silent_s": 0.0} if self._source.is_live else {}),
            **self._counters(),
        )


class _Outbox:
    """Sends requests to the ledger in a thread of its own, through the spool."""

    def __init__(self, context: ServiceContext, camera: str) -> None:
        self._context = context
        root = context.config.spool.directory or Path.home() / ".vggt-motion" / "spool"
        patience_s = context.config.bus.connect_timeout_s
        status = retry(context.bus, context.ledger.status, patience_s=patience_s, what="the ledger's status")
        # What waits for one ledger is nothing to another that stands under the same session.
        folder = root / context.config.bus.session / camera
        for other in sorted(folder.glob("*/*.request")):
            if other.parent.name != status.ledger_id:
                _log.warning("records for another ledger are left waiting", extra={"folder": str(other.parent)})
                break
        self._spool = Spool(
            folder / (status.ledger_id or "unknown"),
            context.config.spool.max_bytes,
            context.config.ledger.reserve_bytes,
        )
        self._failure: VggtMotionError | None = None
        self._full_count = 0
        self._refused_count = 0
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def counters(self) -> dict[str, float]:
        return {
            "spooled_records": self._spool.count,
            "spooled_bytes": self._spool.size_bytes,
            "spool_full_waits": self._full_count,
            "refused_records": self._refused_count,
        }

    def put(self, request: bytes) -> None:
        """Returns when the request is on disk; a full spool holds up the source, whose frames go by meanwhile."""
        is_full = False
        while not self._spool.put(request, _SPOOL_POLL_S):
            self._check()
            if self._context.stopping.is_set():
                raise BusUnavailableError("told to stop while the spool or its disk is full: the newest record is lost")
            if not is_full:
                is_full = True
                self._full_count += 1
            self._context.set_health("waiting", "the spool or its disk is full: frames go by", **self.counters())
        self._check()

    def send_all(self) -> None:
        """Wait until everything is acknowledged; told to stop, leave the rest to the next frontend."""
        while not self._spool.wait_until_empty(_SPOOL_POLL_S) and not self._context.stopping.is_set():
            self._context.set_counters(**self.counters())
            self._check()

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        while not self._context.stopping.is_set():
            request = self._spool.first(_SPOOL_POLL_S)
            if request is None:
                continue
            try:
                self._context.ledger.append_encoded(request, what="from the spool")
                self._spool.drop_first()
            except DiskFullError as error:
                self._context.set_health("waiting", str(error), **self.counters())
                self._context.stopping.wait(_DISK_RETRY_S)
            except BusUnavailableError:
                return  # told to stop
            except RequestRefusedError as error:
                if error.code is RefusalCode.INTERNAL:  # a defect over there: it may pass, the record is kept
                    self._context.set_health("waiting", str(error), **self.counters())
                    self._context.stopping.wait(_DISK_RETRY_S)
                else:
                    self._set_aside(error)
            except VggtMotionError as error:
                self._failure = error
                return

    def _set_aside(self, error: RequestRefusedError) -> None:
        """Keep what is refused for good, tell of it in the log, and go on: it must not hold up what comes after it."""
        try:
            kept = self._spool.set_first_aside()
        except InputError as problem:
            self._failure = problem
            return
        self._refused_count += 1
        reason = one_line(f"a record of the camera was refused: {error}")
        _log.error("a record was refused and set aside", extra={"kept": str(kept), "reason": str(error)})
        event = Event(f"record_refused/{kept.stem}", EventKind.WARNING, reason, time.time_ns(), {"kept": str(kept)})
        with contextlib.suppress(BusError, DiskFullError):
            self._context.ledger.append(Stream.EVENT, event.event_id, event, patience_s=_WARNING_PATIENCE_S)


@contextlib.contextmanager
def _closed_on_stop(source: Source, stopping: threading.Event) -> Iterator[None]:
    """A live source that waits for its next frame is closed when the service is told to stop."""
    is_over = threading.Event()

    def watch() -> None:
        while not is_over.is_set():
            if stopping.wait(_REPORT_S):
                source.close()
                return

    if source.is_live:
        threading.Thread(target=watch, name="stop-watch", daemon=True).start()
    try:
        yield
    finally:
        is_over.set()
