"""Live events to many clients, where a slow client costs nothing but its own events.

Events are published from the thread that follows the log and consumed on the event loop. Each client has a queue of
bounded length; when it is full, what waits in it is dropped, and the client is told how many it missed before it gets
the newest. Nobody waits for a client.
"""

from __future__ import annotations

import asyncio
import json
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

LAGGED = "lagged"
CLOSED = "closed"


@dataclass(frozen=True)
class LiveEvent:
    """One event as clients see it."""

    number: int  # counts all events of this gateway
    name: str
    data: Mapping[str, Any]  # JSON values

    def encode(self) -> bytes:
        """The event in the form of server-sent events (HTML standard, section 9.2)."""
        text = json.dumps(self.data, separators=(",", ":"), allow_nan=False)
        return f"id: {self.number}\nevent: {self.name}\ndata: {text}\n\n".encode()


class Subscription:
    """The queue of one client; used on the event loop on which it was made."""

    def __init__(self, hub: EventHub, loop: asyncio.AbstractEventLoop, capacity: int) -> None:
        """Made by :meth:`EventHub.subscribe`."""
        self._hub = hub
        self._loop = loop
        self._capacity = capacity
        self._lock = threading.Lock()
        self._waiting: deque[LiveEvent] = deque()
        self._missed = 0
        self._is_closed = False
        self._wake = asyncio.Event()

    def put(self, event: LiveEvent) -> int:
        """Add an event, from any thread; returns how many were dropped for it."""
        dropped = 0
        with self._lock:
            if len(self._waiting) >= self._capacity:
                dropped = len(self._waiting)
                self._missed += dropped
                self._waiting.clear()
            was_empty = not self._waiting
            self._waiting.append(event)
        if was_empty:
            self._notify()
        return dropped

    def end(self) -> None:
        """Let the client go, from any thread."""
        with self._lock:
            self._is_closed = True
        self._notify()

    async def next(self, timeout_s: float) -> LiveEvent | None:
        """The next event; None when nothing came in time, an event named ``closed`` at the end."""
        event = self._take()
        if event is None:
            self._wake.clear()
            event = self._take()  # what was put between the two lines above
        if event is None:
            try:
                await asyncio.wait_for(self._wake.wait(), timeout_s)
            except TimeoutError:
                return None
            event = self._take()
        return event

    def close(self) -> None:
        """Leave the hub; safe to call twice."""
        self._hub.remove(self)

    def _take(self) -> LiveEvent | None:
        with self._lock:
            if self._is_closed:
                return LiveEvent(0, CLOSED, {})
            if self._missed:
                missed, self._missed = self._missed, 0
                return LiveEvent(self._waiting[0].number - 1, LAGGED, {"missed_events": missed})
            return self._waiting.popleft() if self._waiting else None

    def _notify(self) -> None:
        try:
            self._loop.call_soon_threadsafe(self._wake.set)
        except RuntimeError:
            # The loop has ended: so has the client.
            self._hub.remove(self)


class EventHub:
    """All clients. Thread-safe."""

    def __init__(self, capacity: int = 64, max_clients: int = 64) -> None:
        """Empty hub.

        Args:
            capacity: events that may wait for one client.
            max_clients: more are refused.
        """
        self._capacity = capacity
        self._max_clients = max_clients
        self._lock = threading.Lock()
        self._clients: set[Subscription] = set()
        self._number = 0
        self._dropped = 0
        self._is_closed = False

    @property
    def client_count(self) -> int:
        """Clients at this moment."""
        return len(self._clients)

    @property
    def dropped_count(self) -> int:
        """Events that slow clients missed since the start, all clients together."""
        return self._dropped

    def publish(self, name: str, data: Mapping[str, Any]) -> None:
        """Give an event to all clients, without ever waiting for one."""
        with self._lock:
            self._number += 1
            event = LiveEvent(self._number, name, data)
            clients = list(self._clients)
        dropped = sum(client.put(event) for client in clients)
        with self._lock:
            self._dropped += dropped

    def subscribe(self) -> Subscription | None:
        """A new client on the running event loop; None when there are too many or the hub is closed."""
        client = Subscription(self, asyncio.get_running_loop(), self._capacity)
        with self._lock:
            if self._is_closed or len(self._clients) >= self._max_clients:
                return None
            self._clients.add(client)
        return client

    def remove(self, client: Subscription) -> None:
        """Forget a client."""
        with self._lock:
            self._clients.discard(client)

    def close(self) -> None:
        """Let all clients go and take no new ones."""
        with self._lock:
            self._is_closed = True
            clients = list(self._clients)
        for client in clients:
            client.end()
