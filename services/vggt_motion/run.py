"""The command ``vggt-motion run``: what was there before, live progress, results, and the summary at the end."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from vggt_motion import launch, results
from vggt_motion.bus.jobs import JobClient
from vggt_motion.bus.ledger import LedgerClient
from vggt_motion.bus.retry import retry
from vggt_motion.bus.session import Bus
from vggt_motion.errors import DiskFullError, InputError, LedgerError, RequestRefusedError, SourceTruncatedError
from vggt_motion.geometry.track import PoseTrack
from vggt_motion.ledger.directory import locked, stored_blob
from vggt_motion.ledger.sessions import SessionState, prepare_session, remove_session
from vggt_motion.records import BlobRef, Event, EventKind, JobReport, JobState, MotionState, Stream

_Outcome = TypeVar("_Outcome")
INTERRUPTED_EXIT_CODE = 130
_DISK_RETRY_S = 1.0
_INTERRUPTED_PATIENCE_S = 15.0
_PATIENCE_S = 120.0  # a ledger that is killed now is started again, or the run is ended as a crash loop
_RESULTS = (
    results.METRICS_FILE,
    "trajectory_keyframes.tum",
    "trajectory_frames.tum",
    "trajectory_frames.kitti",
    "trajectory_frames.csv",
    "report.html",
)
_FILES = (*_RESULTS, launch.CONFIG_FILE, "map.ply", "run.mcap")
_STATE_NAMES = {MotionState.STATIC: "standing", MotionState.TURNING: "turning", MotionState.LINEAR: "straight"}


def run_to_results(request: launch.RunRequest, *, ground_truth: Path | None, fresh: bool) -> int:
    """Run a source to its results, continue an unfinished run, or show a finished one again.

    Args:
        request: what to run.
        ground_truth: trajectory to compare with.
        fresh: discard what an earlier run left in the folder.

    Returns:
        The exit code: 0; 3 when the input ended early; 130 after Ctrl-C.

    Raises:
        InputError: nothing can be made of this source, or the folder belongs to another run.
        VggtMotionError: a service could not be kept running.
    """
    reference = results.read_ground_truth(ground_truth) if ground_truth is not None else None
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    run = launch.LocalRun(request)
    finished = _claim_folder(request, run, fresh=fresh)
    if finished is not None and (reference is None or "ground_truth" in finished):
        console.print(f"This run is finished already (in {escape(str(request.out))}); --fresh runs it again.")
        _summarise(console, request.out, finished)
        return int(finished["exit_code"])

    metrics: dict[str, Any] = {}

    def finish(outcome: launch.RunOutcome, bus: Bus) -> None:
        write = functools.partial(_write_results, request, run, outcome, bus, reference)
        metrics.update(_with_space(write, bus, console, "Waiting to write the results"))
        if metrics["is_complete"]:
            event = Event("run_ended", EventKind.RUN_ENDED, "the run ended by itself", time.time_ns())
            append = functools.partial(LedgerClient(bus).append, Stream.EVENT, event.event_id, event)
            _with_space(append, bus, console, "The results are written. Waiting to close the session")

    with _display(console, run.source_description) as on_progress:
        outcome = run.execute(on_progress, finish)
    if metrics["frame_count"] < launch.MIN_FRAMES and not outcome.interrupted:
        raise InputError(metrics["truncated"] or launch.TOO_FEW_FRAMES)
    _summarise(console, request.out, metrics)
    if outcome.interrupted:
        console.print("Interrupted. The same command continues from here.")
        return INTERRUPTED_EXIT_CODE
    if outcome.exit_code == SourceTruncatedError.exit_code:
        console.print(f"The input ended early: {escape(metrics['truncated'])}")
    if metrics["exit_code"] == InputError.exit_code:
        raise InputError(f"no trajectory can be made of this input: {next(iter(metrics['warnings']), 'no submap')}")
    return outcome.exit_code


def _with_space(work: Callable[[], _Outcome], bus: Bus, console: Console, what: str) -> _Outcome:
    """What ``work`` returns; without space on the disk, as soon as there is some."""
    is_told = False
    while True:
        try:
            return work()
        except DiskFullError as error:
            if not is_told:
                is_told = True
                console.print(f"{what}: {escape(str(error))}")
            if bus.wait(_DISK_RETRY_S):
                raise


def _claim_folder(request: launch.RunRequest, run: launch.LocalRun, *, fresh: bool) -> dict[str, Any] | None:
    """Make the folder this run's; the metrics of the run where it is finished already.

    Raises:
        InputError: the folder cannot be written, or holds another run.
        LedgerError: the folder is in use, or its ledger is damaged.
    """
    ledger, metrics_file = request.out / launch.LEDGER_FOLDER, request.out / results.METRICS_FILE
    try:
        if fresh:
            remove_session(ledger)
            shutil.rmtree(request.out / launch.SPOOL_FOLDER, ignore_errors=True)
            for name in _FILES:
                (request.out / name).unlink(missing_ok=True)
        state = prepare_session(ledger, run.identity)
        with locked(ledger):
            pass  # in use by another run: said now, in one line
        if state is not SessionState.FINISHED:
            return None
        if not all((request.out / name).exists() for name in _RESULTS):
            return None  # what is gone is made again from the ledger
        with contextlib.suppress(ValueError):
            metrics: dict[str, Any] = json.loads(metrics_file.read_text(encoding="utf-8"))
            return metrics
        return None
    except OSError as error:
        raise InputError(f"cannot write to {request.out}: {error.strerror or error}") from error


def _write_results(
    request: launch.RunRequest,
    run: launch.LocalRun,
    outcome: launch.RunOutcome,
    bus: Bus,
    reference: PoseTrack | list[PoseTrack] | None,
) -> dict[str, Any]:
    # After Ctrl-C what can be had soon must do.
    patience_s = _INTERRUPTED_PATIENCE_S if outcome.interrupted else _PATIENCE_S
    dead_jobs: list[JobReport] = []
    if outcome.state.dead_jobs:
        ask = functools.partial(JobClient(bus).reports, JobState.DEAD)
        dead_jobs = retry(bus, ask, patience_s=patience_s, what="the jobs that were given up")
    facts = results.RunFacts(
        source=run.source_description,
        exit_code=INTERRUPTED_EXIT_CODE if outcome.interrupted else outcome.exit_code,
        interrupted=outcome.interrupted,
        wall_seconds=outcome.seconds,
        start_up_seconds=outcome.start_up_seconds,
        restart_count=outcome.restart_count,
        predictor=run.config.inference.predictor,
        predictor_reason=run.config.inference.predictor_reason,
        first_frame=request.start,
        stride=request.stride,
        dead_jobs=tuple(dead_jobs),
        missing_frame_count=outcome.missing_frame_count,
    )
    load_blob = functools.partial(
        _read_blob, request.out / launch.LEDGER_FOLDER, LedgerClient(bus), patience_s=patience_s
    )
    return results.write_results(request.out, outcome.state, run.config, facts, load_blob, reference)


def _read_blob(folder: Path, ledger: LedgerClient, ref: BlobRef, *, patience_s: float) -> bytes:
    """A payload from the folder, which is ours; where that does not work just now, from the ledger."""
    with contextlib.suppress(LedgerError, RequestRefusedError):
        data = stored_blob(folder, ref.sha256)
        if hashlib.sha256(data).hexdigest() == ref.sha256:
            return data
    return ledger.blob(ref, patience_s=patience_s)


@contextlib.contextmanager
def _display(console: Console, source: str) -> Iterator[Callable[[launch.Progress], None]]:
    """A bar over the frames with what has come of them; plain lines where the output is no terminal."""
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[what]}"),
        console=console,
        disable=not console.is_terminal,
        transient=True,
    )
    last = {"text": ""}
    console.print(escape(source))
    with bar:
        task = bar.add_task("starting", total=None, what="")

        def show(progress: launch.Progress) -> None:
            state = _STATE_NAMES[progress.state] if progress.state is not None else ""
            text = (
                f"{progress.frames} frames, {progress.keyframes} keyframes, "
                f"{progress.submaps}/{progress.segments} submaps, {progress.constraints} constraints, "
                f"lag {progress.lag_submaps}"
            )
            if progress.dead_jobs:
                text += f", {progress.dead_jobs} jobs given up"
            if progress.waiting:
                text += f"; waiting: {progress.waiting}"
            bar.update(
                task,
                description=state or "running",
                total=progress.segments * 2 or None if progress.is_input_complete else None,
                completed=progress.submaps + progress.constraints,
                what=text,
            )
            if not console.is_terminal and text != last["text"]:
                console.print(text)
                last["text"] = text

        yield show


def _summarise(console: Console, out: Path, metrics: dict[str, Any]) -> None:
    length = next(((name, value) for name, value in metrics.items() if name.startswith("path_length_")), None)
    rows = [
        ("frames", f"{metrics['frame_count']}, of them {metrics['keyframe_count']} keyframes"),
        (
            "submaps",
            f"{metrics['submap_count']} of {metrics['segment_count']} ("
            + ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in metrics["submaps"].items())
            + f"), {metrics['accepted_constraint_count']} constraints, {metrics['break_count']} breaks",
        ),
    ]
    if length is not None:
        rows.append(("path", f"{length[1]:.2f} {length[0].removeprefix('path_length_')}"))
    if metrics.get("focal_over_width") is not None:
        rows.append(("focal length", f"{metrics['focal_over_width']:.3f} image widths"))
    truth = metrics.get("ground_truth")
    if truth is not None and "not_evaluated" in truth:
        rows.append(("ground truth", f"not compared: {truth['not_evaluated']}"))
    elif truth is not None:
        rows.append(
            (
                "ATE",
                f"{truth['ate_rmse_m']:.3f} m RMSE over {truth['reference_length_m']:.1f} m "
                f"({truth['matched_pose_count']} of {truth['reference_pose_count']} frames, Sim(3) aligned), "
                f"drift {truth['drift_ate_percent']:.2f} %",
            )
        )
    rows.append(("time", f"{metrics['wall_seconds']:.1f} s, of them {metrics['start_up_seconds']:.1f} s start-up"))
    rows.append(("results", str(out)))
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        console.print(f"[bold]{name:<{width}}[/bold]  {escape(value)}")
    for line in metrics["warnings"]:
        console.print(f"[yellow]warning[/yellow]: {escape(line)}")
