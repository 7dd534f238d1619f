from __future__ import annotations

import contextlib
import random
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bus_processes import EXIT_LIMIT_S, READY_S, wait_until
from ledger_processes import (
    CALLS,
    Site,
    depth_blob,
    event,
    keyframe,
    predict,
    site,
    submap,
)
from vggt_motion.bus import calls, codec
from vggt_motion.bus.follow import SEVERAL_ENTRIES, Follower
from vggt_motion.bus.ledger import AppendResult, append_request
from vggt_motion.bus.liveliness import ServiceWatch
from vggt_motion.errors import (
    BusUnavailableError,
    DiskFullError,
    RefusalCode,
    RequestRefusedError,
)
from vggt_motion.ledger.check import check
from vggt_motion.records import BlobRef, Event, EventKind, JobKind, JobState, Keyframe

PREDICT = (JobKind.PREDICT,)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Site]:
    with site(tmp_path) as opened:
        yield opened


# Calls


def test_records_and_blobs_come_back_as_they_were_stored(running: Site) -> None:
    client = running.client()
    images = [bytes([number]) * 1000 for number in range(3)]
    for number, image in enumerate(images):
        frame = keyframe(number, image)
        result = client.append("keyframe", frame.keyframe_id, frame, [image])
        assert (result.sequence, result.was_known) == (number, False)
    frame = keyframe(1, images[1])
    again = client.append("keyframe", frame.keyframe_id, frame, [images[1]])
    assert (again.sequence, again.was_known) == (1, True)
    entries = client.read("keyframe", 0)
    assert [entry.sequence for entry in entries] == [0, 1, 2]
    frames = [codec.decode(type(frame), entry.payload) for entry in entries]
    assert frames == [keyframe(number, image) for number, image in enumerate(images)]
    assert [client.blob(frame.image) for frame in frames] == images
    assert client.blobs([frame.image for frame in (*reversed(frames), frames[0])]) == [*reversed(images), images[0]]
    assert client.read("keyframe", 1, limit=1) == entries[1:2]
    assert client.read("segment", 0) == []
    status = client.status()
    assert status.position("keyframe") == 3 and status.position("segment") == 0
    assert status.is_accepting and status.detail == "" and status.stored_bytes > 3000


def test_what_is_appended_at_a_time_keeps_its_order_and_is_published_together(running: Site) -> None:
    encodings: list[str] = []
    key = running.bus.keys.log("keyframe")
    running.bus.subscribe(key, lambda sample: encodings.append(sample.encoding), is_small=True)
    client = running.client()
    images = [bytes([number]) * 40_000 for number in range(20)]
    frames = [keyframe(number, image) for number, image in enumerate(images)]
    first = frames[7]
    assert client.append("keyframe", first.keyframe_id, first, [images[7]]).sequence == 0
    conflicting = replace(frames[3], capture_time_ns=frames[3].capture_time_ns + 1)
    requests = [
        codec.encode_in_pieces(append_request("keyframe", frame.keyframe_id, frame, [image]))
        for frame, image in zip((*frames, conflicting), (*images, images[3]), strict=True)
    ]
    results = client.append_all_encoded(requests)
    others = [number for number in range(20) if number != 7]
    assert [(r.sequence, r.was_known) for r in results if isinstance(r, AppendResult)] == [
        (0, True) if number == 7 else (1 + others.index(number), False) for number in range(20)
    ]
    assert isinstance(results[20], RequestRefusedError) and results[20].code is RefusalCode.CONFLICT
    assert [entry.record_id for entry in client.read("keyframe", 0)] == [
        first.keyframe_id, *(frames[number].keyframe_id for number in others)
    ]  # fmt: skip
    for frame, image in zip(frames, images, strict=True):
        assert client.blob(frame.image) == image
    wait_until(lambda: SEVERAL_ENTRIES in encodings)
    follower = Follower(running.bus, "keyframe", Keyframe)
    assert [followed.sequence for _ in range(20) if (followed := follower.next(10.0))] == list(range(20))
    follower.close()


def test_another_content_under_a_known_id_is_a_conflict(running: Site) -> None:
    client = running.client()
    client.append("event", "event-1", event(1))
    with pytest.raises(RequestRefusedError, match="event record 'event-1' is known with another content") as caught:
        client.append("event", "event-1", Event("event-1", EventKind.WARNING, "something else", 1))
    assert caught.value.code is RefusalCode.CONFLICT
    later = Event("event-1", EventKind.WARNING, "number 1", time_ns=999)
    assert client.append("event", "event-1", later).was_known, "the wall clock is not part of the identity"
    assert running.status().refused_request_count == 1


