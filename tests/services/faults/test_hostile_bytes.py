"""Hostile bytes on every entry: one clear refusal that is counted, and nothing else changes."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import random
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import hostile
import httpx
import psutil
import pytest
from hostile import ANYTHING, ENTRIES, REFUSALS, SESSION, SUBMAPS, UNPARSED, Case, Entry, Maker, Pick
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families

from ledger_helpers import stored_blobs
from live_session import LiveSession, Service, live_session, wait_for
from vggt_motion.bus import calls, codec
from vggt_motion.bus.images import decode_image, encode_image
from vggt_motion.bus.jobs import JobClient
from vggt_motion.bus.ledger import LedgerClient
from vggt_motion.bus.parcels import _identity
from vggt_motion.bus.serving import BUNDLE_ENCODING
from vggt_motion.bus.session import Bus, open_bus
from vggt_motion.errors import BusUnavailableError, CodecError, RefusalCode, RequestRefusedError
from vggt_motion.records import BlobRef, Constraint, DoneOutcome, Job, JobKind, Lease, Stream, SubmapGeometry
from vggt_motion.sources.registry import open_source
from vggt_motion.sources.source import Frame
from vggt_motion.v1 import jobs_pb2, ledger_pb2

pytestmark = [pytest.mark.faults, pytest.mark.timeout(1800)]
CASES = 20_000
LEAST_OF_A_KIND = 200
LIVE_CASES = 200
LIVE_OF_A_KIND = 20
MIB = 2**20
CALL_BYTES = 512 * MIB
MEMORY_FOR_CALLS = 8 * 2**30  # a message of that length is there several times, in three processes
Tally = Callable[[str, str], "Counter[str]"]


# --- decoding and validation -----------------------------------------------------------------------------------------
@st.composite
def cases(draw: st.DrawFn, entry: Entry) -> tuple[str, Case]:
    kind = draw(st.sampled_from(list(entry.kinds)))
    return kind, entry.kinds[kind](lambda n: draw(st.integers(0, n - 1)))


@pytest.mark.parametrize("name", ENTRIES)
def test_whatever_comes_is_taken_or_refused_for_what_is_wrong_with_it(
    name: str, generator: random.Random, tally: Tally
) -> None:
    entry = ENTRIES[name]
    for _ in range(100):
        entry.take(entry.sound(generator.randrange))
    counts: Counter[str] = Counter()
    distinct = set()

    @seed(generator.getrandbits(64))
    @settings(max_examples=CASES, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(cases(entry))
    def attack(kind_and_case: tuple[str, Case]) -> None:
        kind, case = kind_and_case
        refusal = refusal_by(entry, case)
        if refusal is None:
            assert case.reason is None, f"{kind} was taken"
            outcome = "taken"
        else:
            assert refusal and "\n" not in refusal and len(refusal) < 2000
            assert case.reason is None or re.search(case.reason, refusal), f"{kind}: {refusal}"
            outcome = "unparsed" if re.search(UNPARSED, refusal) else "content"
        counts.update((kind, outcome))
        tally(name, kind).update(("cases", outcome))
        distinct.add((case.payload, case.attachment))

    attack()
    assert sum(counts[kind] for kind in entry.kinds) >= CASES
    assert min(counts[kind] for kind in entry.kinds) >= LEAST_OF_A_KIND, counts
    assert counts["content"] >= CASES / 3, "too few are whole on the wire"
    assert len(distinct) >= CASES / 2


def refusal_by(entry: Entry, case: Case) -> str | None:
    """What is said to a message: the same whether what is long in it is copied or looked at where it lies."""
    said: list[str | None] = []
    for lifted_from_bytes in (2**16, 0):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(codec, "LIFTED_FROM_BYTES", lifted_from_bytes)
            try:
                entry.take(case)
            except REFUSALS as error:
                said.append(str(error))
            else:
                said.append(None)
    assert said[0] == said[1]
    return said[0]


OF_STREAM = {one.request.stream: one for one in hostile.BRINGING}
# Each message with a sound one of it and how long it may be.
BOUNDS: dict[str, tuple[type[Any], bytes, int]] = {
    "claim": (calls.ClaimRequest, hostile.sound_claim(lambda n: n - 1).SerializeToString(), hostile.CLAIM_BYTES),
    "append": (calls.AppendRequest, b"", CALL_BYTES),
    "done": (calls.DoneRequest, b"", CALL_BYTES),
    **{
        stream: (codec.STREAM_RECORDS[Stream(stream)], OF_STREAM[stream].request.payload, bound)
        for stream, bound in hostile.RECORD_BYTES.items()
    },
}


@pytest.mark.parametrize("name", BOUNDS)
def test_a_message_may_be_as_long_as_it_may_be_and_not_a_byte_longer(name: str) -> None:
    cls, sound, bound = BOUNDS[name]
    too_long = bytes(bound + 1)
    if sound:  # of the longest ones a whole message takes seconds and gigabytes
        assert codec.decode(cls, hostile.padded(sound, bound)) is not None
        too_long = hostile.padded(sound, bound + 1)
    with pytest.raises(REFUSALS, match=f"{bound + 1} bytes are more than the allowed {bound}"):
        codec.decode(cls, too_long)


def picture_message(size: int) -> bytes:
    """A sound image message whose picture is so long: its scan goes on for ever."""
    data = hostile.PICTURES["jpeg"]
    return hostile.image_message(data[:-2] + bytes(size - len(data)) + data[-2:], "jpeg")


def test_a_picture_may_be_as_long_as_it_may_be_and_not_a_byte_longer() -> None:
    assert len(decode_image(picture_message(hostile.PICTURE_BYTES)).encoded) == hostile.PICTURE_BYTES
    with pytest.raises(CodecError, match="an image of 134217729 bytes, allowed are 134217728"):
        decode_image(picture_message(hostile.PICTURE_BYTES + 1))


# --- a live session --------------------------------------------------------------------------------------------------
class Target:
    """A live session, what hostile messages may not change in it, and how many were refused there."""

    def __init__(self, session: LiveSession, images: list[Frame]) -> None:
        self.session = session
        self._images = iter(images)
        self._indices = itertools.count()
        self._ledger = next(service for service in session.services if service.name == "ledger")
        self.frontend = session.start("frontend", "--source", "zenoh:front")
        self.recorder = session.started("recorder", "--directory", str(session.folder))
        self.gateway = session.started("gateway")
        self.camera = session.bus.publisher(session.bus.keys.image("front"), blocking=True, history=16)
        wait_for(lambda: session.ledger.read(Stream.EVENT, 0, patience_s=30.0), "the frontend's first record")
        self.taken_images = self.recorded_images = 0
        self.leases = self._handed_out()
        self.show(10)
        self.begin()

    def begin(self) -> None:
        """Count from here, whatever was before."""
        self.before = self._state()
        self.refused = self.session.ledger.status().refused_request_count
        self.refused_images = Counter(
            frontend=self.counter(self.frontend, "refused_frames", "unreadable_frames"),
            recorder=self.counter(self.recorder, "refused_images"),
        )

    def _handed_out(self) -> dict[str, Lease]:
        """Leases on jobs whose results hostile messages pretend to be; one job more is left for them to claim."""
        jobs = JobClient(self.session.bus)
        results = [(submap.record_id, JobKind.PREDICT) for submap in SESSION.submaps]
        results += [(constraint.record_id, JobKind.REGISTER) for constraint in SESSION.constraints]
        jobs.submit([Job(job_id, kind, b"spec", "test.Spec") for job_id, kind in results])
        leases = [jobs.claim([kind], [], "inference/test", 0.0) for _, kind in results]
        jobs.submit([Job(f"open/{kind}", kind, b"spec", "test.Spec") for kind in JobKind])
        return {lease.job.job_id: lease for lease in leases if lease is not None}

    def next_header(self) -> bytes:
        """Of a frame that the frontend takes from the bus: it numbers them in the same way."""
        return hostile.image_header(next(self._indices))

    def show(self, count: int) -> None:
        """Sound frames: they are all taken, and when that is over, the session stands still."""
        for frame in itertools.islice(self._images, count):
            self.camera.put(encode_image(frame, "front"), attachment=self.next_header())
        self.taken_images += count
        self.recorded_images += count
        wait_for(self._has_all_frames, "all frames")
        wait_for(self._is_all_sent, "the frontend's keyframes")
        self.before = self._state()

    def _has_all_frames(self) -> bool:
        counts = (self.counter(self.frontend, "frames"), self.counter(self.recorder, "frames"))
        return counts == (self.taken_images, self.recorded_images)

    def _is_all_sent(self) -> bool:
        status = self.session.ledger.status()
        sent = (status.position("keyframe"), status.position("segment"))
        return sent == (self.counter(self.frontend, "keyframes"), self.counter(self.frontend, "segments"))

    def _state(self) -> tuple[object, ...]:
        status = self.session.ledger.status()
        return status.positions, status.job_counts, stored_blobs(self.session.folder / "ledger")

    def counter(self, service: Service, *names: str) -> float:
        report = self.session.report_of(service)
        return -1.0 if report is None else sum(report.counters.get(name, 0.0) for name in names)

    def counts_refusals(self, count: int = 1) -> None:
        """So many requests have been refused since, and nothing was done for them."""
        self.refused += count
        status = self.session.ledger.status()
        assert status.refused_request_count == self.refused
        assert (status.positions, status.job_counts) == self.before[:2]

    def is_unchanged(self) -> None:
        """All that is kept is what it was, everybody is alive, and the metrics say how many were refused."""
        assert self._state() == self.before
        for service in self.session.services:
            assert service.process.poll() is None
            assert "Traceback" not in service.text()
        wait_for(lambda: self._metrics() == self._expected_metrics(), "the metrics")
        wait_for(self._has_all_frames, "all frames, and no others")

    def _expected_metrics(self) -> dict[str, float]:
        return {
            "status": self.refused,
            "total": self.refused,
            "ledger": self.refused,
            "frontend": self.refused_images["frontend"],
            "recorder": self.refused_images["recorder"],
        }

    def _metrics(self) -> dict[str, float]:
        """Refusals as the gateway shows them: in its status and its metrics, and among what the services count."""
        port = int(self.counter(self.gateway, "port"))
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60) as client:
            shown = {"status": client.get("/api/v1/status").json()["ledger"]["refused_requests"]}
            families = text_string_to_metric_families(client.get("/metrics").text)
        names = ("refused_requests", "refused_frames", "unreadable_frames", "refused_images")
        for sample in (sample for family in families for sample in family.samples):
            if sample.name == "vggt_motion_ledger_refused_requests_total":
                shown["total"] = sample.value
            elif sample.labels.get("name") in names:
                service = sample.labels["service"]
                shown[service] = shown.get(service, 0.0) + sample.value
        return shown

    def resident_bytes(self) -> int:
        return psutil.Process(self._ledger.process.pid).memory_info().rss

    @contextlib.contextmanager
    def needs_less_than(self, size_bytes: int) -> Iterator[None]:
        """The ledger's memory does not grow by more meanwhile, not even for a moment."""
        process = Path(f"/proc/{self._ledger.process.pid}")
        (process / "clear_refs").write_text("5")  # the peak begins anew: proc(5)
        before = self.resident_bytes()
        yield
        peak = re.search(r"VmHWM:\s+(\d+) kB", (process / "status").read_text())
        assert peak is not None and int(peak[1]) * 1024 - before < size_bytes


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory, sample_dir: Path) -> Iterator[Target]:
    folder = tmp_path_factory.mktemp("hostile")
    images = list(open_source(str(sample_dir / "kitti_06_first51"), end=30).frames())
    sections: dict[str, dict[str, Any]] = {
        "spool": {"directory": str(folder / "spool")},
        "ledger": {"reserve_bytes": 0, "lease_duration_s": 600.0},
    }
    with live_session(folder, **sections) as session:
        yield Target(session, images)


