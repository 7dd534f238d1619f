"""The fault suite: whatever happens to a run, its result is that of the undisturbed one (`make test-faults`)."""

from __future__ import annotations

import contextlib
import os
import random
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cutting_proxy import CuttingProxy
from fault_run import FaultRun, Outcome, moments
from test_fault_cross_section import SERVICES

from conftest import free_port
from vggt_motion.records import Stream

pytestmark = [pytest.mark.faults, pytest.mark.timeout(900)]
Start = Callable[..., FaultRun]
Judge = Callable[[str, Outcome], Outcome]
TWO_OF_EACH = ("run.inference_workers=2", "run.registration_workers=2")
KILLS = 10
KILL_ROUNDS = 4
FREEZE_S = 5.0  # longer than both leases of a quick run


def fully_started(run: FaultRun) -> FaultRun:
    assert run.wait_until(lambda: run.count(Stream.KEYFRAME) > 0), run.finish().output
    return run


def attack(run: FaultRun, faults: list[Callable[[], object]], generator: random.Random, over_s: float) -> None:
    """Inject faults in random order at random moments; those that find nobody to hit come again."""
    generator.shuffle(faults)
    for pause, fault in zip(moments(generator, len(faults), over_s), faults, strict=True):
        run.wait_until(lambda: False, pause)
        for _ in range(100):
            if not run.is_running or fault():
                break
            time.sleep(0.05)


