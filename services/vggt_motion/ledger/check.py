"""``vggt-motion ledger check DIR``: verify every row and blob, and repair what an interrupted write left behind."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vggt_motion.errors import LedgerError
from vggt_motion.ledger.blobs import BlobFiles
from vggt_motion.ledger.directory import BLOBS_NAME, DATABASE_NAME, PACKS_NAME, locked
from vggt_motion.ledger.log import bounded_records, is_intact, set_content_aside
from vggt_motion.ledger.packs import PackFiles
from vggt_motion.ledger.sqlite import SqliteRows, integrity_problems, rebuild_indexes
from vggt_motion.ledger.store import JobRow, Place, Reader, RecordRow, Rows, Transaction, UnknownError, sha256_hex
from vggt_motion.records import JobState

_PAGE = 256
_MAX_LISTED = 100


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
        records = ", ".join(f"{count} {stream}" for stream, count in sorted(self.record_counts.items())) or "none"
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
    acknowledged writes, indexes, and jobs that are done without a result. A damaged blob is set aside, so that the
    source of it may append it again; a damaged row cannot be repaired.

    Args:
        directory: of the session.
        repair: False to change nothing but what opening a database changes.

    Raises:
        LedgerError: no session, or in use by another process.
    """
    path = directory / DATABASE_NAME
    if not path.is_file():
        raise LedgerError(f"{directory} holds no ledger")
    with locked(directory):
        findings = _Findings()
        _check_interrupted_writes(directory, findings, repair=repair)
        with findings.collecting_errors():
            _check_database(path, findings, repair=repair)
        counts: dict[str, int] = {}
        job_count = blob_count = stored_bytes = 0
        # Whatever a damaged database file still gives is looked at, and where it gives nothing more is said.
        with findings.collecting_errors(), contextlib.closing(SqliteRows(path)) as rows:
            counts, referenced = _check_records(rows, findings)
            job_count = _check_jobs(rows, findings, repair=repair)
            blob_count, blob_bytes = _check_blobs(directory, rows, referenced, findings, repair=repair)
            stored_bytes = rows.size_bytes() + blob_bytes
    return CheckReport(directory, counts, job_count, blob_count, stored_bytes, findings.repaired, findings.problems)


class _Findings:
    """Lines of the report; bounded, for a session may be damaged everywhere."""

    def __init__(self) -> None:
        self._repaired: list[str] = []
        self._problems: list[str] = []
        self._left_out = 0

    def repair(self, line: str) -> None:
        self._repaired.append(line)

    def problem(self, line: str) -> None:
        if len(self._problems) < _MAX_LISTED:
            self._problems.append(line)
        else:
            self._left_out += 1

    @contextlib.contextmanager
    def collecting_errors(self) -> Iterator[None]:
        try:
            yield
        except LedgerError as error:
            self.problem(str(error))

    @property
    def repaired(self) -> tuple[str, ...]:
        return tuple(self._repaired)

    @property
    def problems(self) -> tuple[str, ...]:
        return (*self._problems, *([f"and {self._left_out} more"] if self._left_out else []))


def _check_interrupted_writes(directory: Path, findings: _Findings, *, repair: bool) -> None:
    incoming = directory / BLOBS_NAME / "incoming"
    leftovers = sorted(incoming.iterdir()) if incoming.is_dir() else []
    if leftovers:
        findings.repair(f"{len(leftovers)} unfinished blob writes removed")
    for leftover in leftovers if repair else ():
        leftover.unlink()
    log = directory / f"{DATABASE_NAME}-wal"
    with contextlib.suppress(FileNotFoundError):
        if log.stat().st_size:
            findings.repair("the write-ahead log of an interrupted process was folded into the database")


def _check_database(path: Path, findings: _Findings, *, repair: bool) -> None:
    problems = integrity_problems(path)
    if problems and all(_is_of_index(line) for line in problems):
        if repair:
            rebuild_indexes(path)
        findings.repair(f"{len(problems)} wrong index entries rebuilt")
        problems = integrity_problems(path) if repair else []
    for line in problems:
        findings.problem(f"{path.name}: {line}")


def _is_of_index(line: str) -> bool:
    return "missing from index" in line or "entries in index" in line or "in index" in line


