"""The undisturbed runs, and the table at the end."""

from __future__ import annotations

import os
import random
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fault_run import HERE, SMALL_SUBMAPS, FaultRun, Outcome, Snapshot, with_hook

from bus_processes import free_port

SEED_VARIABLE = "VGGT_MOTION_FAULT_SEED"
_TABLE = pytest.StashKey[dict[str, list[Outcome]]]()
_SEED = pytest.StashKey[int]()
_HOSTILE = pytest.StashKey[dict[tuple[str, str], Counter[str]]]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_TABLE] = defaultdict(list)
    config.stash[_HOSTILE] = defaultdict(Counter)
    config.stash[_SEED] = int(os.environ.get(SEED_VARIABLE, "0")) or random.SystemRandom().randrange(1, 2**31)


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    _write_hostile(terminalreporter, config)
    table = config.stash[_TABLE]
    if not table:
        return
    write = _section(terminalreporter, config, "faults")
    write(
        f"{'fault':<36}{'injected':>9}{'runs':>6}{'records':>9}{'lost':>6}{'twice':>7}{'jobs lost':>11}"
        f"{'jobs run twice':>16}{'equal':>7}"
    )
    total: Counter[str] = Counter()
    for name, outcomes in table.items():
        injected: Counter[str] = Counter()
        for outcome in outcomes:
            injected.update(outcome.injected)
        is_equal = all(outcome.is_equal for outcome in outcomes)
        figures = {
            "injected": sum(injected.values()),
            "runs": len(outcomes),
            "acknowledged": sum(outcome.acknowledged for outcome in outcomes),
            "lost": sum(outcome.records_lost for outcome in outcomes),
            "twice": sum(outcome.records_twice for outcome in outcomes),
            "jobs_lost": sum(outcome.jobs_lost for outcome in outcomes),
            "run_twice": sum(outcome.jobs_run_twice for outcome in outcomes),
        }
        total.update(figures)
        write(_line(name, figures, "yes" if is_equal else "NO"))
        if len(injected) > 1:
            for kind, count in sorted(injected.items()):
                write(f"  {kind:<34}{count:>9}")
    write(_line("all", total, "yes" if all(o.is_equal for outcomes in table.values() for o in outcomes) else "NO"))


def _section(terminalreporter: Any, config: pytest.Config, name: str) -> Callable[[str], None]:
    """Begin a part of the summary, with the seed that repeats it; returns what writes a line."""
    terminalreporter.section(name)
    terminalreporter.write_line(f"seed {config.stash[_SEED]} (repeat with {SEED_VARIABLE})")
    write: Callable[[str], None] = terminalreporter.write_line
    return write


def _write_hostile(terminalreporter: Any, config: pytest.Config) -> None:
    table = config.stash[_HOSTILE]
    if not table:
        return
    write = _section(terminalreporter, config, "hostile bytes")
    columns = {
        "cases": "cases",
        "unparsed": "no message",
        "content": "refused by content",
        "taken": "taken",
        "live": "live",
    }
    write(f"{'entry':<8}{'kind':<22}" + "".join(f"{title:>20}" for title in columns.values()))
    for (entry, kind), counts in table.items():
        write(f"{entry:<8}{kind:<22}" + "".join(f"{counts[column]:>20}" for column in columns))


def _line(name: str, figures: Any, is_equal: str) -> str:
    return (
        f"{name:<36}{figures['injected']:>9}{figures['runs']:>6}{figures['acknowledged']:>9}{figures['lost']:>6}"
        f"{figures['twice']:>7}{figures['jobs_lost']:>11}{figures['run_twice']:>16}{is_equal:>7}"
    )


@pytest.fixture
def judge(request: pytest.FixtureRequest) -> Callable[[str, Outcome], Outcome]:
    """Enter an outcome into the table, and assert that nothing was lost."""

    def enter(fault: str, outcome: Outcome) -> Outcome:
        request.config.stash[_TABLE][fault].append(outcome)
        print(f"{fault}: {outcome.seconds:.0f} s, {dict(outcome.injected)}")
        assert outcome.acknowledged > 0, "nobody witnessed anything"
        assert not outcome.problems, (outcome.problems, outcome.output[-3000:])
        assert not outcome.differences, (outcome.differences, outcome.output[-3000:])
        assert (outcome.records_lost, outcome.records_twice, outcome.jobs_lost) == (0, 0, 0)
        return outcome

    return enter


