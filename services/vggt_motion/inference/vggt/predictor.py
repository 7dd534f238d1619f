"""VGGT behind the predictor contract (DESIGN 3.4)."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from vggt_motion.config import VggtConfig
from vggt_motion.errors import InputError, PredictionError
from vggt_motion.geometry import se3
from vggt_motion.inference import lattice as lattices
from vggt_motion.inference.lattice import Lattice
from vggt_motion.inference.predictor import KeyframeImage, Prediction, PredictionHints
from vggt_motion.inference.vggt.architecture import architecture_of
from vggt_motion.inference.vggt.checkpoint import copied_bytes, load_model, open_checkpoint
from vggt_motion.inference.vggt.device import resolve_device, resolve_dtype
from vggt_motion.inference.vggt.memory import MemoryPlan, available_bytes, is_out_of_memory, plan_pass
from vggt_motion.inference.vggt.model import Vggt, VggtOutput
from vggt_motion.inference.vggt.weights import WHERE_TO_GET, fetch_weights
from vggt_motion.records import ScaleKind

_log = logging.getLogger(__name__)
Request = tuple[Sequence[KeyframeImage], PredictionHints]


def load(config: VggtConfig) -> VggtPredictor:
    """Fetch and load the weights and put them on the device.

    Raises:
        InputError: no such weights, weights of another architecture, or no such device.
        PredictionError: the weights alone do not fit into the memory that is free.
    """
    if config.cpu_threads is not None:
        torch.set_num_threads(config.cpu_threads)
    device = resolve_device(config.device)
    dtype = resolve_dtype(config.dtype, device)
    path = fetch_weights(config.model, allow_download=config.allow_download)
    checkpoint = open_checkpoint(path)
    try:
        architecture = architecture_of(checkpoint.shapes, config.dense_levels)
    except InputError as error:
        raise InputError(f"{path.name}: {error}; {WHERE_TO_GET}") from error
    required = copied_bytes(checkpoint, architecture, dtype, device)
    available = available_bytes(device) - config.memory_reserve_bytes
    if required > available:
        raise PredictionError(
            f"VGGT weights {path.name} need {required / 2**30:.1f} GiB as {_name(dtype)} and "
            f"{max(available, 0) / 2**30:.1f} GiB are free on {device}"
        )
    start = time.perf_counter()
    model = load_model(checkpoint, dtype, device, dense_levels=config.dense_levels)
    _log.info("loaded %s on %s as %s in %.1f s", path.name, device, _name(dtype), time.perf_counter() - start)
    label = path.stem if Path(config.model).expanduser() == path else config.model
    return VggtPredictor(model, config, dtype, device, label)


class VggtPredictor:
    """Predicts submaps with a loaded VGGT network. It uses no focal hint: the network has no input for one."""

    name = "vggt"

    def __init__(self, model: Vggt, config: VggtConfig, dtype: torch.dtype, device: torch.device, label: str) -> None:
        """Take a model that is already on its device; ``label`` names its weights in results."""
        self._model = model
        self._config = config
        self.batch_limit = config.max_batch_submaps if device.type != "cpu" else 1  # a CPU is full with one
        self._dtype = dtype
        self._device = device
        self._label = f"vggt {label} {_name(dtype)}"

    def predict(self, images: Sequence[KeyframeImage], hints: PredictionHints) -> Prediction:
        """Predict one submap; see the contract.

        Raises:
            PredictionError: it does not fit into memory; another worker, or half of it, may succeed.
        """
        return self.predict_many([(images, hints)])[0]

    def predict_many(self, requests: Sequence[Request]) -> tuple[Prediction, ...]:
        """Predict several submaps, those of equal size together as far as ``max_batch_submaps`` and memory allow.

        Raises:
            PredictionError: a single submap does not fit into memory.
        """
        results: dict[int, Prediction] = {}
        groups: dict[tuple[int, Lattice], list[int]] = {}
        for index, (images, _) in enumerate(requests):
            size = lattices.common_size(images)
            if isinstance(size, str):
                results[index] = lattices.failed(size, ScaleKind.RELATIVE, self._label)
                continue
            lattice = lattices.fit_width(*size, self._config.width_px, self._model.architecture.patch_px)
            groups.setdefault((len(images), lattice), []).append(index)
        for (frames, lattice), indices in groups.items():
            for batch, plan in self._batches(indices, frames, lattice):
                some = [requests[index] for index in batch]
                results.update(zip(batch, self._predict_batch(some, lattice, plan), strict=True))
        return tuple(results[index] for index in range(len(requests)))

    def _batches(self, indices: list[int], frames: int, lattice: Lattice) -> Iterator[tuple[list[int], MemoryPlan]]:
        """Cut submaps of one shape into batches that fit."""
        start = 0
        while start < len(indices):
            count = min(self._config.max_batch_submaps, len(indices) - start)
            while True:
                try:
                    plan = self._plan(count * frames, lattice)
                    break
                except PredictionError:
                    if count == 1:
                        raise
                    count = (count + 1) // 2
            yield indices[start : start + count], plan
            start += count

    def _plan(self, frames: int, lattice: Lattice) -> MemoryPlan:
        return plan_pass(
            self._model.architecture,
            frames,
            (lattice.window_height_px, lattice.window_width_px),
            self._dtype,
            available_bytes(self._device) - self._config.memory_reserve_bytes,
            frame_chunk=self._config.frame_chunk,
            is_cpu=self._device.type == "cpu",
        )

    def _predict_batch(self, requests: Sequence[Request], lattice: Lattice, plan: MemoryPlan) -> list[Prediction]:
        start = time.perf_counter()
        batch = torch.stack([network_images(images, lattice) for images, _ in requests])
        prepared = time.perf_counter()
        try:
            output = self._model(batch.to(self._device).float().div_(255.0), frame_chunk=plan.frame_chunk)
        except Exception as error:
            if not is_out_of_memory(error):
                raise
            if self._device.type == "cuda":
                torch.cuda.empty_cache()
            raise PredictionError(
                f"out of memory on {self._device} with {len(requests)} submaps of {batch.shape[1]} frames at "
                f"{lattice.window_width_px}x{lattice.window_height_px}: {plan.required_bytes / 2**30:.1f} GiB were "
                f"expected to do, {plan.available_bytes / 2**30:.1f} GiB were free"
            ) from error
        share = 1.0 / len(requests)
        seconds = {
            "prepare": (prepared - start) * share,
            **{part: value * share for part, value in output.seconds.items()},
        }
        return [self._finish(index, output, hints, lattice, seconds) for index, (_, hints) in enumerate(requests)]

    def _finish(
        self, index: int, output: VggtOutput, hints: PredictionHints, lattice: Lattice, seconds: dict[str, float]
    ) -> Prediction:
        height, width = lattice.window_height_px, lattice.window_width_px
        encodings = output.pose_encoding[index].double().cpu().numpy()
        raw_confidence = output.depth_confidence[index].cpu().numpy()
        with np.errstate(divide="ignore", invalid="ignore"):
            pinhole = pinhole_matrices(encodings, width, height)
            poses = submap_from_camera(encodings)
        return lattices.assemble(
            lattice,
            hints,
            output.depth[index].cpu().numpy(),
            unit_confidence(raw_confidence),
            pinhole,
            poses,
            scale_kind=ScaleKind.RELATIVE,
            model=self._label,
            stage_seconds=seconds,
        )


def network_images(images: Sequence[KeyframeImage], lattice: Lattice) -> Tensor:
    """Resize with an antialiased bicubic kernel, as the network was trained, and cut the window.

    Args:
        images: of one size.
        lattice: from :func:`vggt_motion.inference.lattice.fit_width`.

    Returns:
        (S, 3, h, w) uint8 RGB.
    """
    rows, columns = lattice.window
    result = torch.empty(len(images), 3, lattice.window_height_px, lattice.window_width_px, dtype=torch.uint8)
    for image, into in zip(images, result, strict=True):
        pixels = torch.from_numpy(np.array(image.pixels, copy=True)).permute(2, 0, 1)[None]
        size = (lattice.height_px, lattice.width_px)
        into.copy_(F.interpolate(pixels, size=size, mode="bicubic", antialias=True)[0, :, rows, columns])
    return result


def unit_confidence(raw: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """VGGT's confidence 1 + exp(x) brought to [0, 1): the logistic function of x, 1 - 1 / raw. Order is kept."""
    return np.asarray(1.0 - 1.0 / raw, dtype=np.float32)


