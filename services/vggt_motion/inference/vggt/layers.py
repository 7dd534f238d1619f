"""Transformer parts that the patch embedding, the aggregator and the camera head share. Inference only.

The residual stream, norms and softmax-free element-wise work stay in float32; matrix products run in the dtype of their
weights. Blocks update the residual stream in place, because two copies of it are what a lean forward pass cannot spare.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F  # noqa: N812, the library's own habit
from torch import Tensor, nn

_ROTARY_BASE = 100.0


class Linear(nn.Linear):
    """A linear layer that computes in the dtype of its weights, whatever comes in."""

    def forward(self, x: Tensor) -> Tensor:
        """(..., in) of any dtype to (..., out) in the weights' dtype."""
        return F.linear(x.to(self.weight.dtype), self.weight, self.bias)


class Rotary:
    """Two-dimensional rotary position embedding (ARCHITECTURE: aggregator).

    The first half of a head's channels is turned by the row, the second by the column. Within a half of size d,
    channel j is paired with j + d/2 and turned by position * 100^(-2j/d).
    """

    def __init__(self, positions: Tensor, head_width: int):
        """Tables for tokens at ``positions`` (N, 2), row and column, in patches."""
        pairs = head_width // 4
        frequency = _ROTARY_BASE ** (-torch.arange(pairs, dtype=torch.float64) / pairs)
        angle = positions.to(device="cpu", dtype=torch.float64)[:, :, None] * frequency  # (N, 2, pairs)
        shape = (positions.shape[0], 1, 2, pairs)  # broadcasts over batch and heads
        self._cosine = torch.cos(angle).to(torch.float32).to(positions.device).view(shape)
        self._sine = torch.sin(angle).to(torch.float32).to(positions.device).view(shape)

    def repeated(self, count: int) -> Rotary:
        """Tables for ``count`` frames of these tokens, one after the other."""
        result = object.__new__(Rotary)
        result._cosine = self._cosine.repeat(count, 1, 1, 1)
        result._sine = self._sine.repeat(count, 1, 1, 1)
        return result

    def __call__(self, x: Tensor) -> Tensor:
        """Turn (B, N, heads, width) float32."""
        batch, tokens, heads, width = x.shape
        split = x.view(batch, tokens, heads, 2, 2, width // 4)
        first, second = split[..., 0, :], split[..., 1, :]
        turned = torch.empty_like(split)
        torch.mul(first, self._cosine, out=turned[..., 0, :]).addcmul_(second, self._sine, value=-1.0)
        torch.mul(second, self._cosine, out=turned[..., 1, :]).addcmul_(first, self._sine)
        return turned.view(batch, tokens, heads, width)


class Attention(nn.Module):
    """Multi-head self-attention, optionally with normalised and rotated queries and keys."""

    def __init__(self, width: int, heads: int, *, normalise_queries: bool = False):
        super().__init__()
        self.heads = heads
        self.qkv = Linear(width, 3 * width)
        self.q_norm: nn.Module = nn.LayerNorm(width // heads, eps=1e-5) if normalise_queries else nn.Identity()
        self.k_norm: nn.Module = nn.LayerNorm(width // heads, eps=1e-5) if normalise_queries else nn.Identity()
        self.proj = Linear(width, width)

    def forward(self, x: Tensor, rotary: Rotary | None = None) -> Tensor:
        """(B, N, width) to (B, N, width); every token sees all N."""
        batch, tokens, width = x.shape
        qkv: Tensor = self.qkv(x)
        q, k, v = qkv.view(batch, tokens, 3, self.heads, width // self.heads).unbind(2)
        if rotary is not None:
            # Angles and norms in float32: in bfloat16 a rotation would be off by up to 1/256 rad.
            q = rotary(self.q_norm(q.float())).to(v.dtype)
            k = rotary(self.k_norm(k.float())).to(v.dtype)
        attended = F.scaled_dot_product_attention(q.transpose(1, 2), k.transpose(1, 2), v.transpose(1, 2))
        del q, k, v, qkv
        projected: Tensor = self.proj(attended.transpose(1, 2).reshape(batch, tokens, width))
        return projected


class Mlp(nn.Module):
    """Two linear layers with exact GELU between them, applied to at most ``token_chunk`` tokens at a time."""

    def __init__(self, width: int, hidden: int, out: int | None = None, token_chunk: int | None = 2048):
        super().__init__()
        self.fc1 = Linear(width, hidden)
        self.fc2 = Linear(hidden, out or width)
        self.token_chunk = token_chunk

    def forward(self, x: Tensor) -> Tensor:
        """(..., width) to (..., out)."""
        tokens = math.prod(x.shape[:-1])
        if self.token_chunk is None or tokens <= self.token_chunk:
            small: Tensor = self.fc2(F.gelu(self.fc1(x)))
            return small
        flat = x.reshape(tokens, x.shape[-1])
        result = torch.empty(tokens, self.fc2.out_features, dtype=self.fc2.weight.dtype, device=x.device)
        for part, into in zip(torch.split(flat, self.token_chunk), torch.split(result, self.token_chunk), strict=True):
            into.copy_(self.fc2(F.gelu(self.fc1(part))))
        return result.view(*x.shape[:-1], -1)


class LayerScale(nn.Module):
    """A learned factor per channel on a residual branch."""

    def __init__(self, width: int):
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def add_to(self, stream: Tensor, branch: Tensor) -> None:
        """``stream += gamma * branch`` in place."""
        if branch.dtype == stream.dtype == self.gamma.dtype:
            stream.addcmul_(branch, self.gamma)
        else:
            stream.add_(branch * self.gamma)


class Block(nn.Module):
    """Pre-norm transformer block with LayerScale on both branches."""

    def __init__(self, width: int, heads: int, *, norm_eps: float, normalise_queries: bool = False):
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=norm_eps)
        self.attn = Attention(width, heads, normalise_queries=normalise_queries)
        self.ls1 = LayerScale(width)
        self.norm2 = nn.LayerNorm(width, eps=norm_eps)
        self.mlp = Mlp(width, 4 * width)
        self.ls2 = LayerScale(width)

    def forward(self, stream: Tensor, rotary: Rotary | None = None) -> Tensor:
        """Update ``stream`` (B, N, width) float32 in place and return it."""
        self.ls1.add_to(stream, self.attn(self.norm1(stream), rotary))
        self.ls2.add_to(stream, self.mlp(self.norm2(stream)))
        return stream
