"""What a request costs on our bus, beside the same bytes over one bare Zenoh hop, through the same router.

Three processes on loopback: router, answerer, asker. A request carries the payload to the answerer and brings back one
byte, as an append does. Run: ``python tests/benchmarks/bench_bus.py [--json FILE]``.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from statistics import median, quantiles

import zenoh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from bus_processes import bus_config, connect, free_port, running, wait_until
from vggt_motion.bus.service import ServiceContext, run_service
from vggt_motion.bus.session import Bus, zenoh_config
from vggt_motion.config import Config
from vggt_motion.errors import BusUnavailableError

SIZES_BYTES = (100, 100_000, 5_000_000)
BUDGET_S = 3.0  # for each measurement
IN_FLIGHT = 32
MIN_COUNT = 20


def answer(context: ServiceContext) -> None:
    """Serve the same acknowledgement twice: through our bus, and with Zenoh alone."""
    bus = context.bus
    bus.serve(bus.keys.rpc("bench", "ours"), lambda *_: b"k", threads=4)
    bus.subscribe(bus.keys.all_images(), lambda _: None)  # a live subscriber beside it, as in real life
    session = zenoh.open(zenoh_config(context.config.bus))
    key = bus.keys.rpc("bench", "bare")
    queryable = session.declare_queryable(key, zenoh.handlers.FifoChannel(8), complete=True)
    queries = queryable.handler

    def loop() -> None:
        while True:
            try:
                with queries.recv() as query:
                    assert query.payload is not None
                    query.payload.to_bytes()
                    query.reply(key, b"k")
            except zenoh.ZError:
                return

    threading.Thread(target=loop, daemon=True).start()
    context.stopping.wait()
    session.close()  # type: ignore[no-untyped-call]


def measure(ask: Callable[[bytes], None], payload: bytes) -> dict[str, float]:
    """Latency one at a time, then rate with many in flight."""
    for _ in range(3):
        ask(payload)
    seconds: list[float] = []
    end = time.perf_counter() + BUDGET_S
    while time.perf_counter() < end or len(seconds) < MIN_COUNT:
        begin = time.perf_counter()
        ask(payload)
        seconds.append(time.perf_counter() - begin)
    count = max(IN_FLIGHT, min(len(seconds), 3000))
    with ThreadPoolExecutor(IN_FLIGHT) as pool:
        begin = time.perf_counter()
        list(pool.map(ask, [payload] * count))
        rate = count / (time.perf_counter() - begin)
    return {
        "median_ms": 1e3 * median(seconds),
        "p95_ms": 1e3 * quantiles(seconds, n=20)[-1],
        "rate_1_per_s": len(seconds) / sum(seconds),
        f"rate_{IN_FLIGHT}_per_s": rate,
    }


def bench(bus: Bus, session: zenoh.Session) -> list[dict[str, float | str]]:
    """All measurements, as rows."""

    def ours(payload: bytes) -> None:
        bus.request(bus.keys.rpc("bench", "ours"), payload)

    def bare(payload: bytes) -> None:
        replies = session.get(bus.keys.rpc("bench", "bare"), payload=payload, timeout=10.0)
        reply = replies.recv().ok
        assert reply is not None and reply.payload.to_bytes() == b"k"

    def is_ready() -> bool:
        try:
            ours(b"")
            bare(b"")
        except (BusUnavailableError, zenoh.ZError):
            return False
        return True

    wait_until(is_ready)
    rows: list[dict[str, float | str]] = []
    for size in SIZES_BYTES:
        payload = bytes(size)
        rows.extend(
            {"what": name, "bytes": size, **measure(ask, payload)} for name, ask in (("bare", bare), ("ours", ours))
        )
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="write the rows here as well")
    parser.add_argument("--serve", metavar="ENDPOINT", help="internal: be the answerer")
    arguments = parser.parse_args()
    if arguments.serve:
        return run_service("bench", Config(bus=bus_config(arguments.serve, connect_timeout_s=20.0)), answer)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stack.enter_context(running(folder, "router", endpoint))
        stack.enter_context(running(folder, "--serve", endpoint, script=Path(__file__)))
        bus = stack.enter_context(connect(endpoint))
        session = zenoh.open(zenoh_config(bus.config))
        stack.callback(session.close)
        rows = bench(bus, session)
    columns = list(rows[0])
    print("  ".join(f"{name:>14}" for name in columns))
    for row in rows:
        print("  ".join(f"{value:>14.3f}" if isinstance(value, float) else f"{value!s:>14}" for value in row.values()))
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
