"""Ledger and job clients against a small ledger in this process: what they send, repeat, verify and raise."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from bus_processes import connect, entry, event, serve
from vggt_motion.bus import calls, codec
from vggt_motion.bus.jobs import JobClient, many_lines, one_line
from vggt_motion.bus.ledger import LedgerClient
from vggt_motion.bus.session import Bus
from vggt_motion.errors import (
    BusUnavailableError,
    CodecError,
    DiskFullError,
    LedgerError,
    RefusalCode,
    RequestRefusedError,
)
from vggt_motion.records import (
    BlobRef,
    DoneOutcome,
    Job,
    JobKind,
    JobReport,
    JobState,
    Keyframe,
    Lease,
    LedgerStatus,
    MotionState,
    StreamPosition,
)

IMAGE = b"not really a PNG"
REF = BlobRef(hashlib.sha256(IMAGE).hexdigest(), len(IMAGE), "image/png")
KEYFRAME = Keyframe("front", 0, 3, 5, MotionState.LINEAR, 8, 6, REF)
JOB = Job("segment/000001", JobKind.PREDICT, b"spec", "vggt_motion.v1.SubmapSpec", 3, "sfm")
LEASE = Lease(JOB, "lease-1", 1, 10.0)


class FakeLedger:
    """Answers with what a test tells it to, and keeps what it was asked."""

    def __init__(self, bus: Bus, asker: Bus) -> None:
        self._bus = bus
        self._asker = asker
        self.asked: list[Any] = []
        self.answers: dict[str, Callable[[Any], Any]] = {}

    def on(self, service: str, call: str, request: type, answer: Callable[[Any], Any]) -> None:
        """Answer a call from now on: who asks next is heard."""

        def handler(_: str, payload: bytes) -> bytes:
            asked: Any = codec.decode(request, payload)
            self.asked.append(asked)
            return codec.encode(answer(asked))

        serve(self._bus, self._bus.keys.rpc(service, call), handler, asker=self._asker, threads=4)

    def blobs(self, content: bytes) -> None:
        """Answer every request for a blob with this content, from now on."""
        serve(self._bus, self._bus.keys.all_blobs(), lambda *_: content, asker=self._asker)


@pytest.fixture
def fake(endpoint: str, bus: Bus) -> Iterator[FakeLedger]:
    with connect(endpoint) as session:
        yield FakeLedger(session, bus)


def refusing(error: Exception) -> Callable[[Any], Any]:
    def answer(_: Any) -> Any:
        raise error

    return answer


def test_append_sends_the_record_its_identity_and_its_references(bus: Bus, fake: FakeLedger) -> None:
    fake.on("ledger", "append", calls.AppendRequest, lambda _: calls.AppendReply(7, False))
    result = LedgerClient(bus).append("keyframe", KEYFRAME.keyframe_id, KEYFRAME, [IMAGE])
    assert (result.sequence, result.was_known) == (7, False)
    (request,) = fake.asked
    assert (request.stream, request.record_id) == ("keyframe", "front/0/00000003")
    assert request.payload_type == "vggt_motion.v1.Keyframe"
    assert codec.decode(Keyframe, request.payload) == KEYFRAME
    assert request.identity_sha256 == codec.identity_digest(KEYFRAME)
    assert (request.blobs, request.blob_refs) == ((IMAGE,), (REF,))


def test_append_waits_for_a_ledger_that_is_not_there_yet(bus: Bus, fake: FakeLedger) -> None:
    timer = threading.Timer(
        1.0, lambda: fake.on("ledger", "append", calls.AppendRequest, lambda _: calls.AppendReply(0, True))
    )
    timer.start()
    assert LedgerClient(bus).append("event", "event-1", event(1)).was_known
    timer.join()
    with pytest.raises(BusUnavailableError, match="nobody answers"):
        JobClient(bus).submit([JOB])


def test_append_gives_up_when_its_patience_ends_or_when_told_to_stop(bus: Bus) -> None:
    with pytest.raises(BusUnavailableError, match="nobody answers"):
        LedgerClient(bus).append("event", "event-1", event(1), patience_s=0.5)
    threading.Timer(0.5, bus.interrupt).start()
    with pytest.raises(BusUnavailableError, match="stopping"):
        LedgerClient(bus).append("event", "event-1", event(1))


def test_refusals_are_not_repeated(bus: Bus, fake: FakeLedger) -> None:
    fake.on("ledger", "append", calls.AppendRequest, refusing(RequestRefusedError("known", RefusalCode.CONFLICT)))
    with pytest.raises(RequestRefusedError) as refused:
        LedgerClient(bus).append("event", "event-1", event(1))
    assert refused.value.code is RefusalCode.CONFLICT
    assert len(fake.asked) == 1
    fake.on("jobs", "done", calls.DoneRequest, refusing(DiskFullError("no space")))
    with pytest.raises(DiskFullError, match="no space"):
        JobClient(bus).done(LEASE, "event", "event-1", event(1))


def test_a_blob_that_belongs_to_no_record_is_not_sent(bus: Bus) -> None:
    with pytest.raises(CodecError, match="a blob of 5 bytes is not referred to"):
        LedgerClient(bus).append("keyframe", KEYFRAME.keyframe_id, KEYFRAME, [IMAGE, b"other"])


def test_read_is_checked_for_gaps_and_foreign_entries(bus: Bus, fake: FakeLedger) -> None:
    pages = {
        0: calls.ReadReply((entry(0), entry(1)), 9),
        5: calls.ReadReply((entry(5), entry(7)), 9),
        7: calls.ReadReply((entry(6),), 9),
        8: calls.ReadReply((entry(8), entry(9)), 9),
    }
    fake.on("ledger", "read", calls.ReadRequest, lambda request: pages[request.from_sequence])
    ledger = LedgerClient(bus)
    assert [item.record_id for item in ledger.read("event", 0)] == ["event-0", "event-1"]
    for start in (5, 7):
        with pytest.raises(CodecError, match="in place of"):
            ledger.read("event", start)
    with pytest.raises(CodecError, match="2 entries came where 1 were asked for"):
        ledger.read("event", 8, limit=1)


def test_blobs_are_verified(bus: Bus, fake: FakeLedger) -> None:
    fake.blobs(IMAGE)
    assert LedgerClient(bus).blob(REF) == IMAGE
    with pytest.raises(LedgerError, match="not its content"):
        LedgerClient(bus).blob(BlobRef("ab" * 32, len(IMAGE), "image/png"))
    with pytest.raises(LedgerError, match="not its content"):
        LedgerClient(bus).blob(BlobRef(REF.sha256, 3, "image/png"))


def test_several_blobs_come_in_order_and_are_asked_for_until_all_are_there(bus: Bus, fake: FakeLedger) -> None:
    contents = {codec.blob_ref(b"%d" % number, "image/png"): b"%d" % number for number in range(7)}
    of_hash = {ref.sha256: content for ref, content in contents.items()}
    fake.on(
        "ledger",
        "blobs",
        calls.BlobsRequest,
        lambda request: calls.BlobsReply(tuple(of_hash[sha256] for sha256 in request.sha256[:3])),
    )
    assert LedgerClient(bus).blobs([]) == []
    assert fake.asked == []
    assert LedgerClient(bus).blobs(list(contents)) == list(contents.values())
    assert [len(request.sha256) for request in fake.asked] == [7, 4, 1]


def test_several_blobs_are_verified_each(bus: Bus, fake: FakeLedger) -> None:
    answers = [(IMAGE, b"other"), (IMAGE, IMAGE, IMAGE)]
    fake.on("ledger", "blobs", calls.BlobsRequest, lambda _: calls.BlobsReply(answers.pop(0)))
    with pytest.raises(LedgerError, match="5 bytes came that are not its content"):
        LedgerClient(bus).blobs([REF, REF])
    with pytest.raises(CodecError, match="3 blobs came where 2 were asked for"):
        LedgerClient(bus).blobs([REF, REF])


def test_status(bus: Bus, fake: FakeLedger) -> None:
    status = LedgerStatus((StreamPosition("event", 4),), (), 10, 20, True, "", 0, "0a1b")
    fake.on("ledger", "status", calls.StatusRequest, lambda _: status)
    got = LedgerClient(bus).status()
    assert got == status
    assert (got.position("event"), got.position("graph"), got.job_count("open")) == (4, 0, 0)


def test_a_claim_whose_answer_was_lost_is_repeated_under_its_name(bus: Bus, fake: FakeLedger) -> None:
    outcomes: list[Any] = [BusUnavailableError("restarting"), calls.ClaimReply(LEASE), calls.ClaimReply(None)]

    def answer(_: Any) -> Any:
        outcome = outcomes.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    fake.on("jobs", "claim", calls.ClaimRequest, answer)
    client = JobClient(bus)
    with pytest.raises(BusUnavailableError, match="restarting"):
        client.claim([JobKind.PREDICT], ["sfm"], "inference/a", 0.1)
    assert client.claim([JobKind.PREDICT], ["sfm"], "inference/a", 0.1) == LEASE
    assert client.claim([JobKind.PREDICT], ["sfm"], "inference/a", 0.1) is None
    first, second, third = fake.asked
    assert first.claim_id == second.claim_id != third.claim_id
    assert (first.kinds, first.models, first.worker, first.wait_s) == ((JobKind.PREDICT,), ("sfm",), "inference/a", 0.1)


def test_two_threads_never_claim_under_one_name(bus: Bus, fake: FakeLedger) -> None:
    def answer(_: Any) -> Any:
        time.sleep(0.1)
        return calls.ClaimReply(None)

    fake.on("jobs", "claim", calls.ClaimRequest, answer)
    client = JobClient(bus)
    threads = [
        threading.Thread(target=client.claim, args=([JobKind.PREDICT], [], "inference/a", 0.1)) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert len({request.claim_id for request in fake.asked}) == 4


def test_done_is_repeated_until_it_is_answered(bus: Bus, fake: FakeLedger) -> None:
    outcomes: list[Any] = [BusUnavailableError("restarting")] * 2 + [calls.DoneReply(DoneOutcome.COMMITTED, 5)]

    def answer(_: Any) -> Any:
        outcome = outcomes.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    fake.on("jobs", "done", calls.DoneRequest, answer)
    assert JobClient(bus).done(LEASE, "keyframe", KEYFRAME.keyframe_id, KEYFRAME, [IMAGE])
    assert len(fake.asked) == 3
    assert len({codec.encode(request) for request in fake.asked}) == 1
    assert (fake.asked[0].job_id, fake.asked[0].lease_id) == (JOB.job_id, "lease-1")
    assert fake.asked[0].result.blobs == (IMAGE,)


@pytest.mark.parametrize(
    ("outcome", "is_done"),
    [(DoneOutcome.COMMITTED, True), (DoneOutcome.ALREADY_DONE, True), (DoneOutcome.DROPPED, False)],
)
def test_what_became_of_a_result(bus: Bus, fake: FakeLedger, outcome: DoneOutcome, is_done: bool) -> None:
    fake.on("jobs", "done", calls.DoneRequest, lambda _: calls.DoneReply(outcome))
    assert JobClient(bus).done(LEASE, "event", "event-1", event(1)) is is_done


def test_fail_sends_what_the_wire_allows_whatever_the_exception_said(bus: Bus, fake: FakeLedger) -> None:
    fake.on("jobs", "fail", calls.FailRequest, lambda _: calls.FailReply(True))
    assert JobClient(bus).fail(LEASE, "first line\n\x1b[31msecond\ud800 line" + "x" * 9000, "trace\n\x00back\n" * 9000)
    (request,) = fake.asked
    assert request.reason.startswith("first line ?[31msecond? line")
    assert request.traceback.endswith("trace\n?back\n")
    assert one_line("") == many_lines("") == ""


def test_heartbeat_cancel_and_submit(bus: Bus, fake: FakeLedger) -> None:
    fake.on(
        "jobs", "heartbeat", calls.HeartbeatRequest, lambda request: calls.HeartbeatReply(request.lease_id == "lease-1")
    )
    fake.on("jobs", "cancel", calls.CancelRequest, lambda request: calls.CancelReply(len(request.job_ids)))
    fake.on("jobs", "submit", calls.SubmitRequest, lambda request: calls.SubmitReply(len(request.jobs), 1))
    client = JobClient(bus)
    assert client.heartbeat("lease-1")
    assert not client.heartbeat("lease-2")
    assert client.cancel(["a", "b"]) == 2
    large = [Job(f"job-{number}", JobKind.PREDICT, bytes(4 * 2**20), JOB.payload_type) for number in range(6)]
    assert client.submit(large) == (6, 2)  # in two requests
    assert client.submit([]) == (0, 0)  # without a request


def test_reports_come_in_pages(bus: Bus, fake: FakeLedger) -> None:
    reports = [
        JobReport(
            f"job-{number:04d}", JobKind.REGISTER, JobState.DEAD, 3, 0, "registration/a", "no overlap", "trace\nback"
        )
        for number in range(1203)
    ]

    def answer(request: calls.ReportsRequest) -> calls.ReportsReply:
        rest = [report for report in reports if report.job_id > request.after_job_id]
        return calls.ReportsReply(tuple(rest[: min(request.limit, 400)]))

    fake.on("jobs", "reports", calls.ReportsRequest, answer)
    assert JobClient(bus).reports(JobState.DEAD) == reports
    assert {request.state for request in fake.asked} == {JobState.DEAD}
