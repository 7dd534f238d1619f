"""The tracking head's parameters, so that a complete checkpoint can be loaded and written back by name.

No part of the pipeline follows points, so the head has no forward pass and is built only when it is asked for.
"""

from __future__ import annotations

import torch
from torch import nn

from vggt_motion.inference.vggt.architecture import VggtArchitecture
from vggt_motion.inference.vggt.dense_head import DenseHead
from vggt_motion.inference.vggt.layers import Mlp

_FEATURES = 128
_HIDDEN = 384
_VIRTUAL_TRACKS = 64
_BLOCKS = 6
_CORRELATION = 567  # 7 pyramid levels of 9 x 9 neighbours
_TRANSFORMER_IN = 388


class _SelfBlock(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(_HIDDEN)
        self.norm2 = nn.LayerNorm(_HIDDEN)
        self.attn = nn.MultiheadAttention(_HIDDEN, 8, batch_first=True)
        self.mlp = Mlp(_HIDDEN, 4 * _HIDDEN)


class _CrossBlock(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(_HIDDEN)
        self.norm_context = nn.LayerNorm(_HIDDEN)
        self.norm2 = nn.LayerNorm(_HIDDEN)
        self.cross_attn = nn.MultiheadAttention(_HIDDEN, 8, batch_first=True)
        self.mlp = Mlp(_HIDDEN, 4 * _HIDDEN)


class _UpdateTransformer(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.virual_tracks = nn.Parameter(torch.zeros(1, _VIRTUAL_TRACKS, 1, _HIDDEN))  # misspelt in every checkpoint
        self.input_norm = nn.LayerNorm(_TRANSFORMER_IN)
        self.input_transform = nn.Linear(_TRANSFORMER_IN, _HIDDEN)
        self.output_norm = nn.LayerNorm(_HIDDEN)
        self.flow_head = nn.Linear(_HIDDEN, _FEATURES + 2)
        self.time_blocks = nn.ModuleList(_SelfBlock() for _ in range(_BLOCKS))
        self.space_virtual_blocks = nn.ModuleList(_SelfBlock() for _ in range(_BLOCKS))
        self.space_point2virtual_blocks = nn.ModuleList(_CrossBlock() for _ in range(_BLOCKS))
        self.space_virtual2point_blocks = nn.ModuleList(_CrossBlock() for _ in range(_BLOCKS))


class _Tracker(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.query_ref_token = nn.Parameter(torch.zeros(1, 2, _TRANSFORMER_IN))
        self.corr_mlp = Mlp(_CORRELATION, _HIDDEN, _FEATURES)
        self.updateformer = _UpdateTransformer()
        self.fmap_norm = nn.LayerNorm(_FEATURES)
        self.ffeat_norm = nn.GroupNorm(1, _FEATURES)
        self.ffeat_updater = nn.Sequential(nn.Linear(_FEATURES, _FEATURES))
        self.vis_predictor = nn.Sequential(nn.Linear(_FEATURES, 1))
        self.conf_predictor = nn.Sequential(nn.Linear(_FEATURES, 1))


class TrackingHead(nn.Module):
    """Parameters of the published tracking head; it has no forward pass."""

    def __init__(self, architecture: VggtArchitecture):
        super().__init__()
        self.feature_extractor = DenseHead(architecture, outputs=None, features=_FEATURES)
        self.tracker = _Tracker()
