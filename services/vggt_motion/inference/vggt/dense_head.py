"""The dense heads: depth or points per pixel from four levels of tokens (after DPT, Ranftl et al., 2021)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from vggt_motion.inference.vggt.architecture import VggtArchitecture

_POSITION_WEIGHT = 0.1
_POSITION_BASE = 100.0


def axis_encoding(count: int, extent: float, channels: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Sine and cosine encoding (channels, count) float32 of ``count`` pixel centres spread over [-extent, extent]."""
    edge = extent * (count - 1) / count
    coordinates = np.linspace(-edge, edge, count, dtype=np.float64)
    frequencies = _POSITION_BASE ** (-np.arange(channels // 2, dtype=np.float64) / (channels // 2))
    angles = frequencies[:, None] * coordinates
    return np.concatenate([np.sin(angles), np.cos(angles)]).astype(np.float32)


def add_position(maps: Tensor, aspect: float) -> Tensor:
    """Add the position encoding to maps (F, C, h, w) of an image of ``aspect`` = width / height, in place.

    The first half of the channels depends on the column alone and the second on the row alone: no (C, h, w) table.
    """
    channels, rows, columns = maps.shape[1:]
    diagonal = float(np.hypot(aspect, 1.0))
    of_columns = torch.from_numpy(axis_encoding(columns, aspect / diagonal, channels // 2)).to(maps.device)
    of_rows = torch.from_numpy(axis_encoding(rows, 1.0 / diagonal, channels // 2)).to(maps.device)
    maps[:, : channels // 2] += _POSITION_WEIGHT * of_columns[:, None, :]
    maps[:, channels // 2 :] += _POSITION_WEIGHT * of_rows[:, :, None]
    return maps


class ResidualUnit(nn.Module):
    """Two convolutions around the **rectified** input: the published network was trained with that in-place slip."""

    def __init__(self, features: int):
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, maps: Tensor) -> Tensor:
        """(F, features, h, w), same shape."""
        rectified = F.relu(maps)
        result: Tensor = self.conv2(F.relu(self.conv1(rectified), inplace=True))
        return result.add_(rectified)


class Fusion(nn.Module):
    """Joins a coarse map with the next finer level and enlarges it."""

    def __init__(self, features: int, *, has_side: bool):
        super().__init__()
        if has_side:
            self.resConfUnit1 = ResidualUnit(features)
        self.resConfUnit2 = ResidualUnit(features)
        self.out_conv = nn.Conv2d(features, features, 1)

    def forward(self, maps: Tensor, size: tuple[int, int], side: Tensor | None = None) -> Tensor:
        """(F, features, h, w) and a side input of that shape to (F, features, *size)."""
        if side is not None:
            maps = maps + self.resConfUnit1(side)
        # A 1x1 convolution and a linear resize commute; before the resize it costs a quarter.
        small = self.out_conv(self.resConfUnit2(maps))
        return F.interpolate(small, size=size, mode="bilinear", align_corners=True)


class Scratch(nn.Module):
    """Fusion and output stages, under the name that checkpoints give them."""

    def __init__(self, channels: tuple[int, ...], features: int, outputs: int | None):
        super().__init__()
        self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn = (
            nn.Conv2d(count, features, 3, padding=1, bias=False) for count in channels
        )
        self.refinenet1, self.refinenet2, self.refinenet3, self.refinenet4 = (
            Fusion(features, has_side=index < 3) for index in range(4)
        )
        half = features if outputs is None else features // 2
        self.output_conv1 = nn.Conv2d(features, half, 3, padding=1)
        if outputs is not None:
            self.output_conv2 = nn.Sequential(
                nn.Conv2d(half, 32, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(32, outputs, 1)
            )


class DenseHead(nn.Module):
    """One value vector per pixel; the last channel is the confidence."""

    def __init__(self, architecture: VggtArchitecture, outputs: int | None, features: int | None = None):
        """Build a head with ``outputs`` channels; None leaves the output stage out, as the tracking head's does."""
        super().__init__()
        width, channels = 2 * architecture.width, architecture.dense_channels
        self.levels = architecture.dense_levels
        self.norm = nn.LayerNorm(width, eps=1e-5)
        self.projects = nn.ModuleList(nn.Conv2d(width, count, 1) for count in channels)
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(channels[0], channels[0], 4, stride=4),
                nn.ConvTranspose2d(channels[1], channels[1], 2, stride=2),
                nn.Identity(),
                nn.Conv2d(channels[3], channels[3], 3, stride=2, padding=1),
            ]
        )
        self.scratch = Scratch(channels, features or architecture.dense_features, outputs)

    def project(self, position: int, tokens: Tensor, grid: tuple[int, int], aspect: float) -> Tensor:
        """Map of one level, narrow enough to be kept until all four are there.

        Args:
            position: 0 to 3, the level's place among ``levels``.
            tokens: (F, rows * columns, 2C) float32, patches only.
            grid: rows and columns of patches.
            aspect: image width / height.

        Returns:
            (F, channels, rows, columns) float32.
        """
        convolution = self.projects[position]
        assert isinstance(convolution, nn.Conv2d)
        narrow = F.linear(self.norm(tokens), convolution.weight[:, :, 0, 0], convolution.bias)
        # The tokens' own layout, channels last, is also the one in which convolutions are fastest.
        maps = narrow.view(len(tokens), *grid, -1).permute(0, 3, 1, 2)
        return add_position(maps, aspect)

    def decode(self, maps: list[Tensor], size: tuple[int, int]) -> Tensor:
        """Raw outputs (F, outputs, H, W) float32 from the four maps of :meth:`project`, before activation."""
        scratch = self.scratch
        convolutions = (scratch.layer1_rn, scratch.layer2_rn, scratch.layer3_rn, scratch.layer4_rn)
        fine, medium, coarse, coarsest = (
            convolution(resize(level))
            for convolution, resize, level in zip(convolutions, self.resize_layers, maps, strict=True)
        )
        fused = scratch.refinenet4(coarsest, _size(coarse))
        fused = scratch.refinenet3(fused, _size(medium), coarse)
        fused = scratch.refinenet2(fused, _size(fine), medium)
        fused = scratch.refinenet1(fused, (2 * fine.shape[-2], 2 * fine.shape[-1]), fine)
        del fine, medium, coarse, coarsest
        half = scratch.output_conv1(fused)
        del fused
        full = F.interpolate(half, size=size, mode="bilinear", align_corners=True)
        del half
        raw: Tensor = scratch.output_conv2(add_position(full, size[1] / size[0]))
        return raw


def activate_depth(raw: Tensor) -> tuple[Tensor, Tensor]:
    """Depth (F, H, W) and confidence (F, H, W), above 1, from the depth head's raw output (F, 2, H, W)."""
    return torch.exp(raw[:, 0]), 1.0 + torch.exp(raw[:, 1])


def activate_points(raw: Tensor) -> tuple[Tensor, Tensor]:
    """Points (F, H, W, 3) in the world frame and confidence (F, H, W) from the point head's raw output (F, 4, H, W)."""
    xyz = raw[:, :3].permute(0, 2, 3, 1)
    return torch.sign(xyz) * torch.expm1(torch.abs(xyz)), 1.0 + torch.exp(raw[:, 3])


def _size(maps: Tensor) -> tuple[int, int]:
    return maps.shape[-2], maps.shape[-1]
