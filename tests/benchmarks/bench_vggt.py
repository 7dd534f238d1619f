"""Memory and time of VGGT on this machine's CPU, beside a plain variant of the same network in the same run.

The plain variant keeps its weights in memory and the outputs of all levels, takes all frames and tokens at once
everywhere and builds what a complete implementation has: depth and point heads, which it runs, and the tracking head's
parameters. Weights are made by rule (rule_weights.py) and written to a checkpoint once, from which both load. Each
measurement is a process of its own. The default is the published 1B network and needs up to 10 GB of memory, 5 GB of
disk and some minutes. Run:
``python tests/benchmarks/bench_vggt.py [--configuration small] [--dtypes bfloat16] [--checkpoint FILE] [--json FILE]``.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
try:
    import torch
except ImportError:
    sys.exit("bench_vggt: torch is not installed: pip install 'vggt-motion[torch]'")
import numpy as np
from torch import Tensor

from rule_weights import rule_weight
from vggt_motion.inference.vggt.architecture import SMALL, VGGT_1B, VggtArchitecture
from vggt_motion.inference.vggt.checkpoint import inference_dtype, load_model, open_checkpoint
from vggt_motion.inference.vggt.dense_head import DenseHead, activate_depth, activate_points
from vggt_motion.inference.vggt.memory import host_available_bytes, pass_bytes
from vggt_motion.inference.vggt.model import DEFAULT_FRAME_CHUNK, Vggt, VggtOutput
from vggt_motion.inference.vggt.predictor import pinhole_matrices, submap_from_camera
from vggt_motion.inference.vggt.stopwatch import Stopwatch

ARCHITECTURES = {"vggt_1b": VGGT_1B, "small": SMALL}
DTYPES = ("float32", "bfloat16")
GEMM_SECONDS = 3.0


@dataclass(frozen=True)
class Measurement:
    """One pass in one process."""

    variant: str
    dtype: str
    load_seconds: float
    weights_bytes: int  # resident before the pass, above what Python and torch take alone
    peak_bytes: int  # resident, all
    seconds: float
    cpu_seconds: float  # of all threads: what other processes on the machine disturb least
    parts: dict[str, float]
    depth_sum: float  # equal for all variants of a dtype up to rounding
    gemm_flops: float  # per second, in this dtype
    gemm_float32_flops: float


def parameter_shapes(architecture: VggtArchitecture) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a published checkpoint, all heads included."""
    with torch.device("meta"):
        model = Vggt(architecture, with_points=True, with_tracking=True)
    return {name: tuple(value.shape) for name, value in model.state_dict().items()}


def write_checkpoint(architecture: VggtArchitecture, path: Path) -> None:
    """A checkpoint of rule weights, as the published ones are: float32, every head."""
    shapes = parameter_shapes(architecture)
    # "~": the name of an unfinished file must not pass for the checkpoint
    unfinished = path.with_name(path.name + "~")
    torch.save(
        {name: torch.from_numpy(np.ascontiguousarray(rule_weight(name, shapes[name]))) for name in shapes}, unfinished
    )
    unfinished.rename(path)


def warm(path: Path) -> None:
    """Read a file, so that the page cache has it: disks are not what is measured."""
    with path.open("rb", buffering=0) as file:
        while file.read(2**24):
            pass


def build_plain(architecture: VggtArchitecture, path: Path, dtype: torch.dtype) -> Vggt:
    """All parameters of a checkpoint in memory."""
    with torch.device("meta"):
        model = Vggt(architecture, with_points=True, with_tracking=True)
    checkpoint = open_checkpoint(path)
    state = {name: checkpoint.read(name).to(inference_dtype(name, dtype), copy=True) for name in model.state_dict()}
    model.load_state_dict(state, strict=True, assign=True)
    return model.eval().requires_grad_(False)


