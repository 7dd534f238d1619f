from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import psutil
import pytest

from vggt_motion.compute import (
    ComputeCancelledError,
    ComputeChild,
    ComputeCrashedError,
    ComputeDeadlineError,
    ComputeError,
)


@pytest.fixture
def child() -> Iterator[ComputeChild]:
    compute = ComputeChild("test")
    yield compute
    compute.kill()


def test_result_comes_back_from_another_process_that_is_kept(child: ComputeChild) -> None:
    first = child.call(os.getpid, deadline_s=30)
    assert first != os.getpid()
    assert child.call(os.getpid, deadline_s=30) == first


def _shortened(images: list[bytes], by: int, *rest: object) -> tuple[list[bytes], object]:
    return [image[by:] for image in images], rest


def test_long_bytes_come_over_as_they_are_both_ways(child: ComputeChild) -> None:
    sizes = (0, 1, 32 * 2**10 - 1, 32 * 2**10, 32 * 2**10 + 1, 3_000_000)
    images = [bytes([number]) * size for number, size in enumerate(sizes)]
    rest = {"again": images[-1], "view": bytearray(100_000), "array": np.arange(100_000), "none": None}
    shortened, came = child.call(_shortened, images, 1, rest, deadline_s=30)
    assert shortened == [image[1:] for image in images]
    assert isinstance(came, tuple) and came[0].keys() == rest.keys()
    assert (came[0]["again"], came[0]["view"], came[0]["none"]) == (rest["again"], rest["view"], None)
    np.testing.assert_array_equal(came[0]["array"], rest["array"])


def _same(images: list[bytes]) -> bool:
    return images[0] is images[1]


def test_long_bytes_that_are_there_twice_are_sent_once(child: ComputeChild) -> None:
    image = bytes(1_000_000)
    assert child.call(_same, [image, image], deadline_s=30)
    assert not child.call(_same, [image, bytes(bytearray(image))], deadline_s=30)


def test_an_exception_keeps_its_message_and_traceback(child: ComputeChild) -> None:
    with pytest.raises(ComputeError, match="ValueError") as caught:
        child.call(int, "seven", deadline_s=30)
    assert "Traceback" in caught.value.traceback_text
    assert child.call(int, "7", deadline_s=30) == 7


def test_deadline_ends_the_call_and_the_next_one_works(child: ComputeChild) -> None:
    with pytest.raises(ComputeDeadlineError):
        child.call(time.sleep, 60, deadline_s=0.2)
    assert child.call(int, "7", deadline_s=30) == 7


def test_cancel_ends_the_call(child: ComputeChild) -> None:
    with pytest.raises(ComputeCancelledError):
        child.call(time.sleep, 60, deadline_s=30, on_tick=lambda: False)


def test_a_killed_child_is_named(child: ComputeChild) -> None:
    pid = child.call(os.getpid, deadline_s=30)
    killed = []

    def kill_once() -> bool:
        if not killed:
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)
        return True

    with pytest.raises(ComputeCrashedError, match="SIGKILL"):
        child.call(time.sleep, 60, deadline_s=30, on_tick=kill_once)
    assert child.call(int, "7", deadline_s=30) == 7


def test_the_child_dies_with_a_killed_parent() -> None:
    script = (
        "import os, time\n"
        "from vggt_motion.compute import ComputeChild\n"
        "if __name__ == '__main__':\n"
        "    child = ComputeChild('test')\n"
        "    print(child.call(os.getpid, deadline_s=30), flush=True)\n"
        "    child.call(time.sleep, 60, deadline_s=60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    for _ in range(400):
        try:
            if psutil.Process(pid).status() == psutil.STATUS_ZOMBIE:
                break
        except psutil.NoSuchProcess:
            break
        time.sleep(0.05)
    else:
        os.kill(pid, signal.SIGKILL)
        pytest.fail("the computing process outlived its parent")


def _late(value: int) -> int:
    time.sleep(0.3)
    return value


def test_a_call_that_is_given_up_by_an_exception_leaves_no_result_for_the_next(child: ComputeChild) -> None:
    def fail() -> bool:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        child.call(_late, 1, deadline_s=30, on_tick=fail)
    time.sleep(0.5)
    assert child.call(_late, 2, deadline_s=30) == 2
