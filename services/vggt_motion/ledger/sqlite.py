"""Rows in SQLite: write-ahead log, ``synchronous=FULL``, group commit.

Changes that arrive while a commit is under way wait for it and then share the next one: the first of them carries out
all, each in its savepoint, under one fsync. A lone change pays one fsync and no change of thread.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import operator
import queue
import sqlite3
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from vggt_motion.errors import DiskFullError, LedgerError, VggtMotionError
from vggt_motion.gathering import Gathering
from vggt_motion.ledger.schema import MIGRATIONS, SCHEMA_VERSION
from vggt_motion.ledger.store import (
    META_SHA256,
    BlobEntry,
    BlobRow,
    Content,
    JobRow,
    LeaseRow,
    Place,
    Reader,
    RecordRow,
    Transaction,
    meta_digest,
    printable,
)
from vggt_motion.records import JobKind, JobState

T = TypeVar("T")

_MAX_READERS = 8
_WAL_LIMIT_BYTES = 64 * 2**20
_RECORD_NAMES = tuple(field.name for field in dataclasses.fields(RecordRow))
_RECORD_COLUMNS = ", ".join(_RECORD_NAMES)
_ADD_RECORD = f"INSERT INTO records ({_RECORD_COLUMNS}) VALUES ({', '.join('?' * len(_RECORD_NAMES))})"
_record_values = operator.attrgetter(*_RECORD_NAMES)
_OF_ONE_CHANGE = (
    sqlite3.IntegrityError,
    sqlite3.InterfaceError,
    sqlite3.DataError,
    sqlite3.ProgrammingError,
    UnicodeDecodeError,
)
_JOB_NAMES = tuple(field.name for field in dataclasses.fields(JobRow))
_JOB_COLUMNS = ", ".join(_JOB_NAMES)
_job_values = operator.attrgetter(*_JOB_NAMES)
_JOB_CONTENT = ("job_id", "submission", "kind", "model", "priority", "payload_type", "payload", "content_sha256")
_JOB_PROGRESS = tuple(name for name in _JOB_NAMES if name not in _JOB_CONTENT)
_UPDATE_JOB = f"UPDATE jobs SET {', '.join(f'{name} = ?' for name in _JOB_PROGRESS)} WHERE job_id = ?"
_KIND, _STATE = _JOB_NAMES.index("kind"), _JOB_NAMES.index("state")
_NOT_AMONG_ROWS = "is_file <> 0"  # in a file of its own, or in a pack
_LEASE_COLUMNS = ", ".join(field.name for field in dataclasses.fields(LeaseRow))
_BLOB_COLUMNS = ", ".join(field.name for field in dataclasses.fields(BlobRow))
_STORAGE: Mapping[str, type] = {"str": str, "JobState": str, "int": int, "float": float, "bytes": bytes}
_TYPES: Mapping[type[Any], tuple[type, ...]] = {
    cls: tuple(_STORAGE[str(field.type)] for field in dataclasses.fields(cls))
    for cls in (RecordRow, JobRow, LeaseRow, BlobRow, BlobEntry)
}


class _Statements:
    """The statements of :class:`.store.Transaction`, on one connection."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection

    def find_record(self, stream: str, record_id: str) -> RecordRow | None:
        row = self._one(f"SELECT {_RECORD_COLUMNS} FROM records WHERE stream = ? AND record_id = ?", stream, record_id)
        return None if row is None else _row(RecordRow, row)

    def records(self, stream: str, from_sequence: int, limit: int) -> Sequence[RecordRow]:
        statement = (
            f"SELECT {_RECORD_COLUMNS} FROM records WHERE stream = ? AND sequence >= ? ORDER BY sequence LIMIT ?"
        )
        rows = [_row(RecordRow, row) for row in self._all(statement, stream, from_sequence, limit)]
        # Readers go on behind the last one: where an index says what the table does not, they would for ever.
        if any(row.sequence < least for least, row in enumerate(rows, from_sequence)):
            raise LedgerError(f"damaged rows: {stream} records out of order: run a check")
        return rows

    def positions(self) -> Mapping[str, int]:
        rows = self._all("SELECT stream, next_sequence FROM streams ORDER BY stream")
        return {_value(str, stream): _value(int, next_sequence) for stream, next_sequence in rows}

    def record_streams(self) -> Sequence[str]:
        return self._names("SELECT DISTINCT CAST(stream AS BLOB) FROM records ORDER BY 1")

    def sequences(self, stream: str) -> Sequence[int]:
        statement = "SELECT COALESCE(CAST(sequence AS BIGINT), -1) FROM records WHERE stream = ? ORDER BY 1"
        return [sequence for (sequence,) in self._all(statement, stream)]

    def find_blob(self, sha256: str) -> BlobEntry | None:
        row = self._one("SELECT sha256, size_bytes FROM blobs WHERE sha256 = ?", sha256)
        return None if row is None else _row(BlobEntry, row)

    def record_blobs(self, stream: str, sequence: int) -> Sequence[BlobEntry]:
        statement = """SELECT blobs.sha256, size_bytes
            FROM record_blobs JOIN blobs ON blobs.sha256 = record_blobs.sha256
            WHERE stream = ? AND sequence = ? ORDER BY blobs.sha256"""
        return [_row(BlobEntry, row) for row in self._all(statement, stream, sequence)]

    def references(self, stream: str, sequence: int) -> Sequence[str]:
        statement = "SELECT sha256 FROM record_blobs WHERE stream = ? AND sequence = ? ORDER BY sha256"
        return [_value(str, sha256) for (sha256,) in self._all(statement, stream, sequence)]

    def find_blob_row(self, sha256: str) -> BlobRow | None:
        row = self._one(f"SELECT {_BLOB_COLUMNS} FROM blobs WHERE sha256 = ?", sha256)
        return None if row is None else _row(BlobRow, row)

    def blob_bytes(self) -> int:
        statement = f"SELECT CAST(COALESCE(SUM(size_bytes), 0) AS BIGINT) FROM blobs WHERE {_NOT_AMONG_ROWS}"
        return int(self._value(statement))

    def blobs(self) -> Iterable[tuple[BlobEntry, Place | None]]:
        statement = f"SELECT {_BLOB_COLUMNS} FROM blobs WHERE {_NOT_AMONG_ROWS} ORDER BY sha256"
        for row in self._connection.execute(statement):
            blob = _row(BlobRow, row)
            yield BlobEntry(blob.sha256, blob.size_bytes), blob.place

    def find_place(self, sha256: str) -> Place | None:
        row = self.find_blob_row(sha256)
        return None if row is None else row.place

    def find_content(self, sha256: str) -> bytes | None:
        row = self._one("SELECT content FROM contents WHERE sha256 = ?", sha256)
        return None if row is None else _value(bytes, row[0])

    def has_content(self, sha256: str, size_bytes: int) -> bool:
        row = self._one("SELECT LENGTH(content) FROM contents WHERE sha256 = ?", sha256)
        return row is not None and row[0] == size_bytes

    def contents(self) -> Iterable[tuple[str, bytes]]:
        for sha256, content in self._connection.execute("SELECT sha256, content FROM contents ORDER BY sha256"):
            yield _value(str, sha256), _value(bytes, content)

    def find_meta(self, key: str) -> str | None:
        row = self._one("SELECT value FROM meta WHERE key = ?", key)
        return None if row is None else _value(str, row[0])

    def meta(self) -> Mapping[str, str]:
        return {_value(str, key): _value(str, value) for key, value in self._all("SELECT key, value FROM meta")}

    def find_job(self, job_id: str) -> JobRow | None:
        return self._job(f"SELECT {_JOB_COLUMNS} FROM jobs WHERE job_id = ?", job_id)

    def find_job_anew(self, job_id: str) -> JobRow | None:
        row = self._one(f"SELECT {', '.join(_JOB_CONTENT)}, state FROM jobs WHERE job_id = ?", job_id)
        if row is None:
            return None
        *content, digest, state = row
        job = dataclasses.replace(JobRow(*content), content_sha256=digest)
        if state in (JobState.DONE, JobState.DEAD, JobState.CANCELLED):
            job = dataclasses.replace(job, state=JobState(state))
        return _job(_values(job))

    def next_open_job(self, kinds: Collection[str], models: Collection[str], now_s: float) -> JobRow | None:
        where, values = _offered(kinds, models)
        order = "ORDER BY priority, submission LIMIT 1"
        return self._job(f"SELECT {_JOB_COLUMNS} FROM jobs WHERE {where} AND not_before_s <= ? {order}", *values, now_s)

    def next_wake_s(self, kinds: Collection[str], models: Collection[str], now_s: float) -> float | None:
        where, values = _offered(kinds, models)
        value = self._value(f"SELECT MIN(not_before_s) FROM jobs WHERE {where} AND not_before_s > ?", *values, now_s)
        return None if value is None else _value(float, value)

    def leased_jobs(self, worker: str | None = None, deadline_before_s: float | None = None) -> Sequence[JobRow]:
        statement = f"SELECT {_JOB_COLUMNS} FROM jobs WHERE state = ?"
        values: list[Any] = [JobState.LEASED.value]
        if worker is not None:
            statement += " AND worker = ?"
            values.append(worker)
        if deadline_before_s is not None:
            statement += " AND deadline_s < ?"
            values.append(deadline_before_s)
        return [_job(row) for row in self._all(statement + " ORDER BY submission", *values)]

    def find_lease(self, lease_id: str) -> LeaseRow | None:
        row = self._one(f"SELECT {_LEASE_COLUMNS} FROM leases WHERE lease_id = ?", lease_id)
        return None if row is None else _row(LeaseRow, row)

    def find_claim(self, worker: str, claim_id: str) -> LeaseRow | None:
        row = self._one(
            f"""SELECT {", ".join("leases." + name for name in _LEASE_COLUMNS.split(", "))}
            FROM leases JOIN jobs ON jobs.lease_id = leases.lease_id WHERE leases.worker = ? AND leases.claim_id = ?""",
            worker,
            claim_id,
        )
        return None if row is None else _row(LeaseRow, row)

    def job_counts(self) -> Mapping[tuple[str, str], int]:
        rows = self._all("SELECT kind, state, COUNT(*) FROM jobs GROUP BY kind, state ORDER BY kind, state")
        return {(_value(str, kind), _value(str, state)): count for kind, state, count in rows}

    def jobs(self, state: str | None, after_job_id: str, limit: int) -> Sequence[JobRow]:
        statement = f"SELECT {_JOB_COLUMNS} FROM jobs WHERE job_id > ?"
        values: list[Any] = [after_job_id]
        if state is not None:
            statement += " AND state = ?"
            values.append(state)
        jobs = [_job(row) for row in self._all(statement + " ORDER BY job_id LIMIT ?", *values, limit)]
        if any(job.job_id <= after_job_id for job in jobs):
            raise LedgerError("damaged rows: jobs out of order: run a check")
        return jobs

    def job_ids(self) -> Sequence[str]:
        return self._names("SELECT CAST(job_id AS BLOB) FROM jobs ORDER BY job_id")

    def lease_ids(self) -> Sequence[str]:
        return self._names("SELECT CAST(lease_id AS BLOB) FROM leases ORDER BY lease_id")

    def next_sequence(self, stream: str) -> int:
        statement = """INSERT INTO streams (stream, next_sequence) VALUES (?, 1)
            ON CONFLICT (stream) DO UPDATE SET next_sequence = streams.next_sequence + 1 RETURNING next_sequence"""
        ((next_sequence,),) = self._all(statement, stream)
        return _value(int, next_sequence) - 1

    def add_record(self, row: RecordRow) -> None:
        self._run(_ADD_RECORD, *_record_values(row))

    def add_reference(self, stream: str, sequence: int, sha256: str) -> None:
        self._run("INSERT INTO record_blobs (stream, sequence, sha256) VALUES (?, ?, ?)", stream, sequence, sha256)

    def set_references(self, stream: str, sequence: int, entries: Collection[BlobEntry]) -> None:
        self._run("DELETE FROM record_blobs WHERE stream = ? AND sequence = ?", stream, sequence)
        for entry in entries:
            self.add_blob(entry)
            self.add_reference(stream, sequence, entry.sha256)

    def set_blob(self, row: BlobRow) -> None:
        self._run(
            f"""INSERT INTO blobs ({_BLOB_COLUMNS}) VALUES (?, ?, ?, ?, ?)
            ON CONFLICT (sha256) DO UPDATE SET size_bytes = excluded.size_bytes, is_file = excluded.is_file,
            pack = excluded.pack, offset_bytes = excluded.offset_bytes""",
            *dataclasses.astuple(row),
        )

    def remove_strays(self) -> int:
        references = self._run(
            """DELETE FROM record_blobs WHERE NOT EXISTS (SELECT 1 FROM records
            WHERE records.stream = record_blobs.stream AND records.sequence = record_blobs.sequence)"""
        )
        blobs = self._run("DELETE FROM blobs WHERE sha256 NOT IN (SELECT sha256 FROM record_blobs)")
        return references + blobs + self._run("DELETE FROM contents WHERE sha256 NOT IN (SELECT sha256 FROM blobs)")

    def add_blob(self, entry: BlobEntry) -> None:
        self._run(
            "INSERT INTO blobs (sha256, size_bytes) VALUES (?, ?) ON CONFLICT (sha256) DO NOTHING",
            entry.sha256,
            entry.size_bytes,
        )

    def set_place(self, entry: BlobEntry, place: Place) -> None:
        added = self._run(
            """INSERT INTO blobs (sha256, size_bytes, pack, offset_bytes) VALUES (?, ?, ?, ?)
            ON CONFLICT (sha256) DO NOTHING""",
            entry.sha256,
            entry.size_bytes,
            place.pack,
            place.offset_bytes,
        )
        if added == 0:
            self._run("DELETE FROM contents WHERE sha256 = ?", entry.sha256)
            self._run(
                "UPDATE blobs SET is_file = 1, pack = ?, offset_bytes = ? WHERE sha256 = ?",
                place.pack,
                place.offset_bytes,
                entry.sha256,
            )

    def set_content(self, entry: BlobEntry, content: Content) -> None:
        self._run(
            """INSERT INTO contents (sha256, content) VALUES (?, ?)
            ON CONFLICT (sha256) DO UPDATE SET content = excluded.content""",
            entry.sha256,
            content,
        )
        self._run(
            """INSERT INTO blobs (sha256, size_bytes, is_file) VALUES (?, ?, 0)
            ON CONFLICT (sha256) DO UPDATE SET is_file = 0, pack = 0, offset_bytes = 0""",
            entry.sha256,
            entry.size_bytes,
        )

    def remove_content(self, sha256: str, content: bytes) -> None:
        self._run("DELETE FROM contents WHERE sha256 = ? AND content = ?", sha256, content)
        self._run(
            """UPDATE blobs SET is_file = 1
            WHERE sha256 = ? AND NOT EXISTS (SELECT 1 FROM contents WHERE contents.sha256 = blobs.sha256)""",
            sha256,
        )

    def remove_place(self, sha256: str, place: Place) -> None:
        self._run(
            "UPDATE blobs SET pack = 0, offset_bytes = 0 WHERE sha256 = ? AND pack = ? AND offset_bytes = ?",
            sha256,
            place.pack,
            place.offset_bytes,
        )

    def set_meta(self, key: str, value: str) -> None:
        statement = "INSERT INTO meta (key, value) VALUES (?, ?) ON CONFLICT (key) DO UPDATE SET value = excluded.value"
        self._run(statement, key, value)
        self._run(statement, META_SHA256, meta_digest(self.meta()))

    def add_job(self, row: JobRow) -> None:
        submission = _value(int, self._value("SELECT COALESCE(MAX(submission) + 1, 0) FROM jobs"))
        row = dataclasses.replace(row, submission=submission)
        row = dataclasses.replace(row, content_sha256=row.content_digest(), progress_sha256=row.progress_digest())
        values = _values(row)
        self._run(f"INSERT INTO jobs ({_JOB_COLUMNS}) VALUES ({_marks(values)})", *values)

    def update_job(self, row: JobRow) -> None:
        row = dataclasses.replace(row, progress_sha256=row.progress_digest())
        values = [str(value) if isinstance(value := getattr(row, name), JobState) else value for name in _JOB_PROGRESS]
        self._run(_UPDATE_JOB, *values, row.job_id)

    def shift_deadlines(self, seconds: float) -> None:
        for job in self.leased_jobs():
            self.update_job(dataclasses.replace(job, deadline_s=job.deadline_s + seconds))

    def reset_times(self) -> None:
        for row in self._all(f"SELECT {_JOB_COLUMNS} FROM jobs WHERE not_before_s <> 0"):
            self.update_job(dataclasses.replace(_job(row), not_before_s=0.0))

    def add_lease(self, row: LeaseRow) -> None:
        values = dataclasses.astuple(dataclasses.replace(row, row_sha256=row.digest()))
        self._run(f"INSERT INTO leases ({_LEASE_COLUMNS}) VALUES ({_marks(values)})", *values)

    def remove_lease(self, lease_id: str) -> bool:
        return self._run("DELETE FROM leases WHERE lease_id = ?", lease_id) > 0

    def _run(self, statement: str, *values: Any) -> int:
        """Carry out a statement; returns the number of rows that it changed."""
        return self._connection.execute(statement, values).rowcount

    def _all(self, statement: str, *values: Any) -> list[tuple[Any, ...]]:
        return self._connection.execute(statement, values).fetchall()

    def _one(self, statement: str, *values: Any) -> tuple[Any, ...] | None:
        row: tuple[Any, ...] | None = self._connection.execute(statement, values).fetchone()
        return row

    def _value(self, statement: str, *values: Any) -> Any:
        row = self._one(statement, *values)
        return None if row is None else row[0]

    def _names(self, statement: str) -> list[str]:
        """Names that were asked for as bytes: what is no text any more is still a row."""
        return [(name or b"").decode(errors="replace") for (name,) in self._all(statement)]

    def _job(self, statement: str, *values: Any) -> JobRow | None:
        row = self._one(statement, *values)
        return None if row is None else _job(row)