@pytest.fixture
def target(attacked: Target) -> Target:
    attacked.begin()
    return attacked


def refused_cases(entry: Entry, make: Maker, pick: Pick, count: int) -> Iterator[Case]:
    """Cases of a kind that are no sound messages any more."""
    found = 0
    while found < count:
        case = make(pick)
        if case.reason is None and refusal_by(entry, case) is None:
            continue
        yield dataclasses.replace(case, reason=case.reason or ANYTHING)
        found += 1


def assert_refused(bus: Bus, key: str, case: Case, encoding: str = "") -> None:
    with pytest.raises(RequestRefusedError) as caught:
        bus.request(key, case.payload, encoding=encoding)
    text = str(caught.value)
    assert text and "\n" not in text and len(text) <= 1000
    assert caught.value.code in (RefusalCode.INVALID, RefusalCode.UNKNOWN), text
    assert re.search(case.reason or ANYTHING, text), text


# What only shows where there are blobs, leases and a queue.
def _without_a_blob(wrap: Callable[[ledger_pb2.AppendRequest], Any]) -> Maker:
    def make(pick: Pick) -> Case:
        request = SUBMAPS[pick(len(SUBMAPS))].copy().whole()
        del request.blobs[pick(len(request.blobs))]
        return Case(wrap(request).SerializeToString(), "no blob [0-9a-f]{64} of")

    return make


