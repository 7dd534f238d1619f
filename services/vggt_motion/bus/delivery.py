"""Messages delivered in a thread that Zenoh starts, which sleeps until there is one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from zenoh import handlers

_JOIN_S = 0.3


class Calls:
    """Calls a function with each message, in a thread that the library starts, one after the other.

    A thread that waits in a channel of ours wakes up ten times a second to look for signals; this one sleeps. But the
    library lets 256 messages wait for it, whatever their size.
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
