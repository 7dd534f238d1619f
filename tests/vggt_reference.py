"""VGGT written down a second time, as plainly as the description of the architecture allows, in float64.

For tests: no chunks, nothing in place, nothing left out or exchanged with something else, one function per sentence.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812

from vggt_motion.inference.vggt.architecture import VggtArchitecture

Tensor = torch.Tensor
PATCH = 14


class Parameters:
    """Weights by name below a prefix."""

    def __init__(self, weights: Mapping[str, np.ndarray], prefix: str = ""):  # type: ignore[type-arg]
        self.weights, self.prefix = weights, prefix

    def __truediv__(self, name: object) -> Parameters:
        return Parameters(self.weights, f"{self.prefix}{name}.")

    def __getitem__(self, name: str) -> Tensor:
        return torch.from_numpy(np.asarray(self.weights[self.prefix + name], dtype=np.float64))

    def get(self, name: str) -> Tensor | None:
        return self[name] if self.prefix + name in self.weights else None


def linear(p: Parameters, x: Tensor) -> Tensor:
    return x @ p["weight"].T + p["bias"]


def norm(p: Parameters | None, x: Tensor, eps: float) -> Tensor:
    mean = x.mean(-1, keepdim=True)
    normed = (x - mean) / torch.sqrt(((x - mean) ** 2).mean(-1, keepdim=True) + eps)
    return normed if p is None else normed * p["weight"] + p["bias"]


def gelu(x: Tensor) -> Tensor:
    return 0.5 * x * (1 + torch.erf(x / 2**0.5))


def mlp(p: Parameters, x: Tensor) -> Tensor:
    return linear(p / "fc2", gelu(linear(p / "fc1", x)))


def rotate(x: Tensor, positions: Tensor) -> Tensor:
    """(B, heads, N, c) turned by positions (N, 2)."""
    halves = []
    for axis, half in enumerate(x.chunk(2, dim=-1)):
        d = half.shape[-1]
        frequency = 100.0 ** (-2.0 * torch.arange(d // 2, dtype=torch.float64) / d)
        angle = positions[:, axis : axis + 1].double() * frequency
        a, b = half[..., : d // 2], half[..., d // 2 :]
        halves += [a * angle.cos() - b * angle.sin(), b * angle.cos() + a * angle.sin()]
    return torch.cat(halves, dim=-1)


def block(p: Parameters, x: Tensor, heads: int, eps: float, positions: Tensor | None = None) -> Tensor:
    b, n, c = x.shape
    qkv = linear(p / "attn" / "qkv", norm(p / "norm1", x, eps)).view(b, n, 3, heads, c // heads)
    q, k, v = qkv.permute(2, 0, 3, 1, 4)
    if p.get("attn.q_norm.weight") is not None:
        q, k = norm(p / "attn" / "q_norm", q, 1e-5), norm(p / "attn" / "k_norm", k, 1e-5)
    if positions is not None:
        q, k = rotate(q, positions), rotate(k, positions)
    attended = torch.softmax(q @ k.transpose(-1, -2) / (c // heads) ** 0.5, dim=-1) @ v
    x = x + p["ls1.gamma"] * linear(p / "attn" / "proj", attended.transpose(1, 2).reshape(b, n, c))
    return x + p["ls2.gamma"] * mlp(p / "mlp", norm(p / "norm2", x, eps))


def convolution(p: Parameters, x: Tensor, **options: int) -> Tensor:
    return F.conv2d(x, p["weight"], p.get("bias"), **options)


def patch_embedding(p: Parameters, architecture: VggtArchitecture, images: Tensor) -> Tensor:
    rows, columns = images.shape[-2] // PATCH, images.shape[-1] // PATCH
    mean, deviation = (torch.tensor(v).view(3, 1, 1).double() for v in ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]))
    patches = convolution(p / "patch_embed" / "proj", (images - mean) / deviation, stride=PATCH)
    tokens = patches.flatten(2).transpose(1, 2)
    positions, grid = p["pos_embed"], architecture.embedding_grid
    if images.shape[-2:] != (PATCH * grid, PATCH * grid):
        maps = positions[:, 1:].view(1, grid, grid, -1).permute(0, 3, 1, 2)
        # float32: the only precision in which the reference has this resize
        maps = F.interpolate(maps.float(), (rows, columns), mode="bicubic", antialias=True).double()
        positions = torch.cat([positions[:, :1], maps.flatten(2).transpose(1, 2)], dim=1)
    x = torch.cat([p["cls_token"].expand(len(images), -1, -1), tokens], dim=1) + positions
    x = torch.cat([x[:, :1], p["register_tokens"].expand(len(images), -1, -1), x[:, 1:]], dim=1)
    for index in range(architecture.backbone_depth):
        x = block(p / "blocks" / index, x, architecture.heads, 1e-6)
    return norm(p / "norm", x, 1e-6)[:, 1 + architecture.register_tokens :]


def aggregate(p: Parameters, architecture: VggtArchitecture, images: Tensor) -> list[Tensor]:
    """The levels' outputs (S, T, 2C) for images (S, 3, H, W)."""
    frames = len(images)
    rows, columns = images.shape[-2] // PATCH, images.shape[-1] // PATCH
    special = torch.cat([p["camera_token"], p["register_token"]], dim=2)[0]
    special = torch.cat([special[:1], special[1:].expand(frames - 1, -1, -1)])
    x = torch.cat([special, patch_embedding(p / "patch_embed", architecture, images)], dim=1)
    positions = [(0, 0)] * architecture.special_tokens
    positions += [(row + 1, column + 1) for row in range(rows) for column in range(columns)]
    of_frame = torch.tensor(positions)
    levels = []
    for index in range(architecture.depth):
        within = block(p / "frame_blocks" / index, x, architecture.heads, 1e-5, of_frame)
        over = block(
            p / "global_blocks" / index,
            within.reshape(1, -1, architecture.width),
            architecture.heads,
            1e-5,
            of_frame.repeat(frames, 1),
        )
        x = over.view_as(within)
        levels.append(torch.cat([within, x], dim=-1))
    return levels


