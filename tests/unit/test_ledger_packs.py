from __future__ import annotations

import errno
import hashlib
import itertools
import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ledger_helpers import damage_blob, in_pack, open_ledger, record
from vggt_motion.direct import BLOCK_BYTES
from vggt_motion.errors import DiskFullError, LedgerError
from vggt_motion.ledger.check import check
from vggt_motion.ledger.files import FileOperations
from vggt_motion.ledger.log import Append, Appended, set_content_aside
from vggt_motion.ledger.packs import PackFiles, read_place
from vggt_motion.ledger.store import BlobEntry, DamagedBlobError, Place, UnknownError


def entry_of(content: bytes) -> BlobEntry:
    return BlobEntry(hashlib.sha256(content).hexdigest(), len(content))


@given(batches=st.lists(st.lists(st.binary(max_size=300), max_size=6), max_size=6), max_bytes=st.integers(1, 500))
@settings(max_examples=40, deadline=None)
def test_what_was_appended_is_read_again_by_this_and_another_process(
    tmp_path_factory: pytest.TempPathFactory, batches: list[list[bytes]], max_bytes: int
) -> None:
    folder = tmp_path_factory.mktemp("session") / "packs"
    packs = PackFiles(folder, max_pack_bytes=max_bytes)
    places = [packs.append(batch) for batch in batches]
    assert [[packs.read(place) for place in batch] for batch in places] == batches
    packs.close()
    flat = [place for batch in places for place in batch]
    assert [read_place(folder, place) for place in flat] == [content for batch in batches for content in batch]
    spans = sorted((place.pack, place.offset_bytes, place.size_bytes) for place in flat if place.size_bytes)
    for before, after in itertools.pairwise(spans):
        gap = after[1] - before[1] - before[2]
        assert after[0] > before[0] or gap == 0 or (0 < gap < BLOCK_BYTES and after[1] % BLOCK_BYTES == 0)
    again = PackFiles(folder, max_pack_bytes=max_bytes)
    (more,) = again.append([b"more"])
    assert [again.read(place) for place in (*flat, more)][-1] == b"more"
    assert [again.read(place) for place in flat] == [content for batch in batches for content in batch]
    assert again.unused_bytes([*flat, more]) == {}
    again.close()


def test_a_pack_that_does_not_end_with_a_block_is_read_and_gone_on_with(tmp_path: Path) -> None:
    """As those that were written by way of the cache."""
    (tmp_path / "packs").mkdir()
    (tmp_path / "packs" / "00000001.pack").write_bytes(b"first" + b"second")
    packs = PackFiles(tmp_path / "packs")
    before = [Place(1, 0, 5), Place(1, 5, 6)]
    assert packs.unused_bytes(before) == {}
    (after,) = packs.append([b"third"])
    assert after == Place(1, BLOCK_BYTES, 5)
    assert [packs.read(place) for place in (*before, after)] == [b"first", b"second", b"third"]
    assert [read_place(tmp_path / "packs", place) for place in (*before, after)] == [b"first", b"second", b"third"]
    packs.close()


def test_what_nobody_refers_to_at_the_end_is_cut_off(tmp_path: Path) -> None:
    packs = PackFiles(tmp_path / "packs")
    (first,) = packs.append([b"first"])
    packs.append([b"lost", b"and more"])
    assert packs.unused_bytes([first]) == {1: BLOCK_BYTES}
    packs.cut_off(1, BLOCK_BYTES)
    assert (tmp_path / "packs" / "00000001.pack").read_bytes() == in_pack(b"first")
    packs.close()


def test_a_place_that_is_not_there_reads_as_nothing(tmp_path: Path) -> None:
    packs = PackFiles(tmp_path / "packs")
    packs.append([b"abc"])
    assert packs.read(Place(2, 0, 3)) == b""
    assert packs.read(Place(1, BLOCK_BYTES - 1, 3)) == b"\0"
    assert packs.read(Place(1, BLOCK_BYTES, 3)) == b""
    packs.close()


