"""How much memory a forward pass needs and how much there is, known before the pass and not from its failure."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import torch

from vggt_motion.errors import PredictionError
from vggt_motion.inference.vggt.architecture import VggtArchitecture
from vggt_motion.inference.vggt.layers import ACCELERATOR_ROW_CHUNK, CPU_ROW_CHUNK

_FLOAT_BYTES = 4
_MAX_FRAME_CHUNK = 16
_CPU_FRAME_CHUNK = 1  # more frames at once are not faster on a CPU, only larger
_LIBRARY_BYTES = 96 * 2**20  # packed operands of matrix products and convolutions


@dataclass(frozen=True)
class MemoryPlan:
    """How a pass will run."""

    frame_chunk: int
    required_bytes: int  # beyond the weights
    available_bytes: int


def pass_bytes(
    architecture: VggtArchitecture,
    frames: int,
    size: tuple[int, int],
    dtype: torch.dtype,
    frame_chunk: int,
    row_chunk: int = CPU_ROW_CHUNK,
) -> int:
    """Upper estimate of the memory of one pass beyond the weights.

    Args:
        architecture: sizes of the network.
        frames: B * S, all submaps of the batch.
        size: rows and columns of the network's images, pixels.
        dtype: of the transformer's matrix products.
        frame_chunk: frames that the dense heads take at a time.
        row_chunk: tokens that a block's matrix products take at a time.
    """
    patches = (size[0] // architecture.patch_px) * (size[1] // architecture.patch_px)
    tokens = frames * (patches + architecture.special_tokens)
    width, item = architecture.width, dtype.itemsize
    # A block: the stream, keys, values; for the rows at hand, the hidden layer before and after its activation, or
    # queries and keys on their way through norm and rotation.
    rows = min(tokens, row_chunk)
    block = tokens * width * (_FLOAT_BYTES + 2 * item) + rows * width * (8 * item + 6 * _FLOAT_BYTES)
    pixels = size[0] * size[1]
    channels = sum(architecture.dense_channels)
    images_and_outputs = frames * pixels * _FLOAT_BYTES * (3 + 2)
    kept_maps = frames * patches * channels * _FLOAT_BYTES
    kept_level = tokens * width * _FLOAT_BYTES
    # Dense head, per frame: either the fusion (inputs at 4 x 4 per patch, its output at 8 x 8) or the output at pixels.
    features = architecture.dense_features
    fusion = patches * (channels + 16 * (architecture.dense_channels[0] + 5 * features) + 64 * 3 * features // 2)
    full = pixels * (features // 2 + 32 + 8) + patches * 64 * features // 2
    dense = frame_chunk * max(fusion, full) * _FLOAT_BYTES
    return _LIBRARY_BYTES + images_and_outputs + kept_maps + max(kept_level + block, dense) * 5 // 4


def plan_pass(
    architecture: VggtArchitecture,
    frames: int,
    size: tuple[int, int],
    dtype: torch.dtype,
    available: int,
    *,
    frame_chunk: int | None = None,
    is_cpu: bool = True,
) -> MemoryPlan:
    """Choose how many frames go through the heads at a time so that the pass fits into ``available`` bytes.

    Raises:
        PredictionError: it does not fit however it is cut; the message has the numbers and what helps.
    """
    row_chunk = CPU_ROW_CHUNK if is_cpu else ACCELERATOR_ROW_CHUNK
    largest = frame_chunk or min(frames, _CPU_FRAME_CHUNK if is_cpu else _MAX_FRAME_CHUNK)
    for chunk in range(largest, 0, -1):
        required = pass_bytes(architecture, frames, size, dtype, chunk, row_chunk)
        if required <= available:
            return MemoryPlan(chunk, required, available)
    raise PredictionError(
        f"a submap of {frames} frames at {size[1]}x{size[0]} needs about {_gib(required)} GiB, {_gib(available)} GiB "
        "are free: smaller submaps (frontend.max_keyframes, frontend.turn_max_keyframes), bfloat16 or a smaller "
        "inference.vggt.width_px need less"
    )


def available_bytes(device: torch.device) -> int:
    """Memory that this process can still take on a device."""
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        # What torch's own allocator holds and does not use is free to us as well.
        return int(free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device))
    if device.type == "mps":
        return int(torch.mps.recommended_max_memory() - torch.mps.current_allocated_memory())
    return host_available_bytes()


def host_available_bytes(proc: Path = Path("/proc"), cgroup: Path = Path("/sys/fs/cgroup")) -> int:
    """Main memory that this process can take: of the machine, and of every control group (container) it is in."""
    limits = [value for value in (_machine_available(proc), *_group_available(proc, cgroup)) if value is not None]
    return min(limits) if limits else os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def is_out_of_memory(error: Exception) -> bool:
    """Whether an exception of torch says that an allocation failed."""
    if isinstance(error, torch.OutOfMemoryError | MemoryError):
        return True
    text = str(error)
    return isinstance(error, RuntimeError) and any(
        sign in text for sign in ("can't allocate memory", "not enough memory", "out of memory")
    )


def _machine_available(proc: Path) -> int | None:
    try:
        for line in (proc / "meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    return None


def _group_available(proc: Path, cgroup: Path) -> list[int]:
    """Free bytes under each limit of control group version 2, from this process's group up to the root."""
    try:
        lines = (proc / "self" / "cgroup").read_text().splitlines()
    except OSError:
        return []
    name = next((line[3:] for line in lines if line.startswith("0::")), None)
    if name is None:
        return []
    found = []
    directory = cgroup / name.strip("/")
    while True:
        try:
            limit = (directory / "memory.max").read_text().strip()
            if limit != "max":
                used = int((directory / "memory.current").read_text())
                statistics = (directory / "memory.stat").read_text().splitlines()
                # File pages, a checkpoint's among them, are counted as used but given back on demand.
                reclaimable = sum(
                    int(line.split()[1]) for line in statistics if line.startswith(("inactive_file ", "active_file "))
                )
                found.append(max(int(limit) - used + reclaimable, 0))
        except (OSError, ValueError, IndexError):
            pass
        if directory == cgroup or cgroup not in directory.parents:
            return found
        directory = directory.parent


def _gib(count: int) -> str:
    return f"{count / 2**30:.1f}"
