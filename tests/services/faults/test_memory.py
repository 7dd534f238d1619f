"""The resident memory of every process is flat over a long run: it does not follow the length of the input."""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from statistics import median

import psutil
import pytest
from fault_run import FaultRun

from vggt_motion.records import Stream

pytestmark = [pytest.mark.faults, pytest.mark.timeout(1200)]
LAPS = 9
MIB = 2**20
GROWTH_BYTES = 24 * MIB
"""Over half of the run: an allocator's slack, and the records (not the payloads) of some 400 keyframes."""


def test_resident_memory_is_flat_over_a_long_run(
    start_sfm: Callable[..., FaultRun], fault_sample: Path, tmp_path: Path
) -> None:
    images = sorted((fault_sample / "image_0").iterdir())
    drive = tmp_path / "drive"
    drive.mkdir()
    for position, image in enumerate((images + images[::-1]) * LAPS):
        (drive / f"{position:06d}{image.suffix}").symlink_to(image)
    run = start_sfm("run.inference_workers=2", "frontend.max_keyframes=6", "frontend.overlap_keyframes=3", source=drive)
    assert run.wait_until(lambda: run.count(Stream.SUBMAP) > 5), run.finish().output
    samples: dict[str, list[tuple[int, int]]] = defaultdict(list)
    while run.is_running:
        done = run.count(Stream.SUBMAP)
        for name, resident in resident_bytes(run).items():
            samples[name].append((done, resident))
        time.sleep(0.5)
    outcome = run.finish()
    assert outcome.exit_code == 0, outcome.output[-2000:]
    last = max(done for found in samples.values() for done, _ in found)
    assert last > 60, "too short to say anything"
    grown = {}
    for name, found in sorted(samples.items()):
        early = [resident for done, resident in found if last / 3 <= done < last / 2]
        # Until the last submap: the map of the whole is made once at the end, and its size is configured.
        late = [resident for done, resident in found if 5 * last / 6 <= done < last]
        if len(early) < 3 or len(late) < 3:  # the frontend has read everything long before
            continue
        course = " ".join(f"{found[index * (len(found) - 1) // 15][1] / MIB:.0f}" for index in range(16))
        print(
            f"{name:<24}{median(early) / MIB:>7.1f} MiB, at the end {median(late) / MIB:>7.1f} MiB; all along {course}"
        )
        grown[name] = median(late) - median(early)
    assert {"ledger", "backend", "recorder", "router", "gateway", "inference", "inference compute"} <= grown.keys()
    assert max(grown.values()) < GROWTH_BYTES, {name: f"{size / MIB:.1f} MiB" for name, size in grown.items()}


def resident_bytes(run: FaultRun) -> dict[str, int]:
    """The largest process of each service, and of its computing children."""
    found: dict[str, int] = defaultdict(int)
    with contextlib.suppress(psutil.NoSuchProcess):
        for service in psutil.Process(run.process.pid).children():
            with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):
                line = service.cmdline()
                name = line[line.index("serve") + 1]
                found[name] = max(found[name], service.memory_info().rss)
                for child in service.children(recursive=True):
                    if any("spawn_main" in argument for argument in child.cmdline()):
                        found[f"{name} compute"] = max(found[f"{name} compute"], child.memory_info().rss)
        found["run"] = psutil.Process(run.process.pid).memory_info().rss
    return found
