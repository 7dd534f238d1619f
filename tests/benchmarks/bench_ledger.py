"""What durability costs: append, claim/done and follow beside the bare limits, measured in the same run.

    python tests/benchmarks/bench_ledger.py [--directory DIR] [--seconds S] [--json FILE]

Three processes on loopback: router, ledger, client. The bare limits are: write and fsync of the same bytes to a new
file; the same bytes over Zenoh through the router to a process that answers with one byte (one hop); their SHA-256.
The folder must be on a real disk: in memory an fsync costs nothing. A round measures everything for a moment, and the
rounds are repeated, so that a disk that has a bad minute has it for all.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from statistics import median

import zenoh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from bench_bus import answer

from bus_processes import bus_config, running, wait_until
from ledger_processes import Site, depth_blob, event, keyframe, predict, site, submap
from vggt_motion.bus import codec
from vggt_motion.bus.follow import Follower
from vggt_motion.bus.ledger import append_request
from vggt_motion.bus.service import run_service
from vggt_motion.bus.session import zenoh_config
from vggt_motion.config import Config, LedgerConfig
from vggt_motion.ledger.admission import admitted
from vggt_motion.ledger.service import open_session
from vggt_motion.records import Event, JobKind, Keyframe, SubmapSpec

SIZES_BYTES = (100, 100_000, 5_000_000)
IN_FLIGHT = 64
ROUNDS = 3
MIN_COUNT = 3
BYTES_PER_ROUND = 400_000_000  # a round of large records ends early rather than fill the disk


class Source:
    """New content for every call: nothing may be recognised as known."""

    def __init__(self, size_bytes: int) -> None:
        self.size_bytes = size_bytes
        self._body = random.Random(size_bytes).randbytes(max(size_bytes - 8, 0))
        self._lock = threading.Lock()
        self._count = 0

    def next(self) -> tuple[int, bytes]:
        """A number that was not there before, and bytes that begin with it."""
        with self._lock:
            self._count += 1
            return self._count, self._count.to_bytes(8, "little") + self._body

    def record(self) -> tuple[str, str, Event | Keyframe, list[bytes]]:
        """Small records have no blob; the others are keyframes with an image of the size."""
        number, data = self.next()
        if self.size_bytes <= 100:
            record = event(number, f"bench{self.size_bytes}")
            return "event", record.event_id, record, []
        frame = keyframe(self.size_bytes * 1_000_000 + number, data)
        return "keyframe", frame.keyframe_id, frame, [data]


def one_by_one(call: Callable[[], None], seconds: float, max_count: int) -> list[float]:
    """Seconds of every call."""
    durations: list[float] = []
    end = time.perf_counter() + seconds
    while (time.perf_counter() < end or len(durations) < MIN_COUNT) and len(durations) < max_count:
        begin = time.perf_counter()
        call()
        durations.append(time.perf_counter() - begin)
    return durations


def many_at_once(call: Callable[[], None], seconds: float, max_count: int) -> float:
    """Calls per second with IN_FLIGHT of them under way."""
    end = time.perf_counter() + seconds
    counts = [0] * IN_FLIGHT
    share = max(1, max_count // IN_FLIGHT)

    def run(index: int) -> None:
        while counts[index] < share and (time.perf_counter() < end or counts[index] == 0):
            call()
            counts[index] += 1

    begin = time.perf_counter()
    with ThreadPoolExecutor(IN_FLIGHT) as pool:
        list(pool.map(run, range(IN_FLIGHT)))
    return sum(counts) / (time.perf_counter() - begin)


class Bench:
    """The calls that are compared, on one set of processes."""

    def __init__(self, place: Site, folder: Path, stack: ExitStack) -> None:
        stack.enter_context(running(folder, "--serve", place.endpoint, script=Path(__file__)))
        self.place = place
        self.folder = folder / "bare"
        self.folder.mkdir()
        self.client = place.client()
        self.jobs = place.jobs()
        self.session = zenoh.open(zenoh_config(place.bus.config))
        stack.callback(self.session.close)
        self.hop_key = place.bus.keys.rpc("bench", "bare")
        self.store = open_session(folder / "local", LedgerConfig(reserve_bytes=0))
        stack.callback(self.store.close)
        wait_until(self._is_ready)

    def _is_ready(self) -> bool:
        try:
            self.hop(b"")
        except zenoh.ZError:
            return False
        return True

    def hop(self, data: bytes) -> None:
        """The bytes to another process and one byte back, with Zenoh alone."""
        reply = self.session.get(self.hop_key, payload=data, timeout=10.0).recv().ok
        assert reply is not None and reply.payload.to_bytes() == b"k"

    def request(self, data: bytes) -> None:
        """The same over our bus."""
        self.place.bus.request(self.place.bus.keys.rpc("bench", "ours"), data)

    def fsync(self, number: int, data: bytes) -> None:
        """A new file, durable."""
        descriptor = os.open(self.folder / f"{len(data)}-{number}", os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        os.write(descriptor, data)
        os.fsync(descriptor)
        os.close(descriptor)

    def append(self, source: Source) -> None:
        """Over the bus, as every service does."""
        stream, record_id, record, blobs = source.record()
        assert not self.client.append(stream, record_id, record, blobs).was_known

    def append_locally(self, source: Source) -> None:
        """The same without the bus: what store and admission cost."""
        request = append_request(*source.record())
        self.store.store.append(*admitted(request))

    def claim_and_done(self) -> None:
        """One job: leased, and its result with one blob committed."""
        lease = self.jobs.claim([JobKind.PREDICT], [], "inference/bench", 1.0)
        assert lease is not None
        index = codec.decode(SubmapSpec, lease.job.payload).submap_index
        depth = depth_blob(index)
        assert self.jobs.done(lease, "submap", lease.job.job_id, submap(index, depth), [depth])


def measure(bench: Bench, size_bytes: int, seconds: float) -> dict[str, float]:
    """One size: medians in milliseconds, rates per second."""
    sequential: dict[str, list[float]] = {name: [] for name in ("fsync", "hop", "request", "hash", "append", "local")}
    sources = {name: Source(size_bytes) for name in sequential}
    rates: dict[str, list[float]] = {"append64": [], "local64": []}
    max_count = max(IN_FLIGHT, BYTES_PER_ROUND // ROUNDS // max(size_bytes, 1))
    calls: dict[str, Callable[[], None]] = {
        "fsync": lambda: bench.fsync(*sources["fsync"].next()),
        "hop": lambda: bench.hop(sources["hop"].next()[1]),
        "request": lambda: bench.request(sources["request"].next()[1]),
        "hash": lambda: hashlib.sha256(sources["hash"].next()[1]).digest() and None,
        "append": lambda: bench.append(sources["append"]),
        "local": lambda: bench.append_locally(sources["local"]),
    }
    for _ in range(ROUNDS):
        for name, durations in sequential.items():
            durations += one_by_one(calls[name], seconds, max_count)
        rates["append64"].append(many_at_once(calls["append"], seconds, max_count))
        rates["local64"].append(many_at_once(calls["local"], seconds, max_count))
    ms = {name: 1e3 * median(durations) for name, durations in sequential.items()}
    limit_ms = ms["fsync"] + ms["hop"] + ms["hash"]
    fsync_rate = len(sequential["fsync"]) / sum(sequential["fsync"])
    return {
        "bytes": size_bytes,
        "fsync_ms": ms["fsync"],
        "hop_ms": ms["hop"],
        "request_ms": ms["request"],
        "hash_ms": ms["hash"],
        "append_ms": ms["append"],
        "append_over_limit": ms["append"] / limit_ms,
        "local_append_ms": ms["local"],
        "fsync_per_s": fsync_rate,
        "append64_per_s": median(rates["append64"]),
        "append64_over_fsync": median(rates["append64"]) / fsync_rate,
        "local64_per_s": median(rates["local64"]),
    }


def measure_jobs(bench: Bench, count: int) -> dict[str, float]:
    """Claim and done of small results, one worker and eight."""
    bench.jobs.submit([predict(index) for index in range(2 * count)])
    begin = time.perf_counter()
    for _ in range(count):
        bench.claim_and_done()
    one = count / (time.perf_counter() - begin)
    begin = time.perf_counter()
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: bench.claim_and_done(), range(count)))
    return {"claim_done_per_s": one, "claim_done_8_workers_per_s": count / (time.perf_counter() - begin)}


def measure_follow(place: Site) -> dict[str, float]:
    """A late follower reads the whole stream of small records."""
    count = place.status().position("event")
    begin = time.perf_counter()
    follower = Follower(place.bus, "event", Event)
    for _ in range(count):
        assert follower.next(10.0) is not None
    seconds = time.perf_counter() - begin
    follower.close()
    return {"follow_records": count, "follow_per_s": count / seconds}


def show(rows: list[dict[str, float]]) -> None:
    for row in rows:
        for name, value in row.items():
            print(f"{name:>26} {value:10.3f}" if value < 100 else f"{name:>26} {value:10.0f}")
        print()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--directory", type=Path, help="on a real disk; defaults to the folder for temporary files")
    parser.add_argument("--seconds", type=float, default=1.0, help="for each measurement of each round")
    parser.add_argument("--json", type=Path, help="write the rows here as well")
    # Internal: be the answerer.
    parser.add_argument("--serve", metavar="ENDPOINT", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        return run_service("bench", Config(bus=bus_config(arguments.serve, connect_timeout_s=20.0)), answer)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=arguments.directory)))
        place = stack.enter_context(site(folder, "ledger.reserve_bytes=0"))
        bench = Bench(place, folder, stack)
        rows = [measure(bench, size_bytes, arguments.seconds) for size_bytes in SIZES_BYTES]
        rows.append(measure_jobs(bench, 300))
        rows.append(measure_follow(place))
    show(rows)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
