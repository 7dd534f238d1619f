"""The VGGT network against reference outputs, and its parts against closed forms."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'vggt-motion[torch]'")

import vggt_reference  # noqa: E402
from rule_weights import TINY, fixture_dir, rule_weights  # noqa: E402
from vggt_motion.errors import InputError  # noqa: E402
from vggt_motion.inference.vggt.architecture import SMALL, VGGT_1B, VggtArchitecture, architecture_of  # noqa: E402
from vggt_motion.inference.vggt.backbone import VisionTransformer  # noqa: E402
from vggt_motion.inference.vggt.dense_head import Fusion, add_position, axis_encoding  # noqa: E402
from vggt_motion.inference.vggt.layers import Block, Rotary  # noqa: E402
from vggt_motion.inference.vggt.model import Vggt  # noqa: E402

Weights = Mapping[str, npt.NDArray[np.float32]]
# sha256 over the sorted lines "name shape" of the published 1B model's state dict and of the small configuration's
NAME_DIGESTS = {
    "vggt_1b": "f5bcc85a31452cd37bb0be6721c3a8ffa498beb82974e8eb215a423eb4b01d4a",
    "small": "881006580512fa1d70dbf2a2ff1f65e08a2c4b10e839a6e4fced8acdaaf91bc6",
}


def shapes_of(model: torch.nn.Module) -> dict[str, tuple[int, ...]]:
    return {name: tuple(value.shape) for name, value in model.state_dict().items()}


def digest(shapes: Mapping[str, tuple[int, ...]]) -> str:
    lines = sorted(f"{name} {list(shape)}\n" for name, shape in shapes.items())
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def meta_model(architecture: VggtArchitecture, **heads: bool) -> Vggt:
    with torch.device("meta"):
        return Vggt(architecture, **heads)


@pytest.fixture(scope="module")
def small() -> Vggt:
    model = meta_model(SMALL, with_points=True)
    weights = rule_weights(shapes_of(model))
    model.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()}, assign=True)
    return model.eval()


@pytest.fixture(scope="module")
def tiny() -> tuple[Vggt, Weights]:
    model = meta_model(TINY, with_points=True)
    weights = rule_weights(shapes_of(model))
    model.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()}, assign=True)
    return model.eval(), weights


def random_images(frames: int, height: int, width: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(1, frames, 3, height, width, generator=torch.Generator().manual_seed(seed))


class TestAgainstReference:
    @pytest.mark.parametrize("frame_chunk", [1, 2, 8])
    def test_outputs(self, small: Vggt, frame_chunk: int) -> None:
        expected = np.load(fixture_dir("vggt") / "small_expected.npz")
        images = torch.from_numpy(expected["images_uint8"]).permute(0, 3, 1, 2)[None].float() / 255
        output = small(images, frame_chunk=frame_chunk)
        assert output.points is not None
        assert output.point_confidence is not None
        for name, value in {
            "pose_enc": output.pose_encoding,
            "depth": output.depth,
            "depth_conf": output.depth_confidence,
            "world_points": output.points,
            "world_points_conf": output.point_confidence,
        }.items():
            np.testing.assert_allclose(value[0].numpy(), expected[name], rtol=1e-4, atol=1e-4, err_msg=name)

    @pytest.mark.parametrize(
        ("name", "architecture", "with_tracking"), [("small", SMALL, False), ("vggt_1b", VGGT_1B, True)]
    )
    def test_names_and_shapes(self, name: str, architecture: VggtArchitecture, with_tracking: bool) -> None:
        expected = json.loads((fixture_dir("vggt") / f"{name}_state_dict.json").read_text())
        shapes = {key: tuple(value) for key, value in expected.items()}
        assert shapes_of(meta_model(architecture, with_points=True, with_tracking=with_tracking)) == shapes
        assert digest(shapes) == NAME_DIGESTS[name]


class TestOtherImagesAndSizes:
    """Against a second implementation, float64, which has to pass the reference's own outputs first."""

    NAMES = ("pose_enc", "depth", "depth_conf", "world_points", "world_points_conf")

    def test_the_second_implementation_equals_the_reference(self, small: Vggt) -> None:
        expected = np.load(fixture_dir("vggt") / "small_expected.npz")
        images = torch.from_numpy(expected["images_uint8"]).permute(0, 3, 1, 2).double() / 255
        weights = {name: value.numpy() for name, value in small.state_dict().items()}
        found = vggt_reference.predict(weights, SMALL, images)
        for name in self.NAMES:
            np.testing.assert_allclose(found[name].numpy(), expected[name], rtol=1e-4, atol=1e-4, err_msg=name)

    @pytest.mark.parametrize(
        ("frames", "height", "width"),
        [
            (1, 28, 42),
            (2, 42, 28),
            (3, 98, 42),  # upright
            (2, 70, 70),  # the side for which the positional embedding was learned: taken as it is
            (2, 84, 84),  # larger than that
            (1, 14, 126),  # one row of patches
            (4, 140, 14),
        ],
    )
    def test_equals_it_on_any_size(self, tiny: tuple[Vggt, Weights], frames: int, height: int, width: int) -> None:
        model, weights = tiny
        images = random_images(2 * frames, height, width, seed=height + width).view(2, frames, 3, height, width)
        output = model(images, frame_chunk=3)
        assert output.points is not None and output.point_confidence is not None
        found = (output.pose_encoding, output.depth, output.depth_confidence, output.points, output.point_confidence)
        shapes = [(9,), (height, width), (height, width), (height, width, 3), (height, width)]
        assert [value.shape for value in found] == [(2, frames, *shape) for shape in shapes]
        for index in range(2):
            expected = vggt_reference.predict(weights, TINY, images[index])
            for name, value in zip(self.NAMES, found, strict=True):
                np.testing.assert_allclose(value[index], expected[name], rtol=1e-4, atol=1e-4, err_msg=name)

    @pytest.mark.parametrize(("rows", "columns"), [(11, 37), (37, 11), (3, 40), (50, 60), (36, 37)])
    def test_positional_embedding_is_resized_as_pillow_does(self, rows: int, columns: int) -> None:
        image_module = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
        backbone = VisionTransformer(8, 1, 1)
        torch.nn.init.normal_(backbone.pos_embed, generator=torch.Generator().manual_seed(4))
        found = backbone.positions(rows, columns)[0].detach().numpy()
        learned = backbone.pos_embed[0].detach().numpy()
        np.testing.assert_array_equal(found[0], learned[0])
        for channel in range(8):
            image = image_module.fromarray(np.ascontiguousarray(learned[1:, channel].reshape(37, 37)))
            expected = np.asarray(image.resize((columns, rows), image_module.Resampling.BICUBIC))
            np.testing.assert_allclose(found[1:, channel].reshape(rows, columns), expected, atol=1e-4)

    def test_positional_embedding_of_the_learned_size_is_taken_as_it_is(self) -> None:
        backbone = VisionTransformer(8, 1, 1)
        assert backbone.positions(37, 37) is backbone.pos_embed

    @pytest.mark.parametrize(("height", "width"), [(100, 140), (98, 141)])
    def test_sides_that_patches_do_not_cover_are_refused(self, small: Vggt, height: int, width: int) -> None:
        with pytest.raises(ValueError, match=rf"{width}x{height}: both sides must be divisible by 14"):
            small(random_images(1, height, width))


