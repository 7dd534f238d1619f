"""The command ``vggt-motion``. Every error that we know ends as one clear line and an exit code (DESIGN section 5)."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import Annotated, NoReturn, TypeVar

import typer
from rich.console import Console

from vggt_motion import __version__
from vggt_motion.config import load_config
from vggt_motion.errors import InputError, SourceTruncatedError, VggtMotionError
from vggt_motion.memory import keep_freed_memory

app = typer.Typer(
    name="vggt-motion",
    help="Globally consistent trajectory and dense map from uncalibrated monocular video.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
config_app = typer.Typer(help="The configuration.", no_args_is_help=True)
app.add_typer(config_app, name="config")
ledger_app = typer.Typer(help="The ledger of a session.", no_args_is_help=True)
app.add_typer(ledger_app, name="ledger")

ConfigOption = Annotated[Path | None, typer.Option("--config", help="YAML file with any part of the configuration.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="SECTION.FIELD=VALUE", help="Set one value; may be repeated.")
]
INTERRUPTED_EXIT_CODE = 130
Value = TypeVar("Value")

SERVICES = ("router", "ledger", "frontend", "inference", "registration", "backend", "gateway", "recorder")


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version and exit.", callback=lambda on: _version(on), is_eager=True),
    ] = False,
) -> None: ...


def _version(is_wanted: bool) -> None:
    if is_wanted:
        Console().print(f"vggt-motion {__version__}", highlight=False)
        raise typer.Exit


@app.command()
def run(
    source: Annotated[str, typer.Argument(help="Image folder, KITTI folder, video file or MCAP recording.")],
    out: Annotated[Path | None, typer.Option(help="Folder for the results; default out/<name of the source>.")] = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
    start: Annotated[int, typer.Option(min=0, help="First frame to use.")] = 0,
    end: Annotated[int | None, typer.Option(min=1, help="Frame to stop before.")] = None,
    stride: Annotated[int, typer.Option(min=1, help="Use every n-th frame.")] = 1,
    ego_mask: Annotated[
        Path | None, typer.Option(help="PNG of the frames' size, non-zero over bonnet, logo or overlay.")
    ] = None,
    known_distance: Annotated[
        float | None, typer.Option(metavar="METRES", help="Travelled distance, if known: sets the scale.")
    ] = None,
    intrinsics: Annotated[
        str | None, typer.Option(metavar="FX,FY,CX,CY[,K1]", help="The camera, if known, in pixels of the images.")
    ] = None,
    ground_truth: Annotated[
        Path | None, typer.Option(help="KITTI or TUM trajectory to compare with; adds ATE, drift and an overlay.")
    ] = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="Discard what an earlier run left in the folder.")] = False,
) -> None:
    """Turn a video into a trajectory and a map, with all services on this machine."""
    from vggt_motion.launch import RunRequest
    from vggt_motion.run import run_to_results

    values = list(assignments or ())
    if known_distance is not None:
        values.append(f"backend.known_distance_m={known_distance}")
    if intrinsics is not None:
        values.extend(_intrinsics_values(intrinsics))
    request = RunRequest(
        source=source,
        out=out if out is not None else Path("out") / (Path(source).stem or "run"),
        config=load_config(config, values),
        start=start,
        end=end,
        stride=stride,
        ego_mask=ego_mask,
    )
    raise typer.Exit(run_to_results(request, ground_truth=ground_truth, fresh=fresh))


def _intrinsics_values(text: str) -> list[str]:
    names, numbers = ("fx", "fy", "cx", "cy", "k1"), text.split(",")
    if len(numbers) not in (4, 5):
        raise InputError(f"--intrinsics '{text}' is not of the form FX,FY,CX,CY or FX,FY,CX,CY,K1")
    return [f"inference.intrinsics.{name}={number.strip()}" for name, number in zip(names, numbers, strict=False)]


@app.command()
def serve(
    name: Annotated[str, typer.Argument(metavar="NAME", help=f"One of: {', '.join(SERVICES)}.")],
    config: ConfigOption = None,
    assignments: SetOption = None,
    directory: Annotated[Path | None, typer.Option(help="ledger, recorder: folder of the session.")] = None,
    source: Annotated[str | None, typer.Option(help="frontend: what to read.")] = None,
    start: Annotated[int, typer.Option(min=0, help="frontend: first frame.")] = 0,
    end: Annotated[int | None, typer.Option(min=1, help="frontend: frame to stop before.")] = None,
    stride: Annotated[int, typer.Option(min=1, help="frontend: every n-th frame.")] = 1,
    ego_mask: Annotated[Path | None, typer.Option(help="frontend: mask PNG.")] = None,
    parent_pid: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Run one service in this process; they find one another through the router at ``bus.endpoint``."""
    if name not in SERVICES:
        raise InputError(f"unknown service '{name}': known are {', '.join(SERVICES)}")
    if parent_pid is not None:
        from vggt_motion.supervise import watch_parent

        watch_parent(parent_pid)
    settings = load_config(config, list(assignments or ()))
    # Imported by need: the camera side carries neither gtsam nor a predictor, and start-up is paid by every process.
    match name:
        case "router":
            from vggt_motion.bus import router

            code = router.main(settings)
        case "ledger":
            from vggt_motion.ledger import service as ledger

            code = ledger.main(settings, directory=_needed(directory, name, "--directory"))
        case "frontend":
            from vggt_motion.frontend import service as frontend

            code = frontend.main(
                settings,
                source=_needed(source, name, "--source"),
                start=start,
                end=end,
                stride=stride,
                ego_mask=ego_mask,
            )
        case "inference":
            from vggt_motion.inference import service as inference

            code = inference.main(settings)
        case "registration":
            from vggt_motion.registration import service as registration

            code = registration.main(settings)
        case "backend":
            from vggt_motion.backend import service as backend

            code = backend.main(settings)
        case "gateway":
            from vggt_motion.gateway import service as gateway

            code = gateway.main(settings)
        case _:
            from vggt_motion.recorder import service as recorder

            code = recorder.main(settings, directory=_needed(directory, name, "--directory"))
    _leave(code)


