from __future__ import annotations

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from ledger_helpers import damage_blob, open_ledger, predict, record
from vggt_motion.ledger.recent import RecentBlobs
from vggt_motion.ledger.store import Blob, ConflictError
from vggt_motion.records import JobKind


@given(sizes=st.lists(st.integers(1, 40), max_size=30), capacity=st.integers(0, 100))
def test_the_last_blobs_that_fit_are_held_and_no_more(sizes: list[int], capacity: int) -> None:
    recent = RecentBlobs(capacity)
    blobs = [Blob.of(bytes([number]) + bytes(size)) for number, size in enumerate(sizes)]
    for blob in blobs:
        recent.add([blob])
    held = [blob for blob in blobs if recent.get(blob.entry.sha256) == blob.data]
    assert sum(len(blob.data) for blob in held) <= capacity
    fitting = [blob for blob in blobs if len(blob.data) <= capacity]
    assert held == fitting[len(fitting) - len(held) :]
    if len(held) < len(fitting):
        assert sum(len(blob.data) for blob in fitting[-len(held) - 1 :]) > capacity
    assert recent.get("0" * 64) is None


def test_the_memory_of_a_message_counts_once_and_whole() -> None:
    recent = RecentBlobs(1000)
    message = bytes(range(200)) * 3
    parts = [Blob.of(memoryview(message)[begin : begin + 150]) for begin in range(0, 600, 150)]
    recent.add(parts)
    assert recent.held_bytes == 600 and all(recent.get(part.entry.sha256) is part.data for part in parts)
    recent.add([Blob.of(memoryview(bytes(2000))[:10])])  # it would keep all of its message in memory
    assert recent.held_bytes == 600
    other = Blob.of(b"x" * 401)
    recent.add([other, other])
    assert recent.held_bytes == 401 and recent.get(other.entry.sha256) is other.data
    assert [recent.get(part.entry.sha256) for part in parts] == [None] * 4
    for number in range(100):
        small = Blob.of(memoryview(bytes([number]) * 300)[:20])
        recent.add([small])
        assert recent.held_bytes <= 1000 and recent.get(small.entry.sha256) is small.data
    assert len(recent._users) == 3


def test_what_came_last_is_answered_from_memory_and_what_was_refused_is_not(tmp_path: Path) -> None:
    ledger = open_ledger(tmp_path / "session", packed_blob_bytes=100, recent_bytes=10)
    first, second = Blob.of(b"first"), Blob.of(b"other")
    ledger.store.append(record("keyframe", "a"), [first], [first.entry])
    ledger.jobs.submit([predict("submap/0")])
    lease = ledger.jobs.claim([JobKind.PREDICT], [], "inference/1")
    assert lease is not None
    ledger.jobs.done("submap/0", lease.lease_id, record("submap", "submap/0"), [second], [second.entry])
    for blob in (first, second):
        damage_blob(tmp_path / "session", blob.entry.sha256, b"wrong")
        assert ledger.store.blob(blob.entry.sha256) == blob.data
    refused = Blob.of(b"third")
    try:
        ledger.store.append(record("keyframe", "a", b"another"), [refused], [refused.entry])
    except ConflictError:
        assert ledger.store._recent.get(refused.entry.sha256) is None
    else:
        raise AssertionError("it was known with another content")
    ledger.close()
