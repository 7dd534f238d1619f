"""Single bits of the database are wrong: the check says so, breaks nothing more, and nothing ends in a traceback."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ledger_helpers import Clock, open_ledger, predict, record
from ledger_processes import event, keyframe
from vggt_motion.bus.ledger import append_request
from vggt_motion.errors import LedgerError
from vggt_motion.ledger.admission import admitted
from vggt_motion.ledger.check import CheckReport, check
from vggt_motion.ledger.sessions import SessionIdentity, prepare_session, summary_of
from vggt_motion.records import JobKind

FLIPS = int(os.environ.get("VGGT_MOTION_FUZZ_CASES", "300"))
TABLES = ("meta", "streams", "records", "blobs", "record_blobs", "contents", "jobs", "leases")
IMAGES = (b"i" * 40, b"p" * 150, b"f" * 1000)  # among the rows, in a pack, a file


def make_session(directory: Path) -> None:
    """Records with blobs of every kind and without, and jobs in every state."""
    prepare_session(directory, SessionIdentity("street.mp4", "video:1", "config:1"))
    ledger = open_ledger(directory, Clock(), inline_bytes=100, packed_blob_bytes=500)
    for index, image in enumerate(IMAGES):
        frame = keyframe(index, image)
        ledger.store.append(*admitted(append_request("keyframe", frame.keyframe_id, frame, [image])))
    for index in range(3):
        ledger.store.append(*admitted(append_request("event", f"event-{index}", event(index), [])))
    ledger.store.append(record("graph", "opaque"), [b"opaque blob"], [])
    ledger.jobs.submit([predict(f"s{index}", model="sfm", payload=b"spec %d" % index) for index in range(6)])
    for name in ("done", "failed", "dead", "leased"):
        lease = ledger.jobs.claim([JobKind.PREDICT], ["sfm"], "inference/a", claim_id=f"claim-{name}")
        assert lease is not None
        if name == "done":
            ledger.jobs.done(lease.job.job_id, lease.lease_id, record("submap", lease.job.job_id), [b"depth"])
        elif name != "leased":
            ledger.jobs.fail(lease.job.job_id, lease.lease_id, "why", "line", is_permanent=name == "dead")
    ledger.jobs.cancel(["s4"])
    ledger.close()
    with contextlib.closing(sqlite3.connect(directory / "ledger.db")) as connection:
        # Small pages, so that there is little free space among what is to be hit.
        for statement in ("PRAGMA journal_mode = DELETE", "PRAGMA page_size = 512", "VACUUM"):
            connection.execute(statement)


def rows_of(database: Path) -> dict[str, list[Any] | str]:
    """Every row of every table as plain SQL gives it, past the indexes; or why it gives none."""
    found: dict[str, list[Any] | str] = {}
    for table in TABLES:
        try:
            uri = f"{database.as_uri()}?immutable=1"
            with contextlib.closing(sqlite3.connect(uri, uri=True)) as connection:
                connection.text_factory = lambda text: ("text", text)
                found[table] = sorted(connection.execute(f"SELECT * FROM {table} NOT INDEXED").fetchall(), key=repr)
        except (sqlite3.Error, UnicodeDecodeError) as error:
            found[table] = repr(error)
    return found


def files_of(directory: Path) -> dict[str, bytes]:
    paths = (path for path in directory.rglob("*") if path.is_file() and path.name != "session.lock")
    return {str(path.relative_to(directory)): path.read_bytes() for path in paths}


def contents_of(files: dict[str, bytes]) -> dict[str, bytes]:
    """The blobs outside the database, whether they are kept for use or for a person."""
    return {Path(name).name: content for name, content in files.items() if name.startswith("blobs/")}


def flips(size_bytes: int) -> Iterator[tuple[int, int]]:
    generator = random.Random(5)
    for _ in range(FLIPS):
        yield generator.randrange(size_bytes), generator.randrange(8)


def why_not_opened(directory: Path) -> str:
    try:
        ledger = open_ledger(directory)
    except LedgerError as error:
        return str(error)
    ledger.close()
    return ""


def own_lines(report: CheckReport) -> list[str]:
    """The problems without those that SQLite tells, which are not the same each time."""
    return [line for line in report.problems if not line.startswith("ledger.db: ")]


def assert_is_readable(report: CheckReport) -> None:
    lines = report.to_text().splitlines()
    assert len(lines) == 2 + len(report.repaired) + len(report.problems)
    assert all(line.isprintable() for line in lines)


def test_every_flip_that_changes_a_row_is_reported_and_none_costs_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda _: None)  # nothing here is about durability, and it takes half the time
    original, session, opened = (tmp_path / name for name in ("original", "session", "opened"))
    make_session(original)
    assert check(original, repair=False) == check(original)
    assert check(original).is_sound and check(original).repaired == ()
    whole, rows = (original / "ledger.db").read_bytes(), rows_of(original / "ledger.db")
    blobs = contents_of(files_of(original))
    assert len(rows["blobs"]) == 5 and len(blobs) == 2, "one file and one pack"
    changed_count = 0
    for offset, bit in flips(len(whole)):
        shutil.rmtree(session, ignore_errors=True)
        shutil.copytree(original, session)
        damaged = bytearray(whole)
        damaged[offset] ^= 1 << bit
        (session / "ledger.db").write_bytes(damaged)
        where = f"byte {offset}, bit {bit}"
        is_changed = rows_of(session / "ledger.db") != rows
        changed_count += is_changed

        files = files_of(session)
        looked = check(session, repair=False)
        assert files_of(session) == files, where
        shutil.rmtree(opened, ignore_errors=True)
        shutil.copytree(session, opened)
        assert "\n" not in summary_of(opened).problem, where
        assert why_not_opened(opened).isprintable(), where
        report = check(session)
        assert_is_readable(report)
        assert (own_lines(looked), looked.repaired) == (own_lines(report), report.repaired), where
        assert report.problems or report.repaired or not is_changed, where
        again = check(session)
        assert again.is_sound or not report.is_sound, (where, report, again)
        if report.is_sound:
            assert again.is_sound and again.repaired == (), (where, report, again)
            left = rows_of(session / "ledger.db")
            assert set(left.pop("leases")) <= set(rows["leases"]), (where, report)
            assert [job[:7] for job in left.pop("jobs")] == [job[:7] for job in rows["jobs"]], (where, report)
            assert left == {table: rows[table] for table in left}, (where, report)
        kept = contents_of(files_of(session))
        assert {name: kept.get(name) for name in blobs} == blobs, (where, report)
    assert changed_count > FLIPS / 10
