"""The fault suite: whatever happens to a run, its result is that of the undisturbed one (`make test-faults`)."""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from cutting_proxy import CuttingProxy
from fault_run import HERE, FaultRun, Outcome, Snapshot, moments, with_hook
from test_fault_cross_section import SERVICES

import power_loss
from bus_processes import free_port
from ledger_helpers import damage_blob
from vggt_motion.bus import calls, codec
from vggt_motion.bus.jobs import JobClient
from vggt_motion.bus.ledger import LedgerClient, append_request
from vggt_motion.bus.session import open_bus
from vggt_motion.config import BusConfig
from vggt_motion.errors import BusUnavailableError, RefusalCode, RequestRefusedError
from vggt_motion.ledger.directory import stored_blob
from vggt_motion.ledger.sqlite import read_only
from vggt_motion.records import (
    Constraint,
    DoneOutcome,
    Job,
    JobKind,
    Keyframe,
    Lease,
    LogEntry,
    Segment,
    Stream,
    SubmapGeometry,
)

pytestmark = [pytest.mark.faults, pytest.mark.timeout(900)]
Start = Callable[..., FaultRun]
Judge = Callable[[str, Outcome], Outcome]
TESTS = Path(__file__).parents[2]
TWO_OF_EACH = ("run.inference_workers=2", "run.registration_workers=2")
OTHERS = sorted(set(SERVICES) - {"frontend"})
KILLS = 10
KILL_ROUNDS = 4
FREEZE_S = 5.0  # longer than both leases of a quick run
UNHURRIED_S = 0.2  # a frame: the frontend is through with the sample in ten seconds in place of one


def fully_started(run: FaultRun) -> FaultRun:
    assert run.wait_until(lambda: run.count(Stream.KEYFRAME) > 0), run.finish().output
    return run


def attack(run: FaultRun, faults: list[Callable[[], object]], generator: random.Random, over_s: float) -> None:
    """Inject faults in random order at random moments; those that find nobody to hit come again."""
    generator.shuffle(faults)
    for pause, fault in zip(moments(generator, len(faults), over_s), faults, strict=True):
        run.wait_until(lambda: False, pause)
        assert run.wait_until(fault, 20.0), "a fault found nobody to hit"