def _with_an_unknown_lease(pick: Pick) -> Case:
    message = jobs_pb2.DoneRequest.FromString(hostile.DONE.sound(pick).payload)
    message.lease_id = f"lease{pick(2**32)}"
    return Case(message.SerializeToString(), "was never handed out for job")


def _with_too_many_models(pick: Pick) -> Case:
    claim = hostile.sound_claim(pick)
    claim.models.extend([f"model{number}" for number in range(63 + pick(190))])
    return Case(claim.SerializeToString(), "more than 64 models in one claim")


def live_entry(name: str, leases: Mapping[str, str]) -> tuple[Entry, dict[str, Maker]]:
    """An entry as it is in a session with leases, and all that can be wrong there."""
    if name == "claim":
        return hostile.CLAIM, {**hostile.CLAIM.kinds, "too many models": _with_too_many_models}
    if name == "append":
        return hostile.APPEND, {**hostile.APPEND.kinds, "missing blob": _without_a_blob(lambda request: request)}
    entry = hostile.done_entry(leases)
    wrap = hostile.result_of(leases)
    return entry, {
        **entry.kinds,
        "missing blob": _without_a_blob(wrap),
        "unknown lease": _with_an_unknown_lease,
    }


KEYS = {"append": ("ledger", "append"), "claim": ("jobs", "claim"), "done": ("jobs", "done")}