@pytest.fixture
def tally(request: pytest.FixtureRequest) -> Callable[[str, str], Counter[str]]:
    """What became of the hostile messages to an entry, by kind; for the table at the end."""
    return lambda entry, kind: request.config.stash[_HOSTILE][entry, kind]


@pytest.fixture
def generator(request: pytest.FixtureRequest) -> random.Random:
    """Randomness of one test, from the seed of the session and the name of the test."""
    seed = f"{request.config.stash[_SEED]}/{request.node.name}"
    print(f"seed {seed}")
    return random.Random(seed)


@pytest.fixture(scope="session")
def fault_sample(sample_dir: Path) -> Path:
    return sample_dir / "kitti_06_first51"


@pytest.fixture(scope="session")
def small_reference(fault_sample: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Snapshot]:
    """The undisturbed run with ``sfm``, in eight submaps: its folder and what has to be equal."""
    return _undisturbed(fault_sample, tmp_path_factory.mktemp("undisturbed"), SMALL_SUBMAPS)


@pytest.fixture(scope="session")
def sfm_reference(fault_sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Snapshot:
    """The undisturbed run as it is shipped."""
    return _undisturbed(fault_sample, tmp_path_factory.mktemp("undisturbed"), ())[1]


def _undisturbed(source: Path, folder: Path, assignments: tuple[str, ...]) -> tuple[Path, Snapshot]:
    import subprocess
    import sys

    out = folder / "out"
    command = [sys.executable, "-m", "vggt_motion", "run", str(source), "--out", str(out), "--set", "gateway.port=0"]
    for assignment in assignments:
        command += ["--set", assignment]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return out, Snapshot.of(out)


Start = Callable[..., FaultRun]


@pytest.fixture
def start(fault_sample: Path, small_reference: tuple[Path, Snapshot], tmp_path: Path) -> Iterator[Start]:
    """Start a run that plays the undisturbed geometry back, so that a run is short and has many submaps."""
    runs: list[FaultRun] = []
    folder, reference = small_reference

    def begin(
        *assignments: str, seconds_per_submap: float = 0.5, seconds_per_frame: float = 0.0, **options: Any
    ) -> FaultRun:
        run = FaultRun(
            source=options.pop("source", fault_sample),
            out=options.pop("out", tmp_path / f"run{len(runs)}"),
            reference=reference,
            assignments=(
                *SMALL_SUBMAPS,
                "inference.predictor=recorded",
                f"inference.recorded.ledger={folder / 'ledger'}",
                f"inference.recorded.seconds_per_submap={seconds_per_submap}",
                *assignments,
            ),
            port=options.pop("port", 0) or free_port(),
            **_paced(seconds_per_frame),
            **options,
        )
        runs.append(run)
        return run

    yield begin
    for run in runs:
        run.stop()


def _paced(seconds_per_frame: float) -> dict[str, Any]:
    if not seconds_per_frame:
        return {}
    return {"environment": with_hook(HERE / "pace", PACE_S_PER_FRAME=str(seconds_per_frame))}


@pytest.fixture
def start_sfm(fault_sample: Path, sfm_reference: Snapshot, tmp_path: Path) -> Iterator[Start]:
    """Start a run as it is shipped."""
    runs: list[FaultRun] = []

    def begin(*assignments: str, seconds_per_frame: float = 0.0) -> FaultRun:
        run = FaultRun(
            source=fault_sample,
            out=tmp_path / f"run{len(runs)}",
            reference=sfm_reference,
            assignments=assignments,
            port=free_port(),
            **_paced(seconds_per_frame),
        )
        runs.append(run)
        return run

    yield begin
    for run in runs:
        run.stop()
