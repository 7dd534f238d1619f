from __future__ import annotations

import errno
import hashlib
import shutil
import threading
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vggt_motion.errors import DiskFullError, LedgerError, RequestRefusedError
from vggt_motion.ledger.blobs import BlobFiles
from vggt_motion.ledger.files import FileOperations
from vggt_motion.ledger.store import BlobEntry, DamagedBlobError, InvalidRequestError, UnknownError


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


@pytest.fixture
def blobs(tmp_path: Path) -> BlobFiles:
    return BlobFiles(tmp_path / "blobs")


def stored_file(tmp_path: Path, data: bytes) -> Path:
    return tmp_path / "blobs" / digest(data)


@given(contents=st.lists(st.binary(max_size=200), max_size=5))
@settings(max_examples=30)
def test_what_is_put_is_got(tmp_path_factory: pytest.TempPathFactory, contents: list[bytes]) -> None:
    store = BlobFiles(tmp_path_factory.mktemp("session") / "blobs")
    entries = store.put(contents, keep_free_bytes=0)
    assert entries == [BlobEntry(digest(data), len(data)) for data in contents]
    assert [store.get(entry.sha256) for entry in entries] == contents
    assert list(store.names()) == sorted({digest(data) for data in contents})


def test_equal_content_is_stored_once(blobs: BlobFiles, tmp_path: Path) -> None:
    blobs.put([b"a", b"a"], keep_free_bytes=0)
    inode = stored_file(tmp_path, b"a").stat().st_ino
    blobs.put([b"a"], keep_free_bytes=0)
    assert stored_file(tmp_path, b"a").stat().st_ino == inode
    assert list(blobs.names()) == [digest(b"a")]


def test_an_unknown_blob_is_refused(blobs: BlobFiles) -> None:
    with pytest.raises(UnknownError, match=digest(b"nothing")):
        blobs.get(digest(b"nothing"))


@pytest.mark.parametrize("name", ["", "..", "../" * 21 + "a", "A" * 64, "a" * 63, "a" * 65, "a" * 64 + "\n", "g" * 64])
def test_a_name_that_is_no_hash_reaches_no_file(blobs: BlobFiles, name: str) -> None:
    with pytest.raises(InvalidRequestError):
        blobs.get(name)


@pytest.mark.parametrize("damage", [b"torn", b"", b"whole contenT", b"whole content and more"])
def test_a_damaged_blob_is_noticed_set_aside_and_healed_by_putting_it_again(
    blobs: BlobFiles, tmp_path: Path, damage: bytes
) -> None:
    data = b"whole content"
    blobs.put([data], keep_free_bytes=0)
    stored_file(tmp_path, data).write_bytes(damage)
    with pytest.raises(DamagedBlobError, match="damaged"):
        blobs.get(digest(data))
    assert (tmp_path / "blobs" / "damaged" / digest(data)).read_bytes() == damage
    assert not blobs.has(digest(data), len(data))
    blobs.put([data], keep_free_bytes=0)
    assert blobs.get(digest(data)) == data


def test_putting_heals_a_damaged_blob_that_nobody_has_read(blobs: BlobFiles, tmp_path: Path) -> None:
    blobs.put([b"abc"], keep_free_bytes=0)
    stored_file(tmp_path, b"abc").write_bytes(b"abd")
    blobs.put([b"abc"], keep_free_bytes=0)
    assert blobs.get(digest(b"abc")) == b"abc"


def test_the_reserve_is_kept(tmp_path: Path) -> None:
    free_bytes = 600
    store = BlobFiles(tmp_path / "blobs", free_bytes=lambda: free_bytes)
    store.put([bytes(400)], keep_free_bytes=600)
    with pytest.raises(DiskFullError, match="no space for 601 bytes"):
        store.put([bytes(300), b"\1" * 301], keep_free_bytes=600)
    free_bytes = 599
    with pytest.raises(DiskFullError, match="MiB left"):
        store.put([b"one"], keep_free_bytes=600)
    assert list(store.names()) == [digest(bytes(400))]
    free_bytes = 600
    store.put([b"one"], keep_free_bytes=600)


