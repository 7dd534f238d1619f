"""Our side: starts the foreign interpreter, hands it images and turns its arrays into a prediction."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import sys
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.config import ForeignConfig
from vggt_motion.errors import InputError, MissingDependencyError, PredictionError
from vggt_motion.inference import lattice as lattices
from vggt_motion.inference.foreign import child
from vggt_motion.inference.lattice import Lattice
from vggt_motion.inference.predictor import KeyframeImage, Prediction, PredictionHints
from vggt_motion.records import ScaleKind

Arrays = Mapping[str, npt.NDArray[Any]]
_EXIT_S = 2.0


class MissingOutputError(Exception):
    """The foreign network returned something else than its documentation says."""


class ForeignProcess:
    """A child interpreter with a loaded network. Not thread-safe: one owner calls it."""

    def __init__(self, name: str, runner: str, config: ForeignConfig, install: str, **options: str) -> None:
        """Start the interpreter and wait until the network is loaded.

        Args:
            name: of the predictor, for messages.
            runner: file beside this one that loads the network.
            config: model, interpreter, device.
            install: what to tell a user whose environment lacks the package.
            options: more for the runner.

        Raises:
            MissingDependencyError: the interpreter or the package is absent.
            InputError: the weights cannot be loaded.
        """
        self._name = name
        self._install = install
        self._python = str(config.python.expanduser()) if config.python is not None else sys.executable
        if shutil.which(self._python) is None:
            raise MissingDependencyError(f"inference.{name}.python: no interpreter at {self._python}; {install}")
        options = {"model": config.model, "device": config.device, **options}
        here = Path(__file__).parent
        self._command = [self._python, str(here / "child.py"), str(here / runner), json.dumps(options)]
        self._model = config.model
        self._process: subprocess.Popen[bytes] | None = None
        self._start()

    def predict(self, images: npt.NDArray[np.uint8]) -> tuple[dict[str, npt.NDArray[Any]], float]:
        """Arrays that the network returns for images (S, H, W, 3), and its seconds.

        Raises:
            PredictionError: the network failed; the interpreter is started again for the next call if it died.
        """
        process = self._start()
        assert process.stdin is not None and process.stdout is not None
        try:
            child.write_message(process.stdin, {}, {"images": images})
            message = child.read_message(process.stdout)
        except (OSError, child.MessageError):
            message = None
        if message is None:
            code = self._end()
            raise PredictionError(f"predictor '{self._name}': its process ended with code {code}")
        fields, arrays = message
        if "error" in fields:
            raise PredictionError(f"predictor '{self._name}': {fields['error']}")
        return arrays, float(fields.get("seconds", "nan"))

    def close(self) -> None:
        """End the child."""
        if self._process is not None:
            self._end()

    def _start(self) -> subprocess.Popen[bytes]:
        if self._process is not None and self._process.poll() is None:
            return self._process
        process = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._process = process
        weakref.finalize(self, _kill, process)
        assert process.stdout is not None
        try:
            message = child.read_message(process.stdout)
        except child.MessageError:
            message = None
        if message is not None and "ready" in message[0]:
            return process
        code = self._end()
        if message is not None and "missing" in message[0]:
            raise MissingDependencyError(
                f"predictor '{self._name}' is not in {self._python} ({message[0]['missing']}); {self._install}"
            )
        reason = message[0].get("error", "no answer") if message is not None else f"its process ended with code {code}"
        raise InputError(f"predictor '{self._name}' cannot load '{self._model}': {reason}")

    def _end(self) -> int:
        process, self._process = self._process, None
        assert process is not None
        if process.stdin is not None:
            with contextlib.suppress(OSError):
                process.stdin.close()
        try:
            code = process.wait(_EXIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            code = process.wait()
        if process.stdout is not None:
            process.stdout.close()
        return code


class ForeignPredictor:
    """A foreign network behind the predictor contract."""

    def __init__(
        self,
        name: str,
        label: str,
        process: ForeignProcess,
        prepare: Callable[[int, int], Lattice | None],
        finish: Callable[[Lattice, PredictionHints, Arrays, str, dict[str, float]], Prediction],
    ) -> None:
        """Wire a process to what is particular of one network.

        Args:
            name: of the predictor.
            label: model name in results.
            process: where the network runs.
            prepare: from the images' width and height to the lattice on which the network wants them; None = as
                they are.
            finish: its arrays to a prediction.
        """
        self.name = name
        self._label = label
        self._process = process
        self._prepare = prepare
        self._finish = finish

    def predict(self, images: Sequence[KeyframeImage], hints: PredictionHints) -> Prediction:
        """Predict one submap; see the contract. Focal hints are not used.

        Raises:
            PredictionError: the foreign process failed.
        """
        size = lattices.common_size(images)
        if isinstance(size, str):
            return lattices.failed(size, ScaleKind.RELATIVE, self._label)
        start = time.perf_counter()
        lattice = self._prepare(*size)
        pixels = np.stack([image.pixels if lattice is None else resized(image.pixels, lattice) for image in images])
        prepared = time.perf_counter()
        arrays, seconds = self._process.predict(pixels)
        stages = {"prepare": prepared - start, "network": seconds}
        try:
            if lattice is None:
                height, width = array_of(arrays, "depth", 3).shape[1:]
                lattice = Lattice(width, height, width, height)
            return self._finish(lattice, hints, arrays, self._label, stages)
        except MissingOutputError as error:
            return lattices.failed(str(error), ScaleKind.RELATIVE, self._label, stages)

    def close(self) -> None:
        """End the network's process."""
        self._process.close()