def _row(cls: type[T], values: tuple[Any, ...]) -> T:
    _check_types(cls, values)
    return cls(*values)


def _check_types(cls: type[Any], values: tuple[Any, ...]) -> None:
    if tuple(map(type, values)) != _TYPES[cls]:
        raise LedgerError(f"a damaged row, no {cls.__name__}: run a check")


def _value(cls: type[T], value: Any) -> T:
    if type(value) is not cls:
        raise LedgerError(f"a damaged row, with {type(value).__name__} in place of {cls.__name__}: run a check")
    return value


def _job(values: tuple[Any, ...]) -> JobRow:
    _check_types(JobRow, values)
    try:
        JobKind(values[_KIND])
        known = [*values[:_STATE], JobState(values[_STATE]), *values[_STATE + 1 :]]
    except ValueError as error:
        raise LedgerError(f"the row of job '{values[0]}' is damaged: {error}; run a check") from None
    return JobRow(*known)


def _values(row: JobRow) -> tuple[Any, ...]:
    return tuple(str(value) if isinstance(value, JobState) else value for value in _job_values(row))


def _marks(values: Sequence[Any]) -> str:
    return ", ".join("?" * len(values))


def _offered(kinds: Collection[str], models: Collection[str]) -> tuple[str, list[Any]]:
    offered_models = sorted({"", *models})
    where = f"state = ? AND kind IN ({_marks(sorted(kinds))}) AND model IN ({_marks(offered_models)})"
    return where, [JobState.OPEN.value, *sorted(kinds), *offered_models]


