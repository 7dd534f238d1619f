"""All services of one session on this machine, for ``vggt-motion run`` (DESIGN section 4)."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType

from vggt_motion.backend.state import LogState
from vggt_motion.bus.ledger import LedgerClient
from vggt_motion.bus.liveliness import ServiceWatch
from vggt_motion.bus.log import LogFollower
from vggt_motion.bus.session import Bus, open_bus
from vggt_motion.config import BusConfig, Config
from vggt_motion.errors import BusError, BusUnavailableError, InputError, VggtMotionError
from vggt_motion.gateway.security import check_exposure
from vggt_motion.inference.registry import choose_predictor
from vggt_motion.ledger.sessions import SessionIdentity
from vggt_motion.records import HealthReport, MotionState, Stream
from vggt_motion.sources.registry import open_source
from vggt_motion.sources.source import Source
from vggt_motion.supervise import ServiceCommand, Supervisor

_log = logging.getLogger(__name__)
_TICK_S = 0.05
_SUPERVISE_S = 0.5
_FINISHING_S = 0.1  # what is left is said by the recorder's health, which wakes nobody
_STATUS_INTERVAL_S = 0.5
_START_TIMEOUT_S = 60.0
_RECORDER_TIMEOUT_S = 30.0
_REST_TIMEOUT_S = 5.0
_RECORDER_QUIET_S = 4.0  # no frame for so long: no more will come
_LOG_PATIENCE_S = 10.0  # what the frontend appended last is seen here after this at the latest
CONFIG_FILE = "config.yaml"
LEDGER_FOLDER = "ledger"
LOG_FOLDER = "logs"
SPOOL_FOLDER = "spool"
_METHOD_SECTIONS = ("frontend", "inference", "registration", "loops", "backend")
MIN_FRAMES = 2
TOO_FEW_FRAMES = "the source has only one frame: a trajectory needs at least two"


@dataclass(frozen=True)
class RunRequest:
    """What the user asked for."""

    source: str
    out: Path
    config: Config
    start: int = 0
    end: int | None = None
    stride: int = 1
    ego_mask: Path | None = None


@dataclass(frozen=True)
class Progress:
    """What the display shows."""

    frame_count: int | None  # of the source, None = unknown
    frames: int
    keyframes: int
    segments: int
    submaps: int
    constraints: int
    state: MotionState | None
    lag_submaps: int  # closed segments that have no submap yet
    dead_jobs: int
    is_input_complete: bool
    waiting: str  # why frontend or recorder do not go on at this moment; mostly empty


@dataclass(frozen=True)
class RunOutcome:
    """How the run ended; the log is folded into ``state``."""

    state: LogState
    exit_code: int
    interrupted: bool
    seconds: float
    start_up_seconds: float
    restart_count: int
    missing_frame_count: int  # that went by while no recorder was there


def session_identity(request: RunRequest, source: Source) -> SessionIdentity:
    """What makes two runs the same one: the input, the part of it, and everything that decides the result."""
    config = with_chosen_predictor(request.config)
    mask = hashlib.sha256(request.ego_mask.read_bytes()).hexdigest() if request.ego_mask is not None else None
    method = {
        "selection": [request.start, request.end, request.stride],
        "ego_mask": mask,
        "camera": config.run.camera,
        **{
            name: getattr(config, name).model_dump(mode="json", exclude={"predictor_reason"})
            for name in _METHOD_SECTIONS
        },
    }
    digest = hashlib.sha256(json.dumps(method, sort_keys=True).encode()).hexdigest()
    return SessionIdentity(source.description, source.fingerprint, digest)


def keep_port() -> socket.socket:
    """A socket on a free TCP port of loopback that keeps it for us: bound, and never listening.

    A listener that sets SO_REUSEADDR, as Zenoh's does, may join it; but the system gives the port to nobody else who
    asks for any, be it another run, or the near end of a connection.
    """
    keeper = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    keeper.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    keeper.bind(("127.0.0.1", 0))
    return keeper


def check_port(host: str, port: int) -> None:
    """Raise InputError with one clear line when the gateway's port cannot be had."""
    if port == 0:
        return
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise InputError(
                f"port {port} on {host} cannot be used for the gateway ({error.strerror}): "
                f"choose another one with --set gateway.port=N, or 0 for any"
            ) from error


def with_endpoint(config: Config, kept_port: socket.socket) -> Config:
    """The configuration with this port for the router, unless the user chose one."""
    if config.bus.endpoint != BusConfig.model_fields["endpoint"].default:
        return config
    bus = config.bus.model_copy(update={"endpoint": f"tcp/127.0.0.1:{kept_port.getsockname()[1]}"})
    return config.model_copy(update={"bus": bus})


