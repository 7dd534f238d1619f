"""What a disk may hold after the power went: everything that was forced to it, and of the rest whatever it likes.

Installed in a process that serves a ledger, :class:`DiskLog` writes down every write, truncation, sync, rename and
deletion below the ledger's folder: those of SQLite through its VFS, those of the blobs through ``FileOperations``.
From that log :func:`crash_image` makes the folder as it may be found when the power went after any of these operations:
a write is safe once a sync of its file that began after it has ended, a name once its folder was synced so. Everything
else is kept, lost or torn at random, each write for itself.
"""

from __future__ import annotations

import ctypes
import json
import os
import random
import shutil
import sys
import threading
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SECTOR_BYTES = 512
LOG_VARIABLE = "VGGT_MOTION_TEST_POWER_LOG"
CUT_VARIABLE = "VGGT_MOTION_TEST_POWER_CUT"

_Pointer = ctypes.c_void_p
_Write = ctypes.CFUNCTYPE(ctypes.c_int, _Pointer, _Pointer, ctypes.c_int, ctypes.c_int64)
_Truncate = ctypes.CFUNCTYPE(ctypes.c_int, _Pointer, ctypes.c_int64)
_Sync = ctypes.CFUNCTYPE(ctypes.c_int, _Pointer, ctypes.c_int)
# The name as a pointer: SQLite keeps it until the file is closed (sqlite3_vfs.xOpen), a copy in Python is gone by then.
_Open = ctypes.CFUNCTYPE(ctypes.c_int, _Pointer, _Pointer, _Pointer, ctypes.c_int, _Pointer)
_Delete = ctypes.CFUNCTYPE(ctypes.c_int, _Pointer, ctypes.c_char_p, ctypes.c_int)


class _Vfs(ctypes.Structure):
    _fields_ = (
        ("version", ctypes.c_int),
        ("file_size", ctypes.c_int),
        ("max_path", ctypes.c_int),
        ("next", _Pointer),
        ("name", ctypes.c_char_p),
        ("data", _Pointer),
        ("open", _Open),
        ("delete", _Delete),
    )


class _Methods(ctypes.Structure):
    """``sqlite3_io_methods``: what is not hooked is copied as it is."""

    _fields_ = (
        ("version", _Pointer),
        ("close", _Pointer),
        ("read", _Pointer),
        ("write", _Write),
        ("truncate", _Truncate),
        ("sync", _Sync),
        ("others", _Pointer * 13),
    )


class _File(ctypes.Structure):
    _fields_ = (("methods", ctypes.POINTER(_Methods)),)


def sqlite_library() -> Any:
    """The library that the module ``sqlite3`` of this process uses; None if it cannot be reached."""
    import sqlite3

    for name in ("libsqlite3.so.0", "libsqlite3.so"):
        try:
            library = ctypes.CDLL(name)
        except OSError:
            continue
        library.sqlite3_libversion.restype = ctypes.c_char_p
        library.sqlite3_vfs_find.restype = ctypes.POINTER(_Vfs)
        maps = Path("/proc/self/maps").read_text(encoding="ascii").splitlines()
        is_one = len({line.split()[-1] for line in maps if "libsqlite3" in line}) == 1
        if is_one and library.sqlite3_libversion().decode() == sqlite3.sqlite_version:
            return library
    return None


def _folder_of(path: str) -> str:
    return str(Path(path).parent)


@dataclass(frozen=True)
class Operation:
    """One thing that happened below the folder, in order."""

    kind: str  # write, truncate, sync, rename, unlink, sync_folder, note
    path: str = ""  # relative to the folder
    offset: int = 0  # of a write; the length of a truncation; of a sync, the operations before it that it covers
    data: bytes = b""  # written, or a note
    target: str = ""  # of a rename


