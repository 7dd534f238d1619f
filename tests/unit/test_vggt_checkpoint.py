"""Strict loading of checkpoints, where they come from, and how much memory they and a pass take."""

from __future__ import annotations

import ctypes
import mmap
import sys
import types
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'vggt-motion[torch]'")

from rule_weights import TINY, rule_weights  # noqa: E402
from vggt_motion.errors import InputError, MissingDependencyError, PredictionError  # noqa: E402
from vggt_motion.inference.vggt import memory, weights  # noqa: E402
from vggt_motion.inference.vggt.architecture import SMALL, VGGT_1B  # noqa: E402
from vggt_motion.inference.vggt.checkpoint import (  # noqa: E402
    CheckpointError,
    copied_bytes,
    inference_dtype,
    load_model,
    open_checkpoint,
)
from vggt_motion.inference.vggt.mapped import FileMapping, mapping_of  # noqa: E402
from vggt_motion.inference.vggt.model import Vggt  # noqa: E402

State = dict[str, "torch.Tensor"]
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def state() -> State:
    with torch.device("meta"):
        shapes = {name: tuple(value.shape) for name, value in Vggt(TINY, with_points=True).state_dict().items()}
    return {name: torch.from_numpy(value) for name, value in rule_weights(shapes).items()}


def saved(state: State, path: Path) -> Path:
    if path.suffix == ".safetensors":
        pytest.importorskip("safetensors.torch", reason="safetensors is not installed").save_file(state, path)
    else:
        torch.save(state, path)
    return path


class TestLoading:
    @pytest.mark.parametrize("name", ["tiny.pt", "tiny.safetensors"])
    def test_values_arrive_unchanged(self, state: State, tmp_path: Path, name: str) -> None:
        model = load_model(open_checkpoint(saved(state, tmp_path / name)), torch.float32, CPU)
        loaded = model.state_dict()
        assert loaded.keys() == {key for key in state if not key.startswith("point_head.")}
        assert all(torch.equal(value, state[key]) for key, value in loaded.items())
        assert not any(parameter.requires_grad for parameter in model.parameters())

    def test_old_serialisation_and_wrapper(self, state: State, tmp_path: Path) -> None:
        path = tmp_path / "old.pt"
        torch.save({"model": state}, path, _use_new_zipfile_serialization=False)
        model = load_model(open_checkpoint(path), torch.float32, CPU, with_points=True)
        assert model.state_dict().keys() == state.keys()

    def test_only_matrix_products_are_reduced(self, state: State, tmp_path: Path) -> None:
        model = load_model(open_checkpoint(saved(state, tmp_path / "tiny.pt")), torch.bfloat16, CPU)
        dtypes = {name: value.dtype for name, value in model.state_dict().items()}
        assert dtypes["aggregator.global_blocks.3.attn.qkv.weight"] == torch.bfloat16
        assert dtypes["aggregator.patch_embed.patch_embed.proj.weight"] == torch.bfloat16
        for name in ("aggregator.frame_blocks.0.norm1.weight", "camera_head.trunk.0.mlp.fc1.weight"):
            assert dtypes[name] == torch.float32

    def test_missing_unexpected_and_misshapen_are_listed(self, state: State, tmp_path: Path) -> None:
        broken = dict(state)
        del broken["camera_head.token_norm.bias"]
        broken["aggregator.extra"] = torch.zeros(1)
        broken["depth_head.norm.weight"] = torch.zeros(3)
        checkpoint = open_checkpoint(saved(broken, tmp_path / "broken.pt"))
        with pytest.raises(CheckpointError) as caught:
            load_model(checkpoint, torch.float32, CPU)
        assert caught.value.missing == ("camera_head.token_norm.bias",)
        assert caught.value.unexpected == ("aggregator.extra",)
        assert caught.value.misshapen == ("depth_head.norm.weight",)
        message = str(caught.value)
        assert "\n" not in message
        assert all(
            name in message for name in ("camera_head.token_norm.bias", "aggregator.extra", "depth_head.norm.weight")
        )

    def test_tracking_names_are_excepted(self, state: State, tmp_path: Path) -> None:
        extended = {**state, "track_head.tracker.anything": torch.zeros(1)}
        load_model(open_checkpoint(saved(extended, tmp_path / "tracking.pt")), torch.float32, CPU)

    def test_point_head_is_needed_only_when_asked_for(self, state: State, tmp_path: Path) -> None:
        pruned = {name: value for name, value in state.items() if not name.startswith("point_head.")}
        checkpoint = open_checkpoint(saved(pruned, tmp_path / "pruned.pt"))
        load_model(checkpoint, torch.float32, CPU)
        with pytest.raises(CheckpointError, match=r"point_head\."):
            load_model(checkpoint, torch.float32, CPU, with_points=True)

    def test_whole_numbers_are_refused(self, state: State, tmp_path: Path) -> None:
        name = "camera_head.token_norm.bias"
        broken = {**state, name: torch.zeros(128, dtype=torch.int64)}
        with pytest.raises(InputError, match=name):
            load_model(open_checkpoint(saved(broken, tmp_path / "whole.pt")), torch.float32, CPU)


