from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import sqlite3
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ledger_helpers import damage_blob, in_pack, open_ledger, predict, record
from ledger_processes import keyframe
from vggt_motion.bus.ledger import append_request
from vggt_motion.errors import DiskFullError, LedgerError, RefusalCode, RequestRefusedError
from vggt_motion.ledger import log, schema, sqlite
from vggt_motion.ledger.admission import admitted
from vggt_motion.ledger.blobs import BlobFiles
from vggt_motion.ledger.check import check
from vggt_motion.ledger.directory import Ledger, stored_blob
from vggt_motion.ledger.export import export_session, import_session
from vggt_motion.ledger.log import Append, Appended, is_intact, row_digest
from vggt_motion.ledger.sqlite import SqliteRows, read_only
from vggt_motion.ledger.store import (
    BlobEntry,
    ConflictError,
    DamagedBlobError,
    InvalidRequestError,
    NewRecord,
    Transaction,
    UnknownError,
)
from vggt_motion.records import JobKind


@pytest.fixture
def ledger(tmp_path: Path) -> Any:
    opened = open_ledger(tmp_path / "session")
    yield opened
    opened.close()


def entry(data: bytes) -> BlobEntry:
    return BlobEntry(hashlib.sha256(data).hexdigest(), len(data))


def test_sequences_are_dense_from_zero_in_every_stream(ledger: Ledger) -> None:
    for stream in ("keyframe", "segment"):
        for index in range(5):
            assert ledger.store.append(record(stream, f"{index}")) == Appended(index, was_known=False)
    assert ledger.store.positions() == {"keyframe": 5, "segment": 5}
    assert [row.record_id for row in ledger.store.read("segment")] == list("01234")


def test_the_same_content_is_acknowledged_again_with_the_same_sequence(ledger: Ledger) -> None:
    ledger.store.append(record("event", "a", b"x"))
    ledger.store.append(record("event", "b", b"y"))
    assert ledger.store.append(record("event", "a", b"x")) == Appended(0, was_known=True)
    assert ledger.store.positions() == {"event": 2}


def test_other_bytes_of_the_same_identity_are_the_same_record(ledger: Ledger) -> None:
    ledger.store.append(record("event", "a", b"took 3 s", identity=b"i"))
    assert ledger.store.append(record("event", "a", b"took 4 s", identity=b"i")) == Appended(0, was_known=True)
    assert ledger.store.read("event")[0].payload == b"took 3 s"


def test_another_content_under_a_known_id_is_refused_and_named(ledger: Ledger) -> None:
    ledger.store.append(record("event", "a", b"x"))
    with pytest.raises(ConflictError, match="event record 'a' is known with another content") as caught:
        ledger.store.append(record("event", "a", b"z"))
    assert caught.value.code is RefusalCode.CONFLICT
    assert [row.payload for row in ledger.store.read("event")] == [b"x"]
    assert ledger.store.append(record("event", "b")).sequence == 1, "a refused append must not use up a number"


def test_the_same_id_in_another_stream_is_another_record(ledger: Ledger) -> None:
    ledger.store.append(record("event", "a", b"x"))
    assert ledger.store.append(record("graph", "a", b"z")) == Appended(0, was_known=False)


@pytest.mark.parametrize(
    ("bad", "field"),
    [
        (record("", "a"), "stream"),
        (record("Event", "a"), "stream"),
        (record("event/../x", "a"), "stream"),
        (record("e" * 33, "a"), "stream"),
        (record("event", ""), "record_id"),
        (record("event", "a" * 257), "record_id"),
        (record("event", "a b"), "record_id"),
        (record("event", "ä"), "record_id"),
        (record("event", "a\n"), "record_id"),
        (record("event", "\ud800"), "record_id"),
        (NewRecord("event", "a", "", b"", bytes(32)), "payload_type"),
        (NewRecord("event", "a", "t" * 129, b"", bytes(32)), "payload_type"),
        (NewRecord("event", "a", "t", b"", bytes(31)), "identity_sha256"),
        (NewRecord("event", "a", "t", b"", b""), "identity_sha256"),
        (NewRecord("event", "a", "t", bytes(log.MAX_PAYLOAD_BYTES + 1), bytes(32)), "payload"),
    ],
)
def test_a_malformed_record_is_refused_and_changes_nothing(ledger: Ledger, bad: NewRecord, field: str) -> None:
    with pytest.raises(InvalidRequestError, match=field) as caught:
        ledger.store.append(bad, [b"blob"])
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 200
    assert ledger.store.positions() == {}
    assert list(ledger.blobs.names()) == []


