"""What the ledger's tests share: a session with an injected clock and records of opaque bytes."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import sqlite3
from pathlib import Path
from typing import Any

from vggt_motion.direct import aligned_up
from vggt_motion.ledger.directory import Ledger
from vggt_motion.ledger.jobs import JobPolicy
from vggt_motion.ledger.sqlite import read_only
from vggt_motion.ledger.store import NewRecord
from vggt_motion.records import Job, JobKind, JobReport

RESULT_STREAMS = {"describe": "descriptor", "predict": "submap", "register": "constraint"}


def in_pack(*batches: bytes) -> bytes:
    """What a pack holds after these were written, one after the other: each from the beginning of a block."""
    return b"".join(content.ljust(aligned_up(len(content)), b"\0") for content in batches)


def damage_blob(directory: Path, sha256: str, content: bytes) -> None:
    """Put other bytes in the place of a blob, wherever the ledger keeps it; nobody may serve the session."""
    with read_only(directory / "ledger.db") as reader:
        place, is_row = reader.find_place(sha256), reader.find_content(sha256) is not None
    if is_row:
        with contextlib.closing(sqlite3.connect(directory / "ledger.db")) as connection, connection:
            connection.execute("UPDATE contents SET content = ? WHERE sha256 = ?", (content, sha256))
        return
    path = directory / "blobs" / sha256
    assert path.is_file() == (place is None), sha256
    if place is None:
        path.write_bytes(content)
        return
    with (directory / "blobs" / "packs" / f"{place.pack:08d}.pack").open("r+b") as file:
        file.seek(place.offset_bytes)
        file.write(content.ljust(place.size_bytes, b"\0")[: place.size_bytes])


def stored_blobs(directory: Path) -> set[str]:
    """Every blob that is kept, whether a record refers to it or not: SHA-256, and how long each pack is."""
    with read_only(directory / "ledger.db") as reader:
        names = {entry.sha256 for entry, _ in reader.blobs()} | {sha256 for sha256, _ in reader.contents()}
    paths = [path for path in (directory / "blobs").rglob("*") if path.is_file()]
    return names | {f"{path.name} {path.stat().st_size}" for path in paths}


class Clock:
    """Seconds that only move when told to."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


def record(stream: str, record_id: str, content: bytes = b"content", identity: bytes | None = None) -> NewRecord:
    """A record whose identity is its content, unless said otherwise."""
    digest = hashlib.sha256(content if identity is None else identity).digest()
    return NewRecord(stream, record_id, "test.Record", content, digest)


def dead_event(report: JobReport) -> NewRecord:
    """The event of a dead job in a form that is easy to read back."""
    text = f"{report.job_id}|{report.last_reason}|{report.last_traceback}".encode()
    return record("event", f"job_dead/{report.job_id}", text)


def predict(job_id: str, **options: Any) -> Job:
    """A job of kind predict."""
    return Job(job_id, JobKind.PREDICT, options.pop("payload", b"spec"), "test.Spec", **options)


def open_ledger(directory: Path, clock: Clock | None = None, **options: Any) -> Ledger:
    """A session whose leases are numbered."""
    counter = itertools.count()
    options.setdefault("new_lease_id", lambda: f"lease{next(counter)}")
    options.setdefault("policy", JobPolicy())
    options.setdefault("packed_blob_bytes", 0)  # blobs are files unless a test is about those that are not
    options.setdefault("inline_bytes", 0)
    return Ledger(
        directory,
        input_streams={"keyframe"},
        result_streams=RESULT_STREAMS,
        dead_event=dead_event,
        clock=clock or Clock(),
        time_ns=lambda: 42,
        **options,
    )