_Changes: TypeAlias = Sequence[Callable[[Transaction], Any]]


class SqliteRows:
    """Rows in one SQLite file; safe for use from many threads. Implements :class:`.store.Rows`."""

    def __init__(self, path: Path) -> None:
        """Open or create the database and bring it to the present schema.

        Raises:
            LedgerError: not a database of ours, of a newer schema, damaged, or not writable.
        """
        self._path = path
        self._commits: Gathering[_Changes, list[Any]] = Gathering(self._commit)
        self._failure: str | None = None
        self._readers: queue.LifoQueue[sqlite3.Connection | None] = queue.LifoQueue()
        for _ in range(_MAX_READERS):
            self._readers.put(None)
        with _errors_of(path):
            self._writer = connect(path)
            try:
                self._writer.execute(f"PRAGMA journal_size_limit = {_WAL_LIMIT_BYTES}")
                self._writer.execute("PRAGMA foreign_keys = ON")
                _migrate(self._writer, path)
            except BaseException:
                self._writer.close()
                raise
        self._statements = _Statements(self._writer)

    def write(self, change: Callable[[Transaction], T]) -> T:
        """Carry out one change atomically; see :meth:`.store.Rows.write`."""
        (outcome,) = self.write_all([change])
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    def write_all(self, changes: Sequence[Callable[[Transaction], T]]) -> list[T | Exception]:
        """Carry out several changes, each atomically, under one fsync; see :meth:`.store.Rows.write_all`."""
        return self._commits(changes)

    def read(self, query: Callable[[Reader], T]) -> T:
        """Ask for committed rows; see :meth:`.store.Rows.read`."""
        connection = self._readers.get()
        try:
            if self._failure is not None:
                raise LedgerError(self._failure)
            with _errors_of(self._path):
                if connection is None:
                    connection = connect(self._path)
                    connection.execute("PRAGMA query_only = ON")
                # One snapshot for all statements of the query.
                connection.execute("BEGIN")
                try:
                    return query(_Statements(connection))
                finally:
                    connection.execute("COMMIT")
        finally:
            self._readers.put(connection)

    def size_bytes(self) -> int:
        """Bytes of the database file and its write-ahead log."""
        return database_bytes(self._path)

    def close(self) -> None:
        """Finish the present commit, fold the write-ahead log into the database and close it."""
        if self._failure is None:
            self._failure = f"{self._path} is closed"  # for those that come from now on
        self._commits.wait_until_idle()
        for _ in range(_MAX_READERS):
            connection = self._readers.get()
            if connection is not None:
                connection.close()
        for _ in range(_MAX_READERS):
            self._readers.put(None)
        self._writer.close()

    def _commit(self, batch: Sequence[_Changes]) -> Sequence[list[Any]]:
        try:
            if self._failure is not None:
                raise LedgerError(self._failure)
            with _errors_of(self._path):
                self._writer.execute("BEGIN IMMEDIATE")
                if len(batch) == 1 and len(batch[0]) == 1:
                    return [[self._run_alone(batch[0][0])]]
                outcomes = [[self._run_among_others(change) for change in changes] for changes in batch]
                self._writer.execute("COMMIT")
                return outcomes
        except BaseException as error:
            if self._failure is None and _is_storage_failure(error.__cause__):
                # After a failed write the state of the file is not known until it is opened and recovered again.
                self._failure = f"{error}; the ledger has to be opened again"
            with contextlib.suppress(sqlite3.Error):
                if self._writer.in_transaction:
                    self._writer.execute("ROLLBACK")
            raise

    def _run_alone(self, change: Callable[[Transaction], T]) -> T | Exception:
        """One change is the whole transaction."""
        outcome = self._outcome(change)
        self._writer.execute("ROLLBACK" if isinstance(outcome, Exception) else "COMMIT")
        return outcome

    def _run_among_others(self, change: Callable[[Transaction], T]) -> T | Exception:
        """Each change may be undone without the others."""
        self._writer.execute("SAVEPOINT change")
        outcome = self._outcome(change)
        if isinstance(outcome, Exception):
            self._writer.execute("ROLLBACK TO change")
        self._writer.execute("RELEASE change")
        return outcome

    def _outcome(self, change: Callable[[Transaction], T]) -> T | Exception:
        try:
            return change(self._statements)
        except _OF_ONE_CHANGE as error:
            return LedgerError(f"{self._path}: {printable(str(error))}")
        except sqlite3.Error:
            # Full or failing storage may have ended the whole transaction: nobody in it is acknowledged.
            raise
        except Exception as error:
            return error


