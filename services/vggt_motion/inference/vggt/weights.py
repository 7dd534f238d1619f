"""Where a checkpoint comes from: a local file or a name on the Hugging Face hub. No torch."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import re
from pathlib import Path
from typing import Any

from vggt_motion.errors import InputError, MissingDependencyError

_log = logging.getLogger(__name__)
_HUB_NAME = re.compile(r"^[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*$")
_SUFFIXES = (".safetensors", ".pt", ".pth")
_HUB_FILES = ("model.safetensors", "model.pt")
_LICENCES = {
    "facebook/vggt-1b": "CC BY-NC 4.0: not for commercial use",
    "facebook/vggt-1b-commercial": "VGGT licence: commercial use allowed, military use not; access on request",
}
WHERE_TO_GET = (
    "weights: https://huggingface.co/facebook/VGGT-1B (CC BY-NC 4.0, not for commercial use) or "
    "https://huggingface.co/facebook/VGGT-1B-Commercial (VGGT licence, access on request), or any .pt or .safetensors "
    "of that architecture; name it in inference.vggt.model"
)


def find_weights(model: str) -> Path | None:
    """The checkpoint file if it is on this machine, without asking the network.

    Raises:
        InputError: ``model`` names a file that does not exist, or is neither a file nor a hub name.
    """
    if (file := _local_file(model)) is not None:
        return file
    if importlib.util.find_spec("huggingface_hub") is None:
        return None
    hub = importlib.import_module("huggingface_hub")
    for name in _HUB_FILES:
        cached = hub.try_to_load_from_cache(model, name)
        if isinstance(cached, str):
            return Path(cached)
    return None


def fetch_weights(model: str, *, allow_download: bool) -> Path:
    """The checkpoint file, downloaded to the hub's cache if need be.

    Raises:
        InputError: there is no such file, or it cannot be downloaded; the message says where weights are and under
            which licence.
        MissingDependencyError: a hub name was given and ``huggingface-hub`` is not installed.
    """
    if (file := find_weights(model)) is not None:
        return file
    if importlib.util.find_spec("huggingface_hub") is None:
        raise MissingDependencyError(
            f"VGGT weights '{model}' are a Hugging Face name: pip install 'vggt-motion[hub]', or name a file; "
            f"{WHERE_TO_GET}"
        )
    if not allow_download:
        raise InputError(
            f"VGGT weights '{model}' are not in the Hugging Face cache and inference.vggt.allow_download is off"
        )
    _log.warning(
        "downloading weights %s (about 5 GB), licence: %s",
        model,
        _LICENCES.get(model.lower(), "see its page on the hub"),
    )
    return _download(importlib.import_module("huggingface_hub"), model)


def _local_file(model: str) -> Path | None:
    path = Path(model).expanduser()
    if path.is_file():
        if path.suffix not in _SUFFIXES:
            raise InputError(f"VGGT weights {path} must end in {', '.join(_SUFFIXES)}")
        return path
    if path.suffix in _SUFFIXES or not _HUB_NAME.match(model):
        raise InputError(f"no VGGT weights at '{model}'; {WHERE_TO_GET}")
    return None


def _download(hub: Any, model: str) -> Path:
    errors = importlib.import_module("huggingface_hub.errors")
    reason = "it holds neither " + " nor ".join(_HUB_FILES)
    for name in _HUB_FILES:
        try:
            return Path(hub.hf_hub_download(model, name))
        except errors.LocalEntryNotFoundError as error:  # what the client raises when there is no network
            reason = _first_line(error)
            break
        except errors.EntryNotFoundError:
            continue
        # The client's failures share no root: HTTP, offline, gated, disk. All mean the same here.
        except Exception as error:
            reason = _first_line(error)
            break
    raise InputError(f"cannot download VGGT weights '{model}': {reason}; {WHERE_TO_GET}")


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
