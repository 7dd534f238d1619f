"""What a disk may hold after the power went: everything that was forced to it, and of the rest whatever it likes.

The system calls of the ledger are recorded with strace. A write is safe once a sync of its file that began after it has
ended; a name is safe once its folder was synced so. Everything else is kept, lost or torn at random in a copy.
"""

from __future__ import annotations

import os
import random
import re
import shutil
import subprocess
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import psutil

_CALLS = "write,pwrite64,pwritev,fsync,fdatasync,rename,renameat,renameat2,ftruncate"
_LINE = re.compile(r"^(\d+) +(.*)$")
_START = re.compile(r"^(\w+)\((.*)$")
_RESUMED = re.compile(r"^<\.\.\. (\w+) resumed>(.*)$")
_FILE = re.compile(r"^\d+<([^>]*)>")
_NAMES = re.compile(r'"([^"]*)"')


def is_available() -> bool:
    return shutil.which("strace") is not None


class Trace:
    """The system calls of a process from now on."""

    def __init__(self, process: psutil.Process, log: Path) -> None:
        self._log = log
        command = ["strace", "-f", "-y", "-s", "0", "-e", f"trace={_CALLS}", "-o", str(log), "-p", str(process.pid)]
        self._strace = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        assert self._strace.stderr is not None
        attached = self._strace.stderr.readline()
        assert b"attached" in attached, attached

    def end(self) -> None:
        """Wait until the traced process is gone and everything is written down."""
        self._strace.communicate(timeout=30)

    def unsafe(self, folder: Path) -> Unsafe:
        """What was not safe at the end."""
        return _unsafe(self._log.read_text(encoding="utf-8", errors="replace").splitlines(), str(folder.resolve()))


@dataclass
class Unsafe:
    """What the disk need not have."""

    writes: dict[str, list[tuple[int | None, int]]] = field(default_factory=lambda: defaultdict(list))
    names: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))  # folder -> names that came
    sync_count: int = 0

    @property
    def count(self) -> int:
        return sum(map(len, self.writes.values())) + sum(map(len, self.names.values()))


def _unsafe(lines: list[str], folder: str) -> Unsafe:
    state = Unsafe()
    pending: dict[str, str] = {}
    # What was unsafe when a sync began: only that is safe when it has ended.
    begun: dict[str, tuple[str, int, int]] = {}
    for line in lines:
        match = _LINE.match(line)
        if match is None:
            continue
        thread, text = match.groups()
        if (resumed := _RESUMED.match(text)) is not None:
            call = pending.pop(thread, "") + resumed.group(2)
        elif text.endswith("<unfinished ...>"):
            pending[thread] = text.removesuffix("<unfinished ...>")
            _begin(state, begun, thread, text)
            # Its bytes may be there already.
            if not text.startswith(("fsync", "fdatasync", "rename")):
                _note(state, pending[thread], folder)
            continue
        else:
            call = text
            _begin(state, begun, thread, text)
        start = _START.match(call)
        if start is None or " = -1" in call:
            begun.pop(thread, None)
            continue
        if start.group(1) in ("fsync", "fdatasync"):
            path, writes, names = begun.pop(thread, ("", 0, 0))
            del state.writes[path][:writes]
            del state.names[path][:names]
            state.sync_count += 1
        else:
            _note(state, call, folder)
    return state


def _begin(state: Unsafe, begun: dict[str, tuple[str, int, int]], thread: str, text: str) -> None:
    start = _START.match(text)
    if start is not None and start.group(1) in ("fsync", "fdatasync") and (file := _FILE.match(start.group(2))):
        path = file.group(1)
        begun[thread] = (path, len(state.writes[path]), len(state.names[path]))


def _note(state: Unsafe, call: str, folder: str) -> None:
    start = _START.match(call)
    if start is None:
        return
    name, rest = start.groups()
    if name.startswith("rename"):
        paths = [path for path in _NAMES.findall(rest) if path]
        target = paths[-1] if paths else ""
        if target.startswith(folder):
            state.names[str(Path(target).parent)].append(target)
        return
    file = _FILE.match(rest)
    if file is None or not file.group(1).startswith(folder):
        return
    numbers = re.findall(r"[ ,](\d+)(?=[,) ])", rest[file.end() :].split(" = ")[0] + " ")
    if name == "pwrite64" and len(numbers) >= 2:
        state.writes[file.group(1)].append((int(numbers[-1]), int(numbers[-2])))
    elif name == "write" and numbers:
        state.writes[file.group(1)].append((None, int(numbers[-1])))


def crash_image(folder: Path, target: Path, unsafe: Unsafe, generator: random.Random) -> list[str]:
    """Copy a ledger's folder as a disk may hold it after the power went; what was lost, one line each."""
    shutil.copytree(folder, target)
    root = str(folder.resolve())
    lost = []
    for shared in target.glob("*-shm"):
        shared.unlink()  # never on a disk
    for path, writes in unsafe.writes.items():
        file = target / os.path.relpath(path, root)
        if not file.is_file() or not writes:
            continue
        size = file.stat().st_size
        with file.open("r+b") as stream:
            for offset, length in writes:
                fate = generator.choice(["kept", "lost", "torn"])
                if fate == "kept" or length == 0:
                    continue
                begin = 0 if offset is None else offset
                if fate == "torn":
                    begin += generator.randrange(length)
                end = size if offset is None else min(size, offset + length)
                if begin < end:
                    stream.seek(begin)
                    stream.write(bytes(end - begin))
                    lost.append(f"{fate}: {file.name} {begin}..{end}")
            if generator.random() < 0.5 and any(offset is not None for offset, _ in writes):
                last, length = max((offset or 0, length) for offset, length in writes)
                if last + length >= size:
                    stream.truncate(last + generator.randrange(length + 1))
                    lost.append(f"cut off: {file.name} at {stream.tell()}")
    for names in unsafe.names.values():
        for path in names:
            file = target / os.path.relpath(path, root)
            if file.is_file() and generator.random() < 0.5:
                file.unlink()
                lost.append(f"name lost: {file.name}")
    return lost