class DiskLog:
    """Writes down what happens below a folder; to be installed once in a process, before the ledger is opened."""

    def __init__(self, folder: Path, *, file: Path | None = None, cut_at_sync: int = 0) -> None:
        """Begin.

        Args:
            folder: of the ledger; created if it is not there.
            file: the operations are also appended here.
            cut_at_sync: when so many syncs of the database's files have begun, nothing more happens in this process:
                every thread that touches the disk stands still, and ``file`` with the suffix ``.cut`` appears.
        """
        self.folder = folder.resolve()
        self.operations: list[Operation] = []
        self._file = None if file is None else file.open("ab", buffering=0)
        self._marker = None if file is None else file.with_suffix(".cut")
        self._cut_at_sync = cut_at_sync
        self._sync_count = 0
        self._lock = threading.RLock()
        self._paths: dict[int, str] = {}
        self._originals: dict[int, Any] = {}  # address of our methods -> those of SQLite
        self._kept: list[Any] = []  # callbacks and tables, which SQLite refers to

    def add(self, operation: Operation) -> None:
        with self._lock:
            self.operations.append(operation)
            if self._file is not None:
                head = [operation.kind, operation.path, operation.offset, len(operation.data), operation.target]
                self._file.write(json.dumps(head).encode() + b"\n" + operation.data)

    def note(self, text: str) -> None:
        """Remember a moment, such as an acknowledgement."""
        self.add(Operation("note", data=text.encode()))

    def begin_sync(self) -> int:
        """Number of operations that a sync which begins now covers."""
        with self._lock:
            return len(self.operations)

    def relative(self, path: str) -> str | None:
        absolute = str(Path(path).resolve())
        root = f"{self.folder}{os.sep}"
        return absolute.removeprefix(root) if absolute.startswith(root) else None

    def install(self) -> None:
        """Hook SQLite and the blobs' file operations of this process, for good."""
        if self._marker is not None and self.folder.is_dir():
            shutil.copytree(self.folder, self._marker.with_suffix(".base"), ignore=shutil.ignore_patterns("*-shm"))
        self._hook_sqlite()
        self._hook_files()

    def _hook_files(self) -> None:
        from vggt_motion.ledger import files

        log, real = self, files.FileOperations

        class Logged(real):  # type: ignore[misc, valid-type]
            def write_and_sync(self, path: Path, data: bytes) -> None:
                name = log.relative(str(path))
                if name is not None:
                    log.add(Operation("write", name, 0, data))
                begun = log.begin_sync()
                super().write_and_sync(path, data)
                if name is not None:
                    log.add(Operation("sync", name, begun))

            def write_blocks(self, path: Path, descriptor: int, offset_bytes: int, blocks: memoryview) -> None:
                name = log.relative(str(path))
                if name is not None:
                    log.add(Operation("write", name, offset_bytes, bytes(blocks)))
                super().write_blocks(path, descriptor, offset_bytes, blocks)

            def sync_data(self, path: Path, descriptor: int) -> None:
                name = log.relative(str(path))
                begun = log.begin_sync()
                super().sync_data(path, descriptor)
                if name is not None:
                    log.add(Operation("sync", name, begun))

            def rename(self, source: Path, target: Path) -> None:
                super().rename(source, target)
                names = log.relative(str(source)), log.relative(str(target))
                if names[0] is not None and names[1] is not None:
                    log.add(Operation("rename", names[0], target=names[1]))

            def sync_folder(self, folder: Path) -> None:
                begun = log.begin_sync()
                super().sync_folder(folder)
                name = log.relative(str(folder / "x"))
                if name is not None:
                    log.add(Operation("sync_folder", _folder_of(name), begun))

        files.FileOperations = Logged  # type: ignore[misc]
        for module in list(sys.modules.values()):
            if getattr(module, "FileOperations", None) is real:
                module.FileOperations = Logged  # type: ignore[attr-defined]

    def _hook_sqlite(self) -> None:
        library = sqlite_library()
        assert library is not None, "SQLite cannot be hooked here"
        vfs = library.sqlite3_vfs_find(None).contents
        real_open, real_delete = _Open.from_buffer_copy(vfs.open), _Delete.from_buffer_copy(vfs.delete)

        def opened(self_: int, name: int | None, file: int, flags: int, out_flags: int) -> int:
            code = int(real_open(self_, name, file, flags, out_flags))
            path = None if name is None else self.relative(os.fsdecode(ctypes.string_at(name)))
            if code == 0 and path is not None:
                self._hook_file(file, path)
            return code

        def deleted(self_: int, name: bytes, sync_folder: int) -> int:
            code = int(real_delete(self_, name, sync_folder))
            path = self.relative(os.fsdecode(name))
            if code == 0 and path is not None:
                self.add(Operation("unlink", path))
            return code

        callbacks = _Open(opened), _Delete(deleted)
        self._kept += [callbacks, real_open, real_delete]
        vfs.open, vfs.delete = callbacks

    def _hook_file(self, file: int, path: str) -> None:
        handle = ctypes.cast(file, ctypes.POINTER(_File)).contents
        real = handle.methods.contents
        address = ctypes.addressof(real)
        with self._lock:
            self._paths[file] = path
            if address not in self._originals:
                self._originals[address] = self._hooked(real)
            handle.methods = ctypes.pointer(self._originals[address])

    def _hooked(self, real: _Methods) -> _Methods:
        hooked = _Methods()
        ctypes.memmove(ctypes.addressof(hooked), ctypes.addressof(real), ctypes.sizeof(_Methods))
        calls = _Methods()
        ctypes.memmove(ctypes.addressof(calls), ctypes.addressof(real), ctypes.sizeof(_Methods))

        def write(file: int, data: int, length: int, offset: int) -> int:
            self.add(Operation("write", self._paths[file], offset, ctypes.string_at(data, length)))
            return int(calls.write(file, data, length, offset))

        def truncate(file: int, length: int) -> int:
            self.add(Operation("truncate", self._paths[file], length))
            return int(calls.truncate(file, length))

        def sync(file: int, flags: int) -> int:
            begun = self.begin_sync()
            self._maybe_cut()
            code = int(calls.sync(file, flags))
            if code == 0:
                self.add(Operation("sync", self._paths[file], begun))
            return code

        hooked.write, hooked.truncate, hooked.sync = _Write(write), _Truncate(truncate), _Sync(sync)
        self._kept += [hooked, calls, real]
        return hooked

    def _maybe_cut(self) -> None:
        with self._lock:
            self._sync_count += 1
            if self._sync_count != self._cut_at_sync or self._marker is None:
                return
            self._marker.touch()
            # The lock stays ours: no operation ends any more, and so nothing more is acknowledged.
            threading.Event().wait()


