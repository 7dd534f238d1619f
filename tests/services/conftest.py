"""A router of its own for each test that asks for one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from bus_processes import connect, free_port, running
from vggt_motion.bus.session import Bus


@pytest.fixture
def endpoint(tmp_path: Path) -> Iterator[str]:
    """Endpoint of a router that runs in a process of its own."""
    address = f"tcp/127.0.0.1:{free_port()}"
    with running(tmp_path, "router", address):
        yield address


@pytest.fixture
def bus(endpoint: str) -> Iterator[Bus]:
    """A session that is connected to the router."""
    with connect(endpoint) as session:
        yield session
