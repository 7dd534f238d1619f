"""Transformer parts that the patch embedding, the aggregator and the camera head share. Inference only.

The residual stream, norms and softmax-free element-wise work stay in float32; matrix products run in the dtype of their
weights. Blocks update the residual stream in place, because two copies of it are what a lean forward pass cannot spare.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812, the library's own habit
from torch import Tensor, nn

_ROTARY_BASE = 100.0
CPU_ROW_CHUNK = 1024  # as fast as any on a CPU, and the smallest such
ACCELERATOR_ROW_CHUNK = 16384
_QUERY_CHUNKS = 2  # attention is slower by a twentieth on queries that are fewer


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
        shape = (positions.shape[0], 1, 2, pairs)  # broadcasts over heads
        self._cosine = torch.cos(angle).to(torch.float32).to(positions.device).view(shape)
        self._sine = torch.sin(angle).to(torch.float32).to(positions.device).view(shape)

    def repeated(self, count: int) -> Rotary:
        """Tables for ``count`` frames of these tokens, one after the other."""
        return self._with(self._cosine.repeat(count, 1, 1, 1), self._sine.repeat(count, 1, 1, 1))

    def rows(self, part: slice) -> Rotary:
        """Tables for some of the tokens."""
        return self._with(self._cosine[part], self._sine[part])

    def __call__(self, x: Tensor) -> Tensor:
        """Turn (N, heads, width) float32."""
        tokens, heads, width = x.shape
        split = x.view(tokens, heads, 2, 2, width // 4)
        first, second = split[..., 0, :], split[..., 1, :]
        turned = torch.empty_like(split)
        torch.mul(first, self._cosine, out=turned[..., 0, :]).addcmul_(second, self._sine, value=-1.0)
        torch.mul(second, self._cosine, out=turned[..., 1, :]).addcmul_(first, self._sine)
        return turned.view(tokens, heads, width)

    @staticmethod
    def _with(cosine: Tensor, sine: Tensor) -> Rotary:
        result = object.__new__(Rotary)
        result._cosine, result._sine = cosine, sine
        return result


class Attention(nn.Module):
    """Multi-head self-attention, optionally with normalised and rotated queries and keys, in two steps."""

    def __init__(self, width: int, heads: int, *, normalise_queries: bool = False):
        super().__init__()
        self.heads = heads
        self.qkv = Linear(width, 3 * width)
        self.q_norm: nn.Module = nn.LayerNorm(width // heads, eps=1e-5) if normalise_queries else nn.Identity()
        self.k_norm: nn.Module = nn.LayerNorm(width // heads, eps=1e-5) if normalise_queries else nn.Identity()
        self.proj = Linear(width, width)

    def queries(self, rows: Tensor, rotary: Rotary | None) -> Tensor:
        """Queries (R, heads, width / heads) of rows (R, width), in the weights' dtype."""
        q = self._heads(rows, 0, 1)[:, 0]
        return q if rotary is None else rotary(self.q_norm(q.float())).to(q.dtype)

    def write_keys_values(self, rows: Tensor, rotary: Rotary | None, keys: Tensor, values: Tensor) -> None:
        """Write keys and values of rows (R, width) to two tensors (R, heads, width / heads)."""
        k, v = self._heads(rows, 1, 3).unbind(1)
        # Angles and norms in float32: in bfloat16 a rotation would be off by up to 1/256 rad.
        keys.copy_(k if rotary is None else rotary(self.k_norm(k.float())))
        values.copy_(v)

    def attend(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Result (B * M, width) of queries (B, M, heads, c) on keys and values (B, N, heads, c) of their sequences."""
        attended = F.scaled_dot_product_attention(q.transpose(1, 2), k.transpose(1, 2), v.transpose(1, 2))
        projected: Tensor = self.proj(attended.transpose(1, 2).flatten(2).flatten(0, 1))
        return projected

    def _heads(self, rows: Tensor, first: int, stop: int) -> Tensor:
        """(R, stop - first, heads, c): some of queries, keys and values, whose weights lie one after the other."""
        width = rows.shape[-1]
        part = slice(first * width, stop * width)
        weight = self.qkv.weight[part]
        return F.linear(rows.to(weight.dtype), weight, self.qkv.bias[part]).view(
            len(rows), stop - first, self.heads, -1
        )


class Mlp(nn.Module):
    """Two linear layers with exact GELU between them."""

    def __init__(self, width: int, hidden: int, out: int | None = None):
        super().__init__()
        self.fc1 = Linear(width, hidden)
        self.fc2 = Linear(hidden, out or width)

    def forward(self, x: Tensor) -> Tensor:
        """(..., width) to (..., out)."""
        result: Tensor = self.fc2(F.gelu(self.fc1(x)))
        return result


class LayerScale(nn.Module):
    """A learned factor per channel on a residual branch."""

    def __init__(self, width: int):
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def add_to(self, stream: Tensor, branch: Tensor) -> None:
        """``stream += gamma * branch`` in place."""
        stream.addcmul_(branch.to(stream.dtype), self.gamma)


class Block(nn.Module):
    """Pre-norm transformer block with LayerScale on both branches.

    It works on ``row_chunk`` tokens at a time: what lies between two matrix products then stays in the cache, and
    beside the stream only the keys and values of one sequence are ever there in full.
    """

    def __init__(self, width: int, heads: int, *, norm_eps: float, normalise_queries: bool = False):
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=norm_eps)
        self.attn = Attention(width, heads, normalise_queries=normalise_queries)
        self.ls1 = LayerScale(width)
        self.norm2 = nn.LayerNorm(width, eps=norm_eps)
        self.mlp = Mlp(width, 4 * width)
        self.ls2 = LayerScale(width)
        self.row_chunk: int | None = CPU_ROW_CHUNK

    def forward(self, stream: Tensor, rotary: Rotary | None = None) -> Tensor:
        """Update ``stream`` in place and return it.

        Args:
            stream: (B, N, width) float32, contiguous; attention within each of the B sequences.
            rotary: tables for all B * N tokens.
        """
        batch, tokens, width = stream.shape
        chunk = self.row_chunk or batch * tokens
        together = max(1, chunk // tokens)  # whole sequences, or a part of one
        for start in range(0, batch, together):
            some = stream[start : start + together]
            rows = slice(start * tokens, start * tokens + len(some) * tokens)
            self._attend(some, None if rotary is None else rotary.rows(rows), chunk)
        for part in torch.split(stream.view(batch * tokens, width), chunk):
            self.ls2.add_to(part, self.mlp(self.norm2(part)))
        return stream

    def _attend(self, sequences: Tensor, rotary: Rotary | None, chunk: int) -> None:
        """The attention branch on sequences (B, N, width) that are not longer than ``chunk`` together, or on one."""
        batch, tokens, width = sequences.shape
        rows = sequences.view(batch * tokens, width)
        shape = (batch, tokens, self.attn.heads, width // self.attn.heads)
        keys, values = (torch.empty(shape, dtype=self.attn.qkv.weight.dtype, device=rows.device) for _ in range(2))
        for part in _parts(len(rows), chunk):
            turn = None if rotary is None else rotary.rows(part)
            into = (keys.flatten(0, 1)[part], values.flatten(0, 1)[part])
            self.attn.write_keys_values(self.norm1(rows[part]), turn, *into)
        # Each row's query comes from that row alone, so rows can be replaced one part after the other.
        for part in _parts(len(rows), _QUERY_CHUNKS * chunk):
            turn = None if rotary is None else rotary.rows(part)
            q = self.attn.queries(self.norm1(rows[part]), turn)
            self.ls1.add_to(rows[part], self.attn.attend(q.view(batch, -1, *shape[2:]), keys, values))


def _parts(count: int, chunk: int) -> list[slice]:
    return [slice(start, start + chunk) for start in range(0, count, chunk)]
