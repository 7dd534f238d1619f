"""The whole pure frontend: online equals offline, bad input, and the numbers on real sequences."""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from motion_truth import f1, is_turning
from vggt_motion.config import FrontendConfig
from vggt_motion.errors import ConfigurationError, SourceError, SourceTruncatedError
from vggt_motion.frontend.flow import CellGrid, DenseFlow, gradient_cells, resize_grey
from vggt_motion.frontend.motion import measure_flow
from vggt_motion.frontend.pipeline import (
    MIN_GRADIENT,
    FrameTrace,
    FrontendPipeline,
    KeyframeOutput,
    Output,
    SegmentOutput,
)
from vggt_motion.records import BlobRef, Keyframe, MotionState, Segment
from vggt_motion.sources.registry import open_source
from vggt_motion.sources.source import Frame


class Run:
    """What a frontend made of some frames."""

    def __init__(self, frames: list[Frame], config: FrontendConfig | None = None, *, finish: bool = True) -> None:
        self.traces: list[FrameTrace] = []
        pipeline = FrontendPipeline(config or FrontendConfig(), "front", on_trace=self.traces.append)
        self.outputs: list[Output] = []
        for frame in frames:
            self.outputs += pipeline.push(frame)
        if finish:
            self.outputs += pipeline.finish()
        self.pipeline = pipeline

    @property
    def keyframes(self) -> list[Keyframe]:
        return [output.keyframe for output in self.outputs if isinstance(output, KeyframeOutput)]

    @property
    def segments(self) -> list[Segment]:
        return [output.segment for output in self.outputs if isinstance(output, SegmentOutput)]

    @property
    def states(self) -> str:
        return "".join(trace.state.value for trace in self.traces)


def _encode(index: int, pixels: np.ndarray) -> Frame:
    return Frame(index, index * 100_000_000, cv2.imencode(".png", pixels)[1].tobytes(), "image/png")


@pytest.fixture(scope="module")
def drive() -> list[Frame]:
    """40 frames of a synthetic drive: straight, then panning, then standing."""
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.standard_normal((400, 900)), (0, 0), 3.0)
    scene = np.clip(120 + 45 * noise / noise.std(), 0, 255).astype(np.float32)
    frames, factor, shift = [], 1.0, 0.0
    for k in range(40):
        factor *= 1.03 if k < 15 else 1.0
        shift += 6.0 if 15 <= k < 28 else 0.0
        matrix = np.array([[factor, 0, (1 - factor) * 450 - shift - 290], [0, factor, (1 - factor) * 200 - 110]])
        view = cv2.warpAffine(scene, matrix.astype(np.float32), (320, 180), borderMode=cv2.BORDER_REFLECT)
        frames.append(_encode(k, view.astype(np.uint8)))
    return frames


def test_states_of_the_synthetic_drive(drive: list[Frame]) -> None:
    run = Run(drive)
    assert set(run.states[:12]) == {"L"}
    assert set(run.states[17:26]) == {"T"}
    assert set(run.states[-5:]) == {"S"}


def test_online_equals_offline_frame_by_frame(drive: list[Frame]) -> None:
    """What is decided while frames come in does not change with what comes after the stated look-ahead."""
    whole = Run(drive)
    lookahead = whole.pipeline.lookahead_frames
    assert lookahead == FrontendConfig().smoothing_lookahead_frames
    traces: list[FrameTrace] = []
    pipeline = FrontendPipeline(FrontendConfig(), "front", on_trace=traces.append)
    for frame in drive:
        pipeline.push(frame)
        # dropped frames are held back by one more, as the stream may end with one
        assert len(traces) >= frame.index - lookahead
        assert traces == whole.traces[: len(traces)]


@pytest.mark.parametrize("length", [1, 2, 5, 17, 29])
def test_a_stream_that_ends_early_has_the_same_beginning(drive: list[Frame], length: int) -> None:
    lookahead = FrontendConfig().smoothing_lookahead_frames
    whole, part = Run(drive), Run(drive[:length])
    assert len(part.traces) == length
    settled = max(0, length - lookahead - 1)
    assert part.traces[:settled] == whole.traces[:settled]


