"""The power goes at any operation: what was acknowledged before is there, and the session can be used."""

from __future__ import annotations

import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import power_loss
from ledger_helpers import open_ledger, record
from power_loss import Operation, crash_image, notes, read_log
from vggt_motion.errors import VggtMotionError
from vggt_motion.ledger.check import check

pytestmark = pytest.mark.skipif(power_loss.sqlite_library() is None, reason="SQLite is linked so that it has no hooks")
IMAGES = 120


def operations_of(tmp_path: Path, *arguments: str) -> list[Operation]:
    """What a process with a ledger did to its disk."""
    file = tmp_path / "operations"
    command = [sys.executable, power_loss.__file__, str(tmp_path / "session"), str(file), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return read_log(file)


def losses(image: Path, acknowledged: list[str]) -> Iterator[str]:
    """What of the acknowledged is not in an image, one line each."""
    try:
        ledger = open_ledger(image)
    except VggtMotionError as error:
        yield str(error)
        return
    try:
        for stream in ("keyframe", "submap"):
            rows = ledger.store.read(stream)
            found = {row.record_id for row in rows}
            if [row.sequence for row in rows] != list(range(len(rows))):
                yield f"{stream} is not dense"
            for line in acknowledged:
                name, record_id, *hashes = line.split()
                if name != stream:
                    continue
                if record_id not in found:
                    yield f"{line} is lost"
                for sha256 in hashes:
                    ledger.store.blob(sha256)
        ledger.store.append(record("event", "after"))
    except VggtMotionError as error:
        yield str(error)
    finally:
        ledger.close()
    yield from check(image).problems


def test_every_acknowledged_record_survives_a_power_cut_at_any_operation(tmp_path: Path) -> None:
    operations = operations_of(tmp_path)
    kinds = {operation.kind for operation in operations}
    assert {"write", "sync", "rename", "sync_folder", "note"} <= kinds
    assert any(operation.kind == "write" and operation.path == "ledger.db" for operation in operations), "no checkpoint"
    generator = random.Random(7)
    damaged = 0
    for number in range(IMAGES):
        # Every part of the course, and then any place in it.
        end = number * len(operations) // IMAGES + generator.randrange(max(1, len(operations) // IMAGES)) + 1
        damaged += crash_image(operations[:end], {}, tmp_path / "image", generator)
        if not (tmp_path / "image" / "ledger.db").exists():
            assert not list(notes(operations[:end]))
            continue
        lost = list(losses(tmp_path / "image", list(notes(operations[:end]))))
        assert not lost, (end, operations[end - 1].kind, operations[end - 1].path, lost)
    assert damaged > IMAGES, "the power was never lost in the middle of anything"


@pytest.mark.parametrize("of", ["rows", "packs"])
def test_the_model_notices_missing_syncs(of: str, tmp_path: Path) -> None:
    """Guards the test above: without these some image must lack what was acknowledged."""
    operations = operations_of(tmp_path, of)
    generator = random.Random(7)
    ends = [number + 1 for number, operation in enumerate(operations) if operation.kind == "note"][10:20]
    lost = []
    for end in ends:
        crash_image(operations[:end], {}, tmp_path / "image", generator)
        lost += list(losses(tmp_path / "image", list(notes(operations[:end]))))
    assert lost
