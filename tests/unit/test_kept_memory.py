"""What is freed is used again, without the kernel's doing and within bounds: in processes of their own."""

from __future__ import annotations

import subprocess
import sys
from xml.etree import ElementTree

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
from vggt_motion.bus.service import resident_bytes
from vggt_motion.memory import keep_freed_memory
assert keep_freed_memory()
before = resident_bytes()
kept = [b"x" * 1_000_000 for _ in range(320)]
del kept
print(resident_bytes() - before)
"""
ARENAS = """
import ctypes, sys, threading
from vggt_motion.memory import keep_freed_memory
assert sys.argv[1] == "leave" or keep_freed_memory()
meet = threading.Barrier(8)
def fill():
    kept = [b"x" * 100_000 for _ in range(40)]
    meet.wait()
threads = [threading.Thread(target=fill) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
library = ctypes.CDLL(None)
library.fopen.restype = ctypes.c_void_p
library.malloc_info(0, ctypes.c_void_p(library.fopen(b"/dev/stdout", b"w")))
library.fflush(None)
"""

pytestmark = pytest.mark.skipif(not keep_freed_memory(), reason="not the GNU C library")


def output_of(program: str, *arguments: object) -> str:
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def printed(program: str, *arguments: object) -> int:
    return int(output_of(program, *arguments))


def arenas(is_kept: str) -> int:
    """How many arenas the C library says that it has (malloc_info(3)), once eight threads have allocated at a time."""
    return len(ElementTree.fromstring(output_of(ARENAS, is_kept)).findall("heap"))


@pytest.mark.parametrize(("count", "size_bytes"), [(5, 1_000_000), (2, 24_000_000)])
def test_what_was_freed_is_not_asked_for_again(count: int, size_bytes: int) -> None:
    assert printed(FAULTS, "keep", count, size_bytes) < 100


def test_without_the_setting_it_is() -> None:
    """If this fails, the C library has learned it, and the setting can go."""
    assert printed(FAULTS, "leave", 5, 1_000_000) > 5000


def test_no_more_is_kept_than_the_bound() -> None:
    """320 MB are freed; one thread does so, for what lies under a piece that another holds cannot be given back."""
    assert printed(RESIDENT) < 64 * 2**20 + 2e6


def test_many_threads_share_two_arenas() -> None:
    assert arenas("keep") == 2
    assert arenas("leave") > 2