def test_profiles_equal_an_offline_computation_over_whole_arrays(drive: list[Frame]) -> None:
    """Eq. 1 and 2 on all frames, then one convolution per score."""
    config = FrontendConfig()
    images = [
        resize_grey(cv2.imdecode(np.frombuffer(frame.encoded, np.uint8), cv2.IMREAD_GRAYSCALE), config.flow_width_px)
        for frame in drive
    ]
    grid = CellGrid.of(images[0].shape, config.flow_width_px)
    flow = DenseFlow()
    measures = [
        measure_flow(
            grid.sample(flow.between(a, b)),
            gradient_cells(a, grid) >= MIN_GRADIENT,
            static_flow_px=config.static_flow_px,
            interval_s=0.1,
        )
        for a, b in itertools.pairwise(images)
    ]
    is_moving_pair = np.array([float(not np.array_equal(a, b)) for a, b in itertools.pairwise(images)])
    reach = config.smoothing_lookahead_frames
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / config.smoothing_sigma_frames) ** 2)

    def smooth(values: np.ndarray, present: np.ndarray) -> np.ndarray:
        values, present = np.concatenate([[0.0], values]), np.concatenate([[0.0], present])
        return np.convolve(values * present, kernel, "same") / np.maximum(np.convolve(present, kernel, "same"), 1e-12)

    ones = np.ones(len(measures))
    static = smooth(np.array([m.static_ratio for m in measures]), is_moving_pair)
    yaw = smooth(np.array([m.yaw_px for m in measures]), ones)
    lateral = smooth(np.array([m.lateral_px for m in measures]), ones)
    for trace in Run(drive).traces:
        if trace.profile.has_evidence:
            assert trace.profile.static_ratio == pytest.approx(static[trace.frame_index], abs=1e-9)
            assert trace.profile.yaw_px == pytest.approx(yaw[trace.frame_index], abs=1e-6)
            assert trace.profile.lateral_px == pytest.approx(lateral[trace.frame_index], abs=1e-6)


def test_two_runs_are_equal(drive: list[Frame]) -> None:
    assert Run(drive).outputs == Run(drive).outputs


def test_outputs_are_complete_and_in_order(drive: list[Frame]) -> None:
    run = Run(drive)
    seen: set[str] = set()
    for output in run.outputs:
        if isinstance(output, KeyframeOutput):
            seen.add(output.keyframe.keyframe_id)
            frame = drive[output.keyframe.frame_index]
            assert output.encoded == frame.encoded
            assert output.keyframe.image == BlobRef(
                hashlib.sha256(frame.encoded).hexdigest(), len(frame.encoded), "image/png"
            )
            assert output.keyframe.capture_time_ns == frame.capture_time_ns
            assert (output.keyframe.width_px, output.keyframe.height_px) == (320, 180)
        else:
            assert set(output.segment.base_keyframe_ids) <= seen
            assert set(output.segment.overlap_keyframe_ids) <= seen
    entries = [entry for segment in run.segments for entry in segment.frames]
    assert [entry.frame_index for entry in entries] == list(range(len(drive)))
    assert [entry.capture_time_ns for entry in entries] == [frame.capture_time_ns for frame in drive]
    assert [entry.state for entry in entries] == [trace.state for trace in run.traces]
    assert all((entry.drop_reason is None) == entry.is_keyframe for entry in entries)
    assert [e.frame_index for e in entries if e.is_keyframe] == [k.frame_index for k in run.keyframes]
    pipeline = run.pipeline
    assert (pipeline.frame_count, pipeline.keyframe_count, pipeline.segment_count) == (
        len(drive),
        len(run.keyframes),
        len(run.segments),
    )
    assert sum(pipeline.state_counts.values()) == len(drive)


def test_the_second_boundary_of_a_stop_is_a_zero_motion_copy_of_the_first(drive: list[Frame]) -> None:
    stop = [k for k in Run(drive).keyframes if k.state is MotionState.STATIC]
    assert len(stop) == 2
    assert stop[1].zero_motion_copy_of == stop[0].keyframe_id
    assert stop[0].zero_motion_copy_of is None


def test_one_frame(drive: list[Frame]) -> None:
    run = Run(drive[:1])
    assert len(run.keyframes) == 1
    assert [len(segment.frames) for segment in run.segments] == [1]
    assert run.segments[0].closed_by == "stream_end"


def test_no_frame() -> None:
    assert Run([]).outputs == []


def test_identical_frames_are_one_stop(drive: list[Frame]) -> None:
    frames = [Frame(k, k * 100_000_000, drive[0].encoded, "image/png") for k in range(30)]
    run = Run(frames)
    assert set(run.states) == {"S"}
    assert [k.frame_index for k in run.keyframes] == [0, 29]


