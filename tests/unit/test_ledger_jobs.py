from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from ledger_helpers import Clock, open_ledger, predict, record
from vggt_motion.errors import DiskFullError
from vggt_motion.ledger.directory import Ledger
from vggt_motion.ledger.jobs import Done, JobPolicy, Submitted
from vggt_motion.ledger.store import ConflictError, InvalidRequestError, UnknownError
from vggt_motion.records import DoneOutcome, Job, JobKind, JobReport, JobState, Lease

PREDICT = (JobKind.PREDICT,)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def ledger(tmp_path: Path, clock: Clock) -> Iterator[Ledger]:
    opened = open_ledger(tmp_path / "session", clock)
    yield opened
    opened.close()


def claim(ledger: Ledger, worker: str = "inference/a", claim_id: str = "") -> Lease:
    lease = ledger.jobs.claim(PREDICT, (), worker, claim_id=claim_id)
    assert lease is not None
    return lease


def report(ledger: Ledger, job_id: str) -> JobReport:
    return next(report for report in ledger.jobs.reports() if report.job_id == job_id)


def state(ledger: Ledger, job_id: str = "a") -> JobState:
    return report(ledger, job_id).state


def deliver(ledger: Ledger, lease: Lease, content: bytes = b"result") -> Done:
    return ledger.jobs.done(lease.job.job_id, lease.lease_id, record("submap", lease.job.job_id, content))


# Submitting


def test_a_job_goes_from_open_over_leased_to_done(ledger: Ledger) -> None:
    job = predict("a", payload=b"p", priority=3)
    assert ledger.jobs.submit([job]) == Submitted(new_count=1, known_count=0)
    assert state(ledger) is JobState.OPEN
    lease = claim(ledger)
    assert lease == Lease(job, "lease0", attempt=1, duration_s=10.0)
    assert state(ledger) is JobState.LEASED
    assert ledger.jobs.claim(PREDICT, (), "inference/b") is None
    assert deliver(ledger, lease) == Done(DoneOutcome.COMMITTED, 0)
    assert state(ledger) is JobState.DONE
    assert [row.payload for row in ledger.store.read("submap")] == [b"result"]
    assert ledger.jobs.counts() == {("predict", "done"): 1}


def test_submitting_again_changes_nothing(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a")])
    claim(ledger)
    assert ledger.jobs.submit([predict("a"), predict("b"), predict("b")]) == Submitted(new_count=1, known_count=2)
    assert state(ledger, "a") is JobState.LEASED


@pytest.mark.parametrize(
    "other",
    [
        predict("a", payload=b"other"),
        predict("a", model="vggt"),
        Job("a", JobKind.REGISTER, b"spec", "test.Spec"),
        Job("a", JobKind.PREDICT, b"spec", "test.Other"),
    ],
)
def test_another_content_is_refused_and_nothing_of_the_call_is_kept(ledger: Ledger, other: Job) -> None:
    ledger.jobs.submit([predict("a")])
    with pytest.raises(ConflictError, match="job 'a' is known with another content"):
        ledger.jobs.submit([predict("new"), other])
    assert [report.job_id for report in ledger.jobs.reports()] == ["a"]


@pytest.mark.parametrize(
    "bad",
    [
        predict(""),
        predict("a" * 241),
        predict("a b"),
        predict("a", model="x y"),
        predict("a", priority=2**31),
        predict("a", payload=bytes(4 * 2**20 + 1)),
        Job("a", JobKind.PREDICT, b"", ""),
    ],
)
def test_a_malformed_job_is_refused(ledger: Ledger, bad: Job) -> None:
    with pytest.raises(InvalidRequestError):
        ledger.jobs.submit([predict("good"), bad])
    assert ledger.jobs.reports() == []


def test_a_job_whose_result_is_in_the_log_is_done_at_once(ledger: Ledger) -> None:
    ledger.store.append(record("submap", "a"))
    ledger.jobs.submit([predict("a")])
    assert state(ledger) is JobState.DONE


# Claiming


def test_jobs_come_by_priority_then_order_of_submission(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("z", priority=1), predict("y"), predict("x", priority=-1)])
    ledger.jobs.submit([predict("b"), predict("a", priority=1)])
    order = [claim(ledger).job.job_id for _ in range(5)]
    assert order == ["x", "y", "b", "z", "a"]


