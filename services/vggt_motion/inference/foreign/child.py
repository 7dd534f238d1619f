"""The other side: runs a foreign network in the foreign environment. Standard library and numpy only, Python 3.9 on.

Started as ``python child.py RUNNER.py OPTIONS_JSON``. ``RUNNER.py`` offers ``load(options)``, which returns a function
from images (S, H, W, 3) uint8 to named arrays. A message is a length, a JSON head and raw arrays: nothing is ever
unpickled.
"""

from __future__ import annotations

import json
import os
import runpy
import struct
import sys
import threading
import time
from typing import IO, Any

import numpy as np

_LENGTH = struct.Struct("<I")
_MAX_HEAD_BYTES = 1 << 20
_MAX_ARRAY_BYTES = 8 << 30
_DTYPES = ("uint8", "bool", "int64", "float32", "float64")
_PARENT_CHECK_S = 1.0


class MessageError(Exception):
    """Bytes that are not a message."""


def write_message(stream: IO[bytes], fields: dict[str, str], arrays: dict[str, Any]) -> None:
    """Send named strings and named arrays."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    head = {
        "fields": fields,
        "arrays": [[name, str(array.dtype), list(array.shape)] for name, array in contiguous.items()],
    }
    text = json.dumps(head).encode()
    stream.write(_LENGTH.pack(len(text)) + text)
    for array in contiguous.values():
        stream.write(array.data if array.size else b"")
    stream.flush()


def read_message(stream: IO[bytes]) -> tuple[dict[str, str], dict[str, Any]] | None:
    """The next message, or None where the other side has closed.

    Raises:
        MessageError: the bytes are not a message, or larger than any sensible one.
    """
    prefix = stream.read(_LENGTH.size)
    if not prefix:
        return None
    (length,) = _LENGTH.unpack(prefix) if len(prefix) == _LENGTH.size else (_MAX_HEAD_BYTES + 1,)
    if length > _MAX_HEAD_BYTES:
        raise MessageError("not a message")
    try:
        head = json.loads(_exactly(stream, length))
        fields = {str(name): str(value) for name, value in head["fields"].items()}
        entries = [(str(name), str(dtype), [int(size) for size in shape]) for name, dtype, shape in head["arrays"]]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise MessageError(f"malformed head: {error}") from error
    arrays: dict[str, Any] = {}
    for name, dtype, shape in entries:
        if dtype not in _DTYPES or len(shape) > 8 or any(size < 0 for size in shape):
            raise MessageError(f"array {name} is {dtype} {shape}")
        count = 1
        for size in shape:
            count *= size
        if count * np.dtype(dtype).itemsize > _MAX_ARRAY_BYTES:
            raise MessageError(f"array {name} of shape {shape} is too large")
        arrays[name] = np.empty(shape, dtype=dtype)
        if count:
            _exactly_into(stream, memoryview(arrays[name]).cast("B"))
    return fields, arrays


def main() -> None:
    """Serve until standard input closes or the parent is gone."""
    # Whatever the foreign package prints must not end up among the messages.
    messages = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    sys.path.pop(0)  # this folder: its file names must not hide modules of the foreign environment
    _end_with_parent()
    options = json.loads(sys.argv[2])
    try:
        if options.get("device") == "auto":
            options["device"] = _best_device()
        predict = runpy.run_path(sys.argv[1])["load"](options)
    except ImportError as error:
        write_message(messages, {"missing": _one_line(error)}, {})
        return
    except Exception as error:
        write_message(messages, {"error": _one_line(error)}, {})
        return
    write_message(messages, {"ready": options.get("device", "")}, {})
    while True:
        message = read_message(sys.stdin.buffer)
        if message is None:
            return
        start = time.perf_counter()
        try:
            arrays = predict(message[1]["images"])
        except Exception as error:
            write_message(messages, {"error": _one_line(error)}, {})
            continue
        write_message(messages, {"seconds": repr(time.perf_counter() - start)}, arrays)


def _exactly(stream: IO[bytes], count: int) -> bytes:
    data = stream.read(count)
    if len(data) != count:
        raise MessageError("the message ends early")
    return data


def _exactly_into(stream: IO[bytes], view: memoryview) -> None:
    done = 0
    while done < len(view):
        some = stream.readinto(view[done:])  # type: ignore[attr-defined]
        if not some:
            raise MessageError("the message ends early")
        done += some


def _best_device() -> str:
    import torch

    if torch.cuda.is_available():
        return "cuda"
    return "mps" if torch.backends.mps.is_available() else "cpu"


def _end_with_parent() -> None:
    """Leave when the parent died, even in the middle of a computation."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_CHECK_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}"[:500] if text else type(error).__name__


if __name__ == "__main__":
    main()
