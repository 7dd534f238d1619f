"""``vggt-motion ledger check DIR``: verify every row and blob, and repair what an interrupted write left behind.

What was damaged may say anything: nothing read here is believed because it can be read. Records, jobs and leases have
digests; which blobs there are, and where, is compared with what the records say of themselves and with the contents.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from vggt_motion.errors import CodecError, LedgerError, VggtMotionError
from vggt_motion.ledger.admission import referenced_blobs
from vggt_motion.ledger.blobs import BlobFiles
from vggt_motion.ledger.directory import BLOBS_NAME, DATABASE_NAME, PACKS_NAME, locked
from vggt_motion.ledger.log import is_intact, set_content_aside
from vggt_motion.ledger.packs import PackFiles
from vggt_motion.ledger.sqlite import (
    SqliteRows,
    dangling_references,
    integrity_problems,
    rebuild_indexes,
    schema_problems,
)
from vggt_motion.ledger.store import (
    META_SHA256,
    BlobRow,
    JobRow,
    LeaseRow,
    Place,
    Reader,
    RecordRow,
    Rows,
    Transaction,
    UnknownError,
    meta_digest,
    printable,
    sha256_hex,
)
from vggt_motion.records import JobState

_MAX_LISTED = 100
_MOST_SET_ASIDE_BYTES = 256 * 2**20
_LOG_NAME = f"{DATABASE_NAME}-wal"


@dataclass(frozen=True)
class CheckReport:
    """What a check found."""

    directory: Path
    record_counts: dict[str, int]
    job_count: int
    blob_count: int
    stored_bytes: int
    repaired: tuple[str, ...]  # one line each; with ``repair=False`` what would be repaired
    problems: tuple[str, ...]  # what cannot be repaired here, one line each

    @property
    def is_sound(self) -> bool:
        """Whether every acknowledged record and blob is there and whole."""
        return not self.problems

    def to_text(self) -> str:
        """The report for a person, one finding a line."""
        counts = sorted(self.record_counts.items())
        records = ", ".join(f"{count} {printable(stream)}" for stream, count in counts) or "none"
        lines = [
            f"{self.directory}: {'sound' if self.is_sound else 'DAMAGED'}",
            f"records: {records}; {self.job_count} jobs; {self.blob_count} payloads; {self.stored_bytes} bytes",
            *(f"repaired: {line}" for line in self.repaired),
            *(f"problem: {line}" for line in self.problems),
        ]
        return "\n".join(lines) + "\n"


def check(directory: Path, *, repair: bool = True) -> CheckReport:
    """Verify a session that nobody serves.

    Repaired are: a write-ahead log that was cut off (SQLite drops what was not committed), files of unfinished or never
    acknowledged writes, indexes, which blobs a sound record refers to and where they lie, leases, and how far a job has
    come. A damaged blob is set aside, so that the source of it may append it again; other damaged rows cannot be
    repaired. While anything is damaged nothing is removed: some record may refer to it.

    Args:
        directory: of the session.
        repair: False to change nothing on disk: then a copy of the rows is repaired, among temporary files.

    Raises:
        LedgerError: no session, in use by another process, or no space for the copy.
    """
    if not (directory / DATABASE_NAME).is_file():
        raise LedgerError(f"{directory} holds no ledger")
    with locked(directory), _database(directory, repair=repair) as path:
        findings = _Findings(path.parent)
        with findings.collecting_errors():
            _check_interrupted_writes(directory, findings, repair=repair)
        with findings.collecting_errors():
            _check_database(path, findings)
        # Whatever a damaged database file still gives is looked at, and where it gives nothing more is said.
        with findings.collecting_errors(), contextlib.closing(SqliteRows(path)) as rows:
            return _Check(directory, path, rows, findings, repair=repair).run()
    return CheckReport(directory, {}, 0, 0, 0, findings.repaired, findings.problems)


@contextlib.contextmanager
def _database(directory: Path, *, repair: bool) -> Iterator[Path]:
    """The database, or a copy of it that may be changed."""
    if repair:
        yield directory / DATABASE_NAME
        return
    with tempfile.TemporaryDirectory(prefix="vggt-motion-check-") as scratch:
        try:
            shutil.copyfile(directory / DATABASE_NAME, Path(scratch) / DATABASE_NAME)
            with contextlib.suppress(FileNotFoundError):
                shutil.copyfile(directory / _LOG_NAME, Path(scratch) / _LOG_NAME)
        except OSError as error:
            raise LedgerError(f"cannot copy the rows of {directory}: {error.strerror or error}") from error
        yield Path(scratch) / DATABASE_NAME


class _Lines:
    """The first lines of many, for a session may be damaged everywhere."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._left_out = 0

    def add(self, line: str) -> None:
        if len(self._lines) < _MAX_LISTED:
            self._lines.append(printable(line))
        else:
            self._left_out += 1

    def shown(self) -> tuple[str, ...]:
        return (*self._lines, *([f"and {self._left_out} more"] if self._left_out else []))