class BrokenFiles(FileOperations):
    """Fails when it is told to, after half of the work."""

    step = ""

    def write_blocks(self, path: Path, descriptor: int, offset_bytes: int, blocks: memoryview) -> None:
        if self.step == "write":
            super().write_blocks(path, descriptor, offset_bytes, blocks[:BLOCK_BYTES])
            raise OSError(errno.ENOSPC, "injected")
        super().write_blocks(path, descriptor, offset_bytes, blocks)

    def sync_data(self, path: Path, descriptor: int) -> None:
        if self.step == "sync":
            raise OSError(errno.EIO, "injected")
        super().sync_data(path, descriptor)


def test_a_write_that_found_no_space_leaves_nothing_behind(tmp_path: Path) -> None:
    files = BrokenFiles()
    packs = PackFiles(tmp_path / "packs", files=files)
    (before,) = packs.append([b"before"])
    files.step = "write"
    with pytest.raises(DiskFullError, match="no space for 10000 bytes"):
        packs.append([bytes(10_000)])
    files.step = ""
    (after,) = packs.append([b"content"])
    assert (tmp_path / "packs" / "00000001.pack").read_bytes() == in_pack(b"before", b"content")
    assert (packs.read(before), packs.read(after)) == (b"before", b"content")
    packs.close()


def test_nothing_goes_behind_a_sync_that_failed(tmp_path: Path) -> None:
    """After a failed fsync Linux may call the next one a success although the content is gone."""
    files = BrokenFiles()
    packs = PackFiles(tmp_path / "packs", files=files)
    (before,) = packs.append([b"before"])
    files.step = "sync"
    with pytest.raises(LedgerError, match="injected"):
        packs.append([b"content"])
    files.step = ""
    (after,) = packs.append([b"content"])
    assert (before.pack, after) == (1, Place(2, 0, 7))
    assert (packs.read(before), packs.read(after)) == (b"before", b"content")
    packs.close()


class GatedFiles(FileOperations):
    """Holds the first sync until it is released; may let it fail."""

    def __init__(self, *, fails: bool) -> None:
        self.release = threading.Event()
        self.sync_count = 0
        self.fails = fails

    def sync_data(self, path: Path, descriptor: int) -> None:
        self.sync_count += 1
        is_first = self.sync_count == 1
        self.release.wait(10)
        if is_first and self.fails:
            raise OSError(errno.EIO, "injected")
        super().sync_data(path, descriptor)


def append_behind_the_first_sync(packs: PackFiles, files: GatedFiles, count: int) -> list[list[Place] | LedgerError]:
    """Append 0, 1, ... from as many threads, all but the first while the first one syncs; what became of each."""
    outcomes: dict[int, list[Place] | LedgerError] = {}

    def append(number: int) -> None:
        try:
            outcomes[number] = packs.append([b"%d" % number])
        except LedgerError as error:
            outcomes[number] = error

    threads = [threading.Thread(target=append, args=(number,)) for number in range(count)]
    threads[0].start()
    while files.sync_count == 0:
        time.sleep(0.001)
    for thread in threads[1:]:
        thread.start()
    while packs._open[1]._shared_sync._asked < count:
        time.sleep(0.001)
    files.release.set()
    for thread in threads:
        thread.join()
    return [outcomes[number] for number in range(count)]


def test_who_wrote_behind_a_sync_that_failed_is_not_told_that_all_is_well(tmp_path: Path) -> None:
    files = GatedFiles(fails=True)
    packs = PackFiles(tmp_path / "packs", files=files)
    outcomes = append_behind_the_first_sync(packs, files, 4)
    assert [type(outcome) for outcome in outcomes] == [LedgerError] * 4
    assert packs.append([b"later"]) == [Place(2, 0, 5)]
    packs.close()


