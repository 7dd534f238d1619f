"""The network: images of a submap to camera encodings and depth, in one lean pass."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from vggt_motion.inference.vggt.aggregator import Aggregator, Level
from vggt_motion.inference.vggt.architecture import VggtArchitecture
from vggt_motion.inference.vggt.camera_head import CameraHead
from vggt_motion.inference.vggt.dense_head import DenseHead, activate_depth, activate_points
from vggt_motion.inference.vggt.layers import Block
from vggt_motion.inference.vggt.stopwatch import Stopwatch
from vggt_motion.inference.vggt.tracking import TrackingHead

DEFAULT_FRAME_CHUNK = 1


@dataclass(frozen=True)
class VggtOutput:
    """What the network returns, on its device, float32.

    ``pose_encoding`` (B, S, 9) as :class:`CameraHead` gives it; ``depth`` (B, S, H, W) along the optical axis, submap
    units; ``depth_confidence`` (B, S, H, W) above 1; ``points`` (B, S, H, W, 3) in the frame of the first camera and
    ``point_confidence`` only where the point head was built.
    """

    pose_encoding: Tensor
    depth: Tensor
    depth_confidence: Tensor
    points: Tensor | None
    point_confidence: Tensor | None
    seconds: dict[str, float]


class Vggt(nn.Module):
    """VGGT (Wang et al., CVPR 2025), inference only, with the parameter names of its published checkpoints."""

    def __init__(self, architecture: VggtArchitecture, *, with_points: bool = False, with_tracking: bool = False):
        super().__init__()
        self.architecture = architecture
        self.aggregator = Aggregator(architecture)
        self.camera_head = CameraHead(architecture)
        self.depth_head = DenseHead(architecture, outputs=2)
        if with_points:
            self.point_head = DenseHead(architecture, outputs=4)
        if with_tracking:
            self.track_head = TrackingHead(architecture)
        self.with_points = with_points

    def set_row_chunk(self, rows: int | None) -> None:
        """Let all blocks work on so many tokens at a time; None = all. It does not change the result."""
        for module in self.modules():
            if isinstance(module, Block):
                module.row_chunk = rows

    @torch.inference_mode()
    def forward(self, images: Tensor, frame_chunk: int = DEFAULT_FRAME_CHUNK) -> VggtOutput:
        """Predict B submaps of S frames each.

        Args:
            images: (B, S, 3, H, W) RGB in [0, 1], sides divisible by 14.
            frame_chunk: frames that dense heads take at a time: it bounds the memory and does not change the result.

        Raises:
            ValueError: a side is not divisible by the patch.
        """
        batch, frames, _, height, width = images.shape
        patch = self.architecture.patch_px
        if height % patch or width % patch:
            raise ValueError(f"images of {width}x{height}: both sides must be divisible by {patch}")
        stopwatch = Stopwatch(images.device)
        heads = [self.depth_head, self.point_head] if self.with_points else [self.depth_head]
        maps: list[list[Tensor]] = [[] for _ in heads]
        camera_tokens: Tensor | None = None
        last = self.architecture.depth - 1
        wanted = frozenset(self.architecture.dense_levels) | {last}
        for level in self.aggregator.levels(images, wanted, stopwatch=stopwatch):
            if level.index == last:
                camera_tokens = level.tokens(slice(None), slice(0, 1)).view(batch, frames, -1)
            if level.index in self.architecture.dense_levels:
                with stopwatch("dense_head"):
                    for head, kept in zip(heads, maps, strict=True):
                        kept.append(self._project(head, level, (height, width), frame_chunk))
        assert camera_tokens is not None
        del level  # the last one's tokens, which the heads need no more
        with stopwatch("camera_head"):
            pose_encoding = self.camera_head(camera_tokens)
        with stopwatch("dense_head"):
            depth, depth_confidence = self._decode(self.depth_head, maps[0], (height, width), frame_chunk)
            points, point_confidence = (
                self._decode(self.point_head, maps[1], (height, width), frame_chunk)
                if self.with_points
                else (None, None)
            )
        shape = (batch, frames, height, width)
        return VggtOutput(
            pose_encoding=pose_encoding,
            depth=depth.view(shape),
            depth_confidence=depth_confidence.view(shape),
            points=None if points is None else points.view(*shape, 3),
            point_confidence=None if point_confidence is None else point_confidence.view(shape),
            seconds=stopwatch.seconds,
        )

    def _project(self, head: DenseHead, level: Level, size: tuple[int, int], frame_chunk: int) -> Tensor:
        position = head.levels.index(level.index)
        grid = (size[0] // self.architecture.patch_px, size[1] // self.architecture.patch_px)
        patches = slice(self.architecture.special_tokens, None)
        count = level.of_frames.shape[0] * level.of_frames.shape[1]
        result: Tensor | None = None
        for start in range(0, count, frame_chunk):
            part = slice(start, start + frame_chunk)
            narrow = head.project(position, level.tokens(part, patches), grid, size[1] / size[0])
            if result is None:
                shape = (count, *narrow.shape[1:])
                result = torch.empty(shape, device=narrow.device, memory_format=torch.channels_last)
            result[part] = narrow
        assert result is not None
        return result

    def _decode(
        self, head: DenseHead, maps: list[Tensor], size: tuple[int, int], frame_chunk: int
    ) -> tuple[Tensor, Tensor]:
        is_points = self.with_points and head is self.point_head
        count = len(maps[0])
        values: Tensor | None = None
        confidence = maps[0].new_empty(count, *size)
        for start in range(0, count, frame_chunk):
            part = slice(start, start + frame_chunk)
            raw = head.decode([level[part] for level in maps], size)
            some_values, some_confidence = activate_points(raw) if is_points else activate_depth(raw)
            if values is None:
                values = some_values.new_empty(count, *some_values.shape[1:])
            values[part] = some_values
            confidence[part] = some_confidence
        assert values is not None
        return values, confidence
