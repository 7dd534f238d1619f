"""Cost of the pure frontend beside what it cannot do without: decode, resize, flow. One core, one run, side by side.

    python tests/benchmarks/bench_frontend.py [--frames N] [--memory-frames N]

Baseline and frontend take turns on the same frames, so that a change of the machine's speed hits both. The baseline is
the same decode call, the same resize and the same DIS on the same images, nothing else. Both decode grey.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import sys
import time
from collections.abc import Iterator
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"

import cv2
import numpy as np

from vggt_motion.bus import codec
from vggt_motion.bus.images import encode_image
from vggt_motion.config import FrontendConfig
from vggt_motion.frontend.flow import DenseFlow, GreyDecoder
from vggt_motion.frontend.pipeline import FrontendPipeline, KeyframeOutput
from vggt_motion.sources.encoded import encode_video_frame
from vggt_motion.sources.registry import open_source
from vggt_motion.sources.source import Frame

TARGET_RATIO = 1.5
BLOCK = 10  # frames per turn


def evaluation_data() -> Path:
    default = Path(__file__).resolve().parents[2].parent / "shared" / "data"
    return Path(os.environ.get("VGGT_MOTION_DATA", default))


def resized(frames: list[Frame], width: int, height: int) -> list[Frame]:
    """The frames at another size, as JPEG."""
    result = []
    for frame in frames:
        pixels = cv2.imdecode(np.frombuffer(frame.encoded, np.uint8), cv2.IMREAD_COLOR)
        big = np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)
        result.append(Frame(frame.index, frame.capture_time_ns, encode_video_frame(big), "image/jpeg"))
    return result


def forever(frames: list[Frame]) -> Iterator[Frame]:
    """The frames there and back, without end, index and time increasing."""
    step_ns = frames[1].capture_time_ns - frames[0].capture_time_ns
    lap = frames + frames[-2:0:-1]
    index = 0
    while True:
        frame = lap[index % len(lap)]
        yield Frame(index, index * step_ns, frame.encoded, frame.media_type)
        index += 1


def compare(name: str, frames: list[Frame], count: int) -> None:
    """Print milliseconds per frame of baseline and frontend, taking turns."""
    config = FrontendConfig()
    baseline_decoder, flow = GreyDecoder(config.flow_width_px), DenseFlow()
    pipeline = FrontendPipeline(config, "front")
    previous = None
    baseline_s, frontend_s, keyframes = [], [], 0
    stream = forever(frames)
    for _ in range(max(2, count // BLOCK)):
        block = [next(stream) for _ in range(BLOCK)]
        begin = time.perf_counter()
        for frame in block:
            grey = baseline_decoder.decode(frame).pixels
            if previous is not None:
                flow.between(previous, grey)
            previous = grey
        middle = time.perf_counter()
        for frame in block:
            keyframes += sum(isinstance(output, KeyframeOutput) for output in pipeline.push(frame))
        end = time.perf_counter()
        baseline_s.append((middle - begin) / BLOCK)
        frontend_s.append((end - middle) / BLOCK)
    baseline_ms = 1e3 * statistics.median(baseline_s)
    frontend_ms = 1e3 * statistics.median(frontend_s)
    ratio = statistics.median(f / b for f, b in zip(frontend_s, baseline_s, strict=True))
    verdict = "within" if ratio <= TARGET_RATIO else "ABOVE"
    states = "".join(f" {state.value}:{number}" for state, number in sorted(pipeline.state_counts.items()))
    sys.stdout.write(
        f"{name:<42} decode+resize+DIS {baseline_ms:6.2f} ms   frontend {frontend_ms:6.2f} ms   "
        f"ratio {ratio:4.2f} ({verdict} {TARGET_RATIO})   {1e3 / frontend_ms:6.1f} frames/s  {states}\n"
    )


def parts(frames: list[Frame]) -> None:
    """Where the baseline's time goes, and what the service adds in its own process."""
    config = FrontendConfig()
    data = [np.frombuffer(frame.encoded, np.uint8) for frame in frames]

    def timed(label: str, call: object, items: list) -> None:
        seconds = []
        for item in items:
            begin = time.perf_counter()
            call(item)  # type: ignore[operator]
            seconds.append(time.perf_counter() - begin)
        sys.stdout.write(f"    {label:<44} {1e3 * statistics.median(seconds):6.2f} ms\n")

    timed("decode, grey", lambda item: cv2.imdecode(item, cv2.IMREAD_GRAYSCALE), data)
    timed("decode, colour (not done in the frontend)", lambda item: cv2.imdecode(item, cv2.IMREAD_COLOR), data)
    timed("decode, grey, and resize", GreyDecoder(config.flow_width_px).decode, frames)
    timed("service: image message, per frame", lambda frame: encode_image(frame, "front"), frames)
    pipeline = FrontendPipeline(config, "front")
    outputs = [output for frame in frames for output in pipeline.push(frame)] + pipeline.finish()
    keyframes = [output.keyframe for output in outputs if isinstance(output, KeyframeOutput)]
    timed("service: keyframe record, per keyframe", codec.encode, keyframes)


def memory(frames: list[Frame], count: int) -> None:
    """Print the resident memory along a long stream."""
    pipeline = FrontendPipeline(FrontendConfig(), "front")
    stream = forever(frames)
    marks = [count * k // 4 for k in range(1, 5)]
    line = []
    for index in range(1, count + 1):
        pipeline.push(next(stream))
        if index == 500 or index in marks:
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            line.append(f"{index}: {pages * resource.getpagesize() / 2**20:.1f} MiB")
    sys.stdout.write(f"resident memory after so many frames   {'   '.join(line)}\n")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--memory-frames", type=int, default=0, help="20000 for the long test")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    data = evaluation_data()
    kitti = list(open_source(str(data / "kitti_00_first200")).frames())
    sys.stdout.write(f"OpenCV {cv2.__version__}, one thread, medians of blocks of {BLOCK} frames\n")
    compare("KITTI 00, 1241x376, driving", kitti, arguments.frames)
    parts(kitti[:60])
    highway = list(open_source(str(data / "video" / "highway_straight.mp4"), end=60).frames())
    compare("motorway, 1920x1080, driving", resized(highway, 1920, 1080), arguments.frames // 2)
    parts(resized(highway[:20], 1920, 1080))
    standing = list(open_source(str(data / "video" / "standing_at_red_light.mp4"), end=330).frames())
    compare("red light, 640x360, standing in traffic", standing, arguments.frames)
    if arguments.memory_frames:
        memory(kitti, arguments.memory_frames)


if __name__ == "__main__":
    main()