@given(
    records=st.lists(
        st.tuples(st.sampled_from(["event", "graph"]), st.sampled_from("abc"), st.sampled_from([b"x", b"y"])),
        max_size=20,
    )
)
@settings(max_examples=25)
def test_any_order_of_appends_gives_a_dense_log_without_duplicates(
    tmp_path_factory: pytest.TempPathFactory, records: list[tuple[str, str, bytes]]
) -> None:
    expected: dict[str, list[tuple[str, bytes]]] = {"event": [], "graph": []}
    opened = open_ledger(tmp_path_factory.mktemp("session"))
    try:
        for stream, name, content in records:
            known = dict(expected[stream])
            if name in known and known[name] != content:
                with pytest.raises(ConflictError):
                    opened.store.append(record(stream, name, content))
                continue
            reply = opened.store.append(record(stream, name, content))
            assert reply.was_known == (name in known)
            if name not in known:
                expected[stream].append((name, content))
            assert expected[stream][reply.sequence] == (name, content)
        for stream, entries in expected.items():
            rows = opened.store.read(stream)
            assert [row.sequence for row in rows] == list(range(len(entries)))
            assert [(row.record_id, row.payload) for row in rows] == entries
    finally:
        opened.close()


def test_reading_starts_where_asked_and_ends_with_an_empty_answer(ledger: Ledger) -> None:
    for index in range(70):
        ledger.store.append(record("event", f"{index:02d}"))
    assert [row.sequence for row in ledger.store.read("event", 65)] == [65, 66, 67, 68, 69]
    assert [row.sequence for row in ledger.store.read("event", 3, limit=40)] == list(range(3, 43))
    assert ledger.store.read("event", 70) == []
    assert ledger.store.read("event", 2**62) == []
    assert ledger.store.read("graph") == []
    for from_sequence, limit in ((-1, 1), (0, -1), (2**63, 1)):
        with pytest.raises(InvalidRequestError):
            ledger.store.read("event", from_sequence, limit)


def test_one_answer_is_bounded_in_bytes_but_always_makes_progress(
    ledger: Ledger, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log, "MAX_READ_BYTES", 1000)
    for index, size in enumerate((400, 400, 400, 5000, 1)):
        ledger.store.append(record("event", f"{index}", bytes(size)))
    lengths, position = [], 0
    while rows := ledger.store.read("event", position):
        lengths.append(len(rows))
        position = rows[-1].sequence + 1
    assert lengths == [2, 1, 1, 1]


def test_blobs_travel_with_a_record_and_may_be_referred_to_later(ledger: Ledger) -> None:
    image, mask = b"image", b"mask"
    ledger.store.append(record("keyframe", "a"), [image, mask], [entry(image), entry(mask)])
    ledger.store.append(record("keyframe", "b"), [], [entry(mask)])
    assert ledger.store.blob(entry(image).sha256) == image
    blobs = ledger.rows.read(lambda reader: [list(reader.record_blobs("keyframe", index)) for index in (0, 1)])
    assert blobs == [sorted([entry(image), entry(mask)], key=lambda blob: blob.sha256), [entry(mask)]]
    assert ledger.store.sizes().blob_bytes == len(image) + len(mask)


@pytest.mark.parametrize("reference", [entry(b"missing"), BlobEntry(entry(b"there").sha256, 4)])
def test_a_reference_to_a_missing_blob_is_refused(ledger: Ledger, reference: BlobEntry) -> None:
    ledger.store.append(record("keyframe", "a"), [b"there"])
    with pytest.raises(UnknownError, match=reference.sha256) as caught:
        ledger.store.append(record("keyframe", "b"), [], [reference])
    assert caught.value.code is RefusalCode.UNKNOWN
    assert ledger.store.positions() == {"keyframe": 1}


def test_a_repeated_append_brings_back_a_damaged_blob(ledger: Ledger, tmp_path: Path) -> None:
    name = entry(b"image").sha256
    ledger.store.append(record("keyframe", "a"), [b"image"], [entry(b"image")])
    (tmp_path / "session" / "blobs" / name).write_bytes(b"imagE")
    with pytest.raises(RequestRefusedError, match="damaged"):
        ledger.store.blob(name)
    assert ledger.store.append(record("keyframe", "a"), [b"image"], [entry(b"image")]) == Appended(0, was_known=True)
    assert ledger.store.blob(name) == b"image"


