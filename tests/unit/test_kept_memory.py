"""What is freed is used again, without the kernel's doing: counted by its page faults, in processes of their own."""

from __future__ import annotations

import subprocess
import sys

import pytest

from vggt_motion.memory import keep_freed_memory

PROGRAM = """
import resource, sys
from vggt_motion.memory import keep_freed_memory
if sys.argv[1] == "keep":
    assert keep_freed_memory()
def round():
    kept = [b"x" * size for size in 5 * (1_000_000,)]
for _ in range(3):
    round()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    round()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(mode: str) -> int:
    """Of twenty rounds that allocate, fill and free five pieces of 1 MB: 1220 pages of 4096 bytes in each."""
    command = [sys.executable, "-c", PROGRAM, mode]
    return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def test_what_was_freed_is_not_asked_for_again() -> None:
    if not keep_freed_memory():
        pytest.skip("not the GNU C library")
    assert page_faults("keep") < 100
    assert page_faults("leave") > 5000, "if this fails, the C library has learned it, and the setting can go"