def test_size_change_keeps_what_was_read(drive: list[Frame]) -> None:
    pipeline = FrontendPipeline(FrontendConfig(), "front")
    outputs: list[Output] = []
    for frame in drive[:20]:
        outputs += pipeline.push(frame)
    other = _encode(20, np.zeros((100, 100), np.uint8))
    with pytest.raises(SourceTruncatedError, match="frame 20 is 100x100"):
        pipeline.push(other)
    outputs += pipeline.finish()
    assert outputs == Run(drive[:20]).outputs


def test_unreadable_first_frame() -> None:
    with pytest.raises(SourceError):
        Run([Frame(0, 0, b"text", "image/jpeg")])


def test_ego_mask_is_kept_out_and_handed_on(drive: list[Frame]) -> None:
    """A moving overlay over a standing scene: with the mask the camera stands."""
    rng = np.random.default_rng(5)
    scene = cv2.imdecode(np.frombuffer(drive[0].encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert scene is not None
    wheel = cv2.GaussianBlur(rng.standard_normal((180, 2000)), (0, 0), 2.0)
    wheel = np.clip(120 + 40 * wheel / wheel.std(), 0, 255).astype(np.uint8)
    frames = []
    for k in range(20):
        image = scene.copy()
        image[60:] = wheel[60:, 7 * k : 7 * k + 320]
        frames.append(_encode(k, image))
    mask = np.zeros((180, 320), np.uint8)
    mask[58:] = 255
    reference = BlobRef("0" * 64, 10, "image/png")
    outputs: list[Output] = []
    traces: list[FrameTrace] = []
    pipeline = FrontendPipeline(FrontendConfig(), "front", 0, mask, reference, on_trace=traces.append)
    for frame in frames:
        outputs += pipeline.push(frame)
    outputs += pipeline.finish()
    assert {trace.state for trace in traces} == {MotionState.STATIC}
    assert [o.segment.ego_mask for o in outputs if isinstance(o, SegmentOutput)] == [reference]
    assert "S" not in Run(frames).states


def test_ego_mask_of_another_size_is_refused(drive: list[Frame]) -> None:
    pipeline = FrontendPipeline(FrontendConfig(), "front", 0, np.zeros((10, 10), np.uint8))
    with pytest.raises(ConfigurationError, match="the ego mask is 10x10, the frames are 320x180"):
        pipeline.push(drive[0])


# --- real sequences: the numbers of the issue, with one configuration for all ---


def _frames(data_dir: Path, name: str) -> list[Frame]:
    return list(open_source(str(data_dir / name)).frames())


def _turn_f1(run: Run, truth: np.ndarray) -> float:
    return f1(np.array([trace.state is MotionState.TURNING for trace in run.traces])[1:], truth)


@pytest.mark.data
def test_turns_of_kitti_00(data_dir: Path) -> None:
    frames = _frames(data_dir, "kitti_00_first200")
    truth = is_turning(data_dir / "kitti_00_first200", [f.capture_time_ns for f in frames])
    run = Run(frames)
    assert _turn_f1(run, truth) >= 0.9
    assert "S" not in run.states
    assert len(run.keyframes) < len(frames) / 2
    # the paper's score does not separate turns on this sequence, whatever its threshold: why yaw is the default
    lateral = Run(frames, FrontendConfig(turning_score="lateral", turning_flow_px=5.0))
    assert _turn_f1(lateral, truth) < 0.8


@pytest.mark.data
@pytest.mark.parametrize(("name", "expected"), [("kitti_01_first51", True), ("kitti_06_first51", False)])
def test_turns_of_a_ramp_and_of_a_straight_street(data_dir: Path, name: str, expected: bool) -> None:
    frames = _frames(data_dir, name)
    run = Run(frames)
    truth = is_turning(data_dir / name, [f.capture_time_ns for f in frames])
    if expected:
        assert _turn_f1(run, truth) >= 0.9
    else:
        assert not truth.any() and "T" not in run.states


@pytest.mark.data
def test_standing_at_a_red_light(data_dir: Path) -> None:
    run = Run(_frames(data_dir, "video/standing_at_red_light.mp4"))
    assert run.states.count("S") >= 0.99 * len(run.traces)
    assert len(run.keyframes) <= 2


@pytest.mark.data
@pytest.mark.parametrize("name", ["video/highway_straight.mp4", "kitti_raw_road_91", "kitti_06_first51"])
def test_driving_has_no_static_frame(data_dir: Path, name: str) -> None:
    assert "S" not in Run(_frames(data_dir, name)).states


def _changed(frames: list[Frame], change: Callable[[np.ndarray], np.ndarray]) -> list[Frame]:
    """The frames with every picture changed."""
    result = []
    for frame in frames:
        pixels = np.asarray(cv2.imdecode(np.frombuffer(frame.encoded, np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8)
        data = cv2.imencode(".jpg", change(pixels), [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()
        result.append(Frame(frame.index, frame.capture_time_ns, data, "image/jpeg"))
    return result


def _small(pixels: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.resize(pixels, (416, 128), interpolation=cv2.INTER_AREA))


def _night(pixels: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, 3, pixels.shape)
    return np.clip(15 + 0.2 * pixels + noise, 0, 255).astype(np.uint8)


@functools.cache
def _barrel_map(height: int, width: int) -> np.ndarray:
    camera = np.array([[0.58 * width, 0, width / 2], [0, 0.58 * width, height / 2], [0, 0, 1.0]])
    seen = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 1, 2).astype(np.float32)
    source = cv2.undistortPoints(seen, camera, np.array([-0.3, 0, 0, 0.0]), P=camera).reshape(height, width, 2)
    return np.asarray(source, np.float32)


def _barrel(pixels: np.ndarray) -> np.ndarray:
    """Seen through a lens with a strong barrel distortion."""
    return np.asarray(cv2.remap(pixels, _barrel_map(*pixels.shape), None, cv2.INTER_LINEAR))  # type: ignore[call-overload]


@pytest.mark.data
@pytest.mark.parametrize("change", [_small, _night, _barrel])
def test_turns_of_kitti_00_through_other_cameras(data_dir: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    frames = _frames(data_dir, "kitti_00_first200")
    truth = is_turning(data_dir / "kitti_00_first200", [f.capture_time_ns for f in frames])
    run = Run(_changed(frames, change))
    assert _turn_f1(run, truth) >= 0.9
    assert "S" not in run.states
    # a lens changes the scale of the parallax, but starves nothing
    assert 50 <= len(run.keyframes) < len(frames) / 2


@pytest.mark.data
def test_turns_of_kitti_00_at_5_hz(data_dir: Path) -> None:
    frames = _frames(data_dir, "kitti_00_first200")
    times = [frame.capture_time_ns for frame in frames]
    kept = [Frame(k, f.capture_time_ns, f.encoded, f.media_type) for k, f in enumerate(frames[::2])]
    run = Run(kept)
    # the smoothing window is two frames, which are twice as long here
    assert _turn_f1(run, is_turning(data_dir / "kitti_00_first200", times, 4.0)[1::2]) >= 0.9
    assert "S" not in run.states


@pytest.mark.data
def test_a_stop_put_into_kitti_00(data_dir: Path) -> None:
    """The same picture 40 times with fresh noise, then the drive goes on."""
    frames = _frames(data_dir, "kitti_00_first200")[:120]
    rng = np.random.default_rng(0)
    still = np.asarray(cv2.imdecode(np.frombuffer(frames[60].encoded, np.uint8), cv2.IMREAD_GRAYSCALE), np.int16)
    stop = [np.clip(still + rng.normal(0, 4, still.shape), 0, 255).astype(np.uint8) for _ in range(39)]
    encoded = [frame.encoded for frame in frames[:61]]
    encoded += [cv2.imencode(".jpg", image)[1].tobytes() for image in stop]
    encoded += [frame.encoded for frame in frames[61:]]
    run = Run([Frame(k, k * 100_000_000, data, "image/jpeg") for k, data in enumerate(encoded)])
    standing = [k for k, state in enumerate(run.states) if state == "S"]
    # the smoothing blurs both ends
    assert set(range(66, 98)) <= set(standing) <= set(range(60, 101))
    boundaries = [k.frame_index for k in run.keyframes if k.state is MotionState.STATIC]
    assert boundaries == [standing[0], standing[-1]]


@pytest.mark.data
@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize("name", ["kitti_00_first200", "video/standing_at_red_light.mp4"])
def test_states_do_not_depend_on_the_resolution(data_dir: Path, name: str, factor: float) -> None:
    frames = _frames(data_dir, name)
    scaled = []
    for frame in frames:
        pixels = cv2.imdecode(np.frombuffer(frame.encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
        interpolation = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
        resized = cv2.resize(pixels, None, fx=factor, fy=factor, interpolation=interpolation)
        data = cv2.imencode(".jpg", resized, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
        scaled.append(Frame(frame.index, frame.capture_time_ns, data, "image/jpeg"))
    same = np.mean([a == b for a, b in zip(Run(frames).states, Run(scaled).states, strict=True)])
    assert same >= 0.97
