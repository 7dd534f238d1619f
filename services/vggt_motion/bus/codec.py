"""Records and calls to bytes and back: the only place where dataclasses and protobuf messages meet.

Whatever is malformed, out of bounds, of a wrong length or of a newer schema ends as :class:`CodecError` with one line
that names the field. Fields that this version does not know are skipped, as protobuf does: adding a field keeps the
version. What each message may hold stands in ``contract``.
"""

from __future__ import annotations

import hashlib
from typing import Any, Final, TypeAlias, TypeVar

from google.protobuf.message import DecodeError, EncodeError, Message

from vggt_motion.bus.bulk import LIFTED_FROM_BYTES, lift
from vggt_motion.bus.contract.calls import CALL_PLANS
from vggt_motion.bus.contract.records import RECORD_PLANS
from vggt_motion.bus.contract.values import MAX_BLOB_BYTES, MAX_BLOBS_PER_REQUEST, MAX_REQUESTS_PER_BUNDLE
from vggt_motion.bus.depth import MEDIA_TYPE as DEPTH_MEDIA_TYPE
from vggt_motion.bus.depth import check_depth, decode_depth, encode_depth
from vggt_motion.bus.scan import check_structure
from vggt_motion.bus.schema import FieldError, Plan
from vggt_motion.bus.wire import Payload, Pieces, joined
from vggt_motion.errors import CodecError
from vggt_motion.records import BlobRef, Constraint, Event, GraphUpdate, Keyframe, Segment, Stream, SubmapGeometry

__all__ = [
    "DEPTH_MEDIA_TYPE",
    "MAX_BLOBS_PER_REQUEST",
    "MAX_BLOB_BYTES",
    "MAX_REQUESTS_PER_BUNDLE",
    "SCHEMA_VERSION",
    "STREAM_RECORDS",
    "Record",
    "blob_ref",
    "blob_refs",
    "check_depth",
    "decode",
    "decode_depth",
    "encode",
    "encode_depth",
    "encode_in_pieces",
    "encode_with_identity",
    "encoding_of",
    "identity_digest",
    "payload_type",
    "record_class",
]

SCHEMA_VERSION: Final = 1
STREAM_RECORDS: Final[dict[Stream, type[Any]]] = {
    Stream.KEYFRAME: Keyframe,
    Stream.SEGMENT: Segment,
    Stream.SUBMAP: SubmapGeometry,
    Stream.CONSTRAINT: Constraint,
    Stream.GRAPH: GraphUpdate,
    Stream.EVENT: Event,
}

Record: TypeAlias = Keyframe | Segment | SubmapGeometry | Constraint | GraphUpdate | Event
"""What a stream of the log may hold."""

_Message = TypeVar("_Message")
_Bytes = TypeVar("_Bytes", bound=bytes | memoryview | Pieces)

_PLANS: Final = (*RECORD_PLANS, *CALL_PLANS)
_BY_CLASS: Final = {plan.record: plan for plan in _PLANS}
_BY_NAME: Final = {plan.full_name: plan.record for plan in _PLANS}
_VERSIONED: Final = {plan.record for plan in _PLANS if "schema_version" in plan.message.DESCRIPTOR.fields_by_name}


def encode(record: Any) -> bytes:
    """Serialise a record of ``records.py`` or a call of ``bus/calls.py``; equal records give equal bytes.

    Raises:
        CodecError: a value breaks a rule of the wire; the message names the field.
    """
    return joined(encode_in_pieces(record))


def encode_in_pieces(record: Any) -> Payload:
    """:func:`encode`, without a copy of what is megabytes long: blobs, and the requests of a bundle.

    Raises:
        CodecError: see there.
    """
    plan = _plan_of(type(record))
    if not plan.has_bulk:
        return _serialise(_message(plan, record), plan)
    try:
        return _bounded(Pieces(plan.pieces(record, _empty(plan))), plan)
    except FieldError as error:
        raise _codec_error(plan, error) from None
    except (EncodeError, ValueError) as error:
        raise CodecError(f"{plan.full_name}: cannot be serialised: {_one_line(error)}") from None


def encode_with_identity(record: Any) -> tuple[bytes, bytes]:
    """:func:`encode` and :func:`identity_digest` of a record in one go."""
    plan = _plan_of(type(record))
    message = _message(plan, record)
    return _serialise(message, plan), _identity(message, plan)


