"""Wall clock that jumps: on PYTHONPATH of the processes under test, with the offset in the file CLOCK_OFFSET_FILE."""

from __future__ import annotations

import os
import time

_file = os.environ.get("CLOCK_OFFSET_FILE", "")
_time_ns, _monotonic = time.time_ns, time.monotonic
_cached = [0.0, 0]  # when to look again, offset in nanoseconds


def _offset_ns() -> int:
    now = _monotonic()
    if now >= _cached[0]:
        _cached[0] = now + 0.1
        try:
            with open(_file, encoding="ascii") as file:  # noqa: PTH123 - runs before the site packages are there
                _cached[1] = int(float(file.read() or 0) * 1e9)
        except (OSError, ValueError):
            pass
    return int(_cached[1])


if _file:
    time.time_ns = lambda: _time_ns() + _offset_ns()
    time.time = lambda: (_time_ns() + _offset_ns()) / 1e9
