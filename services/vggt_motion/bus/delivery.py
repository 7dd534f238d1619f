"""How messages come to us: what waits for them, and in which thread.

A thread that waits in a channel of Zenoh's wakes up ten times a second to look for signals. So who waits long waits
otherwise.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any

import zenoh
from zenoh import handlers

_JOIN_S = 0.3
_ONE_ANSWER = 2  # a place more than it needs


class PolledAnswer:
    """The answer to a query that is soon there: the waiting thread itself takes it out of a channel."""

    def __init__(self) -> None:
        """For one query."""
        self.handler: Any = handlers.FifoChannel(_ONE_ANSWER)

    def wait(self, channel: Any) -> zenoh.Reply:
        """The answer.

        Args:
            channel: what the query returned.

        Raises:
            zenoh.ZError: there is none.
        """
        reply: zenoh.Reply = channel.recv()
        return reply


class WokenAnswer:
    """The answer to a query that may take long: the waiting thread sleeps until Zenoh's network thread wakes it."""

    def __init__(self) -> None:
        """For one query."""
        self._replies: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()
        # In the network thread: neither call waits for anything.
        self.handler: Any = handlers.Callback(self._replies.put, lambda: self._replies.put(None), indirect=False)

    def wait(self, _: Any) -> zenoh.Reply:
        """As :meth:`PolledAnswer.wait`."""
        reply = self._replies.get()
        if reply is None:
            raise zenoh.ZError("no answer")
        return reply


class Calls:
    """Calls a function with each message, in a thread that the library starts, one after the other.

    It sleeps until there is one. But the library lets 256 messages wait for it, whatever their size.
    """

    def __init__(self, function: Callable[[Any], None]) -> None:
        self._function = function
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()

    def declare(self, declare: Callable[[Any], Any]) -> Any:
        """Declare something with this handler."""
        outcome: list[Any] = []

        def run() -> None:
            try:
                outcome.append(declare(handlers.Callback(self._call, self._ended.set)))
            except Exception as error:
                outcome.append(error)

        # The library's thread is a daemon if ours is: a link that had to be abandoned must not keep the process alive.
        thread = threading.Thread(target=run, name="declare", daemon=True)
        thread.start()
        thread.join()
        if isinstance(outcome[0], Exception):
            raise outcome[0]
        return outcome[0]

    def wait_for_end(self) -> None:
        """After it was undeclared: wait a moment for the call that may be under way, if not called from it."""
        if threading.current_thread() is not self._thread:
            self._ended.wait(_JOIN_S)

    def _call(self, received: Any) -> None:
        self._thread = threading.current_thread()
        self._function(received)
