"""Results that take long to make: made once for all who ask, beside the event loop, and kept."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

Value = TypeVar("Value")


@dataclass(frozen=True)
class Built(Generic[Value]):
    """A result and what it cost."""

    key: Hashable
    value: Value
    seconds: float
    finished_at: float  # time.monotonic()


class Builder(Generic[Value]):
    """Builds one result at a time in a thread of its own. Used on one event loop."""

    def __init__(self, name: str, kept: int) -> None:
        """Nothing built yet.

        Args:
            name: of the thread.
            kept: how many results to keep; the least recently used go first.
        """
        self._name = name
        self._turn = asyncio.Lock()
        self._kept = kept
        self._results: OrderedDict[Hashable, Built[Value]] = OrderedDict()
        self._in_flight: dict[Hashable, asyncio.Task[Built[Value]]] = {}

    async def get(self, key: Hashable, build: Callable[[], Value]) -> Built[Value]:
        """The result for a key, built if it is not there; those who ask meanwhile wait for the same one.

        A client that goes away does not stop the building: the others, and the next one, want it too.
        """
        known = self._results.get(key)
        if known is not None:
            self._results.move_to_end(key)
            return known
        task = self._in_flight.get(key)
        if task is None:
            task = self._in_flight[key] = asyncio.create_task(self._build(key, build))
        return await asyncio.shield(task)

    def newest(self) -> Built[Value] | None:
        """The result that was finished last, if it is still kept."""
        return max(self._results.values(), key=lambda built: built.finished_at, default=None)

    async def _build(self, key: Hashable, build: Callable[[], Value]) -> Built[Value]:
        try:
            async with self._turn:
                begin = time.monotonic()
                value = await self._in_thread(build)
                now = time.monotonic()
            built = self._results[key] = Built(key, value, now - begin, now)
            while len(self._results) > self._kept:
                self._results.popitem(last=False)
            return built
        finally:
            del self._in_flight[key]

    async def _in_thread(self, build: Callable[[], Value]) -> Value:
        # A daemon thread, which the threads of the standard executors are not: a map in the making must not hold up
        # the end of the process.
        loop = asyncio.get_running_loop()
        future: asyncio.Future[Value] = loop.create_future()

        def run() -> None:
            try:
                value = build()
            except BaseException as error:
                settle = functools.partial(_fail, future, error)
            else:
                settle = functools.partial(_succeed, future, value)
            with contextlib.suppress(RuntimeError):  # the loop has ended meanwhile
                loop.call_soon_threadsafe(settle)

        threading.Thread(target=run, name=self._name, daemon=True).start()
        return await future


def _succeed(future: asyncio.Future[Any], value: Any) -> None:
    if not future.done():
        future.set_result(value)


def _fail(future: asyncio.Future[Any], error: BaseException) -> None:
    if not future.done():
        future.set_exception(error)
