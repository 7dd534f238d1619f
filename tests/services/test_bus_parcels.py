"""Long payloads within one machine over a real router: they go by files in memory, and without them nothing is lost."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from bus_processes import answer_when_ready, connect, running, wait_until
from vggt_motion.bus import parcels
from vggt_motion.bus.parcels import MemoryParcels
from vggt_motion.bus.session import Bus
from vggt_motion.errors import BusUnavailableError

pytestmark = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="no memory as a file system here")


def payload(number: int) -> bytes:
    return number.to_bytes(4, "little") * 50_000


@pytest.fixture
def left(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The lengths of all parcels that this process leaves."""
    lengths: list[int] = []
    real = MemoryParcels.leave

    def leave(self: MemoryParcels, content: bytes) -> parcels.Parcel | None:
        parcel = real(self, content)
        if parcel is not None:
            lengths.append(len(content))
        return parcel

    monkeypatch.setattr(MemoryParcels, "leave", leave)
    return lengths


def ask(bus: Bus, content: bytes) -> bytes:
    return answer_when_ready(bus, "reverse", content)


def reverse(_: str, content: bytes) -> bytes:
    return content[::-1]


def folder_of(bus: Bus) -> Path:
    assert isinstance(bus._parcels, MemoryParcels)
    return bus._parcels._folder


def files_in(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.suffix != ".lock"]


def test_after_the_first_one_long_payloads_go_by_parcels_both_ways(endpoint: str, left: list[int]) -> None:
    with connect(endpoint) as server, connect(endpoint) as client:
        server.serve(server.keys.rpc("test", "reverse"), reverse)
        assert ask(client, payload(0)) == payload(0)[::-1]
        assert left == [200_000], "the answer only: that the other side is near was not known before"
        for number in range(1, 5):
            assert ask(client, payload(number)) == payload(number)[::-1]
        assert left == [200_000] * 9
        assert ask(client, b"short") == b"trohs"
        assert len(left) == 9
        assert len(files_in(folder_of(client))) == 1, "the client's, to be filled again"
        folder = folder_of(client)
    assert not folder.exists()


def test_many_at_once_are_not_mixed_up_whether_or_not_there_is_memory(
    endpoint: str, left: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    real, asked = os.statvfs, iter(range(10**9))

    class Scarce:
        def __init__(self, path: Path) -> None:
            self.f_frsize = real(path).f_frsize
            self.f_bavail = 0 if next(asked) % 3 else real(path).f_bavail

    with connect(endpoint) as server, connect(endpoint) as client:
        key = server.keys.rpc("test", "reverse")
        server.serve_together(key, lambda contents: [content[::-1] for content in contents], at_a_time=8, threads=2)
        ask(client, payload(0))
        monkeypatch.setattr(parcels.os, "statvfs", Scarce)
        with ThreadPoolExecutor(16) as pool:
            answers = list(pool.map(lambda number: client.request(key, payload(number)), range(200)))
        assert answers == [payload(number)[::-1] for number in range(200)]
        assert 50 < len(left) < 350
        assert len(files_in(folder_of(client))) <= 16


@pytest.mark.parametrize("side", ["client", "server"])
def test_a_side_without_parcels_gets_and_sends_messages(endpoint: str, left: list[int], side: str) -> None:
    with (
        connect(endpoint, local_parcels=side != "server") as server,
        connect(endpoint, local_parcels=side != "client") as client,
    ):
        server.serve(server.keys.rpc("test", "reverse"), reverse)
        for number in range(3):
            assert ask(client, payload(number)) == payload(number)[::-1]
    assert left == []


def test_who_answers_from_elsewhere_all_of_a_sudden_is_sent_a_message(endpoint: str, left: list[int]) -> None:
    seen: list[bytes] = []

    def remember(_: str, content: bytes) -> bytes:
        seen.append(content)
        return hashlib.sha256(content).digest()

    with connect(endpoint) as client:
        with connect(endpoint) as near:
            near.serve(near.keys.rpc("test", "reverse"), remember)
            for number in range(2):
                ask(client, payload(number))
        assert left == [200_000]
        with connect(endpoint, local_parcels=False) as far:
            far.serve(far.keys.rpc("test", "reverse"), remember)
            for number in range(2, 4):
                assert ask(client, payload(number)) == hashlib.sha256(payload(number)).digest()
    assert seen == [payload(number) for number in range(4)], "a parcel that cannot be read reaches no handler"


def test_an_answer_that_cannot_be_read_is_no_answer(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    real: Callable[[MemoryParcels, bytes], parcels.Parcel | None] = MemoryParcels.leave_answer

    def lose(self: MemoryParcels, content: bytes) -> parcels.Parcel | None:
        parcel = real(self, content)
        if parcel is not None:
            parcel.remove()
        return parcel

    with connect(endpoint) as server, connect(endpoint) as client:
        server.serve(server.keys.rpc("test", "reverse"), reverse)
        ask(client, b"")
        monkeypatch.setattr(MemoryParcels, "leave_answer", lose)
        with pytest.raises(BusUnavailableError, match="cannot be read"):
            client.request(client.keys.rpc("test", "reverse"), payload(1))
        assert client.request(client.keys.rpc("test", "reverse"), payload(2)) == payload(2)[::-1], "by messages now"


def test_what_a_killed_answerer_left_goes_when_the_next_one_joins(endpoint: str, tmp_path: Path) -> None:
    with connect(endpoint) as client:
        folder = folder_of(client)
        for number in range(2):
            with running(tmp_path, "answer", endpoint) as answerer:
                wait_until(functools.partial(echoes, client, payload(number)))
                answerer.kill()
        assert files_in(folder) == []
        # Of the client, the router, and the one that was killed last: the next that comes or goes clears up after it.
        assert len(list(folder.iterdir())) == 3


def echoes(client: Bus, content: bytes) -> bool:
    try:
        return client.request(client.keys.rpc("test", "echo"), content) == content
    except BusUnavailableError:
        return False


def test_no_parcel_is_left_for_a_process_that_does_not_answer_any_more(endpoint: str, left: list[int]) -> None:
    with connect(endpoint) as client:
        with connect(endpoint) as server:
            server.serve(server.keys.rpc("test", "reverse"), reverse)
            ask(client, payload(0))
        left.clear()
        with pytest.raises(BusUnavailableError):
            client.request(client.keys.rpc("test", "reverse"), payload(1))
        assert left == [200_000]
        with pytest.raises(BusUnavailableError):
            client.request(client.keys.rpc("test", "reverse"), payload(1))
        assert left == [200_000], "the second attempt is a message"
        assert files_in(folder_of(client)) == []