def connect(path: Path, *, is_read_only: bool = False) -> sqlite3.Connection:
    """A connection with explicit transactions; whoever uses it from several threads keeps them apart."""
    uri = f"{path.resolve().as_uri()}?mode={'ro' if is_read_only else 'rwc'}"
    connection = sqlite3.connect(uri, uri=True, timeout=10.0, isolation_level=None, check_same_thread=False)
    try:
        if not is_read_only:
            (mode,) = connection.execute("PRAGMA journal_mode = WAL").fetchone()
            if mode != "wal":
                raise LedgerError(f"{path}: this file system does not allow a write-ahead log")
            connection.execute("PRAGMA synchronous = FULL")
    except BaseException:
        connection.close()
        raise
    return connection


@contextlib.contextmanager
def read_only(path: Path) -> Iterator[Reader]:
    """Committed rows of a database that another process may be serving; an older one is brought up to date first.

    Raises:
        LedgerError: no database of ours, or damaged.
    """
    with _errors_of(path):
        if not path.is_file():
            raise LedgerError(f"{path.parent} holds no ledger")
        with contextlib.closing(connect(path, is_read_only=True)) as connection:
            version = _version(connection)
            _check_version(version, path)
            if version < SCHEMA_VERSION:
                with contextlib.closing(connect(path)) as writer:
                    _migrate(writer, path)
            connection.execute("BEGIN")
            yield _Statements(connection)


