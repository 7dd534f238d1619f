from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vggt_motion.bus import calls, codec, parcels
from vggt_motion.bus.parcels import MIN_PARCEL_BYTES, MemoryParcels, Parcels, open_parcels
from vggt_motion.bus.wire import Pieces
from vggt_motion.config import BusConfig
from vggt_motion.errors import BusUnavailableError

LONG = bytes(range(256)) * 600
pytestmark = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="no memory as a file system here")


@pytest.fixture
def memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in place of that of the machine."""
    monkeypatch.setattr(parcels, "_MEMORY", tmp_path)
    return tmp_path


@pytest.fixture
def sides(memory: Path) -> Iterator[tuple[MemoryParcels, MemoryParcels]]:
    folder = memory / "vggt_motion-0-session"
    pair = MemoryParcels(folder), MemoryParcels(folder)
    yield pair
    for side in pair:
        side.close()
    assert not folder.exists(), "the folder goes with the last one"


def left_in(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if path.suffix != ".lock"]


def test_what_one_side_leaves_the_other_takes(sides: tuple[MemoryParcels, MemoryParcels]) -> None:
    here, there = sides
    assert here.is_near(there.greeting) and there.is_near(here.greeting)
    parcel = here.leave(LONG)
    assert parcel is not None
    assert there.is_near(parcel.attachment)
    assert there.size_bytes(parcel.attachment) == len(LONG)
    assert there.take(b"", parcel.attachment) == LONG
    assert there.take(b"", parcel.attachment, is_last_reader=True) == LONG
    with pytest.raises(BusUnavailableError, match="cannot be read"):
        there.take(b"", parcel.attachment)
    parcel.remove()


def test_messages_carry_what_is_short_or_comes_without_a_parcel(sides: tuple[MemoryParcels, MemoryParcels]) -> None:
    here, there = sides
    assert here.leave(bytes(MIN_PARCEL_BYTES - 1)) is None
    for attachment in (None, here.greeting):
        assert there.take(b"payload", attachment) == b"payload"
        assert there.size_bytes(attachment) == 0
    assert not there.is_near(None)


def test_sides_with_different_folders_are_not_near(memory: Path) -> None:
    here, there = MemoryParcels(memory / "vggt_motion-0-a"), MemoryParcels(memory / "vggt_motion-0-b")
    parcel = here.leave(LONG)
    assert parcel is not None
    assert not there.is_near(here.greeting) and not there.is_near(parcel.attachment)
    assert there.take(b"payload", here.greeting) == b"payload"
    for other in (there, Parcels()):
        with pytest.raises(BusUnavailableError, match="send it"):
            other.take(b"", parcel.attachment)
    here.close()
    there.close()
    assert list(memory.iterdir()) == []


def test_without_space_nothing_is_left(
    sides: tuple[MemoryParcels, MemoryParcels], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.statvfs

    class Full:
        def __init__(self, path: Path) -> None:
            self.f_frsize = real(path).f_frsize
            self.f_bavail = 3 * len(LONG) // self.f_frsize - 1

    monkeypatch.setattr(parcels.os, "statvfs", Full)
    assert sides[0].leave(LONG) is None
    assert sides[0].leave(LONG[:-8192]) is not None


@pytest.mark.parametrize("name", ["fifo", "link", "short", "folder", "missing"])
def test_what_is_not_the_file_that_was_spoken_of_is_neither_read_nor_waited_for(
    sides: tuple[MemoryParcels, MemoryParcels], memory: Path, name: str
) -> None:
    here = sides[0]
    folder = memory / "vggt_motion-0-session"
    os.mkfifo(folder / "fifo")
    (folder / "target").write_bytes(bytes(100))
    (folder / "link").symlink_to(folder / "target")
    (folder / "short").write_bytes(bytes(99))
    (folder / "folder").mkdir()
    attachment = codec.encode(calls.Parcel(codec.decode(calls.Parcel, here.greeting or b"").folder_id, name, 100))
    with pytest.raises(BusUnavailableError):
        here.take(b"", attachment)
    for path in ("fifo", "link", "short", "target"):
        (folder / path).unlink()
    (folder / "folder").rmdir()


parcels_of_others = st.builds(
    lambda name, size_bytes: codec.encode(calls.Parcel("0" * 32, name, size_bytes)),
    st.from_regex("[0-9a-z-]{1,64}", fullmatch=True),
    st.integers(0, 2**29),
)


@given(attachment=st.binary(max_size=200) | parcels_of_others)
@settings(max_examples=200, deadline=None)
def test_any_attachment_gives_the_payload_or_one_clear_refusal(
    tmp_path_factory: pytest.TempPathFactory, attachment: bytes
) -> None:
    side = MemoryParcels(tmp_path_factory.mktemp("memory") / "vggt_motion-0-fuzz")
    assert not side.is_near(attachment)
    if side.size_bytes(attachment):
        with pytest.raises(BusUnavailableError, match=r"\A[^\n]+\Z"):
            side.take(b"payload", attachment)
    else:
        assert side.take(b"payload", attachment) == b"payload"
    side.close()


def test_answers_that_nobody_takes_are_removed_after_a_while(
    sides: tuple[MemoryParcels, MemoryParcels], memory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = memory / "vggt_motion-0-session"
    monkeypatch.setattr(parcels, "_ANSWER_LIFE_S", 0.2)
    for _ in range(2):
        assert sides[0].leave_answer(LONG) is not None
    kept = sides[0].leave(LONG)
    assert kept is not None and len(left_in(folder)) == 3
    deadline = time.monotonic() + 20.0
    while len(left_in(folder)) > 1:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    monkeypatch.undo()
    assert sides[0].leave_answer(LONG) is not None
    sides[0].close()
    assert left_in(folder) == []


def test_what_a_killed_process_left_is_cleared_up_by_the_next_one(memory: Path) -> None:
    folder = memory / "vggt_motion-0-session"
    code = f"""