def resized(pixels: npt.NDArray[np.uint8], lattice: Lattice) -> npt.NDArray[np.uint8]:
    """An image (H, W, 3) on the lattice, each pixel the mean of the area it covers where the image shrinks."""
    is_smaller = lattice.width_px * lattice.height_px < pixels.shape[0] * pixels.shape[1]
    method = cv2.INTER_AREA if is_smaller else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(pixels, (lattice.width_px, lattice.height_px), interpolation=method), dtype=np.uint8)


def array_of(arrays: Arrays, name: str, dimensions: int) -> npt.NDArray[np.float64]:
    """A named array of the right number of dimensions as float64.

    Raises:
        MissingOutputError: it is absent or of another form.
    """
    if name not in arrays:
        raise MissingOutputError(
            f"the network returned no {name}; it returned {', '.join(sorted(arrays)) or 'nothing'}"
        )
    array = np.asarray(arrays[name], dtype=np.float64)
    if array.ndim != dimensions:
        raise MissingOutputError(f"the network returned {name} of shape {array.shape}")
    return array


def fit_pinhole(rays: npt.NDArray[np.float64], weights: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The pinhole matrix that fits a network's free rays best, on the lattice where the first pixel centre is (0, 0).

    Column by column, u = fx * x + cx and v = fy * y + cy are lines: least squares, five times re-weighted (Huber, one
    pixel), so that it does not matter where the network puts its principal point or its pixel centres.

    Args:
        rays: (h, w, 2), x / z and y / z.
        weights: (h, w), not negative.

    Returns:
        (3, 3); not finite where the rays do not determine it.
    """
    rows, columns = np.mgrid[0 : rays.shape[0], 0 : rays.shape[1]].astype(np.float64)
    matrix = np.eye(3)
    usable = np.isfinite(rays).all(axis=-1) & (weights > 0)
    for axis, pixel in ((0, columns[usable]), (1, rows[usable])):
        ray, weight = rays[usable][:, axis], weights[usable]
        current = weight
        slope, offset = np.nan, np.nan
        for _ in range(5):
            total = current.sum()
            if not total > 0:
                break
            mean_ray, mean_pixel = (current @ ray) / total, (current @ pixel) / total
            spread = current @ (ray - mean_ray) ** 2
            if not spread > 0:
                slope = np.nan
                break
            slope = (current @ ((ray - mean_ray) * (pixel - mean_pixel))) / spread
            offset = mean_pixel - slope * mean_ray
            residual = np.abs(slope * ray + offset - pixel)
            current = weight / np.maximum(residual, 1.0)
        matrix[axis, axis], matrix[axis, 2] = slope, offset
    return matrix


def _kill(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
        process.wait()