@pytest.mark.skipif(sys.platform != "linux", reason="weights stay in their file on Linux only")
class TestWeightsThatStayInTheFile:
    @pytest.mark.parametrize("name", ["tiny.pt", "tiny.safetensors"])
    def test_what_fits_is_not_copied_and_what_does_not_is(self, state: State, tmp_path: Path, name: str) -> None:
        path = saved(state, tmp_path / name)
        for dtype in (torch.float32, torch.bfloat16):
            model = load_model(open_checkpoint(path), dtype, CPU)
            mapping = mapping_of(path)
            for key, value in model.state_dict().items():
                if not key.startswith("depth_head."):
                    assert mapping.holds(value) == (value.dtype == torch.float32), key

    def test_memory_is_that_of_the_copies(self, state: State, tmp_path: Path) -> None:
        path = saved(state, tmp_path / "tiny.pt")
        head = sum(value.numel() for key, value in state.items() if key.startswith("depth_head."))
        halves = sum(
            value.numel() for key, value in state.items() if inference_dtype(key, torch.bfloat16) != value.dtype
        )
        mapped, old = open_checkpoint(path), tmp_path / "old.pt"
        torch.save(state, old, _use_new_zipfile_serialization=False)
        points = sum(value.numel() for key, value in state.items() if key.startswith("point_head."))
        whole = sum(value.numel() for value in state.values()) - points
        assert copied_bytes(mapped, TINY, torch.float32, CPU) == 4 * head
        assert copied_bytes(mapped, TINY, torch.bfloat16, CPU) == 4 * head + 2 * halves
        assert copied_bytes(open_checkpoint(old), TINY, torch.float32, CPU) == 4 * whole
        assert copied_bytes(mapped, TINY, torch.float32, torch.device("cuda")) == 4 * whole

    def test_a_pass_gives_back_what_it_read_and_reads_it_again(self, tmp_path: Path) -> None:
        with torch.device("meta"):
            shapes = {key: tuple(value.shape) for key, value in Vggt(SMALL).state_dict().items()}
        weights = {key: torch.from_numpy(value) for key, value in rule_weights(shapes).items()}
        images = torch.rand(1, 2, 3, 28, 42, generator=torch.Generator().manual_seed(0))
        held = Vggt(SMALL)
        held.load_state_dict(weights)
        expected = held.eval()(images)
        for name in ("small.pt", "small.safetensors"):
            path = saved(weights, tmp_path / name)
            model = load_model(open_checkpoint(path), torch.float32, CPU)
            size = path.stat().st_size
            for _ in range(2):
                output = model(images)
                assert torch.equal(output.depth, expected.depth)
                assert torch.equal(output.pose_encoding, expected.pose_encoding)
                assert _mapped_resident_bytes(path) < 0.1 * size, "left behind: norms, tokens, ends of pages"
            total = sum(float(value.double().sum()) for value in model.state_dict().values())
            assert total != 0.0
            assert _mapped_resident_bytes(path) > 0.5 * size, "the measure sees pages that are in use"

    def test_only_whole_private_pages_of_the_file_itself(self, tmp_path: Path) -> None:
        page = mmap.PAGESIZE
        file = tmp_path / "weights.pt"
        maps = tmp_path / "maps"
        maps.write_text(
            f"{0x10000:x}-{0x20000:x} rw-p 00000000 fe:00 1                    {file}\n"
            f"{0x30000:x}-{0x40000:x} r--s 00000000 fe:00 1                    {file}\n"
            f"{0x50000:x}-{0x60000:x} rw-p 00000000 fe:00 1                    {file} (deleted)\n"
            f"{0x70000:x}-{0x80000:x} rw-p 00000000 00:00 0 \n"
        )
        assert mapping_of(file, maps) == FileMapping(((0x10000, 0x20000),))
        assert mapping_of(file, tmp_path / "none") == FileMapping(())
        values = torch.zeros(4 * page, dtype=torch.uint8)
        begin = values.data_ptr()
        mapping = FileMapping(((begin, begin + len(values)),))
        ((first, last),) = mapping.pages_of([values[1 : 2 * page], values[2 * page : 4 * page - 1]])
        assert first % page == last % page == 0
        assert begin < first <= begin + page
        assert begin + 3 * page - 1 < last < begin + 4 * page
        assert mapping.pages_of([torch.zeros(4 * page), values[:1]]) == []


