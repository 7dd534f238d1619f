"""The sessions below a folder, and what a session's directory belongs to."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

from vggt_motion.bus import codec
from vggt_motion.errors import CodecError, InputError, LedgerError
from vggt_motion.ledger.directory import BLOBS_NAME, DATABASE_NAME, is_in_use, locked
from vggt_motion.ledger.sqlite import SqliteRows, database_bytes, read_only
from vggt_motion.ledger.store import Reader, Transaction
from vggt_motion.records import Event, EventKind, Stream

_SOURCE = "source"
_FINGERPRINT = "source_fingerprint"
_CONFIGURATION = "configuration_digest"
_DEPTH = 3  # of directories below the root that is searched
_PAGE = 100


@dataclass(frozen=True)
class SessionIdentity:
    """What a session's directory belongs to; two runs may share it only if fingerprint and digest are equal."""

    source: str  # for a person
    source_fingerprint: str
    configuration_digest: str


class SessionState(StrEnum):
    """What there is in a directory that a run wants to use."""

    NEW = "new"
    UNFINISHED = "unfinished"  # of the same source and configuration: to be continued
    FINISHED = "finished"


@dataclass(frozen=True)
class SessionSummary:
    """One session, as ``vggt-motion sessions`` lists it."""

    directory: Path
    source: str  # empty if the session does not say
    source_fingerprint: str
    started_ns: int  # wall clock of its first event; 0 if it has none
    record_counts: dict[str, int]
    dead_job_count: int
    stored_bytes: int
    is_ended: bool  # the run ended by itself
    is_in_use: bool  # a process serves it at this moment
    problem: str  # one line if it cannot be read; empty otherwise

    def to_text(self) -> str:
        """Two lines for a person: where it is and how far it got, and what it is of."""
        state = self.problem or ("in use" if self.is_in_use else "finished" if self.is_ended else "unfinished")
        counts = ", ".join(f"{self.record_counts.get(stream, 0)} {stream}s" for stream in ("keyframe", "submap"))
        started = ""
        if self.started_ns:
            started = datetime.fromtimestamp(self.started_ns / 1e9, UTC).strftime(", started %Y-%m-%d %H:%M UTC")
        dead = f", {self.dead_job_count} jobs given up" if self.dead_job_count else ""
        return (
            f"{self.directory}: {state}, {counts}{dead}, {self.stored_bytes / 1e6:.1f} MB{started}\n"
            f"    {self.source or 'unknown source'}\n"
        )


def list_sessions(root: Path) -> list[SessionSummary]:
    """All sessions at or below a folder, in order of their path; may be called while they are being served.

    Raises:
        InputError: ``root`` is not a folder.
    """
    if not root.is_dir():
        raise InputError(f"{root} is not a folder")
    return [summary_of(directory) for directory in sorted(_directories(root, _DEPTH))]


def summary_of(directory: Path) -> SessionSummary:
    """One session; what cannot be read is said in ``problem``."""
    path = directory / DATABASE_NAME
    in_use = is_in_use(directory)
    try:
        with read_only(path) as reader:
            started, ended = _events(reader)
            detail = started.detail if started is not None else {}
            return SessionSummary(
                directory=directory,
                source=detail.get(_SOURCE) or reader.find_meta(_SOURCE) or "",
                source_fingerprint=detail.get(_FINGERPRINT) or reader.find_meta(_FINGERPRINT) or "",
                started_ns=started.time_ns if started is not None else 0,
                record_counts=dict(reader.positions()),
                dead_job_count=sum(count for (_, state), count in reader.job_counts().items() if state == "dead"),
                stored_bytes=database_bytes(path) + reader.blob_bytes(),
                is_ended=ended,
                is_in_use=in_use,
                problem="",
            )
    except LedgerError as error:
        return SessionSummary(directory, "", "", 0, {}, 0, database_bytes(path), False, in_use, str(error))


def identity_of(directory: Path) -> SessionIdentity | None:
    """What a directory belongs to; None if it holds no session, or one that does not say.

    Raises:
        LedgerError: damaged, or of a newer schema.
    """
    path = directory / DATABASE_NAME
    if not path.is_file():
        return None
    with read_only(path) as reader:
        fingerprint = reader.find_meta(_FINGERPRINT)
        digest = reader.find_meta(_CONFIGURATION)
        if fingerprint is None or digest is None:
            return None
        return SessionIdentity(reader.find_meta(_SOURCE) or "", fingerprint, digest)


def prepare_session(directory: Path, identity: SessionIdentity) -> SessionState:
    """Make a directory ready for a run of this source and configuration; to be called before its ledger is started.

    Raises:
        InputError: it holds another source, another configuration, or something that does not say what it is.
        LedgerError: in use by another process, damaged, of a newer schema, or not writable.
    """
    path = directory / DATABASE_NAME
    known = identity_of(directory)
    if known is not None:
        if known.source_fingerprint != identity.source_fingerprint:
            raise InputError(f"{directory} holds another source ({known.source}): choose another folder or --fresh")
        if known.configuration_digest != identity.configuration_digest:
            raise InputError(f"{directory} holds a run with another configuration: choose another folder or --fresh")
        return SessionState.FINISHED if summary_of(directory).is_ended else SessionState.UNFINISHED
    if path.is_file():
        with read_only(path) as reader:
            if reader.positions():
                raise InputError(f"{directory} holds a session of unknown source: choose another folder or --fresh")
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create {directory}: {error.strerror or error}") from error
    with locked(directory):
        rows = SqliteRows(path)
        try:

            def change(transaction: Transaction) -> None:
                transaction.set_meta(_SOURCE, identity.source)
                transaction.set_meta(_FINGERPRINT, identity.source_fingerprint)
                transaction.set_meta(_CONFIGURATION, identity.configuration_digest)

            rows.write(change)
        finally:
            rows.close()
    return SessionState.NEW


def remove_session(directory: Path) -> None:
    """Delete what a ledger keeps in a directory, and nothing else.

    Raises:
        LedgerError: in use by another process, or it cannot be deleted.
    """
    if not (directory / DATABASE_NAME).exists() and not (directory / BLOBS_NAME).exists():
        return
    with locked(directory):
        try:
            for suffix in ("", "-wal", "-shm"):
                (directory / f"{DATABASE_NAME}{suffix}").unlink(missing_ok=True)
            if (directory / BLOBS_NAME).exists():
                shutil.rmtree(directory / BLOBS_NAME)
        except OSError as error:
            raise LedgerError(f"cannot delete the session in {directory}: {error.strerror or error}") from error


def _directories(folder: Path, depth: int) -> Iterator[Path]:
    if (folder / DATABASE_NAME).is_file():
        yield folder
        return
    if depth == 0:
        return
    with contextlib.suppress(PermissionError):
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                yield from _directories(path, depth - 1)


def _events(reader: Reader) -> tuple[Event | None, bool]:
    """The event that started the session, and whether the run ended."""
    started: Event | None = None
    ended = False
    position = 0
    while rows := reader.records(Stream.EVENT.value, position, _PAGE):
        position = rows[-1].sequence + 1
        for row in rows:
            try:
                event = codec.decode(Event, row.payload)
            except CodecError:
                continue
            if event.kind is EventKind.SESSION_STARTED and started is None:
                started = event
            ended = ended or event.kind is EventKind.RUN_ENDED
    return started, ended
