"""Hostile messages for every entry: what is sound there, and what can be wrong with it, by kind.

What is wrong with a message is told by what was done to a sound one, never by the code under test, and so is what the
refusal has to say. Most kinds change one thing in a message that stays whole on the wire, so that its content has to be
looked at. Choices are made by ``pick(n)``, one of 0 ... n - 1: Hypothesis draws them, and what goes through a live
session takes them from a generator.
"""

from __future__ import annotations

import functools
import hashlib
import random
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import zstandard
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError, Message

from synthetic_session import HEIGHT, WIDTH, Session
from vggt_motion.bus import calls, codec
from vggt_motion.bus.images import decode_image
from vggt_motion.bus.ledger import append_request
from vggt_motion.errors import CodecError, RequestRefusedError
from vggt_motion.ledger.admission import admitted
from vggt_motion.records import Stream
from vggt_motion.v1 import bundle_pb2, jobs_pb2, ledger_pb2, parcel_pb2, recording_pb2

Pick = Callable[[int], int]
REFUSALS = (CodecError, RequestRefusedError)
SESSION = Session(2)
UNPARSED = "not a valid message|not a foxglove|not an ImageHeader|not a depth blob|damaged header"
"""What refusals say of that which is not even what it should be on the wire."""
ANYTHING = ""


@dataclass(frozen=True)
class Case:
    """A message, and what its refusal says (a regular expression); None: it may have stayed a sound one."""

    payload: bytes
    reason: str | None
    attachment: bytes = b""


Maker = Callable[[Pick], Case]


@dataclass(frozen=True)
class Entry:
    """A place where messages come in."""

    take: Callable[[Case], object]  # decoding and validation, as the service does them; raises one of REFUSALS
    sound: Callable[[Pick], Case]
    kinds: Mapping[str, Maker]


# --- bytes -----------------------------------------------------------------------------------------------------------
def noise(pick: Pick, size: int) -> bytes:
    return random.Random(pick(2**32)).randbytes(size)


def random_bytes(pick: Pick) -> Case:
    return Case(noise(pick, 1 + pick(400)), ANYTHING)


def damaged(sound: Callable[[Pick], Case]) -> Maker:
    """A few bytes of it are others, or too many, or gone."""

    def make(pick: Pick) -> Case:
        case = sound(pick)
        payload = bytearray(case.payload)
        for _ in range(1 + pick(2)):
            at = pick(len(payload))
            match pick(5):
                case 0:
                    payload[at] ^= 1 << pick(8)
                case 1:
                    payload[at:at] = noise(pick, 1 + pick(20))
                case 2:  # the same field twice, or a message in a message
                    payload[at:at] = payload[: pick(200)]
                case 3:  # lengths and counts beyond everything
                    payload[at : at + 5] = b"\xff\xff\xff\xff\x0f"
                case _:
                    del payload[at : at + 1 + pick(8)]
            payload = payload or bytearray(1)
        return Case(bytes(payload), None, case.attachment)

    return make


def truncated(sound: Callable[[Pick], Case], reason: Callable[[bytes], str | None]) -> Maker:
    """Only its beginning; ``reason`` says what the refusal of a beginning says."""

    def make(pick: Pick) -> Case:
        case = sound(pick)
        beginning = case.payload[: pick(len(case.payload))]
        return Case(beginning, reason(beginning), case.attachment)

    return make


def is_message(cls: type[Message], payload: bytes) -> bool:
    try:
        cls.FromString(payload)
    except DecodeError:
        return False
    return True


# --- messages --------------------------------------------------------------------------------------------------------
def fields_of(message: Message) -> Iterator[tuple[Message, FieldDescriptor, Any]]:
    """Every field that is set, however deep: where it stands, what it is, its value. Maps are left out."""
    for field, value in message.ListFields():
        if field.type != FieldDescriptor.TYPE_MESSAGE:
            yield message, field, value
        elif not field.message_type.GetOptions().map_entry:
            yield message, field, value
            for child in [value] if isinstance(value, Message) else value:
                yield from fields_of(child)


def is_single(value: Any) -> bool:
    return isinstance(value, (Message, str, bytes, int, float))


def put(owner: Message, field: FieldDescriptor, pick: Pick, change: Callable[[Any], Any]) -> None:
    """Give the field, or one of its elements, another value."""
    value = getattr(owner, field.name)
    if is_single(value):
        setattr(owner, field.name, change(value))
    else:
        at = pick(len(value))
        value[at] = change(value[at])


@dataclass(frozen=True)
class Spoil:
    """Something that may be wrong with one field of a message."""

    fits: Callable[[Message, FieldDescriptor, Any], bool]
    change: Callable[[Message, FieldDescriptor, Pick], None]
    reason: str

    def has_place(self, message: Message) -> bool:
        return any(self.fits(*place) for place in fields_of(message))

    def apply(self, message: Message, pick: Pick) -> None:
        places = [place for place in fields_of(message) if self.fits(*place)]
        owner, field, _ = places[pick(len(places))]
        self.change(owner, field, pick)


