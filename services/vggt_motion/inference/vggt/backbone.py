"""The patch embedding: a DINOv2 vision transformer (Oquab et al., 2023) with or without register tokens."""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from vggt_motion.inference.vggt.layers import Block

_NORM_EPS = 1e-6


class PatchProjection(nn.Module):
    """One linear map per image patch, stored as a convolution."""

    def __init__(self, width: int, patch_px: int):
        super().__init__()
        self.proj = nn.Conv2d(3, width, kernel_size=patch_px, stride=patch_px)

    def forward(self, images: Tensor) -> Tensor:
        """(F, 3, H, W) to (F, H/patch * W/patch, width) float32, row by row."""
        maps: Tensor = self.proj(images.to(self.proj.weight.dtype))
        return maps.flatten(2).transpose(1, 2).float()


class VisionTransformer(nn.Module):
    """DINOv2 with parameter names of its published checkpoints."""

    def __init__(
        self, width: int, depth: int, heads: int, *, patch_px: int = 14, grid: int = 37, register_tokens: int = 4
    ):
        super().__init__()
        self.patch_px = patch_px
        self.grid = grid
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + grid * grid, width))
        if register_tokens:
            self.register_tokens = nn.Parameter(torch.zeros(1, register_tokens, width))
        self.register_count = register_tokens
        # Training replaced hidden patches by this; it has no use here but its name is part of every checkpoint.
        self.mask_token = nn.Parameter(torch.zeros(1, width))
        self.patch_embed = PatchProjection(width, patch_px)
        self.blocks = nn.ModuleList(Block(width, heads, norm_eps=_NORM_EPS) for _ in range(depth))
        self.norm = nn.LayerNorm(width, eps=_NORM_EPS)

    def positions(self, rows: int, columns: int) -> Tensor:
        """Positional embedding (1, 1 + rows * columns, width) float32 for a grid of patches."""
        if (rows, columns) == (self.grid, self.grid):
            return self.pos_embed
        # On the CPU, because not every device has the antialiased bicubic kernel; it is tiny.
        learned = self.pos_embed.float().cpu()
        width = learned.shape[-1]
        maps = learned[:, 1:].reshape(1, self.grid, self.grid, width).permute(0, 3, 1, 2)
        resized = F.interpolate(maps, size=(rows, columns), mode="bicubic", antialias=True, align_corners=False)
        return torch.cat([learned[:, :1], resized.flatten(2).transpose(1, 2)], dim=1).to(self.pos_embed.device)

    def forward(self, images: Tensor) -> Tensor:
        """All normalised tokens.

        Args:
            images: (F, 3, H, W), normalised with the ImageNet mean and deviation, sides divisible by the patch.

        Returns:
            (F, 1 + registers + patches, width) float32: class token, registers, patches.
        """
        rows, columns = images.shape[-2] // self.patch_px, images.shape[-1] // self.patch_px
        positions = self.positions(rows, columns)
        patches: Tensor = self.patch_embed(images)
        patches += positions[:, 1:]
        leading = [self.cls_token + positions[:, :1]]
        if self.register_count:
            leading.append(self.register_tokens)
        stream = torch.cat([token.expand(len(images), -1, -1) for token in leading] + [patches], dim=1).float()
        for block in self.blocks:
            stream = block(stream)
        normed: Tensor = self.norm(stream)
        return normed

    def patch_tokens(self, images: Tensor) -> Tensor:
        """Like :meth:`forward`, the patches only: (F, patches, width) float32."""
        tokens: Tensor = self(images)
        return tokens[:, 1 + self.register_count :]