def test_what_does_not_exist_is_unknown(running: Site) -> None:
    client = running.client()
    requests = [
        lambda: client.read("nonsense", 0),
        lambda: client.blob(BlobRef("0" * 64, 1, "image/png")),
        lambda: client.blobs([BlobRef("0" * 64, 1, "image/png")]),
        lambda: client.append("keyframe", keyframe(0, b"x").keyframe_id, keyframe(0, b"x")),
    ]
    for request in requests:
        with pytest.raises(RequestRefusedError) as caught:
            request()
        assert caught.value.code is RefusalCode.UNKNOWN
    assert running.status().position("keyframe") == 0


def test_a_job_is_claimed_done_and_seen(running: Site) -> None:
    jobs = running.jobs()
    assert jobs.submit([predict(0), predict(1)]) == (2, 0)
    assert jobs.submit([predict(0)]) == (0, 1)
    lease = jobs.claim(PREDICT, ["sfm"], "inference/a", 0.0)
    assert lease is not None and lease.job == predict(0) and lease.attempt == 1
    assert jobs.heartbeat(lease.lease_id)
    depth = depth_blob(0)
    assert jobs.done(lease, "submap", lease.job.job_id, submap(0, depth, 1.0), [depth])
    assert jobs.done(lease, "submap", lease.job.job_id, submap(0, depth, 2.0), [depth]), "once more: already done"
    assert not jobs.heartbeat(lease.lease_id)
    (entry,) = running.client().read("submap", 0)
    assert entry.record_id == lease.job.job_id
    counts = {(count.kind, count.state): count.count for count in running.status().job_counts}
    assert counts == {("predict", "done"): 1, ("predict", "open"): 1}


def test_health_counts_the_jobs_of_this_moment(running: Site) -> None:
    watch = ServiceWatch(running.bus)

    def counted(state: str) -> float | None:
        reports = [report for (service, _), report in watch.services().items() if service == "ledger"]
        return reports[0].counters.get(f"jobs_predict_{state}") if reports and reports[0] is not None else None

    jobs = running.jobs()
    jobs.submit([predict(0)])
    wait_until(lambda: counted("open") == 1.0)
    lease = jobs.claim(PREDICT, [], "inference/a", 0.0)
    assert lease is not None
    wait_until(lambda: (counted("open"), counted("leased")) == (0.0, 1.0))
    depth = depth_blob(0)
    assert jobs.done(lease, "submap", lease.job.job_id, submap(0, depth, 1.0), [depth])
    wait_until(lambda: (counted("open"), counted("leased"), counted("done")) == (0.0, 0.0, 1.0))
    watch.close()


def test_a_dead_job_is_told_on_the_log_with_the_workers_reason(running: Site) -> None:
    follower = Follower(running.bus, "event", Event)
    jobs = running.jobs()
    jobs.submit([predict(0)])
    lease = jobs.claim(PREDICT, [], "inference/a", 0.0)
    assert lease is not None
    assert jobs.fail(lease, "no parallax", "Traceback (most recent call last):\n  ...", is_permanent=True)
    followed = follower.next(READY_S)
    assert followed is not None and followed.record.kind is EventKind.JOB_DEAD
    assert followed.record.event_id == "job_dead/submap/000000/r1"
    assert followed.record.detail == {
        "job_id": "submap/000000/r1",
        "kind": "predict",
        "reason": "no parallax",
        "traceback": "Traceback (most recent call last):\n  ...",
    }
    (report,) = jobs.reports(JobState.DEAD)
    assert (report.last_reason, report.failure_count) == ("no parallax", 1)
    follower.close()


def test_waiting_claims_hold_up_no_append_and_end_with_the_ledger(running: Site) -> None:
    bus = running.connect(request_timeout_s=30.0)
    answers: list[object] = []

    def wait_for_a_job(number: int) -> None:
        request = calls.ClaimRequest(PREDICT, (), f"inference/{number}", 25.0, f"claim-{number}")
        try:
            answers.append(
                codec.decode(calls.ClaimReply, bus.request(bus.keys.rpc("jobs", "claim"), codec.encode(request)))
            )
        except BusUnavailableError as error:
            answers.append(error)

    threads = [threading.Thread(target=wait_for_a_job, args=(number,)) for number in range(20)]
    for thread in threads:
        thread.start()
    time.sleep(0.5)
    for number in range(20):
        running.client().append("event", f"event-{number}", event(number), patience_s=5.0)
    running.jobs().submit([predict(0)])
    wait_until(lambda: len(answers) == 1)
    assert isinstance(answers[0], calls.ClaimReply) and answers[0].lease is not None
    assert running.ledger.terminate() < EXIT_LIMIT_S
    assert running.ledger.process.returncode == 0
    for thread in threads:
        thread.join(10)
    assert len(answers) == 20
    assert all(isinstance(answer, BusUnavailableError) or answer.lease is None for answer in answers[1:])


