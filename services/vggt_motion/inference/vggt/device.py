"""Where and in which precision the network runs."""

from __future__ import annotations

import torch

from vggt_motion.errors import ConfigurationError

_DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


def resolve_device(name: str) -> torch.device:
    """The device of a configuration value; ``auto`` is CUDA, else Apple's Metal, else the CPU.

    Raises:
        ConfigurationError: the device is not there.
    """
    if name == "auto":
        if torch.cuda.is_available():
            return torch.device("cuda", torch.cuda.current_device())
        return torch.device("mps" if torch.backends.mps.is_available() else "cpu")
    device = torch.device(name)
    if device.type == "cuda":
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (device.index or 0) >= count:
            raise ConfigurationError(
                f"inference.vggt.device is {name}, but PyTorch {torch.__version__} sees {count} CUDA devices"
            )
        return torch.device("cuda", device.index if device.index is not None else torch.cuda.current_device())
    if device.type == "mps" and not torch.backends.mps.is_available():
        raise ConfigurationError(f"inference.vggt.device is mps, but PyTorch {torch.__version__} sees no Metal device")
    return device


def resolve_dtype(name: str, device: torch.device) -> torch.dtype:
    """The dtype of a configuration value.

    ``auto`` is bfloat16 on CUDA devices that compute in it, float16 on older ones, else float32: on a CPU results must
    not depend on which instructions it happens to have.
    """
    if name != "auto":
        return _DTYPES[name]
    if device.type == "cuda":
        major, _ = torch.cuda.get_device_capability(device)
        return torch.bfloat16 if major >= 8 else torch.float16
    return torch.float32


def accelerator_name(name: str) -> str | None:
    """What a person calls the accelerator that a configuration value chooses, or None where it is the CPU or absent."""
    try:
        device = resolve_device(name)
    except ConfigurationError:
        return None
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return "Apple Metal" if device.type == "mps" else None
