from __future__ import annotations

import errno
import itertools
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vggt_motion.errors import DiskFullError, LedgerError
from vggt_motion.ledger.files import FileOperations
from vggt_motion.ledger.packs import PackFiles, read_place
from vggt_motion.ledger.store import Place


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
        assert after[0] > before[0] or after[1] == before[1] + before[2], "packs have neither gaps nor overlaps"
    again = PackFiles(folder, max_pack_bytes=max_bytes)
    (more,) = again.append([b"more"])
    assert [again.read(place) for place in (*flat, more)][-1] == b"more"
    assert [again.read(place) for place in flat] == [content for batch in batches for content in batch]
    assert again.unused_bytes([*flat, more]) == {}
    again.close()


def test_what_nobody_refers_to_at_the_end_is_cut_off(tmp_path: Path) -> None:
    packs = PackFiles(tmp_path / "packs")
    first, _ = packs.append([b"first", b"lost"])
    assert packs.unused_bytes([first]) == {1: 4}
    packs.cut_off(1, 4)
    assert (tmp_path / "packs" / "00000001.pack").read_bytes() == b"first"
    packs.close()


def test_a_place_that_is_not_there_reads_as_nothing(tmp_path: Path) -> None:
    packs = PackFiles(tmp_path / "packs")
    packs.append([b"abc"])
    assert packs.read(Place(2, 0, 3)) == b""
    assert packs.read(Place(1, 2, 3)) == b"c"
    packs.close()


class BrokenFiles(FileOperations):
    """Fails when it is told to, after half of the work."""

    step = ""

    def write_at(self, path: Path, descriptor: int, offset_bytes: int, pieces: Sequence[bytes]) -> None:
        if self.step == "write":
            super().write_at(path, descriptor, offset_bytes, [pieces[0][:2]])
            raise OSError(errno.ENOSPC, "injected")
        super().write_at(path, descriptor, offset_bytes, pieces)

    def sync_data(self, path: Path, descriptor: int) -> None:
        if self.step == "sync":
            raise OSError(errno.EIO, "injected")
        super().sync_data(path, descriptor)


def test_a_write_that_found_no_space_leaves_nothing_behind(tmp_path: Path) -> None:
    files = BrokenFiles()
    packs = PackFiles(tmp_path / "packs", files=files)
    (before,) = packs.append([b"before"])
    files.step = "write"
    with pytest.raises(DiskFullError, match="no space for 7 bytes"):
        packs.append([b"content"])
    files.step = ""
    (after,) = packs.append([b"content"])
    assert (tmp_path / "packs" / "00000001.pack").read_bytes() == b"beforecontent"
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


def test_callers_at_the_same_time_share_a_sync(tmp_path: Path) -> None:
    class Gated(FileOperations):
        def __init__(self) -> None:
            self.release = threading.Event()
            self.sync_count = 0

        def sync_data(self, path: Path, descriptor: int) -> None:
            self.sync_count += 1
            self.release.wait(10)
            super().sync_data(path, descriptor)

    files = Gated()
    packs = PackFiles(tmp_path / "packs", files=files)
    places: dict[int, Place] = {}

    def append(number: int) -> None:
        (places[number],) = packs.append([b"%d" % number])

    threads = [threading.Thread(target=append, args=(number,)) for number in range(8)]
    threads[0].start()
    while files.sync_count == 0:
        time.sleep(0.001)
    for thread in threads[1:]:
        thread.start()
    while packs._open[1]._shared_sync._asked < 8:
        time.sleep(0.001)
    files.release.set()
    for thread in threads:
        thread.join()
    assert files.sync_count == 2, "the second one stands for the seven that came during the first"
    assert all(packs.read(place) == b"%d" % number for number, place in places.items())
    packs.close()


def test_a_folder_that_cannot_be_used_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "packs").write_bytes(b"a file")
    with pytest.raises(LedgerError, match=r"^cannot use .*packs for packs: .+$"):
        PackFiles(tmp_path / "packs")
