"""The short cross-section of the fault suite: every service killed once in one run."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest
from fault_run import FaultRun, Outcome

from vggt_motion.records import Stream

pytestmark = pytest.mark.timeout(500)
SERVICES = ("registration", "inference", "ledger", "backend", "router", "frontend", "recorder", "gateway")


def test_every_service_is_killed_once_and_nothing_is_lost(
    start: Callable[..., FaultRun], judge: Callable[[str, Outcome], Outcome], generator: random.Random
) -> None:
    run = start("run.inference_workers=2", seconds_per_submap=1.0)
    assert run.wait_until(lambda: run.count(Stream.EVENT) > 0), "the frontend's first record"
    order = list(SERVICES)
    generator.shuffle(order)
    order.remove("frontend")  # while there is still input
    for service in ("frontend", *order):
        assert run.wait_until(lambda name=service: run.processes(name))
        assert run.kill(service)
        run.wait_until(lambda: False, generator.uniform(0.1, 1.0))
    outcome = judge("SIGKILL of each once", run.finish())
    assert outcome.acknowledged > 0