def test_a_second_ledger_on_the_same_session_ends_with_one_line(running: Site) -> None:
    second = running.start_ledger()
    assert second.process.wait(20) == 1
    assert second.text().splitlines()[-1].endswith("is in use by another process "
                                                   f"({running.ledger.process.pid})")  # fmt: skip
    running.status()


# Workers


def test_the_job_of_a_killed_worker_is_open_at_once(tmp_path: Path) -> None:
    with site(tmp_path, "ledger.lease_duration_s=600") as running:
        running.jobs().submit([predict(0)])
        worker = running.start("worker", "600")
        wait_until(lambda: running.job_state("submap/000000/r1") == "leased")
        worker.kill()
        wait_until(lambda: running.job_state("submap/000000/r1") == "open")
        (report,) = running.jobs().reports()
        assert report.lost_lease_count == 1 and "vanished" in report.last_reason


def test_the_late_result_of_a_frozen_worker_is_taken_once(tmp_path: Path) -> None:
    with site(tmp_path, "ledger.lease_duration_s=1.5", "bus.lease_s=60") as running:
        running.jobs().submit([predict(0)])
        frozen = running.start("worker", "4.0")
        wait_until(lambda: running.job_state("submap/000000/r1") == "leased")
        frozen.send(signal.SIGSTOP)  # its link stays up: only its silence tells
        wait_until(lambda: running.job_state("submap/000000/r1") == "open")
        frozen.send(signal.SIGCONT)
        wait_until(lambda: running.job_state("submap/000000/r1") == "done")
        time.sleep(1.0)
        assert running.status().position("submap") == 1


def test_jobs_survive_the_router_and_leases_are_not_lost_with_it(tmp_path: Path) -> None:
    with site(tmp_path) as running:
        running.jobs().submit([predict(number) for number in range(3)])
        start = tmp_path / "start"  # none of them is done before the last one has begun
        workers = [running.start("worker", "4.0", str(start)) for _ in range(3)]
        wait_until(lambda: all(report.state is JobState.LEASED for report in running.jobs().reports()))
        start.touch()
        running.start_again("router")
        running.wait_until_ready()
        wait_until(lambda: all(report.state is JobState.DONE for report in running.jobs().reports()), 40.0)
        assert [report.lost_lease_count for report in running.jobs().reports()] == [0, 0, 0]
        for worker in workers:
            assert worker.text().count("lease ") == 1


def test_leases_survive_a_ledger_that_was_frozen(tmp_path: Path) -> None:
    with site(tmp_path, "ledger.lease_duration_s=2", "bus.lease_s=30") as running:
        running.jobs().submit([predict(0)])
        worker = running.start("worker", "8.0")
        wait_until(lambda: running.job_state("submap/000000/r1") == "leased")
        running.ledger.send(signal.SIGSTOP)
        time.sleep(4.0)
        running.ledger.send(signal.SIGCONT)
        wait_until(lambda: running.job_state("submap/000000/r1") == "done", 40.0)
        (report,) = running.jobs().reports()
        assert report.lost_lease_count == 0
        assert worker.text().count("lease ") == 1


# Faults