class TestArchitecture:
    @pytest.mark.parametrize(
        ("name", "architecture", "with_tracking"), [("small", SMALL, False), ("vggt_1b", VGGT_1B, True)]
    )
    def test_name_digest(self, name: str, architecture: VggtArchitecture, with_tracking: bool) -> None:
        shapes = shapes_of(meta_model(architecture, with_points=True, with_tracking=with_tracking))
        assert digest(shapes) == NAME_DIGESTS[name]
        assert architecture_of(shapes) == architecture

    def test_heads_that_nobody_asked_for_are_not_built(self) -> None:
        names = shapes_of(meta_model(VGGT_1B))
        assert not any(name.startswith(("point_head.", "track_head.")) for name in names)

    def test_unknown_depth_needs_levels(self) -> None:
        shapes = shapes_of(meta_model(SMALL))
        shapes = {name: shape for name, shape in shapes.items() if "_blocks.3." not in name}
        with pytest.raises(InputError, match="dense_levels"):
            architecture_of(shapes)
        with pytest.raises(InputError, match="rising"):
            architecture_of(shapes, dense_levels=(0, 1, 2, 3))

    @pytest.mark.parametrize("gone", ["aggregator.camera_token", "aggregator.patch_embed.pos_embed"])
    def test_foreign_names_are_refused(self, gone: str) -> None:
        shapes = shapes_of(meta_model(SMALL))
        del shapes[gone]
        with pytest.raises(InputError, match=gone):
            architecture_of(shapes)