class PlainPass:
    """The forward pass without any of the measures against memory."""

    def __init__(self, model: Vggt):
        self.model = model
        model.set_row_chunk(None)
        model.aggregator.embedded_frames = 10**6

    @torch.inference_mode()
    def __call__(self, images: Tensor) -> VggtOutput:
        model, stopwatch = self.model, Stopwatch(images.device)
        height, width = images.shape[-2:]
        every = frozenset(range(model.architecture.depth))
        kept = [
            torch.cat([level.of_frames, level.of_global], dim=-1)
            for level in model.aggregator.levels(images, every, stopwatch=stopwatch)
        ]
        with stopwatch("camera_head"):
            pose = model.camera_head(kept[-1][:, :, 0])
        with stopwatch("dense_head"):
            depth, confidence = activate_depth(self._dense(model.depth_head, kept, (height, width)))
        with stopwatch("point_head"):
            points, point_confidence = activate_points(self._dense(model.point_head, kept, (height, width)))
        return VggtOutput(pose, depth[None], confidence[None], points[None], point_confidence[None], stopwatch.seconds)

    def _dense(self, head: DenseHead, kept: list[Tensor], size: tuple[int, int]) -> Tensor:
        patch = self.model.architecture.patch_px
        patches = slice(self.model.architecture.special_tokens, None)
        grid = (size[0] // patch, size[1] // patch)
        maps = []
        for position, index in enumerate(head.levels):
            tokens = kept[index][0, :, patches]
            maps.append(head.project(position, tokens, grid, size[1] / size[0]).contiguous())
        return head.decode(maps, size)


def flops(architecture: VggtArchitecture, frames: int, size: tuple[int, int]) -> dict[str, float]:
    """Floating-point operations of each part's matrix products and convolutions, a multiply-add counted as two."""
    rows, columns = size[0] // architecture.patch_px, size[1] // architecture.patch_px
    patches, width = rows * columns, architecture.width
    tokens = patches + architecture.special_tokens

    def block(count: float, seen: float, channels: int) -> float:
        return 24.0 * channels**2 * count + 4.0 * channels * count * seen

    embedding = 2.0 * 3 * architecture.patch_px**2 * width * patches
    camera = architecture.camera_depth * block(frames, frames, 2 * width)
    camera += 2.0 * frames * (2 * width) * (9 + 3 * 2 * width + width) + 2.0 * frames * width * 9
    c, f = architecture.dense_channels, architecture.dense_features
    coarsest = math.ceil(rows / 2) * math.ceil(columns / 2)
    areas = (16 * patches, 4 * patches, patches, coarsest)
    dense = sum(2.0 * 2 * width * count * patches for count in c)
    dense += 2.0 * (c[0] ** 2 * areas[0] + c[1] ** 2 * areas[1] + 9 * c[3] ** 2 * coarsest)
    dense += sum(2.0 * 9 * count * f * area for count, area in zip(c, areas, strict=True))
    dense += sum(2.0 * (9 * f * f * units + f * f) * area for units, area in zip((4, 4, 4, 2), areas, strict=True))
    dense += 2.0 * 9 * f * (f // 2) * 64 * patches + 2.0 * size[0] * size[1] * (9 * (f // 2) * 32 + 32 * 2)
    return {
        "patch_embedding": frames * (embedding + architecture.backbone_depth * block(tokens, tokens, width)),
        "frame_attention": architecture.depth * frames * block(tokens, tokens, width),
        "global_attention": architecture.depth * block(frames * tokens, frames * tokens, width),
        "camera_head": architecture.camera_refinements * camera,
        "dense_head": frames * dense,
    }


def gemm_rate(dtype: torch.dtype, tokens: int, width: int) -> float:
    """Measured rate of the network's own largest matrix product, operations per second; the best of several."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(tokens, width, generator=generator).to(dtype)
    weight = torch.randn(4 * width, width, generator=generator).to(dtype)
    best, end = math.inf, time.perf_counter() + GEMM_SECONDS
    while time.perf_counter() < end:
        start = time.perf_counter()
        torch.nn.functional.linear(x, weight)
        best = min(best, time.perf_counter() - start)
    return 8.0 * tokens * width**2 / best


def resident(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024
    raise RuntimeError(field)


def measure(arguments: argparse.Namespace) -> Measurement:
    """In this process: load, run once, report."""
    torch.set_num_threads(arguments.threads)
    architecture, dtype = ARCHITECTURES[arguments.configuration], getattr(torch, arguments.dtype)
    is_plain = arguments.variant == "plain"
    images = torch.rand(1, arguments.frames, 3, *arguments.size, generator=torch.Generator().manual_seed(0))
    warm_up = Vggt(SMALL).eval()  # what libraries allocate once is not the network's
    warm_up(images[:, :1, :, :28, :28])
    del warm_up
    ctypes.CDLL(None).malloc_trim(0)
    alone = resident("VmRSS")
    start = time.perf_counter()
    if is_plain:
        model = build_plain(architecture, arguments.checkpoint, dtype)
        run = PlainPass(model)
    else:
        run = model = load_model(open_checkpoint(arguments.checkpoint), dtype, torch.device("cpu"))
    load_seconds = time.perf_counter() - start
    ctypes.CDLL(None).malloc_trim(0)
    before = resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak
    start, cpu_start = time.perf_counter(), time.process_time()
    output = run(images)
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
    peak = resident("VmHWM")
    depth_sum = float(output.depth.double().sum())
    parts = output.seconds
    del output, model, run
    tokens = arguments.frames * (arguments.size[0] // 14 * (arguments.size[1] // 14) + architecture.special_tokens)
    rate = gemm_rate(dtype, tokens, architecture.width)
    rate32 = rate if dtype == torch.float32 else gemm_rate(torch.float32, tokens, architecture.width)
    return Measurement(
        variant=arguments.variant,
        dtype=arguments.dtype,
        load_seconds=load_seconds,
        weights_bytes=before - alone,
        peak_bytes=peak,
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        parts=parts,
        depth_sum=depth_sum,
        gemm_flops=rate,
        gemm_float32_flops=rate32,
    )


def precision(configuration: str) -> dict[str, dict[str, float]]:
    """How far reduced precision moves poses and depth, on the reference images where they are there."""
    fixtures = Path(os.environ.get("VGGT_MOTION_FIXTURES", Path(__file__).resolve().parents[3] / "shared" / "fixtures"))
    file = fixtures / "vggt" / "small_expected.npz"
    if file.is_file():
        pixels = np.load(file)["images_uint8"]
    else:
        pixels = np.random.default_rng(0).integers(0, 256, (3, 98, 140, 3), dtype=np.uint8)
    images = torch.from_numpy(pixels).permute(0, 3, 1, 2)[None].float() / 255
    architecture = ARCHITECTURES[configuration]
    result = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "small.pt"
        write_checkpoint(architecture, path)
        exact, bfloat16, float16 = (
            load_model(open_checkpoint(path), dtype, torch.device("cpu"))(images)
            for dtype in (torch.float32, torch.bfloat16, torch.float16)
        )
    for dtype, reduced in ((torch.bfloat16, bfloat16), (torch.float16, float16)):
        encodings = [output.pose_encoding[0].double().numpy() for output in (exact, reduced)]
        poses = [submap_from_camera(encoding) for encoding in encodings]
        focal = [pinhole_matrices(encoding, pixels.shape[2], pixels.shape[1])[:, 0, 0] for encoding in encodings]
        turns = [np.trace(a[:3, :3].T @ b[:3, :3]) for a, b in zip(*poses, strict=True)]
        scale = np.linalg.norm(poses[0][:, :3, 3], axis=1).mean()
        depth = ((reduced.depth - exact.depth).abs() / exact.depth).flatten()
        result[str(dtype).removeprefix("torch.")] = {
            "rotation_max_deg": float(np.degrees(np.arccos(np.clip((np.array(turns) - 1) / 2, -1, 1))).max()),
            "translation_max_relative": float(np.linalg.norm((poses[0] - poses[1])[:, :3, 3], axis=1).max() / scale),
            "focal_max_relative": float(np.abs(focal[1] / focal[0] - 1).max()),
            "depth_median_relative": float(depth.median()),
            "depth_max_relative": float(depth.max()),
        }
    return result


def run_all(arguments: argparse.Namespace, checkpoint: Path) -> dict[str, dict[str, Measurement]]:
    """Each measurement in a process of its own: dtype -> variant -> result."""
    measurements: dict[str, dict[str, Measurement]] = {}
    for dtype in arguments.dtypes:
        for variant in ("plain", "lean"):
            command = [sys.executable, __file__, "--variant", variant, "--dtype", dtype]
            for name in ("configuration", "frames", "threads"):
                command += [f"--{name}", str(getattr(arguments, name))]
            command += ["--checkpoint", str(checkpoint), "--size", *map(str, arguments.size)]
            warm(checkpoint)
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            measurements.setdefault(dtype, {})[variant] = Measurement(**json.loads(done.stdout.splitlines()[-1]))
            report(measurements[dtype][variant], arguments)
    return measurements


def report(measurement: Measurement, arguments: argparse.Namespace) -> None:
    operations = flops(ARCHITECTURES[arguments.configuration], arguments.frames, arguments.size)
    if measurement.variant == "plain":
        operations["point_head"] = operations["dense_head"]
    print(
        f"\n{measurement.variant} {measurement.dtype}: {measurement.seconds:.1f} s, "
        f"CPU {measurement.cpu_seconds:.1f} s, "
        f"peak {gib(measurement.peak_bytes)}, {gib(measurement.weights_bytes)} of weights before the pass, "
        f"loaded in {measurement.load_seconds:.1f} s, "
        f"GEMM {measurement.gemm_flops / 1e9:.0f} GFLOP/s (float32 {measurement.gemm_float32_flops / 1e9:.0f})"
    )
    limit_sum = 0.0
    for part, seconds in measurement.parts.items():
        is_head = part in ("camera_head", "dense_head", "point_head")
        limit = operations[part] / (measurement.gemm_float32_flops if is_head else measurement.gemm_flops)
        limit_sum += limit
        print(
            f"  {part:17s} {seconds:7.2f} s {100 * seconds / measurement.seconds:5.1f} %"
            f"  {operations[part] / 1e9:8.0f} GFLOP  {operations[part] / seconds / 1e9:6.0f} GFLOP/s"
            f"  {seconds / limit:5.2f} x GEMM limit"
        )
    print(f"  all together {measurement.seconds / limit_sum:.2f} x the GEMM limit of {limit_sum:.1f} s")


def gib(count: int) -> str:
    return f"{count / 2**30:.2f} GiB"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--configuration", choices=ARCHITECTURES, default="vggt_1b")
    parser.add_argument("--frames", type=int, default=17)
    parser.add_argument("--size", type=int, nargs=2, default=(154, 518), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--dtypes", nargs="+", choices=DTYPES, default=DTYPES, help="measure these only")
    parser.add_argument("--checkpoint", type=Path, help="of rule weights; written if it is not there; None = for once")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--variant", choices=("lean", "plain"), help=argparse.SUPPRESS)  # in the child
    parser.add_argument("--dtype", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    arguments.size = tuple(arguments.size)
    if arguments.variant is not None:
        print(json.dumps(asdict(measure(arguments))))
        return
    architecture = ARCHITECTURES[arguments.configuration]
    needed = 8 * sum(math.prod(shape) for shape in parameter_shapes(architecture).values())
    if needed > host_available_bytes():
        sys.exit(
            f"bench_vggt: about {gib(needed)} are needed, {gib(host_available_bytes())} are free: --configuration small"
        )
    size = f"{arguments.size[1]}x{arguments.size[0]}"
    print(f"{arguments.configuration}, {arguments.frames} frames of {size}, {arguments.threads} threads")
    print(f"torch {torch.__version__}")
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = arguments.checkpoint or Path(folder) / "rule.pt"
        if not checkpoint.is_file():
            write_checkpoint(architecture, checkpoint)
        measurements = run_all(arguments, checkpoint)
    print()
    for dtype, pair in measurements.items():
        lean, plain = pair["lean"], pair["plain"]
        estimate = pass_bytes(
            architecture, arguments.frames, arguments.size, getattr(torch, dtype), DEFAULT_FRAME_CHUNK
        )
        print(
            f"{dtype}: lean / plain: memory {lean.peak_bytes / plain.peak_bytes:.2f} "
            f"({gib(lean.peak_bytes)} of {gib(plain.peak_bytes)}), time {lean.seconds / plain.seconds:.2f}, "
            f"CPU time {lean.cpu_seconds / plain.cpu_seconds:.2f}; "
            f"depth sums differ by {abs(lean.depth_sum / plain.depth_sum - 1):.1e}; "
            f"the planner expects {gib(estimate)} beyond the weights"
        )
    differences = precision("small")
    print("reduced precision of the transformer, small network, against float32:")
    for dtype, values in differences.items():
        print(f"  {dtype}: " + ", ".join(f"{name} {value:.2e}" for name, value in values.items()))
    if arguments.json is not None:
        content = {dtype: {name: asdict(value) for name, value in pair.items()} for dtype, pair in measurements.items()}
        arguments.json.write_text(json.dumps({"measurements": content, "precision": differences}, indent=1))


if __name__ == "__main__":
    main()
