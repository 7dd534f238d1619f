"""Alternating attention: each level attends within every frame, then over all frames of the submap."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from vggt_motion.inference.vggt.architecture import VggtArchitecture
from vggt_motion.inference.vggt.backbone import VisionTransformer
from vggt_motion.inference.vggt.layers import Block, Rotary
from vggt_motion.inference.vggt.stopwatch import Stopwatch

_NORM_EPS = 1e-5
_IMAGENET_MEAN = (0.485, 0.456, 0.406)
_IMAGENET_DEVIATION = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class Level:
    """Output of one level: the frame block's tokens and the global block's, each (B, S, T, C) float32.

    ``of_global`` is the live residual stream: use it before asking for the next level.
    """

    index: int
    of_frames: Tensor
    of_global: Tensor

    def tokens(self, frames: slice, tokens: slice) -> Tensor:
        """The concatenation (F, T', 2C) for a range of the B * S frames and of their tokens."""
        parts = [half.flatten(0, 1)[frames, tokens] for half in (self.of_frames, self.of_global)]
        return torch.cat(parts, dim=-1)


class Aggregator(nn.Module):
    """Patch embedding and alternating-attention transformer."""

    def __init__(self, architecture: VggtArchitecture):
        super().__init__()
        width, heads = architecture.width, architecture.heads
        self.architecture = architecture
        self.embedded_frames = 8  # at a time; blocks bound their memory themselves
        self.camera_token = nn.Parameter(torch.zeros(1, 2, 1, width))
        self.register_token = nn.Parameter(torch.zeros(1, 2, architecture.register_tokens, width))
        self.patch_embed = VisionTransformer(
            width, architecture.backbone_depth, heads, patch_px=architecture.patch_px, grid=architecture.embedding_grid
        )
        self.frame_blocks = nn.ModuleList(
            Block(width, heads, norm_eps=_NORM_EPS, normalise_queries=True) for _ in range(architecture.depth)
        )
        self.global_blocks = nn.ModuleList(
            Block(width, heads, norm_eps=_NORM_EPS, normalise_queries=True) for _ in range(architecture.depth)
        )

    def levels(self, images: Tensor, wanted: frozenset[int], *, stopwatch: Stopwatch) -> Iterator[Level]:
        """Run the network and hand out the wanted levels, in order.

        Args:
            images: (B, S, 3, H, W) RGB in [0, 1].
            wanted: level numbers; the others are not kept.
            stopwatch: takes the time of each part.
        """
        batch, frames = images.shape[:2]
        rows, columns = (side // self.architecture.patch_px for side in images.shape[-2:])
        with stopwatch("patch_embedding"):
            stream = self._embed(images)
        token_count = stream.shape[1]
        positions = self._positions(rows, columns, stream.device)
        rotary = Rotary(positions, stream.shape[-1] // self.architecture.heads).repeated(batch * frames)
        for index in range(self.architecture.depth):
            with stopwatch("frame_attention"):
                stream = self.frame_blocks[index](stream.view(batch * frames, token_count, -1), rotary)
            of_frames = stream.clone() if index in wanted else None
            with stopwatch("global_attention"):
                stream = self.global_blocks[index](stream.view(batch, frames * token_count, -1), rotary)
            if of_frames is not None:
                shape = (batch, frames, token_count, stream.shape[-1])
                yield Level(index, of_frames.view(shape), stream.view(shape))

    def _embed(self, images: Tensor) -> Tensor:
        """Camera token, registers and patch tokens of every frame: (B * S, T, C) float32."""
        batch, frames = images.shape[:2]
        flat = images.flatten(0, 1)
        mean = torch.tensor(_IMAGENET_MEAN, device=images.device).view(3, 1, 1)
        deviation = torch.tensor(_IMAGENET_DEVIATION, device=images.device).view(3, 1, 1)
        special = torch.cat([self.camera_token, self.register_token], dim=2).float()[0]  # (2, 1 + registers, C)
        # The first frame of a submap is the reference and has tokens of its own.
        which = torch.ones(frames, dtype=torch.long, device=images.device)
        which[0] = 0
        leading = special[which].repeat(batch, 1, 1)
        patch_count = (images.shape[-2] // self.architecture.patch_px) * (
            images.shape[-1] // self.architecture.patch_px
        )
        count = leading.shape[1]
        stream = torch.empty(batch * frames, count + patch_count, leading.shape[2], device=images.device)
        stream[:, :count] = leading
        for start in range(0, batch * frames, self.embedded_frames):
            part = slice(start, start + self.embedded_frames)
            stream[part, count:] = self.patch_embed.patch_tokens((flat[part].float() - mean) / deviation)
        return stream

    def _positions(self, rows: int, columns: int, device: torch.device) -> Tensor:
        """Row and column (T, 2) of each token of a frame; special tokens sit at (0, 0), patches count from 1."""
        row, column = torch.meshgrid(torch.arange(1, rows + 1), torch.arange(1, columns + 1), indexing="ij")
        patches = torch.stack([row.flatten(), column.flatten()], dim=1)
        special = torch.zeros(self.architecture.special_tokens, 2, dtype=patches.dtype)
        return torch.cat([special, patches]).to(device)
