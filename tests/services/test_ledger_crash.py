"""A process that appends is killed at random moments, again and again; what it had acknowledged must be there."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import ledger_processes
from ledger_helpers import damage_blob
from vggt_motion.config import LedgerConfig
from vggt_motion.ledger.check import check
from vggt_motion.ledger.service import open_session

ROUNDS = 20


def acknowledged_until_killed(directory: Path, threads: int, seconds: float) -> list[tuple[int, str, str]]:
    """(sequence, record id, SHA-256 of its blob) of everything that one process acknowledged before SIGKILL."""
    command = [sys.executable, ledger_processes.__file__, "appender", str(directory), str(threads)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    first = process.stdout.readline()  # it has started; the moment of the kill counts from here
    timer = time.monotonic() + seconds
    os.set_blocking(process.stdout.fileno(), False)
    output = first
    while time.monotonic() < timer:
        output += process.stdout.read() or b""
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()
    os.set_blocking(process.stdout.fileno(), True)
    output += process.stdout.read()
    process.stdout.close()
    lines = [line.decode().split() for line in output.split(b"\n") if line]
    return [(int(sequence), record_id, sha256) for sequence, record_id, sha256 in lines]


@pytest.mark.parametrize("threads", [1, 4])
def test_every_acknowledged_record_is_there_after_every_kill(tmp_path: Path, threads: int) -> None:
    generator = random.Random(threads)
    directory = tmp_path / "session"
    acknowledged: dict[int, tuple[str, str]] = {}
    for _ in range(ROUNDS // 2):
        for sequence, record_id, sha256 in acknowledged_until_killed(directory, threads, generator.uniform(0, 0.1)):
            assert acknowledged.setdefault(sequence, (record_id, sha256)) == (record_id, sha256)
        ledger = open_session(directory, LedgerConfig())
        rows, position = {}, 0
        while page := ledger.store.read("keyframe", position):
            position = page[-1].sequence + 1
            rows |= {row.sequence: row.record_id for row in page}
        assert list(rows) == list(range(len(rows)))
        for sequence, (record_id, sha256) in acknowledged.items():
            assert rows[sequence] == record_id
            assert ledger.store.blob(sha256)
        ledger.close()
    assert len(acknowledged) > ROUNDS
    report = check(directory)
    assert report.is_sound, report.problems
    assert check(directory).repaired == ()


def test_a_torn_blob_is_found_by_the_check_and_not_handed_out(tmp_path: Path) -> None:
    directory = tmp_path / "session"
    records = acknowledged_until_killed(directory, 1, 0.05)
    _, record_id, sha256 = records[0]
    damage_blob(directory, sha256, b"torn")
    report = check(directory)
    assert len(report.problems) == 1 and record_id in report.problems[0]
    shutil.rmtree(directory)
