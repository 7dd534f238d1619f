"""Invariants of the partition over random sequences of states (issue: every mechanism of Algorithm 1 as repaired)."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vggt_motion.config import FrontendConfig
from vggt_motion.frontend.partition import Partitioner, Topology, create_rule
from vggt_motion.records import FrameEntry, MotionState, Segment

S, T, L = MotionState.STATIC, MotionState.TURNING, MotionState.LINEAR
STATES = {"S": S, "T": T, "L": L}

# runs of one state, long ones and flickering ones; None = a dropped frame
sequences = st.lists(
    st.tuples(st.sampled_from([S, T, L]), st.integers(1, 60) | st.integers(1, 3), st.integers(0, 2)),
    min_size=1,
    max_size=25,
)
sizes = st.tuples(st.integers(1, 6), st.integers(0, 10), st.integers(0, 30))


def _expand(runs: list[tuple[MotionState, int, int]]) -> list[tuple[MotionState, bool]]:
    """Frames (state, is keyframe); the last is a keyframe, as the frontend makes it."""
    frames: list[tuple[MotionState, bool]] = []
    for state, length, dropped in runs:
        for _ in range(length):
            frames += [(state, False)] * dropped + [(state, True)]
    return frames


def _partition(
    frames: list[tuple[MotionState, bool]], config: FrontendConfig, parallax_px: float = 6.0
) -> list[Segment]:
    partitioner = Partitioner(create_rule(config), config.overlap_keyframes, camera="c", epoch=0)
    segments = []
    for index, (state, is_keyframe) in enumerate(frames):
        entry = FrameEntry(index, index, state, is_keyframe)
        if is_keyframe:
            closed = partitioner.push_keyframe(entry, str(index), parallax_px)
            if closed is not None:
                segments.append(closed)
        else:
            partitioner.push_dropped(entry)
    last = partitioner.finish()
    return segments if last is None else [*segments, last]


def _check_common(frames: list[tuple[MotionState, bool]], segments: list[Segment], overlap: int, cap: int) -> None:
    keyframes = [str(index) for index, (_, is_keyframe) in enumerate(frames) if is_keyframe]
    assert list(itertools.chain.from_iterable(s.base_keyframe_ids for s in segments)) == keyframes
    assert [entry.frame_index for s in segments for entry in s.frames] == list(range(len(frames)))
    assert [s.index for s in segments] == list(range(len(segments)))
    assert segments[0].overlap_keyframe_ids == ()
    for before, after in itertools.pairwise(segments):
        assert after.overlap_keyframe_ids == before.base_keyframe_ids[-min(overlap, len(before.base_keyframe_ids)) :]
    for segment in segments:
        kept = tuple(str(entry.frame_index) for entry in segment.frames if entry.is_keyframe)
        assert kept == segment.base_keyframe_ids
        assert len(segment.base_keyframe_ids) <= cap
        assert segment.frames[-1].is_keyframe
    for segment in segments[:-1]:
        assert len(segment.base_keyframe_ids) >= overlap
        assert segment.closed_by != "stream_end"
    assert segments[-1].closed_by == "stream_end"


@given(sequences, sizes)
def test_topology_invariants(runs: list[tuple[MotionState, int, int]], size: tuple[int, int, int]) -> None:
    overlap, budget = size[0], size[0] + 1 + size[1]
    cap = budget + size[2]
    config = FrontendConfig(overlap_keyframes=overlap, max_keyframes=budget, turn_max_keyframes=cap)
    frames = _expand(runs)
    segments = _partition(frames, config)
    _check_common(frames, segments, overlap, cap)
    for segment in segments:
        states = [entry.state for entry in segment.frames if entry.is_keyframe]
        if T not in states:
            assert len(states) <= budget
    for before, after in itertools.pairwise(segments):
        last = [entry.state for entry in before.frames if entry.is_keyframe][-1]
        first = next(entry.state for entry in after.frames if entry.is_keyframe)
        if last is T and first is T:
            # a turn is cut only at the cap
            assert before.closed_by == "turn_cap"
            assert len(before.base_keyframe_ids) == cap


@given(sequences, sizes)
def test_every_turn_ends_its_segment_soon(runs: list[tuple[MotionState, int, int]], size: tuple[int, int, int]) -> None:
    """After a turn the base is closed as soon as it holds N_ovlp keyframes; no straight stretch is filled up behind."""
    overlap, budget = size[0], size[0] + 1 + size[1]
    config = FrontendConfig(overlap_keyframes=overlap, max_keyframes=budget, turn_max_keyframes=budget + size[2])
    for segment in _partition(_expand(runs), config):
        states = [entry.state for entry in segment.frames if entry.is_keyframe]
        ends = [k for k in range(1, len(states)) if states[k - 1] is T and states[k] is not T]
        if ends:
            due = max(overlap, ends[0])
            while due < len(states) and states[due] is T and states[due - 1] is T:
                due += 1  # the next turn has begun: it is not cut either
            assert len(states) <= due


@given(sequences, st.integers(1, 8), st.integers(1, 30))
def test_temporal_bases_have_one_length(runs: list[tuple[MotionState, int, int]], overlap: int, extra: int) -> None:
    config = FrontendConfig(
        partition="temporal", overlap_keyframes=overlap, max_keyframes=overlap + extra, turn_max_keyframes=60
    )
    frames = _expand(runs)
    segments = _partition(frames, config)
    _check_common(frames, segments, overlap, overlap + extra)
    assert all(len(s.base_keyframe_ids) == overlap + extra for s in segments[:-1])


@given(sequences, st.sampled_from([("vggt_long", 60, 30), ("vggt_long_75", 75, 30)]))
def test_vggt_long_invariants(runs: list[tuple[MotionState, int, int]], chunk: tuple[str, int, int]) -> None:
    """Every frame is a keyframe there, and its chunks are blind to the motion."""
    preset, size, overlap = chunk
    config = FrontendConfig.model_validate({"preset": preset})
    frames = [(state, True) for state, _ in _expand(runs)]
    segments = _partition(frames, config)
    _check_common(frames, segments, overlap, size - overlap)
    assert all(len(s.base_keyframe_ids) == size - overlap for s in segments[:-1])


@given(st.integers(1, 600), st.integers(0, 40), st.integers(0, 40))
def test_a_long_roundabout_is_cut_at_the_cap_only(turning: int, before: int, after: int) -> None:
    """Straight on, round and round, straight on: each piece of the turn but its last has the cap's length."""
    config = FrontendConfig()
    frames = [(L, True)] * before + [(T, True)] * turning + [(L, True)] * after
    segments = _partition(frames, config)
    _check_common(frames, segments, config.overlap_keyframes, config.turn_max_keyframes)
    holding = [s for s in segments if any(entry.state is T for entry in s.frames)]
    assert [len(s.base_keyframe_ids) for s in holding[:-1]] == [config.turn_max_keyframes] * (len(holding) - 1)
    assert all(s.closed_by == "turn_cap" for s in holding[:-1])


