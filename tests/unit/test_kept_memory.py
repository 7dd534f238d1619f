"""What is freed is used again, without the kernel's doing and within bounds: in processes of their own."""

from __future__ import annotations

import subprocess
import sys

import pytest

from vggt_motion.memory import keep_freed_memory

FAULTS = """
import resource, sys
from vggt_motion.memory import keep_freed_memory
is_kept, count, size = sys.argv[1] == "keep", int(sys.argv[2]), int(sys.argv[3])
assert not is_kept or keep_freed_memory()
def round():
    kept = [b"x" * size for _ in range(count)]
for _ in range(3):
    round()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    round()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
RESIDENT = """
import threading
from vggt_motion.bus.service import resident_bytes
from vggt_motion.memory import keep_freed_memory
assert keep_freed_memory()
before = resident_bytes()
meet = threading.Barrier(8)
def fill():
    kept = [b"x" * 1_000_000 for _ in range(40)]
    meet.wait()
threads = [threading.Thread(target=fill) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(resident_bytes() - before)
"""

pytestmark = pytest.mark.skipif(not keep_freed_memory(), reason="not the GNU C library")


def printed(program: str, *arguments: object) -> int:
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.parametrize(("count", "size_bytes"), [(5, 1_000_000), (2, 24_000_000)])
def test_what_was_freed_is_not_asked_for_again(count: int, size_bytes: int) -> None:
    assert printed(FAULTS, "keep", count, size_bytes) < 100


def test_without_the_setting_it_is() -> None:
    """If this fails, the C library has learned it, and the setting can go."""
    assert printed(FAULTS, "leave", 5, 1_000_000) > 5000


def test_many_threads_keep_no_more_than_a_few() -> None:
    """Eight threads free 320 MB."""
    assert printed(RESIDENT) < 160e6
