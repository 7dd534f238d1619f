from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vggt_motion import direct
from vggt_motion.direct import BLOCK_BYTES, aligned_up, block_memory, open_direct, read_direct, write_blocks


def write(path: Path, content: bytes) -> int:
    """A file of this content, filled up to a whole block; returns its open descriptor."""
    descriptor = open_direct(path, os.O_RDWR | os.O_CREAT)
    with block_memory(len(content)) as memory:
        memory[:] = content.ljust(len(memory), b"\0")
        write_blocks(descriptor, memory, 0)
    return descriptor


@given(content=st.binary(min_size=1, max_size=20_000), offset=st.integers(0, 25_000), size=st.integers(0, 25_000))
@settings(max_examples=60, deadline=None)
def test_any_part_reads_as_it_was_written(
    tmp_path_factory: pytest.TempPathFactory, content: bytes, offset: int, size: int
) -> None:
    descriptor = write(tmp_path_factory.mktemp("direct") / "file", content)
    padded = content.ljust(aligned_up(len(content)), b"\0")
    assert read_direct(descriptor, offset, size) == padded[offset : offset + size]
    os.close(descriptor)


def test_a_file_that_ends_within_a_block_reads_to_its_end(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"x" * BLOCK_BYTES + b"abc")
    descriptor = open_direct(tmp_path / "file", os.O_RDONLY)
    assert read_direct(descriptor, BLOCK_BYTES - 1, 100) == b"xabc"
    assert read_direct(descriptor, BLOCK_BYTES + 3, 100) == b""
    os.close(descriptor)


@pytest.fixture(params=["open", "read and write"])
def without_direct(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A file system that does not open files past the cache, or opens them so, but does not read and write them."""
    real = os.open, os.pwrite, os.preadv
    direct_files: set[int] = set()

    def open_(path: Path, flags: int, mode: int = 0o777) -> int:
        if flags & direct._O_DIRECT and request.param == "open":
            raise OSError(errno.EINVAL, "injected")
        descriptor = real[0](path, flags, mode)
        if flags & direct._O_DIRECT:
            direct_files.add(descriptor)
        return descriptor

    def refuse(descriptor: int) -> None:
        if fcntl.fcntl(descriptor, fcntl.F_GETFL) & direct._O_DIRECT:
            raise OSError(errno.EINVAL, "injected")

    def pwrite(descriptor: int, data: memoryview, offset: int) -> int:
        refuse(descriptor)
        return real[1](descriptor, data, offset)

    def preadv(descriptor: int, buffers: list[memoryview], offset: int) -> int:
        refuse(descriptor)
        return real[2](descriptor, buffers, offset)

    monkeypatch.setattr(direct.os, "open", open_)
    monkeypatch.setattr(direct.os, "pwrite", pwrite)
    monkeypatch.setattr(direct.os, "preadv", preadv)
    yield
    assert direct_files or request.param == "open"


@pytest.mark.usefixtures("without_direct")
def test_a_file_system_without_it_is_used_by_way_of_the_cache(tmp_path: Path) -> None:
    descriptor = write(tmp_path / "file", b"content" * 1000)
    assert read_direct(descriptor, 7, 7) == b"content"
    os.close(descriptor)
    descriptor = open_direct(tmp_path / "file", os.O_RDONLY)
    assert read_direct(descriptor, 7, 7) == b"content"
    os.close(descriptor)


def test_what_a_descriptor_does_not_allow_is_an_error_and_no_endless_attempt(tmp_path: Path) -> None:
    descriptor = write(tmp_path / "file", b"content")
    os.close(descriptor)
    with pytest.raises(OSError, match="Bad file descriptor"):
        read_direct(descriptor, 0, 7)
    with block_memory(1) as memory, pytest.raises(OSError, match="Invalid argument"):
        write_blocks(os.open(tmp_path / "other", os.O_RDWR | os.O_CREAT), memory, -1)


def test_memory_is_used_again_and_little_is_kept() -> None:
    sizes = [3, 5 * 2**20, 2**20, 40 * 2**20]
    for size in sizes:
        with block_memory(size) as memory, block_memory(size) as other:
            assert len(memory) == aligned_up(size) == len(other)
            memory[0], other[0] = 1, 2
            assert (memory[0], other[0]) == (1, 2)
    kept = [len(memory) for memory in direct._kept._free]
    assert len(kept) <= direct._MAX_KEPT and max(kept) <= direct._MAX_KEPT_BYTES
