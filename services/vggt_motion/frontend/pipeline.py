"""The whole frontend as one pure object: encoded frames in, keyframes and segments out (paper section 3.1)."""

from __future__ import annotations

import hashlib
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.config import FrontendConfig
from vggt_motion.errors import ConfigurationError
from vggt_motion.frontend.flow import (
    CellGrid,
    DenseFlow,
    Flow,
    GreyDecoder,
    GreyFrame,
    MotionProof,
    at_width,
    gradient_cells,
)
from vggt_motion.frontend.keyframes import Candidate, KeyframeSelector, ParallaxTracker, Selected, create_strategy
from vggt_motion.frontend.motion import MotionProfile, ProfileSmoother, classify, measure_flow
from vggt_motion.frontend.overlay import OverlayDetector
from vggt_motion.frontend.partition import Partitioner, create_rule
from vggt_motion.frontend.standing import ShiftMeter, StandingDetector
from vggt_motion.records import BlobRef, DropReason, FrameEntry, Keyframe, MotionState, Segment, keyframe_id
from vggt_motion.sources.source import Frame

MIN_GRADIENT = 3.0  # grey levels; noise of a dark image stays below after the reduction to the working width


@dataclass(frozen=True)
class KeyframeOutput:
    """A keyframe and the bytes of its image blob."""

    keyframe: Keyframe
    encoded: bytes


@dataclass(frozen=True)
class SegmentOutput:
    """A closed segment; all its keyframes were put out before."""

    segment: Segment


Output = KeyframeOutput | SegmentOutput


@dataclass(frozen=True)
class FrameTrace:
    """What was seen and decided at one frame, for plots and tables."""

    frame_index: int
    capture_time_ns: int
    profile: MotionProfile
    state: MotionState
    is_keyframe: bool
    drop_reason: DropReason | None
    parallax_px: float  # against the last keyframe, px of the working image


@dataclass(frozen=True)
class _Waiting:
    """A frame that waits for its look-ahead."""

    frame: Frame
    grey: GreyFrame
    flow_cells: Flow | None
    usable: npt.NDArray[np.bool_]
    fixed: npt.NDArray[np.bool_]