@pytest.mark.parametrize("name", KEYS)
def test_hostile_requests_are_refused_and_counted_and_change_nothing(
    target: Target, name: str, generator: random.Random, tally: Tally
) -> None:
    bus = target.session.bus
    key = bus.keys.rpc(*KEYS[name])
    entry, kinds = live_entry(name, {job_id: lease.lease_id for job_id, lease in target.leases.items()})
    for kind, make in kinds.items():
        # A bomb that went off would take up to a gigabyte.
        with target.needs_less_than(256 * MIB):
            for case in refused_cases(entry, make, generator.randrange, LIVE_OF_A_KIND):
                assert_refused(bus, key, case)
                target.counts_refusals()
                tally(name, kind)["live"] += 1
    assert LIVE_OF_A_KIND * len(kinds) >= LIVE_CASES
    target.is_unchanged()


def too_long_requests(wrap: Callable[[ledger_pb2.AppendRequest], Any]) -> Iterator[Case]:
    """Noise, and what is beyond the bounds of a record, of a blob, and of how many parts there may be."""
    yield Case(random.Random(0).randbytes(3_000_000), "not a valid message")
    for stream, bound in (("submap", 8 * MIB), ("submap", 32 * MIB), ("constraint", 8 * MIB)):
        bringing = OF_STREAM[stream].copy()
        bringing.request.payload = hostile.padded(bringing.request.payload, bound + 1)
        reason = f"{bound + 1} bytes are more than the allowed {bound}|has {bound + 1} bytes, allowed"
        yield Case(wrap(bringing.request).SerializeToString(), reason)
    bringing = SUBMAPS[0].copy()
    bringing.put_depth(lambda _: 0, bytes(128 * MIB + 1))
    yield Case(wrap(bringing.whole()).SerializeToString(), "has 134217729 bytes|is 134217729, allowed")
    bringing = SUBMAPS[0].copy()
    bringing.request.blobs[0] = bytes(128 * MIB + 1)
    yield Case(wrap(bringing.request).SerializeToString(), "has 134217729 bytes, allowed are 0 to 134217728")
    bringing = SUBMAPS[0].copy()
    bringing.request.MergeFromString(b"\x42\x00" * 2**20)  # blob_refs
    yield Case(wrap(bringing.request).SerializeToString(), "has too many elements")


