"""Records and calls to bytes and back: round trips by property, and hostile input of every kind."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vggt_motion.bus import calls, codec
from vggt_motion.errors import CodecError, RefusalCode
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import (
    BlobRef,
    Constraint,
    ConstraintKind,
    DoneOutcome,
    DropReason,
    EdgeReport,
    Event,
    EventKind,
    FocalHint,
    FrameEntry,
    FrameGeometry,
    GraphUpdate,
    HealthReport,
    Job,
    JobCount,
    JobKind,
    JobReport,
    JobState,
    Keyframe,
    Lease,
    LedgerStatus,
    LogEntry,
    MotionState,
    PredictTask,
    RegisterTask,
    RegistrationAttempt,
    RegistrationSpec,
    ScaleKind,
    Segment,
    SharedGeometry,
    Stream,
    StreamPosition,
    SubmapGeometry,
    SubmapPart,
    SubmapPose,
    SubmapQuality,
    SubmapSpec,
    SubmapVerdict,
)
from vggt_motion.v1 import jobs_pb2, keyframe_pb2, ledger_pb2


def equal(a: Any, b: Any) -> bool:
    """Equality that looks into arrays and takes NaN as equal to itself, and a view as its content."""
    if isinstance(a, memoryview):
        a = bytes(a)
    if type(a) is not type(b):
        return False
    if dataclasses.is_dataclass(a) and not isinstance(a, type):
        return all(equal(getattr(a, entry.name), getattr(b, entry.name)) for entry in dataclasses.fields(a))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(equal, a, b))
    if isinstance(a, float) and math.isnan(a):
        return math.isnan(b)
    return bool(a == b)


# --- strategies, one for each record ---------------------------------------------------------------------------------
names = st.from_regex(r"[A-Za-z0-9_.-]{1,12}", fullmatch=True)
identifiers = st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1, max_size=20)
lines = st.text(st.characters(exclude_categories=("Cc", "Cs", "Zl", "Zp")), max_size=30)
counts = st.integers(0, 2**32 - 1)
indices = st.integers(0, 2**53)
times = st.integers(-(2**62), 2**62)
sides = st.integers(1, 2**15)
finite = st.floats(-1e6, 1e6)
positive = st.floats(1e-6, 1e6)
ratios = st.floats(0.0, 1.0)
untold = st.one_of(st.just(math.nan), st.just(math.inf), st.floats(0.0, 1e6))
id_sets = st.lists(identifiers, max_size=12, unique=True).map(tuple)
blob_refs = st.builds(
    BlobRef,
    st.binary(min_size=32, max_size=32).map(bytes.hex),
    st.integers(0, codec.MAX_BLOB_BYTES),
    st.sampled_from(["image/png", "image/jpeg", codec.DEPTH_MEDIA_TYPE]),
)
rotations = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(lambda vector: se3.so3_exp(np.array(vector)))
vectors = st.tuples(finite, finite, finite).map(lambda values: np.array(values, dtype=np.float64))
similarities = st.builds(Sim3, rotations, vectors, positive)
rigid = st.builds(se3.make, rotations, vectors)
intrinsics = st.builds(Intrinsics, positive, positive, finite, finite, sides, sides, st.floats(-1.0, 1.0))
keyframes = st.builds(
    Keyframe,
    names,
    indices,
    indices,
    times,
    st.sampled_from(MotionState),
    sides,
    sides,
    blob_refs,
    st.none() | identifiers,
)


@st.composite
def segments(draw: st.DrawFn) -> Segment:
    ids = draw(st.lists(identifiers, min_size=1, max_size=12, unique=True))
    cut = draw(st.integers(0, len(ids) - 1))
    frames = []
    for index in sorted(draw(st.sets(indices, max_size=8))):
        reason = draw(st.none() | st.sampled_from(DropReason))
        frames.append(FrameEntry(index, draw(times), draw(st.sampled_from(MotionState)), reason is None, reason))
    return Segment(
        draw(indices), draw(names), draw(indices), tuple(ids[cut:]), tuple(ids[:cut]), tuple(frames), draw(names),
        draw(st.none() | blob_refs),
    )  # fmt: skip


@st.composite
def submap_specs(draw: st.DrawFn) -> SubmapSpec:
    ids = draw(st.lists(identifiers, min_size=2, max_size=12, unique=True))
    first, second = sorted([draw(st.integers(0, len(ids) - 1)), draw(st.integers(1, len(ids)))])
    second = max(second, first + 1)
    copies = ((ids[0], ids[1]),) if draw(st.booleans()) else ()
    told = untold.filter(lambda value: not math.isnan(value))
    hint = st.builds(FocalHint, positive, told, finite, st.booleans(), st.none() | intrinsics)
    return SubmapSpec(
        draw(indices), draw(st.integers(1, 9)), tuple(ids[:first]), tuple(ids[first:second]), tuple(ids[second:]),
        copies, draw(st.none() | hint), draw(st.none() | blob_refs), draw(st.none() | st.sampled_from(SubmapPart)),
    )  # fmt: skip


frame_geometries = st.builds(FrameGeometry, identifiers, intrinsics, rigid, blob_refs)
qualities = st.builds(
    SubmapQuality, counts, untold, ratios | st.just(math.nan), untold, positive, untold, finite,
    st.lists(lines, max_size=3).map(tuple),
)  # fmt: skip


@st.composite
def submaps(draw: st.DrawFn) -> SubmapGeometry:
    spec = draw(submap_specs())
    verdict = draw(st.sampled_from(SubmapVerdict))
    ids = () if verdict is SubmapVerdict.FAILED else spec.keyframe_ids[: draw(st.integers(1, 3))]
    frames = tuple(dataclasses.replace(draw(frame_geometries), keyframe_id=keyframe_id) for keyframe_id in ids)
    return SubmapGeometry(
        spec, verdict, draw(lines), draw(st.sampled_from(ScaleKind)), draw(lines), frames, draw(qualities),
        draw(st.dictionaries(names, st.floats(0.0, 1e3), max_size=4)),
    )  # fmt: skip


@st.composite
def registration_specs(draw: st.DrawFn) -> RegistrationSpec:
    i, j = draw(st.lists(indices, min_size=2, max_size=2, unique=True))
    revisions = st.integers(1, 5)
    return RegistrationSpec(
        i, j, draw(revisions), draw(revisions), draw(st.sampled_from(ConstraintKind)), draw(id_sets)
    )


attempts = st.builds(RegistrationAttempt, names, id_sets, indices, ratios | st.just(math.nan), untold, lines)
informations = st.lists(finite, min_size=49, max_size=49).map(
    lambda values: np.array(values).reshape(7, 7) @ np.array(values).reshape(7, 7).T
)
constraints = st.one_of(
    st.builds(
        Constraint, registration_specs(), st.just(True), lines, similarities, ratios, positive, informations, indices,
        st.lists(attempts, max_size=2).map(tuple),
    ),
    st.builds(
        Constraint, registration_specs(), st.just(False), lines, similarities, ratios | st.just(math.nan), untold,
        st.just(np.zeros((7, 7))), indices, st.lists(attempts, max_size=2).map(tuple),
    ),
)  # fmt: skip
graphs = st.builds(
    GraphUpdate, indices, st.booleans(),
    st.lists(st.builds(SubmapPose, indices, st.integers(1, 3), indices, similarities), max_size=3,
             unique_by=lambda pose: pose.submap_index).map(tuple),
    st.lists(st.builds(EdgeReport, identifiers, positive, st.booleans(), ratios), max_size=3).map(tuple),
    st.lists(lines, max_size=3).map(tuple), positive,
)  # fmt: skip
texts = st.text(st.characters(exclude_categories=("Cc", "Cs")), max_size=30).map(lambda text: f"{text}\n\t{text}")
events = st.builds(
    Event, identifiers, st.sampled_from(EventKind), lines, times, st.dictionaries(names, texts, max_size=3)
)
healths = st.builds(
    HealthReport, names, names, times, names, lines, indices, st.dictionaries(names, finite, max_size=3)
)
jobs = st.builds(
    Job, identifiers, st.sampled_from(JobKind), st.binary(max_size=64),
    st.from_regex(r"[A-Za-z_][A-Za-z0-9_.]{0,20}", fullmatch=True), st.integers(-(2**31), 2**31 - 1), lines,
)  # fmt: skip
leases = st.builds(Lease, jobs, identifiers, st.integers(1, 99), positive)
reports = st.builds(
    JobReport, identifiers, st.sampled_from(JobKind), st.sampled_from(JobState), counts, counts, lines, lines, texts
)
log_entries = st.builds(LogEntry, names, indices, identifiers, st.just("vggt_motion.v1.Event"), st.binary(), times)
statuses = st.builds(
    LedgerStatus, st.lists(st.builds(StreamPosition, names, indices), max_size=3).map(tuple),
    st.lists(st.builds(JobCount, names, names, indices), max_size=3).map(tuple),
    indices, indices, st.booleans(), lines, indices, st.from_regex(r"[0-9a-f]{0,32}", fullmatch=True),
)  # fmt: skip
appends = st.builds(
    calls.AppendRequest, names, identifiers, st.just("vggt_motion.v1.Event"), st.binary(),
    st.binary(min_size=32, max_size=32), st.lists(st.binary(), max_size=3).map(tuple),
    st.lists(blob_refs, max_size=3).map(tuple),
)  # fmt: skip


@st.composite
def predict_tasks(draw: st.DrawFn) -> PredictTask:
    frames = draw(st.lists(keyframes, min_size=1, max_size=3, unique_by=lambda keyframe: keyframe.keyframe_id))
    return PredictTask(SubmapSpec(0, 1, (), tuple(frame.keyframe_id for frame in frames)), tuple(frames))


STRATEGIES: dict[type, st.SearchStrategy[Any]] = {
    BlobRef: blob_refs,
    Keyframe: keyframes,
    Segment: segments(),
    SubmapSpec: submap_specs(),
    SubmapGeometry: submaps(),
    PredictTask: predict_tasks(),
    RegistrationSpec: registration_specs(),
    RegisterTask: st.builds(
        RegisterTask,
        registration_specs(),
        st.lists(st.builds(SharedGeometry, frame_geometries, frame_geometries), max_size=2).map(tuple),
        st.booleans(),
    ),
    Constraint: constraints,
    GraphUpdate: graphs,
    Event: events,
    HealthReport: healths,
    Job: jobs,
    Lease: leases,
    JobReport: reports,
    LogEntry: log_entries,
    LedgerStatus: statuses,
    calls.Refusal: st.builds(calls.Refusal, st.sampled_from(RefusalCode), lines),
    calls.Parcel: st.builds(
        calls.Parcel,
        st.binary(min_size=16, max_size=16).map(bytes.hex),
        st.from_regex("[0-9a-z-]{0,64}", fullmatch=True),
        st.integers(0, 2**29),
    ),
    calls.Bundle: st.builds(calls.Bundle, st.lists(st.binary(max_size=50), min_size=1, max_size=3).map(tuple)),
    calls.BundleReply: st.builds(
        calls.BundleReply,
        st.lists(
            st.builds(
                calls.BundledAnswer,
                st.binary(max_size=50),
                st.none() | st.builds(calls.Refusal, st.sampled_from(RefusalCode), lines),
            ),
            max_size=3,
        ).map(tuple),
    ),
    calls.AppendRequest: appends,
    calls.AppendReply: st.builds(calls.AppendReply, indices, st.booleans()),
    calls.ReadRequest: st.builds(calls.ReadRequest, names, indices, counts),
    calls.ReadReply: st.builds(calls.ReadReply, st.lists(log_entries, max_size=3).map(tuple), indices),
    calls.BlobsRequest: st.builds(
        calls.BlobsRequest,
        st.lists(st.binary(min_size=32, max_size=32).map(bytes.hex), min_size=1, max_size=3).map(tuple),
    ),
    calls.BlobsReply: st.builds(calls.BlobsReply, st.lists(st.binary(max_size=50), min_size=1, max_size=3).map(tuple)),
    calls.StatusRequest: st.builds(calls.StatusRequest),
    calls.SubmitRequest: st.builds(calls.SubmitRequest, st.lists(jobs, max_size=3).map(tuple)),
    calls.SubmitReply: st.builds(calls.SubmitReply, counts, counts),
    calls.ClaimRequest: st.builds(
        calls.ClaimRequest,
        st.lists(st.sampled_from(JobKind), min_size=1, max_size=3).map(tuple),
        st.lists(lines, max_size=3).map(tuple),
        st.builds("{}/{}".format, names, names),
        st.floats(0.0, 60.0),
        identifiers,
    ),
    calls.ClaimReply: st.builds(calls.ClaimReply, st.none() | leases),
    calls.HeartbeatRequest: st.builds(calls.HeartbeatRequest, identifiers),
    calls.HeartbeatReply: st.builds(calls.HeartbeatReply, st.booleans()),
    calls.DoneRequest: st.builds(calls.DoneRequest, identifiers, identifiers, appends),
    calls.DoneReply: st.builds(calls.DoneReply, st.sampled_from(DoneOutcome), indices),
    calls.FailRequest: st.builds(calls.FailRequest, identifiers, identifiers, lines, texts, st.booleans()),
    calls.FailReply: st.builds(calls.FailReply, st.booleans()),
    calls.ReportsRequest: st.builds(
        calls.ReportsRequest, st.none() | st.sampled_from(JobState), st.just("") | identifiers, counts
    ),
    calls.ReportsReply: st.builds(calls.ReportsReply, st.lists(reports, max_size=3).map(tuple)),
    calls.CancelRequest: st.builds(calls.CancelRequest, st.lists(identifiers, max_size=3).map(tuple)),
    calls.CancelReply: st.builds(calls.CancelReply, counts),
}
all_classes = pytest.mark.parametrize("cls", STRATEGIES, ids=lambda cls: cls.__name__)


def test_every_message_of_the_wire_has_a_strategy() -> None:
    assert {codec.payload_type(cls) for cls in STRATEGIES} == set(codec._BY_NAME)


@all_classes
@settings(max_examples=30)
@given(data=st.data())
def test_round_trip(cls: type, data: st.DataObject) -> None:
    record = data.draw(STRATEGIES[cls])
    payload = codec.encode(record)
    again: Any = codec.decode(cls, payload)
    assert equal(again, record)
    assert codec.encode(again) == payload
    assert codec.identity_digest(again) == codec.identity_digest(record)


def problem_with(cls: type, payload: bytes) -> str | None:
    try:
        codec.decode(cls, payload)
    except CodecError as error:
        return str(error)
    return None


@all_classes
@settings(max_examples=30)
@given(payload=st.binary(max_size=300))
def test_random_bytes_give_one_error(cls: type, payload: bytes) -> None:
    problem = problem_with(cls, payload)
    assert problem is None or (codec.payload_type(cls) in problem and "\n" not in problem)


@all_classes
@settings(max_examples=30)
@given(data=st.data())
def test_damaged_bytes_give_a_valid_record_or_one_error(cls: type, data: st.DataObject) -> None:
    payload = bytearray(codec.encode(data.draw(STRATEGIES[cls])))
    if data.draw(st.booleans()):
        del payload[data.draw(st.integers(0, max(len(payload) - 1, 0))) :]
    else:
        position = data.draw(st.integers(0, 8 * len(payload) - 1))
        payload[position // 8] ^= 1 << position % 8
    problem = problem_with(cls, bytes(payload))
    if problem is None:
        record: Any = codec.decode(cls, bytes(payload))
        assert equal(codec.decode(cls, codec.encode(record)), record)
    else:
        assert "\n" not in problem


# --- by example ------------------------------------------------------------------------------------------------------
IMAGE = BlobRef("ab" * 32, 1234, "image/png")
KEYFRAME = Keyframe("front", 0, 7, 1_000, MotionState.LINEAR, 620, 187, IMAGE)
EVENT = Event("stream_ended", EventKind.STREAM_ENDED, "200 frames", 5, {"frame_count": "200"})
QUALITY = SubmapQuality(2, 0.3, 0.9, 2.0, 1.1, 0.01)
SPEC = SubmapSpec(3, 1, ("a",), ("b", "c"))
FRAME = FrameGeometry("b", Intrinsics.centred(200.0, 310, 94), np.eye(4), IMAGE)
SUBMAP = SubmapGeometry(SPEC, SubmapVerdict.GOOD, "", ScaleKind.RELATIVE, "sfm", (FRAME,), QUALITY, {"match": 1.5})
ALIGNMENT = RegistrationSpec(1, 2, 1, 1, ConstraintKind.ADJACENT, ("a",))
CONSTRAINT = Constraint(ALIGNMENT, True, "", Sim3(), 0.9, 0.01, np.eye(7), 1000)


def replace(record: Any, **changes: Any) -> Any:
    return dataclasses.replace(record, **changes)


REFUSED: list[tuple[Any, str]] = [
    (replace(KEYFRAME, camera="front camera"), r"Keyframe\.camera: must be a name"),
    (replace(KEYFRAME, image=replace(IMAGE, sha256="AB" * 32)), r"Keyframe\.image\.sha256: must be 64 lower-case"),
    (replace(KEYFRAME, image=replace(IMAGE, size_bytes=2**40)), r"image\.size_bytes: is 1099511627776"),
    (replace(KEYFRAME, image=None), r"Keyframe\.image: must be a BlobRef"),
    (replace(KEYFRAME, width_px=0), r"width_px: is 0, allowed are 1 to 32768"),
    (replace(KEYFRAME, width_px=1.5), r"width_px: must be a whole number, not float"),
    (replace(KEYFRAME, frame_index=True), r"frame_index: must be a whole number, not bool"),
    (replace(KEYFRAME, state="L"), r"state: must be a MotionState"),
    (replace(KEYFRAME, zero_motion_copy_of=KEYFRAME.keyframe_id), r"is the keyframe itself"),
    (replace(EVENT, message="two\nlines"), r"Event\.message: must be one line"),
    (replace(EVENT, message="\ud800"), r"Event\.message: must be valid Unicode"),
    (replace(EVENT, message="x" * 5000), r"Event\.message: has 5000 characters"),
    (replace(EVENT, detail={"k": "\0"}), r"Event\.detail\['k'\]: must not contain control characters"),
    (replace(EVENT, event_id="with blank"), r"Event\.event_id: must be an identifier"),
    (replace(SPEC, base_keyframe_ids=()), r"base_keyframe_ids: has 0 elements"),
    (replace(SPEC, base_keyframe_ids=["b"]), r"base_keyframe_ids: must be a tuple, not list"),
    (replace(SPEC, base_keyframe_ids=("a",)), r"listed twice"),
    (replace(SPEC, zero_motion_copies=(("b", "z"),)), r"zero_motion_copies: must be pairs of keyframes of this submap"),
    (replace(SPEC, revision=0), r"revision: is 0"),
    (replace(SUBMAP, frames=()), r"frames: must be empty if and only if"),
    (replace(SUBMAP, frames=(FRAME, FRAME)), r"frames: each must be of a keyframe of the spec, once"),
    (replace(SUBMAP, frames=(replace(FRAME, keyframe_id="z"),)), r"frames: each must be of a keyframe of the spec"),
    (
        replace(SUBMAP, frames=(replace(FRAME, submap_from_camera=np.full((4, 4), np.nan)),)),
        r"SubmapGeometry\.frames\[0\]\.submap_from_camera: must be finite",
    ),
    (
        replace(SUBMAP, frames=(replace(FRAME, submap_from_camera=np.diag([1.0, 1.0, 2.0, 1.0])),)),
        r"submap_from_camera: is not a rotation: rows are not orthonormal",
    ),
    (
        replace(SUBMAP, frames=(replace(FRAME, submap_from_camera=np.diag([1.0, 1.0, -1.0, 1.0])),)),
        r"submap_from_camera: is not a rotation: it mirrors",
    ),
    (replace(SUBMAP, frames=(replace(FRAME, submap_from_camera=np.eye(3)),)), r"float array of shape \(4, 4\)"),
    (
        replace(SUBMAP, frames=(replace(FRAME, intrinsics=replace(FRAME.intrinsics, fx=math.nan)),)),
        r"frames\[0\]\.intrinsics\.fx: must not be NaN",
    ),
    (replace(SUBMAP, quality=replace(QUALITY, track_inlier_ratio=1.1)), r"track_inlier_ratio: is 1\.1"),
    (replace(ALIGNMENT, j=1), r"j: is the same submap as i"),
    (replace(CONSTRAINT, j_from_i=Sim3(scale=0.0)), r"j_from_i\.scale: is 0"),
    (replace(CONSTRAINT, j_from_i=Sim3(scale=math.inf)), r"j_from_i\.scale: must be finite"),
    (replace(CONSTRAINT, information=-np.eye(7)), r"information: has a negative diagonal"),
    (replace(CONSTRAINT, information=np.eye(7) + np.eye(7, k=1)), r"information: is not symmetric"),
    (replace(CONSTRAINT, inlier_ratio=math.nan), r"accepted constraint needs finite"),
]


@pytest.mark.parametrize(("record", "problem"), REFUSED, ids=[problem for _, problem in REFUSED])
def test_what_the_receiver_would_refuse_is_not_sent(record: Any, problem: str) -> None:
    with pytest.raises(CodecError, match=problem):
        codec.encode(record)


def test_a_newer_schema_and_a_missing_one_are_refused() -> None:
    message = keyframe_pb2.Keyframe.FromString(codec.encode(KEYFRAME))
    message.schema_version = codec.SCHEMA_VERSION + 1
    with pytest.raises(CodecError, match=r"Keyframe: schema_version 2 is newer than the known 1"):
        codec.decode(Keyframe, message.SerializeToString())
    with pytest.raises(CodecError, match=r"Keyframe: schema_version is missing"):
        codec.decode(Keyframe, b"")


def test_an_unknown_enum_value_and_a_missing_field_are_named() -> None:
    message = keyframe_pb2.Keyframe.FromString(codec.encode(KEYFRAME))
    message.state = 9  # type: ignore[assignment]
    with pytest.raises(CodecError, match=r"Keyframe\.state: has the unknown value 9"):
        codec.decode(Keyframe, message.SerializeToString())
    message.ClearField("state")
    with pytest.raises(CodecError, match=r"Keyframe\.state: is missing"):
        codec.decode(Keyframe, message.SerializeToString())
    message.CopyFrom(keyframe_pb2.Keyframe.FromString(codec.encode(KEYFRAME)))
    message.ClearField("image")
    with pytest.raises(CodecError, match=r"Keyframe\.image: is missing"):
        codec.decode(Keyframe, message.SerializeToString())


def test_a_message_longer_than_its_type_may_be_is_not_even_parsed() -> None:
    with pytest.raises(CodecError, match=r"70000 bytes are more than the allowed 65536"):
        codec.decode(Keyframe, bytes(70_000))


def test_a_small_message_that_unfolds_into_millions_is_refused() -> None:
    # An empty blob reference takes two bytes on the wire and far more in memory.
    valid = codec.encode(calls.AppendRequest("event", "e", "vggt_motion.v1.Event", b"", bytes(32)))
    with pytest.raises(CodecError, match=r"AppendRequest: has too many elements"):
        codec.decode(calls.AppendRequest, valid + b"\x42\x00" * 2_000_000)
    inner = valid + b"\x42\x00" * 2_000_000
    done = jobs_pb2.DoneRequest(schema_version=1, job_id="j", lease_id="l").SerializeToString()
    length = len(inner)
    prefix = b"\x22" + bytes(
        [length & 0x7F | 0x80, length >> 7 & 0x7F | 0x80, length >> 14 & 0x7F | 0x80, length >> 21]
    )
    assert jobs_pb2.DoneRequest.FromString(done + prefix + inner).result.stream == "event"
    with pytest.raises(CodecError, match=r"DoneRequest: has too many elements"):
        codec.decode(calls.DoneRequest, done + prefix + inner)


def test_large_payloads_are_no_structure() -> None:
    request = calls.AppendRequest(
        "submap", "s", "vggt_motion.v1.Event", bytes(2**20), bytes(32), (bytes(2**25), bytes(2**24))
    )
    done = calls.DoneRequest("j", "l", request)
    assert equal(codec.decode(calls.DoneRequest, codec.encode(done)), done)


def outcome_of(cls: type, payload: bytes, lifted_from_bytes: int) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(codec, "LIFTED_FROM_BYTES", lifted_from_bytes)
        try:
            return codec.decode(cls, payload)
        except CodecError as error:
            return str(error)


@pytest.mark.parametrize("cls", [calls.AppendRequest, calls.DoneRequest], ids=lambda cls: cls.__name__)
@settings(max_examples=150)
@given(data=st.data())
def test_blobs_as_views_or_as_copies_make_no_difference(cls: type, data: st.DataObject) -> None:
    payload = bytearray(codec.encode(data.draw(STRATEGIES[cls])))
    if data.draw(st.booleans()):
        payload += codec.encode(data.draw(STRATEGIES[cls]))  # protobuf joins the two
    for _ in range(data.draw(st.integers(0, 3))):
        position = data.draw(st.integers(0, 8 * len(payload) - 1))
        payload[position // 8] ^= 1 << position % 8
    del payload[data.draw(st.integers(0, len(payload)) | st.just(len(payload))) :]
    assert equal(outcome_of(cls, bytes(payload), 0), outcome_of(cls, bytes(payload), 2**30))


@given(st.binary(min_size=1, max_size=64))
def test_large_garbage_is_refused(pattern: bytes) -> None:
    with pytest.raises(CodecError):
        codec.decode(calls.AppendRequest, pattern * (2**20 // len(pattern) + 1))


def test_fields_of_the_future_are_skipped() -> None:
    assert equal(codec.decode(Keyframe, codec.encode(KEYFRAME) + b"\xfa\x3f\x03abc"), KEYFRAME)


def test_identity_ignores_what_is_only_informative() -> None:
    assert codec.identity_digest(EVENT) == codec.identity_digest(replace(EVENT, time_ns=99))
    assert codec.identity_digest(EVENT) != codec.identity_digest(replace(EVENT, message="201 frames"))
    assert codec.identity_digest(SUBMAP) == codec.identity_digest(replace(SUBMAP, stage_seconds={"match": 9.0}))
    assert codec.identity_digest(SUBMAP) != codec.identity_digest(replace(SUBMAP, model="other"))
    assert codec.encode(SUBMAP) != codec.encode(replace(SUBMAP, stage_seconds={}))


def test_equal_records_have_equal_bytes_whatever_the_order_of_their_tables() -> None:
    forward = replace(SUBMAP, stage_seconds={"a": 1.0, "b": 2.0})
    assert codec.encode(forward) == codec.encode(replace(SUBMAP, stage_seconds={"b": 2.0, "a": 1.0}))
    negative_zero = replace(CONSTRAINT, information=np.eye(7) * 1.0 - 0.0)
    negative_zero.information[0, 1] = negative_zero.information[1, 0] = -0.0
    assert codec.encode(negative_zero) == codec.encode(CONSTRAINT)


def test_numpy_scalars_travel_as_numbers() -> None:
    record = replace(KEYFRAME, width_px=np.int32(620), frame_index=np.int64(7))
    assert codec.encode(record) == codec.encode(KEYFRAME)
    assert codec.encode(replace(CONSTRAINT, accepted=np.bool_(True), inlier_ratio=np.float64(0.9))) == codec.encode(
        CONSTRAINT
    )


def test_names_and_references() -> None:
    assert codec.encoding_of(Keyframe) == "application/protobuf;vggt_motion.v1.Keyframe"
    assert codec.record_class("vggt_motion.v1.Keyframe") is Keyframe
    with pytest.raises(CodecError, match="not known"):
        codec.record_class("vggt_motion.v2.Keyframe")
    with pytest.raises(TypeError):
        codec.encode(object())
    assert set(codec.STREAM_RECORDS) == set(Stream) - {Stream.DESCRIPTOR}
    mask = replace(IMAGE, sha256="cd" * 32)
    assert codec.blob_refs(replace(SUBMAP, spec=replace(SPEC, ego_mask=mask))) == (mask, IMAGE)
    # "abc", FIPS 180-2 appendix B.1
    assert codec.blob_ref(b"abc", "image/png") == BlobRef(
        "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad", 3, "image/png"
    )


def test_the_wire_is_plain_protobuf() -> None:
    message = ledger_pb2.AppendRequest.FromString(
        codec.encode(calls.AppendRequest("event", "e", "vggt_motion.v1.Event", b"xyz", bytes(32), (b"blob",), (IMAGE,)))
    )
    assert (message.stream, message.payload, list(message.blobs)) == ("event", b"xyz", [b"blob"])
    assert message.blob_refs[0].sha256 == IMAGE.sha256
