"""Partition of the keyframes into base segments (paper section 3.1, Algorithm 1 step 2; repairs of DESIGN 3.2).

A rule says, when the next keyframe comes, whether the open base is closed before it, and why. Every rule keeps to
this: no base but the last is shorter than N_ovlp, none longer than ``turn_max``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from vggt_motion.config import FrontendConfig
from vggt_motion.frontend.flow import at_width
from vggt_motion.records import BlobRef, FrameEntry, MotionState, Segment

CLOSED_BY_BUDGET = "budget"
CLOSED_BY_TURN_END = "turn_end"
CLOSED_BY_TURN_CAP = "turn_cap"
CLOSED_BY_PARALLAX = "parallax"
CLOSED_BY_STREAM_END = "stream_end"


@dataclass
class OpenBase:
    """The base that is being filled: R_k so far.

    Attributes:
        keyframe_ids: in time order.
        last_state: state of the last keyframe in it.
        has_left_turn: a turn ended inside it, but it was too short to be closed then.
        parallax_px: sum over its keyframes of the parallax against the keyframe before.
    """

    keyframe_ids: list[str] = field(default_factory=list)
    last_state: MotionState | None = None
    has_left_turn: bool = False
    parallax_px: float = 0.0

    def __len__(self) -> int:
        return len(self.keyframe_ids)


class CutRule(Protocol):
    """A partition strategy."""

    def reason_to_close(self, base: OpenBase, state: MotionState) -> str | None:
        """Why the base is to be closed before a keyframe of this state, or None to go on."""
        ...


@dataclass(frozen=True)
class Topology:
    """Turns stay whole, straight stretches are sliced (Algorithm 1, repaired).

    "Left a turn" looks at the last *keyframe*: with the printed look at the last frame the cut is lost when the first
    straight frame is not a keyframe. The cut waits until the base holds N_ovlp keyframes,
    and if the next turn has begun by then, for the end of that.
    """

    max_keyframes: int
    overlap_keyframes: int
    turn_max_keyframes: int

    def reason_to_close(self, base: OpenBase, state: MotionState) -> str | None:
        """Algorithm 1, step 2."""
        is_inside_turn = state is MotionState.TURNING and base.last_state is MotionState.TURNING
        if base.has_left_turn and len(base) >= self.overlap_keyframes and not is_inside_turn:
            return CLOSED_BY_TURN_END
        if state is MotionState.TURNING:
            return CLOSED_BY_TURN_CAP if len(base) >= self.turn_max_keyframes else None
        return CLOSED_BY_BUDGET if len(base) >= self.max_keyframes else None


@dataclass(frozen=True)
class Temporal:
    """Fixed chunks of N_max keyframes, whatever the motion."""

    max_keyframes: int

    def reason_to_close(self, base: OpenBase, state: MotionState) -> str | None:
        """By count."""
        return CLOSED_BY_BUDGET if len(base) >= self.max_keyframes else None


@dataclass(frozen=True)
class CumulativeParallax:
    """Chunks of equal accumulated parallax, with N_ovlp keyframes at least and ``turn_max`` at most."""

    parallax_px: float  # of the working image
    overlap_keyframes: int
    turn_max_keyframes: int

    def reason_to_close(self, base: OpenBase, state: MotionState) -> str | None:
        """By the way that the image has moved."""
        if len(base) >= self.turn_max_keyframes:
            return CLOSED_BY_TURN_CAP
        is_full = base.parallax_px >= self.parallax_px and len(base) >= self.overlap_keyframes
        return CLOSED_BY_PARALLAX if is_full else None


def create_rule(config: FrontendConfig) -> CutRule:
    """The rule that ``frontend.partition`` names."""
    if config.partition == "temporal":
        return Temporal(config.max_keyframes)
    if config.partition == "parallax":
        return CumulativeParallax(
            at_width(config.partition_parallax_px, config.flow_width_px),
            config.overlap_keyframes,
            config.turn_max_keyframes,
        )
    return Topology(config.max_keyframes, config.overlap_keyframes, config.turn_max_keyframes)


class Partitioner:
    """Builds the segments, keyframe by keyframe.

    A segment's list of frames ends with its last keyframe: dropped frames between two bases belong to the later one.
    """

    def __init__(
        self,
        rule: CutRule,
        overlap_keyframes: int,
        *,
        camera: str,
        epoch: int,
        ego_mask: BlobRef | None = None,
        first_index: int = 0,
    ) -> None:
        """Set up.

        Args:
            rule: the strategy.
            overlap_keyframes: N_ovlp.
            camera: name, copied into the segments.
            epoch: copied into the segments.
            ego_mask: copied into the segments.
            first_index: of the first segment.
        """
        self._rule = rule
        self._overlap_keyframes = overlap_keyframes
        self._camera = camera
        self._epoch = epoch
        self._ego_mask = ego_mask
        self._index = first_index
        self._base = OpenBase()
        self._overlap: tuple[str, ...] = ()
        self._frames: list[FrameEntry] = []  # of the open segment, up to its last keyframe
        self._pending: list[FrameEntry] = []  # dropped frames since that keyframe

    def push_dropped(self, entry: FrameEntry) -> None:
        """Note a frame that is no keyframe."""
        self._pending.append(entry)

    def push_keyframe(self, entry: FrameEntry, keyframe_id: str, parallax_px: float) -> Segment | None:
        """Add a keyframe; returns the segment before it when that is closed.

        Args:
            entry: the frame.
            keyframe_id: its id.
            parallax_px: against the keyframe before, px of the working image.
        """
        base = self._base
        if base.last_state is MotionState.TURNING and entry.state is not MotionState.TURNING:
            base.has_left_turn = True
        reason = self._rule.reason_to_close(base, entry.state) if len(base) else None
        closed = self._close(reason) if reason is not None else None
        base = self._base
        base.keyframe_ids.append(keyframe_id)
        base.last_state = entry.state
        base.parallax_px += parallax_px
        self._frames += [*self._pending, entry]
        self._pending = []
        return closed

    def finish(self) -> Segment | None:
        """Close the last base, which may be short; None when there was no keyframe at all."""
        if not len(self._base):
            return None
        self._frames += self._pending
        self._pending = []
        return self._close(CLOSED_BY_STREAM_END)

    def _close(self, reason: str) -> Segment:
        base_ids = tuple(self._base.keyframe_ids)
        segment = Segment(
            index=self._index,
            camera=self._camera,
            epoch=self._epoch,
            base_keyframe_ids=base_ids,
            overlap_keyframe_ids=self._overlap,
            frames=tuple(self._frames),
            closed_by=reason,
            ego_mask=self._ego_mask,
        )
        self._index += 1
        self._overlap = base_ids[-self._overlap_keyframes :]
        self._base = OpenBase()
        self._frames = []
        return segment