def test_below_the_reserve_new_input_is_refused_and_results_may_use_half_of_it(tmp_path: Path) -> None:
    free_bytes = 1000
    ledger = open_ledger(tmp_path / "session", reserve_bytes=1000, free_bytes=lambda: free_bytes)
    ledger.store.append(record("keyframe", "a"))
    assert ledger.store.is_accepting
    free_bytes = 999
    assert not ledger.store.is_accepting
    with pytest.raises(DiskFullError):
        ledger.store.append(record("keyframe", "b"))
    assert ledger.store.append(record("keyframe", "a")).was_known, "what is there already needs no space"
    free_bytes = 500
    ledger.store.append(record("submap", "s"), [bytes(100)])
    free_bytes = 499
    with pytest.raises(DiskFullError):
        ledger.store.append(record("submap", "t"), [bytes(100)])
    with pytest.raises(DiskFullError):
        ledger.store.append(record("submap", "t"))
    assert ledger.store.positions() == {"keyframe": 1, "submap": 1}
    free_bytes = 10_000
    assert ledger.store.append(record("keyframe", "b"), [b"now there is space"]) == Appended(1, was_known=False)
    ledger.close()


def test_everything_is_there_after_closing_and_opening_again(tmp_path: Path) -> None:
    first = open_ledger(tmp_path / "session")
    first.store.append(record("event", "a", b"x"), [b"blob"])
    rows = first.store.read("event")
    first.close()
    assert not (tmp_path / "session" / "ledger.db-wal").exists()
    second = open_ledger(tmp_path / "session")
    assert second.store.read("event") == rows
    assert second.store.append(record("event", "b")) == Appended(1, was_known=False)
    second.close()


