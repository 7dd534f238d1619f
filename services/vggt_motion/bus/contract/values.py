"""Rules for single values that several messages share, and the limits of size."""

from __future__ import annotations

import re
from typing import Any, Final

from google.protobuf.message import Message

from vggt_motion.bus.schema import Many, Plan, Raw, Real, Rule, Text, Whole

MAX_BLOB_BYTES: Final = 128 * 2**20
MAX_BLOBS_PER_REQUEST: Final = 512
MAX_REQUESTS_PER_BUNDLE: Final = 256
MAX_RECORD_BYTES: Final = 32 * 2**20
MAX_TASK_BYTES: Final = 2**22
MAX_CALL_BYTES: Final = 512 * 2**20  # with all blobs; Zenoh drops messages above 1 GiB without a word
_MAX_COUNT = 2**32 - 1
_MAX_INDEX = 2**53

SHA256 = Text(64, 64, re.compile("[0-9a-f]{64}"), "64 lower-case hexadecimal digits")
IDENTIFIER = Text(256, 1, re.compile("[!-~]+"), "an identifier of printable ASCII without blanks")
NAME = Text(64, 1, re.compile("[A-Za-z0-9_.-]+"), "a name of letters, digits, '_', '.' and '-'")
LINE = Text()
LINES = Text(max_chars=2**16, many_lines=True)
INDEX = Whole(0, _MAX_INDEX)
COUNT = Whole(0, _MAX_COUNT)
REVISION = Whole(1, _MAX_COUNT)
TIME_NS = Whole(-(2**62), 2**62)
SIDE_PX = Whole(1, 2**15)
NUMBER = Real()
RATIO = Real(0.0, 1.0)
POSITIVE = Real(low=5e-324)
KEYFRAME_IDS = Many(IDENTIFIER, 4096)
IDENTITY = Raw(32, 32)


def plan(record: type[Any], message: type[Message], max_bytes: int = 2**16, **options: Any) -> Plan:
    """A plan for a small message, if not told otherwise."""
    rules: dict[str, Rule] = options.pop("rules")
    return Plan(record, message, rules, max_bytes=max_bytes, **options)
