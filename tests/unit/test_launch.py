"""When a run on this machine is over."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from synthetic_session import Session
from vggt_motion import launch
from vggt_motion.bus.log import LogRecord
from vggt_motion.config import Config
from vggt_motion.errors import BusUnavailableError
from vggt_motion.records import GraphUpdate, LedgerStatus, Stream, StreamPosition

SAMPLE = Path(__file__).resolve().parents[1] / "data" / "kitti_06_first51"


class Follower:
    """Delivers one batch of records a turn."""

    def __init__(self, batches: Iterator[dict[Stream, list[Any]]]) -> None:
        self._batches = batches
        self._positions = dict.fromkeys(Stream, 0)

    def poll(self) -> list[LogRecord]:
        records = []
        for stream, batch in next(self._batches, {}).items():
            self._positions[stream] += len(batch)
            records += batch
        return records

    def expect(self, ends: Mapping[str, int]) -> None:
        self.expected = dict(ends)

    def positions(self) -> dict[Stream, int]:
        return self._positions

    def wait(self, timeout_s: float) -> None:
        pass

    def close(self) -> None:
        pass


def test_a_run_is_over_when_it_has_taken_in_all_that_the_final_graph_speaks_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # a publication got lost: the final graph overtakes submaps, and the ledger is asked while it is away
    session = Session(2)
    batches: list[dict[Stream, list[Any]]] = [
        {Stream.KEYFRAME: session.keyframes, Stream.SEGMENT: session.segments, Stream.SUBMAP: session.submaps[:1]},
        {Stream.CONSTRAINT: session.constraints, Stream.GRAPH: [GraphUpdate(3, True, (), ())]},
        {},
        {},
        {Stream.SUBMAP: session.submaps[1:]},
    ]
    counts = {"keyframe": len(session.keyframes), "segment": 2, "submap": 2, "constraint": 1, "graph": 1}
    positions = tuple(StreamPosition(stream, count) for stream, count in counts.items())
    answers = iter([None])  # away once, there from then on

    def status() -> LedgerStatus:
        if next(answers, "there") is None:
            raise BusUnavailableError("away")
        return LedgerStatus(positions, (), 0, 0, True, "", 0, "")

    follower = Follower(iter(batches))
    monkeypatch.setattr(launch, "LogFollower", lambda bus: follower)
    monkeypatch.setattr(launch, "LedgerClient", lambda bus: SimpleNamespace(status=status))
    config = Config.model_validate({"recorder": {"enabled": False}, "gateway": {"port": 0}})
    run = launch.LocalRun(launch.RunRequest(str(SAMPLE), tmp_path, config))
    supervisor = SimpleNamespace(poll=lambda: None, exit_code=lambda name: 0, start=lambda names: None)
    watch = SimpleNamespace(newest_report=lambda service: None)
    state = run._follow(supervisor, SimpleNamespace(), watch, lambda progress: None)  # type: ignore[arg-type]
    assert sorted(state.submaps) == [(0, 1), (1, 1)]
    assert follower.positions()[Stream.SUBMAP] == 2
    assert follower.expected == counts, "what is missing was asked for, and not waited for until the next poll"