def with_chosen_predictor(config: Config) -> Config:
    """The configuration with ``auto`` replaced by a name, so that all workers offer the same predictor."""
    name, reason = choose_predictor(config.inference)
    inference = config.inference.model_copy(update={"predictor": name, "predictor_reason": reason})
    return config.model_copy(update={"inference": inference})


def service_commands(request: RunRequest, config_file: Path) -> list[ServiceCommand]:
    """The processes of a run, in the order in which to start them."""
    config = request.config
    common = ("--config", str(config_file))
    ledger = str(request.out / LEDGER_FOLDER)
    commands = [
        ServiceCommand("router", "router", ("router", *common), tier=0),
        ServiceCommand("ledger", "ledger", ("ledger", *common, "--directory", ledger), tier=1),
    ]
    if config.recorder.enabled:
        recorder = ("recorder", *common, "--directory", str(request.out))
        commands.append(ServiceCommand("recorder", "recorder", recorder, tier=2))
    for name, count in (
        ("inference", config.run.inference_workers),
        ("registration", config.run.registration_workers),
        ("backend", 1),
        ("gateway", 1),
    ):
        for number in range(count):
            label = name if count == 1 else f"{name}-{number}"
            commands.append(ServiceCommand(name, label, (name, *common), tier=3))
    frontend = ["frontend", *common, "--source", request.source]
    frontend += ["--start", str(request.start), "--stride", str(request.stride)]
    if request.end is not None:
        frontend += ["--end", str(request.end)]
    if request.ego_mask is not None:
        frontend += ["--ego-mask", str(request.ego_mask)]
    commands.append(ServiceCommand("frontend", "frontend", tuple(frontend), tier=4, ends_by_itself=True))
    return commands