@pytest.mark.parametrize("victim", ["ledger", "router"])
def test_nothing_acknowledged_is_lost_and_followers_see_all_when_it_is_killed(tmp_path: Path, victim: str) -> None:
    random.seed(7)
    count = 150
    with site(tmp_path) as running:
        follower = Follower(running.connect(), "keyframe", type(keyframe(0, b"")))
        acknowledged: dict[int, int] = {}
        failures: list[Exception] = []

        def append(offset: int) -> None:
            client = running.client()
            try:
                for number in range(offset, count, 3):
                    image = number.to_bytes(4, "little") * 5000
                    frame = keyframe(number, image)
                    result = client.append("keyframe", frame.keyframe_id, frame, [image])
                    acknowledged[number] = result.sequence
                    time.sleep(0.03)
            except Exception as error:
                failures.append(error)

        threads = [threading.Thread(target=append, args=(offset,)) for offset in range(3)]
        for thread in threads:
            thread.start()
        for _ in range(4):
            time.sleep(random.uniform(0.2, 0.9))
            running.start_again(victim)
        for thread in threads:
            thread.join()
        assert failures == []
        assert sorted(acknowledged.values()) == list(range(count)), "each acknowledged once, without a gap"
        seen: list[int] = []
        deadline = time.monotonic() + 30
        while len(seen) < count and time.monotonic() < deadline:
            followed = follower.next(1.0)
            if followed is not None:
                assert followed.sequence == len(seen)
                seen.append(followed.record.frame_index)
        assert {number: sequence for sequence, number in enumerate(seen)} == acknowledged
        for number in range(0, count, 10):
            image = number.to_bytes(4, "little") * 5000
            assert running.client().blob(keyframe(number, image).image) == image
        running.ledger.terminate()
        report = check(running.directory)
        assert report.is_sound and report.record_counts["keyframe"] == count


def test_every_job_is_done_once_while_workers_and_ledger_are_killed(tmp_path: Path) -> None:
    random.seed(11)
    count = 30
    with site(tmp_path) as running:
        running.jobs().submit([predict(number) for number in range(count)])
        workers = [running.start("worker", "0.2") for _ in range(3)]
        for _ in range(6):
            time.sleep(random.uniform(0.2, 0.6))
            victim = random.randrange(4)
            if victim == 3:
                running.start_again("ledger")
                running.wait_until_ready()
            else:
                workers[victim].kill()
                workers[victim] = running.start("worker", "0.2")

        def is_all_done() -> bool:
            with contextlib.suppress(BusUnavailableError):
                return all(report.state is JobState.DONE for report in running.jobs().reports())
            return False

        wait_until(is_all_done, 60.0)
        entries = running.client().read("submap", 0)
        assert [entry.sequence for entry in entries] == list(range(count))
        assert {entry.record_id for entry in entries} == {predict(number).job_id for number in range(count)}


# Bad bytes


def hostile_payloads() -> Iterator[tuple[str, str, bytes]]:
    """Request, why it must be refused, payload."""
    generator = random.Random(3)
    good = codec.encode(append_request("event", "event-0", event(0), []))
    for service, names in CALLS.items():
        for name in names:
            for size in (1, 7, 100, 10_000):
                yield service, name, generator.randbytes(size)
    for cut in range(1, len(good), 2):
        yield "ledger", "append", good[:cut]
    for position in range(len(good)):
        changed = bytearray(good)
        changed[position] ^= 1 << generator.randrange(8)
        yield "ledger", "append", bytes(changed)


def refusal_of(running: Site, service: str, name: str, payload: bytes) -> RequestRefusedError | None:
    try:
        running.bus.request(running.bus.keys.rpc(service, name), payload)
    except RequestRefusedError as error:
        return error
    return None


def test_hostile_bytes_are_refused_and_counted_and_change_nothing(running: Site) -> None:
    running.client().append("event", "before", Event("before", EventKind.WARNING, "", 0))
    before = running.status()
    refused = accepted = 0
    for service, name, payload in hostile_payloads():
        refusal = refusal_of(running, service, name, payload)
        if refusal is not None:
            assert refusal.code is not RefusalCode.INTERNAL, f"{service}/{name} {payload!r}: {refusal}"
            assert "\n" not in str(refusal)
            refused += 1
        else:
            # A flipped bit may leave a valid request: another message, time or identity.
            assert (service, name) == ("ledger", "append"), f"{service}/{name} took {payload!r}"
            accepted += 1
    after = running.status()
    assert refused > 150
    assert after.refused_request_count - before.refused_request_count == refused
    assert after.position("event") <= before.position("event") + accepted
    assert after.job_counts == before.job_counts == ()
    assert running.client().append("event", "event-99", event(99)).was_known is False


