"""Logging of a service: one line per event, with time, level, who, and key=value."""

from __future__ import annotations

import logging
import os
import sys
import time

LEVEL_VARIABLE = "VGGT_MOTION_LOG_LEVEL"
_STANDARD = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}


class StructuredFormatter(logging.Formatter):
    """``2026-01-31T12:00:00.123Z INFO inference/4f2a module: message key=value``."""

    def __init__(self, service: str, instance: str) -> None:
        """Bind who speaks."""
        super().__init__()
        self._who = f"{service}/{instance}"

    def format(self, record: logging.LogRecord) -> str:
        """One line, and the traceback after it if there is one."""
        moment = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        module = record.name.removeprefix("vggt_motion.")
        fields = "".join(f" {key}={_value(value)}" for key, value in vars(record).items() if key not in _STANDARD)
        message = " ".join(record.getMessage().split())
        line = f"{moment}.{int(record.msecs):03d}Z {record.levelname} {self._who} {module}: {message}{fields}"
        if record.exc_info:
            line += "\n" + self.formatException(record.exc_info)
        return line


def is_told(count: int) -> bool:
    """Whether the so many-th of events that may come without end is logged: the 1st, 2nd, 4th, 8th, ..."""
    return count & (count - 1) == 0


def set_up_logging(service: str, instance: str) -> None:
    """Send everything to standard error; the level is in the environment, INFO if it is not."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(StructuredFormatter(service, instance))
    level = os.environ.get(LEVEL_VARIABLE, "INFO").upper()
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level if level in logging.getLevelNamesMapping() else "INFO")


def _value(value: object) -> str:
    text = " ".join(str(value).split())
    return f'"{text}"' if " " in text or not text else text