def integrity_problems(path: Path) -> list[str]:
    """What SQLite itself finds wrong with the file and its indexes; empty if sound.

    Raises:
        LedgerError: so much that it cannot look.
    """
    with _errors_of(path), contextlib.closing(connect(path)) as connection:
        found = [str(row[0]) for row in connection.execute("PRAGMA integrity_check(100)")]
    return [line for line in found if line != "ok"]


def schema_problems(path: Path) -> list[str]:
    """Tables and indexes that are not there, or not as they were made, one line each.

    Raises:
        LedgerError: so much that it cannot look.
    """
    statement = "SELECT type, name, tbl_name, sql FROM sqlite_master"
    with (
        _errors_of(path),
        contextlib.closing(connect(path, is_read_only=True)) as connection,
        contextlib.closing(sqlite3.connect(":memory:")) as model,
    ):
        for change in itertools.chain.from_iterable(MIGRATIONS):
            model.execute(change)
        missing = set(model.execute(statement)) - set(connection.execute(statement))
    return sorted(f"{kind} {name} is not as it was made" for kind, name, *_ in missing)


def dangling_references(path: Path) -> list[str]:
    """Rows that refer to others that are not there, one line each.

    Raises:
        LedgerError: the tables themselves are damaged.
    """
    with _errors_of(path), contextlib.closing(connect(path)) as connection:
        found = connection.execute("PRAGMA foreign_key_check").fetchall()
    return [f"{table} row {row}: no such row in {parent}" for table, row, parent, _ in found]


