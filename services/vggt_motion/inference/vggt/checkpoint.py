"""Loading a checkpoint, strictly: by its own names, one parameter at a time, straight into the dtype of inference."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import math
import re
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vggt_motion.errors import InputError, MissingDependencyError
from vggt_motion.inference.vggt.architecture import VggtArchitecture, architecture_of
from vggt_motion.inference.vggt.layers import ACCELERATOR_ROW_CHUNK, CPU_ROW_CHUNK
from vggt_motion.inference.vggt.mapped import FileMapping, give_back_after_use, mapping_of
from vggt_motion.inference.vggt.model import Vggt

_log = logging.getLogger(__name__)
_TRACKING = "track_head."
_DEPTH = "depth_head."
_WRAPPERS = ("model", "state_dict")
# Matrix products of the transformer run in the inference dtype. Its norms, tokens and scales stay in float32, and so do
# both heads: with the camera head in bfloat16 the fields of view move by 0.4 % on the reference images, five times what
# the transformer's own rounding does to them, and a depth map is an exponential of its head's output.
_REDUCED = re.compile(r"^aggregator\..*\b(qkv|proj|fc1|fc2)\.(weight|bias)$")
_LISTED_NAMES = 12
_LONGEST_REASON = 160  # characters


class CheckpointError(InputError):
    """A checkpoint that does not fit the architecture; the attributes list all names, the message the first ones."""

    def __init__(self, path: Path, missing: Iterable[str], unexpected: Iterable[str], misshapen: Iterable[str]) -> None:
        self.missing, self.unexpected, self.misshapen = tuple(missing), tuple(unexpected), tuple(misshapen)
        parts = [
            f"{len(names)} {kind}: {_listed(names)}"
            for kind, names in (
                ("missing", self.missing),
                ("unexpected", self.unexpected),
                ("misshapen", self.misshapen),
            )
            if names
        ]
        super().__init__(f"checkpoint {path.name} is not of the VGGT architecture: {'; '.join(parts)}")


@dataclass(frozen=True)
class Checkpoint:
    """An open checkpoint: shapes of all parameters, and their values one by one, which may lie in the mapped file."""

    path: Path
    shapes: Mapping[str, tuple[int, ...]]
    read: Callable[[str], Tensor]


def open_checkpoint(path: Path) -> Checkpoint:
    """Open a ``.safetensors`` or ``.pt`` file without reading its values.

    A ``.pt`` file is a pickle by design of torch; it is read with torch's restricted unpickler, which builds tensors
    and nothing else.

    Raises:
        InputError: the file is not a checkpoint.
        MissingDependencyError: the package for ``.safetensors`` is absent.
    """
    if path.suffix == ".safetensors":
        if importlib.util.find_spec("safetensors") is None:
            raise MissingDependencyError(f"checkpoint {path.name} needs a package: pip install 'vggt-motion[torch]'")
        opener = _open_safetensors
    else:
        opener = _open_pickle
    try:
        return opener(path)
    except InputError:
        raise
    # Readers of damaged files raise whatever they stumble over.
    except Exception as error:
        raise InputError(
            f"cannot read checkpoint {path.name}: it is damaged, incomplete or no checkpoint ({_first_line(error)})"
        ) from error


def inference_dtype(name: str, dtype: torch.dtype) -> torch.dtype:
    """The dtype in which a parameter is kept when inference runs in ``dtype``."""
    return dtype if _REDUCED.match(name) else torch.float32


def copied_bytes(
    checkpoint: Checkpoint, architecture: VggtArchitecture, dtype: torch.dtype, device: torch.device
) -> int:
    """Memory that :func:`load_model` takes on ``device``: of the parameters that cannot stay in the file."""
    with torch.device("meta"):
        wanted = Vggt(architecture).state_dict()
    mapping = mapping_of(checkpoint.path) if device.type == "cpu" else FileMapping(())
    total = 0
    for name, parameter in wanted.items():
        kept = inference_dtype(name, dtype)
        # The depth head is laid out anew.
        if not name.startswith(_DEPTH) and name in checkpoint.shapes:
            value = checkpoint.read(name)
            if value.dtype == kept and mapping.holds(value):
                continue
        total += math.prod(parameter.shape) * kept.itemsize
    return total


def load_model(
    checkpoint: Checkpoint,
    dtype: torch.dtype,
    device: torch.device,
    *,
    with_points: bool = False,
    dense_levels: tuple[int, ...] | None = None,
) -> Vggt:
    """Build the network that a checkpoint describes and fill it.

    On a CPU, parameters that are used as they are in the checkpoint stay in the file (see :mod:`.mapped`): it must not
    be overwritten while the network is in use.

    Args:
        checkpoint: from :func:`open_checkpoint`.
        dtype: of the transformer's matrix products.
        device: where the parameters go.
        with_points: build the point head as well.
        dense_levels: see :func:`architecture_of`.

    Raises:
        CheckpointError: names are missing, unexpected or misshapen. The tracking head's may be there or not; the point
            head's may be absent unless ``with_points``.
    """
    architecture = architecture_of(checkpoint.shapes, dense_levels)
    with torch.device("meta"):
        model = Vggt(architecture, with_points=with_points)
        complete = model if with_points else Vggt(architecture, with_points=True)
    wanted = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    allowed = {name: tuple(value.shape) for name, value in complete.state_dict().items()}
    given = {name: shape for name, shape in checkpoint.shapes.items() if not name.startswith(_TRACKING)}
    missing = sorted(wanted.keys() - given.keys())
    unexpected = sorted(given.keys() - allowed.keys())
    misshapen = sorted(name for name in given.keys() & allowed.keys() if given[name] != allowed[name])
    if missing or unexpected or misshapen:
        raise CheckpointError(checkpoint.path, missing, unexpected, misshapen)
    state: dict[str, Tensor] = {}
    mapping = mapping_of(checkpoint.path)
    for name in wanted:
        value = checkpoint.read(name)
        if not value.dtype.is_floating_point:
            raise InputError(
                f"cannot read checkpoint {checkpoint.path.name}: {name} is {value.dtype}, not floating-point"
            )
        state[name] = value.detach().to(device=device, dtype=inference_dtype(name, dtype))
        if not mapping.holds(state[name]):
            mapping.give_back([value])  # it has been copied
    model.load_state_dict(state, strict=True, assign=True)
    model.set_row_chunk(CPU_ROW_CHUNK if device.type == "cpu" else ACCELERATOR_ROW_CHUNK)
    model.depth_head.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    mapping.give_back(state.values())  # what was laid out anew
    give_back_after_use(model, mapping)
    return model.eval().requires_grad_(False)


def _open_safetensors(path: Path) -> Checkpoint:
    handle: Any = importlib.import_module("safetensors").safe_open(str(path), framework="pt", device="cpu")
    shapes = {name: tuple(handle.get_slice(name).get_shape()) for name in handle.keys()}  # noqa: SIM118, no mapping
    return Checkpoint(path, shapes, handle.get_tensor)


def _open_pickle(path: Path) -> Checkpoint:
    # Mapped into memory, so that a parameter is read when it is converted and its pages can be dropped again.
    loaded = torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    for wrapper in _WRAPPERS:
        if isinstance(loaded, Mapping) and isinstance(loaded.get(wrapper), Mapping):
            loaded = loaded[wrapper]
    if not isinstance(loaded, Mapping) or not all(isinstance(value, Tensor) for value in loaded.values()):
        raise InputError(f"cannot read checkpoint {path.name}: it holds no parameters by name")
    state: dict[str, Tensor] = {str(name): value for name, value in loaded.items()}
    return Checkpoint(path, {name: tuple(value.shape) for name, value in state.items()}, state.__getitem__)


def _listed(names: tuple[str, ...]) -> str:
    shown = ", ".join(names[:_LISTED_NAMES])
    return shown if len(names) <= _LISTED_NAMES else f"{shown} and {len(names) - _LISTED_NAMES} more"


def _first_line(error: Exception) -> str:
    line = (str(error).strip().splitlines() or [""])[0]
    return f"{type(error).__name__}: {line}"[:_LONGEST_REASON]
