"""Capture times: reading them, and making them strictly increasing."""

from __future__ import annotations

import calendar
import itertools
import logging
import math
import re
import time
from pathlib import Path

from vggt_motion.errors import SourceError

_log = logging.getLogger(__name__)

NANOSECONDS = 1_000_000_000
MAX_TIME_NS = 4 * 10**18  # in the year 2096; records take 2**62, and times that are repaired run on from the last one
REPAIR_STEP_NS = 1_000  # 1 us: visible in a TUM file with six decimals, and the next good time is not disturbed
CLOCK_RESET_NS = NANOSECONDS  # a backward step larger than this is a clock that was set anew

_KITTI_RAW = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)\.(\d{1,9})$")


class TimestampRepair:
    """Makes capture times strictly increasing, frame by frame.

    A repeated time, or one that steps back by less than a second, is moved to 1 us after its predecessor: one bad
    stamp then disturbs nothing after it. A larger step back is a clock that was set anew: all later times are
    shifted, so that the frame follows its predecessor at ``interval_ns``. The first repair is logged as a warning;
    ``count`` has all.
    """

    def __init__(self, interval_ns: int, description: str = "source") -> None:
        self.count = 0
        self._interval_ns = max(interval_ns, REPAIR_STEP_NS)
        self._description = description
        self._previous_ns: int | None = None
        self._shift_ns = 0

    def __call__(self, time_ns: int) -> int:
        """The repaired time of the next frame, in nanoseconds."""
        repaired = time_ns + self._shift_ns
        previous = self._previous_ns
        if previous is not None and repaired <= previous:
            if previous - repaired > CLOCK_RESET_NS:
                self._shift_ns += previous + self._interval_ns - repaired
                repaired = previous + self._interval_ns
            else:
                repaired = previous + REPAIR_STEP_NS
            if self.count == 0:
                _log.warning(
                    "%s: timestamps do not increase (%.6f s after %.6f s); repaired, further ones without a message",
                    self._description,
                    time_ns / NANOSECONDS,
                    (previous - self._shift_ns) / NANOSECONDS,
                )
            self.count += 1
        self._previous_ns = repaired
        return repaired


def read_times(path: Path) -> list[int]:
    """Read one capture time per line, in nanoseconds.

    Understands seconds as decimal numbers (KITTI odometry ``times.txt``) and ``YYYY-MM-DD HH:MM:SS.fffffffff`` (KITTI
    raw ``timestamps.txt``, taken as UTC). Empty lines are passed over.

    Raises:
        SourceError: naming file and line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"cannot read times from {path}: {error}") from error
    times: list[int] = []
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if not text:
            continue
        time_ns = _parse_time(text)
        if time_ns is None or not 0 <= time_ns <= MAX_TIME_NS:
            raise SourceError(f"{path}, line {number}: '{text[:40]}' is not a time in seconds")
        times.append(time_ns)
    return times


def _parse_time(text: str) -> int | None:
    dated = _KITTI_RAW.match(text)
    if dated is not None:
        try:
            seconds = calendar.timegm(time.strptime(dated[1], "%Y-%m-%d %H:%M:%S"))
        except ValueError:
            return None
        return seconds * NANOSECONDS + int(dated[2].ljust(9, "0"))
    try:
        value = float(text)
    except ValueError:
        return None
    return round(value * NANOSECONDS) if math.isfinite(value) else None


def median_interval_ns(times_ns: list[int], nominal_ns: int) -> int:
    """Median of the positive steps between successive times, or ``nominal_ns`` where there are none."""
    steps = sorted(b - a for a, b in itertools.pairwise(times_ns) if b > a)
    return steps[len(steps) // 2] if steps else nominal_ns