def _mapped_resident_bytes(path: Path) -> int:
    """Pages of a file that are in this process's memory."""
    total, is_ours = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        fields = line.split()
        if "-" in fields[0]:
            is_ours = line.endswith(str(path))
        elif is_ours and fields[0] == "Rss:":
            total += int(fields[1]) * 1024
    return total


class TestDamagedFiles:
    @pytest.mark.parametrize("name", ["bad.pt", "bad.safetensors"])
    @pytest.mark.parametrize("content", [b"", b"\x00" * 64, b"PK\x03\x04 not a zip", b"\xff" * 9 + b"{}"])
    def test_one_line(self, tmp_path: Path, name: str, content: bytes) -> None:
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(InputError) as caught:
            open_checkpoint(path)
        assert "bad" in str(caught.value)
        assert "\n" not in str(caught.value)

    def test_truncated(self, state: State, tmp_path: Path) -> None:
        for name in ("cut.pt", "cut.safetensors"):
            path = saved(state, tmp_path / name)
            path.write_bytes(path.read_bytes()[:20_000])
            with pytest.raises(InputError, match="cut"):
                open_checkpoint(path)

    def test_no_code_is_run(self, tmp_path: Path) -> None:
        class Hostile:
            def __reduce__(self) -> tuple[object, tuple[str]]:
                return Path.touch, (tmp_path / "was_run",)  # type: ignore[return-value]

        torch.save({"x": Hostile()}, tmp_path / "hostile.pt")
        with pytest.raises(InputError, match="hostile"):
            open_checkpoint(tmp_path / "hostile.pt")
        assert not (tmp_path / "was_run").exists()

    def test_something_else_by_name(self, tmp_path: Path) -> None:
        torch.save({"x": 3}, tmp_path / "numbers.pt")
        with pytest.raises(InputError, match="no parameters"):
            open_checkpoint(tmp_path / "numbers.pt")