def rebuild_indexes(path: Path) -> None:
    """Derive every index anew from its table.

    Raises:
        LedgerError: the tables themselves are damaged.
    """
    with _errors_of(path), contextlib.closing(connect(path)) as connection:
        connection.execute("REINDEX")


def copy_database(path: Path, target: Path) -> None:
    """Write a consistent copy of the database, which another process may be serving, to a new file.

    Raises:
        LedgerError: it cannot be read or written.
    """
    with (
        _errors_of(path),
        contextlib.closing(connect(path, is_read_only=True)) as source,
        contextlib.closing(sqlite3.connect(target)) as copy,
    ):
        source.backup(copy)
        # One plain file, without a write-ahead log beside it.
        copy.execute("PRAGMA journal_mode = DELETE")


def take_out_of_packs(path: Path) -> None:
    """Let a database that nobody serves say that every blob has a file of its own."""
    with _errors_of(path), contextlib.closing(connect(path)) as connection:
        connection.execute("UPDATE blobs SET pack = 0, offset_bytes = 0 WHERE pack <> 0")
        connection.execute("PRAGMA journal_mode = DELETE")


def database_bytes(path: Path) -> int:
    """Bytes of a database file and its write-ahead log."""
    total = 0
    for file in (path, path.with_name(path.name + "-wal")):
        with contextlib.suppress(FileNotFoundError):
            total += file.stat().st_size
    return total


