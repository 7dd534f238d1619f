"""Long payloads between processes of one machine: left as files in a folder in memory, instead of sent.

Over TCP through the router the kernel copies a payload four times and Zenoh several times more; a file in memory is
written once and read once. It carries requests and answers only: if anything is not as expected they are sent as
messages, so that nothing depends on it. What processes that were killed have left behind is removed by the others.

The files are not Zenoh's shared memory: that can be taken away from a reader, and stays when its writer is killed.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import itertools
import logging
import os
import secrets
import stat
import threading
import time
from collections import deque
from pathlib import Path
from typing import Final

from vggt_motion.bus import calls, codec
from vggt_motion.bus.wire import Payload, joined, parts_of
from vggt_motion.config import BusConfig
from vggt_motion.errors import BusUnavailableError, CodecError
from vggt_motion.locks import try_lock

_log = logging.getLogger(__name__)

MIN_PARCEL_BYTES: Final = 64 * 2**10
"""Shorter payloads are sent: measured, a file costs more than a message of 60 kB, and less than one of 100 kB."""

_MEMORY = Path("/dev/shm")  # where every Linux has memory as a file system
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_KEPT_FREE = 3  # as many times a parcel's size must be free in memory
_ANSWER_LIFE_S = 60.0
_MAX_IDLE_BYTES = 16 * 2**20
_MAX_ATTACHMENT_BYTES = 256  # of one that says where a parcel is
_MAX_PARTS = 512  # in one call; Linux allows 1024
_JOIN_ATTEMPTS = 100


class Parcel:
    """A file that this process has left for another."""

    def __init__(self, path: str, descriptor: int) -> None:
        self._path = path
        self._descriptor: int | None = descriptor
        self.capacity_bytes = 0  # length of the file, which may have held more before
        self.attachment = b""
        self.ends_s = 0.0

    def rename(self, path: str) -> None:
        """Take the file from whoever still knows its name, before it is filled again.

        Raises:
            OSError: it is not there any more.
        """
        os.rename(self._path, path)  # noqa: PTH104 (here and below: a Path costs as much as the call)
        self._path = path

    def fill(self, payload: Payload, folder_id: str) -> None:
        """Put a payload into the file.

        Raises:
            OSError: there is no space.
        """
        assert self._descriptor is not None
        written = os.pwritev(self._descriptor, parts_of(payload)[:_MAX_PARTS], 0)
        if written < len(payload):
            rest = memoryview(joined(payload))[written:]
            while rest:
                count = os.pwrite(self._descriptor, rest, len(payload) - len(rest))
                rest = rest[count:]
        self.capacity_bytes = max(self.capacity_bytes, len(payload))
        self.attachment = codec.encode(calls.Parcel(folder_id, self._path.rpartition(os.sep)[2], len(payload)))

    def seal(self) -> None:
        """It is not filled again."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def remove(self) -> None:
        """Delete the file, if its reader has not."""
        self.seal()
        with contextlib.suppress(OSError):
            os.unlink(self._path)  # noqa: PTH108


class Parcels:
    """Leaves nothing: every payload is sent. What it is for stands at :class:`MemoryParcels`."""

    greeting: bytes | None = None
    """Attachment of a message that carries its payload itself."""

    def leave(self, payload: Payload) -> Parcel | None:
        """Leave a payload for the other side, which says that it uses the same folder; None: send it."""
        return None

    def take_back(self, parcel: Parcel, *, is_read: bool) -> None:
        """End of what was left; ``is_read``: the other side has answered, and does not look at it any more."""

    def leave_answer(self, payload: Payload) -> Parcel | None:
        """As :meth:`leave`; it is removed by its reader, or after a while."""
        return None

    def is_near(self, attachment: bytes | None) -> bool:
        """Whether a message comes from a process that uses the same folder."""
        return False

    def size_bytes(self, attachment: bytes | None) -> int:
        """Length of the payload that a message stands for; 0 if it carries it itself."""
        if attachment is None or attachment == self.greeting:
            return 0
        parcel = _decoded(attachment)
        return 0 if parcel is None else parcel.size_bytes

    def take(self, payload: bytes, attachment: bytes | None, *, is_last_reader: bool = False) -> bytes:
        """The payload of a message, or what was left in its stead.

        Args:
            payload: of the message.
            attachment: of the message.
            is_last_reader: nobody else reads it: delete the file.

        Raises:
            BusUnavailableError: it cannot be read; the other side is to send it.
        """
        if self.size_bytes(attachment):
            raise BusUnavailableError("what was left for this process cannot be read: send it")
        return payload

    def close(self) -> None:
        """Remove what nobody has taken."""