import os, signal, sys
from pathlib import Path
from vggt_motion.bus.parcels import MemoryParcels
side = MemoryParcels(Path({str(folder)!r}))
assert side.leave(bytes(200_000)) is not None
os.kill(os.getpid(), signal.SIGKILL)
"""
    alive = MemoryParcels(folder)
    kept = alive.leave(LONG)
    assert kept is not None
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    assert len(left_in(folder)) == 2
    elsewhere = MemoryParcels(memory / "vggt_motion-0-other")
    assert left_in(folder) == [codec.decode(calls.Parcel, kept.attachment).name]
    elsewhere.close()
    alive.close()
    assert list(memory.iterdir()) == []


def test_a_folder_that_others_may_open_is_not_used(memory: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    config = BusConfig()
    opened = open_parcels(config)
    assert isinstance(opened, MemoryParcels)
    (folder,) = memory.iterdir()
    opened.close()
    folder.mkdir(mode=0o755)
    folder.chmod(0o755)
    assert type(open_parcels(config)) is Parcels
    assert "are sent to processes of this machine too" in caplog.text
    folder.rmdir()
    folder.symlink_to(memory)
    assert type(open_parcels(config)) is Parcels
    folder.unlink()
    assert type(open_parcels(config.model_copy(update={"local_parcels": False}))) is Parcels
    assert list(memory.iterdir()) == []


def test_a_link_in_the_place_of_a_folder_leads_nowhere(memory: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Anybody may make one: whose name it bears is not whose it is."""
    precious = tmp_path_factory.mktemp("home")
    (precious / "uv.lock").write_text("mine")
    (precious / "uv-build.toml").write_text("mine")
    (memory / f"vggt_motion-{os.geteuid()}-x").symlink_to(precious)
    opened = open_parcels(BusConfig())
    assert isinstance(opened, MemoryParcels)
    (folder,) = (path for path in memory.iterdir() if not path.is_symlink())
    (folder / "other.lock").symlink_to(precious / "uv.lock")
    opened.close()
    assert sorted(path.name for path in precious.iterdir()) == ["uv-build.toml", "uv.lock"]