@given(st.lists(st.sampled_from([S, T, L]), min_size=1, max_size=300), sizes)
def test_states_that_change_from_frame_to_frame(states: list[MotionState], size: tuple[int, int, int]) -> None:
    overlap, budget = size[0], size[0] + 1 + size[1]
    cap = budget + size[2]
    config = FrontendConfig(overlap_keyframes=overlap, max_keyframes=budget, turn_max_keyframes=cap)
    frames = [(state, True) for state in states]
    segments = _partition(frames, config)
    _check_common(frames, segments, overlap, cap)
    for segment in segments:
        if all(entry.state is not T for entry in segment.frames):
            assert len(segment.base_keyframe_ids) <= budget


@given(sequences, st.floats(1.0, 200.0))
def test_parallax_bases_reach_the_parallax(runs: list[tuple[MotionState, int, int]], total: float) -> None:
    config = FrontendConfig(partition="parallax", partition_parallax_px=total)
    frames = _expand(runs)
    segments = _partition(frames, config, parallax_px=6.0)
    _check_common(frames, segments, config.overlap_keyframes, config.turn_max_keyframes)
    for segment in segments[:-1]:
        count = len(segment.base_keyframe_ids)
        assert 6.0 * count >= total or count == config.turn_max_keyframes


@pytest.mark.parametrize(
    ("states", "expected"),
    [
        ("L" * 12 + "L" * 3, [(12, "budget"), (3, "stream_end")]),
        # the turn starts in a straight stretch and is left: cut at the first straight keyframe
        ("L" * 4 + "T" * 20 + "L" * 3, [(24, "turn_end"), (3, "stream_end")]),
        # Algorithm 1 as printed: a full base takes the turn's keyframes still
        ("L" * 12 + "T" * 3 + "L" * 2, [(15, "turn_end"), (2, "stream_end")]),
        # the cut after a short turn waits for N_ovlp = 5
        ("T" * 3 + "L" * 9, [(5, "turn_end"), (7, "stream_end")]),
        # a stop ends a turn as well
        ("T" * 8 + "SS" + "L" * 2, [(8, "turn_end"), (4, "stream_end")]),
        # a roundabout: cut at the cap
        ("T" * 80, [(36, "turn_cap"), (36, "turn_cap"), (8, "stream_end")]),
        ("L", [(1, "stream_end")]),
    ],
)
def test_cases_by_hand(states: str, expected: list[tuple[int, str]]) -> None:
    frames = [(STATES[letter], True) for letter in states]
    segments = _partition(frames, FrontendConfig(max_keyframes=12, overlap_keyframes=5, turn_max_keyframes=36))
    assert [(len(s.base_keyframe_ids), s.closed_by) for s in segments] == expected


def test_left_a_turn_looks_at_keyframes_not_at_frames() -> None:
    """The first straight frame after a turn is often no keyframe; the cut must come all the same."""
    frames = [(T, True)] * 6 + [(L, False)] * 3 + [(L, True)] * 2
    segments = _partition(frames, FrontendConfig())
    assert [s.closed_by for s in segments] == ["turn_end", "stream_end"]
    # the dropped frames between the bases belong to the later one
    assert [len(s.frames) for s in segments] == [6, 5]


def test_no_keyframes_no_segment() -> None:
    assert Partitioner(Topology(12, 5, 36), 5, camera="c", epoch=0).finish() is None


@pytest.mark.parametrize(("preset", "chunk", "overlap"), [("vggt_long", 60, 30), ("vggt_long_75", 75, 30)])
def test_preset_vggt_long_has_every_frame_in_fixed_chunks(preset: str, chunk: int, overlap: int) -> None:
    config = FrontendConfig.model_validate({"preset": preset})
    assert config.selection == "dense" and not config.static_pruning
    segments = _partition([(T, True)] * 40 + [(L, True)] * 160, config)
    for segment in segments[1:-1]:
        assert len(segment.base_keyframe_ids) + len(segment.overlap_keyframe_ids) == chunk
        assert len(segment.overlap_keyframe_ids) == overlap


def test_what_is_set_by_itself_wins_over_the_preset() -> None:
    config = FrontendConfig.model_validate({"preset": "paper", "parallax_px": 9.0})
    assert (config.turning_score, config.turning_flow_px, config.parallax_px) == ("lateral", 5.0, 9.0)
    assert FrontendConfig.model_validate(config.model_dump()) == config