class MemoryParcels(Parcels):
    """Leaves long payloads in a folder in memory. Thread-safe.

    All processes of one user that join one session at one endpoint use the same folder. Its identity is that of the
    inode, on this machine since it was started: two sides that name the same one look at the same folder, through
    whatever containers. Each process holds a lock on a file there: who gets the lock of another may clear up after it,
    and the folder goes with the last one.
    """

    def __init__(self, folder: Path) -> None:
        """Make or join the folder.

        Raises:
            OSError: that is not possible here.
        """
        self._folder = folder
        self._folder_name = str(folder)
        self._prefix = secrets.token_hex(8)
        self._numbers = itertools.count()
        self._lock = threading.Lock()
        self._idle: list[Parcel] = []  # requests that were answered
        self._answers: deque[Parcel] = deque()
        self._timer: threading.Timer | None = None  # that removes the oldest answer when its time is over
        self._is_closed = False
        self._lock_descriptor = _joined(folder, self._prefix)
        try:
            self._folder_id = _identity(folder)
        except OSError:
            os.close(self._lock_descriptor)
            _clear_up(folder)
            raise
        self.greeting = codec.encode(calls.Parcel(self._folder_id))
        _clear_up(folder)
        for other in folder.parent.glob(f"{folder.name.rsplit('-', 1)[0]}-*"):
            _clear_up(other)

    def leave(self, payload: Payload) -> Parcel | None:
        """See :meth:`Parcels.leave`."""
        if len(payload) < MIN_PARCEL_BYTES or self._is_closed:
            return None
        with self._lock:
            parcel = self._idle.pop() if self._idle else None
        try:
            if parcel is None or parcel.capacity_bytes < len(payload):
                space = os.statvfs(self._folder)
                if space.f_bavail * space.f_frsize < _KEPT_FREE * len(payload):
                    raise OSError(errno.ENOSPC, "little space is left")
            path = f"{self._folder_name}{os.sep}{self._prefix}-{next(self._numbers)}"
            if parcel is None:
                parcel = Parcel(path, os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
            else:
                parcel.rename(path)
            parcel.fill(payload, self._folder_id)
            if self._is_closed:
                raise OSError(errno.EBADF, "closed meanwhile")
        except OSError as error:
            if parcel is not None:
                parcel.remove()
            _log.debug("no parcel", extra={"folder": str(self._folder), "reason": error.strerror})
            return None
        return parcel

    def take_back(self, parcel: Parcel, *, is_read: bool) -> None:
        """See :meth:`Parcels.take_back`. The file is used again: its memory need not be found and cleared anew."""
        with self._lock:
            kept_bytes = parcel.capacity_bytes + sum(idle.capacity_bytes for idle in self._idle)
            if is_read and not self._is_closed and kept_bytes <= _MAX_IDLE_BYTES:
                self._idle.append(parcel)
                return
        parcel.remove()

    def leave_answer(self, payload: Payload) -> Parcel | None:
        """See :meth:`Parcels.leave_answer`."""
        parcel = self.leave(payload)
        if parcel is None:
            return None
        parcel.seal()
        parcel.ends_s = time.monotonic() + _ANSWER_LIFE_S
        with self._lock:
            if not self._is_closed:
                self._answers.append(parcel)
                if self._timer is None:
                    self._start_timer(_ANSWER_LIFE_S)
                return parcel
        parcel.remove()
        return None

    def is_near(self, attachment: bytes | None) -> bool:
        """See :meth:`Parcels.is_near`."""
        if attachment is None or attachment == self.greeting:
            return attachment is not None
        return self._parcel(attachment) is not None

    def take(self, payload: bytes, attachment: bytes | None, *, is_last_reader: bool = False) -> bytes:
        """See :meth:`Parcels.take`."""
        if attachment is None or attachment == self.greeting:
            return payload
        parcel = self._parcel(attachment)
        if parcel is None:
            return super().take(payload, attachment)
        path = f"{self._folder_name}{os.sep}{parcel.name}"
        try:
            content = _read(path, parcel.size_bytes)
            if is_last_reader:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(path)  # noqa: PTH108
        except OSError as error:
            raise BusUnavailableError(f"what was left for this process cannot be read ({error.strerror})") from None
        if len(content) != parcel.size_bytes:
            raise BusUnavailableError(f"{len(content)} of {parcel.size_bytes} bytes were left for this process")
        return content

    def close(self) -> None:
        """Remove what nobody has taken, and the folder after the last parcel."""
        with self._lock:
            if self._is_closed:
                return
            self._is_closed = True
            if self._timer is not None:
                self._timer.cancel()
            kept = [*self._answers, *self._idle]
            self._answers.clear()
            self._idle.clear()
        for parcel in kept:
            parcel.remove()
        os.close(self._lock_descriptor)
        _clear_up(self._folder)

    def _start_timer(self, seconds: float) -> None:
        self._timer = threading.Timer(max(0.0, seconds), self._remove_overdue)
        self._timer.daemon = True
        self._timer.start()

    def _remove_overdue(self) -> None:
        now_s = time.monotonic()
        overdue: list[Parcel] = []
        with self._lock:
            while self._answers and self._answers[0].ends_s <= now_s:
                overdue.append(self._answers.popleft())
            self._timer = None
            if self._answers and not self._is_closed:
                self._start_timer(self._answers[0].ends_s - now_s)
        for parcel in overdue:
            parcel.remove()

    def _parcel(self, attachment: bytes) -> calls.Parcel | None:
        parcel = _decoded(attachment)
        return parcel if parcel is not None and parcel.folder_id == self._folder_id and parcel.name else None


def open_parcels(config: BusConfig) -> Parcels:
    """The parcels of a session, as far as this machine and the configuration allow them."""
    if not config.local_parcels or not _MEMORY.is_dir():
        return Parcels()
    digest = hashlib.sha256(f"{config.endpoint}\0{config.session}".encode()).hexdigest()[:16]
    try:
        return MemoryParcels(_MEMORY / f"vggt_motion-{os.geteuid()}-{digest}")
    except OSError as error:
        _log.info("payloads are sent to processes of this machine too", extra={"reason": str(error)})
        return Parcels()


def _decoded(attachment: bytes) -> calls.Parcel | None:
    """What an attachment says; None: it is none of a parcel."""
    return _remembered(attachment) if len(attachment) <= _MAX_ATTACHMENT_BYTES else None


@functools.lru_cache(64)
def _remembered(attachment: bytes) -> calls.Parcel | None:
    """Each is looked at several times."""
    try:
        return codec.decode(calls.Parcel, attachment)
    except CodecError:
        return None


def _read(path: str, size_bytes: int) -> bytes:
    """The first bytes of a plain file; whatever else stands under the name is not waited for."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or found.st_size < size_bytes:
            raise OSError(errno.EINVAL, "not the file that was spoken of")
        content = os.read(descriptor, size_bytes)
        if os.lstat(path).st_ino != found.st_ino:  # its writer takes the name away before it uses the file again
            raise OSError(errno.ESTALE, "not the file that was spoken of any more")
        return content
    finally:
        os.close(descriptor)


def _joined(folder: Path, prefix: str) -> int:
    """Make the folder and a lock in it that says that this process uses it; returns the descriptor that holds it."""
    lock = folder / f"{prefix}.lock"
    for _ in range(_JOIN_ATTEMPTS):
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        try:
            _check_own(folder)
            descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        except FileNotFoundError:
            continue  # the last one of before has just left
        if try_lock(descriptor) and lock.exists():
            return descriptor
        os.close(descriptor)  # somebody cleared it up before it was held
    raise OSError(errno.EAGAIN, "others keep clearing it up", str(folder))


def _check_own(folder: Path) -> None:
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o077:
        raise PermissionError(errno.EPERM, "not a folder of our own", str(folder))


def _identity(folder: Path) -> str:
    found = folder.stat()
    boot_id = _BOOT_ID.read_text(encoding="ascii").strip()
    return hashlib.sha256(f"{boot_id} {found.st_dev} {found.st_ino}".encode()).hexdigest()[:32]


def _clear_up(folder: Path) -> None:
    """Remove what processes that are gone have left, and the folder if nobody uses it."""
    with contextlib.suppress(OSError):
        _check_own(folder)  # the name alone says nothing: anybody may make a link of it
        for lock in folder.glob("*.lock"):
            with contextlib.suppress(OSError):  # of one, which somebody else may be clearing up
                _clear_up_after(folder, lock)
        folder.rmdir()


def _clear_up_after(folder: Path, lock: Path) -> None:
    descriptor = os.open(lock, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        if try_lock(descriptor):
            for path in (*folder.glob(f"{lock.stem}-*"), lock):
                path.unlink(missing_ok=True)
    finally:
        os.close(descriptor)
