"""Cost of the pure frontend beside what it cannot do without: decode, resize, flow. One core, one run, side by side.

    python tests/benchmarks/bench_frontend.py [--frames N] [--memory-frames N] [--skip-accuracy]

Baseline and frontend take turns on the same frames, and processor time is counted, so that whatever else the machine
does hits both alike. The baseline is
the same decode call, the same resize and the same DIS on the same images, nothing else. Both decode grey. The cost of
the service around it is measured on its own process.

Then what it is worth: F1 of turning against the ground-truth yaw rate with one configuration for all sequences, for
both scores, and how many keyframes and submaps each strategy makes.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # helpers of the tests

from live_session import live_session
from motion_truth import f1, is_turning
from vggt_motion.bus import codec
from vggt_motion.bus.images import encode_image
from vggt_motion.config import FrontendConfig
from vggt_motion.frontend.flow import DenseFlow, GreyDecoder
from vggt_motion.frontend.motion import turning_score_px
from vggt_motion.frontend.pipeline import FrameTrace, FrontendPipeline, KeyframeOutput
from vggt_motion.records import MotionState
from vggt_motion.sources.encoded import encode_video_frame
from vggt_motion.sources.registry import open_source
from vggt_motion.sources.source import Frame

TARGET_RATIO = 1.5
BLOCK = 10  # frames per turn
SHORT_RUN, SERVICE_RUNS = 20, 3


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
        begin = time.thread_time()
        for frame in block:
            grey = baseline_decoder.decode(frame).pixels
            if previous is not None:
                flow.between(previous, grey)
            previous = grey
        middle = time.thread_time()
        for frame in block:
            keyframes += sum(isinstance(output, KeyframeOutput) for output in pipeline.push(frame))
        end = time.thread_time()
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
            begin = time.thread_time()
            call(item)  # type: ignore[operator]
            seconds.append(time.thread_time() - begin)
        sys.stdout.write(f"    {label:<44} {1e3 * statistics.median(seconds):6.2f} ms\n")

    timed("decode, grey", lambda item: cv2.imdecode(item, cv2.IMREAD_GRAYSCALE), data)
    timed("decode, colour (not done in the frontend)", lambda item: cv2.imdecode(item, cv2.IMREAD_COLOR), data)
    timed("decode, grey, and resize", GreyDecoder(config.flow_width_px).decode, frames)
    timed("service: image message, per frame", lambda frame: encode_image(frame, "front"), frames)
    pipeline = FrontendPipeline(config, "front")
    outputs = [output for frame in frames for output in pipeline.push(frame)] + pipeline.finish()
    keyframes = [output.keyframe for output in outputs if isinstance(output, KeyframeOutput)]
    timed("service: keyframe record, per keyframe", codec.encode, keyframes)


def service_cost(sequence: Path) -> None:
    """Processor time per frame of the whole process ``serve frontend``: pipeline, publishing, records, all threads.

    The difference between a long and a short run, so that the start (imports, joining the bus) does not count.
    """
    pure_ms, whole_ms = [], []
    frames = list(open_source(str(sequence)).frames())
    for _ in range(SERVICE_RUNS):
        used = [_service_s(sequence, end) for end in (SHORT_RUN, len(frames))]
        whole_ms.append(1e3 * (used[1] - used[0]) / (len(frames) - SHORT_RUN))
        pipeline = FrontendPipeline(FrontendConfig(), "front")
        begin = time.thread_time()
        for frame in frames:
            pipeline.push(frame)
        pure_ms.append(1e3 * (time.thread_time() - begin) / len(frames))
    pure, whole = statistics.median(pure_ms), statistics.median(whole_ms)
    sys.stdout.write(
        f"service process, {sequence.name}: {whole:.2f} ms of processor time a frame, "
        f"of which the pure stages {pure:.2f} ms, the rest (bus, records, files, health) {whole - pure:.2f} ms\n"
    )


def _service_s(sequence: Path, end: int) -> float:
    with tempfile.TemporaryDirectory() as folder, live_session(Path(folder)) as session:
        process = session.start("frontend", "--source", str(sequence), "--end", str(end)).process
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.returncode == 0
        return usage.ru_utime + usage.ru_stime


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


SEQUENCES = (
    "kitti_00_first200",
    "kitti_01_first51",
    "kitti_06_first51",
    "kitti_raw_road_91",
    "redkitchen_first400",
    "video/highway_straight.mp4",
    "video/standing_at_red_light.mp4",
)


def traces_of(frames: list[Frame], config: FrontendConfig) -> tuple[list[FrameTrace], FrontendPipeline]:
    traces: list[FrameTrace] = []
    pipeline = FrontendPipeline(config, "front", on_trace=traces.append)
    for frame in frames:
        pipeline.push(frame)
    pipeline.finish()
    return traces, pipeline


def turning_table(data: Path, sequences: dict[str, list[Frame]]) -> None:
    """F1 of both scores at their thresholds, and the best that any threshold could reach."""
    sys.stdout.write(
        f"\n{'F1 of turning (truth: above 5 deg/s)':<36}{'turning':>9}{'yaw 1.6':>9}{'best':>7}{'at':>6}"
        f"{'lateral 5':>11}{'best':>7}{'at':>6}\n"
    )
    for name, frames in sequences.items():
        if not (data / name / "poses.txt").is_file():
            continue
        truth = is_turning(data / name, [frame.capture_time_ns for frame in frames])
        traces, _ = traces_of(frames, FrontendConfig())
        moving = np.array([trace.state is not MotionState.STATIC for trace in traces])[1:]
        row = f"{name:<36}{100 * truth.mean():>8.0f}%"
        for score, threshold in (("yaw", 1.6), ("lateral", 5.0)):
            values = np.array([turning_score_px(trace.profile, score) for trace in traces])[1:]
            candidates = np.arange(0.2, 12.0, 0.1)
            scores = [f1((values > t) & moving, truth) for t in candidates]
            best = int(np.nanargmax(scores)) if truth.any() else 0
            row += f"{f1((values > threshold) & moving, truth):>{9 if score == 'yaw' else 11}.3f}"
            row += f"{scores[best]:>7.3f}{candidates[best]:>6.1f}" if truth.any() else f"{'-':>7}{'-':>6}"
        sys.stdout.write(row + "\n")


def strategy_table(sequences: dict[str, list[Frame]]) -> None:
    """Keyframes and submaps of each strategy."""
    strategies = {
        "default": {},
        "paper": {"preset": "paper"},
        "vggt_long": {"preset": "vggt_long"},
        "dense": {"selection": "dense"},
        "uniform": {"selection": "uniform"},
        "covisibility": {"selection": "covisibility"},
        "no pruning": {"static_pruning": False},
        "temporal": {"partition": "temporal"},
        "parallax": {"partition": "parallax"},
    }
    sys.stdout.write(f"\n{'keyframes/submaps':<36}{'frames':>7}" + "".join(f"{name:>13}" for name in strategies) + "\n")
    for name, frames in sequences.items():
        row = f"{name:<36}{len(frames):>7}"
        for changes in strategies.values():
            _, pipeline = traces_of(frames, FrontendConfig.model_validate(changes))
            row += f"{f'{pipeline.keyframe_count}/{pipeline.segment_count}':>13}"
        sys.stdout.write(row + "\n")
    sys.stdout.write(f"\n{'states of the default':<36}{'S':>7}{'T':>7}{'L':>7}\n")
    for name, frames in sequences.items():
        _, pipeline = traces_of(frames, FrontendConfig())
        counts = pipeline.state_counts
        sys.stdout.write(f"{name:<36}" + "".join(f"{counts[state]:>7}" for state in MotionState) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--skip-accuracy", action="store_true")
    parser.add_argument("--memory-frames", type=int, default=0, help="20000 for the long test")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    data = evaluation_data()
    kitti = list(open_source(str(data / "kitti_00_first200")).frames())
    sys.stdout.write(f"OpenCV {cv2.__version__}, one thread, medians of blocks of {BLOCK} frames\n")
    compare("KITTI 00, 1241x376, driving", kitti, arguments.frames)
    parts(kitti[:60])
    service_cost(data / "kitti_00_first200")
    highway = list(open_source(str(data / "video" / "highway_straight.mp4"), end=60).frames())
    compare("motorway, 1920x1080, driving", resized(highway, 1920, 1080), arguments.frames // 2)
    parts(resized(highway[:20], 1920, 1080))
    standing = list(open_source(str(data / "video" / "standing_at_red_light.mp4"), end=330).frames())
    compare("red light, 640x360, standing in traffic", standing, arguments.frames)
    if not arguments.skip_accuracy:
        sequences = {name: list(open_source(str(data / name)).frames()) for name in SEQUENCES}
        turning_table(data, sequences)
        strategy_table(sequences)
    if arguments.memory_frames:
        memory(kitti, arguments.memory_frames)


if __name__ == "__main__":
    main()