class TestRotary:
    def test_equals_complex_rotation(self) -> None:
        generator = torch.Generator().manual_seed(1)
        positions = torch.randint(0, 40, (7, 2), generator=generator)
        x = torch.randn(7, 3, 64, generator=generator)
        turned = Rotary(positions, 64)(x).double().numpy()
        for axis in range(2):
            half = x[..., 32 * axis : 32 * axis + 32].double().numpy()
            number = half[..., :16] + 1j * half[..., 16:]
            angle = positions[:, axis].numpy()[:, None] * 100.0 ** (-2 * np.arange(16) / 32)
            expected = number * np.exp(1j * angle)[:, None, :]
            np.testing.assert_allclose(turned[..., 32 * axis : 32 * axis + 16], expected.real, atol=1e-5)
            np.testing.assert_allclose(turned[..., 32 * axis + 16 : 32 * axis + 32], expected.imag, atol=1e-5)

    def test_products_depend_on_distance_only(self) -> None:
        generator = torch.Generator().manual_seed(2)
        q, k = torch.randn(2, 1, 1, 64, generator=generator)

        def product(at_q: tuple[int, int], at_k: tuple[int, int]) -> float:
            turned_q = Rotary(torch.tensor([at_q]), 64)(q)
            return float((turned_q * Rotary(torch.tensor([at_k]), 64)(k)).sum())

        assert product((3, 5), (10, 1)) == pytest.approx(product((13, 25), (20, 21)), abs=1e-4)
        assert product((3, 5), (10, 1)) != pytest.approx(product((3, 5), (11, 1)), abs=1e-2)

    def test_origin_is_left_alone(self) -> None:
        x = random_images(1, 5, 64)[0, 0]
        assert torch.equal(Rotary(torch.zeros(3, 2, dtype=torch.long), 64)(x), x)