@pytest.mark.parametrize("number", range(KILL_ROUNDS))
def test_sigkill_at_random_moments(number: int, start: Start, judge: Judge, generator: random.Random) -> None:
    """Each service at least ten times over all rounds; never so often that supervision has to give up."""
    run = fully_started(start(*TWO_OF_EACH, seconds_per_submap=3.0))
    per_service = -(-KILLS // KILL_ROUNDS)
    faults: list[Callable[[], object]] = []
    for service in SERVICES:
        faults += [lambda s=service: run.kill(s, generator.randrange(2)) for _ in range(per_service)]
    attack(run, faults, generator, over_s=25.0)
    judge("SIGKILL at random moments", run.finish())


@pytest.mark.parametrize("number", range(2))
def test_sigstop_for_longer_than_the_lease(number: int, start: Start, judge: Judge, generator: random.Random) -> None:
    run = fully_started(start(*TWO_OF_EACH, seconds_per_submap=6.0))
    faults: list[Callable[[], object]] = [
        lambda s=service: run.freeze(s, FREEZE_S, generator.randrange(2)) for service in SERVICES
    ]
    attack(run, faults, generator, over_s=5.0)
    judge("SIGSTOP longer than the lease", run.finish())


@pytest.mark.parametrize("number", range(3))
def test_restart(number: int, start: Start, judge: Judge, generator: random.Random) -> None:
    run = fully_started(start(*TWO_OF_EACH, seconds_per_submap=3.0))
    faults: list[Callable[[], object]] = []
    for service in SERVICES:
        faults += [lambda s=service: run.restart(s, generator.randrange(2)) for _ in range(2)]
    attack(run, faults, generator, over_s=20.0)
    judge("restart (SIGTERM)", run.finish())


@contextlib.contextmanager
def links(*services: str) -> Iterator[tuple[int, dict[str, CuttingProxy]]]:
    port = free_port()
    proxies = {service: CuttingProxy(port) for service in services}
    try:
        yield port, proxies
    finally:
        for proxy in proxies.values():
            proxy.close()


@pytest.mark.parametrize("service", ["frontend", "inference", "registration", "ledger", "backend"])
@pytest.mark.parametrize("seconds", [2.0, 15.0])
@pytest.mark.parametrize("kind", ["cut", "black_hole"])
def test_links_cut_and_swallowed(
    service: str, seconds: float, kind: str, start: Start, judge: Judge, generator: random.Random
) -> None:
    with links(service) as (port, proxies):
        endpoints = {name: proxy.endpoint for name, proxy in proxies.items()}
        run = fully_started(start(*TWO_OF_EACH, seconds_per_submap=2.0, port=port, endpoints=endpoints))
        for _ in range(2 if seconds < 10.0 else 1):
            run.wait_until(lambda: False, generator.uniform(0.2, 3.0))
            if run.is_running:
                getattr(proxies[service], kind)(seconds)
                run.injected[f"link of {service}: {kind} {seconds:g} s"] += 1
        judge(f"link {kind.replace('_', ' ')} {seconds:g} s", run.finish())


@pytest.mark.parametrize("number", range(2))
def test_everything_at_once(number: int, start: Start, judge: Judge, generator: random.Random) -> None:
    with links("frontend", "inference") as (port, proxies):
        endpoints = {name: proxy.endpoint for name, proxy in proxies.items()}
        run = fully_started(start(*TWO_OF_EACH, seconds_per_submap=3.0, port=port, endpoints=endpoints))

        def cut(name: str, kind: str) -> bool:
            run.injected[f"link of {name}: {kind} 2 s"] += 1
            getattr(proxies[name], kind)(2.0)
            return True

        faults: list[Callable[[], object]] = [lambda s=service: run.kill(s, 0) for service in SERVICES]
        faults += [lambda s=service: run.restart(s, 1) for service in SERVICES]
        faults += [lambda s=service: run.freeze(s, FREEZE_S) for service in ("ledger", "inference", "router")]
        faults += [lambda n=name, k=kind: cut(n, k) for name in proxies for kind in ("cut", "black_hole")]
        attack(run, faults, generator, over_s=15.0)
        judge("mixed", run.finish())


def test_the_shipped_predictor_under_kills(start_sfm: Start, judge: Judge, generator: random.Random) -> None:
    run = fully_started(start_sfm("run.inference_workers=2"))
    attack(run, [lambda s=service: run.kill(s, generator.randrange(2)) for service in SERVICES], generator, over_s=12.0)
    judge("SIGKILL, predictor sfm", run.finish())


def test_the_shipped_predictor_under_freezes(start_sfm: Start, judge: Judge, generator: random.Random) -> None:
    run = fully_started(start_sfm("run.inference_workers=2"))
    services = ("inference", "ledger", "router", "backend")
    attack(run, [lambda s=service: run.freeze(s, FREEZE_S) for service in services], generator, over_s=5.0)
    judge("SIGSTOP, predictor sfm", run.finish())


@pytest.mark.parametrize("number", range(3))
def test_kill_of_everything_and_resume(
    number: int, start: Start, judge: Judge, generator: random.Random, tmp_path: Path
) -> None:
    out = tmp_path / "resumed"
    first = start(seconds_per_submap=2.0, out=out)
    wanted = generator.choice([Stream.KEYFRAME, Stream.SUBMAP, Stream.CONSTRAINT])
    first.wait_until(lambda: first.count(wanted) > generator.randrange(4))
    first.wait_until(lambda: False, generator.uniform(0.0, 1.5))
    first.kill_everything()
    second = start(seconds_per_submap=0.2, out=out)
    second.injected.update(first.injected)
    second.witness.acknowledged.extend(first.witness.acknowledged)
    judge("SIGKILL of everything, resumed", second.finish())


def test_the_clock_jumps(start: Start, judge: Judge, generator: random.Random, tmp_path: Path) -> None:
    offset = tmp_path / "offset"
    offset.write_text("0", encoding="ascii")
    here = Path(__file__).parent / "clock"
    environment = {
        "PYTHONPATH": f"{here}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
        "CLOCK_OFFSET_FILE": str(offset),
    }
    run = fully_started(start(*TWO_OF_EACH, seconds_per_submap=2.0, environment=environment))
    for jump in (3600.0, -3600.0, 86400.0 * 365, -5.0, 0.0, -86400.0 * 3650):
        if run.is_running:
            offset.write_text(str(jump), encoding="ascii")
            run.injected["clock jump"] += 1
            run.wait_until(lambda: False, generator.uniform(0.5, 2.0))
            run.kill(generator.choice(["ledger", "backend", "recorder"]))
    judge("clock jumps", run.finish())


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(folder)], capture_output=True, check=False
    )
    if done.returncode != 0:
        pytest.skip(f"cannot mount a small file system: {done.stderr.decode().strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)


@pytest.mark.parametrize("reserve_mb", [0, 16])
def test_the_disk_fills_up(reserve_mb: int, start: Start, judge: Judge, small_disk: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    (out / "ledger").symlink_to(small_disk / "ledger")
    (small_disk / "ledger").mkdir()
    run = start(f"ledger.reserve_bytes={reserve_mb * 2**20}", seconds_per_submap=1.0, out=out)
    assert run.wait_until(lambda: run.count(Stream.KEYFRAME) > 2)
    for _ in range(3):
        if not run.is_running:
            break
        filler = small_disk / "filler"
        with contextlib.suppress(OSError), filler.open("wb") as file:
            while True:
                file.write(bytes(2**20))
                file.flush()
        run.injected["ledger's disk full"] += 1
        run.wait_until(lambda: False, 3.0)
        filler.unlink()
        run.wait_until(lambda: False, 1.0)
    judge("ledger's disk full", run.finish())
    assert run.injected["ledger's disk full"] >= 2
