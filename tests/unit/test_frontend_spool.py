from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from full_disk import full_disk
from vggt_motion.errors import InputError
from vggt_motion.frontend.spool import Spool


def drained(spool: Spool) -> list[bytes]:
    found = []
    while (request := spool.first(0.0)) is not None:
        found.append(request)
        spool.drop_first()
    return found


def test_first_in_first_out_also_for_the_next_process(tmp_path: Path) -> None:
    spool = Spool(tmp_path, 1000)
    requests = [bytes([number]) * 10 for number in range(12)]
    assert all(spool.put(request, 0.0) for request in requests)
    assert (spool.count, spool.size_bytes) == (12, 120)
    assert spool.first(0.0) == requests[0] == spool.first(0.0)
    spool.drop_first()
    (tmp_path / "000000000099.part").write_bytes(b"torn")
    again = Spool(tmp_path, 1000)
    assert again.put(b"new", 0.0)
    assert drained(again) == [*requests[1:], b"new"]
    assert list(tmp_path.iterdir()) == []
    assert again.wait_until_empty(0.0)


def test_it_is_bounded_and_a_long_request_passes_alone(tmp_path: Path) -> None:
    spool = Spool(tmp_path, 25)
    assert spool.put(bytes(40), 0.0)
    assert not spool.put(b"x", 0.0)
    spool.drop_first()
    assert spool.put(bytes(20), 0.0) and spool.put(bytes(5), 0.0)
    assert not spool.put(b"x", 0.0)
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) == 25


def test_on_a_full_disk_there_is_no_room_until_there_is_space(tmp_path: Path) -> None:
    spool = Spool(tmp_path, 10**6)
    assert spool.put(bytes(50), 0.0)
    with full_disk(100):
        assert not spool.put(bytes(200), 0.0)
        assert spool.put(bytes(60), 0.0)
    assert spool.put(bytes(200), 0.0)
    assert [len(request) for request in drained(spool)] == [50, 60, 200]
    assert list(tmp_path.iterdir()) == []


def test_it_leaves_the_ledger_its_reserve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vggt_motion.frontend.spool.free_space", lambda _: 1000)
    spool = Spool(tmp_path, 10**6, reserve_bytes=900)
    assert spool.put(bytes(500), 0.0), "one passes, or nothing would be sent any more"
    assert not spool.put(bytes(101), 0.0)
    assert spool.put(bytes(100), 0.0)


def test_a_folder_that_cannot_be_used_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="as spool"):
        Spool(tmp_path / "file", 10)


@given(st.lists(st.one_of(st.binary(max_size=30), st.none())))
def test_any_order_of_putting_and_dropping(tmp_path_factory: pytest.TempPathFactory, steps: list[bytes | None]) -> None:
    folder = tmp_path_factory.mktemp("spool")
    spool, model = Spool(folder, 60), list[bytes]()
    for step in steps:
        if step is None and model:
            assert spool.first(0.0) == model.pop(0)
            spool.drop_first()
        elif step is not None:
            has_room = not model or sum(map(len, model)) + len(step) <= 60
            assert spool.put(step, 0.0) == has_room
            model += [step] if has_room else []
    assert drained(Spool(folder, 60)) == model