class TestPositionEncoding:
    @pytest.mark.parametrize(
        ("rows", "columns", "height", "width"), [(7, 10, 98, 140), (98, 140, 98, 140), (3, 2, 60, 20)]
    )
    def test_equals_closed_form(self, rows: int, columns: int, height: int, width: int) -> None:
        channels = 12
        maps = add_position(torch.zeros(1, channels, rows, columns), width / height)[0].numpy()
        aspect = width / height
        a, b = aspect / math.hypot(aspect, 1), 1 / math.hypot(aspect, 1)
        for row in (0, rows // 2, rows - 1):
            v = b * (2 * row + 1 - rows) / rows
            for column in (0, columns - 1):
                u = a * (2 * column + 1 - columns) / columns
                frequencies = [100 ** (-k / 3) for k in range(3)]
                expected = [
                    0.1 * turn(coordinate * frequency)
                    for coordinate in (u, v)
                    for turn in (math.sin, math.cos)
                    for frequency in frequencies
                ]
                np.testing.assert_allclose(maps[:, row, column], expected, atol=1e-6)

    def test_single_pixel_is_the_middle(self) -> None:
        np.testing.assert_allclose(axis_encoding(1, 0.8, 4)[:, 0], [0, 0, 1, 1])


class TestParts:
    @torch.inference_mode()
    @pytest.mark.parametrize("row_chunk", [None, 1, 3, 4])
    def test_block_equals_its_definition(self, row_chunk: int | None) -> None:
        torch.manual_seed(3)
        block = Block(128, 2, norm_eps=1e-5, normalise_queries=True)
        for parameter in block.parameters():
            torch.nn.init.normal_(parameter, std=0.2)
        x = torch.randn(2, 5, 128)
        rotary = Rotary(torch.arange(10).view(5, 2), 64)

        normed = block.norm1(x)
        q, k, v = block.attn.qkv(normed).view(2, 5, 3, 2, 64).unbind(2)
        q, k = (
            torch.stack([rotary(norm(sequence)) for sequence in rows])
            for norm, rows in ((block.attn.q_norm, q), (block.attn.k_norm, k))
        )
        weights = torch.softmax(torch.einsum("bnhc,bmhc->bhnm", q, k) / 8.0, dim=-1)
        attended = torch.einsum("bhnm,bmhc->bnhc", weights, v).reshape(2, 5, 128)
        expected = x + block.ls1.gamma * block.attn.proj(attended)
        hidden = block.mlp.fc1(block.norm2(expected))
        hidden = 0.5 * hidden * (1 + torch.erf(hidden / math.sqrt(2)))  # the exact GELU
        expected = expected + block.ls2.gamma * block.mlp.fc2(hidden)

        block.row_chunk = row_chunk
        stream = x.clone()
        assert block(stream, rotary.repeated(2)) is stream
        torch.testing.assert_close(stream, expected, rtol=1e-4, atol=1e-4)

    def test_convolution_before_resize_equals_after(self) -> None:
        torch.manual_seed(5)
        fusion = Fusion(6, has_side=False)
        maps = torch.randn(1, 6, 4, 5)
        unit = fusion.resConfUnit2
        rectified = maps.clamp(min=0)
        summed = unit.conv2(unit.conv1(rectified).clamp(min=0)) + rectified
        resized = torch.nn.functional.interpolate(summed, size=(8, 10), mode="bilinear", align_corners=True)
        torch.testing.assert_close(fusion(maps, (8, 10)), fusion.out_conv(resized), rtol=1e-5, atol=1e-5)


class TestPass:
    def test_a_batch_equals_single_submaps(self, small: Vggt) -> None:
        first, second = random_images(2, 56, 84, seed=6), random_images(2, 56, 84, seed=7)
        both = small(torch.cat([first, second]), frame_chunk=3)
        for index, images in enumerate((first, second)):
            alone = small(images)
            torch.testing.assert_close(both.pose_encoding[index], alone.pose_encoding[0], rtol=1e-4, atol=1e-4)
            torch.testing.assert_close(both.depth[index], alone.depth[0], rtol=1e-4, atol=1e-4)

    def test_repeats_exactly(self, small: Vggt) -> None:
        images = random_images(2, 28, 42, seed=8)
        assert torch.equal(small(images).depth, small(images).depth)

    def test_input_is_not_written_to(self, small: Vggt) -> None:
        images = random_images(1, 28, 28, seed=9)
        before = images.clone()
        small(images)
        assert torch.equal(images, before)

    def test_times_every_part(self, small: Vggt) -> None:
        seconds = small(random_images(1, 28, 28)).seconds
        assert set(seconds) == {"patch_embedding", "frame_attention", "global_attention", "dense_head", "camera_head"}
        assert all(value > 0 for value in seconds.values())