def test_only_jobs_that_fit_are_claimed(ledger: Ledger) -> None:
    ledger.jobs.submit([Job("r", JobKind.REGISTER, b"", "t"), predict("v", model="vggt"), predict("any")])
    jobs = ledger.jobs

    def claimed(kinds: tuple[JobKind, ...], models: tuple[str, ...]) -> str | None:
        lease = jobs.claim(kinds, models, "inference/a")
        return lease and lease.job.job_id

    assert claimed((JobKind.DESCRIBE,), ("vggt",)) is None
    assert claimed(PREDICT, ("sfm",)) == "any"
    assert claimed(PREDICT, ("sfm",)) is None
    assert claimed(PREDICT, ("sfm", "vggt")) == "v"
    assert claimed((JobKind.DESCRIBE, JobKind.REGISTER), ()) == "r"


@pytest.mark.parametrize(
    ("kinds", "models", "worker", "wait_s", "claim_id"),
    [
        ((), (), "w", 0, ""),
        (PREDICT, (), "", 0, ""),
        (PREDICT, (), "w w", 0, ""),
        (PREDICT, ("",), "w", 0, ""),
        (PREDICT, ("m",) * 65, "w", 0, ""),
        (PREDICT, (), "w", -1, ""),
        (PREDICT, (), "w", float("nan"), ""),
        (PREDICT, (), "w", float("inf"), ""),
        (PREDICT, (), "w", 0, "c" * 257),
    ],
)
def test_a_malformed_claim_is_refused(
    ledger: Ledger, kinds: tuple[JobKind, ...], models: tuple[str, ...], worker: str, wait_s: float, claim_id: str
) -> None:
    ledger.jobs.submit([predict("a")])
    with pytest.raises(InvalidRequestError):
        ledger.jobs.claim(kinds, models, worker, wait_s, claim_id)
    assert state(ledger) is JobState.OPEN


def test_a_repeated_claim_gets_the_same_lease_while_it_is_valid(ledger: Ledger, clock: Clock) -> None:
    ledger.jobs.submit([predict("a"), predict("b")])
    first = claim(ledger, claim_id="c1")
    clock.now_s += 9
    assert claim(ledger, claim_id="c1") == first
    assert claim(ledger, claim_id="c2").job.job_id == "b"
    assert ledger.jobs.claim(PREDICT, (), "inference/other", claim_id="c1") is None
    clock.now_s += 2
    ledger.jobs.tick()  # only notes the time: it was long silent itself
    assert ledger.jobs.heartbeat(first.lease_id), "the repeated claim has moved the deadline"
    deliver(ledger, first)
    assert ledger.jobs.claim(PREDICT, (), "inference/a", claim_id="c1") is None


