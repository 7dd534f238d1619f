"""What the ledger needs of a store: rows in atomic transactions, and blobs addressed by their content.

The interfaces are small on purpose, so that PostgreSQL and an object store can stand behind them for servers with
many vehicles, while SQLite (:mod:`.sqlite`) and files (:mod:`.blobs`, :mod:`.packs`) stay the embedded default.
Every method of :class:`Transaction` is a plain SQL statement or two; :meth:`Transaction.next_open_job` is
``SELECT ... ORDER BY priority, submission LIMIT 1 FOR UPDATE SKIP LOCKED``.

Policy (what is idempotent, when a job is dead) lives in :mod:`.log` and :mod:`.jobs` and knows neither implementation.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Protocol, TypeAlias, TypeVar

from vggt_motion.errors import RefusalCode, RequestRefusedError
from vggt_motion.records import JobState

T = TypeVar("T")
Content: TypeAlias = bytes | memoryview
"""Of a blob; a view is into the request that it came with."""
META_SHA256: Final = "meta_sha256"
"""The fact about a session that says what all the others are, see :func:`meta_digest`."""


class InvalidRequestError(RequestRefusedError):
    """The request is malformed or out of bounds."""


class ConflictError(RequestRefusedError):
    """The id is known with another content."""

    def __init__(self, message: str) -> None:
        super().__init__(message, RefusalCode.CONFLICT)


class UnknownError(RequestRefusedError):
    """What was asked for or referred to does not exist: stream, blob, job, lease."""

    def __init__(self, message: str) -> None:
        super().__init__(message, RefusalCode.UNKNOWN)


class DamagedBlobError(UnknownError):
    """The bytes no longer have the hash they are stored under; they were set aside and may be appended again."""


@dataclass(frozen=True)
class BlobEntry:
    """One blob as the rows know it."""

    sha256: str  # 64 lower-case hexadecimal digits
    size_bytes: int


@dataclass(frozen=True)
class Place:
    """Where a small blob lies among others."""

    pack: int  # from 1
    offset_bytes: int
    size_bytes: int


@dataclass(frozen=True)
class BlobRow:
    """A blob as it is stored."""

    sha256: str
    size_bytes: int
    is_file: int  # 0: its content stands among the rows; 1: in a file of its own, or in a pack
    pack: int = 0  # from 1; 0: in none
    offset_bytes: int = 0  # in the pack

    @property
    def place(self) -> Place | None:
        """Where it lies if it is in a pack."""
        return Place(self.pack, self.offset_bytes, self.size_bytes) if self.pack else None


@dataclass(frozen=True)
class Blob:
    """Bytes with their hash, so that it is computed once on their way through the ledger."""

    entry: BlobEntry
    data: Content = field(repr=False)

    @classmethod
    def of(cls, data: Content | Blob) -> Blob:
        """Bytes, hashed if they are not yet."""
        if isinstance(data, Blob):
            return data
        return cls(BlobEntry(sha256_hex(data), len(data)), data)


@dataclass(frozen=True)
class NewRecord:
    """A record as a client hands it in; the payload is opaque."""

    stream: str
    record_id: str
    payload_type: str
    payload: bytes
    identity_sha256: bytes  # 32 bytes; two payloads are the same record if and only if these are equal


@dataclass(frozen=True)
class RecordRow:
    """A record as it is stored."""

    stream: str
    sequence: int  # dense from 0
    record_id: str
    payload_type: str
    payload: bytes
    identity_sha256: bytes
    append_time_ns: int  # wall clock, informative
    row_sha256: bytes  # over all the fields above and the blobs it refers to: what `ledger check` verifies


@dataclass(frozen=True)
class JobRow:
    """A job as it is stored. Times are seconds of the queue's own clock, valid until the ledger is opened anew."""

    job_id: str
    submission: int  # order of submission, dense from 0
    kind: str
    model: str
    priority: int
    payload_type: str
    payload: bytes
    state: JobState = JobState.OPEN
    attempt: int = 0  # leases handed out so far
    failure_count: int = 0
    lost_lease_count: int = 0
    lease_id: str = ""  # of the present lease; empty unless leased
    worker: str = ""  # of the present or last lease
    deadline_s: float = 0.0  # of the present lease
    not_before_s: float = 0.0  # back-off after a failure
    last_reason: str = ""
    last_traceback: str = ""
    content_sha256: str = ""  # the store keeps both; empty: not written since schema 4
    progress_sha256: str = ""

    def content_digest(self) -> str:
        """SHA-256 over what never changes."""
        content = (self.job_id, self.submission, self.kind, self.model, self.priority, self.payload_type, self.payload)
        return digest_of(*content).hex()

    def progress_digest(self) -> str:
        """SHA-256 over the rest."""
        counts = (self.attempt, self.failure_count, self.lost_lease_count)
        times = (self.deadline_s, self.not_before_s)
        texts = (self.lease_id, self.worker, self.last_reason, self.last_traceback)
        return digest_of(self.job_id, self.state, *counts, *times, *texts).hex()


