"""The camera head: refines each frame's pose encoding four times from its camera token."""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from vggt_motion.inference.vggt.architecture import VggtArchitecture
from vggt_motion.inference.vggt.layers import Block, Linear, Mlp

POSE_ENCODING = 9  # translation 3, quaternion x y z w, field of view vertical and horizontal


class CameraHead(nn.Module):
    """Iterative regression of camera_from_world and the fields of view."""

    def __init__(self, architecture: VggtArchitecture):
        super().__init__()
        width = 2 * architecture.width
        self.refinements = architecture.camera_refinements
        self.token_norm = nn.LayerNorm(width, eps=1e-5)
        self.empty_pose_tokens = nn.Parameter(torch.zeros(1, 1, POSE_ENCODING))
        self.embed_pose = Linear(POSE_ENCODING, width)
        self.poseLN_modulation = nn.Sequential(nn.SiLU(), Linear(width, 3 * width))
        self.adaptive_norm = nn.LayerNorm(width, eps=1e-6, elementwise_affine=False)
        self.trunk = nn.ModuleList(
            Block(width, architecture.camera_heads, norm_eps=1e-5) for _ in range(architecture.camera_depth)
        )
        self.trunk_norm = nn.LayerNorm(width, eps=1e-5)
        self.pose_branch = Mlp(width, width // 2, POSE_ENCODING)

    def forward(self, camera_tokens: Tensor) -> Tensor:
        """Pose encodings.

        Args:
            camera_tokens: (B, S, 2C) float32, of the last level.

        Returns:
            (B, S, 9) float32: translation and quaternion (x, y, z, w; not normalised) of camera_from_world, then the
            vertical and horizontal field of view in radians, not negative.
        """
        tokens = self.token_norm(camera_tokens.float())
        normed = self.adaptive_norm(tokens)
        encoding: Tensor | None = None
        for _ in range(self.refinements):
            previous = self.empty_pose_tokens.expand(*tokens.shape[:2], -1) if encoding is None else encoding
            shift, scale, gate = self.poseLN_modulation(self.embed_pose(previous)).float().chunk(3, dim=-1)
            stream = gate * (normed * (1.0 + scale) + shift) + tokens
            for block in self.trunk:
                stream = block(stream)
            update = self.pose_branch(self.trunk_norm(stream)).float()
            encoding = update if encoding is None else encoding + update
        assert encoding is not None
        return torch.cat([encoding[..., :7], F.relu(encoding[..., 7:])], dim=-1)