def test_a_part_of_the_disk_that_cannot_be_read_is_as_damaged_as_any(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=100)
    entries = {data: BlobEntry(hashlib.sha256(data).hexdigest(), len(data)) for data in (b"lost", b"kept")}
    for data, entry in entries.items():
        ledger.store.append(record("keyframe", data.decode()), [data], [entry])
    real = os.preadv

    def preadv(descriptor: int, buffers: list[memoryview], offset: int) -> int:
        if offset == 0:
            raise OSError(errno.EIO, "injected")
        return real(descriptor, buffers, offset)

    monkeypatch.setattr("vggt_motion.direct.os.preadv", preadv)
    with pytest.raises(DamagedBlobError):
        ledger.store.blob(entries[b"lost"].sha256)
    assert ledger.store.blob(entries[b"kept"].sha256) == b"kept"
    assert ledger.store.append(record("keyframe", "lost"), [b"lost"], [entries[b"lost"]]).was_known
    assert ledger.store.blob(entries[b"lost"].sha256) == b"lost"
    ledger.close()


def test_a_known_record_whose_pack_is_gone_is_not_acknowledged_without_its_blob(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=100)
    entry = entry_of(b"image")
    ledger.store.append(record("keyframe", "a"), [b"image"], [entry])
    ledger.close()
    (tmp_path / "session" / "blobs" / "packs" / "00000001.pack").unlink()
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=100)
    with pytest.raises(UnknownError):
        ledger.store.append(record("keyframe", "b"), [], [entry])
    assert ledger.store.append(record("keyframe", "a"), [b"image"], [entry]).was_known
    assert ledger.store.blob(entry.sha256) == b"image"
    ledger.close()


def test_records_that_are_new_in_all_look_at_nothing_before_their_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=1000)
    reads = 0
    read = ledger.rows.read

    def counted(query: Any) -> Any:
        nonlocal reads
        reads += 1
        return read(query)

    monkeypatch.setattr(ledger.rows, "read", counted)
    images = [b"one", b"two"]
    together = [Append(record("keyframe", f"{n}"), [image], [entry_of(image)]) for n, image in enumerate(images)]
    together.append(Append(record("keyframe", "2"), [b"one"], [entry_of(b"one")]))
    assert [o.sequence for o in ledger.store.append_all(together) if isinstance(o, Appended)] == [0, 1, 2]
    assert reads == 0
    assert [ledger.store.blob(entry_of(image).sha256) for image in images] == images
    ledger.close()
    assert (tmp_path / "session" / "blobs" / "packs" / "00000001.pack").read_bytes() == in_pack(b"onetwo")
    assert check(tmp_path / "session").is_sound


def test_a_pack_that_finds_no_space_holds_up_only_what_brings_blobs(tmp_path: Path) -> None:
    files = BrokenFiles()
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=1000, files=files)
    together = [
        Append(record("event", "before")),
        Append(record("keyframe", "0"), [b"image"], [entry_of(b"image")]),
        Append(record("event", "after")),
    ]
    files.step = "write"
    outcomes = ledger.store.append_all(together)
    assert [type(outcome) for outcome in outcomes] == [Appended, DiskFullError, Appended]
    files.step = ""
    assert [o.was_known for o in ledger.store.append_all(together) if isinstance(o, Appended)] == [True, False, True]
    assert [row.record_id for row in ledger.store.read("event")] == ["before", "after"]
    assert ledger.store.blob(entry_of(b"image").sha256) == b"image"
    ledger.close()
    assert check(tmp_path / "session").is_sound


def test_a_pack_that_cannot_be_forced_to_the_disk_acknowledges_nobody(tmp_path: Path) -> None:
    files = BrokenFiles()
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=1000, files=files)
    files.step = "sync"
    together = [
        Append(record("event", "before")),
        Append(record("keyframe", "0"), [b"image"], [entry_of(b"image")]),
    ]
    outcomes = ledger.store.append_all(together)
    assert [type(outcome) for outcome in outcomes] == [LedgerError, LedgerError]
    assert ledger.store.positions() == {}
    ledger.close()


def test_setting_aside_what_was_damaged_leaves_what_has_come_back(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=100)
    entry = entry_of(b"image")
    ledger.store.append(record("keyframe", "a"), [b"image"], [entry])
    damage_blob(tmp_path / "session", entry.sha256, b"imagE")
    ledger.store.append(record("keyframe", "b"), [b"image"], [entry])
    set_content_aside(ledger.rows, ledger.blobs, entry.sha256, b"imagE", Place(1, 0, 5))
    assert ledger.store.blob(entry.sha256) == b"image"
    ledger.close()