def pinhole_matrices(encodings: npt.NDArray[np.float64], width_px: int, height_px: int) -> npt.NDArray[np.float64]:
    """Pinhole matrices (S, 3, 3) of the network's image from pose encodings (S, 9).

    The principal point is at (width / 2, height / 2) of a lattice whose first pixel centre is (0, 0): half a pixel off
    the middle, as the network was trained and as its authors unproject.
    """
    result = np.zeros((len(encodings), 3, 3))
    result[:, 0, 0] = 0.5 * width_px / np.tan(0.5 * encodings[:, 8])
    result[:, 1, 1] = 0.5 * height_px / np.tan(0.5 * encodings[:, 7])
    result[:, 0, 2], result[:, 1, 2], result[:, 2, 2] = 0.5 * width_px, 0.5 * height_px, 1.0
    return result


def submap_from_camera(encodings: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Camera poses (S, 4, 4) from pose encodings (S, 9); the submap's frame is what the network calls world."""
    result: npt.NDArray[np.float64] = np.full((len(encodings), 4, 4), np.nan)
    for pose, encoding in zip(result, encodings, strict=True):
        if np.isfinite(encoding).all() and np.linalg.norm(encoding[3:7]) > 0:
            rotation = se3.rotation_from_quaternion(encoding[[6, 3, 4, 5]])
            pose[:] = se3.inverse(se3.make(rotation, encoding[:3]))
    return result


def _name(dtype: Any) -> str:
    return str(dtype).removeprefix("torch.")