def test_writes_at_the_same_time_do_not_overshoot_the_reserve_together(tmp_path: Path) -> None:
    both_ask = threading.Barrier(2, timeout=10)

    class SlowFiles(FileOperations):
        def write_and_sync(self, path: Path, data: bytes) -> None:
            both_ask.wait()  # the second one has been refused by now, or this breaks
            super().write_and_sync(path, data)

    store = BlobFiles(tmp_path / "blobs", free_bytes=lambda: 1000, files=SlowFiles())
    writer = threading.Thread(target=lambda: store.put([bytes(700)], keep_free_bytes=0))
    writer.start()
    while store._claimed_bytes == 0:
        time.sleep(0.001)
    with pytest.raises(DiskFullError):
        store.put([b"\1" * 700], keep_free_bytes=0)
    both_ask.wait()
    writer.join()
    assert list(store.names()) == [digest(bytes(700))]


class GatedFiles(FileOperations):
    """Holds the first sync of the folder of blobs until it is released; may let it fail."""

    def __init__(self) -> None:
        self.release = threading.Event()
        self.release.set()
        self.sync_count = 0
        self.fails = False

    def sync_folder(self, folder: Path) -> None:
        if folder.name == "blobs":
            self.sync_count += 1
            is_first = not self.release.is_set() and self.sync_count == 1
            self.release.wait(10)
            if is_first and self.fails:
                raise OSError(errno.EIO, "injected")
        super().sync_folder(folder)


@pytest.mark.parametrize("fails", [False, True])
def test_writes_at_the_same_time_share_the_sync_of_their_names(tmp_path: Path, fails: bool) -> None:
    files = GatedFiles()
    store = BlobFiles(tmp_path / "blobs", files=files)
    files.release.clear()
    files.sync_count, files.fails = 0, fails
    outcomes: dict[int, object] = {}

    def put(number: int) -> None:
        try:
            outcomes[number] = store.put([number.to_bytes(4, "little")], keep_free_bytes=0)
        except LedgerError as error:
            outcomes[number] = error

    threads = [threading.Thread(target=put, args=(number,)) for number in range(8)]
    threads[0].start()
    while files.sync_count == 0:
        time.sleep(0.001)
    for thread in threads[1:]:
        thread.start()
    while store._sync_names._asked < 8:
        time.sleep(0.001)
    files.release.set()
    for thread in threads:
        thread.join()
    assert files.sync_count == 2, "the second one stands for the seven that came during the first"
    assert isinstance(outcomes[0], LedgerError) == fails, "who waited does not share the failure of another"
    assert [isinstance(outcomes[number], list) for number in range(1, 8)] == [True] * 7


