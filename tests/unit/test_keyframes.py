"""Keyframe selection: parallax in closed form, strategies, stops, first and last frame."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vggt_motion.config import FrontendConfig
from vggt_motion.frontend.flow import CellGrid
from vggt_motion.frontend.keyframes import (
    COMPANION_RATIO,
    ROTATION_WEIGHT,
    STOP_MAX_FRAMES,
    Candidate,
    KeyframeSelector,
    ParallaxTracker,
    Selected,
    create_strategy,
)
from vggt_motion.records import DropReason, MotionState
from vggt_motion.sources.source import Frame

SHAPE = (96, 320)
GRID = CellGrid.of(SHAPE, 320)
USABLE = np.ones((GRID.rows, GRID.columns), np.bool_)
NOWHERE = ~USABLE
PIXELS = np.zeros(SHAPE, np.uint8)

S, T, L = MotionState.STATIC, MotionState.TURNING, MotionState.LINEAR


def _shift(dx: float, dy: float = 0.0) -> np.ndarray:
    return np.broadcast_to(np.array([dx, dy], np.float32), (GRID.rows, GRID.columns, 2)).copy()


def _expansion(factor: float) -> np.ndarray:
    """Flow of u -> centre + factor (u - centre)."""
    centre = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2], np.float32)
    return ((factor - 1) * (GRID.centres_px() - centre)).reshape(GRID.rows, GRID.columns, 2).astype(np.float32)


def test_expansion_is_measured_against_its_closed_form() -> None:
    tracker = ParallaxTracker(GRID, SHAPE)
    tracker.restart(USABLE)
    for _ in range(5):
        tracker.advance(_expansion(1.02), USABLE, NOWHERE)
    centre = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2])
    total = 1.02**5
    offsets = GRID.centres_px() - centre
    inside = (np.abs(total * offsets) <= [(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2]).all(axis=1)
    # points that have left rank above the others, whatever they had
    lengths = np.where(inside, (total - 1) * np.hypot(*offsets.T), np.inf)
    assert tracker.parallax_px == pytest.approx(np.median(lengths), rel=0.02)
    assert tracker.covisible_share == pytest.approx(inside.mean(), abs=0.01)


def test_common_shift_counts_by_its_weight() -> None:
    tracker = ParallaxTracker(GRID, SHAPE)
    tracker.restart(USABLE)
    for _ in range(4):
        tracker.advance(_shift(-5.0), USABLE, NOWHERE)
    assert tracker.parallax_px == pytest.approx(ROTATION_WEIGHT * 20.0, rel=1e-4)


@pytest.mark.parametrize("steps", [10, 40, 200])
def test_parallax_stays_right_beyond_the_image(steps: int) -> None:
    """A shift of several image widths: points leave, new ones are laid, what was reached is kept."""
    tracker = ParallaxTracker(GRID, SHAPE)
    tracker.restart(USABLE)
    for _ in range(steps):
        tracker.advance(_shift(9.0), USABLE, NOWHERE)
    assert tracker.parallax_px == pytest.approx(ROTATION_WEIGHT * 9.0 * steps, rel=1e-3)


def test_parallax_does_not_come_to_a_halt_when_what_is_near_leaves() -> None:
    """A motorway: two thirds of the image rush out of it, a far third hardly moves."""
    flow = np.zeros((GRID.rows, GRID.columns, 2), np.float32)
    near = np.arange(GRID.columns) % 3 != 0
    x = GRID.centres_px().reshape(GRID.rows, GRID.columns, 2)[..., 0] - (SHAPE[1] - 1) / 2
    flow[..., 0] = np.where(near, np.sign(x) * 12.0, 0.0)
    tracker = ParallaxTracker(GRID, SHAPE)
    tracker.restart(USABLE)
    reached = []
    for _ in range(6):
        tracker.advance(flow, USABLE, NOWHERE)
        reached.append(tracker.parallax_px)
    assert all(b >= a for a, b in itertools.pairwise(reached))
    assert reached[-1] > 2 * reached[0] > 0


@pytest.mark.parametrize(("truck_px", "rest_px"), [(0.4, 6.0), (0.05, 2.0), (0.0, 1.0)])
def test_behind_a_truck_the_rest_of_the_view_decides(truck_px: float, rest_px: float) -> None:
    """It fills half of the view and sways; what is left of the road moves by another length, to both sides."""
    assert rest_px > COMPANION_RATIO * truck_px
    across = np.arange(GRID.columns) / GRID.columns
    is_truck = (across >= 0.23) & (across < 0.77)
    flow = np.zeros((GRID.rows, GRID.columns, 2), np.float32)
    flow[..., 0] = np.where(is_truck, 0.0, np.where(across < 0.5, -rest_px, rest_px))
    flow[::2, :, 1][:, is_truck] = truck_px
    flow[1::2, :, 1][:, is_truck] = -truck_px
    tracker = ParallaxTracker(GRID, SHAPE)
    tracker.restart(USABLE)
    tracker.advance(flow, USABLE, NOWHERE)
    assert tracker.parallax_px == pytest.approx(rest_px, abs=truck_px + 1e-3)


def test_depth_alone_does_not_look_like_a_truck() -> None:
    """Lengths that are spread evenly from nothing to the largest, as depth spreads them: the median counts."""
    flow = np.zeros((GRID.rows, GRID.columns, 2), np.float32)
    x = GRID.centres_px().reshape(GRID.rows, GRID.columns, 2)[..., 0] - (SHAPE[1] - 1) / 2
    flow[..., 0] = 0.03 * x
    tracker = ParallaxTracker(GRID, SHAPE)
    tracker.restart(USABLE)
    tracker.advance(flow, USABLE, NOWHERE)
    assert tracker.parallax_px == pytest.approx(0.03 * SHAPE[1] / 4, rel=0.05)


def test_all_points_lost_at_once_does_not_break() -> None:
    tracker = ParallaxTracker(GRID, SHAPE)
    tracker.restart(USABLE)
    tracker.advance(_shift(1000.0), USABLE, NOWHERE)
    tracker.advance(_shift(3.0), USABLE, NOWHERE)
    assert math.isfinite(tracker.parallax_px)
    assert tracker.covisible_share == 0.0


def test_no_usable_cells_falls_back_to_all() -> None:
    tracker = ParallaxTracker(GRID, SHAPE)
    tracker.restart(NOWHERE)
    tracker.advance(_shift(10.0), NOWHERE, NOWHERE)
    assert tracker.parallax_px == pytest.approx(3.0)


def test_points_that_prove_to_be_fixed_to_the_camera_leave_the_median() -> None:
    """Four fifths of the image are a bonnet that is not known at first."""
    bonnet = NOWHERE.copy()
    bonnet[GRID.rows // 5 :] = True
    flow = _expansion(1.05)
    flow[bonnet] = 0.0
    tracker = ParallaxTracker(GRID, SHAPE)
    tracker.restart(USABLE)
    tracker.advance(flow, USABLE, NOWHERE)
    starved = tracker.parallax_px
    tracker.advance(flow, USABLE & ~bonnet, bonnet)
    alone = ParallaxTracker(GRID, SHAPE)
    alone.restart(~bonnet)
    for _ in range(2):
        alone.advance(flow, ~bonnet, bonnet)
    assert starved == 0.0
    assert tracker.parallax_px == pytest.approx(alone.parallax_px, rel=0.05)
    assert tracker.parallax_px > 1.0
    assert tracker.covisible_share <= 1.0


def _candidates(states: list[MotionState], flow: np.ndarray) -> list[Candidate]:
    return [
        Candidate(Frame(k, k, b"", "image/png"), PIXELS, 320, 96, state, flow if k else None, USABLE, NOWHERE)
        for k, state in enumerate(states)
    ]


def _select(states: list[MotionState], flow: np.ndarray, **changes: object) -> list[Selected]:
    config = FrontendConfig.model_validate(changes)
    selector = KeyframeSelector(
        create_strategy(config), ParallaxTracker(GRID, SHAPE), static_pruning=config.static_pruning
    )
    verdicts: list[Selected] = []
    for candidate in _candidates(states, flow):
        verdicts += selector.push(candidate)
    verdicts += selector.finish()
    return verdicts


def _indices(verdicts: list[Selected]) -> list[int]:
    return [v.candidate.frame.index for v in verdicts if v.is_keyframe]


def test_parallax_strategy_takes_every_nth_frame_of_a_constant_motion() -> None:
    # the common shift of 5 px a frame counts 1.5 px: above 5.5 px after four frames
    assert _indices(_select([L] * 21, _shift(5.0), parallax_px=5.5)) == [0, 4, 8, 12, 16, 20]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"selection": "dense"}, list(range(12))),
        ({"selection": "uniform", "uniform_stride": 5}, [0, 5, 10, 11]),
        # 9.6 px of 320 leave a share of 0.03 a frame: below 0.9 after four
        ({"selection": "covisibility", "covisibility_ratio": 0.9}, [0, 4, 8, 11]),
        ({"selection": "parallax", "parallax_px": 1000.0}, [0, 11]),
    ],
)
def test_strategies(changes: dict[str, object], expected: list[int]) -> None:
    assert _indices(_select([L] * 12, _shift(9.6), **changes)) == expected


def test_drop_reasons() -> None:
    for selection, reason in (("uniform", DropReason.STRATEGY), ("parallax", DropReason.LOW_PARALLAX)):
        dropped = [v.drop_reason for v in _select([L] * 9, _shift(0.1), selection=selection) if not v.is_keyframe]
        assert set(dropped) == {reason}
    assert {v.drop_reason for v in _select([S] * 9, _shift(0.0)) if not v.is_keyframe} == {DropReason.STATIC}


def test_of_a_stop_the_first_and_the_last_frame_stay_and_share_a_pose() -> None:
    verdicts = _select([L] * 3 + [S] * 6 + [L] * 3, _shift(0.0))
    assert _indices(verdicts) == [0, 3, 8, 11]
    copies = {v.candidate.frame.index: v.zero_motion_copy_of for v in verdicts if v.is_keyframe}
    assert copies == {0: None, 3: None, 8: 3, 11: None}


def test_boundary_keyframes_become_the_last_one() -> None:
    """After a stop parallax counts from the stop's last frame, not from before it."""
    verdicts = _select([L] * 3 + [S] * 4 + [L] * 6, _shift(5.0), parallax_px=5.5)
    # 0, then the stop 3..6, then four frames of 1.5 px each after 6
    assert _indices(verdicts) == [0, 3, 6, 10, 12]