def test_a_waiting_claim_gets_a_job_that_comes_later(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session", clock=time.monotonic)  # type: ignore[arg-type]
    leases: list[Lease | None] = []
    threads = [
        threading.Thread(target=lambda: leases.append(ledger.jobs.claim(PREDICT, (), "inference/a", wait_s=30)))
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    while len(ledger.jobs._waiters) < 3:
        time.sleep(0.001)
    ledger.jobs.submit([predict("a"), predict("b"), predict("c")])
    for thread in threads:
        thread.join()
    assert sorted(lease.job.job_id for lease in leases if lease) == ["a", "b", "c"]
    assert ledger.jobs._waiters == []
    ledger.close()


@pytest.mark.parametrize("cause", ["submit", "fail", "release", "deadline"])
def test_whatever_makes_a_job_ready_wakes_the_claims_that_it_is_for(tmp_path: Path, cause: str) -> None:
    """Between two looks of its own accord a claim lets ten seconds pass: it must not need one."""
    policy = JobPolicy(retry_backoff_s=0.01, lease_duration_s=0.2)
    ledger = open_ledger(tmp_path / "session", clock=time.monotonic, policy=policy)  # type: ignore[arg-type]
    if cause != "submit":
        ledger.jobs.submit([predict("a")])
        lease = claim(ledger, "inference/b")
    leases: dict[str, Lease | None] = {}

    def wait_for(kind: JobKind) -> None:
        leases[kind] = ledger.jobs.claim((kind,), (), "inference/a", wait_s=20.0)

    threads = [threading.Thread(target=wait_for, args=(kind,)) for kind in (JobKind.PREDICT, JobKind.REGISTER)]
    for thread in threads:
        thread.start()
    while len(ledger.jobs._waiters) < 2:
        time.sleep(0.001)
    time.sleep(0.1)  # they have looked, and sleep
    begin = time.monotonic()
    if cause == "submit":
        ledger.jobs.submit([predict("a")])
    elif cause == "fail":
        ledger.jobs.fail("a", lease.lease_id, "no")
    elif cause == "release":
        ledger.jobs.release_worker("inference/b")
    else:
        time.sleep(policy.lease_duration_s)
        while not ledger.jobs.tick():
            time.sleep(0.01)
    threads[0].join()
    assert time.monotonic() - begin < 5.0
    found = leases[JobKind.PREDICT]
    assert found is not None and found.job.job_id == "a"
    assert JobKind.REGISTER not in leases, "there is nothing for it yet"
    ledger.jobs.submit([Job("r", JobKind.REGISTER, b"", "t")])
    threads[1].join()
    assert time.monotonic() - begin < 9.0
    found = leases[JobKind.REGISTER]
    assert found is not None and found.job.job_id == "r"
    ledger.close()


def test_a_claim_waits_no_longer_than_asked(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session", clock=time.monotonic)  # type: ignore[arg-type]
    assert ledger.jobs.claim(PREDICT, (), "inference/a", wait_s=0.01) is None
    ledger.close()


def test_a_waiting_claim_gets_a_failed_job_when_its_back_off_is_over(tmp_path: Path) -> None:
    policy = JobPolicy(retry_backoff_s=0.05)
    start, goes = time.monotonic(), threading.Event()
    ledger = open_ledger(
        tmp_path / "session",
        clock=lambda: time.monotonic() if goes.is_set() else start,  # type: ignore[arg-type]
        policy=policy,
    )
    ledger.jobs.submit([predict("a")])
    ledger.jobs.fail("a", claim(ledger).lease_id, "no")
    assert ledger.jobs.claim(PREDICT, (), "inference/a") is None
    goes.set()  # not before: a busy machine may take longer than the back-off to come here
    lease = ledger.jobs.claim(PREDICT, (), "inference/a", wait_s=30)
    assert lease is not None and lease.attempt == 2
    ledger.close()


@pytest.mark.parametrize("end", ["close", "release"])
def test_a_waiting_claim_ends_with_the_queue_or_its_worker(tmp_path: Path, end: str) -> None:
    ledger = open_ledger(tmp_path / "session", clock=time.monotonic)  # type: ignore[arg-type]
    leases: list[Lease | None] = []
    thread = threading.Thread(target=lambda: leases.append(ledger.jobs.claim(PREDICT, (), "inference/a", wait_s=60)))
    thread.start()
    while not ledger.jobs._waiters:
        time.sleep(0.001)
    if end == "close":
        ledger.jobs.close()
    else:
        ledger.jobs.release_worker("inference/a")
        ledger.jobs.submit([predict("a")])
    thread.join()
    assert leases == [None]
    ledger.close()


def test_below_the_reserve_no_job_is_handed_out_and_running_ones_may_finish(tmp_path: Path) -> None:
    free_bytes = 1000
    ledger = open_ledger(tmp_path / "session", reserve_bytes=1000, free_bytes=lambda: free_bytes)
    ledger.jobs.submit([predict("a"), predict("b")])
    lease = claim(ledger)
    free_bytes = 900
    assert ledger.jobs.claim(PREDICT, (), "inference/b") is None
    result = record("submap", "a")
    free_bytes = 499
    with pytest.raises(DiskFullError):
        ledger.jobs.done("a", lease.lease_id, result, [bytes(100)])
    assert state(ledger, "a") is JobState.LEASED
    free_bytes = 500
    assert ledger.jobs.done("a", lease.lease_id, result, [bytes(100)]).outcome is DoneOutcome.COMMITTED
    free_bytes = 1000
    assert claim(ledger).job.job_id == "b"
    ledger.close()


# Leases


def test_heartbeats_keep_a_lease_and_silence_ends_it(ledger: Ledger, clock: Clock) -> None:
    ledger.jobs.submit([predict("a")])
    lease = claim(ledger)
    for _ in range(30):
        clock.now_s += 2
        assert ledger.jobs.tick() == 0
        assert ledger.jobs.heartbeat(lease.lease_id)
    for _ in range(5):
        clock.now_s += 2
        assert ledger.jobs.tick() == 0
    clock.now_s += 0.1
    assert ledger.jobs.tick() == 1
    assert not ledger.jobs.heartbeat(lease.lease_id)
    assert state(ledger) is JobState.OPEN
    assert report(ledger, "a").lost_lease_count == 1
    assert claim(ledger).attempt == 2


def test_time_in_which_nobody_watched_counts_against_nobody(ledger: Ledger, clock: Clock) -> None:
    ledger.jobs.submit([predict("a")])
    lease = claim(ledger)
    clock.now_s += 2
    ledger.jobs.tick()
    clock.now_s += 3600  # frozen, or cut off from the bus
    assert ledger.jobs.tick() == 0
    for _ in range(4):
        clock.now_s += 2
        assert ledger.jobs.tick() == 0, "eight seconds were left and are left"
    clock.now_s += 0.1
    assert ledger.jobs.tick() == 1
    assert not ledger.jobs.heartbeat(lease.lease_id)


def test_a_vanished_worker_loses_all_its_leases_and_no_others(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a"), predict("b"), predict("c")])
    claim(ledger, "inference/a"), claim(ledger, "inference/b"), claim(ledger, "inference/a")
    assert ledger.jobs.release_worker("inference/a") == 2
    assert ledger.jobs.release_worker("inference/a") == 0
    assert [state(ledger, job_id) for job_id in "abc"] == [JobState.OPEN, JobState.LEASED, JobState.OPEN]


def test_a_job_that_loses_too_many_leases_is_dead_and_reported(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a"), predict("b")])
    for count in range(1, 11):
        assert claim(ledger).attempt == count
        assert ledger.jobs.release_worker("inference/a") == 1
        assert report(ledger, "a").lost_lease_count == count
    assert state(ledger) is JobState.DEAD
    (event,) = ledger.store.read("event")
    assert event.record_id == "job_dead/a"
    assert event.payload == b"a|10 leases were lost, the last one because worker inference/a vanished|"
    assert claim(ledger).job.job_id == "b", "a dead job does not hold up the others"


def test_on_restart_leased_jobs_are_open_again_and_nothing_is_counted(tmp_path: Path) -> None:
    first = open_ledger(tmp_path / "session")
    first.jobs.submit([predict("a"), predict("b")])
    lease = claim(first)
    first.jobs.fail("b", claim(first).lease_id, "no")
    first.close()
    second = open_ledger(tmp_path / "session", Clock(), new_lease_id=lambda: "new")
    assert [state(second, job_id) for job_id in "ab"] == [JobState.OPEN, JobState.OPEN]
    assert report(second, "a").lost_lease_count == 0
    assert report(second, "b").failure_count == 1
    assert not second.jobs.heartbeat(lease.lease_id)
    assert deliver(second, lease).outcome is DoneOutcome.COMMITTED, "the worker went on meanwhile"
    assert claim(second).job.job_id == "b", "the clock began anew: an old back-off means nothing"
    second.close()


# Results


def test_a_result_delivered_twice_is_committed_once(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a")])
    lease = claim(ledger)
    assert deliver(ledger, lease) == Done(DoneOutcome.COMMITTED, 0)
    assert deliver(ledger, lease) == Done(DoneOutcome.ALREADY_DONE, 0)
    assert deliver(ledger, lease, b"other bytes") == Done(DoneOutcome.ALREADY_DONE, 0)
    assert [row.payload for row in ledger.store.read("submap")] == [b"result"]


def test_a_late_result_is_taken_if_nobody_else_brought_one(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a")])
    late = claim(ledger, "inference/slow")
    ledger.jobs.release_worker("inference/slow")
    second = claim(ledger, "inference/b")
    assert deliver(ledger, late, b"late").outcome is DoneOutcome.COMMITTED
    assert not ledger.jobs.heartbeat(second.lease_id), "the other worker learns that it may stop"
    assert deliver(ledger, second, b"second").outcome is DoneOutcome.ALREADY_DONE
    assert [row.payload for row in ledger.store.read("submap")] == [b"late"]


def test_a_late_result_is_dropped_if_somebody_else_brought_one(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a")])
    late = claim(ledger, "inference/slow")
    ledger.jobs.release_worker("inference/slow")
    deliver(ledger, claim(ledger, "inference/b"), b"second")
    assert deliver(ledger, late, b"late") == Done(DoneOutcome.ALREADY_DONE, 0)
    assert [row.payload for row in ledger.store.read("submap")] == [b"second"]


def test_results_of_cancelled_dead_and_unknown_jobs_are_dropped(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a"), predict("b")])
    cancelled, dead = claim(ledger), claim(ledger)
    ledger.jobs.cancel(["a"])
    ledger.jobs.fail("b", dead.lease_id, "no", is_permanent=True)
    assert deliver(ledger, cancelled).outcome is DoneOutcome.DROPPED
    assert deliver(ledger, dead).outcome is DoneOutcome.DROPPED
    assert ledger.jobs.done("x", "lease0", record("submap", "x")).outcome is DoneOutcome.DROPPED
    assert ledger.store.read("submap") == []


def test_a_result_for_another_job_or_stream_or_of_an_unknown_lease_is_refused(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a"), predict("b")])
    first, second = claim(ledger), claim(ledger)
    with pytest.raises(InvalidRequestError, match="is not the one of job"):
        ledger.jobs.done("a", first.lease_id, record("submap", "b"))
    with pytest.raises(UnknownError, match="never handed out for job 'b'"):
        ledger.jobs.done("b", first.lease_id, record("submap", "b"))
    with pytest.raises(UnknownError, match="never handed out"):
        ledger.jobs.done("a", "guessed", record("submap", "a"))
    with pytest.raises(InvalidRequestError, match="belong into the stream submap"):
        ledger.jobs.done("a", first.lease_id, record("constraint", "a"))
    assert [state(ledger, job_id) for job_id in "ab"] == [JobState.LEASED, JobState.LEASED]
    assert deliver(ledger, second).outcome is DoneOutcome.COMMITTED


def test_a_result_that_is_in_the_log_already_ends_the_job(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a")])
    lease = claim(ledger)
    ledger.store.append(record("submap", "a", b"from elsewhere"))
    assert deliver(ledger, lease, b"mine") == Done(DoneOutcome.ALREADY_DONE, 0)
    assert state(ledger) is JobState.DONE
    assert [row.payload for row in ledger.store.read("submap")] == [b"from elsewhere"]


def test_a_result_without_one_of_its_blobs_leaves_the_job_leased(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a")])
    lease = claim(ledger)
    missing = ledger.blobs.put([b"x"], keep_free_bytes=0)
    ledger.blobs.set_aside(missing[0].sha256)
    with pytest.raises(UnknownError):
        ledger.jobs.done("a", lease.lease_id, record("submap", "a"), [], missing)
    assert state(ledger) is JobState.LEASED
    assert (
        ledger.jobs.done("a", lease.lease_id, record("submap", "a"), [b"x"], missing).outcome is DoneOutcome.COMMITTED
    )


# Failures


def test_failures_are_retried_with_a_back_off_that_doubles_until_the_job_is_dead(ledger: Ledger, clock: Clock) -> None:
    ledger.jobs.submit([predict("a")])
    for count, backoff_s in ((1, 0.5), (2, 1.0)):
        assert ledger.jobs.fail("a", claim(ledger).lease_id, f"no {count}", "Traceback ...")
        clock.now_s += backoff_s - 0.01
        assert ledger.jobs.claim(PREDICT, (), "inference/a") is None
        clock.now_s += 0.01
        assert report(ledger, "a").failure_count == count
    assert ledger.jobs.fail("a", claim(ledger).lease_id, "no 3", "Traceback 3")
    expected = JobReport("a", JobKind.PREDICT, JobState.DEAD, 3, 0, "inference/a", "no 3", "Traceback 3")
    assert report(ledger, "a") == expected
    assert [(row.record_id, row.payload) for row in ledger.store.read("event")] == [
        ("job_dead/a", b"a|no 3|Traceback 3")
    ]
    clock.now_s += 1000
    assert ledger.jobs.claim(PREDICT, (), "inference/a") is None


def test_a_permanent_failure_is_final_at_once(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a")])
    assert ledger.jobs.fail("a", claim(ledger).lease_id, "hopeless", is_permanent=True)
    assert state(ledger) is JobState.DEAD
    assert ledger.jobs.submit([predict("a")]) == Submitted(0, 1)
    assert state(ledger) is JobState.DEAD
    assert len(ledger.store.read("event")) == 1


def test_a_failure_counts_once_and_only_under_the_present_lease(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a"), predict("b")])
    lost = claim(ledger, "inference/slow")
    ledger.jobs.release_worker("inference/slow")
    present = claim(ledger, "inference/b")
    other = claim(ledger, "inference/b")
    assert not ledger.jobs.fail("a", lost.lease_id, "late")
    assert not ledger.jobs.fail("a", other.lease_id, "of another job")
    assert not ledger.jobs.fail("a", "guessed", "unknown")
    assert ledger.jobs.fail("a", present.lease_id, "no")
    assert not ledger.jobs.fail("a", present.lease_id, "no")
    assert report(ledger, "a").failure_count == 1


def test_reason_and_traceback_are_bounded_and_the_reason_is_one_line(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a")])
    ledger.jobs.fail("a", claim(ledger).lease_id, "one\ntwo " + "x" * 10_000, "head" + "y" * 100_000 + "tail")
    dead = report(ledger, "a")
    assert dead.last_reason.startswith("one two x") and len(dead.last_reason) <= 2000
    assert dead.last_traceback.endswith("tail") and len(dead.last_traceback) <= 16_000


def test_an_event_that_somebody_forged_does_not_keep_a_job_alive(ledger: Ledger) -> None:
    ledger.store.append(record("event", "job_dead/a", b"forged"))
    ledger.jobs.submit([predict("a")])
    assert ledger.jobs.fail("a", claim(ledger).lease_id, "hopeless", is_permanent=True)
    assert state(ledger) is JobState.DEAD


# Cancelling and reporting


def test_cancelled_jobs_are_not_claimed_and_come_back_when_submitted_again(ledger: Ledger) -> None:
    ledger.jobs.submit([predict("a"), predict("b"), predict("c")])
    lease = claim(ledger)
    done = claim(ledger)
    deliver(ledger, done)
    assert ledger.jobs.cancel(["a", "b", "c", "unknown"]) == 2
    assert not ledger.jobs.heartbeat(lease.lease_id)
    assert [state(ledger, job_id) for job_id in "abc"] == [JobState.CANCELLED, JobState.DONE, JobState.CANCELLED]
    assert ledger.jobs.claim(PREDICT, (), "inference/a") is None
    ledger.jobs.submit([predict("c")])
    assert claim(ledger).job.job_id == "c"


def test_reports_come_in_pages_by_state(ledger: Ledger) -> None:
    ledger.jobs.submit([predict(f"{index:02d}") for index in reversed(range(10))])
    leased = claim(ledger).job.job_id
    names = [f"{index:02d}" for index in range(10)]
    pages, after = [], ""
    while page := ledger.jobs.reports(after_job_id=after, limit=4):
        pages.append([report.job_id for report in page])
        after = page[-1].job_id
    assert pages == [names[:4], names[4:8], names[8:]]
    assert [report.job_id for report in ledger.jobs.reports(JobState.LEASED)] == [leased]
    assert [report.job_id for report in ledger.jobs.reports(JobState.OPEN)] == [
        name for name in names if name != leased
    ]