class TestWhereWeightsComeFrom:
    def test_local_file(self, tmp_path: Path) -> None:
        path = tmp_path / "mine.pt"
        path.touch()
        assert weights.fetch_weights(str(path), allow_download=False) == path

    @pytest.mark.parametrize("model", ["nowhere.pt", "/no/such/dir/x.safetensors", "not a name", "a/b/c", "../x"])
    def test_no_such_file_says_where_to_get_them(self, model: str) -> None:
        with pytest.raises(InputError, match=r"huggingface.co/facebook/VGGT-1B .CC BY-NC 4.0"):
            weights.find_weights(model)

    def test_other_suffix(self, tmp_path: Path) -> None:
        path = tmp_path / "weights.bin"
        path.touch()
        with pytest.raises(InputError, match="safetensors"):
            weights.find_weights(str(path))

    def test_hub_package_missing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(weights.importlib.util, "find_spec", lambda name: None)
        with pytest.raises(MissingDependencyError, match=r"vggt-motion\[hub\]"):
            weights.fetch_weights("facebook/VGGT-1B", allow_download=True)

    def test_hub(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        hub = FakeHub({"model.pt": str(tmp_path / "model.pt")}).installed(monkeypatch)
        with pytest.raises(InputError, match="allow_download"):
            weights.fetch_weights("owner/name", allow_download=False)
        assert hub.downloads == []
        assert weights.fetch_weights("owner/name", allow_download=True) == tmp_path / "model.pt"
        assert hub.downloads == ["model.safetensors", "model.pt"]
        assert weights.find_weights("owner/name") == tmp_path / "model.pt", "now it is in the cache"

    def test_hub_without_network(self, monkeypatch: pytest.MonkeyPatch) -> None:
        FakeHub({}, is_online=False).installed(monkeypatch)
        with pytest.raises(InputError, match=r"cannot download.*no network") as caught:
            weights.fetch_weights("owner/name", allow_download=True)
        assert "\n" not in str(caught.value)


class FakeHub:
    """The two calls of huggingface-hub that are used, with its exceptions."""

    class EntryNotFoundError(Exception):
        pass

    class LocalEntryNotFoundError(FileNotFoundError, EntryNotFoundError):
        pass

    def __init__(self, files: dict[str, str], *, is_online: bool = True):
        self.files, self.is_online, self.downloads, self.cache = files, is_online, [], {}  # type: ignore[var-annotated]

    def installed(self, monkeypatch: pytest.MonkeyPatch) -> FakeHub:
        hub, errors = types.ModuleType("huggingface_hub"), types.ModuleType("huggingface_hub.errors")
        hub.try_to_load_from_cache = lambda model, name: self.cache.get(name)  # type: ignore[attr-defined]
        hub.hf_hub_download = self.download  # type: ignore[attr-defined]
        errors.EntryNotFoundError = self.EntryNotFoundError  # type: ignore[attr-defined]
        errors.LocalEntryNotFoundError = self.LocalEntryNotFoundError  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
        monkeypatch.setitem(sys.modules, "huggingface_hub.errors", errors)
        monkeypatch.setattr(weights.importlib.util, "find_spec", lambda name: object())
        return self

    def download(self, model: str, name: str) -> str:
        self.downloads.append(name)
        if not self.is_online:
            raise self.LocalEntryNotFoundError("no network\nand many more lines")
        if name not in self.files:
            raise self.EntryNotFoundError(name)
        self.cache[name] = self.files[name]
        return self.files[name]


class TestMemory:
    def test_estimate_grows_with_everything(self) -> None:
        base = memory.pass_bytes(VGGT_1B, 17, (154, 518), torch.bfloat16, 1)
        assert memory.pass_bytes(VGGT_1B, 18, (154, 518), torch.bfloat16, 1) > base
        assert memory.pass_bytes(VGGT_1B, 17, (168, 518), torch.bfloat16, 1) > base
        assert memory.pass_bytes(VGGT_1B, 17, (154, 518), torch.float32, 1) > base
        assert memory.pass_bytes(VGGT_1B, 17, (154, 518), torch.bfloat16, 8) > base

    def test_plan_takes_the_largest_chunk_that_fits(self) -> None:
        sizes = {chunk: memory.pass_bytes(VGGT_1B, 17, (518, 518), torch.bfloat16, chunk) for chunk in range(1, 17)}
        plan = memory.plan_pass(VGGT_1B, 17, (518, 518), torch.bfloat16, sizes[10], is_cpu=False)
        assert plan.frame_chunk == max(chunk for chunk, required in sizes.items() if required <= sizes[10])
        assert plan.required_bytes <= plan.available_bytes

    def test_a_pass_that_does_not_fit_is_refused_with_numbers(self) -> None:
        with pytest.raises(PredictionError, match=r"41 frames at 518x518.*GiB.*max_keyframes"):
            memory.plan_pass(VGGT_1B, 41, (518, 518), torch.float32, 2**28)

    def test_container_limits_count(self, tmp_path: Path) -> None:
        proc, groups = tmp_path / "proc", tmp_path / "cgroup"
        (proc / "self").mkdir(parents=True)
        (proc / "meminfo").write_text("MemTotal: 100 kB\nMemAvailable:     80 kB\n")
        (proc / "self" / "cgroup").write_text("0::/outer/inner\n")
        inner = groups / "outer" / "inner"
        inner.mkdir(parents=True)
        assert memory.host_available_bytes(proc, groups) == 80 * 1024
        (inner / "memory.max").write_text("max\n")
        (inner.parent / "memory.max").write_text("50000\n")
        (inner.parent / "memory.current").write_text("30000\n")
        (inner.parent / "memory.stat").write_text("anon 20000\ninactive_file 10000\nactive_file 5\n")
        assert memory.host_available_bytes(proc, groups) == 30005

    def test_host_has_memory(self) -> None:
        assert 0 < memory.available_bytes(CPU) < 2**50

    def test_recognises_failures_of_allocation(self) -> None:
        with pytest.raises(RuntimeError) as caught:
            torch.empty(2**55, dtype=torch.uint8)
        assert memory.is_out_of_memory(caught.value)
        assert memory.is_out_of_memory(torch.OutOfMemoryError("CUDA out of memory"))
        assert not memory.is_out_of_memory(RuntimeError("shapes differ"))

    @pytest.mark.skipif(sys.platform != "linux", reason="reads the peak from /proc")
    def test_estimate_covers_what_a_pass_takes(self) -> None:
        torch.manual_seed(0)
        model = Vggt(SMALL).eval()
        size, frames = (154, 518), 8
        images = torch.rand(1, frames, 3, *size)
        model(images[:, :1, :, :28, :28])  # what libraries allocate once
        ctypes.CDLL(None).malloc_trim(0)  # memory that earlier tests freed would hide what this takes
        before = _resident_bytes("VmRSS")
        Path("/proc/self/clear_refs").write_text("5")  # forget the peak
        model(images, frame_chunk=2)
        taken = _resident_bytes("VmHWM") - before
        estimate = memory.pass_bytes(SMALL, frames, size, torch.float32, 2)
        assert taken <= 1.2 * estimate, f"{taken / 2**20:.0f} MiB taken, {estimate / 2**20:.0f} MiB estimated"
        assert taken >= 0.2 * estimate, f"{taken / 2**20:.0f} MiB taken, {estimate / 2**20:.0f} MiB estimated"


def _resident_bytes(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024
    raise AssertionError(field)


def test_dtype_rule_leaves_heads_alone() -> None:
    with torch.device("meta"):
        names = list(Vggt(SMALL).state_dict())
    reduced = [name for name in names if inference_dtype(name, torch.float16) == torch.float16]
    assert len(reduced) == 2 + 2 * 4 * (SMALL.backbone_depth + 2 * SMALL.depth)
    assert all(name.startswith("aggregator.") for name in reduced)
