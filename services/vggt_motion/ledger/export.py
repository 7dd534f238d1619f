"""A session as one file, and back: a tar archive with the database and the blobs beside it, each a file of its own."""

from __future__ import annotations

import io
import os
import shutil
import tarfile
import tempfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from vggt_motion.errors import InputError, LedgerError
from vggt_motion.ledger.blobs import BlobFiles
from vggt_motion.ledger.directory import BLOBS_NAME, DATABASE_NAME, PACKS_NAME, locked
from vggt_motion.ledger.files import FileOperations
from vggt_motion.ledger.packs import read_place
from vggt_motion.ledger.sqlite import copy_database, read_only, take_out_of_packs
from vggt_motion.ledger.store import BlobEntry, Place, Reader, sha256_hex

_MAX_BLOB_BYTES = 2**30


@dataclass(frozen=True)
class ExportReport:
    """What went into or came out of an archive."""

    record_counts: dict[str, int]
    blob_count: int
    archive_bytes: int

    def __str__(self) -> str:
        """One line for a person."""
        return f"{sum(self.record_counts.values())} records, {self.blob_count} payloads, {self.archive_bytes} bytes"


def export_session(directory: Path, archive: Path) -> ExportReport:
    """Write a session to a tar file; it may be served meanwhile, what comes later is not in it.

    Args:
        directory: of the session.
        archive: file to write; appears under its name only when it is whole.

    Raises:
        InputError: the archive cannot be written, or is there already.
        LedgerError: no session of ours, or a damaged one.
    """
    if archive.exists():
        raise InputError(f"{archive} is there already")
    partial = archive.with_name(archive.name + ".partial")
    try:
        with tempfile.TemporaryDirectory(dir=archive.parent) as scratch, tarfile.open(partial, "w") as tar:
            snapshot = Path(scratch) / DATABASE_NAME
            copy_database(directory / DATABASE_NAME, snapshot)
            with read_only(snapshot) as reader:
                counts = dict(reader.positions())
                blob_count = _check_contents(reader)
                entries = list(reader.blobs())
            take_out_of_packs(snapshot)
            tar.add(snapshot, DATABASE_NAME)
            # Blobs never change and are never removed while a record refers to them: no lock is needed.
            for entry, place in entries:
                _add(tar, entry, _content(directory, entry, place))
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        FileOperations().rename(partial, archive)
        FileOperations().sync_folder(archive.parent)
    except OSError as error:
        raise InputError(f"cannot write {archive}: {error.strerror or error}") from error
    finally:
        partial.unlink(missing_ok=True)
    return ExportReport(counts, blob_count + len(entries), archive.stat().st_size)


def import_session(archive: Path, directory: Path) -> ExportReport:
    """Make a session from a tar file; everything is verified before the database is put in its place.

    Args:
        archive: file that :func:`export_session` wrote.
        directory: new or empty.

    Raises:
        InputError: not such an archive, damaged, or the directory holds something.
    """
    if directory.exists() and any(directory.iterdir()):
        raise InputError(f"{directory} is not empty")
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with locked(directory):
            return _import(archive, directory)
    except (OSError, tarfile.TarError, LedgerError) as error:
        shutil.rmtree(directory, ignore_errors=True)
        raise InputError(f"cannot import {archive}: {error}") from error
    except BaseException:
        shutil.rmtree(directory, ignore_errors=True)
        raise


def _import(archive: Path, directory: Path) -> ExportReport:
    blobs = BlobFiles(directory / BLOBS_NAME)
    found: set[BlobEntry] = set()
    snapshot = directory / f"{DATABASE_NAME}.partial"
    with tarfile.open(archive, "r:") as tar:
        for member in tar:
            content = tar.extractfile(member) if member.isreg() else None
            if content is None:
                raise InputError(f"cannot import {archive}: '{member.name[:80]}' is not a file")
            if member.name == DATABASE_NAME:
                with snapshot.open("wb") as file:
                    shutil.copyfileobj(content, file)
                    file.flush()
                    os.fsync(file.fileno())
                continue
            if member.size > _MAX_BLOB_BYTES:
                raise InputError(f"cannot import {archive}: a blob of {member.size} bytes")
            (entry,) = blobs.put([content.read()], keep_free_bytes=0)
            if PurePosixPath(member.name) != PurePosixPath(BLOBS_NAME, entry.sha256):
                raise InputError(f"cannot import {archive}: '{member.name[:80]}' is damaged or not of a session")
            found.add(entry)
    if not snapshot.is_file():
        raise InputError(f"cannot import {archive}: there is no {DATABASE_NAME} in it")
    with read_only(snapshot) as reader:
        counts = dict(reader.positions())
        blob_count = _check_contents(reader)
        missing = {entry for entry, _ in reader.blobs()} - found
    if missing:
        raise InputError(f"cannot import {archive}: {len(missing)} blobs are missing")
    FileOperations().rename(snapshot, directory / DATABASE_NAME)
    FileOperations().sync_folder(directory)
    return ExportReport(counts, blob_count + len(found), archive.stat().st_size)


def _check_contents(reader: Reader) -> int:
    """Verify the blobs among the rows; returns how many there are."""
    count = 0
    for sha256, content in reader.contents():
        count += 1
        if sha256_hex(content) != sha256:
            raise LedgerError(f"blob {sha256} is damaged; run a check")
    return count


def _content(directory: Path, entry: BlobEntry, place: Place | None) -> bytes:
    try:
        if place is not None:
            return read_place(directory / PACKS_NAME, place)
        return (directory / BLOBS_NAME / entry.sha256).read_bytes()
    except FileNotFoundError:
        raise LedgerError(f"blob {entry.sha256} is missing; run a check") from None


def _add(tar: tarfile.TarFile, entry: BlobEntry, data: bytes) -> None:
    if BlobEntry(sha256_hex(data), len(data)) != entry:
        raise LedgerError(f"blob {entry.sha256} is damaged; run a check")
    info = tarfile.TarInfo(f"{BLOBS_NAME}/{entry.sha256}")
    info.size = len(data)
    info.mode = 0o644
    tar.addfile(info, io.BytesIO(data))
