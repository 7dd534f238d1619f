"""Generate the Python code of the wire contract (``services/vggt_motion/v1``) from the ``.proto`` files here.

Uses the protoc of grpcio-tools, pinned in the extra ``dev`` to the oldest one whose code runs on every protobuf runtime
that the project allows. ``--check`` writes nothing and exits with 1 if the committed code differs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

PROTO_ROOT = Path(__file__).resolve().parent
PACKAGE = Path("vggt_motion", "v1")
OUTPUT_ROOT = PROTO_ROOT.parent / "services"


def generate(output_root: Path) -> None:
    """Write ``vggt_motion/v1/*_pb2.py`` and ``.pyi`` under ``output_root``.

    Raises:
        RuntimeError: protoc refused a file; it has written why to standard error.
    """
    import grpc_tools
    from grpc_tools import protoc

    includes = Path(grpc_tools.__file__).parent / "_proto"
    files = sorted(str(path.relative_to(PROTO_ROOT)) for path in (PROTO_ROOT / PACKAGE).glob("*.proto"))
    arguments = [
        "protoc",
        f"-I{PROTO_ROOT}",
        f"-I{includes}",
        f"--python_out={output_root}",
        f"--pyi_out={output_root}",
    ]
    if protoc.main([*arguments, *files]) != 0:
        raise RuntimeError("protoc failed")


def generated_files(root: Path) -> dict[str, bytes]:
    """Name and content of every generated file under ``root``."""
    return {path.name: path.read_bytes() for path in sorted((root / PACKAGE).glob("*_pb2.py*"))}


def differences(committed_root: Path = OUTPUT_ROOT) -> list[str]:
    """Names of generated files that are missing, superfluous or differ from what protoc writes now."""
    with tempfile.TemporaryDirectory() as scratch:
        generate(Path(scratch))
        fresh = generated_files(Path(scratch))
    committed = generated_files(committed_root)
    return sorted(name for name in fresh.keys() | committed.keys() if fresh.get(name) != committed.get(name))


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="only compare")
    if parser.parse_args().check:
        stale = differences()
        if stale:
            sys.stderr.write(f"stale generated code: {', '.join(stale)}; run python proto/generate.py\n")
        return 1 if stale else 0
    for name in generated_files(OUTPUT_ROOT):
        (OUTPUT_ROOT / PACKAGE / name).unlink()
    generate(OUTPUT_ROOT)
    return 0


if __name__ == "__main__":
    sys.exit(main())
