"""One session's directory: the lock, the database and the blobs, opened and closed as one.

DIR/session.lock   held exclusively by the process that serves the session
DIR/ledger.db      rows, and small payloads that come alone (and ledger.db-wal, ledger.db-shm while it is open)
DIR/blobs/         large payloads by their hash
DIR/blobs/packs/   the other small payloads, many in a file
"""

from __future__ import annotations

import contextlib
import os
import re
import time
import uuid
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Final

from vggt_motion.errors import LedgerError
from vggt_motion.ledger.blobs import BlobFiles
from vggt_motion.ledger.files import FileOperations, make_folder
from vggt_motion.ledger.jobs import JobPolicy, JobQueue
from vggt_motion.ledger.log import INLINE_BYTES, PACKED_BLOB_BYTES, Store
from vggt_motion.ledger.packs import PackFiles, read_place
from vggt_motion.ledger.sqlite import SqliteRows, read_only
from vggt_motion.ledger.store import NewRecord, Transaction, UnknownError, printable
from vggt_motion.locks import try_lock
from vggt_motion.records import JobReport

DATABASE_NAME: Final = "ledger.db"
LOCK_NAME: Final = "session.lock"
BLOBS_NAME: Final = "blobs"
PACKS_NAME: Final = "blobs/packs"
_LEDGER_ID = "ledger_id"
_IDENTITY = re.compile(r"[0-9a-f]{32}")
_PATIENCE_S = 0.5


class SessionLock:
    """The exclusive right to a session's directory; ends with the process at the latest, however it ends."""

    def __init__(self, directory: Path, *, patience_s: float = _PATIENCE_S) -> None:
        """Take the lock.

        Args:
            directory: it must be there.
            patience_s: how long to wait for a process that is ending, or that only looks.

        Raises:
            LedgerError: another process has it, or the directory cannot be written.
        """
        path = directory / LOCK_NAME
        try:
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise LedgerError(f"cannot write to {directory}: {error.strerror or error}") from error
        end_s = time.monotonic() + patience_s
        while not try_lock(self._descriptor):
            if time.monotonic() < end_s:
                time.sleep(0.02)
                continue
            holder = os.pread(self._descriptor, 32, 0).decode("ascii", "replace").strip()
            os.close(self._descriptor)
            raise LedgerError(f"{directory} is in use by another process ({holder or 'unknown'})")
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, f"{os.getpid()}\n".encode(), 0)

    def release(self) -> None:
        """Give the lock back."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def is_in_use(directory: Path) -> bool:
    """Whether a process serves the session at this moment."""
    try:
        descriptor = os.open(directory / LOCK_NAME, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        return not try_lock(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Hold a session's directory for a while."""
    lock = SessionLock(directory)
    try:
        yield
    finally:
        lock.release()


class Ledger:
    """An open session: ``store``, ``jobs`` and ``blobs`` on one directory, under its lock."""

    def __init__(
        self,
        directory: Path,
        *,
        reserve_bytes: int = 0,
        input_streams: Collection[str] = (),
        packed_blob_bytes: int = PACKED_BLOB_BYTES,
        inline_bytes: int = INLINE_BYTES,
        recent_bytes: int = 0,
        policy: JobPolicy | None = None,
        result_streams: Mapping[str, str],
        dead_event: Callable[[JobReport], NewRecord],
        free_bytes: Callable[[], int] | None = None,
        files: FileOperations | None = None,
        clock: Callable[[], float] = time.monotonic,
        time_ns: Callable[[], int] = time.time_ns,
        new_lease_id: Callable[[], str] | None = None,
    ) -> None:
        """Open or create a session; what was leased is open again.

        Args:
            directory: created if it is not there.
            reserve_bytes: see :class:`.log.Store`.
            input_streams: see :class:`.log.Store`.
            packed_blob_bytes: see :class:`.log.Store`.
            inline_bytes: see :class:`.log.Store`.
            recent_bytes: see :class:`.log.Store`.
            policy: see :class:`.jobs.JobQueue`.
            result_streams: see :class:`.jobs.JobQueue`.
            dead_event: see :class:`.jobs.JobQueue`.
            free_bytes: space left in bytes; defaults to asking the file system.
            files: the file operations of blobs and packs; defaults to the real ones.
            clock: seconds, monotonic.
            time_ns: wall clock, informative.
            new_lease_id: see :class:`.jobs.JobQueue`.

        Raises:
            LedgerError: in use by another process, damaged, of a newer schema, or not writable.
        """
        self.directory = directory
        with contextlib.ExitStack() as undo:
            files = files or FileOperations()
            try:
                make_folder(directory, files)
            except OSError as error:
                raise LedgerError(f"cannot create {directory}: {error.strerror or error}") from error
            lock = SessionLock(directory)
            undo.callback(lock.release)
            self.blobs = BlobFiles(directory / BLOBS_NAME, free_bytes=free_bytes, files=files)
            self.packs = PackFiles(directory / PACKS_NAME, files=files)
            undo.callback(self.packs.close)
            self.rows = SqliteRows(directory / DATABASE_NAME)
            undo.callback(self.rows.close)
            files.sync_folder(directory)
            self.store = Store(
                self.rows,
                self.blobs,
                self.packs,
                reserve_bytes=reserve_bytes,
                input_streams=input_streams,
                packed_blob_bytes=packed_blob_bytes,
                inline_bytes=inline_bytes,
                recent_bytes=recent_bytes,
                time_ns=time_ns,
            )
            self.jobs = JobQueue(
                self.rows,
                self.store,
                policy=policy,
                result_streams=result_streams,
                dead_event=dead_event,
                clock=clock,
                new_lease_id=new_lease_id,
            )
            self.ledger_id = self.rows.write(_identified)
            self._close = undo.pop_all()

    def close(self) -> None:
        """End waiting claims, close the database and give the lock back."""
        self.jobs.close()
        self._close.close()


def _identified(transaction: Transaction) -> str:
    """An id that no other log has, made when this one was.

    Raises:
        LedgerError: what is stored is no such id.
    """
    known = transaction.find_meta(_LEDGER_ID)
    if known is None:
        known = uuid.uuid4().hex
        transaction.set_meta(_LEDGER_ID, known)
    if not _IDENTITY.fullmatch(known):
        raise LedgerError(f"the id of this ledger is damaged: '{printable(known):.40}'")
    return known


def stored_blob(directory: Path, sha256: str) -> bytes:
    """The bytes of a blob of a session that another process may be serving; not verified.

    Raises:
        LedgerError: no ledger of ours, or it cannot be read.
        UnknownError: it has no such blob.
    """
    with read_only(directory / DATABASE_NAME) as reader:
        content, place = reader.find_content(sha256), reader.find_place(sha256)
    if content is not None and place is None:
        return content
    try:
        if place is not None:
            return read_place(directory / PACKS_NAME, place)
        return (directory / BLOBS_NAME / sha256).read_bytes()
    except FileNotFoundError:
        raise UnknownError(f"no blob {sha256} in {directory}") from None
    except OSError as error:
        raise LedgerError(f"cannot read blob {sha256} in {directory}: {error.strerror or error}") from error