@dataclass(frozen=True)
class LeaseRow:
    """A lease that was ever handed out; kept so that a late result can be recognised."""

    lease_id: str
    job_id: str
    worker: str
    claim_id: str
    attempt: int
    row_sha256: str = ""  # the store keeps it; empty: of schema 4 or older

    def digest(self) -> str:
        """SHA-256 over all the fields but this one."""
        return digest_of(self.lease_id, self.job_id, self.worker, self.claim_id, self.attempt).hex()


class Reader(Protocol):
    """Committed rows. Every question raises LedgerError when a row that answers it is damaged so that it shows."""

    def find_record(self, stream: str, record_id: str) -> RecordRow | None:
        """The record with this id."""

    def records(self, stream: str, from_sequence: int, limit: int) -> Sequence[RecordRow]:
        """Up to ``limit`` records in order of sequence."""

    def positions(self) -> Mapping[str, int]:
        """Next sequence number of every stream that has records."""

    def record_streams(self) -> Sequence[str]:
        """The streams that the records themselves name."""

    def sequences(self, stream: str) -> Sequence[int]:
        """The sequence numbers of all records of a stream, in order."""

    def find_blob(self, sha256: str) -> BlobEntry | None:
        """The blob, if a record refers to it."""

    def record_blobs(self, stream: str, sequence: int) -> Sequence[BlobEntry]:
        """The blobs that a record refers to."""

    def references(self, stream: str, sequence: int) -> Sequence[str]:
        """SHA-256 of the blobs that a record refers to, in order, whether there are such blobs or not."""

    def find_blob_row(self, sha256: str) -> BlobRow | None:
        """All that is stored of a blob."""

    def blob_bytes(self) -> int:
        """Sum of the sizes of the blobs whose content is not among the rows."""

    def blobs(self) -> Iterable[tuple[BlobEntry, Place | None]]:
        """The blobs whose content is not among the rows, in order of their hash, as long as the query lasts."""

    def find_place(self, sha256: str) -> Place | None:
        """Where the blob lies if it is in a pack."""

    def find_content(self, sha256: str) -> bytes | None:
        """The content of a blob that is kept among the rows; not verified."""

    def has_content(self, sha256: str, size_bytes: int) -> bool:
        """Whether it is there with this size."""

    def contents(self) -> Iterable[tuple[str, bytes]]:
        """All contents among the rows with the hashes they are kept under, as long as the query lasts."""

    def find_meta(self, key: str) -> str | None:
        """A fact about the session."""

    def meta(self) -> Mapping[str, str]:
        """All facts about the session."""

    def find_job(self, job_id: str) -> JobRow | None:
        """The job with this id."""

    def find_job_anew(self, job_id: str) -> JobRow | None:
        """The job with this id as if it had not begun, whatever is damaged of how far it has come; ended if it is."""

    def next_open_job(self, kinds: Collection[str], models: Collection[str], now_s: float) -> JobRow | None:
        """The first open job by (priority, submission) that fits an offer and whose back-off is over.

        It fits if its kind is offered and its model is offered or empty. Inside a transaction it is locked against
        other claims.
        """

    def next_wake_s(self, kinds: Collection[str], models: Collection[str], now_s: float) -> float | None:
        """When the earliest back-off after ``now_s`` of a matching open job ends."""

    def leased_jobs(self, worker: str | None = None, deadline_before_s: float | None = None) -> Sequence[JobRow]:
        """Leased jobs in order of submission, of one worker or with a deadline that is over."""

    def find_lease(self, lease_id: str) -> LeaseRow | None:
        """A lease that was ever handed out."""

    def find_claim(self, worker: str, claim_id: str) -> LeaseRow | None:
        """The lease that was handed out for a claim, if its job still has it."""

    def job_counts(self) -> Mapping[tuple[str, str], int]:
        """Number of jobs per (kind, state)."""

    def jobs(self, state: str | None, after_job_id: str, limit: int) -> Sequence[JobRow]:
        """Jobs in order of id."""

    def job_ids(self) -> Sequence[str]:
        """The ids of all jobs, in order; of a damaged one as much as can be read."""

    def lease_ids(self) -> Sequence[str]:
        """The ids of all leases, in order; of a damaged one as much as can be read."""