def _check_records(rows: Rows, findings: _Findings) -> tuple[dict[str, int], dict[str, tuple[int, str]]]:
    counts: dict[str, int] = {}
    referenced: dict[str, tuple[int, str]] = {}  # SHA-256 -> (size in bytes, a record that refers to it)
    for stream, end in rows.read(lambda reader: dict(reader.positions())).items():
        expected = 0
        for row in _records(rows, stream):
            name = f"{stream}/{row.sequence} ('{row.record_id}')"
            if row.sequence != expected:
                findings.problem(f"{stream}: records {expected} to {row.sequence - 1} are missing")
            expected = row.sequence + 1
            if not is_intact(row):
                findings.problem(f"{name}: the record is not what was stored")
            for blob in _blobs_of(rows, stream, row.sequence):
                referenced.setdefault(blob[0], (blob[1], name))
        if expected != end:
            findings.problem(f"{stream}: the last {end - expected} records are missing")
        counts[stream] = expected
    return counts, referenced


def _records(rows: Rows, stream: str) -> Iterator[RecordRow]:
    position = 0
    while True:
        page = rows.read(lambda reader, start=position: list(bounded_records(reader, stream, start, _PAGE)))  # type: ignore[misc]
        if not page:
            return
        yield from page
        position = page[-1].sequence + 1


def _blobs_of(rows: Rows, stream: str, sequence: int) -> list[tuple[str, int]]:
    entries = rows.read(lambda reader: list(reader.record_blobs(stream, sequence)))
    return [(entry.sha256, entry.size_bytes) for entry in entries]


def _check_jobs(rows: Rows, findings: _Findings, *, repair: bool) -> int:
    count, after = 0, ""
    while page := rows.read(lambda reader, start=after: list(reader.jobs(None, start, _PAGE))):  # type: ignore[misc]
        count += len(page)
        after = page[-1].job_id
        for job in page:
            if job.state is JobState.DONE and not rows.read(lambda reader, job=job: _has_result(reader, job)):  # type: ignore[misc]
                findings.repair(f"job '{job.job_id}' was done without a result and is open again")
                if repair:
                    rows.write(lambda transaction, job=job: _reopen(transaction, job))  # type: ignore[misc]
    return count


def _has_result(reader: Reader, job: JobRow) -> bool:
    return any(reader.find_record(stream, job.job_id) is not None for stream in reader.positions())


def _reopen(transaction: Transaction, job: JobRow) -> None:
    transaction.update_job(dataclasses.replace(job, state=JobState.OPEN))


def _check_blobs(
    directory: Path, rows: Rows, referenced: dict[str, tuple[int, str]], findings: _Findings, *, repair: bool
) -> tuple[int, int]:
    """Number of sound blobs, and the bytes of those that are not among the rows."""
    blobs = BlobFiles(directory / BLOBS_NAME)
    orphans = [sha256 for sha256 in blobs.names() if sha256 not in referenced]
    # With damaged rows it is not known which blobs they refer to: then none is an orphan for certain.
    if orphans and not findings.problems:
        size_bytes = sum(blobs.size_bytes(sha256) for sha256 in orphans)
        findings.repair(f"{len(orphans)} blobs of writes that were never acknowledged removed ({size_bytes} bytes)")
        for sha256 in orphans if repair else ():
            blobs.remove(sha256)
    count = total_bytes = 0
    packs = PackFiles(directory / PACKS_NAME)
    if not findings.problems:
        _check_ends_of_packs(rows, packs, findings, repair=repair)
    for sha256, (size_bytes, name) in sorted(referenced.items()):
        content, place = rows.read(functools.partial(_content_and_place, sha256=sha256))
        if place is not None:
            content = packs.read(place)
        if content is not None and sha256_hex(content) == sha256:
            count += 1
            total_bytes += 0 if place is None else size_bytes
            continue
        if content is not None:
            if repair:
                set_content_aside(rows, blobs, sha256, content, place)
            findings.problem(
                f"{name}: blob {sha256} is damaged (another content); appending the record again brings it back"
            )
            continue
        try:
            problem = blobs.problem(sha256, size_bytes)
        except UnknownError:
            findings.problem(f"{name}: blob {sha256} is missing; appending the record again brings it back")
            continue
        if problem:
            if repair:
                blobs.set_aside(sha256)
            findings.problem(f"{name}: blob {sha256} is damaged ({problem}); appending the record again brings it back")
            continue
        count += 1
        total_bytes += size_bytes
    packs.close()
    return count, total_bytes


def _content_and_place(reader: Reader, sha256: str) -> tuple[bytes | None, Place | None]:
    return reader.find_content(sha256), reader.find_place(sha256)


def _check_ends_of_packs(rows: Rows, packs: PackFiles, findings: _Findings, *, repair: bool) -> None:
    """Cut off what was written behind the last blob that a row knows: it was never acknowledged."""
    used = rows.read(lambda reader: [place for _, place in reader.blobs() if place is not None])
    for number, size_bytes in packs.unused_bytes(used).items():
        findings.repair(f"{size_bytes} bytes of writes that were never acknowledged removed from pack {number}")
        if repair:
            packs.cut_off(number, size_bytes)