class FrontendPipeline:
    """Motion state, keyframes and partition, frame by frame.

    Deterministic, and independent of how the frames arrive: the states of a live stream are those of the file. A
    frame is decided ``lookahead_frames`` frames after it came. Memory is bounded: it holds the frames that wait for
    their look-ahead, half a second of working images, and the frame list of the open segment.
    """

    def __init__(
        self,
        config: FrontendConfig,
        camera: str,
        epoch: int = 0,
        ego_mask: npt.NDArray[np.generic] | None = None,
        ego_mask_ref: BlobRef | None = None,
        *,
        first_segment: int = 0,
        on_trace: Callable[[FrameTrace], None] | None = None,
    ) -> None:
        """Set up for one stream.

        Args:
            config: section ``frontend``.
            camera: name, part of the keyframe ids.
            epoch: part of the keyframe ids.
            ego_mask: (H, W) of the full image, non-zero where pixels belong to the vehicle or an overlay.
            ego_mask_ref: the same mask as a blob, copied into the segments.
            first_segment: index of the first segment; not 0 for a later epoch of a live camera.
            on_trace: told of each frame once it is decided, in frame order.
        """
        self._config = config
        self._camera = camera
        self._epoch = epoch
        self._ego_mask = ego_mask
        self._on_trace = on_trace
        self._decoder = GreyDecoder(config.flow_width_px)
        self._flow = DenseFlow()
        self._smoother = ProfileSmoother(config.smoothing_sigma_frames, config.smoothing_lookahead_frames)
        self._partitioner = Partitioner(
            create_rule(config),
            config.overlap_keyframes,
            camera=camera,
            epoch=epoch,
            ego_mask=ego_mask_ref,
            first_index=first_segment,
        )
        self._static_flow_px = at_width(config.static_flow_px, config.flow_width_px)
        self._turning_flow_px = at_width(config.turning_flow_px, config.flow_width_px)
        self._waiting: deque[_Waiting] = deque()
        self._profiles: deque[MotionProfile] = deque()  # of frames that are decided but held back by the selector
        self._previous: _Waiting | None = None
        self._parts: _SizedParts | None = None
        self.frame_count = 0
        self.keyframe_count = 0
        self.segment_count = 0
        self.state_counts: Counter[MotionState] = Counter()

    @property
    def lookahead_frames(self) -> int:
        """Delay between a frame's arrival and its state, in frames."""
        return self._smoother.lookahead_frames

    def push(self, frame: Frame) -> list[Output]:
        """Take the next frame.

        Returns:
            Keyframes and segments that are decided now, in order; a segment comes after its keyframes.

        Raises:
            SourceError: the first frame is not readable.
            SourceTruncatedError: this frame is not readable or has another size. It is not taken; :meth:`finish` gives
                what was read before.
            ConfigurationError: the ego mask does not fit to the frames.
        """
        grey = self._decoder.decode(frame)
        if self._parts is None:
            self._parts = self._fit(grey)
        parts, previous = self._parts, self._previous
        usable = (gradient_cells(grey.pixels, parts.grid) >= MIN_GRADIENT) & parts.allowed
        measures, cells, is_fixed = None, None, ~parts.allowed
        if previous is not None:
            flow = self._flow.between(previous.grey.pixels, grey.pixels)
            cells = parts.grid.sample(flow)
            interval_s = (frame.capture_time_ns - previous.frame.capture_time_ns) * 1e-9
            # the flow's own lattice is the frame before, so that one's texture says where it can be believed
            is_fixed = is_fixed | parts.overlay.update(cells, previous.usable, interval_s)
            before, proof = previous.grey.pixels, parts.proof
            measures = measure_flow(
                cells,
                previous.usable & ~is_fixed,
                static_flow_px=self._static_flow_px,
                interval_s=interval_s,
                is_repeat=np.array_equal(before, grey.pixels),
                prove_motion=lambda: proof.cells(before, grey.pixels, flow),
            )
            usable &= ~is_fixed
        self._previous = _Waiting(frame, grey, cells, usable, is_fixed)
        self._waiting.append(self._previous)
        self.frame_count += 1
        profile = self._smoother.push(measures)
        return [] if profile is None else self._decide(profile)

    def finish(self) -> list[Output]:
        """The stream has ended: decide what is still waiting. Call once."""
        outputs: list[Output] = []
        for profile in self._smoother.finish():
            outputs += self._decide(profile)
        if self._parts is not None:
            outputs += self._emit(self._parts.selector.finish())
        segment = self._partitioner.finish()
        if segment is not None:
            outputs.append(self._segment_output(segment))
        return outputs

    def _fit(self, grey: GreyFrame) -> _SizedParts:
        shape = grey.pixels.shape
        grid = CellGrid.of(shape, self._config.flow_width_px)
        allowed = np.ones((grid.rows, grid.columns), np.bool_)
        if self._ego_mask is not None:
            if self._ego_mask.shape != (grey.height_px, grey.width_px):
                mask_height, mask_width = self._ego_mask.shape[:2]
                raise ConfigurationError(
                    f"the ego mask is {mask_width}x{mask_height}, the frames are {grey.width_px}x{grey.height_px}"
                )
            # a cell that is masked in part may see the vehicle
            mask = (self._ego_mask != 0).astype(np.uint8) * 255
            small = cv2.resize(mask, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
            allowed = grid.mean(np.asarray(small, np.uint8)) == 0
        proof = MotionProof(grid, shape)
        meter = ShiftMeter(self._flow, grid, proof, self._static_flow_px)
        selector = KeyframeSelector(
            create_strategy(self._config),
            ParallaxTracker(grid, (shape[0], shape[1])),
            static_pruning=self._config.static_pruning,
        )
        return _SizedParts(
            grid=grid,
            allowed=allowed,
            proof=proof,
            overlay=OverlayDetector(grid, self._static_flow_px),
            standing=StandingDetector(meter, self._config.static_ratio, self._static_flow_px),
            selector=selector,
        )

    def _decide(self, profile: MotionProfile) -> list[Output]:
        assert self._parts is not None
        waiting = self._waiting.popleft()
        is_standing = self._parts.standing.decide(
            profile.static_ratio, waiting.grey.pixels, waiting.usable, waiting.frame.capture_time_ns
        )
        state = classify(
            profile,
            is_standing=is_standing,
            score=self._config.turning_score,
            turning_flow_px=self._turning_flow_px,
        )
        self.state_counts[state] += 1
        self._profiles.append(profile)
        candidate = Candidate(
            frame=waiting.frame,
            pixels=waiting.grey.pixels,
            width_px=waiting.grey.width_px,
            height_px=waiting.grey.height_px,
            state=state,
            flow_cells=waiting.flow_cells,
            usable=waiting.usable,
            fixed=waiting.fixed,
        )
        return self._emit(self._parts.selector.push(candidate))

    def _emit(self, verdicts: Iterable[Selected]) -> list[Output]:
        outputs: list[Output] = []
        for selected in verdicts:
            candidate = selected.candidate
            frame = candidate.frame
            entry = FrameEntry(
                frame_index=frame.index,
                capture_time_ns=frame.capture_time_ns,
                state=candidate.state,
                is_keyframe=selected.is_keyframe,
                drop_reason=selected.drop_reason,
            )
            profile = self._profiles.popleft()
            if self._on_trace is not None:
                self._on_trace(
                    FrameTrace(
                        frame_index=frame.index,
                        capture_time_ns=frame.capture_time_ns,
                        profile=profile,
                        state=candidate.state,
                        is_keyframe=selected.is_keyframe,
                        drop_reason=selected.drop_reason,
                        parallax_px=selected.parallax_px,
                    )
                )
            if not selected.is_keyframe:
                self._partitioner.push_dropped(entry)
                continue
            keyframe = self._keyframe(selected)
            closed = self._partitioner.push_keyframe(entry, keyframe.keyframe_id, selected.parallax_px)
            if closed is not None:
                outputs.append(self._segment_output(closed))
            self.keyframe_count += 1
            outputs.append(KeyframeOutput(keyframe, frame.encoded))
        return outputs

    def _keyframe(self, selected: Selected) -> Keyframe:
        candidate = selected.candidate
        frame = candidate.frame
        original = selected.zero_motion_copy_of
        return Keyframe(
            camera=self._camera,
            epoch=self._epoch,
            frame_index=frame.index,
            capture_time_ns=frame.capture_time_ns,
            state=candidate.state,
            width_px=candidate.width_px,
            height_px=candidate.height_px,
            image=BlobRef(hashlib.sha256(frame.encoded).hexdigest(), len(frame.encoded), frame.media_type),
            zero_motion_copy_of=None if original is None else keyframe_id(self._camera, self._epoch, original),
        )

    def _segment_output(self, segment: Segment) -> SegmentOutput:
        self.segment_count += 1
        return SegmentOutput(segment)


@dataclass(frozen=True)
class _SizedParts:
    """What can only be built when the size of the frames is known."""

    grid: CellGrid
    allowed: npt.NDArray[np.bool_]  # (rows, columns), outside the ego mask
    proof: MotionProof
    overlay: OverlayDetector
    standing: StandingDetector
    selector: KeyframeSelector
