"""What distinguishes one VGGT network from another: widths, depths, the levels that dense heads read. No torch."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from vggt_motion.errors import InputError

_HEAD_WIDTH = 64  # channels per attention head in the transformer and in its patch embedding
_DENSE_LEVELS = {4: (0, 1, 2, 3), 24: (4, 11, 17, 23)}  # depth -> levels, of the published configurations


@dataclass(frozen=True)
class VggtArchitecture:
    """Sizes of a VGGT network (Wang et al., CVPR 2025)."""

    width: int  # channels C of the alternating-attention transformer; heads see 2 C
    depth: int  # levels, each one frame block and one global block
    heads: int
    backbone_depth: int  # of the DINOv2 patch embedding, same width and heads
    dense_levels: tuple[int, ...]  # four levels, from fine to coarse
    dense_features: int
    dense_channels: tuple[int, ...]  # per dense level
    register_tokens: int = 4
    patch_px: int = 14
    embedding_grid: int = 37  # side of the learned positional embedding, in patches
    camera_depth: int = 4
    camera_heads: int = 16
    camera_refinements: int = 4

    @property
    def special_tokens(self) -> int:
        """Tokens of a frame before its patches: camera and registers."""
        return 1 + self.register_tokens


SMALL = VggtArchitecture(
    width=384,
    depth=4,
    heads=6,
    backbone_depth=12,
    dense_levels=(0, 1, 2, 3),
    dense_features=64,
    dense_channels=(48, 96, 192, 384),
)
VGGT_1B = VggtArchitecture(
    width=1024,
    depth=24,
    heads=16,
    backbone_depth=24,
    dense_levels=(4, 11, 17, 23),
    dense_features=256,
    dense_channels=(256, 512, 1024, 1024),
)


def architecture_of(
    shapes: Mapping[str, tuple[int, ...]], dense_levels: tuple[int, ...] | None = None
) -> VggtArchitecture:
    """Read the architecture off a checkpoint's parameter shapes, so that any VGGT checkpoint loads as it is.

    Args:
        shapes: parameter name -> shape.
        dense_levels: the four levels that the dense heads read. Shapes cannot tell: needed for depths other than
            4 and 24.

    Raises:
        InputError: the names are not those of a VGGT network.
    """
    try:
        width = shapes["aggregator.camera_token"][-1]
        depth = _block_count(shapes, "aggregator.frame_blocks")
        levels = dense_levels or _DENSE_LEVELS.get(depth)
        if levels is None:
            raise InputError(
                f"a VGGT checkpoint of {depth} levels needs inference.vggt.dense_levels: four level numbers"
            )
        if len(levels) != 4 or not all(0 <= level < depth for level in levels) or sorted(set(levels)) != list(levels):
            raise InputError(f"dense levels {levels} must be four rising numbers below the checkpoint's depth, {depth}")
        tokens = shapes["aggregator.patch_embed.pos_embed"][1] - 1
        grid = round(tokens**0.5)
        architecture = VggtArchitecture(
            width=width,
            depth=depth,
            heads=width // shapes["aggregator.frame_blocks.0.attn.q_norm.weight"][0],
            backbone_depth=_block_count(shapes, "aggregator.patch_embed.blocks"),
            dense_levels=tuple(levels),
            dense_features=shapes["depth_head.scratch.layer1_rn.weight"][0],
            dense_channels=tuple(shapes[f"depth_head.projects.{level}.weight"][0] for level in range(4)),
            register_tokens=shapes["aggregator.register_token"][2],
            patch_px=shapes["aggregator.patch_embed.patch_embed.proj.weight"][-1],
            embedding_grid=grid,
            camera_depth=_block_count(shapes, "camera_head.trunk"),
        )
    except (KeyError, IndexError, ZeroDivisionError) as error:
        raise InputError(f"not a VGGT checkpoint: parameter {error} is missing or misshapen") from error
    if width % _HEAD_WIDTH or grid * grid != tokens or not architecture.backbone_depth or not architecture.camera_depth:
        raise InputError(
            f"not a VGGT checkpoint: width {width}, {tokens} positions, {architecture.backbone_depth} backbone blocks"
        )
    return architecture


def _block_count(shapes: Mapping[str, tuple[int, ...]], prefix: str) -> int:
    pattern = re.compile(re.escape(prefix) + r"\.(\d+)\.")
    return 1 + max((int(match[1]) for name in shapes if (match := pattern.match(name))), default=-1)