class Transaction(Reader, Protocol):
    """One atomic change; reads see its own writes."""

    def next_sequence(self, stream: str) -> int:
        """The next sequence number of a stream, taken: it is used up if and only if the change commits."""

    def add_record(self, row: RecordRow) -> None:
        """Insert a record."""

    def add_reference(self, stream: str, sequence: int, sha256: str) -> None:
        """Say that a record refers to a blob; both are there."""

    def set_references(self, stream: str, sequence: int, entries: Collection[BlobEntry]) -> None:
        """Say that a record refers to these blobs and no others; those that are not known become so."""

    def set_blob(self, row: BlobRow) -> None:
        """Insert a blob, or replace all that is stored of it but its content."""

    def remove_strays(self) -> int:
        """Forget references of no record, blobs that no record refers to, and contents of no blob; returns how many."""

    def add_blob(self, entry: BlobEntry) -> None:
        """Insert a blob whose content is durable, unless it is known."""

    def set_place(self, entry: BlobEntry, place: Place) -> None:
        """Insert a blob that lies in a pack, or say where it lies now."""

    def set_content(self, entry: BlobEntry, content: Content) -> None:
        """Insert a blob with its content, or replace that."""

    def remove_content(self, sha256: str, content: bytes) -> None:
        """Forget the content of a blob among the rows, if it still is this one."""

    def remove_place(self, sha256: str, place: Place) -> None:
        """Forget where a blob lies, if that still is its place."""

    def set_meta(self, key: str, value: str) -> None:
        """Insert or replace a fact about the session, and what says what all of them are."""

    def add_job(self, row: JobRow) -> None:
        """Insert a job; its ``submission`` is replaced by the next one."""

    def update_job(self, row: JobRow) -> None:
        """Replace everything of a job but its content."""

    def shift_deadlines(self, seconds: float) -> None:
        """Move the deadline of every leased job."""

    def reset_times(self) -> None:
        """End every back-off: the clock that it was measured with is gone."""

    def add_lease(self, row: LeaseRow) -> None:
        """Insert a lease."""

    def remove_lease(self, lease_id: str) -> bool:
        """Forget that a lease was handed out; False: it is not known."""


class Rows(Protocol):
    """Durable rows."""

    def write(self, change: Callable[[Transaction], T]) -> T:
        """Carry out one change atomically; durable on return. An exception of ``change`` undoes it and is passed on.

        Changes of several threads may be committed together, and a change may be run again when it could not be
        serialised: it must not have effects of its own, but for contents in packs, to which nobody refers then.

        Raises:
            DiskFullError: there is no space; nothing was changed.
            LedgerError: the store failed; it has to be opened anew.
        """

    def write_all(self, changes: Sequence[Callable[[Transaction], T]]) -> list[T | Exception]:
        """As :meth:`write`, of several changes that may share a commit; each is undone alone.

        Returns:
            For each change, in order, what it returned or what it raised.

        Raises:
            DiskFullError: there is no space; nothing was changed.
            LedgerError: the store failed; it has to be opened anew.
        """

    def read(self, query: Callable[[Reader], T]) -> T:
        """Ask for committed rows."""

    def size_bytes(self) -> int:
        """Bytes that the rows take on disk."""

    def close(self) -> None:
        """Release everything; later calls raise LedgerError."""


class Blobs(Protocol):
    """Durable bytes, addressed by their SHA-256: those that are too large to stand among the rows."""

    def put(self, blobs: Sequence[Content | Blob], *, keep_free_bytes: int) -> list[BlobEntry]:
        """Make blobs durable, in order; durable on return. Known ones are not stored twice.

        Raises:
            DiskFullError: less than ``keep_free_bytes`` are free, or less than the blobs need.
        """

    def get(self, sha256: str) -> bytes:
        """The bytes, verified.

        Raises:
            UnknownError: there is no such blob.
            DamagedBlobError: its bytes are not what they were.
        """

    def has(self, sha256: str, size_bytes: int) -> bool:
        """Whether the blob is there with this size; its content is verified on :meth:`get`."""

    def free_bytes(self) -> int:
        """Space left for more."""

    def keep_damaged(self, sha256: str, data: bytes) -> bool:
        """Keep a content that is not what it was where a person can look at it; False: it cannot be written."""


class Writing(NamedTuple):
    """Contents on their way to the disk."""

    places: tuple[Place, ...]  # to which nothing that lasts may refer before they have been waited for
    wait: Callable[[], None]
    """Returns when they are durable; DiskFullError, each time it is called: there is no space, nothing was kept."""


class Packs(Protocol):
    """Durable bytes at places that the rows know: those that are too small for a file and too much for the rows."""

    def begin(self, contents: Sequence[Content]) -> Writing:
        """Make contents durable, in order, under one sync: they are when they have been waited for."""

    def read(self, place: Place) -> bytes:
        """What lies at a place; not verified."""

    def has(self, place: Place) -> bool:
        """Whether something of this length lies there."""


def sha256_hex(data: Content) -> str:
    """SHA-256 as 64 lower-case hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def digest_of(*values: str | float | Content) -> bytes:
    """SHA-256 over values, each with its length before it."""
    digest = hashlib.sha256()
    for value in values:
        part = str(value).encode() if isinstance(value, (str, int, float)) else value
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.digest()


def meta_digest(facts: Mapping[str, str]) -> str:
    """SHA-256 over all facts about a session but the one that holds it."""
    return digest_of(*(text for key in sorted(facts) if key != META_SHA256 for text in (key, facts[key]))).hex()


def printable(text: str) -> str:
    """Foreign text as one line that a terminal can show."""
    return "".join(character if character.isprintable() else "?" for character in " ".join(text.split()))


def reserve_line(free_bytes: int, keep_free_bytes: int) -> str:
    """Why something is refused, for a person."""
    return f"the ledger's disk has {free_bytes / 2**20:.0f} MiB left and keeps {keep_free_bytes / 2**20:.0f} MiB free"