class LocalRun:
    """One session with all its processes on this machine."""

    def __init__(self, request: RunRequest) -> None:
        """Check what can be checked before anything is started; writes nothing.

        Raises:
            InputError: the source, the mask or the gateway's port cannot be used.
        """
        source = open_source(request.source, start=request.start, end=request.end, stride=request.stride)
        self.source_description = source.description
        self._frame_count = source.frame_count
        source.close()
        if self._frame_count is not None and self._frame_count < MIN_FRAMES:
            raise InputError(TOO_FEW_FRAMES)
        if request.ego_mask is not None and not request.ego_mask.is_file():
            raise InputError(f"no ego mask at {request.ego_mask}")
        self.identity = session_identity(request, source)
        check_exposure(request.config.gateway)
        check_port(request.config.gateway.host, request.config.gateway.port)
        self._kept_port = keep_port()
        config = with_chosen_predictor(with_endpoint(request.config, self._kept_port))
        if config.spool.directory is None:
            spool = config.spool.model_copy(update={"directory": request.out.absolute() / SPOOL_FOLDER})
            config = config.model_copy(update={"spool": spool})
        self._request = replace(request, config=config)
        self._interrupts = 0

    @property
    def config(self) -> Config:
        """The effective configuration."""
        return self._request.config

    def execute(self, on_progress: Callable[[Progress], None], finish: Callable[[RunOutcome, Bus], None]) -> RunOutcome:
        """Run to the end, or until Ctrl-C.

        Args:
            on_progress: called twice a second.
            finish: called with the outcome while the ledger still answers.

        Raises:
            InputError: the output folder cannot be written, or a service refused its input.
            VggtMotionError: a service keeps crashing.
        """
        request, config = self._request, self.config
        config_file = request.out / CONFIG_FILE
        try:
            for folder in (LEDGER_FOLDER, LOG_FOLDER):
                (request.out / folder).mkdir(parents=True, exist_ok=True)
            config_file.write_text(config.to_yaml(), encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot write to {request.out}: {error.strerror or error}") from error
        token = config.gateway.token
        environment = {"VGGT_MOTION_GATEWAY__TOKEN": token} if token is not None else {}
        commands = service_commands(request, config_file)
        begin = time.monotonic()
        with (
            self._kept_port,
            self._interruptible(),
            Supervisor(commands, request.out / LOG_FOLDER, environment) as supervisor,
        ):
            supervisor.start([command.label for command in commands if command.name != "frontend"])
            bus = self._join(supervisor)
            try:
                watch = ServiceWatch(bus, reports_of=("frontend", "recorder"))
                self._wait_for(supervisor, watch, commands)
                start_up_seconds = time.monotonic() - begin
                supervisor.start(["frontend"])
                state = self._follow(supervisor, bus, watch, on_progress)
                outcome = RunOutcome(
                    state=state,
                    exit_code=supervisor.exit_code("frontend") or 0,
                    interrupted=self._interrupts > 0,
                    seconds=time.monotonic() - begin,
                    start_up_seconds=start_up_seconds,
                    restart_count=supervisor.restart_count,
                    missing_frame_count=self._missing_frame_count(state, watch),
                )
                with _supervised(supervisor, bus):
                    finish(outcome, bus)
            finally:
                bus.close()
        return outcome

    @contextlib.contextmanager
    def _interruptible(self) -> Iterator[None]:
        def interrupt(_: int, __: FrameType | None) -> None:
            self._interrupts += 1
            if self._interrupts > 1:
                raise KeyboardInterrupt

        previous = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _join(self, supervisor: Supervisor) -> Bus:
        """Open our own session as soon as the router listens, and notice when it never will."""
        end = time.monotonic() + _START_TIMEOUT_S
        impatient = self.config.bus.model_copy(update={"connect_timeout_s": 1.0})
        while True:
            supervisor.poll()
            try:
                return open_bus(impatient)
            except BusError:
                if self._interrupts:
                    raise KeyboardInterrupt from None
                if time.monotonic() > end:
                    raise

    def _wait_for(self, supervisor: Supervisor, watch: ServiceWatch, commands: list[ServiceCommand]) -> None:
        """Wait until all services but the frontend are alive, so that nothing that it sends is missed."""
        wanted = {command.name for command in commands} - {"frontend", "router"}
        end = time.monotonic() + _START_TIMEOUT_S
        while not self._interrupts:
            alive = {service for service, _ in watch.services()}
            if wanted <= alive:
                return
            supervisor.poll()
            if time.monotonic() > end:
                raise VggtMotionError(f"not ready after {_START_TIMEOUT_S:.0f} s: {', '.join(sorted(wanted - alive))}")
            time.sleep(_TICK_S)

    def _follow(
        self, supervisor: Supervisor, bus: Bus, watch: ServiceWatch, on_progress: Callable[[Progress], None]
    ) -> LogState:
        """Fold the log until the final graph is there and the recorder has it all, or until Ctrl-C."""
        state = LogState()
        follower = LogFollower(bus)
        recorded = _RecorderProgress(watch, is_enabled=self.config.recorder.enabled)
        next_status = 0.0
        finished_at: float | None = None
        absent_since: float | None = None
        ends: Mapping[str, int] | None = None
        try:
            while not self._interrupts:
                supervisor.poll()
                for record in follower.poll():
                    state.apply(record)
                now = time.monotonic()
                if now >= next_status:
                    next_status = now + _STATUS_INTERVAL_S
                    on_progress(self._progress(state, watch))
                is_absent = state.stream_ended is None and supervisor.exit_code("frontend") is not None
                if is_absent and absent_since is None:
                    _ask_for_ends(follower, LedgerClient(bus))
                absent_since = (absent_since or now) if is_absent else None
                if absent_since is not None and now - absent_since > _LOG_PATIENCE_S:
                    _log.warning("the frontend was ended before its input was, starting it again")
                    supervisor.start(["frontend"])
                graph = state.latest_graph()
                if graph is not None and graph.is_final and supervisor.exit_code("frontend") is not None:
                    finished_at = finished_at or now
                    # The streams are not ordered mutually, and a publication may be lost: what the graph speaks of
                    # need not be here yet.
                    ends = ends or _ask_for_ends(follower, LedgerClient(bus))
                    has_all = ends is not None and _has_come(follower, ends)
                    if has_all and recorded.is_complete(state, follower.positions(), now):
                        break
                    if recorded.waits_for_space():
                        finished_at = now
                    if has_all and now - finished_at > _RECORDER_TIMEOUT_S:
                        _log.warning("the recorder did not catch up in time; the recording may lack its end")
                        break
                follower.wait(_SUPERVISE_S if finished_at is None else _FINISHING_S)
            if self._interrupts:
                _take_in_rest(follower, state, LedgerClient(bus))
            on_progress(self._progress(state, watch))
        finally:
            follower.close()
        return state

    def _missing_frame_count(self, state: LogState, watch: ServiceWatch) -> int:
        report = watch.newest_report("recorder")
        return 0 if not self.config.recorder.enabled or report is None else _missing_frame_count(state, report)

    def _progress(self, state: LogState, watch: ServiceWatch) -> Progress:
        frontend, recorder = watch.newest_report("frontend"), watch.newest_report("recorder")
        reports = [report for report in (frontend, recorder) if report is not None]
        counters = frontend.counters if frontend is not None else {}
        newest = max(state.keyframes.values(), key=lambda keyframe: keyframe.frame_index, default=None)
        predicted = {index for index, _ in state.submaps}
        ended = state.stream_ended
        # The log is ahead of the frontend's health, which comes once a second.
        seen = max(int(counters.get("frames", 0)), newest.frame_index + 1 if newest is not None else 0)
        frames = int(ended.detail["frame_count"]) if ended is not None else seen
        return Progress(
            frame_count=self._frame_count,
            frames=frames,
            keyframes=len(state.keyframes),
            segments=len(state.segments),
            submaps=len(predicted),
            constraints=sum(1 for constraint in state.constraints.values() if constraint.accepted),
            state=newest.state if newest is not None else None,
            lag_submaps=len(state.unpredicted_segments()),
            dead_jobs=len(state.dead_jobs),
            is_input_complete=state.is_input_complete,
            waiting=next((report.detail for report in reports if report.state == "waiting"), ""),
        )


@contextlib.contextmanager
def _supervised(supervisor: Supervisor, bus: Bus) -> Iterator[None]:
    """Keep the services running while this thread is busy with the results: the ledger that it asks may be killed too.

    Raises:
        VggtMotionError: a service keeps crashing.
    """
    is_over = threading.Event()
    failure: list[VggtMotionError] = []

    def watch() -> None:
        while not is_over.wait(_SUPERVISE_S):
            try:
                supervisor.poll()
            except VggtMotionError as error:
                failure.append(error)
                bus.interrupt()  # whoever waits for the service that is given up
                return

    thread = threading.Thread(target=watch, name="supervise", daemon=True)
    thread.start()
    try:
        yield
    except BusUnavailableError as error:
        raise (failure[0] if failure else error) from None
    finally:
        is_over.set()
        thread.join()


def _missing_frame_count(state: LogState, recorder: HealthReport) -> int:
    """Frames of the input that the recorder has not; 0 while the input has not ended."""
    ended = state.stream_ended
    wanted = int(ended.detail["frame_count"]) if ended is not None else 0
    return max(0, wanted - int(recorder.counters.get("frames", 0)))


class _RecorderProgress:
    """Whether the recorder has everything that it can have."""

    def __init__(self, watch: ServiceWatch, *, is_enabled: bool) -> None:
        self._watch = watch
        self._is_enabled = is_enabled
        self._frame_count = -1.0
        self._quiet_since = 0.0

    def waits_for_space(self) -> bool:
        report = self._watch.newest_report("recorder")
        return self._is_enabled and report is not None and report.state == "waiting"

    def is_complete(self, state: LogState, positions: Mapping[Stream, int], now: float) -> bool:
        if not self._is_enabled:
            return True
        report = self._watch.newest_report("recorder")
        if report is None:
            self._frame_count = -1.0
            return False
        frame_count = report.counters.get("frames", 0.0)
        if frame_count != self._frame_count:
            self._frame_count, self._quiet_since = frame_count, now
        if any(report.counters.get(f"position_{stream.value}", 0) < position for stream, position in positions.items()):
            return False
        if not _missing_frame_count(state, report):
            return True
        # Then those that are missing went by, and the results say how many.
        return now - self._quiet_since >= _RECORDER_QUIET_S


def _take_in_rest(follower: LogFollower, state: LogState, ledger: LedgerClient) -> None:
    """Fold what the ledger has acknowledged up to now, so that an interrupted run shows all that was done."""
    end = time.monotonic() + _REST_TIMEOUT_S
    ends = _ask_for_ends(follower, ledger)
    if ends is None:
        _log.warning("the ledger did not answer any more; its last records may be missing")
        return
    while time.monotonic() < end:
        for record in follower.poll():
            state.apply(record)
        if _has_come(follower, ends):
            return
        time.sleep(_TICK_S)


def _ask_for_ends(follower: LogFollower, ledger: LedgerClient) -> Mapping[str, int] | None:
    """Have everything taken in that there is by now, though its publication be lost.

    Returns:
        Next sequence number of every stream that has records; None: the ledger does not answer.
    """
    try:
        ends = {entry.stream: entry.next_sequence for entry in ledger.status().positions}
    except BusError:
        return None
    follower.expect(ends)
    return ends


def _has_come(follower: LogFollower, ends: Mapping[str, int]) -> bool:
    """Whether every stream was taken in up to there."""
    return all(ends.get(stream.value, 0) <= position for stream, position in follower.positions().items())