class FailingFiles(FileOperations):
    """Fails at one step, after half of the work."""

    def __init__(self, step: str, code: int) -> None:
        self.step = step
        self.code = code
        self.is_armed = False

    def _fail(self, step: str) -> None:
        if self.is_armed and step == self.step:
            raise OSError(self.code, "injected")

    def write_and_sync(self, path: Path, data: bytes) -> None:
        if self.is_armed and self.step == "write":
            path.write_bytes(data[: len(data) // 2])
        self._fail("write")
        super().write_and_sync(path, data)

    def rename(self, source: Path, target: Path) -> None:
        self._fail("rename")
        super().rename(source, target)

    def sync_folder(self, folder: Path) -> None:
        self._fail("sync")
        super().sync_folder(folder)


@pytest.mark.parametrize("step", ["write", "rename", "sync"])
@pytest.mark.parametrize(
    ("code", "expected"), [(errno.ENOSPC, DiskFullError), (errno.EDQUOT, DiskFullError), (errno.EIO, LedgerError)]
)
def test_a_failing_write_acknowledges_nothing_and_leaves_nothing_half(
    tmp_path: Path, step: str, code: int, expected: type[LedgerError]
) -> None:
    files = FailingFiles(step, code)
    store = BlobFiles(tmp_path / "blobs", files=files)
    store.put([b"before"], keep_free_bytes=0)
    files.is_armed = True
    with pytest.raises(expected) as caught:
        store.put([b"content"], keep_free_bytes=0)
    assert isinstance(caught.value, DiskFullError) == (expected is DiskFullError)
    assert list((tmp_path / "blobs" / "incoming").iterdir()) == []
    files.is_armed = False
    assert store.get(digest(b"before")) == b"before"
    store.put([b"content"], keep_free_bytes=0)
    assert store.get(digest(b"content")) == b"content"


def test_what_an_interrupted_write_left_is_removed_at_the_start(tmp_path: Path) -> None:
    BlobFiles(tmp_path / "blobs").put([b"kept"], keep_free_bytes=0)
    (tmp_path / "blobs" / "incoming" / f"{digest(b'torn')}.0").write_bytes(b"to")
    store = BlobFiles(tmp_path / "blobs")
    assert list((tmp_path / "blobs" / "incoming").iterdir()) == []
    assert store.get(digest(b"kept")) == b"kept"


def test_a_folder_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "blobs").write_bytes(b"a file")
    with pytest.raises(LedgerError, match=r"^cannot use .*blobs for blobs: .+$"):
        BlobFiles(tmp_path / "blobs")


class CrashingDisk(FileOperations):
    """Keeps the worst that a power cut may leave: unsynced entries and contents are gone.

    It knows which names of files and folders are durable (their folder was synced after they came into being). Model of
    what POSIX promises, not of a particular file system: nothing is durable until it is synced.
    """

    def __init__(self) -> None:
        self.durable_content: dict[Path, bytes] = {}  # by present name; content that was synced
        self.pending: list[Path] = []  # entries of folders that are not durable yet
        self.durable_names: dict[Path, bytes] = {}

    def write_and_sync(self, path: Path, data: bytes) -> None:
        super().write_and_sync(path, data)
        self.durable_content[path] = data
        self.pending.append(path)

    def rename(self, source: Path, target: Path) -> None:
        super().rename(source, target)
        self.durable_content[target] = self.durable_content.pop(source)
        self.pending.append(target)

    def sync_folder(self, folder: Path) -> None:
        super().sync_folder(folder)
        for path in self.pending:
            if path.parent == folder and path in self.durable_content:
                self.durable_names[path] = self.durable_content[path]

    def restore(self, source: Path, target: Path) -> None:
        """The folder after the power came back."""
        for path, data in self.durable_names.items():
            copy = target / path.relative_to(source)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(data)


class StopAfter(CrashingDisk):
    """The power goes after a number of operations."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.left = count

    def _spend(self) -> None:
        if self.left == 0:
            raise KeyboardInterrupt
        self.left -= 1

    def write_and_sync(self, path: Path, data: bytes) -> None:
        self._spend()
        super().write_and_sync(path, data)

    def rename(self, source: Path, target: Path) -> None:
        self._spend()
        super().rename(source, target)

    def sync_folder(self, folder: Path) -> None:
        self._spend()
        super().sync_folder(folder)


@pytest.mark.parametrize("operations", range(40))
def test_every_acknowledged_blob_survives_a_power_cut_at_any_operation(tmp_path: Path, operations: int) -> None:
    disk = StopAfter(operations)
    contents = [[b"first"], [b"second", b"third"], [b"first", b"fourth"], [bytes(10_000)], [b"second"]]
    acknowledged: list[bytes] = []
    try:
        store = BlobFiles(tmp_path / "before" / "blobs", files=disk)
        for batch in contents:
            store.put(batch, keep_free_bytes=0)
            acknowledged += batch
    except KeyboardInterrupt:
        pass
    disk.restore(tmp_path / "before", tmp_path / "after")
    survived = BlobFiles(tmp_path / "after" / "blobs")
    for data in acknowledged:
        assert survived.get(digest(data)) == data
    shutil.rmtree(tmp_path / "after")
    assert operations < 30 or acknowledged == [data for batch in contents for data in batch]


def test_the_crash_model_notices_a_missing_sync(tmp_path: Path) -> None:
    """Guards the test above: without the sync of the folder it must fail."""

    class Forgetful(CrashingDisk):
        def sync_folder(self, folder: Path) -> None:
            pass

    disk = Forgetful()
    BlobFiles(tmp_path / "before" / "blobs", files=disk).put([b"lost"], keep_free_bytes=0)
    disk.restore(tmp_path / "before", tmp_path / "after")
    with pytest.raises(RequestRefusedError):
        BlobFiles(tmp_path / "after" / "blobs").get(digest(b"lost"))