def test_a_stop_of_one_frame_has_one_boundary() -> None:
    assert _indices(_select([L, L, S, L, L], _shift(0.0))) == [0, 2, 4]


def test_without_pruning_standing_frames_follow_the_strategy() -> None:
    assert _indices(_select([S] * 6, _shift(0.0), static_pruning=False)) == [0, 5]
    assert _indices(_select([S] * 6, _shift(0.0), static_pruning=False, selection="dense")) == list(range(6))


def test_a_very_long_stop_gets_boundaries_in_between() -> None:
    verdicts = _select([S] * (2 * STOP_MAX_FRAMES + 50), _shift(0.0))
    kept = _indices(verdicts)
    assert kept[0] == 0 and kept[-1] == 2 * STOP_MAX_FRAMES + 49
    assert len(kept) == 4
    assert max(b - a for a, b in itertools.pairwise(kept)) <= STOP_MAX_FRAMES
    copies = {v.candidate.frame.index: v.zero_motion_copy_of for v in verdicts if v.is_keyframe}
    assert [copies[k] for k in kept[1:]] == kept[:-1]


@given(
    st.lists(st.sampled_from([S, T, L]), min_size=1, max_size=60),
    st.sampled_from(["dense", "uniform", "covisibility", "parallax"]),
    st.booleans(),
    st.floats(0, 12),
)
def test_invariants_over_random_states(states: list[MotionState], selection: str, pruning: bool, speed: float) -> None:
    verdicts = _select(states, _shift(speed), selection=selection, static_pruning=pruning)
    assert [v.candidate.frame.index for v in verdicts] == list(range(len(states)))  # one verdict each, in order
    kept = set(_indices(verdicts))
    assert {0, len(states) - 1} <= kept
    if pruning:
        for k, state in enumerate(states):
            before = states[k - 1] if k else None
            after = states[k + 1] if k + 1 < len(states) else None
            if state is S:
                assert (k in kept) == (before is not S or after is not S)
        for v in verdicts:
            original = v.zero_motion_copy_of
            if original is not None:
                assert original in kept
                assert all(states[k] is S for k in range(original, v.candidate.frame.index + 1))
    else:
        assert all(v.zero_motion_copy_of is None for v in verdicts)
    if selection == "dense" and not pruning:
        assert len(kept) == len(states)
