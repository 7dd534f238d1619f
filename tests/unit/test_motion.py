"""Scores on flow fields in closed form, smoothing against its definition, classification."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vggt_motion.frontend.motion import FlowMeasures, MotionProfile, ProfileSmoother, classify, measure_flow
from vggt_motion.records import MotionState

ROWS, COLUMNS = 60, 80
EVERYWHERE = np.ones((ROWS, COLUMNS), np.bool_)


def _centred() -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.mgrid[0:ROWS, 0:COLUMNS].astype(np.float32)
    return columns - (COLUMNS - 1) / 2, rows - (ROWS - 1) / 2


def _measure(flow: np.ndarray, textured: np.ndarray = EVERYWHERE) -> FlowMeasures:
    return measure_flow(flow.astype(np.float32), textured, static_flow_px=0.7, interval_s=0.1)


def test_forward_motion_has_lateral_flow_but_no_yaw() -> None:
    x, y = _centred()
    rate = 0.05
    measures = _measure(np.stack([rate * x, rate * y], axis=-1))
    # mean |rate x| over a symmetric range of width W is rate W / 4; |F| < tau inside a circle of radius tau / rate
    assert measures.lateral_px == pytest.approx(rate * COLUMNS / 4, rel=0.01)
    assert measures.static_ratio == pytest.approx(math.pi * (0.7 / rate) ** 2 / (ROWS * COLUMNS), rel=0.05)
    assert measures.yaw_px == pytest.approx(0.0, abs=1e-6)


def test_turning_while_driving_shows_as_the_common_shift() -> None:
    x, y = _centred()
    measures = _measure(np.stack([0.2 * x - 3.5, 0.2 * y], axis=-1))
    assert measures.yaw_px == pytest.approx(-3.5, abs=1e-5)


def test_yaw_is_not_moved_by_a_static_bonnet_or_an_empty_sky() -> None:
    x, y = _centred()
    flow = np.stack([0.05 * x + 3.0, 0.05 * y], axis=-1)
    flow[:20] = 0.0  # sky without texture
    flow[-10:] = 0.0  # bonnet, textured
    textured = EVERYWHERE.copy()
    textured[:20] = False
    assert _measure(flow, textured).yaw_px == pytest.approx(3.0, abs=0.5)


def test_static_ratio_counts_cells_below_the_threshold_with_texture_only() -> None:
    flow = np.zeros((ROWS, COLUMNS, 2))
    flow[:, :20, 0] = 0.69
    flow[:, 20:40, 1] = -0.71
    assert _measure(flow).static_ratio == pytest.approx(0.75)
    textured = EVERYWHERE.copy()
    textured[:, 40:] = False
    assert _measure(flow, textured).static_ratio == pytest.approx(0.5)


def test_without_any_texture_all_cells_count() -> None:
    flow = np.zeros((ROWS, COLUMNS, 2))
    assert _measure(flow, np.zeros((ROWS, COLUMNS), np.bool_)).static_ratio == 1.0


def _random_measures(seed: int, count: int) -> list[FlowMeasures]:
    rng = np.random.default_rng(seed)
    return [
        FlowMeasures(float(rng.random()), float(rng.random() * 9), float(rng.normal() * 4), 0.1, False)
        for _ in range(count)
    ]


def _smooth(measures: list[FlowMeasures | None], sigma: float, lookahead: int) -> list[MotionProfile]:
    smoother = ProfileSmoother(sigma, lookahead)
    profiles = []
    for position, item in enumerate(measures):
        profile = smoother.push(item)
        assert (profile is not None) == (position >= lookahead)  # the delay is exactly the look-ahead
        if profile is not None:
            profiles.append(profile)
    profiles += list(smoother.finish())
    return profiles


@pytest.mark.parametrize(
    ("sigma", "lookahead", "count"), [(2.0, 4, 30), (1.0, 2, 3), (2.0, 4, 1), (3.0, 0, 10), (0.0, 3, 8)]
)
def test_smoothing_equals_its_definition_over_the_whole_sequence(sigma: float, lookahead: int, count: int) -> None:
    measures: list[FlowMeasures | None] = [None, *_random_measures(1, count)]
    profiles = _smooth(measures, sigma, lookahead)
    assert len(profiles) == len(measures)
    for t, profile in enumerate(profiles):
        weights, members = [], []
        for k, member in enumerate(measures):
            if member is not None and abs(k - t) <= lookahead:
                weight = math.exp(-((k - t) ** 2) / (2 * sigma**2)) if sigma else float(k == t)
                if weight:
                    weights.append(weight)
                    members.append(member)
        if not members:
            assert not profile.has_evidence
            continue
        assert profile.static_ratio == pytest.approx(np.average([m.static_ratio for m in members], weights=weights))
        assert profile.lateral_px == pytest.approx(np.average([m.lateral_px for m in members], weights=weights))
        assert profile.yaw_px == pytest.approx(np.average([m.yaw_px for m in members], weights=weights))


def test_turning_scores_are_rates() -> None:
    """The same turn seen at 10, 30 and 60 frames/s, with jitter of the stamps, has the same score."""
    rng = np.random.default_rng(0)
    for rate in (10.0, 30.0, 60.0):
        steps = rng.uniform(0.5, 1.5, 40) / rate
        measures: list[FlowMeasures | None] = [FlowMeasures(0.0, 60.0 * dt, 25.0 * dt, dt, False) for dt in steps]
        for profile in _smooth(measures, 2.0, 4):
            assert profile.yaw_px == pytest.approx(2.5)
            assert profile.lateral_px == pytest.approx(6.0)


def test_repeated_images_are_no_evidence_of_standing() -> None:
    """A 15 Hz camera in a 30 Hz file: each second pair of images is identical."""
    moving = FlowMeasures(0.05, 5.0, 2.0, 1 / 30, False)
    repeat = FlowMeasures(1.0, 0.0, 0.0, 1 / 30, True)
    profiles = _smooth([None, *[moving, repeat] * 20], 2.0, 4)
    for profile in profiles:
        assert profile.static_ratio == pytest.approx(0.05)
    # half of the time the image stands, so the rate is half of what one pair says
    assert profiles[20].yaw_px == pytest.approx(2.0 / 2 * 3, rel=0.05)


def test_only_repeats_is_standing() -> None:
    repeat = FlowMeasures(1.0, 0.0, 0.0, 0.1, True)
    for profile in _smooth([None, *[repeat] * 12], 2.0, 4):
        assert profile == MotionProfile(1.0, 0.0, 0.0, has_evidence=False)


@given(st.floats(0, 20), st.floats(-20, 20), st.booleans(), st.floats(0.1, 10))
def test_classification_is_hierarchical(lateral: float, yaw: float, is_standing: bool, threshold: float) -> None:
    profile = MotionProfile(0.0, lateral, yaw, True)
    for score, value in (("lateral", lateral), ("yaw", abs(yaw))):
        state = classify(profile, is_standing=is_standing, score=score, turning_flow_px=threshold)
        if is_standing:
            assert state is MotionState.STATIC
        elif value > threshold:
            assert state is MotionState.TURNING
        else:
            assert state is MotionState.LINEAR
