"""What may enter the log: a whole record of its stream's type, under its own id, with blobs that hold what they should.

The store treats payloads as opaque. The service does not let in what its readers could only choke on: a record that
cannot be decoded would be passed over by every follower for ever, after it was acknowledged.
"""

from __future__ import annotations

from typing import Any

from vggt_motion.bus import calls, codec
from vggt_motion.errors import CodecError, RefusalCode, RequestRefusedError
from vggt_motion.ledger.log import Append
from vggt_motion.ledger.store import Blob, BlobEntry, InvalidRequestError, NewRecord, RecordRow
from vggt_motion.records import (
    Constraint,
    Event,
    GraphUpdate,
    Keyframe,
    Segment,
    Stream,
    SubmapGeometry,
)


def admitted(request: calls.AppendRequest) -> Append:
    """The record of a request, its new blobs, and the blobs that it refers to.

    Raises:
        RequestRefusedError: an unknown stream, or not a record of this stream under this id.
        CodecError: the record or one of its blobs breaks a rule of the wire.
    """
    stream = known_stream(request.stream)
    cls = codec.STREAM_RECORDS.get(stream)
    if cls is None:
        raise RequestRefusedError(f"stream {stream} takes no records in this version", RefusalCode.UNKNOWN)
    if request.payload_type != codec.payload_type(cls):
        raise InvalidRequestError(f"stream {stream} holds {codec.payload_type(cls)}, not {request.payload_type}")
    record = codec.decode(cls, request.payload)
    if _record_id(record) != request.record_id:
        raise InvalidRequestError(f"record_id '{request.record_id}' is not that of the record, '{_record_id(record)}'")
    if set(request.blob_refs) != set(codec.blob_refs(record)):
        raise InvalidRequestError(f"blob_refs of '{request.record_id}' are not what the record refers to")
    blobs = [Blob.of(data) for data in request.blobs]
    _check_blobs(request, record, blobs)
    admitted_record = NewRecord(
        stream=request.stream,
        record_id=request.record_id,
        payload_type=request.payload_type,
        payload=request.payload,
        identity_sha256=request.identity_sha256,
    )
    return Append(admitted_record, blobs, [BlobEntry(ref.sha256, ref.size_bytes) for ref in request.blob_refs])


def referenced_blobs(row: RecordRow) -> list[BlobEntry]:
    """The blobs that a stored record refers to, by what it says itself.

    Raises:
        CodecError: this version cannot decode it.
    """
    record = codec.decode(codec.record_class(row.payload_type), row.payload)
    return [BlobEntry(ref.sha256, ref.size_bytes) for ref in codec.blob_refs(record)]


def known_stream(name: str) -> Stream:
    """The stream with this name.

    Raises:
        RequestRefusedError: there is none.
    """
    try:
        return Stream(name)
    except ValueError:
        raise RequestRefusedError(f"there is no stream '{name:.40}'", RefusalCode.UNKNOWN) from None


def _record_id(record: Any) -> str:
    match record:
        case Keyframe():
            return record.keyframe_id
        case Event():
            return record.event_id
        case Segment() | SubmapGeometry() | Constraint() | GraphUpdate():
            return record.record_id
    raise TypeError(f"{type(record).__name__} is not a record of the log")


def _check_blobs(request: calls.AppendRequest, record: Any, blobs: list[Blob]) -> None:
    known = {ref.sha256 for ref in request.blob_refs}
    shapes = {}
    if isinstance(record, SubmapGeometry):
        shapes = {
            frame.depth.sha256: (frame.intrinsics.height_px, frame.intrinsics.width_px) for frame in record.frames
        }
    for blob in blobs:
        sha256 = blob.entry.sha256
        if sha256 not in known:
            raise InvalidRequestError(f"'{request.record_id}' brings a blob that it does not refer to: {sha256}")
        if sha256 in shapes:
            shape = codec.check_depth(blob.data)
            if shape != shapes[sha256]:
                raise CodecError(f"depth blob {sha256}: {shape} in place of {shapes[sha256]} (height, width)")
