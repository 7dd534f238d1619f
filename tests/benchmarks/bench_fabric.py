"""What the fabric costs: append, claim/done and follow beside the bare limits, and its share of a run's CPU seconds.

    python tests/benchmarks/bench_fabric.py [--directory DIR] [--seconds S] [--source SOURCE] [--json FILE]

Three processes on loopback: router, ledger, client. The bare limits are: write and fsync of the same bytes to a new
file; the same bytes over Zenoh through the router to a process that answers with one byte (one hop); their SHA-256.
Each is measured in a loop of its own, with everything it touches in the caches. The chain is all three in a row, as in
an append: one hop to a process that writes, forces to the disk and hashes before it answers; nothing else.
The folder must be on a real disk: in memory an fsync costs nothing. A round measures everything for a moment, and the
rounds are repeated, so that a disk that has a bad minute has it for all.

Then one ``vggt-motion run`` of a source, whose processes are watched. Numerics are the computing children, the frames
and pixels in the frontend, the trajectories and maps in the recording (of both the processor time of the threads in the
pure functions, which the services count in place, and of the frontend that of FFmpeg's threads), and the results that
``run`` writes after the final graph; everything else after start-up is fabric. Start-up ends with the frontend's first
record: until then the others import, open their files and start their children.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import TypeVar

import psutil
import zenoh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from bench_bus import answer

from bus_processes import bus_config, free_port, running, wait_until
from ledger_processes import Site, depth_blob, event, keyframe, predict, site, submap
from vggt_motion.bus import codec
from vggt_motion.bus.follow import Follower
from vggt_motion.bus.ledger import append_request
from vggt_motion.bus.service import ServiceContext, run_service
from vggt_motion.bus.session import Sample, open_bus, zenoh_config
from vggt_motion.config import BusConfig, Config, LedgerConfig
from vggt_motion.errors import LedgerError
from vggt_motion.ledger.admission import admitted
from vggt_motion.ledger.service import open_session
from vggt_motion.ledger.sqlite import read_only
from vggt_motion.records import Event, HealthReport, JobKind, Keyframe, SubmapSpec

SIZES_BYTES = (100, 100_000, 5_000_000)
IN_FLIGHT = 64
JOBS = 100
FOLLOWED = 100
ROUNDS = 3
BRIEF_S, OFTEN_S, SELDOM_S = 0.01, 0.1, 1.0  # between two looks at the processes of a run
COUNT_IN_PLACE = ("frontend", "recorder")  # services with numerics in threads of their own process
SAMPLE = Path(__file__).resolve().parents[1] / "data" / "kitti_06_first51"
MIN_COUNT = 3
BYTES_PER_ROUND = 400_000_000  # a round of large records ends early rather than fill the disk


Entry = tuple[str, str, Event | Keyframe, list[bytes]]
Item = TypeVar("Item")


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

    def data(self) -> bytes:
        """New bytes."""
        return self.next()[1]

    def record(self) -> Entry:
        """Small records have no blob; the others are keyframes with an image of the size."""
        number, data = self.next()
        if self.size_bytes <= 100:
            record = event(number, f"bench{self.size_bytes}")
            return "event", record.event_id, record, []
        frame = keyframe(self.size_bytes * 1_000_000 + number, data)
        return "keyframe", frame.keyframe_id, frame, [data]


def one_by_one(make: Callable[[], Item], call: Callable[[Item], object], seconds: float, max_count: int) -> list[float]:
    """Seconds of every call; what it is called with is made before."""
    durations: list[float] = []
    end = time.perf_counter() + seconds
    while (time.perf_counter() < end or len(durations) < MIN_COUNT) and len(durations) < max_count:
        item = make()
        begin = time.perf_counter()
        call(item)
        durations.append(time.perf_counter() - begin)
    return durations


def many_at_once(make: Callable[[], Item], call: Callable[[Item], object], seconds: float, max_count: int) -> float:
    """Calls per second with IN_FLIGHT of them under way."""
    end = time.perf_counter() + seconds
    counts = [0] * IN_FLIGHT
    share = max(1, max_count // IN_FLIGHT)

    def run(index: int) -> None:
        while counts[index] < share and (time.perf_counter() < end or counts[index] == 0):
            call(make())
            counts[index] += 1

    begin = time.perf_counter()
    with ThreadPoolExecutor(IN_FLIGHT) as pool:
        list(pool.map(run, range(IN_FLIGHT)))
    return sum(counts) / (time.perf_counter() - begin)


def write_and_sync(folder: Path, data: bytes) -> None:
    """A new file with this content, which begins with a number of its own, forced to the disk."""
    descriptor = os.open(folder / f"{len(data)}-{data[:8].hex()}", os.O_WRONLY | os.O_CREAT | os.O_EXCL)
    os.write(descriptor, data)
    os.fsync(descriptor)
    os.close(descriptor)


def answer_chain(context: ServiceContext, folder: Path) -> None:
    """Beside the bare answers: one that writes, forces to the disk and hashes before it answers, in 16 threads."""
    session = zenoh.open(zenoh_config(context.config.bus))
    key = context.bus.keys.rpc("bench", "chain")
    queryable = session.declare_queryable(key, zenoh.handlers.FifoChannel(1024), complete=True)

    def loop() -> None:
        with contextlib.suppress(zenoh.ZError):
            while True:
                with queryable.handler.recv() as query:
                    assert query.payload is not None
                    data = query.payload.to_bytes()
                    write_and_sync(folder, data)
                    hashlib.sha256(data).digest()
                    query.reply(key, b"k")

    for _ in range(16):
        threading.Thread(target=loop, daemon=True).start()
    answer(context)
    session.close()  # type: ignore[no-untyped-call]


class Bench:
    """The calls that are compared, on one set of processes."""

    def __init__(self, place: Site, folder: Path, stack: ExitStack) -> None:
        chain_folder = folder / "chain"
        self.folder = folder / "bare"
        for made in (chain_folder, self.folder):
            made.mkdir()
        stack.enter_context(running(folder, "--serve", place.endpoint, str(chain_folder), script=Path(__file__)))
        self.place = place
        self.client = place.client()
        self.jobs = place.jobs()
        self.session = zenoh.open(zenoh_config(place.bus.config))
        stack.callback(self.session.close)
        self.hop_key = place.bus.keys.rpc("bench", "bare")
        self.chain_key = place.bus.keys.rpc("bench", "chain")
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

    def fsync(self, data: bytes) -> None:
        """A new file, durable."""
        write_and_sync(self.folder, data)

    def chain(self, data: bytes) -> None:
        """All bare limits in a row."""
        reply = self.session.get(self.chain_key, payload=data, timeout=30.0).recv().ok
        assert reply is not None and reply.payload.to_bytes() == b"k"

    def append(self, entry: Entry) -> None:
        """Over the bus, as every service does."""
        assert not self.client.append(*entry).was_known

    def append_locally(self, entry: Entry) -> None:
        """The same without the bus: what store and admission cost."""
        self.store.store.append(*admitted(append_request(*entry)))

    def claim_and_done(self, depths: Mapping[int, bytes], shape: tuple[int, int]) -> None:
        """One job: leased, and its result with one blob committed."""
        lease = self.jobs.claim([JobKind.PREDICT], [], "inference/bench", 1.0)
        assert lease is not None
        index = codec.decode(SubmapSpec, lease.job.payload).submap_index
        depth = depths[index]
        assert self.jobs.done(lease, "submap", lease.job.job_id, submap(index, depth, shape=shape), [depth])


def measure(bench: Bench, size_bytes: int, seconds: float) -> dict[str, float]:
    """One size: medians in milliseconds, rates per second."""
    bare: dict[str, Callable[[bytes], object]] = {
        "fsync": bench.fsync,
        "hop": bench.hop,
        "hash": lambda data: hashlib.sha256(data).digest(),
        "chain": bench.chain,
        "request": bench.request,
    }
    ours: dict[str, Callable[[Entry], object]] = {"append": bench.append, "local": bench.append_locally}
    sources = {name: Source(size_bytes) for name in (*bare, *ours)}
    durations: dict[str, list[float]] = {name: [] for name in sources}
    rates: dict[str, list[float]] = {name: [] for name in ("hop", "chain", "append", "local")}
    max_count = max(IN_FLIGHT, BYTES_PER_ROUND // ROUNDS // max(size_bytes, 1))
    for _ in range(ROUNDS):
        for name, spent in durations.items():
            if name in bare:
                spent += one_by_one(sources[name].data, bare[name], seconds, max_count)
            else:
                spent += one_by_one(sources[name].record, ours[name], seconds, max_count)
        for name, counted in rates.items():
            if name in bare:
                counted.append(many_at_once(sources[name].data, bare[name], seconds, max_count))
            else:
                counted.append(many_at_once(sources[name].record, ours[name], seconds, max_count))
    ms = {name: 1e3 * median(spent) for name, spent in durations.items()}
    fsync_rate = len(durations["fsync"]) / sum(durations["fsync"])
    return {
        "bytes": size_bytes,
        **{f"{name}_ms": value for name, value in ms.items()},
        "append_over_sum": ms["append"] / (ms["fsync"] + ms["hop"] + ms["hash"]),
        "append_over_chain": ms["append"] / ms["chain"],
        "fsync_per_s": fsync_rate,
        **{f"{name}_64_per_s": median(counted) for name, counted in rates.items()},
        "append_64_over_fsync": median(rates["append"]) / fsync_rate,
        "chain_64_over_fsync": median(rates["chain"]) / fsync_rate,
    }


def measure_jobs(bench: Bench, size_bytes: int, first: int, count: int) -> dict[str, float]:
    """Claim and done of results with one blob of a size, one worker and eight."""
    width = max(2, round((size_bytes / 3) ** 0.5))  # incompressible: two bytes of depth and one of confidence a pixel
    shape = width, max(2, round(size_bytes / 3 / width))
    depths = {index: depth_blob(index, *shape) for index in range(first, first + 2 * count)}
    bench.jobs.submit([predict(index) for index in depths])
    begin = time.perf_counter()
    for _ in range(count):
        bench.claim_and_done(depths, shape)
    one = count / (time.perf_counter() - begin)
    begin = time.perf_counter()
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: bench.claim_and_done(depths, shape), range(count)))
    return {
        "result_bytes": len(depths[first]),
        "claim_done_per_s": one,
        "claim_done_8_workers_per_s": count / (time.perf_counter() - begin),
    }


def measure_follow(place: Site) -> list[dict[str, float]]:
    """A late follower reads whole streams: small records, and keyframes with their images."""
    count = place.status().position("event")
    begin = time.perf_counter()
    follower = Follower(place.bus, "event", Event)
    for _ in range(count):
        assert follower.next(10.0) is not None
    rows = [{"bytes": 100.0, "follow_records": float(count), "follow_per_s": count / (time.perf_counter() - begin)}]
    follower.close()
    ledger = place.client()
    images = Follower(place.bus, "keyframe", Keyframe)
    seconds: dict[int, list[float]] = {}
    for _ in range(place.status().position("keyframe")):
        begin = time.perf_counter()
        followed = images.next(10.0)
        assert followed is not None
        of_size = seconds.setdefault(followed.record.image.size_bytes, [])
        if len(of_size) < FOLLOWED:
            ledger.blob(followed.record.image)
            of_size.append(time.perf_counter() - begin)
    images.close()
    rows += [
        {"bytes": float(size), "follow_records": float(len(spent)), "follow_per_s": len(spent) / sum(spent)}
        for size, spent in sorted(seconds.items())
    ]
    return rows


class Watched:
    """CPU seconds of the processes of a run, by service; a computing child is ``SERVICE compute``."""

    def __init__(self, run: psutil.Process) -> None:
        self._run = run
        self._names: dict[int, str] = {}
        self._alive: set[int] = set()
        self._decoding: dict[int, float] = {}
        self.used: dict[int, float] = {}

    def has(self, name: str) -> bool:
        """Whether a service was alive at the last look."""
        return any(self._names.get(pid) == name for pid in self._alive)

    def look(self) -> None:
        with contextlib.suppress(psutil.NoSuchProcess):
            processes = [self._run, *self._run.children(recursive=True)]
            self._alive = {process.pid for process in processes}
            for process in processes:
                with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):
                    # each time: between fork and exec a child has its parent's command line; one that has ended and is
                    # not taken leave of yet has none, but says what it used in all
                    if process.status() != psutil.STATUS_ZOMBIE:
                        self._names[process.pid] = self._name_of(process)
                    elif process.pid not in self._names:
                        continue
                    times = process.cpu_times()
                    self.used[process.pid] = times.user + times.system
                    if self._names[process.pid] == "frontend":
                        self._look_at_decoder(process)

    def decoding_s(self) -> float:
        """CPU seconds of the threads in which FFmpeg turns video into pixels; they bear its name."""
        return sum(self._decoding.values())

    def _look_at_decoder(self, process: psutil.Process) -> None:
        for thread in process.threads():
            with contextlib.suppress(OSError):
                if Path(f"/proc/{process.pid}/task/{thread.id}/comm").read_text().startswith("av:"):
                    self._decoding[thread.id] = thread.user_time + thread.system_time

    def by_name(self) -> dict[str, float]:
        """CPU seconds of each service, up to the last look."""
        total: dict[str, float] = defaultdict(float)
        for pid, seconds in self.used.items():
            total[self._names[pid]] += seconds
        return total

    def _name_of(self, process: psutil.Process) -> str:
        line = process.cmdline()
        if "serve" in line:
            return line[line.index("serve") + 1]
        if process.pid == self._run.pid:
            return "run"
        return f"{self._names.get(process.ppid(), 'run')} compute"


def has_record(database: Path, stream: str, record_id: str) -> bool:
    """Whether the log holds a record; read from its file, so that the ledger has no work with it."""
    with contextlib.suppress(LedgerError), read_only(database) as reader:
        return reader.find_record(stream, record_id) is not None
    return False


class NumericsWatch:
    """What the services of a run say of the processor seconds that their own threads spent on numerics."""

    def __init__(self, endpoint: str) -> None:
        self.cpu_s: dict[str, float] = {}
        self._bus = open_bus(BusConfig(endpoint=endpoint, connect_timeout_s=60.0))
        for service in COUNT_IN_PLACE:
            self._bus.subscribe(self._bus.keys.all_health(service), self._on_health, is_small=True)

    def _on_health(self, sample: Sample) -> None:
        report = codec.decode(HealthReport, sample.payload)
        self.cpu_s[report.service] = report.counters.get("numerics_cpu_s", 0.0)

    def close(self) -> None:
        self._bus.close()


def measure_share(folder: Path, source: str) -> dict[str, float]:
    """CPU seconds of one run."""
    out = folder / "run"
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "vggt_motion", "run", source, "--out", str(out)]
    command += ["--set", "gateway.port=0", "--set", f"bus.endpoint={endpoint}"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    watched = Watched(psutil.Process(process.pid))
    in_place = NumericsWatch(endpoint)

    def counted() -> dict[str, float]:
        """Numerics of those services that compute in their own process, since they began."""
        return in_place.cpu_s | {"frontend": in_place.cpu_s.get("frontend", 0.0) + watched.decoding_s()}

    start_up: dict[str, float] = {}
    start_up_numerics: dict[str, float] = {}
    run_until_graph = 0.0
    is_sending = is_solved = False
    database = out / "ledger" / "ledger.db"
    next_look_s = 0.0
    while process.poll() is None:
        if not is_sending:
            watched.look()
            is_sending = has_record(database, "event", "session_started")
            start_up = watched.by_name()
            start_up_numerics = counted()
        elif not is_solved:
            is_solved = has_record(database, "graph", "graph/final")
            # Whoever looks takes time and caches away from those that are looked at: seldom, where nobody ends.
            if is_solved or watched.has("frontend") or time.monotonic() >= next_look_s:
                watched.look()
                next_look_s = time.monotonic() + SELDOM_S
            run_until_graph = watched.by_name()["run"]
        else:
            watched.look()
        # What the frontend does between its first record and our look counts as start-up.
        time.sleep(BRIEF_S if not is_sending and watched.has("frontend") else OFTEN_S)
    in_place.close()
    assert process.returncode in (0, 3), f"the run ended with {process.returncode}"
    used = {name: seconds - start_up.get(name, 0.0) for name, seconds in watched.by_name().items()}
    numerics = {name: seconds for name, seconds in used.items() if name.endswith(" compute")}
    numerics |= {name: seconds - start_up_numerics.get(name, 0.0) for name, seconds in counted().items()}
    numerics["run"] = max(0.0, used["run"] - (run_until_graph - start_up.get("run", 0.0)))
    services = [name for name in used if not name.endswith(" compute")]
    row = {f"{name}_fabric_s": used[name] - numerics.get(name, 0.0) for name in services}
    fabric, everything = sum(row.values()), sum(used.values())
    row |= {f"{name.replace(' ', '_')}_numerics_s": seconds for name, seconds in numerics.items()}
    return row | {"fabric_s": fabric, "all_s": everything, "fabric_share_percent": 100.0 * fabric / everything}


def show(rows: list[dict[str, float]]) -> None:
    for row in rows:
        for name, value in row.items():
            print(f"{name:>26} {value:10.3f}" if value < 100 else f"{name:>26} {value:10.0f}")
        print()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--directory", type=Path, help="on a real disk; defaults to the folder for temporary files")
    parser.add_argument("--seconds", type=float, default=1.0, help="for each measurement of each round")
    parser.add_argument("--source", default=str(SAMPLE), help="of the run whose CPU seconds are counted")
    parser.add_argument("--json", type=Path, help="write the rows here as well")
    # Internal: be the answerer.
    parser.add_argument("--serve", nargs=2, metavar=("ENDPOINT", "FOLDER"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        endpoint, chain_folder = arguments.serve
        config = Config(bus=bus_config(endpoint, connect_timeout_s=20.0))
        return run_service("bench", config, lambda context: answer_chain(context, Path(chain_folder)))
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=arguments.directory)))
        place = stack.enter_context(site(folder, "ledger.reserve_bytes=0"))
        bench = Bench(place, folder, stack)
        rows = [measure(bench, size_bytes, arguments.seconds) for size_bytes in SIZES_BYTES]
        for number, size_bytes in enumerate(SIZES_BYTES):
            rows.append(measure_jobs(bench, size_bytes, 10_000 * number, JOBS if size_bytes < 1e6 else JOBS // 10))
        rows += measure_follow(place)
    with tempfile.TemporaryDirectory(dir=arguments.directory) as name:
        rows.append(measure_share(Path(name), arguments.source))
    show(rows)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
