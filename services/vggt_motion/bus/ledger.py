"""Client of the durable log (DESIGN section 4)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

from vggt_motion.bus import calls, codec
from vggt_motion.bus.retry import retry
from vggt_motion.bus.session import Bus
from vggt_motion.bus.wire import Payload
from vggt_motion.errors import CodecError, DiskFullError, LedgerError, VggtMotionError
from vggt_motion.records import BlobRef, LedgerStatus, LogEntry

_BLOB_PATIENCE_S = 15.0


@dataclass(frozen=True)
class AppendResult:
    """Acknowledgement: the record is on disk."""

    sequence: int
    was_known: bool  # it had been appended before


def append_request(stream: str, record_id: str, record: codec.Record, blobs: Sequence[bytes]) -> calls.AppendRequest:
    """The request that makes a record durable, with its identity and everything that it refers to.

    Raises:
        CodecError: the record breaks a rule of the wire, or a blob cannot be one that it refers to.
    """
    refs = codec.blob_refs(record)
    # The ledger hashes them all: here only what looks wrong by its length, so that nothing large is hashed again.
    sizes = {ref.size_bytes for ref in refs}
    known = {ref.sha256 for ref in refs}
    are_all_looked_at = len(blobs) > len(refs)
    for blob in blobs:
        if len(blob) in sizes and not are_all_looked_at:
            continue
        if hashlib.sha256(blob).hexdigest() not in known:
            raise CodecError(f"{record_id}: a blob of {len(blob)} bytes is not referred to by the record")
    payload, identity_sha256 = codec.encode_with_identity(record)
    return calls.AppendRequest(
        stream=str(stream),
        record_id=record_id,
        payload_type=codec.payload_type(type(record)),
        payload=payload,
        identity_sha256=identity_sha256,
        blobs=tuple(blobs),
        blob_refs=refs,
    )


class LedgerClient:
    """Calls of the ledger. Thread-safe."""

    def __init__(self, bus: Bus) -> None:
        """Bind the bus."""
        self._bus = bus

    def append(
        self,
        stream: str,
        record_id: str,
        record: codec.Record,
        blobs: Sequence[bytes] = (),
        *,
        patience_s: float | None = None,
    ) -> AppendResult:
        """Make a record durable, with the blobs that it refers to and that the ledger may not have yet.

        Returns only when it is on disk; what several threads append at a time travels together. While the ledger or
        the link is down, tries again: for ``patience_s``, or for ever.

        Raises:
            BusUnavailableError: patience is at its end, or the process was told to stop; whether it was stored is not
                known, and appending again is safe.
            RequestRefusedError: refused; code CONFLICT if the id is known with another content.
            DiskFullError: the ledger takes nothing until there is space again.
            CodecError: the record breaks a rule of the wire.
        """
        request = append_request(stream, record_id, record, blobs)
        return self.append_encoded(codec.encode_in_pieces(request), patience_s=patience_s, what=record_id)

    def append_encoded(
        self, payload: Payload, *, patience_s: float | None = None, what: str = "record"
    ) -> AppendResult:
        """As :meth:`append`, of an :class:`.calls.AppendRequest` that was encoded before."""
        key = self._bus.keys.rpc("ledger", "append")
        return retry(
            self._bus,
            lambda: _append_result(self._bus.request_among_others(key, payload)),
            patience_s=patience_s,
            what=f"append {what}",
        )

    def append_all_encoded(
        self, payloads: Sequence[Payload], *, what: str = "records"
    ) -> list[AppendResult | VggtMotionError]:
        """As :meth:`append_encoded` of several in order, in few round trips.

        Returns:
            What became of each: where it was refused, why.

        Raises:
            BusUnavailableError: the process was told to stop.
        """
        key = self._bus.keys.rpc("ledger", "append")
        results: list[AppendResult | VggtMotionError] = []
        while len(results) < len(payloads):
            rest = payloads[len(results) :]
            answers = retry(
                self._bus,
                lambda rest=rest: self._bus.request_all(key, rest),  # type: ignore[misc]
                patience_s=None,
                what=f"append {what} and others",
            )
            results += [answer if isinstance(answer, VggtMotionError) else _append_result(answer) for answer in answers]
            full = next((result for result in results if isinstance(result, DiskFullError)), None)
            if full is not None:  # the others may not overtake it
                results += [full] * (len(payloads) - len(results))
        return results

    def read(self, stream: str, from_sequence: int, limit: int = 0, *, patience_s: float = 0.0) -> list[LogEntry]:
        """Entries of a stream from a sequence number on, in order and without gap.

        Args:
            stream: its name.
            from_sequence: first to return; 0 is the beginning.
            limit: at most so many; 0 = as many as the ledger likes. May be fewer, but is empty only at the end.
            patience_s: how long to try again while nobody answers.

        Raises:
            BusUnavailableError: nobody answers.
            RequestRefusedError: the stream is unknown.
        """
        return list(self.page(stream, from_sequence, limit, patience_s=patience_s).entries)

    def page(self, stream: str, from_sequence: int, limit: int = 0, *, patience_s: float = 0.0) -> calls.ReadReply:
        """As :meth:`read`, with the position of the stream's end.

        Raises:
            CodecError: the answer has a gap, or is not what was asked for.
        """
        payload = codec.encode(calls.ReadRequest(str(stream), from_sequence, limit))
        key = self._bus.keys.rpc("ledger", "read")
        reply = retry(
            self._bus,
            lambda: codec.decode(calls.ReadReply, self._bus.request(key, payload)),
            patience_s=patience_s,
            what=f"read {stream}",
        )
        if limit and len(reply.entries) > limit:
            raise CodecError(f"read {stream}: {len(reply.entries)} entries came where {limit} were asked for")
        for offset, entry in enumerate(reply.entries):
            if entry.sequence != from_sequence + offset or entry.stream != stream:
                raise CodecError(
                    f"read {stream}: entry {entry.stream}/{entry.sequence} in place of {from_sequence + offset}"
                )
        return reply

    def blobs(self, refs: Sequence[BlobRef], *, patience_s: float = _BLOB_PATIENCE_S) -> list[bytes]:
        """The bytes of several blobs, verified, in few round trips.

        Raises:
            BusUnavailableError: nobody answers.
            RequestRefusedError: the ledger does not have one of them (code UNKNOWN).
            LedgerError: what came is not what a reference says.
        """
        key = self._bus.keys.rpc("ledger", "blobs")
        contents: list[bytes] = []
        while len(contents) < len(refs):
            asked = refs[len(contents) : len(contents) + codec.MAX_BLOBS_PER_REQUEST]
            payload = codec.encode(calls.BlobsRequest(tuple(ref.sha256 for ref in asked)))
            answer = retry(
                self._bus,
                lambda payload=payload: self._bus.request(key, payload),  # type: ignore[misc]
                patience_s=patience_s,
                what=f"{len(asked)} blobs",
            )
            found = codec.decode(calls.BlobsReply, answer).blobs
            if len(found) > len(asked):
                raise CodecError(f"{len(found)} blobs came where {len(asked)} were asked for")
            contents += [_verified(bytes(content), ref) for content, ref in zip(found, asked, strict=False)]
        return contents

    def blob(self, ref: BlobRef, *, patience_s: float = _BLOB_PATIENCE_S) -> bytes:
        """The bytes of a blob, verified.

        Raises:
            BusUnavailableError: nobody answers.
            RequestRefusedError: the ledger does not have it (code UNKNOWN).
            LedgerError: what came is not what the reference says.
        """
        content = retry(
            self._bus,
            lambda: self._bus.request(self._bus.keys.blob(ref.sha256), b""),
            patience_s=patience_s,
            what=f"blob {ref.sha256[:12]}",
        )
        return _verified(content, ref)

    def status(self) -> LedgerStatus:
        """Positions, jobs and space.

        Raises:
            BusUnavailableError: nobody answers.
        """
        key = self._bus.keys.rpc("ledger", "status")
        return codec.decode(LedgerStatus, self._bus.request(key, codec.encode(calls.StatusRequest())))


def _append_result(answer: bytes) -> AppendResult:
    reply = codec.decode(calls.AppendReply, answer)
    return AppendResult(reply.sequence, reply.was_known)


def _verified(content: bytes, ref: BlobRef) -> bytes:
    if len(content) != ref.size_bytes or hashlib.sha256(content).hexdigest() != ref.sha256:
        raise LedgerError(f"blob {ref.sha256[:12]}: {len(content)} bytes came that are not its content")
    return content
