"""What the ledger's tests share: a session with an injected clock and records of opaque bytes."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import sqlite3
from pathlib import Path
from typing import Any

from vggt_motion.ledger.directory import Ledger
from vggt_motion.ledger.jobs import JobPolicy
from vggt_motion.ledger.store import NewRecord
from vggt_motion.records import Job, JobKind, JobReport

RESULT_STREAMS = {"describe": "descriptor", "predict": "submap", "register": "constraint"}


def damage_blob(directory: Path, sha256: str, content: bytes) -> None:
    """Put other bytes in the place of a blob, wherever the ledger keeps it; nobody may serve the session."""
    with contextlib.closing(sqlite3.connect(directory / "ledger.db")) as connection:
        changed = connection.execute("UPDATE contents SET content = ? WHERE sha256 = ?", (content, sha256)).rowcount
        connection.commit()
    path = directory / "blobs" / sha256
    if path.is_file():
        path.write_bytes(content)
        changed += 1
    assert changed == 1, sha256


def stored_blobs(directory: Path) -> set[str]:
    """SHA-256 of every blob that is kept, whether a record refers to it or not."""
    with contextlib.closing(sqlite3.connect(f"{(directory / 'ledger.db').as_uri()}?mode=ro", uri=True)) as connection:
        names = {str(row[0]) for row in connection.execute("SELECT sha256 FROM contents")}
    return names | {path.name for path in (directory / "blobs").rglob("*") if path.is_file()}


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
    options.setdefault("inline_blob_bytes", 0)  # blobs are files unless a test is about those that are not
    return Ledger(
        directory,
        input_streams={"keyframe"},
        result_streams=RESULT_STREAMS,
        dead_event=dead_event,
        clock=clock or Clock(),
        time_ns=lambda: 42,
        **options,
    )