def _leave(code: int) -> NoReturn:
    """End a process that has joined the bus at once, without the interpreter's teardown.

    All that matters is closed and flushed by then. Foreign threads that are still winding down would make the teardown
    take seconds, or abort it ("exception not rethrown", seen in 2 of 40 ends of the ledger).
    """
    logging.shutdown()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except OSError:
        code = code or 1  # whoever read our output has gone
    finally:
        os._exit(code)


def _needed(value: Value | None, service: str, option: str) -> Value:
    if value is None:
        raise InputError(f"service {service} needs {option}")
    return value


@app.command()
def evaluate(
    estimate: Annotated[Path, typer.Argument(help="Trajectory to judge: TUM or KITTI.")],
    ground_truth: Annotated[Path, typer.Argument(help="Reference trajectory: TUM or KITTI.")],
    max_difference_s: Annotated[float, typer.Option(min=0.0, help="Greatest difference in time of a match.")] = 0.01,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Compare a trajectory with a reference: ATE, drift, KITTI relative errors, RPE.

    Poses are matched by time; two KITTI files, which have no times, line by line.
    """
    from vggt_motion.evaluation import summary

    errors = summary.evaluate_files(estimate, ground_truth, max_difference_s=max_difference_s)
    sys.stdout.write(summary.to_json(errors) if as_json else summary.to_text(errors))


@app.command()
def inspect(
    source: Annotated[str, typer.Argument(help="As for run.")],
    out: Annotated[Path, typer.Option(help="Folder for inspect.png, inspect.html and inspect.csv.")] = Path("inspect"),
    config: ConfigOption = None,
    assignments: SetOption = None,
    start: Annotated[int, typer.Option(min=0, help="First frame to use.")] = 0,
    end: Annotated[int | None, typer.Option(min=1, help="Frame to stop before.")] = None,
    stride: Annotated[int, typer.Option(min=1, help="Use every n-th frame.")] = 1,
) -> None:
    """Show what the frontend sees: scores over time, motion states, keyframes and submap borders."""
    from vggt_motion.evaluation import inspect as inspection

    found = inspection.inspect(
        source, load_config(config, list(assignments or ())), out, start=start, end=end, stride=stride
    )
    console = Console(stderr=True, highlight=False, soft_wrap=True, markup=False)
    console.print(f"{out}: inspect.png, inspect.html, inspect.csv")
    if found.truncated:
        console.print(f"The input ended early: {found.truncated}")
        raise typer.Exit(SourceTruncatedError.exit_code)


@app.command()
def export(
    directory: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="Folder of a run, or of a ledger.")],
    form: Annotated[str, typer.Option("--format", help="tum, kitti, csv, json, ply or colmap.")] = "colmap",
    out: Annotated[Path | None, typer.Option(help="File to write; for colmap a folder.")] = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
    frames: Annotated[str, typer.Option(help="tum, kitti: all frames, or key frames only.")] = "all",
    component: Annotated[
        int | None, typer.Option(min=0, help="First submap of the connected part; default: all, or the largest.")
    ] = None,
    text: Annotated[bool, typer.Option("--text", help="colmap: text files instead of binary ones.")] = False,
    undistort: Annotated[bool, typer.Option("--undistort", help="colmap: images and cameras as pinholes.")] = False,
    max_points: Annotated[int, typer.Option(min=1000, help="colmap: most points.")] = 300_000,
    max_observations: Annotated[int, typer.Option(min=1, help="colmap: most observations of an image.")] = 4096,
) -> None:
    """Write a run's trajectory, map or COLMAP model; the run may be finished, interrupted or still going on."""
    from vggt_motion import export as exporter
    from vggt_motion.launch import CONFIG_FILE, LEDGER_FOLDER

    try:
        wanted = exporter.ExportFormat(form)
    except ValueError:
        known = ", ".join(exporter.ExportFormat)
        raise InputError(f"unknown format '{form}': known are {known}") from None
    if frames not in ("all", "key"):
        raise InputError(f"--frames is all or key, not '{frames}'")
    ledger = directory / LEDGER_FOLDER if (directory / LEDGER_FOLDER).is_dir() else directory
    stored = directory / CONFIG_FILE
    settings = load_config(config or (stored if stored.is_file() else None), list(assignments or ()))
    name = "colmap" if wanted is exporter.ExportFormat.COLMAP else f"export.{wanted}"
    options = exporter.ExportOptions(
        "key" if frames == "key" else "all", component, text, undistort, max_points, max_observations
    )
    sys.stdout.write(exporter.export(ledger, wanted, out or directory / name, settings, options) + "\n")


@app.command()
def record(
    directory: Annotated[Path, typer.Argument(help="Folder that gets run.mcap.")],
    config: ConfigOption = None,
    assignments: SetOption = None,
) -> None:
    """Record a running session until Ctrl-C: frames, records and views, in one MCAP file."""
    from vggt_motion.recorder import service as recorder

    raise typer.Exit(recorder.main(load_config(config, list(assignments or ())), directory=directory))


@app.command()
def replay(
    file: Annotated[Path, typer.Argument(help="MCAP recording.")],
    config: ConfigOption = None,
    assignments: SetOption = None,
    rate: Annotated[float, typer.Option(help="Speed: 2 = twice as fast, inf = as fast as they are taken.")] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end.")] = False,
    start_s: Annotated[float, typer.Option(help="Skip so many seconds.")] = 0.0,
    duration_s: Annotated[float | None, typer.Option(help="Stop after so many seconds of the recording.")] = None,
) -> None:
    """Publish the frames of a recording on the image key, at the pace of their capture times."""
    from vggt_motion.recorder import replay as player

    settings = load_config(config, list(assignments or ()))
    outcome = player.replay(file, settings, rate=rate, loop=loop, start_s=start_s, duration_s=duration_s)
    Console(stderr=True, highlight=False).print(f"{outcome.frame_count} frames replayed")


@app.command()
def sessions(root: Annotated[Path, typer.Argument(help="Folder to search.")] = Path()) -> None:
    """List the sessions at or below a folder."""
    from vggt_motion.ledger.sessions import list_sessions

    for session in list_sessions(root):
        sys.stdout.write(session.to_text())


@app.command()
def health(
    service: Annotated[str, typer.Argument(help=f"One of: {', '.join(SERVICES)}.")],
    config: ConfigOption = None,
    assignments: SetOption = None,
    timeout_s: Annotated[float, typer.Option(min=0.1, help="How long to wait for a sign of life.")] = 5.0,
) -> None:
    """Exit with 0 if a service of this name is alive on the bus and said so within the last seconds, else with 1."""
    from vggt_motion.bus.liveliness import ServiceWatch
    from vggt_motion.bus.session import open_bus

    if service not in SERVICES:
        raise InputError(f"unknown service '{service}': known are {', '.join(SERVICES)}")
    bus = open_bus(load_config(config, list(assignments or ())).bus)
    try:
        watch = ServiceWatch(bus)
        report = watch.wait_for_report(service, timeout_s)
        watch.close()
    finally:
        bus.close()
    if report is None:
        raise VggtMotionError(f"no {service} answered within {timeout_s:g} s")
    sys.stdout.write(f"{report.service}/{report.instance}: {report.state} {report.detail}".rstrip() + "\n")


@ledger_app.command("check")
def ledger_check(
    directory: Annotated[Path, typer.Argument(help="Folder of the ledger (of a run: OUT/ledger).")],
    repair: Annotated[bool, typer.Option(help="Repair what can be repaired.")] = True,
) -> None:
    """Verify every row and payload of a ledger that nobody serves; exit with 1 if something is damaged."""
    from vggt_motion.ledger.check import check

    report = check(directory, repair=repair)
    sys.stdout.write(report.to_text())
    raise typer.Exit(0 if report.is_sound else 1)


@ledger_app.command("export")
def ledger_export(
    directory: Annotated[Path, typer.Argument(help="Folder of the ledger.")],
    archive: Annotated[Path, typer.Argument(help="File to write (tar).")],
) -> None:
    """Write a session into one file that can be imported elsewhere."""
    from vggt_motion.ledger.export import export_session

    report = export_session(directory, archive)
    sys.stdout.write(f"{archive}: {report}\n")


@ledger_app.command("import")
def ledger_import(
    archive: Annotated[Path, typer.Argument(help="File that export wrote.")],
    directory: Annotated[Path, typer.Argument(help="Folder for the ledger, without one yet.")],
) -> None:
    """Make a ledger of an exported session."""
    from vggt_motion.ledger.export import import_session

    report = import_session(archive, directory)
    sys.stdout.write(f"{directory}: {report}\n")


@config_app.command("dump")
def config_dump(config: ConfigOption = None, assignments: SetOption = None) -> None:
    """Print the effective configuration as YAML."""
    sys.stdout.write(load_config(config, list(assignments or ())).to_yaml())


def main() -> None:
    """Entry point of the command: runs it and turns errors into one line and an exit code."""
    logging.captureWarnings(True)
    keep_freed_memory()
    try:
        code = app(standalone_mode=False)
    except typer.Exit as stop:
        code = stop.exit_code
    except (typer.Abort, KeyboardInterrupt):
        code = INTERRUPTED_EXIT_CODE
    except typer.TyperException as error:
        _complain(error.format_message())
        code = InputError.exit_code
    except VggtMotionError as error:
        _complain(str(error))
        code = error.exit_code
    except BrokenPipeError:
        code = 1  # whoever read our output has gone
    code = code if isinstance(code, int) else 0
    if "zenoh" in sys.modules:
        _leave(code)
    sys.exit(code)


def _complain(message: str) -> None:
    sys.stderr.write(f"vggt-motion: {' '.join(message.split())}\n")