def _version(connection: sqlite3.Connection) -> int:
    tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if not tables:
        return 0
    if "meta" in tables:
        row = connection.execute("SELECT value FROM meta WHERE key = 'schema_version'").fetchone()
        if row is not None and str(row[0]).isdecimal():
            return int(row[0])
    raise LedgerError("a database, but not one of a ledger")


def _check_version(version: int, path: Path) -> None:
    if version > SCHEMA_VERSION:
        raise LedgerError(
            f"{path} was written by a newer version: its schema is {version}, this one knows up to {SCHEMA_VERSION}"
        )


def _migrate(connection: sqlite3.Connection, path: Path) -> None:
    connection.execute("BEGIN IMMEDIATE")
    version = _version(connection)
    _check_version(version, path)
    # One transaction for all steps: an interrupted migration has not begun.
    for step in MIGRATIONS[version:]:
        for statement in step:
            connection.execute(statement)
    if version < SCHEMA_VERSION:
        _Statements(connection).set_meta("schema_version", str(SCHEMA_VERSION))
    connection.execute("COMMIT")


def _is_storage_failure(error: BaseException | None) -> bool:
    code = getattr(error, "sqlite_errorcode", 0) or 0
    return code & 0xFF in (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_READONLY)


@contextlib.contextmanager
def _errors_of(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into ours."""
    try:
        yield
    except VggtMotionError:
        raise
    except UnicodeDecodeError as error:  # SQLite's message quotes what is no text any more
        raise LedgerError(f"{path} is damaged: {error}") from error
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", None)
        if code is not None and code & 0xFF == sqlite3.SQLITE_FULL:
            raise DiskFullError(f"no space for the rows of {path}") from error
        raise LedgerError(f"{path}: {printable(str(error))}") from error