def test_a_closed_ledger_says_so(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session")
    ledger.close()
    with pytest.raises(LedgerError, match="is closed"):
        ledger.store.append(record("event", "a"))
    with pytest.raises(LedgerError, match="is closed"):
        ledger.store.read("event")


def test_a_second_opener_is_told_in_one_line(tmp_path: Path) -> None:
    first = open_ledger(tmp_path / "session")
    with pytest.raises(LedgerError, match=r"^.*session is in use by another process \(\d+\)$"):
        open_ledger(tmp_path / "session")
    first.store.append(record("event", "a"))
    first.close()
    open_ledger(tmp_path / "session").close()


def test_a_directory_that_cannot_be_made_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(LedgerError, match=r"^cannot create .*$"):
        open_ledger(tmp_path / "file" / "session")


def test_a_stored_row_that_changed_is_not_intact(ledger: Ledger) -> None:
    ledger.store.append(record("event", "a", b"x"), [b"one", b"two"])
    (row,) = ledger.store.read("event")
    references = [entry(b"one").sha256, entry(b"two").sha256]
    assert is_intact(row, references)
    for change in ({"payload": b"y"}, {"sequence": 1}, {"stream": "graph"}, {"record_id": "b"}, {"append_time_ns": 0}):
        assert not is_intact(type(row)(**{**row.__dict__, **change}), references)
    for others in (references[:1], [], [*references, entry(b"three").sha256], None):
        assert not is_intact(row, others)


# Small blobs among the rows and in packs


def test_small_blobs_lie_in_packs_and_large_ones_are_files(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=5)
    small, large = b"small", b"larger"
    ledger.store.append(record("keyframe", "a"), [small, large], [entry(small), entry(large)])
    ledger.store.append(record("keyframe", "b"), [], [entry(small), entry(large)])
    assert [path.name for path in (tmp_path / "session" / "blobs").glob("*[0-9a-f]")] == [entry(large).sha256]
    assert ledger.store.sizes().blob_bytes == len(small) + len(large)
    assert (tmp_path / "session" / "blobs" / "packs" / "00000001.pack").read_bytes() == in_pack(small)
    ledger.close()
    again = open_ledger(tmp_path / "session")
    assert [again.store.blob(entry(data).sha256) for data in (small, large)] == [small, large]
    assert [stored_blob(tmp_path / "session", entry(data).sha256) for data in (small, large)] == [small, large]
    again.close()
    with pytest.raises(UnknownError):
        stored_blob(tmp_path / "session", entry(b"nothing").sha256)


def test_what_comes_alone_stands_among_the_rows_and_more_in_a_pack(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=100, inline_bytes=10)
    pack = tmp_path / "session" / "blobs" / "packs" / "00000001.pack"
    ledger.store.append(record("keyframe", "a"), [b"01234", b"56789"], [entry(b"01234"), entry(b"56789")])
    assert not pack.exists() and ledger.store.sizes().blob_bytes == 0
    ledger.store.append(record("keyframe", "b"), [b"01234", b"0123456789"], [entry(b"01234"), entry(b"0123456789")])
    assert not pack.exists(), "what is known is not counted"
    together = [Append(record("keyframe", name), [name.encode() * 6], [entry(name.encode() * 6)]) for name in "cd"]
    assert [outcome for outcome in ledger.store.append_all(together) if isinstance(outcome, Exception)] == []
    assert pack.read_bytes() == in_pack(b"ccccccdddddd") and ledger.store.sizes().blob_bytes == 12
    contents = [b"01234", b"56789", b"0123456789", b"cccccc", b"dddddd"]
    assert [ledger.store.blob(entry(content).sha256) for content in contents] == contents
    ledger.close()
    assert [stored_blob(tmp_path / "session", entry(content).sha256) for content in contents] == contents
    report = check(tmp_path / "session")
    assert report.is_sound and report.blob_count == 5


def test_small_blobs_of_many_threads_share_one_commit(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=100)
    gate = Gate(ledger.rows, waiting=15)
    in_threads(
        16,
        lambda index: ledger.store.append(record("keyframe", f"{index}"), [b"%d" % index], [entry(b"%d" % index)]),
    )
    assert gate.commit_sizes == [1, 15]
    ledger.close()


def test_of_several_at_a_time_each_stands_for_itself_in_one_commit(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=3)
    ledger.store.append(record("keyframe", "first"))
    gate = Gate(ledger.rows, waiting=0)
    conflicting = dataclasses.replace(record("keyframe", "first"), identity_sha256=bytes(32))
    outcomes = ledger.store.append_all(
        [
            Append(record("keyframe", "inline"), [b"abc"], [entry(b"abc")]),
            Append(conflicting),
            Append(record("keyframe", "file"), [b"long"], [entry(b"long")]),
            Append(record("keyframe", "missing"), [], [entry(b"nowhere")]),
            Append(record("keyframe", "not a name")),
            Append(record("keyframe", "inline"), [b"abc"], [entry(b"abc")]),
            Append(record("event", "last")),
        ]
    )
    assert gate.commit_sizes == [1, 1], "what does not go at once is undone, and goes one by one"
    kinds = [type(outcome) for outcome in outcomes]
    assert kinds == [Appended, ConflictError, Appended, UnknownError, InvalidRequestError, Appended, Appended]
    assert [(o.sequence, o.was_known) for o in outcomes if isinstance(o, Appended)] == [
        (1, False), (2, False), (1, True), (0, False)
    ]  # fmt: skip
    assert [row.record_id for row in ledger.store.read("keyframe")] == ["first", "inline", "file"]
    assert [ledger.store.blob(entry(content).sha256) for content in (b"abc", b"long")] == [b"abc", b"long"]
    ledger.close()
    assert check(tmp_path / "session").is_sound


@pytest.mark.parametrize("inline_bytes", [0, 1000], ids=["packed", "among the rows"])
def test_what_comes_together_keeps_its_order_also_where_something_is_known(tmp_path: Path, inline_bytes: int) -> None:
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=100, inline_bytes=inline_bytes)
    images = [b"same", b"same", b"other", b"third"]
    together = [Append(record("keyframe", f"{n}"), [image], [entry(image)]) for n, image in enumerate(images)]
    assert [o.sequence for o in ledger.store.append_all(together) if isinstance(o, Appended)] == [0, 1, 2, 3]
    assert [row.record_id for row in ledger.store.read("keyframe")] == ["0", "1", "2", "3"]
    ledger.close()


