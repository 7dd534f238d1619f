"""The durable log: streams of records with dense sequence numbers, appended idempotently, and the blobs they refer to.

An append is acknowledged when its blobs and its row have been forced to the disk: little with the row, in one commit;
more before it in a pack, whose sync those that come together share; large ones as files. It may be repeated at will:
the same identity under the same id is acknowledged again with the same sequence number, another identity is refused.

Most records are new, and so is what they bring: they are put down without a look at what there is, in one transaction
that finds out if they are not.
"""

from __future__ import annotations

import contextlib
import functools
import re
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from vggt_motion.errors import DiskFullError, LedgerError, RequestRefusedError, VggtMotionError
from vggt_motion.ledger.recent import RecentBlobs
from vggt_motion.ledger.store import (
    Blob,
    BlobEntry,
    Blobs,
    ConflictError,
    Content,
    DamagedBlobError,
    InvalidRequestError,
    NewRecord,
    Packs,
    Place,
    Reader,
    RecordRow,
    Rows,
    Transaction,
    UnknownError,
    digest_of,
    printable,
    reserve_line,
    sha256_hex,
)

MAX_RECORD_ID_BYTES = 256
MAX_PAYLOAD_TYPE_BYTES = 128
MAX_PAYLOAD_BYTES = 32 * 2**20
MAX_BLOBS_PER_RECORD = 4096
MAX_READ_RECORDS = 1000
MAX_READ_BYTES = 8 * 2**20
IDENTITY_BYTES = 32

PACKED_BLOB_BYTES = 16 * 2**20
"""Blobs up to this length lie in packs.

Measured at 5 MB: one costs two syncs in a pack, three as a file, and half the processor time; of eight at a time, which
share a sync, nearly twice as many are stored.
"""

INLINE_BYTES = 64 * 2**10
"""Blobs that come together and are not longer than this in all stand among the rows.

One sync in place of two for what comes alone. But a database writes everything twice, the second time in a commit that
others wait for: measured, from 60 kB on a pack costs less, at 100 kB by a sixth.
"""

_STREAM = re.compile(r"[a-z][a-z0-9_]{0,31}")
_IDENTIFIER = re.compile(r"[!-~]+")


class Append(NamedTuple):
    """A record that is to become durable."""

    record: NewRecord
    blobs: Sequence[Content | Blob] = ()  # new ones, that travel with it
    references: Sequence[BlobEntry] = ()  # what it refers to; each among ``blobs`` or stored already


@dataclass(frozen=True)
class Appended:
    """Acknowledgement of a durable record."""

    sequence: int  # dense per stream, from 0
    was_known: bool


@dataclass(frozen=True)
class Prepared:
    """The blobs of a record that is about to be added."""

    entries: tuple[BlobEntry, ...] = ()  # every blob that the record refers to
    places: tuple[tuple[BlobEntry, Place], ...] = ()  # where those among them lie that have been packed for it
    contents: tuple[tuple[BlobEntry, Content], ...] = ()  # of those among them that are to be kept with the row


_NOTHING = Prepared()


class _NotNewError(Exception):
    """The record or one of its blobs has been here before."""


class _Needs(NamedTuple):
    """What has to become durable before the row of a record."""

    entries: tuple[BlobEntry, ...]
    small: dict[BlobEntry, Content]
    large: list[Blob]
    keep_free_bytes: int

    @property
    def new_bytes(self) -> int:
        """Length of what travels with the record."""
        return sum(map(len, self.small.values())) + sum(len(blob.data) for blob in self.large)


def _no_wait() -> None:
    """All is durable."""


class _Placing(NamedTuple):
    """Where new contents will be."""

    places: dict[BlobEntry, Place]
    inline: dict[BlobEntry, Content]
    wait: Callable[[], None]  # until all of them are durable: nothing that refers to them is committed before

    def prepared(self, entries: tuple[BlobEntry, ...], brought: Iterable[BlobEntry]) -> Prepared:
        """Of a record that refers to some and brings some of them."""
        packed = tuple((entry, self.places[entry]) for entry in brought if entry in self.places)
        contents = tuple((entry, self.inline[entry]) for entry in brought if entry in self.inline)
        return Prepared(entries, packed, contents)


class _Kept(NamedTuple):
    """The blobs of several records that are about to be added."""

    prepared: dict[int, Prepared | Exception]
    wait: Callable[[], None]  # as that of the placing
    waiting: frozenset[int]  # those that have something to wait for