# Fields in which there may be nothing, and doubles that may say "cannot tell".
MAY_BE_EMPTY = {"drop_reason", "message", "model", "models", "reason", "name"}
MAY_BE_NO_NUMBER = {"weighted_residual"}
OUT_OF_RANGE = {
    "fx": -1.0,
    "fy": -1.0,
    "inlier_ratio": 2.0,
    "median_relative_residual": -1.0,
    "robust_weight": 2.0,
    "scale": -1.0,
    "wait_s": 4000.0,
}
MAX_SIDE_PX, MAX_PIXELS = 2**15, 2**24
LARGEST_INDEX = 2**53
LARGEST_TIME_NS = 2**62


def _no_number(pick: Pick) -> float:
    bits = (pick(2) << 63) | (0x7FF << 52) | (0 if pick(3) == 0 else 1 + pick(2**51))
    number: float = struct.unpack("<d", struct.pack("<Q", bits))[0]  # an infinity, or one of the many NaN
    return number


def _is_wrong_size(owner: Message, field: FieldDescriptor, value: Any) -> bool:
    return field.type == FieldDescriptor.TYPE_DOUBLE and not is_single(value)


def _change_size(owner: Message, field: FieldDescriptor, pick: Pick) -> None:
    values = getattr(owner, field.name)
    if pick(2):
        del values[pick(len(values)) :]
    else:
        values.extend([float(pick(100)) for _ in range(1 + pick(20))])


# Elements that cannot be 2 and more, or negative, whatever the others are; rows of 3, 4 and 7.
TURNS = {"rotation": range(9), "submap_from_camera": [0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, 15]}
DIAGONAL = range(0, 49, 8)


def _bend(owner: Message, field: FieldDescriptor, pick: Pick) -> None:
    values = getattr(owner, field.name)
    if field.name in TURNS:
        places = TURNS[field.name]
        values[places[pick(len(places))]] = 2.0 + pick(1000)
    else:
        values[DIAGONAL[pick(7)]] = -1.0 - pick(1000)


def _may_be_other(owner: Message, field: FieldDescriptor, value: Any) -> bool:
    match field.type:
        case FieldDescriptor.TYPE_UINT32:
            return field.name.endswith(("_px", "revision"))
        case FieldDescriptor.TYPE_DOUBLE:
            return field.name in OUT_OF_RANGE and owner.DESCRIPTOR.name != "SubmapQuality"
        case FieldDescriptor.TYPE_BYTES:
            return field.name == "identity_sha256"
    return field.type in (
        FieldDescriptor.TYPE_STRING,
        FieldDescriptor.TYPE_ENUM,
        FieldDescriptor.TYPE_UINT64,
        FieldDescriptor.TYPE_INT64,
    )


def _change_to_other(owner: Message, field: FieldDescriptor, pick: Pick) -> None:
    def other(value: Any) -> Any:
        match field.type:
            case FieldDescriptor.TYPE_STRING:
                at = pick(len(value) + 1)
                return value[:at] + chr(pick(32)) + value[at:]
            case FieldDescriptor.TYPE_ENUM:
                return 100 + pick(2**20)
            case FieldDescriptor.TYPE_UINT64:
                return LARGEST_INDEX + 1 + pick(2**63)
            case FieldDescriptor.TYPE_INT64:
                return (LARGEST_TIME_NS + 1 + pick(2**61)) * (1 if pick(2) else -1)
            case FieldDescriptor.TYPE_UINT32:
                return pick(2) * (MAX_SIDE_PX + 1 + pick(2**20)) if field.name.endswith("_px") else 0
            case FieldDescriptor.TYPE_BYTES:
                return noise(pick, (33 + pick(20)) % 48)
        return OUT_OF_RANGE[field.name] * (1.0 + pick(1000))

    put(owner, field, pick, other)


def _may_be_missing(owner: Message, field: FieldDescriptor, value: Any) -> bool:
    if field.name in MAY_BE_EMPTY:
        return False
    return field.name in {"base_keyframe_ids", "kinds", "folder_id"} or (
        field.type
        in (
            FieldDescriptor.TYPE_MESSAGE,
            FieldDescriptor.TYPE_STRING,
            FieldDescriptor.TYPE_ENUM,
            FieldDescriptor.TYPE_BYTES,
        )
        and is_single(value)
    )


def _may_be_longer(owner: Message, field: FieldDescriptor, value: Any) -> bool:
    return field.type == FieldDescriptor.TYPE_STRING or (
        field.type == FieldDescriptor.TYPE_ENUM and not is_single(value)
    )


def _lengthen(owner: Message, field: FieldDescriptor, pick: Pick) -> None:
    value = getattr(owner, field.name)
    if not is_single(value) and (pick(2) or not isinstance(value[0], str)):
        value.extend([value[0]] * (4096 + pick(100)))
    else:
        put(owner, field, pick, lambda text: text + "x" * (4097 + pick(4000)))