@pytest.mark.parametrize("name", ["append", "done"])
def test_oversized_requests_are_refused_and_their_memory_is_given_back(target: Target, name: str, tally: Tally) -> None:
    bus = target.session.bus
    key = bus.keys.rpc(*KEYS[name])
    wrap = hostile.result_of({}) if name == "done" else lambda request: request
    before = target.resident_bytes()
    for case in too_long_requests(wrap):
        assert_refused(bus, key, case)
        target.counts_refusals()
        tally(name, "oversized")["live"] += 1
    assert target.resident_bytes() - before < 400 * MIB  # some of it is kept for what comes next
    if psutil.virtual_memory().available > MEMORY_FOR_CALLS:
        payload = hostile.padded(wrap(SUBMAPS[0].request).SerializeToString(), CALL_BYTES + 1)
        asked: Any = bus._session.get(key, payload=payload, timeout=120.0)  # Bus would not send it
        refusal = codec.decode(calls.Refusal, asked.recv().err.payload.to_bytes())
        assert "536870913 bytes are more than the allowed 536870912" in refusal.message
        target.counts_refusals()
        tally(name, "oversized")["live"] += 1
    target.is_unchanged()


def test_hostile_bundles_are_refused_and_those_beside_a_hostile_request_are_answered(
    target: Target, generator: random.Random, tally: Tally
) -> None:
    bus = target.session.bus
    key = bus.keys.rpc("ledger", "append")
    kinds = {kind: make for kind, make in hostile.BUNDLE.kinds.items() if kind != "hostile among others"}
    as_a_whole = dataclasses.replace(hostile.BUNDLE, take=lambda case: codec.decode(calls.Bundle, case.payload))
    for kind, make in kinds.items():
        for case in refused_cases(as_a_whole, make, generator.randrange, LIVE_CASES // len(kinds)):
            # What is no bundle is looked at as a request, and refused as one.
            assert_refused(bus, key, dataclasses.replace(case, reason=ANYTHING), BUNDLE_ENCODING)
            target.counts_refusals()
            tally("bundle", kind)["live"] += 1
    # Known already, so that it is acknowledged, and nothing changes.
    (known, *_) = target.session.ledger.read(Stream.EVENT, 0)
    event = codec.decode(codec.STREAM_RECORDS[Stream.EVENT], known.payload)
    sound = calls.AppendRequest(
        known.stream, known.record_id, known.payload_type, known.payload, codec.identity_digest(event)
    )
    for kind, make in hostile.APPEND.kinds.items():
        (case,) = refused_cases(hostile.APPEND, make, generator.randrange, 1)
        bundle = calls.Bundle((codec.encode(sound), case.payload, codec.encode(sound)))
        reply = codec.decode(calls.BundleReply, bus.request(key, codec.encode(bundle), encoding=BUNDLE_ENCODING))
        first, hostile_one, last = reply.answers
        assert first.refusal is None and last.refusal is None
        assert codec.decode(calls.AppendReply, first.payload) == calls.AppendReply(known.sequence, True)
        assert hostile_one.refusal is not None, kind
        assert re.search(case.reason or ANYTHING, hostile_one.refusal.message)
        target.counts_refusals()
        tally("bundle", "hostile among others")["live"] += 1
    target.is_unchanged()


def test_attachments_that_are_no_parcels_are_refused(
    target: Target, generator: random.Random, tally: Tally, tmp_path: Path
) -> None:
    def ask(attachment: bytes) -> calls.Refusal:
        asked: Any = target.session.bus._session.get(key, payload=b"", attachment=attachment, timeout=10.0)
        return codec.decode(calls.Refusal, asked.recv().err.payload.to_bytes())

    key = target.session.bus.keys.rpc("ledger", "append")
    for kind, make in hostile.PARCEL.kinds.items():
        for case in refused_cases(hostile.PARCEL, make, generator.randrange, LIVE_CASES // len(hostile.PARCEL.kinds)):
            assert "schema_version is missing" in ask(case.payload).message  # what is in the message counts: nothing
            target.counts_refusals()
            tally("parcel", kind)["live"] += 1
    with _foreign_parcels(target.session.bus, tmp_path) as foreign:
        for attachment in foreign:
            assert ask(attachment).code is RefusalCode.UNAVAILABLE
            target.counts_refusals(0)  # nothing was asked yet: it is to be sent
            tally("parcel", "foreign")["live"] += 1
    target.is_unchanged()


@contextlib.contextmanager
def _foreign_parcels(bus: Bus, tmp_path: Path) -> Iterator[list[bytes]]:
    """Attachments that name what is there, but is no parcel, or not of this length; and what is not there."""
    if bus._parcels.greeting is None:
        yield []
        return
    folder_id = codec.decode(calls.Parcel, bus._parcels.greeting).folder_id
    folder = next(path for path in Path("/dev/shm").glob("vggt_motion-*") if _identity(path) == folder_id)
    (folder / "link").symlink_to(tmp_path)
    os.mkfifo(folder / "pipe")
    (folder / "short").write_bytes(b"short")
    named = [calls.Parcel(folder_id, name, 2**20) for name in ("link", "pipe", "short", "nothing")]
    yield [codec.encode(parcel) for parcel in (*named, calls.Parcel("0" * 32, "short", 5))]
    for name in ("link", "pipe", "short"):
        (folder / name).unlink()


def test_hostile_images_are_refused_and_counted_by_all_who_read_them(
    target: Target, generator: random.Random, tally: Tally
) -> None:
    def send(kind: str, case: Case, readers: tuple[str, ...]) -> None:
        target.camera.put(case.payload, attachment=case.attachment)
        target.refused_images.update(readers)
        tally("image", kind)["live"] += 1

    both = ("frontend", "recorder")
    for kind, make in hostile.IMAGE.kinds.items():
        for case in refused_cases(hostile.IMAGE, make, generator.randrange, LIVE_OF_A_KIND):
            send(kind, case, both)
    too_long = picture_message(hostile.PICTURE_BYTES + 1)
    send("oversized", Case(too_long, None, hostile.image_header(2**31)), both)
    assert LIVE_OF_A_KIND * len(hostile.IMAGE.kinds) >= LIVE_CASES
    for number in range(LIVE_OF_A_KIND):
        # Sound in itself: only who has seen the frames before can tell.
        other_size = hostile.picture(".jpg", 64 + number, 48)
        message = hostile.image_message(other_size, "jpeg", 1 + number)
        send("wrong shape", Case(message, None, target.next_header()), both[:1])
        target.recorded_images += 1
    sent = target.refused_images
    wait_for(lambda: target.counter(target.recorder, "refused_images") >= sent["recorder"], "the recorder's count")
    names = ("refused_frames", "unreadable_frames")
    wait_for(lambda: target.counter(target.frontend, *names) >= sent["frontend"], "the frontend's count")
    target.counts_refusals(0)
    target.is_unchanged()
    target.show(5)
    target.is_unchanged()  # none of them was counted twice, and none was taken


def test_messages_to_another_session_change_nothing_in_this_one(
    target: Target, generator: random.Random, tally: Tally
) -> None:
    config = target.session.config.bus
    with contextlib.closing(open_bus(config.model_copy(update={"session": "another"}))) as other:
        leases = {job_id: lease.lease_id for job_id, lease in target.leases.items()}
        for name, (service, call) in KEYS.items():
            entry, _ = live_entry(name, leases)
            for _ in range(LIVE_OF_A_KIND):
                # Sound, so that it would be taken if it came here.
                with pytest.raises(BusUnavailableError, match=r"\A[^\n]*/another/[^\n]*: nobody answers\Z"):
                    other.request(other.keys.rpc(service, call), entry.sound(generator.randrange).payload)
                target.counts_refusals(0)
                tally(name, "unknown session")["live"] += 1
        submap = SESSION.submaps[0]
        blobs = [SESSION.blobs[ref.sha256] for ref in codec.blob_refs(submap)]
        with pytest.raises(BusUnavailableError, match="nobody answers"):
            LedgerClient(other).append(Stream.SUBMAP, submap.record_id, submap, blobs, patience_s=0.0)
        with pytest.raises(BusUnavailableError, match="nobody answers"):
            JobClient(other).claim([JobKind.PREDICT], [], "inference/test", 0.0)
        lease = target.leases[submap.record_id]
        with pytest.raises(BusUnavailableError, match="nobody answers"):
            JobClient(other).done(lease, Stream.SUBMAP, submap.record_id, submap, blobs, patience_s=0.0)
        camera = other.publisher(other.keys.image("front"), blocking=True, history=8)
        for _ in range(LIVE_OF_A_KIND):
            image = hostile.IMAGE.sound(generator.randrange)
            camera.put(image.payload, attachment=image.attachment)
            tally("image", "unknown session")["live"] += 1
        target.show(5)
        target.is_unchanged()


def test_after_all_that_sound_messages_are_taken(target: Target) -> None:
    jobs = JobClient(target.session.bus)
    records: dict[str, SubmapGeometry | Constraint] = {
        record.record_id: record for record in (*SESSION.submaps, *SESSION.constraints)
    }
    for job_id, lease in target.leases.items():
        record = records[job_id]
        stream = Stream.SUBMAP if isinstance(record, SubmapGeometry) else Stream.CONSTRAINT
        refs: tuple[BlobRef, ...] = codec.blob_refs(record)
        result = hostile.append_request(stream, job_id, record, [SESSION.blobs[ref.sha256] for ref in refs])
        key = target.session.bus.keys.rpc("jobs", "done")
        payload = codec.encode(calls.DoneRequest(job_id, lease.lease_id, result))
        reply = codec.decode(calls.DoneReply, target.session.bus.request(key, payload))
        assert reply.outcome is DoneOutcome.COMMITTED
    claimed = [jobs.claim([kind], [], "inference/test", 0.0) for kind in JobKind]
    assert [lease.job.job_id for lease in claimed if lease is not None] == [f"open/{kind}" for kind in JobKind]
    assert [lease.attempt for lease in claimed if lease is not None] == [1, 1, 1]
    keyframes = target.session.ledger.status().position("keyframe")
    target.show(10)
    assert target.session.ledger.status().position("keyframe") > keyframes
    target.is_unchanged()