def decode(cls: type[_Message], payload: bytes | memoryview) -> _Message:
    """Parse and check a record or call; the inverse of :func:`encode`.

    The blobs of a long request, and the requests of a long bundle, are views of ``payload``, not copies.

    Raises:
        CodecError: one line that names the type and the field that is wrong.
    """
    plan = _plan_of(cls)
    _bounded(payload, plan)
    check_structure(payload, plan.message.DESCRIPTOR)
    lifted = None
    if plan.has_bulk and len(payload) >= LIFTED_FROM_BYTES:
        payload, lifted = lift(payload, plan)
    message = plan.message()
    try:
        message.ParseFromString(bytes(payload))
    except (DecodeError, ValueError) as error:
        raise CodecError(f"{plan.full_name}: not a valid message: {_one_line(error)}") from None
    if cls in _VERSIONED:
        version = message.schema_version  # type: ignore[attr-defined]
        if version != SCHEMA_VERSION:
            problem = "is missing" if version == 0 else f"{version} is newer than the known {SCHEMA_VERSION}"
            raise CodecError(f"{plan.full_name}: schema_version {problem}")
    try:
        record: _Message = plan.read(message, lifted)
    except FieldError as error:
        raise _codec_error(plan, error) from None
    return record


def payload_type(cls: type[Any]) -> str:
    """Full name of the message of a class: ``vggt_motion.v1.Keyframe``."""
    return _plan_of(cls).full_name


def encoding_of(cls: type[Any]) -> str:
    """Zenoh encoding of a class: ``application/protobuf;vggt_motion.v1.Keyframe``."""
    return f"application/protobuf;{payload_type(cls)}"


def record_class(name: str) -> type[Any]:
    """The class of a message by its full name; the inverse of :func:`payload_type`.

    Raises:
        CodecError: this version does not know the name.
    """
    if name not in _BY_NAME:
        raise CodecError(f"message type '{name:.128}' is not known here")
    return _BY_NAME[name]


def identity_digest(record: Any) -> bytes:
    """SHA-256 over the record's type and its canonical bytes without informative fields (wall clock, durations).

    Two records with one id are the same record if and only if their digests are equal: this is what the ledger
    compares, to which payloads are opaque.
    """
    plan = _plan_of(type(record))
    return _identity(_message(plan, record), plan)


def blob_ref(content: bytes, media_type: str) -> BlobRef:
    """Reference to bytes that are about to be stored."""
    return BlobRef(hashlib.sha256(content).hexdigest(), len(content), media_type)


def blob_refs(record: Any) -> tuple[BlobRef, ...]:
    """Every blob that a record refers to, once, in order of appearance."""
    return tuple(dict.fromkeys(_plan_of(type(record)).parts(record, BlobRef)))


def _plan_of(cls: type[Any]) -> Plan:
    if cls not in _BY_CLASS:
        raise TypeError(f"{cls.__name__} is not a message of the wire")
    return _BY_CLASS[cls]


def _message(plan: Plan, record: Any) -> Message:
    message = _empty(plan)
    try:
        plan.fill(message, record)
    except FieldError as error:
        raise _codec_error(plan, error) from None
    return message


def _empty(plan: Plan) -> Message:
    message = plan.message()
    if plan.record in _VERSIONED:
        message.schema_version = SCHEMA_VERSION  # type: ignore[attr-defined]
    return message


def _serialise(message: Message, plan: Plan) -> bytes:
    try:
        payload = message.SerializeToString(deterministic=True)
    except (EncodeError, ValueError) as error:
        raise CodecError(f"{plan.full_name}: cannot be serialised: {_one_line(error)}") from None
    return _bounded(payload, plan)


def _identity(message: Message, plan: Plan) -> bytes:
    for name in plan.informative:
        message.ClearField(name)
    return hashlib.sha256(plan.full_name.encode() + b"\0" + _serialise(message, plan)).digest()


def _bounded(payload: _Bytes, plan: Plan) -> _Bytes:
    if len(payload) > plan.max_bytes:
        raise CodecError(f"{plan.full_name}: {len(payload)} bytes are more than the allowed {plan.max_bytes}")
    return payload


def _codec_error(plan: Plan, error: FieldError) -> CodecError:
    place = ".".join([plan.full_name, *error.path]).replace(".[", "[")
    return CodecError(f"{place}: {error.problem}")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