def cameras(p: Parameters, architecture: VggtArchitecture, tokens: Tensor) -> Tensor:
    """Pose encodings (S, 9) from the camera tokens (S, 2C) of the last level."""
    x0 = norm(p / "token_norm", tokens[None], 1e-5)
    encoding = torch.zeros(1, len(tokens), 9, dtype=torch.float64)
    for turn in range(architecture.camera_refinements):
        previous = p["empty_pose_tokens"].expand(1, len(tokens), -1) if turn == 0 else encoding
        embedded = linear(p / "embed_pose", previous)
        modulation = linear(p / "poseLN_modulation" / 1, embedded * torch.sigmoid(embedded))
        shift, scale, gate = modulation.chunk(3, dim=-1)
        x = gate * (norm(None, x0, 1e-6) * (1 + scale) + shift) + x0
        for index in range(architecture.camera_depth):
            x = block(p / "trunk" / index, x, architecture.camera_heads, 1e-5)
        encoding = encoding + mlp(p / "pose_branch", norm(p / "trunk_norm", x, 1e-5))
    return torch.cat([encoding[0, :, :7], encoding[0, :, 7:].clamp(min=0)], dim=-1)


def encode_positions(maps: Tensor, width: int, height: int) -> Tensor:
    channels, h, w = maps.shape[1:]
    aspect = width / height
    a, b = aspect / (aspect**2 + 1) ** 0.5, 1 / (aspect**2 + 1) ** 0.5
    u = torch.linspace(-a * (w - 1) / w, a * (w - 1) / w, w, dtype=torch.float64)
    v = torch.linspace(-b * (h - 1) / h, b * (h - 1) / h, h, dtype=torch.float64)
    frequency = 100.0 ** (-torch.arange(channels // 4, dtype=torch.float64) / (channels / 4))
    parts = []
    for coordinate, shape in ((u, (1, 1, 1, w)), (v, (1, 1, h, 1))):
        for turn in (torch.sin, torch.cos):
            parts += [turn(coordinate * f).view(shape).expand(1, 1, h, w) for f in frequency]
    return maps + 0.1 * torch.cat(parts, dim=1)


def residual_unit(p: Parameters, x: Tensor) -> Tensor:
    rectified = x.clamp(min=0)
    hidden = convolution(p / "conv1", rectified, padding=1).clamp(min=0)
    return convolution(p / "conv2", hidden, padding=1) + rectified


def resized(x: Tensor, size: tuple[int, int]) -> Tensor:
    return F.interpolate(x, size, mode="bilinear", align_corners=True)


def dense(p: Parameters, architecture: VggtArchitecture, levels: list[Tensor], width: int, height: int) -> Tensor:
    """Raw outputs (S, channels, H, W)."""
    rows, columns = height // PATCH, width // PATCH
    sides = []
    for index, level in enumerate(architecture.dense_levels):
        tokens = norm(p / "norm", levels[level][:, architecture.special_tokens :], 1e-5)
        maps = tokens.transpose(1, 2).reshape(len(tokens), -1, rows, columns)
        maps = encode_positions(convolution(p / "projects" / index, maps), width, height)
        resize = p / "resize_layers" / index
        if index < 2:
            maps = F.conv_transpose2d(maps, resize["weight"], resize["bias"], stride=4 if index == 0 else 2)
        elif index == 3:
            maps = convolution(resize, maps, stride=2, padding=1)
        sides.append(convolution(p / "scratch" / f"layer{index + 1}_rn", maps, padding=1))
    x = torch.empty(0)
    for index in (3, 2, 1, 0):
        unit = p / "scratch" / f"refinenet{index + 1}"
        x = sides[3] if index == 3 else x + residual_unit(unit / "resConfUnit1", sides[index])
        x = residual_unit(unit / "resConfUnit2", x)
        size = sides[index - 1].shape[-2:] if index else (2 * x.shape[-2], 2 * x.shape[-1])
        x = convolution(unit / "out_conv", resized(x, (size[0], size[1])))
    x = resized(convolution(p / "scratch" / "output_conv1", x, padding=1), (height, width))
    x = convolution(p / "scratch" / "output_conv2" / 0, encode_positions(x, width, height), padding=1)
    return convolution(p / "scratch" / "output_conv2" / 2, x.clamp(min=0))


def predict(
    weights: Mapping[str, np.ndarray],  # type: ignore[type-arg]
    architecture: VggtArchitecture,
    images: Tensor,
) -> dict[str, Tensor]:
    """All outputs, named as in the reference file, for one submap (S, 3, H, W) in [0, 1]."""
    height, width = images.shape[-2:]
    p = Parameters(weights)
    levels = aggregate(p / "aggregator", architecture, images.double())
    depth = dense(p / "depth_head", architecture, levels, width, height)
    points = dense(p / "point_head", architecture, levels, width, height)
    xyz = points[:, :3].permute(0, 2, 3, 1)
    return {
        "pose_enc": cameras(p / "camera_head", architecture, levels[-1][:, 0]),
        "depth": depth[:, 0].exp(),
        "depth_conf": 1 + depth[:, 1].exp(),
        "world_points": xyz.sign() * (xyz.abs().exp() - 1),
        "world_points_conf": 1 + points[:, 3].exp(),
    }