SPOILS = {
    "no number": Spoil(
        lambda owner, field, _: (
            field.type == FieldDescriptor.TYPE_DOUBLE
            and field.name not in MAY_BE_NO_NUMBER
            and owner.DESCRIPTOR.name != "SubmapQuality"
        ),
        lambda owner, field, pick: put(owner, field, pick, lambda _: _no_number(pick)),
        r"must not be NaN|must be finite|needs finite|is -inf, allowed",
    ),
    "wrong shape": Spoil(_is_wrong_size, _change_size, r"has \d+ numbers, \d+ are needed"),
    "wrong geometry": Spoil(
        lambda owner, field, _: field.name in {*TURNS, "information"},
        _bend,
        "is not a rotation|must have the last row 0 0 0 1|has a negative diagonal",
    ),
    "wrong value": Spoil(
        _may_be_other,
        _change_to_other,
        r"must be |must not |has \d+ (characters|bytes)|unknown value|is -?[\d.e+]+, allowed",
    ),
    "missing part": Spoil(
        _may_be_missing, lambda owner, field, _: owner.ClearField(field.name), r"is missing|has 0 |is 0, allowed"
    ),
    "too long a part": Spoil(_may_be_longer, _lengthen, r"has \d+ (characters|elements)|more than the allowed"),
}


def spoiled(sound: Callable[[Pick], Message], spoil: Spoil) -> Maker:
    def make(pick: Pick) -> Case:
        message = sound(pick)
        spoil.apply(message, pick)
        return Case(message.SerializeToString(), spoil.reason)

    return make


def with_schema(payload: bytes, pick: Pick) -> bytes:
    """A message that says that it is of another schema, or of none: in its first field, or once more at its end."""
    assert payload.startswith(b"\x08\x01")
    version = pick(2) * (2 + pick(2**32 - 2))
    said = b"\x08" + _varint(version)
    return said + payload[2:] if pick(2) else payload + said


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


SCHEMA = r"schema_version (is missing|\d+ is newer than the known 1)"


def padded(payload: bytes, size: int) -> bytes:
    """A sound message of just this length: with a field that nobody knows, which readers skip."""
    for length_bytes in range(1, 6):
        content = size - len(payload) - 2 - length_bytes
        if content >= 0 and len(_varint(content)) == length_bytes:
            return payload + b"\xfa\x3f" + _varint(content) + bytes(content)
    raise AssertionError(f"{len(payload)} bytes cannot be made {size}")


# --- depth -----------------------------------------------------------------------------------------------------------
def depth_header(width: int, height: int, *, version: int = 1, exponent: int = 0) -> bytes:
    header = struct.pack("<4sBBhII", b"VMD1", version, 0, exponent, width, height)
    return header + struct.pack("<I", zlib.crc32(header))


def depth_blob(halves: np.ndarray, levels: np.ndarray, **header: int) -> bytes:
    """A blob of float16 bits and confidence levels (H, W), whole in every other respect."""
    planes = halves.astype("<u2").reshape(-1).view(np.uint8).reshape(-1, 2)
    content = planes[:, 0].tobytes() + planes[:, 1].tobytes() + levels.astype(np.uint8).tobytes()
    height, width = halves.shape
    return depth_header(width, height, **header) + zstandard.ZstdCompressor(write_checksum=True).compress(content)