def test_after_the_end_nothing_is_written_into_what_may_be_somebody_elses(tmp_path: Path) -> None:
    packs = PackFiles(tmp_path / "packs")
    (place,) = packs.append([b"abc"])
    packs.close()
    for call in (lambda: packs.append([b"more"]), lambda: packs.read(place)):
        with pytest.raises(LedgerError, match="the session is closed"):
            call()
    assert (tmp_path / "packs" / "00000001.pack").read_bytes() == in_pack(b"abc")


def test_callers_at_the_same_time_share_a_sync(tmp_path: Path) -> None:
    files = GatedFiles(fails=False)
    packs = PackFiles(tmp_path / "packs", files=files)
    outcomes = append_behind_the_first_sync(packs, files, 8)
    assert files.sync_count == 2, "the second one stands for the seven that came during the first"
    places = [place for outcome in outcomes if isinstance(outcome, list) for place in outcome]
    assert [packs.read(place) for place in places] == [b"%d" % number for number in range(8)]
    packs.close()


def test_a_folder_that_cannot_be_used_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "packs").write_bytes(b"a file")
    with pytest.raises(LedgerError, match=r"^cannot use .*packs for packs: .+$"):
        PackFiles(tmp_path / "packs")


class FullFiles(FileOperations):
    """Finds no space for what it is told to."""

    fails_at: frozenset[int] = frozenset()

    def write_blocks(self, path: Path, descriptor: int, offset_bytes: int, blocks: memoryview) -> None:
        if offset_bytes in self.fails_at:
            raise OSError(errno.ENOSPC, "injected")
        super().write_blocks(path, descriptor, offset_bytes, blocks)


@pytest.mark.parametrize("size_bytes", [5000, 600_000], ids=["at once", "in the background"])
def test_a_place_that_was_given_up_is_never_written_again(tmp_path: Path, size_bytes: int) -> None:
    """Not by whoever waits once more for what failed: it may be somebody else's."""
    files = FullFiles()
    files.fails_at = frozenset({0})
    packs = PackFiles(tmp_path / "packs", files=files)
    failed = packs.begin([b"x" * size_bytes])
    with pytest.raises(DiskFullError):
        failed.wait()
    files.fails_at = frozenset()
    (place,) = packs.append([b"mine"])
    assert place.offset_bytes == 0
    with pytest.raises(DiskFullError):
        failed.wait()
    assert packs.read(place) == b"mine"
    packs.close()


def test_rooms_that_are_given_up_in_any_order_are_used_again(tmp_path: Path) -> None:
    files = FullFiles()
    packs = PackFiles(tmp_path / "packs", files=files)
    (kept,) = packs.append([b"kept"])
    files.fails_at = frozenset(BLOCK_BYTES * number for number in (1, 2, 3))
    writings = [packs.begin([b"%d" % number]) for number in range(3)]
    for writing in (writings[1], writings[0], writings[2]):
        with pytest.raises(DiskFullError):
            writing.wait()
    files.fails_at = frozenset()
    assert packs.append([b"next"]) == [Place(1, BLOCK_BYTES, 4)]
    assert packs.read(kept) == b"kept"
    packs.close()


def test_files_are_closed_only_when_nothing_is_being_written(tmp_path: Path) -> None:
    files = GatedFiles(fails=False)
    packs = PackFiles(tmp_path / "packs", files=files)
    outcome: list[Any] = []
    writing = threading.Thread(target=lambda: outcome.append(packs.append([bytes(100_000)])))
    writing.start()
    while files.sync_count == 0:
        time.sleep(0.001)
    closing = threading.Thread(target=packs.close)
    closing.start()
    time.sleep(0.05)
    assert closing.is_alive()
    with pytest.raises(LedgerError, match="the session is closed"):
        packs.begin([bytes(600_000)])
    files.release.set()
    writing.join()
    closing.join()
    assert outcome == [[Place(1, 0, 100_000)]]