def test_for_want_of_space_nothing_overtakes_what_was_refused(tmp_path: Path) -> None:
    free = [1000]
    ledger = open_ledger(
        tmp_path / "session",
        packed_blob_bytes=5000,
        reserve_bytes=900,
        free_bytes=lambda: free[0],
    )
    sizes = {"first": 50, "large": 600, "small": 1}
    together = [
        Append(record("keyframe", name), [bytes([n]) * size], [entry(bytes([n]) * size)])
        for n, (name, size) in enumerate(sizes.items())
    ]
    outcomes = ledger.store.append_all([*together, Append(record("event", "other"))])
    assert [type(outcome) for outcome in outcomes] == [Appended, DiskFullError, DiskFullError, Appended]
    free[0] = 10**6
    assert [type(outcome) for outcome in ledger.store.append_all(together)] == [Appended] * 3
    assert [row.record_id for row in ledger.store.read("keyframe")] == ["first", "large", "small"]
    free[0] = 950  # what is stored takes no space
    referring = [Append(record("keyframe", f"{n}"), [], [entry(bytes([1]) * 600)]) for n in range(5)]
    assert [type(outcome) for outcome in ledger.store.append_all(referring)] == [Appended] * 5
    ledger.close()


def test_when_the_commit_fails_nobody_in_it_is_acknowledged(ledger: Ledger) -> None:
    (pages,) = ledger.rows._writer.execute("PRAGMA page_count").fetchone()
    ledger.rows._writer.execute(f"PRAGMA max_page_count = {pages + 1}")
    large = [dataclasses.replace(record("event", f"{index}"), payload=bytes(20_000)) for index in range(3)]
    outcomes = ledger.store.append_all([Append(entry) for entry in large])
    assert [type(outcome) for outcome in outcomes] == [DiskFullError] * 3
    assert ledger.store.positions() == {}
    ledger.rows._writer.execute("PRAGMA max_page_count = 1000000")
    assert [o.sequence for o in map(ledger.store.append, large)] == [0, 1, 2]


def test_a_refused_record_leaves_no_content_behind(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=100)
    ledger.store.append(record("keyframe", "a"))
    with pytest.raises(ConflictError):
        ledger.rows.write(
            lambda transaction: ledger.store.add(
                transaction, record("keyframe", "a", b"other"), ledger.store.prepare([b"new"], [], is_input=True)
            )
        )
    with pytest.raises(UnknownError):
        ledger.store.blob(entry(b"new").sha256)
    ledger.close()
    report = check(tmp_path / "session")
    assert report.repaired == ("4096 bytes at the end of pack 1, to which no record refers, set aside",)
    assert check(tmp_path / "session").repaired == ()


def test_a_small_blob_that_is_known_is_not_stored_again(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=100)
    for name in ("a", "b", "a"):
        ledger.store.append(record("keyframe", name), [b"image"], [entry(b"image")])
    assert (tmp_path / "session" / "blobs" / "packs" / "00000001.pack").read_bytes() == in_pack(b"image")
    ledger.close()


@pytest.mark.parametrize("inline_bytes", [0, 100], ids=["packed", "among the rows"])
def test_a_damaged_small_blob_is_noticed_set_aside_and_healed_by_appending_again(
    tmp_path: Path, inline_bytes: int
) -> None:
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=100, inline_bytes=inline_bytes)
    ledger.store.append(record("keyframe", "a"), [b"image"], [entry(b"image")])
    damage_blob(tmp_path / "session", entry(b"image").sha256, b"imagE")
    with pytest.raises(DamagedBlobError):
        ledger.store.blob(entry(b"image").sha256)
    assert (tmp_path / "session" / "blobs" / "damaged" / entry(b"image").sha256).read_bytes() == b"imagE"
    with pytest.raises(UnknownError):
        ledger.store.blob(entry(b"image").sha256)
    assert ledger.store.append(record("keyframe", "a"), [b"image"], [entry(b"image")]).was_known
    assert ledger.store.blob(entry(b"image").sha256) == b"image"
    ledger.close()


# Group commit


