"""What compose.yaml starts, as processes of this machine, with the health check of the image asking for each."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from bus_processes import free_port

REPOSITORY = Path(__file__).resolve().parents[2]
TOKEN = "0123456789abcdef0123456789abcdef"
START_S = 60.0


@dataclass
class Stack:
    """The services of the compose file, as they run here."""

    directory: Path
    environment: dict[str, dict[str, str]]
    commands: dict[str, list[str]]
    processes: dict[str, subprocess.Popen[bytes]]

    def is_healthy(self, service: str) -> bool:
        """What the container engine would find: the exit code of the image's script."""
        line = self.directory / f"{service}.cmdline"
        line.write_bytes(
            b"".join(word.encode() + b"\0" for word in ("init", "--", "vggt-motion", *self.commands[service]))
        )
        result = subprocess.run(
            ["sh", str(REPOSITORY / "docker" / "healthcheck.sh")],
            env={**self.environment[service], "HEALTHCHECK_COMMAND_LINE": str(line)},
            capture_output=True,
            timeout=60,
            check=False,
        )
        return result.returncode == 0

    def wait_until_healthy(self, service: str) -> None:
        deadline = time.monotonic() + START_S
        while not self.is_healthy(service):
            code = self.processes[service].poll()
            log = (self.directory / f"{service}.log").read_text(errors="replace")
            assert code is None, f"{service} ended with {code}: {log}"
            assert time.monotonic() < deadline, f"{service} is not healthy: {log}"

    def start(self, service: str) -> None:
        with (self.directory / f"{service}.log").open("wb") as log:
            self.processes[service] = subprocess.Popen(
                ["vggt-motion", *self.commands[service]],
                env=self.environment[service],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd=self.directory,
            )


def on_this_machine(text: str, directory: Path, bus_port: int, http_port: int) -> str:
    """Replace what only exists between containers: host names, fixed ports, the volume."""
    for name, default in re.findall(r"\$\{(\w+):-([^}]*)\}", text):
        text = text.replace(f"${{{name}:-{default}}}", default)
    text = re.sub(r"\$\{VGGT_MOTION_TOKEN:\?[^}]*\}", TOKEN, text)
    text = text.replace("tcp/router:7447", f"tcp/127.0.0.1:{bus_port}").replace(":7447", f":{bus_port}")
    text = text.replace("0.0.0.0", "127.0.0.1")  # a test listens on loopback only
    text = text.replace('VGGT_MOTION_GATEWAY__PORT: "8000"', f'VGGT_MOTION_GATEWAY__PORT: "{http_port}"')
    return text.replace('"/data/', f'"{directory}/')


@pytest.fixture
def stack(tmp_path: Path) -> Iterator[Stack]:
    text = (REPOSITORY / "deploy" / "compose.yaml").read_text(encoding="utf-8")
    tree: dict[str, Any] = yaml.safe_load(on_this_machine(text, tmp_path, free_port(), free_port()))
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("VGGT_MOTION_")}
    inherited["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{inherited['PATH']}"
    services = {name: service for name, service in tree["services"].items() if "profiles" not in service}
    running = Stack(
        tmp_path,
        {name: {**inherited, **service["environment"]} for name, service in services.items()},
        {name: service["command"] for name, service in services.items()},
        {},
    )
    try:
        yield running
    finally:
        for process in running.processes.values():
            process.terminate()
        for process in running.processes.values():
            try:
                process.wait(timeout=15)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def test_every_service_of_the_compose_file_starts_is_healthy_and_stops(stack: Stack) -> None:
    # In the order that depends_on gives: a service starts when those that it needs are healthy.
    for service in ("router", "ledger"):
        stack.start(service)
        stack.wait_until_healthy(service)
    rest = [name for name in stack.commands if name not in stack.processes]
    assert set(rest) == {"inference", "registration", "backend", "gateway", "recorder"}
    for service in rest:
        stack.start(service)
    for service in rest:
        stack.wait_until_healthy(service)

    stack.processes["backend"].kill()
    stack.processes["backend"].wait()
    assert not stack.is_healthy("backend")
    assert stack.is_healthy("ledger")
    stack.start("backend")  # what the restart policy does
    stack.wait_until_healthy("backend")

    for service in [*rest, "ledger", "router"]:
        stack.processes[service].terminate()
        assert stack.processes[service].wait(timeout=10) == 0, (stack.directory / f"{service}.log").read_text()
    assert not stack.is_healthy("router")