@pytest.mark.parametrize("number", range(KILL_ROUNDS))
def test_sigkill_at_random_moments(number: int, start: Start, judge: Judge, generator: random.Random) -> None:
    """Each service at least ten times over all rounds; never so often that supervision has to give up."""
    run = start(*TWO_OF_EACH, seconds_per_submap=3.0)
    per_service = -(-KILLS // KILL_ROUNDS)
    hits = 0
    while hits < per_service:
        assert run.wait_until(lambda: run.processes("frontend")), "the frontend was through before it was killed"
        # The input is short: a process starts for a second and is through in a quarter of one, or more when it is busy.
        run.wait_until(lambda: False, generator.uniform(0.0, 0.7))
        hits += bool(run.kill("frontend"))
    faults: list[Callable[[], object]] = []
    for service in OTHERS:
        faults += [lambda s=service: run.kill(s, generator.randrange(2)) for _ in range(per_service)]
    attack(run, faults, generator, over_s=25.0)
    judge("SIGKILL at random moments", run.finish())


@pytest.mark.parametrize("number", range(2))
def test_sigstop_for_longer_than_the_lease(number: int, start: Start, judge: Judge, generator: random.Random) -> None:
    run = fully_started(start(*TWO_OF_EACH, seconds_per_submap=6.0, seconds_per_frame=UNHURRIED_S))
    run.wait_until(lambda: False, generator.uniform(0.0, 4.0))
    assert run.freeze("frontend", FREEZE_S), "the frontend was through before it was frozen"
    faults: list[Callable[[], object]] = [
        lambda s=service: run.freeze(s, FREEZE_S, generator.randrange(2)) for service in OTHERS
    ]
    attack(run, faults, generator, over_s=5.0)
    judge("SIGSTOP longer than the lease", run.finish())


@pytest.mark.parametrize("number", range(3))
def test_restart(number: int, start: Start, judge: Judge, generator: random.Random) -> None:
    run = start(*TWO_OF_EACH, seconds_per_submap=3.0)
    assert run.wait_until(lambda: run.processes("frontend"))
    run.wait_until(lambda: False, generator.uniform(0.0, 2.0))
    run.restart("frontend")
    faults: list[Callable[[], object]] = []
    for service in OTHERS:
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
        run = fully_started(
            start(
                *TWO_OF_EACH,
                seconds_per_submap=2.0,
                seconds_per_frame=UNHURRIED_S if service == "frontend" else 0.0,
                port=port,
                endpoints=endpoints,
            )
        )
        for _ in range(2 if seconds < 10.0 else 1):
            run.wait_until(lambda: False, generator.uniform(0.2, 3.0))
            assert run.processes(service), "nobody is at the other end of the link any more"
            assert proxies[service].link_count > 0
            getattr(proxies[service], kind)(seconds)
            run.injected[f"link of {service}: {kind} {seconds:g} s"] += 1
        judge(f"link {kind.replace('_', ' ')} {seconds:g} s", run.finish())


@pytest.mark.parametrize("number", range(2))
def test_everything_at_once(number: int, start: Start, judge: Judge, generator: random.Random) -> None:
    with links("frontend", "inference") as (port, proxies):
        endpoints = {name: proxy.endpoint for name, proxy in proxies.items()}
        run = fully_started(
            start(
                *TWO_OF_EACH,
                seconds_per_submap=3.0,
                seconds_per_frame=UNHURRIED_S,
                port=port,
                endpoints=endpoints,
            )
        )

        def cut(name: str, kind: str) -> bool:
            if not proxies[name].link_count:
                return False
            run.injected[f"link of {name}: {kind} 2 s"] += 1
            getattr(proxies[name], kind)(2.0)
            return True

        def of(services: Iterable[str]) -> list[Callable[[], object]]:
            faults: list[Callable[[], object]] = [lambda s=service: run.kill(s, 0) for service in services]
            return faults + [lambda s=service: run.restart(s, 1) for service in services]

        # first those of the frontend, while there is input
        links_of_frontend = [lambda k=kind: cut("frontend", k) for kind in ("cut", "black_hole")]
        attack(run, [*of(["frontend"]), *links_of_frontend], generator, over_s=4.0)
        faults = of(OTHERS)
        faults += [lambda s=service: run.freeze(s, FREEZE_S) for service in ("ledger", "inference", "router")]
        faults += [lambda k=kind: cut("inference", k) for kind in ("cut", "black_hole")]
        attack(run, faults, generator, over_s=15.0)
        judge("mixed", run.finish())


def test_the_shipped_predictor_under_kills(start_sfm: Start, judge: Judge, generator: random.Random) -> None:
    run = fully_started(start_sfm("run.inference_workers=2", seconds_per_frame=UNHURRIED_S))
    attack(run, [lambda: run.kill("frontend")], generator, over_s=4.0)
    attack(run, [lambda s=service: run.kill(s, generator.randrange(2)) for service in OTHERS], generator, over_s=6.0)
    judge("SIGKILL, predictor sfm", run.finish())


def test_the_shipped_predictor_under_freezes(start_sfm: Start, judge: Judge, generator: random.Random) -> None:
    run = fully_started(start_sfm("run.inference_workers=2", seconds_per_frame=2 * UNHURRIED_S))
    services = ("inference", "ledger", "router", "backend")
    attack(run, [lambda s=service: run.freeze(s, FREEZE_S) for service in services], generator, over_s=5.0)
    judge("SIGSTOP, predictor sfm", run.finish())


@pytest.mark.parametrize("number", range(3))
def test_kill_of_everything_and_resume(
    number: int, start: Start, judge: Judge, generator: random.Random, tmp_path: Path
) -> None:
    out = tmp_path / "resumed"
    first = start(seconds_per_submap=1.0, out=out)
    wanted = generator.choice([Stream.KEYFRAME, Stream.SUBMAP, Stream.CONSTRAINT])
    first.wait_until(lambda: first.count(wanted) > generator.randrange(4))
    first.wait_until(lambda: False, generator.uniform(0.0, 1.5))
    first.kill_everything()
    second = start(seconds_per_submap=1.0, out=out)
    second.injected.update(first.injected)
    second.witness.acknowledged.extend(first.witness.acknowledged)
    judge("SIGKILL of everything, resumed", second.finish())


def test_a_recording_as_the_source(
    start: Start, judge: Judge, generator: random.Random, small_reference: tuple[Path, Snapshot]
) -> None:
    """A run of what a run has recorded, with the same names and numbers, under kills."""
    recording = small_reference[0] / "run.mcap"
    run = start(*TWO_OF_EACH, source=recording, seconds_per_submap=2.0, seconds_per_frame=UNHURRIED_S / 2)
    fully_started(run)
    attack(run, [lambda: run.kill("frontend"), lambda: run.restart("frontend")], generator, over_s=2.0)
    faults = [lambda s=service: run.kill(s, generator.randrange(2)) for service in OTHERS]
    attack(run, faults, generator, over_s=10.0)
    judge("recording as the source, SIGKILL", run.finish())


def test_the_clock_jumps(start: Start, judge: Judge, generator: random.Random, tmp_path: Path) -> None:
    offset = tmp_path / "offset"
    offset.write_text("0", encoding="ascii")
    environment = with_hook(HERE / "clock", CLOCK_OFFSET_FILE=str(offset))
    run = fully_started(start(*TWO_OF_EACH, seconds_per_submap=2.0, environment=environment))
    for jump in (3600.0, -3600.0, 86400.0 * 365, -5.0, 0.0, -86400.0 * 3650):
        assert run.is_running
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


@pytest.mark.parametrize("what", ["ledger", "everything"])
@pytest.mark.parametrize("reserve_mb", [0, 16])
def test_the_disk_fills_up(
    reserve_mb: int, what: str, start: Start, judge: Judge, small_disk: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    if what == "ledger":
        out.mkdir()
        (out / "ledger").symlink_to(small_disk / "ledger")
        (small_disk / "ledger").mkdir()
    else:
        out = small_disk / "run"
    run = start(f"ledger.reserve_bytes={reserve_mb * 2**20}", seconds_per_submap=1.0, out=out)
    assert run.wait_until(lambda: run.count(Stream.KEYFRAME) > 2)
    for _ in range(3):
        assert run.is_running
        filler = small_disk / "filler"
        with contextlib.suppress(OSError), filler.open("wb") as file:
            while True:
                file.write(bytes(2**20))
                file.flush()
        run.injected[f"disk of {what} full"] += 1
        run.wait_until(lambda: False, 3.0)
        filler.unlink()
        run.wait_until(lambda: False, 1.0)
    judge(f"disk of {what} full", run.finish())


@pytest.mark.skipif(power_loss.sqlite_library() is None, reason="SQLite is linked so that it has no hooks")
@pytest.mark.parametrize("number", range(6))
def test_power_loss_and_resume_from_the_crash_image(
    number: int, start: Start, judge: Judge, generator: random.Random, tmp_path: Path
) -> None:
    """The power goes in the middle of a commit: written, not yet forced to the disk."""
    file = tmp_path / "operations"
    hook = {
        "PYTHONPATH": os.pathsep.join([str(HERE / "power_hook"), str(TESTS), os.environ.get("PYTHONPATH", "")]),
        power_loss.LOG_VARIABLE: str(file),
        power_loss.CUT_VARIABLE: str(generator.randrange(20, 60 + 30 * number)),
    }
    first = start(seconds_per_submap=1.0, environment=hook)
    cut = file.with_suffix(".cut")
    assert first.wait_until(cut.exists), "the run was over before the power went"
    first.kill_everything()
    operations = power_loss.read_log(file)
    image = tmp_path / "image"
    shutil.copytree(first.out, image, ignore=shutil.ignore_patterns("ledger"))
    base = power_loss.read_base(file)
    damaged = power_loss.crash_image(operations, base, image / "ledger", generator)
    print(f"{len(operations)} operations, {damaged} writes or names lost or torn")
    with read_only(image / "ledger" / "ledger.db") as reader:
        kept = {row.record_id for row in reader.records(Stream.EVENT.value, 0, 100_000)}
    assert set(first.witness.acknowledged) <= kept
    second = start(seconds_per_submap=1.0, out=image)
    second.injected["power loss"] += 1
    second.witness.acknowledged.extend(first.witness.acknowledged)
    judge("power loss, resumed", second.finish())


TRICKS = {
    "record appended again",
    "other content under a known id",
    "message again or out of order",
    "garbage in place of a result",
    "result of another job",
    "result again, under no lease",
    "result twice",
    "late result",
}


class Rogue:
    """A client of the fabric that sends again, late, in another order, and what it should not."""

    def __init__(self, run: FaultRun, generator: random.Random, reference: Path) -> None:
        self._run, self._generator, self._reference = run, generator, reference
        self._bus = open_bus(BusConfig(endpoint=run.endpoint, connect_timeout_s=60.0, request_timeout_s=5.0))
        self._ledger, self._jobs = LedgerClient(self._bus), JobClient(self._bus)

    def close(self) -> None:
        self._bus.close()

    def _count(self, what: str, number: int = 1) -> None:
        self._run.injected[what] += number

    def _all(self, stream: Stream) -> list[LogEntry]:
        entries: list[LogEntry] = []
        while page := self._ledger.read(stream, len(entries), patience_s=5.0):
            entries += page
        return entries

    def append_again(self) -> None:
        """Records of the frontend once more, in any order: acknowledged again, under their old numbers."""
        for stream, cls in ((Stream.KEYFRAME, Keyframe), (Stream.SEGMENT, Segment)):
            entries = self._all(stream)
            self._generator.shuffle(entries)
            for entry in entries[:10]:
                result = self._ledger.append(stream, entry.record_id, codec.decode(cls, entry.payload), patience_s=5.0)
                assert (result.sequence, result.was_known) == (entry.sequence, True)
                self._count("record appended again")

    def append_other(self) -> None:
        """Another content under a known id."""
        for entry in self._all(Stream.KEYFRAME)[:5]:
            other = replace(codec.decode(Keyframe, entry.payload), capture_time_ns=1)
            with pytest.raises(RequestRefusedError) as caught:
                self._ledger.append(Stream.KEYFRAME, entry.record_id, other, patience_s=5.0)
            assert caught.value.code is RefusalCode.CONFLICT
            self._count("other content under a known id")

    def publish_again(self) -> None:
        """What the ledger has published on the log, again, backwards, and twice; and what is no record at all."""
        for stream in (Stream.KEYFRAME, Stream.SEGMENT, Stream.SUBMAP, Stream.CONSTRAINT):
            publisher = self._bus.publisher(self._bus.keys.log(stream.value), blocking=True)
            entries = self._all(stream)
            for entry in [*reversed(entries), *entries]:
                publisher.put(codec.encode(entry))
            for size in (0, 1, 100):
                publisher.put(self._generator.randbytes(size))
            self._count("message again or out of order", 2 * len(entries) + 3)
            publisher.close()

    def misuse_a_lease(self) -> None:
        """Garbage, then the result of another job, then nothing more: the lease runs out."""
        for kind, stream in ((JobKind.PREDICT, Stream.SUBMAP), (JobKind.REGISTER, Stream.CONSTRAINT)):
            lease = self._jobs.claim([kind], ["recorded"], "rogue/1", 2.0)
            if lease is None:
                continue
            key = self._bus.keys.rpc("jobs", "done")
            for garbage in (b"", self._generator.randbytes(300)):
                with pytest.raises(RequestRefusedError):
                    self._bus.request(key, garbage)
                self._count("garbage in place of a result")
            others = [entry for entry in self._all(stream) if entry.record_id != lease.job.job_id]
            if others:
                cls = SubmapGeometry if stream is Stream.SUBMAP else Constraint
                other = codec.decode(cls, others[0].payload)
                with pytest.raises(RequestRefusedError):
                    self._jobs.done(lease, stream, other.record_id, other)
                self._count("result of another job")
                with pytest.raises(RequestRefusedError):
                    self._bus.request(key, codec.encode(_done_as(lease, stream, other)))
                self._count("result of another job")

    def hand_in_under_no_lease(self) -> None:
        """The result of a job that is done, under a lease that is none."""
        for entry in self._all(Stream.CONSTRAINT)[:3]:
            record = codec.decode(Constraint, entry.payload)
            job = Job(entry.record_id, JobKind.REGISTER, b"", "RegisterTask")
            with pytest.raises(RequestRefusedError):
                self._jobs.done(Lease(job, "no-such-lease", 1, 1.0), Stream.CONSTRAINT, record.record_id, record)
            self._count("result again, under no lease")

    def hand_in_twice(self) -> None:
        """A true result, and once more."""
        lease = self._jobs.claim([JobKind.PREDICT], ["recorded"], "rogue/2", 2.0)
        if lease is not None:
            assert self._hand_in(lease) is DoneOutcome.COMMITTED
            assert self._hand_in(lease) is DoneOutcome.ALREADY_DONE
            self._count("result twice")

    def hand_in_late(self) -> None:
        """A true result, when the lease is lost and somebody else may have brought it."""
        lease = self._jobs.claim([JobKind.PREDICT], ["recorded"], "rogue/3", 2.0)
        if lease is not None:
            assert self._run.wait_until(lambda: self._lease_of(lease.job.job_id) != lease.lease_id)
            assert self._hand_in(lease) in (DoneOutcome.COMMITTED, DoneOutcome.ALREADY_DONE)
            assert self._hand_in(lease) is DoneOutcome.ALREADY_DONE
            self._count("late result")

    def _lease_of(self, job_id: str) -> str:
        with read_only(self._run.out / "ledger" / "ledger.db") as reader:
            job = reader.find_job(job_id)
        assert job is not None
        return job.lease_id

    def _hand_in(self, lease: Lease) -> DoneOutcome:
        job_id = lease.job.job_id
        with read_only(self._reference / "ledger" / "ledger.db") as reader:
            row = reader.find_record(Stream.SUBMAP.value, job_id)
        assert row is not None
        geometry = codec.decode(SubmapGeometry, row.payload)
        blobs = [bytes(stored_blob(self._reference / "ledger", ref.sha256)) for ref in codec.blob_refs(geometry)]
        request = calls.DoneRequest(job_id, lease.lease_id, append_request(Stream.SUBMAP, job_id, geometry, blobs))
        answer = self._bus.request(self._bus.keys.rpc("jobs", "done"), codec.encode(request))
        return codec.decode(calls.DoneReply, answer).outcome


def _done_as(lease: Lease, stream: Stream, other: SubmapGeometry | Constraint) -> calls.DoneRequest:
    request = append_request(stream, other.record_id, other, ())
    return calls.DoneRequest(lease.job.job_id, lease.lease_id, replace(request, record_id=lease.job.job_id))


@pytest.mark.parametrize("number", range(2))
def test_duplicate_late_reordered_and_foreign_messages(
    number: int, start: Start, judge: Judge, generator: random.Random, small_reference: tuple[Path, Snapshot]
) -> None:
    run = fully_started(start(*TWO_OF_EACH, seconds_per_submap=6.0))  # jobs are open for long enough
    rogue = Rogue(run, generator, small_reference[0])
    try:
        tricks = [
            rogue.append_again,
            rogue.append_other,
            rogue.publish_again,
            rogue.misuse_a_lease,
            rogue.hand_in_under_no_lease,
            rogue.hand_in_twice,
            rogue.hand_in_late,
        ]
        for _ in range(3):
            generator.shuffle(tricks)
            for trick in tricks:
                if run.is_running:
                    trick()
    except BusUnavailableError:
        assert not run.wait_until(lambda: False, 5.0), "a trick was not answered"
    finally:
        rogue.close()
    judge("duplicate, late, foreign", run.finish())
    assert set(run.injected) >= TRICKS


def test_late_results_of_frozen_workers(start: Start, judge: Judge, generator: random.Random) -> None:
    """Both workers are frozen with a job in hand until their leases are lost, and hand in what they had."""
    run = fully_started(start(*TWO_OF_EACH, seconds_per_submap=2.0))
    for _ in range(3):
        run.wait_until(lambda: False, generator.uniform(0.5, 2.5))
        run.freeze("inference", FREEZE_S, 0)
        run.freeze("registration", FREEZE_S, 1)
    judge("late results", run.finish())


def test_a_poison_submap_is_halved(start: Start, fault_sample: Path, small_reference: tuple[Path, Snapshot]) -> None:
    """The whole run, but the depth of one submap is gone from the recording: given up, halved, and the graph breaks."""
    folder, reference = small_reference
    with read_only(folder / "ledger" / "ledger.db") as reader:
        rows = reader.records(Stream.SUBMAP.value, 0, 100)
    victim = next(g for row in rows if (g := codec.decode(SubmapGeometry, row.payload)).spec.submap_index == 6)
    copy = folder.parent / "poisoned"
    shutil.copytree(folder / "ledger", copy)
    for frame in victim.frames:
        damage_blob(copy, frame.depth.sha256, b"poison")
    run = start(f"inference.recorded.ledger={copy}", "ledger.retry_backoff_s=0.05", seconds_per_submap=0.0)
    outcome = run.finish()
    assert outcome.exit_code == 0, outcome.output
    got = Snapshot.of(run.out)
    metrics = json.loads((run.out / "metrics.json").read_text(encoding="utf-8"))
    assert (got.keyframes, got.segments) == (reference.keyframes, reference.segments)
    assert {"submap/000006/r1"} <= reference.submaps - got.submaps
    assert metrics["dead_job_count"] == 3 and metrics["break_count"] >= 1
    warnings = "\n".join(metrics["warnings"])
    assert "damaged" in warnings and "submap/000006a/r1" in warnings and "the trajectory is broken" in warnings