def in_threads(count: int, work: Callable[[int], Any]) -> list[Any]:
    results: list[Any] = [None] * count

    def run(index: int) -> None:
        try:
            results[index] = work(index)
        except Exception as error:
            results[index] = error

    threads = [threading.Thread(target=run, args=(index,)) for index in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return results


class Gate:
    """Holds the first commit open until the others have queued up, and counts the commits."""

    def __init__(self, rows: SqliteRows, waiting: int) -> None:
        self.commit_sizes: list[int] = []
        commits = rows._commits
        commit = commits._carry_out

        def gated(batch: Any) -> Any:
            if not self.commit_sizes:
                while len(commits._waiting) < waiting:
                    time.sleep(0.001)
            self.commit_sizes.append(len(batch))
            return commit(batch)

        commits._carry_out = gated


def test_concurrent_appends_share_one_commit(ledger: Ledger) -> None:
    gate = Gate(ledger.rows, waiting=31)
    replies = in_threads(32, lambda index: ledger.store.append(record("event", f"{index}")))
    assert gate.commit_sizes == [1, 31]
    assert sorted(reply.sequence for reply in replies) == list(range(32))
    assert {row.sequence: row.record_id for row in ledger.store.read("event")} == {
        reply.sequence: f"{index}" for index, reply in enumerate(replies)
    }


def test_a_commit_is_forced_to_the_disk(ledger: Ledger) -> None:
    assert ledger.rows._writer.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    assert ledger.rows._writer.execute("PRAGMA synchronous").fetchone() == (2,), "FULL: an fsync with every commit"


def test_a_refused_change_does_not_touch_the_others_of_its_commit(ledger: Ledger) -> None:
    ledger.store.append(record("event", "7", b"before"))
    gate = Gate(ledger.rows, waiting=15)

    def append(index: int) -> Appended:
        # Past the quick look, straight into the common transaction, where the conflict must be found as well.
        return ledger.rows.write(lambda transaction: ledger.store.add(transaction, record("event", f"{index}")))

    replies = in_threads(16, append)
    assert gate.commit_sizes == [1, 15]
    assert isinstance(replies[7], ConflictError)
    assert sorted(reply.sequence for index, reply in enumerate(replies) if index != 7) == list(range(1, 16))


def test_concurrent_appends_of_one_record_give_one_record(ledger: Ledger) -> None:
    Gate(ledger.rows, waiting=7)
    replies = in_threads(8, lambda _: ledger.store.append(record("event", "a"), [b"blob"]))
    assert {reply.sequence for reply in replies} == {0}
    assert sorted(reply.was_known for reply in replies) == [False] + [True] * 7
    assert ledger.store.positions() == {"event": 1}


def test_no_space_for_rows_acknowledges_nobody_and_passes(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session")
    ledger.store.append(record("event", "before", bytes(10_000)))
    (pages,) = ledger.rows._writer.execute("PRAGMA page_count").fetchone()
    ledger.rows._writer.execute(f"PRAGMA max_page_count = {pages + 1}")
    Gate(ledger.rows, waiting=3)
    replies = in_threads(4, lambda index: ledger.store.append(record("event", f"{index}", bytes(100_000))))
    assert all(isinstance(reply, DiskFullError) for reply in replies)
    assert [row.record_id for row in ledger.store.read("event")] == ["before"]
    ledger.rows._writer.execute("PRAGMA max_page_count = 1000000")
    assert ledger.store.append(record("event", "after", bytes(100_000))) == Appended(1, was_known=False)
    ledger.close()


def test_after_a_failed_write_nothing_more_is_acknowledged_until_it_is_opened_again(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session")
    ledger.store.append(record("event", "a"))

    def fail(_: Transaction) -> None:
        error = sqlite3.OperationalError("disk I/O error")
        error.sqlite_errorcode = sqlite3.SQLITE_IOERR_FSYNC  # type: ignore[attr-defined]
        raise error

    with pytest.raises(LedgerError, match="disk I/O error"):
        ledger.rows.write(fail)
    with pytest.raises(LedgerError, match="has to be opened again"):
        ledger.store.append(record("event", "b"))
    ledger.close()
    again = open_ledger(tmp_path / "session")
    assert again.store.append(record("event", "b")) == Appended(1, was_known=False)
    again.close()


# Schema


def test_an_older_schema_is_brought_up_to_date(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "session" / "ledger.db"
    path.parent.mkdir()
    with monkeypatch.context() as old:
        old.setattr(sqlite, "MIGRATIONS", schema.MIGRATIONS[:1])
        old.setattr(sqlite, "SCHEMA_VERSION", 1)
        rows = SqliteRows(path)
        rows.write(lambda transaction: transaction.set_meta("key", "kept"))
        rows.close()
    with sqlite3.connect(path) as connection:
        assert not connection.execute("SELECT * FROM sqlite_master WHERE name = 'jobs'").fetchall()
    connection.close()
    ledger = open_ledger(tmp_path / "session")
    assert ledger.rows.read(lambda reader: reader.find_meta("key")) == "kept"
    assert ledger.rows.read(lambda reader: reader.find_meta("schema_version")) == str(schema.SCHEMA_VERSION)
    assert ledger.jobs.counts() == {}
    ledger.close()


def test_a_session_with_all_blobs_in_files_is_brought_up_to_date_by_looking_at_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Schema 2 knew only blobs in files of their own."""
    folder = tmp_path / "session"
    files = BlobFiles(folder / "blobs")
    (stored,) = files.put([b"image"], keep_free_bytes=0)
    with monkeypatch.context() as old:
        old.setattr(sqlite, "MIGRATIONS", schema.MIGRATIONS[:2])
        old.setattr(sqlite, "SCHEMA_VERSION", 2)
        SqliteRows(folder / "ledger.db").close()
        with contextlib.closing(sqlite3.connect(folder / "ledger.db")) as connection, connection:
            connection.execute("INSERT INTO blobs VALUES (?, ?)", (stored.sha256, stored.size_bytes))
    with read_only(folder / "ledger.db") as reader:
        assert reader.blob_bytes() == stored.size_bytes
        assert list(reader.blobs()) == [(stored, None)]
    ledger = open_ledger(folder, packed_blob_bytes=100)
    ledger.store.append(record("keyframe", "a"), [], [stored])
    assert ledger.store.blob(stored.sha256) == b"image"
    ledger.close()
    assert check(folder).is_sound


def test_small_blobs_of_schema_3_stay_among_the_rows_and_heal_into_a_pack(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Schema 3 kept small blobs in a table."""
    folder = tmp_path / "session"
    folder.mkdir()
    contents = {entry(data).sha256: data for data in (b"image", b"depth")}
    with monkeypatch.context() as old:
        old.setattr(sqlite, "MIGRATIONS", schema.MIGRATIONS[:3])
        old.setattr(sqlite, "SCHEMA_VERSION", 3)
        SqliteRows(folder / "ledger.db").close()
        with contextlib.closing(sqlite3.connect(folder / "ledger.db")) as connection, connection:
            for sha256, data in contents.items():
                connection.execute("INSERT INTO blobs VALUES (?, ?, 0)", (sha256, len(data)))
                connection.execute("INSERT INTO contents VALUES (?, ?)", (sha256, data))
    with read_only(folder / "ledger.db") as reader:
        assert (reader.blob_bytes(), list(reader.blobs())) == (0, [])
    assert [stored_blob(folder, sha256) for sha256 in contents] == list(contents.values())
    ledger = open_ledger(folder, packed_blob_bytes=100)
    ledger.store.append(record("keyframe", "a"), [b"image"], [entry(b"image"), entry(b"depth")])
    assert [ledger.store.blob(sha256) for sha256 in contents] == list(contents.values())
    assert not list((folder / "blobs" / "packs").iterdir())
    ledger.close()
    assert check(folder).is_sound
    with contextlib.closing(sqlite3.connect(folder / "ledger.db")) as connection, connection:
        connection.execute("UPDATE contents SET content = ? WHERE sha256 = ?", (b"imagE", entry(b"image").sha256))
    (problem,) = check(folder).problems
    assert problem.startswith(f"keyframe/0 ('a'): blob {entry(b'image').sha256} is damaged")
    ledger = open_ledger(folder, packed_blob_bytes=100)
    assert ledger.store.append(record("keyframe", "a"), [b"image"], [entry(b"image")]).was_known
    assert ledger.store.blob(entry(b"image").sha256) == b"image"
    assert (folder / "blobs" / "packs" / "00000001.pack").read_bytes() == in_pack(b"image")
    ledger.close()
    assert check(folder).is_sound
    export_session(folder, tmp_path / "session.tar")
    import_session(tmp_path / "session.tar", tmp_path / "copy")
    assert check(tmp_path / "copy").is_sound
    assert [stored_blob(tmp_path / "copy", sha256) for sha256 in contents] == list(contents.values())


def test_rows_of_schema_4_have_no_digests_and_are_verified_as_far_as_they_can_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Schema 4 had digests of records only, which did not cover the blobs that they refer to."""
    folder, frame = tmp_path / "session", keyframe(0, b"image")
    ledger = open_ledger(folder)
    ledger.store.append(*admitted(append_request("keyframe", frame.keyframe_id, frame, [b"image"])))
    (row,) = ledger.store.read("keyframe")
    new = NewRecord(row.stream, row.record_id, row.payload_type, row.payload, row.identity_sha256)
    ledger.jobs.submit([predict("s0"), predict("s1")])
    assert ledger.jobs.claim([JobKind.PREDICT], [], "inference/a") is not None
    ledger.close()
    with monkeypatch.context() as old:
        old.setattr(sqlite, "MIGRATIONS", schema.MIGRATIONS[:4])
        old.setattr(sqlite, "SCHEMA_VERSION", 4)
        SqliteRows(tmp_path / "old.db").close()
    with contextlib.closing(sqlite3.connect(tmp_path / "old.db")) as connection, connection:
        connection.execute("DELETE FROM meta WHERE key = 'meta_sha256'")
        connection.execute("ATTACH ? AS new", (str(folder / "ledger.db"),))
        for table in ("streams", "records", "blobs", "record_blobs", "jobs", "leases"):
            columns = ", ".join(name for _, name, *_ in connection.execute(f"PRAGMA main.table_info({table})"))
            connection.execute(f"INSERT INTO main.{table} SELECT {columns} FROM new.{table}")
        connection.execute("UPDATE main.records SET row_sha256 = ?", (row_digest(new, 0, row.append_time_ns, None),))
    (tmp_path / "old.db").replace(folder / "ledger.db")
    looked = check(folder, repair=False)
    assert looked.is_sound and looked.repaired == (), looked
    ledger = open_ledger(folder)
    job, other = ledger.rows.read(lambda reader: (reader.find_job("s0"), reader.find_job("s1")))
    assert job is not None and other is not None
    assert job.progress_sha256 == job.progress_digest(), "it was leased and is open again"
    assert (job.content_sha256, other.content_sha256, other.progress_sha256) == ("", "", "")
    ledger.close()
    assert check(folder).repaired == ()
    with contextlib.closing(sqlite3.connect(folder / "ledger.db")) as connection, connection:
        connection.execute("DELETE FROM record_blobs")
    report = check(folder)
    assert report.is_sound and report.blob_count == 1
    assert len(report.repaired) == 1 and "was taken from the record" in report.repaired[0]
    with contextlib.closing(sqlite3.connect(folder / "ledger.db")) as connection, connection:
        connection.execute("UPDATE records SET payload = x'00'")
    (problem,) = check(folder).problems
    assert "not what was stored" in problem


def test_a_newer_schema_is_refused_and_not_touched(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session")
    ledger.rows.write(lambda transaction: transaction.set_meta("schema_version", str(schema.SCHEMA_VERSION + 1)))
    ledger.close()
    content = (tmp_path / "session" / "ledger.db").read_bytes()
    with pytest.raises(LedgerError, match=r"^.*was written by a newer version: its schema is \d+, .*$"):
        open_ledger(tmp_path / "session")
    with pytest.raises(LedgerError, match="newer version"), read_only(tmp_path / "session" / "ledger.db"):
        pass
    assert (tmp_path / "session" / "ledger.db").read_bytes() == content


@pytest.mark.parametrize(
    "content", [b"not a database at all, but long enough to look like one" * 100, b"SQLite format 3\0"]
)
def test_another_file_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "ledger.db").write_bytes(content)
    with pytest.raises(LedgerError):
        SqliteRows(tmp_path / "ledger.db")


def test_another_database_is_refused(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "ledger.db") as connection:
        connection.execute("CREATE TABLE t (a)")
    connection.close()
    with pytest.raises(LedgerError, match="not one of a ledger"):
        SqliteRows(tmp_path / "ledger.db")


@pytest.mark.parametrize("cut", [1, 24, 1000, 4096, 4097])
def test_a_torn_end_of_the_write_ahead_log_costs_no_acknowledged_record(tmp_path: Path, cut: int) -> None:
    """A power cut in mid-write: the log holds every acknowledged commit and a part of the next one."""
    ledger = open_ledger(tmp_path / "session")
    for index in range(10):
        ledger.store.append(record("event", f"{index}"))
    wal = tmp_path / "session" / "ledger.db-wal"
    acknowledged = wal.stat().st_size
    ledger.store.append(record("event", "torn", bytes(20_000)))
    image = tmp_path / "image"
    image.mkdir()
    (image / "ledger.db").write_bytes((tmp_path / "session" / "ledger.db").read_bytes())
    (image / "ledger.db-wal").write_bytes(wal.read_bytes()[: acknowledged + cut])
    ledger.close()
    recovered = open_ledger(image)
    assert [row.record_id for row in recovered.store.read("event")] == [f"{index}" for index in range(10)]
    assert recovered.store.append(record("event", "torn", bytes(20_000))) == Appended(10, was_known=False)
    recovered.close()
