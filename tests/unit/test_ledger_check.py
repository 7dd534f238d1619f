from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import shutil
import sqlite3
import tarfile
from pathlib import Path

import pytest

from ledger_helpers import damage_blob, open_ledger, predict, record
from ledger_processes import keyframe
from vggt_motion.bus import codec
from vggt_motion.bus.ledger import append_request
from vggt_motion.errors import InputError, LedgerError
from vggt_motion.ledger.admission import admitted
from vggt_motion.ledger.check import check
from vggt_motion.ledger.export import export_session, import_session
from vggt_motion.ledger.sessions import (
    SessionIdentity,
    SessionState,
    identity_of,
    list_sessions,
    prepare_session,
    remove_session,
    summary_of,
)
from vggt_motion.ledger.store import BlobEntry, NewRecord, Transaction
from vggt_motion.records import Event, EventKind, JobKind, JobState

IDENTITY = SessionIdentity("street.mp4", "video:1", "config:1")
IMAGES = (b"i" * 40, b"p" * 150, b"f" * 1000)  # among the rows, in a pack, in a file


def entry(data: bytes) -> BlobEntry:
    return BlobEntry(hashlib.sha256(data).hexdigest(), len(data))


def blob_path(directory: Path, data: bytes) -> Path:
    name = entry(data).sha256
    return directory / "blobs" / name


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A closed session with two streams, two blobs and two jobs, one of them done."""
    directory = tmp_path / "run" / "ledger"
    ledger = open_ledger(directory)
    ledger.store.append(record("keyframe", "k0"), [b"image"], [entry(b"image")])
    ledger.store.append(record("keyframe", "k1"), [b"other"], [entry(b"other"), entry(b"image")])
    ledger.jobs.submit([predict("s0"), predict("s1")])
    lease = ledger.jobs.claim([JobKind.PREDICT], [], "inference/a")
    assert lease is not None
    ledger.jobs.done("s0", lease.lease_id, record("submap", "s0"))
    ledger.close()
    return directory


def execute(directory: Path, statement: str) -> None:
    connection = sqlite3.connect(directory / "ledger.db")
    with connection:
        connection.executescript(statement)
    connection.close()


def files_of(directory: Path) -> dict[str, bytes]:
    """Every file but the lock, which a check takes."""
    paths = (path for path in directory.rglob("*") if path.is_file() and path.name != "session.lock")
    return {str(path.relative_to(directory)): path.read_bytes() for path in paths}


def test_a_sound_session_is_found_sound(session: Path) -> None:
    report = check(session)
    assert report.is_sound and report.repaired == ()
    assert report.record_counts == {"keyframe": 2, "submap": 1}
    assert (report.job_count, report.blob_count) == (2, 2)
    assert report.stored_bytes == (session / "ledger.db").stat().st_size + len(b"image") + len(b"other")


def test_what_an_interrupted_write_left_is_repaired(session: Path) -> None:
    ledger = open_ledger(session)
    ledger.blobs.put([b"written, but its row never was"], keep_free_bytes=0)
    ledger.close()
    (session / "blobs" / "incoming" / "torn.0").write_bytes(b"to")
    report = check(session)
    assert report.is_sound
    assert "1 unfinished blob writes removed" in report.repaired
    assert not (session / "blobs" / "incoming" / "torn.0").exists()
    assert any("1 blobs to which no record refers set aside" in line for line in report.repaired)
    assert not blob_path(session, b"written, but its row never was").exists()
    assert check(session).repaired == ()


def finish(transaction: Transaction, job_id: str) -> None:
    job = transaction.find_job(job_id)
    assert job is not None
    transaction.update_job(dataclasses.replace(job, state=JobState.DONE))


def test_without_repair_nothing_changes_on_disk_and_the_report_says_what_would(session: Path, tmp_path: Path) -> None:
    ledger = open_ledger(session, packed_blob_bytes=100)
    ledger.blobs.put([b"written, but its row never was"], keep_free_bytes=0)
    ledger.packs.append([b"packed, but its row never was"])
    ledger.rows.write(lambda transaction: finish(transaction, "s1"))
    image = tmp_path / "image"  # as the ledger leaves it when it is killed
    shutil.copytree(session, image)
    ledger.close()
    (image / "ledger.db-shm").unlink()
    (image / "blobs" / "incoming" / "torn.0").write_bytes(b"to")
    for content in (b"otheR", b"other"):
        blob_path(image, b"other").write_bytes(content)
        files = files_of(image)
        assert files["ledger.db-wal"]
        looked = check(image, repair=False)
        assert files_of(image) == files
        assert looked.is_sound == (content == b"other")
    assert len(looked.repaired) == 5, looked.repaired
    report = check(image)
    assert (report.repaired, report.problems) == (looked.repaired, looked.problems)
    assert check(image).repaired == ()


def test_without_repair_no_folder_is_made(session: Path) -> None:
    shutil.rmtree(session / "blobs")
    report = check(session, repair=False)
    assert [line.split(": ")[0] for line in report.problems] == ["keyframe/0 ('k0')", "keyframe/1 ('k1')"]
    assert all("is missing" in line for line in report.problems)
    assert not (session / "blobs").exists()


def test_a_torn_write_ahead_log_is_recovered_and_reported(session: Path, tmp_path: Path) -> None:
    ledger = open_ledger(session)
    ledger.store.append(record("event", "acknowledged"))
    size = (session / "ledger.db-wal").stat().st_size
    ledger.store.append(record("event", "torn", bytes(10_000)))
    image = tmp_path / "image"
    image.mkdir()
    (image / "ledger.db").write_bytes((session / "ledger.db").read_bytes())
    (image / "ledger.db-wal").write_bytes((session / "ledger.db-wal").read_bytes()[: size + 5000])
    for path in (session / "blobs").glob("*[0-9a-f]"):
        target = image / path.relative_to(session)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())
    ledger.close()
    report = check(image)
    assert report.is_sound and report.record_counts["event"] == 1
    assert report.repaired == ("the write-ahead log of an interrupted process was folded into the database",)
    assert check(image).repaired == ()


@pytest.mark.parametrize("damage", [b"imagE", b"imag", b""])
def test_a_damaged_blob_is_named_set_aside_and_healed_by_appending_again(session: Path, damage: bytes) -> None:
    blob_path(session, b"image").write_bytes(damage)
    assert not check(session, repair=False).is_sound
    report = check(session)
    (problem,) = report.problems
    assert problem.startswith(f"keyframe/0 ('k0'): blob {entry(b'image').sha256} is damaged")
    assert not blob_path(session, b"image").exists()
    (problem,) = check(session).problems
    assert "is missing" in problem
    ledger = open_ledger(session)
    assert ledger.store.append(record("keyframe", "k0"), [b"image"], [entry(b"image")]).was_known
    ledger.close()
    assert check(session).is_sound


@pytest.mark.parametrize("inline_bytes", [0, 100], ids=["packed", "among the rows"])
def test_a_damaged_small_blob_is_named_set_aside_and_healed_by_appending_again(
    tmp_path: Path, inline_bytes: int
) -> None:
    session = tmp_path / "session"
    ledger = open_ledger(session, packed_blob_bytes=100, inline_bytes=inline_bytes)
    ledger.store.append(record("keyframe", "k0"), [b"image"], [entry(b"image")])
    ledger.close()
    report = check(session)
    assert report.is_sound and report.blob_count == 1
    in_pack = 0 if inline_bytes else len(b"image")
    assert report.stored_bytes == (session / "ledger.db").stat().st_size + in_pack
    damage_blob(session, entry(b"image").sha256, b"imagE")
    assert not check(session, repair=False).is_sound
    with pytest.raises(LedgerError, match="damaged"):
        export_session(session, tmp_path / "session.tar")
    (problem,) = check(session).problems
    assert problem.startswith(f"keyframe/0 ('k0'): blob {entry(b'image').sha256} is damaged")
    (problem,) = check(session).problems
    assert "is missing" in problem
    ledger = open_ledger(session, packed_blob_bytes=100, inline_bytes=inline_bytes)
    assert ledger.store.append(record("keyframe", "k0"), [b"image"], [entry(b"image")]).was_known
    ledger.close()
    assert check(session).is_sound


@pytest.mark.parametrize(
    ("statement", "problem"),
    [
        ("UPDATE records SET payload = x'00' WHERE record_id = 'k1'", "keyframe/1 ('k1'): the record is not what was"),
        ("UPDATE records SET record_id = 'other' WHERE record_id = 'k1'", "keyframe/1 ('other'): the record is not"),
        ("DELETE FROM records WHERE record_id = 'k0'", "keyframe: records 0 to 0 are missing"),
        (
            "DELETE FROM record_blobs; DELETE FROM records WHERE record_id = 'k1'",
            "keyframe: the last 1 records are missing",
        ),
    ],
)
def test_a_damaged_row_is_named(session: Path, statement: str, problem: str) -> None:
    execute(session, statement)
    report = check(session)
    assert any(line.startswith(problem) for line in report.problems), report.problems
    assert blob_path(session, b"image").exists(), "what a damaged row may refer to is kept"


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE jobs SET payload = x'00' WHERE job_id = 's1'",
        "UPDATE jobs SET model = 'other' WHERE job_id = 's1'",
        "UPDATE jobs SET kind = 'pregict' WHERE job_id = 's1'",
        "UPDATE jobs SET priority = priority + 1 WHERE job_id = 's1'",
        "UPDATE jobs SET job_id = 's9' WHERE job_id = 's1'",
        "UPDATE meta SET value = 'f' || value WHERE key = 'ledger_id'",
        "DELETE FROM meta WHERE key = 'ledger_id'",
        "UPDATE meta SET key = 'ledger_ie' WHERE key = 'ledger_id'",
        "UPDATE streams SET next_sequence = 1 WHERE stream = 'keyframe'",
        "UPDATE streams SET stream = 'keyfrale' WHERE stream = 'keyframe'",
        "UPDATE records SET stream = 'keyfrale' WHERE record_id = 'k1'",
        "UPDATE records SET payload = 'text' WHERE record_id = 'k1'",
        "UPDATE records SET append_time_ns = x'ff' WHERE record_id = 'k1'",
        "UPDATE records SET record_id = CAST(x'ff' AS TEXT) WHERE record_id = 'k1'",
        "UPDATE records SET record_id = 's9' WHERE record_id = 's0'",  # the result of a job, which stays done
        "DELETE FROM record_blobs",  # of records that this version cannot decode
        "DELETE FROM record_blobs WHERE sequence = 0",
        "UPDATE record_blobs SET sha256 = 'no hash' WHERE sequence = 0",
    ],
)
def test_damage_of_any_row_is_reported_and_nothing_is_removed(session: Path, statement: str) -> None:
    (session / "blobs" / "incoming" / "torn").touch()
    execute(session, statement)
    report = check(session)
    assert report.problems and report.repaired == ("1 unfinished blob writes removed",), report
    assert check(session).problems == report.problems
    assert blob_path(session, b"image").exists() and blob_path(session, b"other").exists()


def test_the_report_of_a_damaged_name_is_one_line_a_finding(session: Path) -> None:
    execute(session, "UPDATE records SET stream = CAST(x'0aff1b' AS TEXT) WHERE record_id = 'k1'")
    report = check(session)
    lines = report.to_text().splitlines()
    assert len(lines) == 2 + len(report.problems) and all(line.isprintable() for line in lines)


def test_a_damaged_row_does_not_hide_the_others(session: Path) -> None:
    execute(session, "UPDATE records SET payload_type = CAST(x'ff' AS TEXT) WHERE record_id = 'k0'")
    execute(session, "UPDATE records SET payload = x'00' WHERE record_id = 'k1'")
    execute(session, "UPDATE jobs SET payload = x'00'; UPDATE jobs SET kind = CAST(x'ff' AS TEXT) WHERE job_id = 's0'")
    report = check(session)
    assert [line.split(":")[0] for line in report.problems] == [
        "keyframe/0",
        "keyframe/1 ('k1')",
        "job 's0'",
        "job 's1'",
    ]
    assert (report.record_counts, report.job_count) == ({"keyframe": 2, "submap": 1}, 2)


@pytest.mark.parametrize(
    "change",
    [
        "state = 'opef'",
        "state = 'leased'",
        "attempt = -1",
        "failure_count = 2",
        "last_reason = CAST(x'ff' AS TEXT)",
        "not_before_s = 'soon'",
    ],
)
def test_a_job_whose_progress_is_damaged_begins_anew(session: Path, change: str) -> None:
    execute(session, f"UPDATE jobs SET {change} WHERE job_id = 's1'")
    report = check(session)
    assert report.is_sound, report.problems
    assert report.repaired == ("job 's1': how far it had come was damaged; it is open, with all counts at zero",)
    assert check(session).repaired == ()
    ledger = open_ledger(session, new_lease_id=lambda: "another")
    lease = ledger.jobs.claim([JobKind.PREDICT], [], "inference/a")
    assert lease is not None and (lease.job.job_id, lease.attempt) == ("s1", 1)
    ledger.close()


def test_a_damaged_lease_is_forgotten(session: Path) -> None:
    execute(session, "UPDATE leases SET worker = 'inference/b'")
    report = check(session)
    assert report.is_sound and "lease 'lease0' was damaged and is forgotten" in report.repaired[0]
    assert check(session).repaired == ()


@pytest.fixture
def decodable(tmp_path: Path) -> Path:
    """A session of records as the services make them: one blob each, among the rows, in a pack and in a file."""
    directory = tmp_path / "decodable"
    ledger = open_ledger(directory, inline_bytes=100, packed_blob_bytes=500)
    for index, image in enumerate(IMAGES):
        frame = keyframe(index, image)
        ledger.store.append(*admitted(append_request("keyframe", frame.keyframe_id, frame, [image])))
    ledger.close()
    return directory


@pytest.mark.parametrize(
    ("statement", "repaired_count"),
    [
        ("DELETE FROM record_blobs", 3),
        ("DELETE FROM record_blobs; DELETE FROM blobs WHERE pack = 0", 4),
        ("UPDATE record_blobs SET sha256 = 'no hash' WHERE sequence = 1", 1),
        ("UPDATE record_blobs SET sequence = 7 WHERE sequence = 1", 2),
        ("INSERT INTO record_blobs SELECT stream, 0, sha256 FROM record_blobs WHERE sequence = 1", 1),
        ("UPDATE blobs SET size_bytes = size_bytes + 1 WHERE pack = 0", 2),
        ("UPDATE blobs SET is_file = 1 - is_file", 3),
        ("UPDATE blobs SET pack = 1 WHERE pack = 0", 2),
        ("UPDATE blobs SET pack = -1, offset_bytes = -5 WHERE pack = 0", 2),
        ("UPDATE blobs SET offset_bytes = offset_bytes + 1 WHERE pack = 0", 2),
        ("INSERT INTO blobs VALUES ('no hash', 1, 1, 0, 0); INSERT INTO contents VALUES ('none', x'00')", 1),
    ],
)
def test_which_blobs_a_record_has_and_where_is_found_out_again(
    decodable: Path, statement: str, repaired_count: int
) -> None:
    def rows() -> list[object]:
        with contextlib.closing(sqlite3.connect(decodable / "ledger.db")) as connection:
            tables = ("blobs", "record_blobs", "contents")
            return [sorted(connection.execute(f"SELECT * FROM {table}").fetchall()) for table in tables]

    before = rows()
    execute(decodable, statement)
    report = check(decodable)
    assert report.is_sound and report.blob_count == 3, report.problems
    assert len(report.repaired) == repaired_count, report.repaired
    assert rows() == before
    assert check(decodable).repaired == ()
    ledger = open_ledger(decodable)
    assert [ledger.store.blob(entry(image).sha256) for image in IMAGES] == list(IMAGES)
    ledger.close()


@pytest.mark.parametrize("change", ["offset_bytes = -1", "size_bytes = 1 << 60", "pack = -5", "offset_bytes = 1 << 62"])
def test_a_place_that_cannot_be_is_a_damaged_blob_and_the_pack_stays_as_it_is(decodable: Path, change: str) -> None:
    execute(decodable, f"UPDATE blobs SET {change} WHERE pack <> 0")
    pack = (decodable / "blobs" / "packs" / "00000001.pack").read_bytes()
    with pytest.raises(LedgerError, match=r"damaged|missing"):
        export_session(decodable, decodable / "session.tar")
    for state in ("damaged", "missing"):
        (problem,) = check(decodable).problems
        assert f"blob {entry(IMAGES[1]).sha256} is {state}" in problem
    assert (decodable / "blobs" / "packs" / "00000001.pack").read_bytes() == pack


@pytest.mark.parametrize(
    ("statement", "reason"),
    [
        ("UPDATE jobs SET state = 'leased', kind = 'pregict' WHERE job_id = 's1'", "job 's1' is damaged: 'pregict'"),
        ("UPDATE jobs SET state = 'leased', worker = CAST(x'ff' AS TEXT) WHERE job_id = 's1'", "UTF-8"),
        ("UPDATE jobs SET state = 'leased', payload = 'text' WHERE job_id = 's1'", "a damaged row, no JobRow"),
        ("UPDATE jobs SET not_before_s = 'soon' WHERE job_id = 's1'", "a damaged row, no JobRow"),
        ("UPDATE meta SET value = 'x' WHERE key = 'ledger_id'", "the id of this ledger is damaged: 'x'"),
        ("UPDATE meta SET value = x'ff' WHERE key = 'ledger_id'", "with bytes in place of str"),
        (
            "PRAGMA writable_schema = ON;"
            "UPDATE sqlite_master SET name = CAST(x'ff' AS TEXT), sql = 'no' WHERE name = 'leases'",
            "ledger.db is damaged: 'utf-8' codec can't decode byte 0xff",
        ),
    ],
)
def test_a_damaged_session_is_not_opened_and_the_reason_is_one_line(session: Path, statement: str, reason: str) -> None:
    execute(session, statement)
    with pytest.raises(LedgerError) as raised:
        open_ledger(session)
    assert reason in str(raised.value) and str(raised.value).isprintable()
    report = check(session)
    assert report.problems or report.repaired


def test_damaged_rows_out_of_order_end_a_reader_that_goes_on_behind_the_last_one(session: Path) -> None:
    ledger = open_ledger(session)
    for index in range(3):
        ledger.store.append(record("event", f"e{index}"))
    ledger.close()
    whole = (session / "ledger.db").read_bytes()
    assert whole.count(b"event\x02\x06") == 1, "the index: stream, sequence, row"
    (session / "ledger.db").write_bytes(whole.replace(b"event\x02\x06", b"event\x00\x06"))
    assert "out of order" in summary_of(session).problem
    report = check(session)
    assert report.is_sound and "wrong index entries rebuilt" in report.repaired[0]
    assert summary_of(session).problem == ""


def test_a_stream_with_a_name_that_none_can_have_ends_the_service_in_one_line(session: Path) -> None:
    execute(session, "UPDATE streams SET stream = 'key/rame' WHERE stream = 'keyframe'")
    ledger = open_ledger(session)
    with pytest.raises(LedgerError, match="a damaged row, of a stream 'key/rame'"):
        ledger.store.positions()
    ledger.close()


def test_a_job_that_is_done_without_a_result_is_opened_again(session: Path) -> None:
    execute(session, "UPDATE jobs SET state = 'done' WHERE job_id = 's1'")
    report = check(session)
    assert report.is_sound
    assert report.repaired == ("job 's1' was done without a result and is open again",)
    ledger = open_ledger(session)
    assert ledger.jobs.counts() == {("predict", "done"): 1, ("predict", "open"): 1}
    ledger.close()


def test_a_damaged_index_is_rebuilt(session: Path) -> None:
    connection = sqlite3.connect(session / "ledger.db")
    with connection:
        # An index that lacks a row: filled under another name, then put in the place of the real one.
        connection.execute("PRAGMA writable_schema = ON")
        (sql,) = connection.execute("SELECT sql FROM sqlite_master WHERE name = 'jobs_by_state'").fetchone()
        connection.execute("UPDATE sqlite_master SET sql = NULL, type = 'index' WHERE 0")
        connection.execute(
            "UPDATE sqlite_master SET sql = ? WHERE name = 'jobs_by_state'", (sql + " WHERE state <> 'open'",)
        )
    connection.close()
    connection = sqlite3.connect(session / "ledger.db")
    with connection:
        connection.execute("REINDEX")
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute("UPDATE sqlite_master SET sql = ? WHERE name = 'jobs_by_state'", (sql,))
    connection.close()
    report = check(session)
    assert report.is_sound, report.problems
    assert any("wrong index entries rebuilt" in line for line in report.repaired)
    assert check(session).repaired == ()


def test_a_damaged_page_of_the_database_is_found_and_never_ends_in_a_traceback(session: Path) -> None:
    whole = (session / "ledger.db").read_bytes()
    for offset in range(0, len(whole), 4096):
        (session / "ledger.db").write_bytes(whole[:offset] + b"\xff" * 64 + whole[offset + 64 :])
        report = check(session)
        assert not report.is_sound or report.repaired, f"offset {offset}"
        assert all("\n" not in line for line in report.problems)


def test_a_session_in_use_and_a_folder_without_one_are_refused_in_one_line(session: Path, tmp_path: Path) -> None:
    ledger = open_ledger(session)
    with pytest.raises(LedgerError, match="in use by another process"):
        check(session)
    ledger.close()
    with pytest.raises(LedgerError, match="holds no ledger"):
        check(tmp_path)


# Sessions


def event(event_id: str, kind: EventKind, **detail: str) -> NewRecord:
    value = Event(event_id, kind, event_id, 123, detail)
    return NewRecord("event", event_id, codec.payload_type(Event), codec.encode(value), codec.identity_digest(value))


def test_sessions_are_listed_while_they_are_served(session: Path, tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "second")
    ledger.store.append(
        event("session_started", EventKind.SESSION_STARTED, source="street.mp4", source_fingerprint="video:1")
    )
    ledger.store.append(event("run_ended", EventKind.RUN_ENDED))
    (tmp_path / "elsewhere").mkdir()
    first, second = list_sessions(tmp_path)
    assert (first.directory, first.source, first.is_ended, first.is_in_use) == (session, "", False, False)
    assert first.record_counts == {"keyframe": 2, "submap": 1}
    assert (second.source, second.source_fingerprint, second.started_ns) == ("street.mp4", "video:1", 123)
    assert second.is_ended and second.is_in_use and second.problem == ""
    ledger.close()
    assert not list_sessions(tmp_path / "second")[0].is_in_use
    assert first.stored_bytes == check(session).stored_bytes


def test_a_session_that_cannot_be_read_is_listed_with_its_problem(session: Path, tmp_path: Path) -> None:
    (session / "ledger.db").write_bytes(b"garbage" * 1000)
    (summary,) = list_sessions(tmp_path)
    assert "\n" not in summary.problem and summary.problem
    with pytest.raises(InputError, match="not a folder"):
        list_sessions(tmp_path / "missing")


def test_a_directory_belongs_to_one_source_and_configuration(tmp_path: Path) -> None:
    directory = tmp_path / "out" / "ledger"
    assert identity_of(directory) is None
    assert prepare_session(directory, IDENTITY) is SessionState.NEW
    assert identity_of(directory) == IDENTITY
    assert prepare_session(directory, IDENTITY) is SessionState.UNFINISHED
    with pytest.raises(InputError, match=r"another source \(street.mp4\)"):
        prepare_session(directory, SessionIdentity("b.mp4", "video:2", "config:1"))
    with pytest.raises(InputError, match="another configuration"):
        prepare_session(directory, SessionIdentity("street.mp4", "video:1", "config:2"))
    ledger = open_ledger(directory)
    ledger.store.append(event("run_ended", EventKind.RUN_ENDED))
    ledger.close()
    assert prepare_session(directory, IDENTITY) is SessionState.FINISHED
    assert summary_of(directory).source == "street.mp4"
    remove_session(directory)
    assert prepare_session(directory, IDENTITY) is SessionState.NEW


def test_a_session_that_does_not_say_what_it_is_is_not_taken_over(session: Path) -> None:
    with pytest.raises(InputError, match="unknown source"):
        prepare_session(session, IDENTITY)


def test_a_session_in_use_is_not_removed(session: Path) -> None:
    ledger = open_ledger(session)
    with pytest.raises(LedgerError, match="in use"):
        remove_session(session)
    ledger.close()
    (session / "notes.txt").write_text("mine")
    remove_session(session)
    assert [path.name for path in session.iterdir() if path.name != "session.lock"] == ["notes.txt"]


# Export


def test_a_session_comes_out_of_an_archive_as_it_went_in(session: Path, tmp_path: Path) -> None:
    ledger = open_ledger(session, packed_blob_bytes=100)  # exporting needs no lock
    ledger.store.append(record("event", "e0"), [b"small"], [entry(b"small")])
    ledger.store._inline_bytes = 100
    ledger.store.append(record("event", "e1"), [b"row"], [entry(b"row")])
    report = export_session(session, tmp_path / "session.tar")
    ledger.store.append(record("keyframe", "k2"))
    rows = ledger.store.read("keyframe", limit=2)
    ledger.close()
    assert (report.record_counts, report.blob_count) == ({"keyframe": 2, "submap": 1, "event": 2}, 4)
    assert report.archive_bytes == (tmp_path / "session.tar").stat().st_size
    assert import_session(tmp_path / "session.tar", tmp_path / "copy") == report
    assert check(tmp_path / "copy").is_sound
    copy = open_ledger(tmp_path / "copy")
    assert copy.store.read("keyframe") == rows
    assert copy.store.blob(entry(b"image").sha256) == b"image"
    assert copy.store.blob(entry(b"small").sha256) == b"small"
    assert copy.store.blob(entry(b"row").sha256) == b"row"
    assert copy.jobs.counts() == {("predict", "done"): 1, ("predict", "open"): 1}
    copy.close()


def test_a_damaged_session_is_not_exported(session: Path, tmp_path: Path) -> None:
    blob_path(session, b"image").write_bytes(b"imagE")
    with pytest.raises(LedgerError, match="damaged"):
        export_session(session, tmp_path / "session.tar")
    assert not list(tmp_path.glob("session.tar*"))


def test_archives_that_are_not_ours_are_refused_and_leave_nothing(session: Path, tmp_path: Path) -> None:
    archive = tmp_path / "session.tar"
    export_session(session, archive)
    with pytest.raises(InputError, match="there already"):
        export_session(session, archive)
    with pytest.raises(InputError, match="not empty"):
        import_session(archive, session)
    whole = archive.read_bytes()

    def refused(data: bytes) -> None:
        (tmp_path / "bad.tar").write_bytes(data)
        with pytest.raises(InputError, match="cannot import"):
            import_session(tmp_path / "bad.tar", tmp_path / "copy")
        assert not (tmp_path / "copy").exists()

    refused(b"")
    refused(b"no archive")
    refused(whole[: len(whole) // 2])
    refused(whole.replace(b"image", b"imagE"))
    for name, kind in (("../escape", tarfile.REGTYPE), ("/etc/escape", tarfile.REGTYPE), ("link", tarfile.SYMTYPE)):
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w") as tar:
            info = tarfile.TarInfo(name)
            info.type = kind
            info.size = 1 if kind == tarfile.REGTYPE else 0
            tar.addfile(info, io.BytesIO(b"x"))
        refused(buffer.getvalue())
    assert not (tmp_path / "escape").exists()


def test_of_an_emptied_database_the_payloads_are_kept(tmp_path: Path) -> None:
    session = tmp_path / "session"
    ledger = open_ledger(session, packed_blob_bytes=100)
    ledger.store.append(record("keyframe", "a"), [b"image"], [entry(b"image")])
    ledger.close()
    pack = (session / "blobs" / "packs" / "00000001.pack").read_bytes()
    for file in session.glob("ledger.db*"):
        file.write_bytes(b"")
    assert check(session, repair=False).repaired == check(session).repaired != ()
    (kept,) = (session / "blobs" / "damaged").iterdir()
    assert kept.read_bytes() == pack
