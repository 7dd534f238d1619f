"""The blobs that came last, kept in memory: whoever works on a record fetches its payloads soon after it was stored."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterable

from vggt_motion.ledger.store import Blob, Content


class RecentBlobs:
    """Contents by SHA-256, the first to come the first to go. Thread-safe.

    They are not copied: those that came in one message share its memory, which counts once, and whole, until the last
    of them goes. That is soon after the first one, because nothing but its age decides what goes.
    """

    def __init__(self, capacity_bytes: int) -> None:
        """Empty; never holds more than ``capacity_bytes`` of memory."""
        self._capacity_bytes = capacity_bytes
        self._lock = threading.Lock()
        self._held: OrderedDict[str, Content] = OrderedDict()
        self._users: dict[int, int] = {}  # by identity of what owns the memory: how many contents lie in it
        self.held_bytes = 0

    def add(self, blobs: Iterable[Blob]) -> None:
        """Hold what has just become durable; its hash is known to be right."""
        with self._lock:
            for blob in blobs:
                owner, size_bytes = _owner(blob.data)
                if blob.entry.sha256 in self._held or size_bytes > self._capacity_bytes:
                    continue
                self._held[blob.entry.sha256] = blob.data
                self._users[owner] = self._users.get(owner, 0) + 1
                if self._users[owner] == 1:
                    self.held_bytes += size_bytes
            while self.held_bytes > self._capacity_bytes:
                _, gone = self._held.popitem(last=False)
                owner, size_bytes = _owner(gone)
                self._users[owner] -= 1
                if self._users[owner] == 0:
                    del self._users[owner]
                    self.held_bytes -= size_bytes

    def get(self, sha256: str) -> Content | None:
        """A content, if it is still held."""
        return self._held.get(sha256)


def _owner(content: Content) -> tuple[int, int]:
    """Identity and length of the object whose memory a content lies in."""
    if isinstance(content, memoryview):
        return id(content.obj), memoryview(content.obj).nbytes
    return id(content), len(content)
