"""The supervisor with real processes; ``serve`` is replaced by small programs through a package on the path."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from vggt_motion import supervise
from vggt_motion.errors import InputError
from vggt_motion.supervise import CrashLoopError, ServiceCommand, Supervisor

FAKE_MAIN = """
import os, signal, sys, time
assert sys.argv[1] == "serve"
what = sys.argv[2]
if what == "crash":
    sys.exit("boom")
if what == "refuse":
    print("vggt-motion: port 8000 is taken", file=sys.stderr)
    sys.exit(2)
if what == "end":
    sys.exit(int(sys.argv[3]))
if what == "stubborn":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("ready", flush=True)
time.sleep(60)
"""


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    package = tmp_path / "fake" / "vggt_motion"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "__main__.py").write_text(FAKE_MAIN)
    return {"PYTHONPATH": str(tmp_path / "fake")}


def poll_until(supervisor: Supervisor, condition: Callable[[], bool], timeout_s: float = 20.0) -> None:
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        supervisor.poll()
        time.sleep(0.02)


def command(what: str, *arguments: str, ends_by_itself: bool = False) -> ServiceCommand:
    return ServiceCommand(what, what, (what, *arguments), ends_by_itself=ends_by_itself)


def test_a_killed_service_is_started_again(tmp_path: Path, environment: dict[str, str]) -> None:
    with Supervisor([command("work")], tmp_path, environment) as supervisor:
        supervisor.start()
        first = supervisor.pids()["work"]
        os.kill(first, signal.SIGKILL)
        poll_until(supervisor, lambda: supervisor.pids().get("work", first) != first)
        assert supervisor.restart_count == 1
        second = supervisor.pids()["work"]
    assert not psutil.pid_exists(second)


def test_a_crash_loop_ends_with_the_last_words(
    tmp_path: Path, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervise, "_MAX_BACKOFF_S", 0.01)
    with Supervisor([command("crash")], tmp_path, environment) as supervisor:
        supervisor.start()
        with pytest.raises(CrashLoopError, match="boom"):
            poll_until(supervisor, lambda: False)


def test_a_refusal_is_not_repeated_and_keeps_its_line(tmp_path: Path, environment: dict[str, str]) -> None:
    with Supervisor([command("refuse")], tmp_path, environment) as supervisor:
        supervisor.start()
        with pytest.raises(InputError, match=r"^port 8000 is taken$"):
            poll_until(supervisor, lambda: False)


@pytest.mark.parametrize("exit_code", [0, 3])
def test_ending_by_itself_is_kept(tmp_path: Path, environment: dict[str, str], exit_code: int) -> None:
    with Supervisor([command("end", str(exit_code), ends_by_itself=True)], tmp_path, environment) as supervisor:
        supervisor.start()
        poll_until(supervisor, lambda: supervisor.exit_code("end") is not None)
        assert supervisor.exit_code("end") == exit_code
        supervisor.poll()
        assert supervisor.pids() == {}


def test_one_that_ignores_the_request_is_killed(
    tmp_path: Path, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervise, "_STOP_S", 0.3)
    supervisor = Supervisor([command("stubborn")], tmp_path, environment)
    supervisor.start()
    poll_until(supervisor, lambda: supervisor.last_words("stubborn") == "ready")
    pid = supervisor.pids()["stubborn"]
    supervisor.stop()
    assert not psutil.pid_exists(pid)


def test_a_process_ends_when_its_parent_was_killed(tmp_path: Path) -> None:
    script = textwrap.dedent(
        """
        import os, subprocess, sys, time
        child = (
            "import os, sys, time; from vggt_motion.supervise import watch_parent;"
            "watch_parent(int(sys.argv[1])); print(os.getpid(), flush=True); time.sleep(60)"
        )
        subprocess.Popen([sys.executable, "-c", child, str(os.getpid())])
        time.sleep(60)
        """
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    for _ in range(200):
        if not psutil.pid_exists(pid):
            return
        time.sleep(0.05)
    os.kill(pid, signal.SIGKILL)
    pytest.fail("the process outlived its parent")


def test_one_that_ended_by_itself_can_be_started_again(tmp_path: Path, environment: dict[str, str]) -> None:
    with Supervisor([command("end", "0", ends_by_itself=True)], tmp_path, environment) as supervisor:
        supervisor.start()
        poll_until(supervisor, lambda: supervisor.exit_code("end") is not None)
        supervisor.start(["end"])
        assert supervisor.exit_code("end") is None
        poll_until(supervisor, lambda: supervisor.exit_code("end") == 0)