def test_records_that_no_reader_could_use_are_refused(running: Site) -> None:
    client, jobs = running.client(), running.jobs()
    jobs.submit([predict(0)])
    lease = jobs.claim(PREDICT, [], "inference/a", 0.0)
    assert lease is not None
    job_id = lease.job.job_id
    depth = depth_blob(0)
    good = append_request("submap", job_id, submap(0, depth), [depth])
    damaged = bytearray(depth)
    damaged[len(depth) // 2] ^= 255

    def with_depth(blob: bytes) -> calls.AppendRequest:
        return append_request("submap", job_id, submap(0, blob), [blob])

    def changed(**changes: object) -> calls.AppendRequest:
        return calls.AppendRequest(**{**good.__dict__, **changes})

    small = codec.encode_depth(np.ones((3, 4), np.float32), np.ones((3, 4), np.float32))
    bad = {
        "damaged depth": with_depth(bytes(damaged)),
        "no depth": with_depth(b"no depth at all"),
        "wrong shape": with_depth(small),
        "another type": changed(payload_type="vggt_motion.v1.Event"),
        "another record": changed(payload=codec.encode(submap(1, depth))),
        "truncated": changed(payload=good.payload[:-3]),
        "missing reference": changed(blob_refs=()),
        "stowaway": changed(blobs=(*good.blobs, b"not referred to")),
        "missing blob": changed(blobs=()),
        "newer schema": changed(payload=b"\x08\x63" + good.payload[2:]),
    }
    key = running.bus.keys.rpc("jobs", "done")
    for why, request in bad.items():
        with pytest.raises(RequestRefusedError) as caught:
            running.bus.request(key, codec.encode(calls.DoneRequest(job_id, lease.lease_id, request)))
        assert caught.value.code in (RefusalCode.INVALID, RefusalCode.UNKNOWN), why
        assert running.job_state(job_id) == "leased", why
    for other in ("another", lease.lease_id + "0"):
        with pytest.raises(RequestRefusedError):
            running.bus.request(key, codec.encode(calls.DoneRequest(job_id, other, good)))
    assert client.read("submap", 0) == []
    running.bus.request(key, codec.encode(calls.DoneRequest(job_id, lease.lease_id, good)))
    assert running.job_state(job_id) == "done"


# Disk


def test_below_the_reserve_the_ledger_refuses_and_says_so(tmp_path: Path) -> None:
    with site(tmp_path, f"ledger.reserve_bytes={2**60}") as running:
        frame = keyframe(0, b"image")
        with pytest.raises(DiskFullError, match="MiB"):
            running.client().append("keyframe", frame.keyframe_id, frame, [b"image"])
        running.jobs().submit([predict(0)])
        assert running.jobs().claim(PREDICT, [], "inference/a", 0.0) is None
        status = running.status()
        assert not status.is_accepting and "MiB" in status.detail
        assert status.position("keyframe") == 0


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own, of 24 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=24m", "none", str(folder)]
    if subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("cannot mount a small tmpfs: needs to be root")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)


@pytest.mark.parametrize("reserve_bytes", [4 * 2**20, 0])
def test_a_full_disk_damages_nothing_and_the_run_goes_on_when_there_is_space(
    tmp_path: Path, small_disk: Path, reserve_bytes: int
) -> None:
    filler = small_disk / "filler"
    filler.write_bytes(bytes(8 * 2**20))
    assignments = (f"ledger.reserve_bytes={reserve_bytes}",)
    with site(tmp_path, *assignments, directory=small_disk / "session") as running:
        running.jobs().submit([predict(0), predict(1)])
        lease = running.jobs().claim(PREDICT, [], "inference/a", 0.0)
        assert lease is not None
        stored = {}

        def append(number: int) -> bool:
            image = random.Random(number).randbytes(2**19)
            frame = keyframe(number, image)
            try:
                stored[number] = running.client().append("keyframe", frame.keyframe_id, frame, [image]).sequence
            except DiskFullError:
                return False
            return True

        number = next(number for number in range(100) if not append(number))
        assert 10 <= number < 40
        assert running.status().position("keyframe") == len(stored)
        if reserve_bytes:
            assert not running.status().is_accepting
            assert running.jobs().claim(PREDICT, [], "inference/b", 0.0) is None
            depth = depth_blob(0)
            assert running.jobs().done(lease, "submap", lease.job.job_id, submap(0, depth), [depth])
        filler.unlink()
        assert all(append(later) for later in range(number, number + 5))
        assert sorted(stored.values()) == list(range(len(stored)))
        for known in stored:
            image = random.Random(known).randbytes(2**19)
            assert running.client().blob(keyframe(known, image).image) == image
        assert running.jobs().claim(PREDICT, [], "inference/b", 0.0) is not None
        running.ledger.terminate()
        report = check(running.directory)
        assert report.is_sound and report.record_counts["keyframe"] == len(stored)
