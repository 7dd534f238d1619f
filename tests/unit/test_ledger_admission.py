"""What is let into the log, and what hostile bytes do at the desk: without a bus, so that there can be many of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ledger_processes import depth_blob, event, keyframe, predict, submap
from vggt_motion.bus import calls, codec
from vggt_motion.bus.ledger import append_request
from vggt_motion.config import LedgerConfig
from vggt_motion.errors import BusUnavailableError, CodecError, LedgerError, RequestRefusedError
from vggt_motion.ledger.admission import admitted
from vggt_motion.ledger.directory import Ledger
from vggt_motion.ledger.service import Desk, Presence, dead_event, open_session
from vggt_motion.records import Event, EventKind, JobKind, JobReport, JobState, Stream

# Many more, and told apart by what is wrong with them, are in tests/services/faults/test_hostile_bytes.py.
FUZZ = settings(
    max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
DEPTH = depth_blob(0)


def good_requests() -> list[calls.AppendRequest]:
    image = b"image" * 10
    frame = keyframe(3, image)
    result = submap(0, DEPTH)
    return [
        append_request("event", "event-1", event(1), []),
        append_request("keyframe", frame.keyframe_id, frame, [image]),
        append_request("submap", result.record_id, result, [DEPTH]),
    ]


@pytest.fixture(scope="module")
def ledger(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ledger]:
    opened = open_session(tmp_path_factory.mktemp("desk") / "session", LedgerConfig(reserve_bytes=0))
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def desk(ledger: Ledger) -> Desk:
    return Desk(ledger, lambda: None)


@pytest.mark.parametrize("request_", good_requests(), ids=lambda request: request.stream)
def test_records_of_their_stream_are_admitted(request_: calls.AppendRequest) -> None:
    record, blobs, references = admitted(codec.decode(calls.AppendRequest, codec.encode(request_)))
    assert (record.stream, record.record_id, record.payload) == (
        request_.stream,
        request_.record_id,
        request_.payload,
    )
    assert [blob.data for blob in blobs] == list(request_.blobs)
    assert {(entry.sha256, entry.size_bytes) for entry in references} == {
        (ref.sha256, ref.size_bytes) for ref in request_.blob_refs
    }


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"stream": "nonsense"}, "there is no stream 'nonsense'"),
        ({"stream": "descriptor"}, "takes no records"),
        ({"stream": "segment"}, "stream segment holds vggt_motion.v1.Segment"),
        ({"payload_type": "vggt_motion.v1.Keyframe"}, "stream event holds vggt_motion.v1.Event"),
        ({"record_id": "event-2"}, "is not that of the record, 'event-1'"),
        ({"payload": b"\xff\xff"}, "Event"),
        ({"payload": b""}, "schema_version is missing"),
        ({"payload": b"\x08\x02"}, "newer"),
        ({"blobs": (b"stowaway",)}, "does not refer to"),
        ({"blob_refs": (codec.blob_ref(b"x", "image/png"),)}, "blob_refs of 'event-1'"),
    ],
)
def test_everything_else_is_refused_with_a_reason(change: dict[str, Any], reason: str) -> None:
    with pytest.raises((CodecError, RequestRefusedError), match=reason) as caught:
        admitted(dataclasses.replace(good_requests()[0], **change))
    assert "\n" not in str(caught.value)


def append_one(desk: Desk, payload: bytes) -> bytes:
    (outcome,) = desk.append([payload])
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


ENTRIES: dict[str, Callable[[Desk, bytes], bytes]] = {
    "append": append_one,
    "read": Desk.read,
    "status": Desk.answer_status,
    "submit": Desk.submit,
    "claim": lambda desk, payload: desk.claim(payload, Presence()),
    "heartbeat": Desk.heartbeat,
    "done": Desk.done,
    "fail": Desk.fail,
    "reports": Desk.reports,
    "cancel": Desk.cancel,
}


def refusal_of(entry: str, desk: Desk, payload: bytes) -> Exception | None:
    """How the desk refuses; anything but a refusal or an answer is a defect."""
    try:
        ENTRIES[entry](desk, payload)
    except (CodecError, RequestRefusedError) as error:
        return error
    return None


def refused(entry: str, desk: Desk, payload: bytes) -> bool:
    """Whether the desk refuses, in one line that is not too long."""
    refusal = refusal_of(entry, desk, payload)
    assert refusal is None or ("\n" not in str(refusal) and len(str(refusal)) < 1000)
    return refusal is not None


def state_of(ledger: Ledger) -> tuple[object, ...]:
    return (ledger.store.positions(), ledger.jobs.counts(), sorted(ledger.blobs.names()))


@pytest.mark.parametrize("entry", ENTRIES)
@FUZZ
@given(payload=st.binary(min_size=1, max_size=300))
def test_random_bytes_are_refused_and_change_nothing(ledger: Ledger, desk: Desk, entry: str, payload: bytes) -> None:
    before = state_of(ledger)
    assert refused(entry, desk, payload)
    assert state_of(ledger) == before


GOOD = {
    "append": [codec.encode(request) for request in good_requests()],
    "done": [codec.encode(calls.DoneRequest("submap/000000/r1", "guessed", good_requests()[2]))],
    "submit": [codec.encode(calls.SubmitRequest((predict(0), predict(1))))],
    "claim": [codec.encode(calls.ClaimRequest((JobKind.DESCRIBE,), ("sfm",), "inference/a", 0.0, "claim"))],
    "fail": [codec.encode(calls.FailRequest("submap/000000/r1", "guessed", "why", "trace", True))],
}


@pytest.mark.parametrize("entry", GOOD)
@FUZZ
@given(data=st.data())
def test_damaged_requests_are_refused_or_still_mean_something(
    ledger: Ledger, desk: Desk, entry: str, data: st.DataObject
) -> None:
    payload = bytearray(data.draw(st.sampled_from(GOOD[entry])))
    for position, value in data.draw(
        st.lists(st.tuples(st.integers(0, len(payload) - 1), st.integers(0, 255)), min_size=1, max_size=4)
    ):
        payload[position] = value
    cut = data.draw(st.none() | st.integers(1, len(payload) - 1))
    if entry == "claim" and cut is None and b"sfm" not in payload[:200]:
        cut = len(payload) // 2
    before = state_of(ledger)
    if refused(entry, desk, bytes(payload[:cut])):
        # Blobs may have been stored before the row was refused; nothing refers to them.
        assert state_of(ledger)[:2] == before[:2]
    for stream in Stream:
        for row in ledger.store.read(stream.value, before[0].get(stream.value, 0)):  # type: ignore[attr-defined]
            codec.decode(codec.STREAM_RECORDS[stream], row.payload)


def test_refusals_are_counted(tmp_path: Path) -> None:
    ledger = open_session(tmp_path / "session", LedgerConfig(reserve_bytes=0))
    desk = Desk(ledger, lambda: None)
    outcomes = desk.append([b"", b"\xff", GOOD["append"][0]])
    assert [type(outcome) for outcome in outcomes] == [CodecError, CodecError, bytes]
    assert desk.status().refused_request_count == 2
    with pytest.raises(CodecError):
        desk.guarded(lambda _, payload: desk.submit(payload))("key", b"\xff")
    assert desk.status().refused_request_count == 3
    ledger.close()


def test_a_failing_store_is_unavailable_and_ends_the_service(tmp_path: Path) -> None:
    ledger = open_session(tmp_path / "session", LedgerConfig(reserve_bytes=0))
    desk = Desk(ledger, lambda: None)
    ledger.rows.close()
    assert [type(outcome) for outcome in desk.append(GOOD["append"][:2])] == [BusUnavailableError] * 2
    assert isinstance(desk.failure, LedgerError)
    desk.failure = None
    with pytest.raises(BusUnavailableError):
        desk.guarded(lambda _, payload: desk.submit(payload))("key", GOOD["submit"][0])
    assert isinstance(desk.failure, LedgerError)
    ledger.close()


def test_the_event_of_a_dead_job_has_one_identity_whenever_it_is_made() -> None:
    report = JobReport("submap/000001/r1", JobKind.PREDICT, JobState.DEAD, 3, 1, "inference/a", "why", "Traceback\n  x")
    first, second = dead_event(report, time_ns=1), dead_event(report, time_ns=2)
    assert first.identity_sha256 == second.identity_sha256
    decoded = codec.decode(Event, first.payload)
    assert (decoded.kind, decoded.event_id) == (EventKind.JOB_DEAD, "job_dead/submap/000001/r1")
    assert decoded.detail == {
        "job_id": "submap/000001/r1",
        "kind": "predict",
        "reason": "why",
        "traceback": "Traceback\n  x",
    }


# Who has vanished


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_a_token_that_ends_is_believed_after_a_moment() -> None:
    clock = Clock()
    presence = Presence(clock)
    presence.on_token("vggt_motion/@v1/s/alive/inference/a", True)
    presence.on_token("vggt_motion/@v1/s/alive/inference/a", False)
    assert presence.take_vanished(is_connected=True) == []
    clock.now_s += 0.3
    assert presence.take_vanished(is_connected=True) == ["inference/a"]
    assert presence.take_vanished(is_connected=True) == [], "once"


def test_a_token_that_comes_back_in_time_has_not_vanished() -> None:
    clock = Clock()
    presence = Presence(clock)
    presence.on_token("vggt_motion/@v1/s/alive/inference/a", False)
    clock.now_s += 0.1
    presence.on_token("vggt_motion/@v1/s/alive/inference/a", True)
    clock.now_s += 10
    assert presence.take_vanished(is_connected=True) == []


def test_while_our_own_link_is_down_nobody_has_vanished() -> None:
    clock = Clock()
    presence = Presence(clock)
    for name in ("back", "gone"):
        presence.on_token(f"vggt_motion/@v1/s/alive/inference/{name}", False)
    for _ in range(20):
        clock.now_s += 0.25
        assert presence.take_vanished(is_connected=False) == []
    presence.on_token("vggt_motion/@v1/s/alive/inference/back", True)
    assert presence.take_vanished(is_connected=True) == []
    clock.now_s += 2.1
    assert presence.take_vanished(is_connected=True) == ["inference/gone"]


def test_a_lease_for_a_worker_that_has_vanished_is_taken_back() -> None:
    clock = Clock()
    presence = Presence(clock)
    presence.on_lease("inference/a")
    presence.on_token("vggt_motion/@v1/s/alive/inference/a", False)
    clock.now_s += 1
    assert presence.take_vanished(is_connected=True) == ["inference/a"]
    presence.on_lease("inference/a")  # its claim was on its way
    clock.now_s += 2.1
    assert presence.take_vanished(is_connected=True) == ["inference/a"]
