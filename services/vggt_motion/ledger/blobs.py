"""Large blobs as files named by their content: ``blobs/abcdef...``. For the small ones see :mod:`.packs`.

A blob is written under ``blobs/incoming``, forced to the disk, renamed to its name and its folder forced to the disk;
only then does a row refer to it. So a name under ``blobs`` always stands for whole content, whatever was killed;
what was torn is under ``incoming`` and is removed at the next start. The hash is verified on every read, because disks
do rot.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from vggt_motion.disk import NO_SPACE, free_space
from vggt_motion.errors import DiskFullError, LedgerError
from vggt_motion.ledger.files import FileOperations, SharedSync, make_folder
from vggt_motion.ledger.store import (
    Blob,
    BlobEntry,
    Content,
    DamagedBlobError,
    InvalidRequestError,
    UnknownError,
    reserve_line,
    sha256_hex,
)

_LOGGER = logging.getLogger(__name__)
_SHA256 = re.compile(r"[0-9a-f]{64}")


class BlobFiles:
    """Blob store in a folder; safe for use from many threads. One process at a time (the session's lock sees to it)."""

    def __init__(
        self,
        folder: Path,
        *,
        free_bytes: Callable[[], int] | None = None,
        files: FileOperations | None = None,
        is_read_only: bool = False,
    ) -> None:
        """Open or create the store and remove what an interrupted write left.

        Args:
            folder: where the files are.
            free_bytes: space left in bytes; defaults to asking the file system.
            files: the file operations; defaults to the real ones.
            is_read_only: True to create and remove nothing.

        Raises:
            LedgerError: the folder cannot be created or written.
        """
        self._folder = folder
        self._incoming = folder / "incoming"
        self._damaged = folder / "damaged"
        self._files = files or FileOperations()
        self._free_bytes = free_bytes or (lambda: free_space(folder))
        self._counter = itertools.count()
        # One folder for all names, so that many writes share the sync of its entries.
        self._sync_names = SharedSync(lambda: self._files.sync_folder(folder))
        self._lock = threading.Lock()
        self._claimed_bytes = 0  # of writes that are under way: many at once must not overshoot the reserve together
        if is_read_only:
            return
        try:
            make_folder(self._incoming, self._files)
            for leftover in self._incoming.iterdir():
                leftover.unlink()
        except OSError as error:
            raise LedgerError(f"cannot use {folder} for blobs: {error.strerror or error}") from error

    def put(self, blobs: Sequence[Content | Blob], *, keep_free_bytes: int) -> list[BlobEntry]:
        """Make blobs durable, in order; see :meth:`.store.Blobs.put`."""
        hashed = [Blob.of(data) for data in blobs]
        # An existing file is read again: that its name is there does not say that the disk kept its content.
        missing = {blob.entry: blob.data for blob in hashed if not self._is_sound(blob.entry)}
        size_bytes = sum(entry.size_bytes for entry in missing)
        with self._space(size_bytes, keep_free_bytes):
            try:
                for entry, data in missing.items():
                    self._write(entry.sha256, data)
                # Also for known blobs: another thread, or a process that was killed, may have renamed them only.
                if hashed:
                    self._sync_names()
            except OSError as error:
                if error.errno in NO_SPACE:
                    raise DiskFullError(f"no space for {size_bytes} bytes in {self._folder}") from error
                raise LedgerError(f"cannot write to {self._folder}: {error.strerror or error}") from error
        return [blob.entry for blob in hashed]

    def get(self, sha256: str) -> bytes:
        """The bytes, verified; see :meth:`.store.Blobs.get`. Damaged ones are set aside; appending heals them."""
        path = self._path(sha256)
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            raise UnknownError(f"no blob {sha256}") from None
        except OSError as error:
            raise LedgerError(f"cannot read blob {sha256}: {error.strerror or error}") from error
        if sha256_hex(data) != sha256:
            self.set_aside(sha256)
            raise DamagedBlobError(f"blob {sha256} is damaged: {len(data)} bytes with another hash")
        return data

    def has(self, sha256: str, size_bytes: int) -> bool:
        """Whether the file is there with this size."""
        try:
            return self._path(sha256).stat().st_size == size_bytes
        except OSError:
            return False

    def free_bytes(self) -> int:
        """Space left in bytes.

        Raises:
            LedgerError: the file system does not say.
        """
        try:
            return self._free_bytes()
        except OSError as error:
            raise LedgerError(f"cannot tell the free space of {self._folder}: {error.strerror or error}") from error

    def names(self) -> Iterator[str]:
        """SHA-256 of every stored file, in order, whether a record refers to it or not."""
        paths = self._folder.iterdir() if self._folder.exists() else ()
        yield from sorted(path.name for path in paths if _SHA256.fullmatch(path.name))

    def size_bytes(self, sha256: str) -> int:
        """Size of a stored file."""
        return self._path(sha256).stat().st_size

    def problem(self, sha256: str) -> str:
        """What is wrong with a stored file; empty if it is what it should be.

        Raises:
            UnknownError: there is no such file.
        """
        try:
            data = self._path(sha256).read_bytes()
        except FileNotFoundError:
            raise UnknownError(f"no blob {sha256}") from None
        except OSError as error:
            return error.strerror or str(error)
        return "" if sha256_hex(data) == sha256 else "another content"

    def set_aside(self, sha256: str) -> None:
        """Move a file that is damaged, or of nobody, to ``damaged/``, where a person can look at it."""
        path = self._path(sha256)
        _LOGGER.error("blob %s is set aside in %s", sha256, self._damaged)
        with contextlib.suppress(OSError):
            make_folder(self._damaged, self._files)
            self._files.rename(path, self._damaged / sha256)

    def keep_damaged(self, sha256: str, data: bytes) -> bool:
        """Write a content that was no file to ``damaged/`` as well; False: it cannot be written."""
        path = self._damaged / self._path(sha256).name
        _LOGGER.error("content %s is set aside as %s", sha256, path)
        with contextlib.suppress(OSError):
            make_folder(self._damaged, self._files)
            path.write_bytes(data)
            return True
        return False

    def _path(self, sha256: str) -> Path:
        # The name comes from outside: it must never lead out of the folder.
        if not _SHA256.fullmatch(sha256):
            raise InvalidRequestError(f"'{sha256[:80]}' is not a SHA-256 in lower-case hexadecimal digits")
        return self._folder / sha256

    def _is_sound(self, entry: BlobEntry) -> bool:
        if not self.has(entry.sha256, entry.size_bytes):
            return False
        try:
            return sha256_hex(self._path(entry.sha256).read_bytes()) == entry.sha256
        except OSError:
            return False

    def _write(self, sha256: str, data: Content) -> None:
        target = self._path(sha256)
        temporary = self._incoming / f"{sha256}.{next(self._counter)}"
        try:
            self._files.write_and_sync(temporary, data)
            self._files.rename(temporary, target)
        except OSError:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise

    @contextlib.contextmanager
    def _space(self, size_bytes: int, keep_free_bytes: int) -> Iterator[None]:
        with self._lock:
            free_bytes = self.free_bytes()
            # The state of the disk decides and not the size of what comes, so that what is refused is what
            # `is_accepting` says: one write may dip into the reserve, many at once may not.
            left_bytes = free_bytes - self._claimed_bytes
            if left_bytes < keep_free_bytes:
                raise DiskFullError(reserve_line(free_bytes, keep_free_bytes))
            if left_bytes < size_bytes:
                raise DiskFullError(f"the ledger's disk has no space for {size_bytes} bytes: {left_bytes} are left")
            self._claimed_bytes += size_bytes
        try:
            yield
        finally:
            with self._lock:
                self._claimed_bytes -= size_bytes
