"""The payloads that went by last, so that views are drawn from them and not from the ledger once more."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable


class RecentPayloads:
    """Bytes by key, those that were put or asked for last. Thread-safe."""

    def __init__(self, capacity_bytes: int) -> None:
        """Empty; never holds more than ``capacity_bytes`` of payload."""
        self._capacity_bytes = capacity_bytes
        self._lock = threading.Lock()
        self._held: OrderedDict[Hashable, bytes] = OrderedDict()
        self._held_bytes = 0

    def put(self, key: Hashable, data: bytes) -> None:
        """Hold a payload, at the cost of those that were not asked for longest."""
        with self._lock:
            self._held_bytes += len(data) - len(self._held.pop(key, b""))
            self._held[key] = data
            while self._held_bytes > self._capacity_bytes:
                _, dropped = self._held.popitem(last=False)
                self._held_bytes -= len(dropped)

    def get(self, key: Hashable) -> bytes | None:
        """A payload, if it is still held."""
        with self._lock:
            data = self._held.get(key)
            if data is not None:
                self._held.move_to_end(key)
            return data
