"""What is fixed to the camera: learned while the rest moves, given up at once when it moves."""

from __future__ import annotations

import numpy as np

from vggt_motion.frontend.flow import CellGrid
from vggt_motion.frontend.overlay import LEARNING_S, OverlayDetector

GRID = CellGrid.of((96, 320), 320)
EVERYWHERE = np.ones((GRID.rows, GRID.columns), np.bool_)


def _flow(speed_px: float) -> np.ndarray:
    """The image moves, but for the lowest quarter and a column in the middle that is far away."""
    flow = np.zeros((GRID.rows, GRID.columns, 2), np.float32)
    flow[..., 0] = speed_px
    flow[_bonnet()] = 0.0
    flow[:, GRID.columns // 2] = 0.0
    return flow


def _bonnet() -> np.ndarray:
    bonnet = np.zeros((GRID.rows, GRID.columns), np.bool_)
    bonnet[-GRID.rows // 4 :] = True
    return bonnet


def _drive(detector: OverlayDetector, seconds: float, rate_hz: float, speed_px: float = 3.0) -> np.ndarray:
    fixed = ~EVERYWHERE
    for _ in range(round(seconds * rate_hz)):
        fixed = detector.update(_flow(speed_px), EVERYWHERE, 1.0 / rate_hz)
    return fixed


def test_learned_in_two_seconds_whatever_the_frame_rate() -> None:
    for rate_hz in (10.0, 30.0):
        detector = OverlayDetector(GRID, 0.7)
        assert not _drive(detector, LEARNING_S - 0.3, rate_hz).any()
        assert _drive(detector, 0.6, rate_hz)[_bonnet()].all()


def test_what_is_far_away_is_believed_again_in_the_very_frame_in_which_it_moves() -> None:
    detector = OverlayDetector(GRID, 0.7)
    assert _drive(detector, 4.0, 10.0)[0, GRID.columns // 2]
    turning = np.full((GRID.rows, GRID.columns, 2), 0.0, np.float32)
    turning[..., 0] = 5.0
    turning[_bonnet()] = 0.0
    fixed = detector.update(turning, EVERYWHERE, 0.1)
    np.testing.assert_array_equal(fixed, _bonnet())


def test_nothing_is_learned_while_the_camera_stands() -> None:
    detector = OverlayDetector(GRID, 0.7)
    for _ in range(100):
        assert not detector.update(_flow(0.0), EVERYWHERE, 0.1).any()


def test_a_gap_between_two_frames_is_no_long_observation() -> None:
    detector = OverlayDetector(GRID, 0.7)
    assert not detector.update(_flow(3.0), EVERYWHERE, 60.0).any()


def test_noise_that_moves_a_cell_once_in_a_while_does_not_hide_the_bonnet() -> None:
    detector = OverlayDetector(GRID, 0.7)
    _drive(detector, 4.0, 10.0)
    shaken = _flow(3.0)
    shaken[_bonnet()] = 0.5
    detector.update(shaken, EVERYWHERE, 0.1)
    assert _drive(detector, 0.2, 10.0)[_bonnet()].all()