def test_a_parcel_that_meets_the_end_of_its_owner_is_not_left_behind(
    sides: tuple[MemoryParcels, MemoryParcels], memory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = parcels.Parcel.fill

    def closing(self: parcels.Parcel, payload: bytes, folder_id: str) -> None:
        sides[0].close()
        real(self, payload, folder_id)

    monkeypatch.setattr(parcels.Parcel, "fill", closing)
    assert sides[0].leave(LONG) is None
    assert left_in(memory / "vggt_motion-0-session") == []


def test_what_was_read_is_filled_again_under_another_name(
    sides: tuple[MemoryParcels, MemoryParcels], memory: Path
) -> None:
    here, there = sides
    folder = memory / "vggt_motion-0-session"
    first = here.leave(LONG)
    assert first is not None
    known = first.attachment
    here.take_back(first, is_read=True)
    assert there.take(b"", known) == LONG, "its name is taken away when it is filled again"
    second = here.leave(Pieces([LONG[::-1], b"", LONG]))
    assert second is first and len(left_in(folder)) == 1
    assert there.take(b"", second.attachment) == LONG[::-1] + LONG
    with pytest.raises(BusUnavailableError):
        there.take(b"", known)
    here.take_back(second, is_read=True)
    third = here.leave(LONG)
    assert third is first and there.take(b"", third.attachment) == LONG, "shorter than what it held before"
    here.take_back(third, is_read=False)
    assert left_in(folder) == [], "whoever did not answer may read it yet: it is not filled again"
    kept = [here.leave(bytes(5 * 2**20)) for _ in range(5)]
    for parcel in kept:
        assert parcel is not None
        here.take_back(parcel, is_read=True)
    assert len(left_in(folder)) == 3, "little memory is kept"


def test_a_parcel_that_is_filled_again_while_it_is_read_is_not_taken(
    sides: tuple[MemoryParcels, MemoryParcels], monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = sides
    parcel = here.leave(LONG)
    assert parcel is not None
    here.take_back(parcel, is_read=True)
    known, real = parcel.attachment, os.read

    def reading(descriptor: int, length: int) -> bytes:
        content = real(descriptor, length)
        assert here.leave(LONG[::-1]) is parcel
        return content

    monkeypatch.setattr(parcels.os, "read", reading)
    with pytest.raises(BusUnavailableError, match="cannot be read"):
        there.take(b"", known)


@given(lengths=st.lists(st.integers(0, 3), min_size=1, max_size=1500))
@settings(max_examples=20, deadline=None)
def test_pieces_arrive_joined_however_many_they_are(
    tmp_path_factory: pytest.TempPathFactory, lengths: list[int]
) -> None:
    side = MemoryParcels(tmp_path_factory.mktemp("memory") / "vggt_motion-0-pieces")
    pieces = Pieces([LONG, *(bytes([at % 256]) * length for at, length in enumerate(lengths)), memoryview(LONG)])
    parcel = side.leave(pieces)
    assert parcel is not None
    assert side.take(b"", parcel.attachment) == pieces.joined()
    side.close()


def test_sessions_and_endpoints_have_folders_of_their_own(memory: Path) -> None:
    configs = [BusConfig(), BusConfig(session="other"), BusConfig(endpoint="tcp/127.0.0.1:7448")]
    opened = [open_parcels(config) for config in [*configs, configs[0]]]
    assert len(list(memory.iterdir())) == 3
    assert [opened[0].is_near(other.greeting) for other in opened] == [True, False, False, True]
    for side in opened:
        side.close()
    assert list(memory.iterdir()) == []