def _held_back(
    outcomes: dict[int, Appended | Exception], indices: Iterable[int], wanted: Sequence[Append]
) -> dict[int, Appended | Exception]:
    """Outcomes, with those of records that may not overtake one of their stream for which the disk is too full."""
    full: dict[str, Exception] = {}
    held = dict(outcomes)
    for index in indices:
        stream = wanted[index].record.stream
        if index not in held and stream in full:
            held[index] = full[stream]
        outcome = held.get(index)
        if isinstance(outcome, DiskFullError):
            full.setdefault(stream, outcome)
    return held


@dataclass(frozen=True)
class Sizes:
    """Bytes of a session on disk."""

    row_bytes: int
    blob_bytes: int
    free_bytes: int


class Store:
    """The log of one session. Thread-safe; may block for a disk."""

    def __init__(
        self,
        rows: Rows,
        blobs: Blobs,
        packs: Packs,
        *,
        reserve_bytes: int = 0,
        input_streams: Collection[str] = (),
        packed_blob_bytes: int = PACKED_BLOB_BYTES,
        inline_bytes: int = INLINE_BYTES,
        recent_bytes: int = 0,
        time_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Put the log's rules on top of rows and blobs.

        Args:
            rows: durable rows.
            blobs: durable blobs, the large ones.
            packs: durable blobs, the small ones.
            reserve_bytes: free bytes below which new input is refused; everything else may use half of them.
            input_streams: the streams that bring new input, and with it more work and more data.
            packed_blob_bytes: length up to which new blobs are packed, or kept among the rows.
            inline_bytes: length in all up to which those of them that come together are kept among the rows.
            recent_bytes: so much of what came last is answered from memory.
            time_ns: wall clock, informative.
        """
        self._rows = rows
        self._blobs = blobs
        self._packs = packs
        self.reserve_bytes = reserve_bytes
        self._input_streams = frozenset(input_streams)
        self._packed_blob_bytes = packed_blob_bytes
        self._inline_bytes = inline_bytes
        self._recent = RecentBlobs(recent_bytes)
        self._time_ns = time_ns

    def append(
        self, record: NewRecord, blobs: Sequence[Content | Blob] = (), references: Sequence[BlobEntry] = ()
    ) -> Appended:
        """Make a record durable, with its blobs.

        Args:
            record: the record; the payload is opaque.
            blobs: new blobs that travel with it.
            references: the blobs that it refers to; each must be among ``blobs`` or stored already.

        Raises:
            InvalidRequestError: malformed or out of bounds.
            ConflictError: the id is known with another identity.
            UnknownError: a reference to a blob that is neither here nor stored.
            DiskFullError: not enough space; nothing was changed.
        """
        (outcome,) = self.append_all([Append(record, blobs, references)])
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    def append_all(self, wanted: Sequence[Append]) -> list[Appended | Exception]:
        """Make several records durable, each for itself, under one fsync.

        Returns:
            For each, in order, its acknowledgement or what :meth:`append` would have raised.
        """
        try:
            free_bytes = self._blobs.free_bytes()
        except VggtMotionError as error:
            return [error] * len(wanted)
        outcomes = self._appended_as_new(wanted, free_bytes) or self._append_after_a_look(wanted, free_bytes)
        for index, outcome in outcomes.items():
            if isinstance(outcome, Appended):
                self.remember(wanted[index].blobs)
        return [outcomes[index] for index in range(len(wanted))]

    def _appended_as_new(self, wanted: Sequence[Append], free_bytes: int) -> dict[int, Appended | Exception]:
        """Append records that are all new and bring what they refer to: most do, and nothing is read twice.

        Returns:
            Nothing where one is not, or may not be added: then nothing was changed.
        """
        brought = [{blob.entry: blob.data for blob in map(Blob.of, entry.blobs)} for entry in wanted]
        new = {entry: data for blobs in brought for entry, data in blobs.items()}
        sizes = [entry.size_bytes for entry in new]
        if free_bytes < self.reserve_bytes + 2 * sum(sizes) or max(sizes, default=0) > self._packed_blob_bytes:
            return {}
        if len({(entry.record.stream, entry.record.record_id) for entry in wanted}) < len(wanted):
            return {}
        for append, blobs in zip(wanted, brought, strict=True):
            if len(blobs) > MAX_BLOBS_PER_RECORD or set(append.references) != set(blobs):
                return {}
            if not _is_valid(append.record):
                return {}

        def add_all(transaction: Transaction) -> list[Appended]:
            for append in wanted:
                if self._find_known(transaction, append.record) is not None:
                    raise _NotNewError
            for entry in new:
                if transaction.find_blob(entry.sha256) is not None:
                    raise _NotNewError
            placing = self._begin(new)
            appended = [
                self._insert(transaction, append.record, placing.prepared(tuple(blobs), blobs))
                for append, blobs in zip(wanted, brought, strict=True)
            ]
            placing.wait()
            return appended

        try:
            return dict(enumerate(self._rows.write(add_all)))
        except (DiskFullError, RequestRefusedError, _NotNewError):
            return {}  # which of them, a second look finds out
        except VggtMotionError as error:
            return dict.fromkeys(range(len(wanted)), error)

    def _begin(self, new: dict[BlobEntry, Content]) -> _Placing:
        """Give contents their places: among the rows, or in a pack, to which they are on their way then."""
        if sum(entry.size_bytes for entry in new) <= self._inline_bytes:
            return _Placing({}, new, _no_wait)
        writing = self._packs.begin(list(new.values()))
        return _Placing(dict(zip(new, writing.places, strict=True)), {}, writing.wait)

    def _write_all(
        self, changes: dict[int, Callable[[Transaction], Appended]], kept: _Kept, wanted: Sequence[Append]
    ) -> dict[int, Appended | Exception]:
        """Carry out changes in one commit, each for itself if they do not all go at once."""

        def all_at_once(transaction: Transaction) -> list[Appended]:
            appended = [change(transaction) for change in changes.values()]
            kept.wait()
            return appended

        if not changes:
            return {}
        with contextlib.suppress(VggtMotionError):
            return dict(zip(changes, self._rows.write(all_at_once), strict=True))
        outcomes: dict[int, Appended | Exception] = {}
        try:
            kept.wait()
        except VggtMotionError as error:
            outcomes |= {index: error for index in changes if index in kept.waiting}
        outcomes = _held_back(outcomes, changes, wanted)
        rest = {index: change for index, change in changes.items() if index not in outcomes}
        try:
            return outcomes | dict(zip(rest, self._rows.write_all(list(rest.values())), strict=True))
        except VggtMotionError as error:
            return outcomes | dict.fromkeys(rest, error)

    def _append_after_a_look(self, wanted: Sequence[Append], free_bytes: int) -> dict[int, Appended | Exception]:
        """:meth:`append_all` of records that may be known, or bring more than stands among the rows."""
        outcomes: dict[int, Appended | Exception] = {}
        needed: dict[int, _Needs] = {}
        known = self._known(wanted, is_accepting=free_bytes >= self.reserve_bytes)
        for index, entry in enumerate(wanted):
            row = known.get(index)
            try:
                if isinstance(row, Exception):
                    raise row
                if row is not None and self._has_all(row.stream, row.sequence):
                    outcomes[index] = Appended(row.sequence, was_known=True)
                    continue
                is_input = entry.record.stream in self._input_streams
                needed[index] = self._needs(entry.blobs, entry.references, free_bytes, is_input=is_input)
                free_bytes -= needed[index].new_bytes
            except VggtMotionError as error:
                outcomes[index] = error
        outcomes = _held_back(outcomes, range(len(wanted)), wanted)
        needed = {index: needs for index, needs in needed.items() if index not in outcomes}
        changes: dict[int, Callable[[Transaction], Appended]] = {}
        kept = self._kept(needed)
        for index, prepared in kept.prepared.items():
            if isinstance(prepared, Exception):
                outcomes[index] = prepared
            else:
                changes[index] = functools.partial(self.add, record=wanted[index].record, prepared=prepared)
        outcomes = _held_back(outcomes, range(len(wanted)), wanted)
        changes = {index: change for index, change in changes.items() if index not in outcomes}
        return outcomes | self._write_all(changes, kept, wanted)

    def _known(self, wanted: Sequence[Append], *, is_accepting: bool) -> dict[int, RecordRow | VggtMotionError]:
        """The rows of those that are there already, before blobs are written or space is asked for; or what is wrong.

        Those without blobs are not looked for while there is space: the commit does it.
        """
        found: dict[int, RecordRow | VggtMotionError] = {}
        asked: list[int] = []
        for index, entry in enumerate(wanted):
            try:
                check_record(entry.record)
            except InvalidRequestError as error:
                found[index] = error
                continue
            if entry.blobs or not is_accepting:
                asked.append(index)

        def look(reader: Reader) -> dict[int, RecordRow | VggtMotionError]:
            seen: dict[int, RecordRow | VggtMotionError] = {}
            for index in asked:
                try:
                    row = self._find_known(reader, wanted[index].record)
                except ConflictError as error:
                    seen[index] = error
                    continue
                if row is not None:
                    seen[index] = row
            return seen

        try:
            return found | (self._rows.read(look) if asked else {})
        except VggtMotionError as error:
            return found | dict.fromkeys(asked, error)

    def prepare(self, blobs: Sequence[Content | Blob], references: Sequence[BlobEntry], *, is_input: bool) -> Prepared:
        """Make the blobs of a record durable, before its row, and see that every blob will be there.

        Raises:
            InvalidRequestError: too many.
            UnknownError: a reference to a blob that is neither here nor stored.
            DiskFullError: not enough space.
        """
        kept = self._kept({0: self._needs(blobs, references, self._blobs.free_bytes(), is_input=is_input)})
        outcome = kept.prepared[0]
        if isinstance(outcome, Exception):
            raise outcome
        kept.wait()
        return outcome

    def _needs(
        self, blobs: Sequence[Content | Blob], references: Sequence[BlobEntry], free_bytes: int, *, is_input: bool
    ) -> _Needs:
        """What :meth:`prepare` has to do, after it was checked."""
        if len(blobs) > MAX_BLOBS_PER_RECORD or len(references) > MAX_BLOBS_PER_RECORD:
            raise InvalidRequestError(f"more than {MAX_BLOBS_PER_RECORD} blobs for one record")
        keep_free_bytes = self.reserve_bytes if is_input else self.reserve_bytes // 2
        if free_bytes < keep_free_bytes:
            raise DiskFullError(reserve_line(free_bytes, keep_free_bytes))
        hashed = [Blob.of(data) for data in blobs]
        brought = {blob.entry.sha256: blob.entry.size_bytes for blob in hashed}
        for reference in references:
            if reference.sha256 in brought:
                is_there = brought[reference.sha256] == reference.size_bytes
            else:
                is_there = self._has(reference)
            if not is_there:
                raise UnknownError(
                    f"no blob {reference.sha256} of {reference.size_bytes} bytes, to which the record refers"
                )
        small = {blob.entry: blob.data for blob in hashed if len(blob.data) <= self._packed_blob_bytes}
        # Among the rows the write-ahead log and the database hold each for a while.
        small_bytes = 2 * sum(entry.size_bytes for entry in small)
        if free_bytes < small_bytes:
            raise DiskFullError(f"the ledger's disk has no space for {small_bytes} bytes: {free_bytes} are left")
        large = [blob for blob in hashed if blob.entry not in small]
        entries = sorted({*(blob.entry for blob in hashed), *references}, key=lambda entry: entry.sha256)
        return _Needs(tuple(entries), small, large, keep_free_bytes)

    def _kept(self, needed: dict[int, _Needs]) -> _Kept:
        """Make the blobs of several records durable: the small ones under one sync, of the others each for itself.

        What lies in packs is durable only after it was waited for.
        """
        placing = _Placing({}, {}, _no_wait)
        failure: VggtMotionError | None = None
        try:
            new = self._not_kept({entry: data for needs in needed.values() for entry, data in needs.small.items()})
            placing = self._begin(new)
        except VggtMotionError as error:
            failure = error
        outcomes: dict[int, Prepared | Exception] = {}
        for index, needs in needed.items():
            if needs.small and failure is not None:
                outcomes[index] = failure
                continue
            try:
                if needs.large:
                    self._blobs.put(needs.large, keep_free_bytes=needs.keep_free_bytes)
            except VggtMotionError as error:
                outcomes[index] = error
                continue
            outcomes[index] = placing.prepared(needs.entries, needs.small)
        packed = placing.places
        waiting = frozenset(index for index, needs in needed.items() if any(entry in packed for entry in needs.small))
        return _Kept(outcomes, placing.wait, waiting)

    def _not_kept(self, small: dict[BlobEntry, Content]) -> dict[BlobEntry, Content]:
        """Those that are not kept yet, or are damaged: then they come back so."""
        if not small:
            return small

        def look(reader: Reader) -> dict[BlobEntry, tuple[Place | None, bytes | None]]:
            known = [entry for entry in small if reader.find_blob(entry.sha256) is not None]
            return {entry: (reader.find_place(entry.sha256), reader.find_content(entry.sha256)) for entry in known}

        found = self._rows.read(look)
        missing = {}
        for entry, data in small.items():
            place, content = found.get(entry, (None, None))
            kept = content if place is None else self._packs.read(place)
            if kept != data:
                missing[entry] = data
                if kept is not None:
                    set_content_aside(self._rows, self._blobs, entry.sha256, kept, place)
        return missing

    def add(self, transaction: Transaction, record: NewRecord, prepared: Prepared = _NOTHING) -> Appended:
        """Append within a larger change; the record must be checked and its blobs prepared already."""
        known = self._find_known(transaction, record)
        if known is None:
            return self._insert(transaction, record, prepared)
        # A content that was damaged comes back so.
        _tell_where(transaction, prepared)
        return Appended(known.sequence, was_known=True)

    def remember(self, blobs: Sequence[Content | Blob]) -> None:
        """Answer these from memory for a while: they are durable."""
        self._recent.add(blob for blob in blobs if isinstance(blob, Blob))

    def _insert(self, transaction: Transaction, record: NewRecord, prepared: Prepared) -> Appended:
        _tell_where(transaction, prepared)
        sequence = transaction.next_sequence(record.stream)
        time_ns = self._time_ns()
        row = RecordRow(
            stream=record.stream,
            sequence=sequence,
            record_id=record.record_id,
            payload_type=record.payload_type,
            payload=record.payload,
            identity_sha256=record.identity_sha256,
            append_time_ns=time_ns,
            row_sha256=row_digest(record, sequence, time_ns, [entry.sha256 for entry in prepared.entries]),
        )
        transaction.add_record(row)
        told = {entry for entry, _ in (*prepared.places, *prepared.contents)}
        for entry in prepared.entries:
            if entry not in told:
                transaction.add_blob(entry)
            transaction.add_reference(record.stream, sequence, entry.sha256)
        return Appended(sequence, was_known=False)

    def read(self, stream: str, from_sequence: int = 0, limit: int = 0) -> list[RecordRow]:
        """Records ``from_sequence``, ``from_sequence + 1``, ... in order; empty only at the end of the stream.

        Args:
            stream: name of the stream; one without records is empty.
            from_sequence: first sequence number.
            limit: at most so many, 0 = as many as allowed; fewer come back when they are large.

        Raises:
            InvalidRequestError: malformed or out of bounds.
        """
        check_stream(stream)
        if not 0 <= from_sequence < 2**63 or limit < 0:
            raise InvalidRequestError("from_sequence and limit must not be negative")
        count = min(limit or MAX_READ_RECORDS, MAX_READ_RECORDS)
        return self._rows.read(lambda reader: list(bounded_records(reader, stream, from_sequence, count)))

    def blob(self, sha256: str) -> Content:
        """The bytes of a blob, verified when they came or are read.

        Damaged ones are set aside, and appending the record again heals them.

        Raises:
            InvalidRequestError: not a SHA-256.
            UnknownError: there is no such blob.
            DamagedBlobError: its bytes are not what they were.
        """
        recent = self._recent.get(sha256)
        if recent is not None:
            return recent
        content, place = self._rows.read(lambda reader: (reader.find_content(sha256), reader.find_place(sha256)))
        if place is not None:
            content = self._packs.read(place)
        if content is None:
            return self._blobs.get(sha256)
        if sha256_hex(content) != sha256:
            set_content_aside(self._rows, self._blobs, sha256, content, place)
            raise DamagedBlobError(f"blob {sha256} is damaged: {len(content)} bytes with another hash")
        return content

    def positions(self) -> dict[str, int]:
        """Next sequence number of every stream that has records.

        Raises:
            LedgerError: a damaged row, with a name that no stream can have.
        """
        positions = self._rows.read(lambda reader: dict(reader.positions()))
        for stream in positions:
            if not _STREAM.fullmatch(stream):
                raise LedgerError(f"a damaged row, of a stream '{printable(stream):.40}': run a check")
        return positions

    def sizes(self) -> Sizes:
        """Bytes on disk."""
        blob_bytes = self._rows.read(lambda reader: reader.blob_bytes())
        return Sizes(self._rows.size_bytes(), blob_bytes, self._blobs.free_bytes())

    @property
    def is_accepting(self) -> bool:
        """Whether there is space for new input."""
        return self._blobs.free_bytes() >= self.reserve_bytes

    def _find_known(self, reader: Reader, record: NewRecord) -> RecordRow | None:
        known = reader.find_record(record.stream, record.record_id)
        if known is not None and known.identity_sha256 != record.identity_sha256:
            raise ConflictError(
                f"{record.stream} record '{record.record_id}' is known with another content (sequence {known.sequence})"
            )
        return known

    def _has_all(self, stream: str, sequence: int) -> bool:
        # A blob that was damaged and set aside comes back with a repeated append.
        entries = self._rows.read(lambda reader: reader.record_blobs(stream, sequence))
        return all(self._has(entry) for entry in entries)

    def _has(self, entry: BlobEntry) -> bool:
        place, is_row = self._rows.read(
            lambda reader: (reader.find_place(entry.sha256), reader.has_content(entry.sha256, entry.size_bytes))
        )
        if place is not None:
            return place.size_bytes == entry.size_bytes and self._packs.has(place)
        return is_row or self._blobs.has(entry.sha256, entry.size_bytes)


def _tell_where(transaction: Transaction, prepared: Prepared) -> None:
    for entry, place in prepared.places:
        transaction.set_place(entry, place)
    for entry, content in prepared.contents:
        transaction.set_content(entry, content)


def set_content_aside(rows: Rows, blobs: Blobs, sha256: str, content: bytes, place: Place | None) -> None:
    """Forget a small blob that is damaged where it was read, and keep what there is for a person.

    Only there: it may have come back meanwhile.
    """
    blobs.keep_damaged(sha256, content)
    if place is None:
        rows.write(lambda transaction: transaction.remove_content(sha256, content))
    else:
        rows.write(lambda transaction: transaction.remove_place(sha256, place))


def bounded_records(reader: Reader, stream: str, from_sequence: int, count: int) -> Sequence[RecordRow]:
    """Up to ``count`` records and, but for the first, up to ``MAX_READ_BYTES`` of payload."""
    rows: list[RecordRow] = []
    size_bytes = 0
    while len(rows) < count:
        # In small steps, so that a few large records do not pull hundreds of others into memory with them.
        step = reader.records(stream, from_sequence + len(rows), min(32, count - len(rows)))
        for row in step:
            size_bytes += len(row.payload)
            if rows and size_bytes > MAX_READ_BYTES:
                return rows
            rows.append(row)
        if not step:
            return rows
    return rows


def check_stream(stream: str) -> None:
    """Refuse a name that no stream can have."""
    if not _STREAM.fullmatch(stream):
        raise InvalidRequestError(f"'{stream[:40]!s}' is not the name of a stream")


def check_id(name: str, value: str, max_bytes: int = MAX_RECORD_ID_BYTES) -> None:
    """Refuse an id that is empty, too long or more than printable ASCII without blanks."""
    if len(value) > max_bytes or not _IDENTIFIER.fullmatch(value):
        raise InvalidRequestError(f"{name} must be 1 to {max_bytes} characters of printable ASCII without blanks")


def check_record(record: NewRecord) -> None:
    """Refuse what is malformed or out of bounds.

    Raises:
        InvalidRequestError: one line that names the field.
    """
    check_stream(record.stream)
    check_id("record_id", record.record_id)
    check_id("payload_type", record.payload_type, MAX_PAYLOAD_TYPE_BYTES)
    if len(record.identity_sha256) != IDENTITY_BYTES:
        raise InvalidRequestError(
            f"identity_sha256 must have {IDENTITY_BYTES} bytes, not {len(record.identity_sha256)}"
        )
    if len(record.payload) > MAX_PAYLOAD_BYTES:
        raise InvalidRequestError(f"a payload of {len(record.payload)} bytes; at most {MAX_PAYLOAD_BYTES} are allowed")


def _is_valid(record: NewRecord) -> bool:
    try:
        check_record(record)
    except InvalidRequestError:
        return False
    return True


def row_digest(record: NewRecord, sequence: int, append_time_ns: int, references: Collection[str] | None) -> bytes:
    """SHA-256 over all fields of a stored record and its references.

    Args:
        record: the record.
        sequence: its place in its stream.
        append_time_ns: wall clock.
        references: SHA-256 of the blobs that it refers to; None for the digest of schema 4, which left them out.
    """
    return digest_of(
        record.stream,
        sequence,
        record.record_id,
        record.payload_type,
        record.payload,
        record.identity_sha256,
        append_time_ns,
        *(() if references is None else (str(len(references)), *sorted(references))),
    )


def is_intact(row: RecordRow, references: Collection[str] | None) -> bool:
    """Whether a stored record still has the digest it was stored with; ``references`` as for :func:`row_digest`."""
    record = NewRecord(row.stream, row.record_id, row.payload_type, row.payload, row.identity_sha256)
    return row_digest(record, row.sequence, row.append_time_ns, references) == row.row_sha256