class _Findings:
    """Lines of the report."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder  # of the database; the lines name it without
        self._repaired = _Lines()
        self._problems = _Lines()

    def repair(self, line: str) -> None:
        self._repaired.add(line)

    def problem(self, line: str) -> None:
        self._problems.add(line.replace(f"{self._folder}/", ""))

    @contextlib.contextmanager
    def collecting_errors(self, of: str = "") -> Iterator[None]:
        try:
            yield
        except (VggtMotionError, OSError) as error:
            self.problem(f"{of}: {error}" if of else str(error))

    @property
    def repaired(self) -> tuple[str, ...]:
        return self._repaired.shown()

    @property
    def problems(self) -> tuple[str, ...]:
        return self._problems.shown()


def _check_interrupted_writes(directory: Path, findings: _Findings, *, repair: bool) -> None:
    incoming = directory / BLOBS_NAME / "incoming"
    leftovers = sorted(incoming.iterdir()) if incoming.is_dir() else []
    if leftovers:
        findings.repair(f"{len(leftovers)} unfinished blob writes removed")
    for leftover in leftovers if repair else ():
        leftover.unlink()
    with contextlib.suppress(FileNotFoundError):
        if (directory / _LOG_NAME).stat().st_size:
            findings.repair("the write-ahead log of an interrupted process was folded into the database")


def _check_database(path: Path, findings: _Findings) -> None:
    problems = integrity_problems(path)
    if problems and all(_is_of_index(line) for line in problems):
        rebuild_indexes(path)
        findings.repair(f"{len(problems)} wrong index entries rebuilt")
        problems = integrity_problems(path)
    for line in problems:
        findings.problem(f"{path.name}: {line}")


def _is_of_index(line: str) -> bool:
    return "missing from index" in line or "entries in index" in line or "in index" in line


class _Check:
    """The rows and blobs of a database that can be opened."""

    def __init__(self, directory: Path, path: Path, rows: Rows, findings: _Findings, *, repair: bool) -> None:
        self._directory = directory
        self._path = path
        self._rows = rows
        self._findings = findings
        self._repair_files = repair
        self._may_write = False
        self._blobs = BlobFiles(directory / BLOBS_NAME, is_read_only=not repair)
        self._packs = PackFiles(directory / PACKS_NAME, is_read_only=not repair)
        self._referenced: dict[str, str] = {}  # SHA-256 -> a record that refers to it
        self._record_counts: dict[str, int] = {}
        self._job_count = self._blob_count = self._blob_bytes = 0

    def run(self) -> CheckReport:
        """Look at everything that can be looked at."""
        stages = (
            self._check_schema,
            self._check_meta,
            self._check_records,
            self._check_leases,
            self._check_jobs,
            self._check_blobs,
            self._remove_stray_rows,
            self._check_dangling_references,
            self._remove_orphans,
        )
        with contextlib.closing(self._packs):
            for stage in stages:
                with self._findings.collecting_errors():
                    stage()
        return CheckReport(
            self._directory,
            self._record_counts,
            self._job_count,
            self._blob_count,
            self._rows.size_bytes() + self._blob_bytes,
            self._findings.repaired,
            self._findings.problems,
        )

    def _repair(self, line: str, change: Callable[[Transaction], object]) -> None:
        if self._may_write:
            self._rows.write(change)
            self._findings.repair(line)
        else:
            self._findings.problem(line)

    def _check_schema(self) -> None:
        for line in schema_problems(self._path):
            self._findings.problem(f"{self._path.name}: {line}")
        # In a broken file a repair would break more.
        self._may_write = not self._findings.problems

    def _check_meta(self) -> None:
        facts = self._rows.read(lambda reader: reader.meta())
        if facts.get(META_SHA256) != meta_digest(facts):
            self._findings.problem("what the ledger knows of its session is not what was stored")

    def _check_records(self) -> None:
        ends: dict[str, int] = {}
        with self._findings.collecting_errors("streams"):
            ends = self._rows.read(lambda reader: dict(reader.positions()))
        for stream in sorted({*ends, *self._rows.read(lambda reader: reader.record_streams())}):
            sequences = self._rows.read(lambda reader, stream=stream: reader.sequences(stream))  # type: ignore[misc]
            expected = 0
            for sequence in sequences:
                if sequence > expected:
                    self._findings.problem(f"{stream}: records {expected} to {sequence - 1} are missing")
                expected = sequence + 1
                with self._findings.collecting_errors(f"{stream}/{sequence}"):
                    self._check_record(stream, sequence)
            end = ends.get(stream, 0)
            if expected < end:
                self._findings.problem(f"{stream}: the last {end - expected} records are missing")
            elif expected > end:
                self._findings.problem(f"{stream}: {expected} records, but only {end} were counted")
            self._record_counts[stream] = len(sequences)

    def _check_record(self, stream: str, sequence: int) -> None:
        row, references = self._rows.read(functools.partial(_record_and_references, stream=stream, sequence=sequence))
        if row is None:
            self._findings.problem(f"{stream}/{sequence}: the record cannot be found")
            return
        name = f"{stream}/{sequence} ('{row.record_id}')"
        if not is_intact(row, references):
            references = self._corrected(row, name, references)
        for sha256 in references:
            self._referenced.setdefault(sha256, name)

    def _corrected(self, row: RecordRow, name: str, references: Sequence[str]) -> Sequence[str]:
        """What a record refers to, by what it says itself if it is whole."""
        is_old = is_intact(row, None)
        try:
            entries = referenced_blobs(row)
        except CodecError as error:
            reason = f"it cannot be told which blobs it refers to ({error})" if is_old else "not what was stored"
            self._findings.problem(f"{name}: the record is {reason}")
            return references
        wanted = sorted(entry.sha256 for entry in entries)
        if not is_old and not is_intact(row, wanted):
            self._findings.problem(f"{name}: the record is not what was stored")
        elif wanted != references:
            line = f"{name}: which blobs it refers to was damaged and was taken from the record"
            self._repair(line, lambda transaction: transaction.set_references(row.stream, row.sequence, entries))
            return wanted
        return references

    def _check_leases(self) -> None:
        for lease_id in self._rows.read(lambda reader: reader.lease_ids()):
            with self._findings.collecting_errors(f"lease '{lease_id}'"):
                if not self._is_sound_lease(lease_id):
                    line = f"lease '{lease_id}' was damaged and is forgotten: a late result under it is refused"
                    self._repair(line, functools.partial(_forget_lease, lease_id=lease_id))

    def _is_sound_lease(self, lease_id: str) -> bool:
        try:
            lease = self._rows.read(lambda reader: reader.find_lease(lease_id))
        except LedgerError:
            return False
        return lease is not None and lease.row_sha256 in ("", lease.digest())

    def _check_jobs(self) -> None:
        are_records_sound = not self._findings.problems
        job_ids = self._rows.read(lambda reader: reader.job_ids())
        self._job_count = len(job_ids)
        for job_id in job_ids:
            with self._findings.collecting_errors(f"job '{job_id}'"):
                self._check_job(job_id, are_records_sound=are_records_sound)

    def _check_job(self, job_id: str, *, are_records_sound: bool) -> None:
        anew, has_result = self._rows.read(lambda reader: (reader.find_job_anew(job_id), _has_result(reader, job_id)))
        if anew is None or anew.content_sha256 not in ("", anew.content_digest()):
            self._findings.problem(f"job '{job_id}': the job is not what was stored")
        elif anew.state is JobState.DONE and not has_result:
            if are_records_sound:
                line = f"job '{job_id}' was done without a result and is open again"
                opened = dataclasses.replace(anew, state=JobState.OPEN)
                self._repair(line, lambda transaction: transaction.update_job(opened))
            else:
                self._findings.problem(f"job '{job_id}' is done without a result")
        elif not self._is_progress_sound(job_id):
            line = f"job '{job_id}': how far it had come was damaged; it is {anew.state.value}, with all counts at zero"
            self._repair(line, lambda transaction: transaction.update_job(anew))

    def _is_progress_sound(self, job_id: str) -> bool:
        try:
            job, lease = self._rows.read(functools.partial(_job_and_lease, job_id=job_id))
        except LedgerError:
            return False
        if job is None or min(job.attempt, job.failure_count, job.lost_lease_count) < 0:
            return False
        has_lease = lease is not None and lease.job_id == job_id
        return has_lease == (job.state is JobState.LEASED) and job.progress_sha256 in ("", job.progress_digest())

    def _check_blobs(self) -> None:
        for sha256, name in sorted(self._referenced.items()):
            with self._findings.collecting_errors(f"{name}: blob {sha256}"):
                self._check_blob(sha256, name)

    def _check_blob(self, sha256: str, name: str) -> None:
        told, content = self._rows.read(lambda reader: (reader.find_blob_row(sha256), reader.find_content(sha256)))
        place = None if told is None else told.place
        packed = None if place is None else self._packs.read(place)
        found: BlobRow | None = None
        problem = ""
        if packed is not None and place is not None and sha256_hex(packed) == sha256:
            found = BlobRow(sha256, len(packed), 1, place.pack, place.offset_bytes)
        elif content is not None and sha256_hex(content) == sha256:
            found = BlobRow(sha256, len(content), 0)
        else:
            with contextlib.suppress(UnknownError):
                problem = self._blobs.problem(sha256)
                if not problem:
                    found = BlobRow(sha256, self._blobs.size_bytes(sha256), 1)
        if found is not None:
            self._blob_count += 1
            self._blob_bytes += found.size_bytes if found.is_file else 0
            if found != told:
                line = f"{name}: where blob {sha256} lies was damaged and was found out"
                self._repair(line, lambda transaction: transaction.set_blob(found))
            return
        if problem and self._repair_files:
            self._blobs.set_aside(sha256)
        for kept, where in ((packed, place), (content, None)):
            if kept is not None:
                problem = "another content"
                self._set_content_aside(sha256, kept, where)
        state = f"damaged ({problem})" if problem else "missing"
        self._findings.problem(f"{name}: blob {sha256} is {state}; appending the record again brings it back")

    def _set_content_aside(self, sha256: str, content: bytes, place: Place | None) -> None:
        if self._repair_files and self._may_write:
            set_content_aside(self._rows, self._blobs, sha256, content, place)

    def _remove_stray_rows(self) -> None:
        if self._findings.problems:
            return
        count = self._rows.write(lambda transaction: transaction.remove_strays())
        if count:
            self._findings.repair(f"{count} rows of blobs and references that no record has removed")

    def _check_dangling_references(self) -> None:
        for line in dangling_references(self._path):
            self._findings.problem(f"{self._path.name}: {line}")

    def _remove_orphans(self) -> None:
        if self._findings.problems:
            return
        orphans = [sha256 for sha256 in self._blobs.names() if sha256 not in self._referenced]
        if orphans:
            size_bytes = sum(self._blobs.size_bytes(sha256) for sha256 in orphans)
            self._findings.repair(f"{len(orphans)} blobs to which no record refers set aside ({size_bytes} bytes)")
        for sha256 in orphans if self._repair_files else ():
            self._blobs.set_aside(sha256)
        # What lies behind the last blob that a row knows was not acknowledged either, or its rows are lost: who cut off
        # the end of the write-ahead log, or emptied the database, must not lose the payloads as well.
        used = self._rows.read(lambda reader: [place for _, place in reader.blobs() if place is not None])
        for number, size_bytes in self._packs.unused_bytes(used).items():
            if size_bytes > _MOST_SET_ASIDE_BYTES:
                self._findings.problem(f"{size_bytes} bytes at the end of pack {number} to which no record refers")
                continue
            line = f"{size_bytes} bytes at the end of pack {number}, to which no record refers, set aside"
            self._findings.repair(line)
            if self._repair_files:
                rest = self._packs.last_bytes(number, size_bytes)
                if self._blobs.keep_damaged(sha256_hex(rest), rest):
                    self._packs.cut_off(number, size_bytes)


def _record_and_references(reader: Reader, stream: str, sequence: int) -> tuple[RecordRow | None, Sequence[str]]:
    rows = [row for row in reader.records(stream, sequence, 1) if row.sequence == sequence]
    return (rows[0] if rows else None), reader.references(stream, sequence)


def _forget_lease(transaction: Transaction, lease_id: str) -> None:
    if not transaction.remove_lease(lease_id):
        raise LedgerError("the row cannot be found under its id")


def _has_result(reader: Reader, job_id: str) -> bool:
    return any(reader.find_record(stream, job_id) is not None for stream in reader.positions())


def _job_and_lease(reader: Reader, job_id: str) -> tuple[JobRow | None, LeaseRow | None]:
    job = reader.find_job(job_id)
    return job, (reader.find_lease(job.lease_id) if job is not None and job.lease_id else None)