def read_log(file: Path) -> list[Operation]:
    """The operations that a process wrote down; a torn last one is left out."""
    content, position, found = file.read_bytes(), 0, []
    while (end := content.find(b"\n", position)) >= 0:
        kind, path, offset, length, target = json.loads(content[position:end])
        data = content[end + 1 : end + 1 + length]
        if len(data) < length:
            break
        found.append(Operation(kind, path, offset, data, target))
        position = end + 1 + length
    return found


@dataclass
class _Content:
    """One file, under whatever name: what is safe, and what came since."""

    safe: bytes = b""
    pending: list[tuple[int, Operation]] = field(default_factory=list)


class _Disk:
    def __init__(self, base: dict[str, bytes]) -> None:
        self.files = {name: _Content(content) for name, content in base.items()}
        self.safe_names: dict[str, _Content] = dict(self.files)
        self.changed: dict[str, list[int]] = defaultdict(list)  # folder -> operations that changed its names
        self.changes: dict[int, tuple[str, _Content | None]] = {}  # operation -> name and what it stands for since

    def apply(self, number: int, operation: Operation) -> None:
        match operation.kind:
            case "write" | "truncate":
                if operation.path not in self.files:
                    self.files[operation.path] = _Content()
                    self._name(number, operation.path, self.files[operation.path])
                self.files[operation.path].pending.append((number, operation))
            case "sync":
                content = self.files.get(operation.path)
                if content is None:
                    return
                done = [entry for entry in content.pending if entry[0] < operation.offset]
                content.pending = content.pending[len(done) :]
                for _, write in done:
                    content.safe = _applied(content.safe, write)
                if _folder_of(operation.path) == ".":
                    # SQLite syncs the folder with the first sync of a file that it made.
                    self.safe_names[operation.path] = content
            case "rename":
                content = self.files.pop(operation.path)
                self.files[operation.target] = content
                self._name(number, operation.path, None)
                self._name(number, operation.target, content)
            case "unlink":
                self.files.pop(operation.path, None)
                self._name(number, operation.path, None)
            case "sync_folder":
                for change in [n for n in self.changed[operation.path] if n < operation.offset]:
                    self._settle(change)
                    self.changed[operation.path].remove(change)

    def _name(self, number: int, name: str, content: _Content | None) -> None:
        key = 2 * number + (0 if content is None else 1)
        self.changes[key] = name, content
        self.changed[_folder_of(name)].append(key // 2)

    def _settle(self, number: int) -> None:
        for key in (2 * number, 2 * number + 1):
            if key in self.changes:
                name, content = self.changes.pop(key)
                if content is None:
                    self.safe_names.pop(name, None)
                else:
                    self.safe_names[name] = content

    def found(self, generator: random.Random) -> tuple[dict[str, bytes], int]:
        """Files as they may be found, and how many writes and names were lost or torn."""
        damaged = 0
        names = dict(self.safe_names)
        for key in sorted(self.changes):
            name, content = self.changes[key]
            if generator.random() < 0.5:
                damaged += 1
            elif content is None:
                names.pop(name, None)
            else:
                names[name] = content
        files = {}
        for name, content in names.items():
            now = content.safe
            for _, write in content.pending:
                fate = generator.choice(["kept", "lost", "torn"])
                if fate == "kept":
                    now = _applied(now, write)
                    continue
                damaged += 1
                if fate == "torn" and write.kind == "write":
                    now = _torn(now, write, generator)
            files[name] = now
        return files, damaged


def _applied(content: bytes, operation: Operation) -> bytes:
    if operation.kind == "truncate":
        return content[: operation.offset].ljust(operation.offset, b"\0")
    return (
        content[: operation.offset].ljust(operation.offset, b"\0")
        + operation.data
        + content[operation.offset + len(operation.data) :]
    )


def _torn(content: bytes, write: Operation, generator: random.Random) -> bytes:
    """Some sectors of a write arrived; what the file grew by without them reads as zeros."""
    grown = content.ljust(write.offset + len(write.data), b"\0")
    for begin in range(0, len(write.data), SECTOR_BYTES):
        if generator.random() < 0.5:
            part = write.data[begin : begin + SECTOR_BYTES]
            at = write.offset + begin
            grown = grown[:at] + part + grown[at + len(part) :]
    return grown


def read_base(file: Path) -> dict[str, bytes]:
    """The files of the folder that were there, and safe, before the log began."""
    folder = file.with_suffix(".base")
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def crash_image(operations: Sequence[Operation], base: dict[str, bytes], target: Path, generator: random.Random) -> int:
    """Make a folder as a disk may hold it when the power went after the last of these operations.

    Returns:
        How many writes and names were lost or torn.
    """
    disk = _Disk(base)
    for number, operation in enumerate(operations):
        disk.apply(number, operation)
    files, damaged = disk.found(generator)
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for name, content in files.items():
        path = target / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return damaged


def notes(operations: Sequence[Operation]) -> Iterator[str]:
    """The texts that were noted."""
    for operation in operations:
        if operation.kind == "note":
            yield operation.data.decode()


def workload(folder: Path, log: DiskLog, *, without: str = "") -> None:
    """Appends, blobs of every kind, jobs and checkpoints; every acknowledgement is noted with its blobs.

    Without the syncs of "rows" or "packs" it is no durable ledger any more.
    """
    from concurrent.futures import ThreadPoolExecutor

    from ledger_helpers import open_ledger, predict, record
    from vggt_motion.ledger.files import FileOperations
    from vggt_motion.ledger.store import Blob
    from vggt_motion.records import JobKind

    class WithoutSyncs(FileOperations):
        def sync_data(self, path: Path, descriptor: int) -> None:
            pass

    generator = random.Random(1)
    files = WithoutSyncs() if without == "packs" else FileOperations()
    ledger = open_ledger(folder, packed_blob_bytes=3000, inline_bytes=600, files=files)
    for statement in (
        "PRAGMA wal_autocheckpoint = 12",
        *(("PRAGMA synchronous = OFF",) if without == "rows" else ()),
    ):
        ledger.rows._writer.execute(statement)
    ledger.rows.read(lambda reader: reader.positions())

    def append(number: int) -> None:
        # none, among the rows, in a pack, in a pack and a file, in a file
        sizes = ((), (100,), (2500, 2000), (2500, 4000), (9000,))[number % 5]
        data = [Blob.of(random.Random(100 * number + size).randbytes(size)) for size in sizes]
        entries = [blob.entry for blob in data]
        ledger.store.append(record("keyframe", f"k{number}", b"%d" % number * 50), data, entries)
        log.note(" ".join(("keyframe", f"k{number}", *(entry.sha256 for entry in entries))))

    for number in range(16):
        append(number)
    with ThreadPoolExecutor(6) as pool:
        list(pool.map(append, range(16, 40)))
    ledger.jobs.submit([predict(f"s{number}") for number in range(4)])
    for number in range(4):
        lease = ledger.jobs.claim([JobKind.PREDICT], [], "inference/a")
        assert lease is not None
        blob = Blob.of(generator.randbytes(500 + 3000 * number))
        job_id = lease.job.job_id
        ledger.jobs.done(job_id, lease.lease_id, record("submap", job_id), [blob], [blob.entry])
        log.note(f"submap {job_id} {blob.entry.sha256}")
    ledger.close()


def _main() -> None:
    folder, file = Path(sys.argv[1]), Path(sys.argv[2])
    folder.mkdir(parents=True)
    log = DiskLog(folder, file=file)
    log.install()
    workload(folder, log, without=sys.argv[3] if len(sys.argv) > 3 else "")


if __name__ == "__main__":
    _main()
