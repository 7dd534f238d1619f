"""Repeating idempotent requests while the other side or the link is down."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from vggt_motion.bus.session import Bus
from vggt_motion.errors import BusUnavailableError

_log = logging.getLogger(__name__)
_FIRST_BACKOFF_S = 0.1
_MAX_BACKOFF_S = 2.0
_QUIET_ATTEMPTS = 3
Result = TypeVar("Result")


def retry(bus: Bus, attempt: Callable[[], Result], *, patience_s: float | None, what: str) -> Result:
    """Call ``attempt`` until it is answered.

    Args:
        bus: ends the waiting when its requests are interrupted.
        attempt: an idempotent call.
        patience_s: give up after this long; None = never.
        what: for the log.

    Raises:
        BusUnavailableError: patience is at its end, or requests were interrupted.
    """
    end = None if patience_s is None else time.monotonic() + patience_s
    backoff_s = _FIRST_BACKOFF_S
    attempts = 0
    while True:
        try:
            return attempt()
        except BusUnavailableError as error:
            attempts += 1
            if bus.is_interrupted or (end is not None and time.monotonic() + backoff_s > end):
                raise
            if attempts == _QUIET_ATTEMPTS:
                _log.warning("no answer, trying on", extra={"what": what, "reason": str(error)})
        if bus.wait(backoff_s):
            raise BusUnavailableError(f"{what}: stopping")
        backoff_s = min(2.0 * backoff_s, _MAX_BACKOFF_S)