def sound_depth(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(width * height)
    return random.integers(0x0400, 0x7C00, (height, width)), random.integers(0, 256, (height, width))


HALVES, LEVELS = sound_depth(WIDTH, HEIGHT)
IMPOSSIBLE_DEPTH = {
    "NaN depth": [(0x7C01, 0x7FFF), (0xFC01, 0xFFFF)],
    "infinite depth": [(0x7C00, 0x7C00), (0xFC00, 0xFC00)],
    "negative depth": [(0x8000, 0xFBFF)],
    "subnormal depth": [(0x0001, 0x03FF)],
}
"""Ranges of float16 bits that no encoder writes."""
NOT_DEPTH = "depth must be finite, not negative and at float16 precision"


def impossible_depth(pick: Pick, ranges: list[tuple[int, int]]) -> bytes:
    """A blob that is whole, with some values of these among its depth."""
    halves = HALVES.copy()
    low, high = ranges[pick(len(ranges))]
    for _ in range(1 + pick(3)):
        halves.flat[pick(halves.size)] = low + pick(high - low + 1)
    return depth_blob(halves, LEVELS)


def confidence_without_depth(pick: Pick) -> bytes:
    halves, levels = HALVES.copy(), LEVELS.copy()
    at = pick(halves.size)
    halves.flat[at], levels.flat[at] = 0, 1 + pick(255)
    return depth_blob(halves, levels)


def bomb(pick: Pick, *, is_lying: bool) -> bytes:
    """A sound header, and behind it up to a gigabyte in some kilobytes: 4 bytes for each 128 KiB (RFC 8878).

    The frame says how large its content is, or nothing; or, if it lies, that it is as large as the header wants it.
    """
    count = 8192 if pick(4) == 0 else 1 + pick(8192)
    declared = 3 * WIDTH * HEIGHT if is_lying else (count * 2**17, None)[pick(2)]
    # Frame header descriptor (content size of 8 bytes or none), then a window of 128 KiB.
    head = b"\x00\x38" if declared is None else b"\xc0\x38" + struct.pack("<Q", declared)
    content = bytes([pick(256)])
    block, last = ((2**17 << 3 | 1 << 1 | is_last).to_bytes(3, "little") + content for is_last in (0, 1))
    return depth_header(WIDTH, HEIGHT) + b"\x28\xb5\x2f\xfd" + head + block * (count - 1) + last


DEPTH_KINDS: dict[str, tuple[Callable[[Pick], bytes], str]] = {
    "bomb": (lambda pick: bomb(pick, is_lying=False), "another size than the header declares"),
    "bomb that lies": (lambda pick: bomb(pick, is_lying=True), "Destination buffer is too small"),
    **{
        kind: (functools.partial(impossible_depth, ranges=ranges), NOT_DEPTH)
        for kind, ranges in IMPOSSIBLE_DEPTH.items()
    },
    "odd confidence": (confidence_without_depth, "confidence without depth"),
}
"""Blobs that are whole but for their content, and what is said of them."""


def _depth_of_other_size(pick: Pick) -> bytes:
    """The content is that of another lattice than the header says."""
    return depth_header(WIDTH + 1 + pick(1000), HEIGHT) + depth_blob(HALVES, LEVELS)[20:]


def _too_large_depth(pick: Pick) -> bytes:
    width = 1 + pick(2**32 - 1)
    height = max(MAX_SIDE_PX + 1, MAX_PIXELS // width + 1) if pick(2) else min(MAX_PIXELS // width + 1, 2**32 - 1)
    return depth_header(width, height) + depth_blob(HALVES, LEVELS)[20:]


def _take_depth(case: Case) -> tuple[int, int]:
    """Who checks and who decodes agree."""
    try:
        depth, confidence = codec.decode_depth(case.payload)
    except CodecError:
        codec.check_depth(case.payload)
        raise AssertionError("only the decoder refuses it") from None
    assert np.all(np.isfinite(depth) & (depth >= 0)) and np.all((confidence >= 0) & (confidence <= 1))
    assert codec.check_depth(case.payload) == depth.shape
    return depth.shape


def _sound_blob(pick: Pick) -> Case:
    blob = depth_blob(np.roll(HALVES, pick(HALVES.size)), LEVELS, exponent=pick(224) - 112)
    return Case(blob, None)


def _other_depth_version(pick: Pick) -> Case:
    version = (2 + pick(255)) % 256
    return Case(depth_blob(np.roll(HALVES, pick(HALVES.size)), LEVELS, version=version), "version .* is not known here")


def _as_case(blob: Callable[[Pick], bytes], reason: str) -> Maker:
    return lambda pick: Case(blob(pick), reason)


DEPTH = Entry(
    take=_take_depth,
    sound=_sound_blob,
    kinds={
        "random": random_bytes,
        "truncated": truncated(_sound_blob, lambda _: ANYTHING),
        "damaged": damaged(_sound_blob),
        "schema version": _other_depth_version,
        "wrong shape": lambda pick: Case(_depth_of_other_size(pick), "another size than the header declares"),
        "oversized": lambda pick: Case(_too_large_depth(pick), "px is out of range"),
        **{kind: _as_case(*made) for kind, made in DEPTH_KINDS.items()},
    },
)


# --- requests that bring a record ------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Bringing:
    """A sound request to append, and its record as a message."""

    request: ledger_pb2.AppendRequest
    record: Message

    def copy(self) -> Bringing:
        request, record = ledger_pb2.AppendRequest(), type(self.record)()
        request.CopyFrom(self.request)
        record.CopyFrom(self.record)
        return Bringing(request, record)

    def whole(self) -> ledger_pb2.AppendRequest:
        """The request with the record as it is now."""
        self.request.payload = self.record.SerializeToString()
        return self.request

    def put_depth(self, pick: Pick, blob: bytes) -> None:
        """Bring another depth map for one of the frames, and refer to it."""
        ref = self.record.frames[pick(len(self.record.frames))].depth  # type: ignore[attr-defined]
        at = [known.sha256 for known in self.request.blob_refs].index(ref.sha256)
        ref.sha256, ref.size_bytes = hashlib.sha256(blob).hexdigest(), len(blob)
        self.request.blob_refs[at].CopyFrom(ref)
        self.request.blobs[at] = blob


def _bringing() -> list[Bringing]:
    found = []
    for stream, _, record in SESSION.entries():
        blobs = [SESSION.blobs[ref.sha256] for ref in codec.blob_refs(record)]
        names = ("record_id", "keyframe_id", "event_id")
        record_id = next(str(getattr(record, name)) for name in names if hasattr(record, name))
        request = append_request(stream, record_id, record, blobs)  # type: ignore[arg-type]
        message = codec._plan_of(type(record)).message.FromString(request.payload)
        found.append(Bringing(ledger_pb2.AppendRequest.FromString(codec.encode(request)), message))
    return found


BRINGING = _bringing()
RESULTS = [one for one in BRINGING if one.request.stream in (Stream.SUBMAP.value, Stream.CONSTRAINT.value)]
SUBMAPS = [one for one in BRINGING if one.request.stream == Stream.SUBMAP.value]
KEYFRAMES = [one for one in BRINGING if one.request.stream == Stream.KEYFRAME.value]
RECORD_BYTES = {
    "keyframe": 2**16,
    "event": 2**20,
    "submap": 2**23,
    "constraint": 2**23,
    "segment": 2**25,
    "graph": 2**25,
}
"""How long a record may be, by its stream."""


def request_kinds(wrap: Callable[[ledger_pb2.AppendRequest], Message], among: list[Bringing]) -> dict[str, Maker]:
    """What can be wrong with a message that brings a record.

    Args:
        wrap: makes the message of the request.
        among: the sound requests.
    """

    def one_of(pick: Pick, some: list[Bringing]) -> Bringing:
        bringing = some[pick(len(some))].copy()
        bringing.request.identity_sha256 = noise(pick, 32)  # what it says is nobody's business but the sender's
        return bringing

    def whole(bringing: Bringing, reason: str | None) -> Case:
        return Case(wrap(bringing.whole()).SerializeToString(), reason)

    def sound(pick: Pick) -> Case:
        return whole(one_of(pick, among), None)

    def spoiled_somewhere(spoil: Spoil) -> Maker:
        in_record = [one for one in among if spoil.has_place(one.record)]
        in_request = [one for one in among if spoil.has_place(wrap(one.request))]

        def make(pick: Pick) -> Case:
            if in_record and (pick(3) or not in_request):
                bringing = one_of(pick, in_record)
                spoil.apply(bringing.record, pick)
                return whole(bringing, spoil.reason)
            message = wrap(one_of(pick, in_request).request)
            spoil.apply(message, pick)
            return Case(message.SerializeToString(), spoil.reason)

        return make

    def other_schema(pick: Pick) -> Case:
        bringing = one_of(pick, among)
        if pick(2):
            return Case(with_schema(wrap(bringing.request).SerializeToString(), pick), SCHEMA)
        bringing.request.payload = with_schema(bringing.request.payload, pick)
        return Case(wrap(bringing.request).SerializeToString(), SCHEMA)

    def cut_record(pick: Pick) -> Case:
        bringing = one_of(pick, among)
        request = bringing.request
        request.payload = request.payload[: pick(len(request.payload))]
        reason = None if is_message(type(bringing.record), request.payload) else "not a valid message"
        return Case(wrap(request).SerializeToString(), reason)

    def wrong_shape(pick: Pick) -> Case:
        way = pick(4)
        if way == 0:
            return spoiled_arrays(pick)
        bringing = one_of(pick, SUBMAPS)
        if way == 1:  # the depth is of another lattice than the record says
            bringing.put_depth(pick, depth_blob(*sound_depth(WIDTH + 1 + pick(30), HEIGHT)))
            return whole(bringing, r"\(height, width\)")
        if way == 2:
            bringing.put_depth(pick, _depth_of_other_size(pick))
            return whole(bringing, "another size than the header declares")
        frames = bringing.record.frames  # type: ignore[attr-defined]
        intrinsics = frames[pick(len(frames))].intrinsics
        if pick(2):
            intrinsics.width_px += 1 + pick(1000)
        else:
            intrinsics.height_px += 1 + pick(1000)
        return whole(bringing, r"\(height, width\)")

    def oversized(pick: Pick) -> Case:
        if pick(4 if KEYFRAMES[0] in among else 20):  # the others may be a hundred times as long
            return too_long_part(pick)
        bringing = one_of(pick, [one for one in among if one in KEYFRAMES] or among)
        too_long = RECORD_BYTES[bringing.request.stream] + 1 + pick(1000)
        bringing.request.payload = padded(bringing.request.payload, too_long)
        return Case(wrap(bringing.request).SerializeToString(), "more than the allowed")

    def with_depth(blob: Callable[[Pick], bytes], reason: str) -> Maker:
        def make(pick: Pick) -> Case:
            bringing = one_of(pick, SUBMAPS)
            bringing.put_depth(pick, blob(pick))
            return whole(bringing, reason)

        return make

    def contradiction(pick: Pick) -> Case:
        bringing = one_of(pick, among)
        request = bringing.request
        match pick(6):
            case 0:
                request.stream = f"nonsense{pick(2**32)}"
                return Case(wrap(request).SerializeToString(), "there is no stream")
            case 1:
                request.stream = Stream.DESCRIPTOR.value
                return Case(wrap(request).SerializeToString(), "takes no records in this version")
            case 2:
                other = [one for one in BRINGING if one.request.stream != request.stream]
                request.payload_type = other[pick(len(other))].request.payload_type
                return Case(wrap(request).SerializeToString(), "stream .* holds ")
            case 3:
                request.record_id += str(pick(2**32))
                return Case(wrap(request).SerializeToString(), "is not that of the record")
            case 4:
                request.blobs.append(noise(pick, 1 + pick(100)))
                return Case(wrap(request).SerializeToString(), "brings a blob that it does not refer to")
        request.blob_refs.add(sha256=noise(pick, 32).hex(), size_bytes=pick(2**20), media_type="image/jpeg")
        return Case(wrap(request).SerializeToString(), "are not what the record refers to")

    spoiled_arrays = spoiled_somewhere(SPOILS["wrong shape"])
    too_long_part = spoiled_somewhere(SPOILS["too long a part"])
    return {
        "random": random_bytes,
        # The last fields on the wire are needed, so that no beginning is a whole request.
        "truncated": truncated(sound, lambda _: ANYTHING),
        "truncated record": cut_record,
        "damaged": damaged(sound),
        "schema version": other_schema,
        "oversized": oversized,
        **{kind: with_depth(*made) for kind, made in DEPTH_KINDS.items()},
        "wrong shape": wrong_shape,
        "wrong geometry": spoiled_somewhere(SPOILS["wrong geometry"]),
        "no number": spoiled_somewhere(SPOILS["no number"]),
        "wrong value": spoiled_somewhere(SPOILS["wrong value"]),
        "missing part": spoiled_somewhere(SPOILS["missing part"]),
        "contradiction": contradiction,
    }


def _sound_append(pick: Pick) -> Case:
    return Case(BRINGING[pick(len(BRINGING))].request.SerializeToString(), None)


APPEND = Entry(
    take=lambda case: admitted(codec.decode(calls.AppendRequest, case.payload)),
    sound=_sound_append,
    kinds=request_kinds(lambda request: request, BRINGING),
)


def result_of(leases: Mapping[str, str]) -> Callable[[ledger_pb2.AppendRequest], jobs_pb2.DoneRequest]:
    """Makes the results of jobs, which have the ids of their records; ``leases`` are those handed out for them."""

    def wrap(request: ledger_pb2.AppendRequest) -> jobs_pb2.DoneRequest:
        lease_id = leases.get(request.record_id, "lease")
        return jobs_pb2.DoneRequest(schema_version=1, job_id=request.record_id, lease_id=lease_id, result=request)

    return wrap


def done_entry(leases: Mapping[str, str]) -> Entry:
    wrap = result_of(leases)
    return Entry(
        take=lambda case: admitted(codec.decode(calls.DoneRequest, case.payload).result),
        sound=lambda pick: Case(wrap(RESULTS[pick(len(RESULTS))].request).SerializeToString(), None),
        kinds=request_kinds(wrap, RESULTS),
    )


DONE = done_entry({})


# --- bundles ---------------------------------------------------------------------------------------------------------
def _take_bundle(case: Case) -> None:
    for request in codec.decode(calls.Bundle, case.payload).requests:
        assert isinstance(request, (bytes, memoryview))
        admitted(codec.decode(calls.AppendRequest, request))


def _sound_bundle(pick: Pick) -> bundle_pb2.Bundle:
    requests = [_sound_append(pick).payload for _ in range(1 + pick(3))]
    return bundle_pb2.Bundle(schema_version=1, requests=requests)


def _hostile_among_others(pick: Pick) -> Case:
    kinds = [make for kind, make in APPEND.kinds.items() if kind != "random"]
    hostile = kinds[pick(len(kinds))](pick)
    bundle = _sound_bundle(pick)
    bundle.requests.insert(pick(len(bundle.requests) + 1), hostile.payload)
    return Case(bundle.SerializeToString(), hostile.reason)


def _whole_bundle(pick: Pick) -> Case:
    return Case(_sound_bundle(pick).SerializeToString(), None)


def _too_many_requests(pick: Pick) -> Case:
    requests = [_sound_append(pick).payload[:50]] * (257 + pick(200))
    return Case(bundle_pb2.Bundle(schema_version=1, requests=requests).SerializeToString(), r"has \d+ elements")


BUNDLE = Entry(
    take=_take_bundle,
    sound=_whole_bundle,
    kinds={
        "random": random_bytes,
        "truncated": truncated(
            _whole_bundle, lambda payload: None if is_message(bundle_pb2.Bundle, payload) else "not a valid message"
        ),
        "damaged": damaged(_whole_bundle),
        "schema version": lambda pick: Case(with_schema(_whole_bundle(pick).payload, pick), SCHEMA),
        "oversized": _too_many_requests,
        "hostile among others": _hostile_among_others,
    },
)


# --- claims ----------------------------------------------------------------------------------------------------------
CLAIM_BYTES = 2**16


def sound_claim(pick: Pick) -> jobs_pb2.ClaimRequest:
    number = pick(2**63)
    return jobs_pb2.ClaimRequest(
        schema_version=1,
        kinds=[1 + number % 3, 1 + number % 2],  # type: ignore[list-item]
        models=["sfm", f"model{number % 1000}"],
        worker=f"inference/{number:x}",
        wait_s=(1 + number % 100) / 1000,
        claim_id=f"claim{number}",
    )


def _whole_claim(pick: Pick) -> Case:
    return Case(sound_claim(pick).SerializeToString(), None)


def _too_long_claim(pick: Pick) -> Case:
    if pick(2):
        return spoiled(sound_claim, SPOILS["too long a part"])(pick)
    payload = padded(sound_claim(pick).SerializeToString(), CLAIM_BYTES + 1 + pick(1000))
    return Case(payload, "more than the allowed 65536")


def _unfolding_claim(pick: Pick) -> Case:
    """Two bytes on the wire, or one, for each element."""
    if pick(2):
        payload = sound_claim(pick).SerializeToString() + b"\x1a\x00" * (300 + pick(30_000))
    else:
        payload = (
            sound_claim(pick).SerializeToString() + b"\x12" + _varint(count := 100 + pick(60_000)) + b"\x01" * count
        )
    return Case(payload, r"has \d+ elements")


CLAIM = Entry(
    take=lambda case: codec.decode(calls.ClaimRequest, case.payload),
    sound=_whole_claim,
    kinds={
        "random": random_bytes,
        "truncated": truncated(_whole_claim, lambda _: ANYTHING),
        "damaged": damaged(_whole_claim),
        "schema version": lambda pick: Case(with_schema(_whole_claim(pick).payload, pick), SCHEMA),
        "oversized": _too_long_claim,
        "bomb": _unfolding_claim,
        "no number": spoiled(sound_claim, SPOILS["no number"]),
        "wrong value": spoiled(sound_claim, SPOILS["wrong value"]),
        "missing part": spoiled(sound_claim, SPOILS["missing part"]),
    },
)


# --- parcels ---------------------------------------------------------------------------------------------------------
def _sound_parcel(pick: Pick) -> parcel_pb2.Parcel:
    number = pick(2**63)
    return parcel_pb2.Parcel(
        schema_version=1, folder_id=f"{number:032x}", name=f"{number:016x}-7", size_bytes=1 + number % 2**29
    )


def _whole_parcel(pick: Pick) -> Case:
    return Case(_sound_parcel(pick).SerializeToString(), None)


PARCEL = Entry(
    take=lambda case: codec.decode(calls.Parcel, case.payload),
    sound=_whole_parcel,
    kinds={
        "random": random_bytes,
        "truncated": truncated(
            _whole_parcel, lambda payload: None if is_message(parcel_pb2.Parcel, payload) else "not a valid message"
        ),
        "damaged": damaged(_whole_parcel),
        "schema version": lambda pick: Case(with_schema(_whole_parcel(pick).payload, pick), SCHEMA),
        "oversized": lambda pick: Case(
            padded(_whole_parcel(pick).payload, 257 + pick(100_000)), "more than the allowed 256"
        ),
        "wrong value": spoiled(_sound_parcel, SPOILS["wrong value"]),
        "missing part": spoiled(_sound_parcel, SPOILS["missing part"]),
    },
)


# --- images ----------------------------------------------------------------------------------------------------------
def picture(extension: str, width: int = WIDTH, height: int = HEIGHT, options: Sequence[int] = ()) -> bytes:
    pixels = np.random.default_rng(width).integers(0, 255, (height, width, 3), dtype=np.uint8)
    encoded: bytes = cv2.imencode(extension, pixels, options)[1].tobytes()
    return encoded


PICTURES = {"jpeg": picture(".jpg"), "png": picture(".png")}
PROGRESSIVE = picture(".jpg", options=[cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
FORMATS = list(PICTURES)
PICTURE_BYTES = 128 * 2**20
LAST_SECOND = 4 * 10**9
NO_WHOLE_PICTURE = "not a whole JPEG or PNG image"


def image_message(data: bytes, image_format: str, time_ns: int = 1) -> bytes:
    message = CompressedImage(frame_id="camera/front", data=data, format=image_format)
    message.timestamp.FromNanoseconds(time_ns)
    return message.SerializeToString()


def image_header(index: int, epoch: int = 0) -> bytes:
    header = recording_pb2.ImageHeader(schema_version=1, epoch=epoch, frame_index=index, is_accepted=True)
    return header.SerializeToString()


def _sound_message(pick: Pick) -> CompressedImage:
    image_format = FORMATS[pick(2)]
    message = CompressedImage(frame_id="camera/front", data=PICTURES[image_format], format=image_format)
    message.timestamp.seconds, message.timestamp.nanos = pick(LAST_SECOND), pick(10**9)
    return message


def _whole_image(pick: Pick) -> Case:
    return Case(_sound_message(pick).SerializeToString(), None, image_header(pick(2**32), pick(10)))


def _around(data: bytes, image_format: str, reason: str, pick: Pick) -> Case:
    """A sound message around what may be no picture."""
    return Case(image_message(data, image_format, 1 + pick(10**18)), reason, image_header(pick(2**32), pick(10)))


def _random_image(pick: Pick) -> Case:
    case = _whole_image(pick)
    if pick(2):
        return Case(random_bytes(pick).payload, ANYTHING, case.attachment)
    # It begins with a tag that no field has.
    return Case(case.payload, "not an ImageHeader", b"\x07" + noise(pick, pick(100)))


def _reason_of_image(payload: bytes) -> str | None:
    if not is_message(CompressedImage, payload):
        return "not a foxglove.CompressedImage"
    message = CompressedImage.FromString(payload)
    return None if message.format else "is not read, only jpeg and png are"


def _damaged_image(pick: Pick) -> Case:
    case = _whole_image(pick)
    if pick(2):
        return damaged(_whole_image)(pick)
    return Case(case.payload, None, damaged(lambda _: Case(case.attachment, None))(pick).payload)


def _other_header(pick: Pick) -> Case:
    case = _whole_image(pick)
    return Case(case.payload, "image header of schema", with_schema(case.attachment, pick))


def _wrong_image(pick: Pick) -> Case:
    message, header = _sound_message(pick), image_header(pick(2**32))
    reason = "out of range"
    match pick(5):
        case 0:
            message.format = f"{('jpeg', 'png', 'webp', '')[pick(4)]} {pick(2**32)}"
            reason = "is not read, only jpeg and png are"
        case 1:
            message.timestamp.seconds = -1 - pick(2**40) if pick(2) else LAST_SECOND + 1 + pick(2**40)
        case 2:
            message.timestamp.nanos = -1 - pick(2**31 - 1) if pick(2) else 10**9 + pick(10**9)
            reason = "nanoseconds"
        case 3:
            message.ClearField("data")
            reason = "without image bytes"
        case _:
            header = image_header(2**32 + pick(2**63))
    return Case(message.SerializeToString(), reason, header)


def _truncated_picture(pick: Pick) -> Case:
    image_format = FORMATS[pick(2)]
    data = PICTURES[image_format]
    return _around(data[: 1 + pick(len(data) - 9)], image_format, NO_WHOLE_PICTURE, pick)


def _other_media_type(pick: Pick) -> Case:
    which = pick(2)
    return _around(PICTURES[FORMATS[which]], FORMATS[1 - which], "the image is image/.*, its message says image/", pick)


def _no_picture(pick: Pick) -> Case:
    """It begins, goes on to a scan and ends as a JPEG does, and there is nothing else of one in it."""
    inside = noise(pick, 10 + pick(200)).replace(b"\xff", b"\xfe")
    data = b"\xff\xd8\xff\xe0\x00\x10" + bytes(14) + b"\xff\xda" + inside + b"\xff\xd9"
    return _around(data, "jpeg", NO_WHOLE_PICTURE, pick)


def _huge_picture(pick: Pick) -> Case:
    """Some hundred bytes that say of themselves that they are 64 million pixels or up to 4 thousand million."""
    image_format = FORMATS[pick(2)]
    data = bytearray(PICTURES[image_format])
    width, height = 2**13 + 1 + pick(2**15), 2**13 + 1 + pick(2**15)
    if image_format == "jpeg":
        at = data.index(b"\xff\xc0") + 5
        data[at : at + 4] = struct.pack(">HH", height, width)
    else:
        data[16:24] = struct.pack(">II", width, height)
        data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    return _around(bytes(data), image_format, "pixels, allowed are", pick)


def _picture_of_many_scans(pick: Pick) -> Case:
    """Each is a pass over all pixels."""
    data, end = PROGRESSIVE[:-2], PROGRESSIVE[-2:]
    return _around(
        data + data[data.rindex(b"\xff\xda") :] * (100 + pick(200)) + end, "jpeg", "scans, allowed are", pick
    )


IMAGE = Entry(
    take=lambda case: decode_image(case.payload, case.attachment),
    sound=_whole_image,
    kinds={
        "random": _random_image,
        "truncated": truncated(_whole_image, _reason_of_image),
        "damaged": _damaged_image,
        "schema version": _other_header,
        "wrong value": _wrong_image,
        # A sound message around what is no picture of its type that could be a frame.
        "truncated picture": _truncated_picture,
        "wrong media type": _other_media_type,
        "no picture": _no_picture,
        "bomb": _huge_picture,
        "bomb of scans": _picture_of_many_scans,
    },
)

ENTRIES = {
    "append": APPEND,
    "done": DONE,
    "bundle": BUNDLE,
    "claim": CLAIM,
    "image": IMAGE,
    "parcel": PARCEL,
    "depth": DEPTH,
}
