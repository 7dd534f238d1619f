"""What moves as one piece through the keyframes, on tracks whose motion is known."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from vggt_motion.geometry.projection import Intrinsics, project
from vggt_motion.inference.sfm import companions
from vggt_motion.inference.sfm.images import WorkingImages
from vggt_motion.inference.sfm.tracks import Tracks

WIDTH, HEIGHT, FRAMES = 620, 188, 5
CAMERA = Intrinsics.centred(360.0, WIDTH, HEIGHT)
POSITIONS = range(FRAMES)
Array = npt.NDArray[np.float64]


def working() -> WorkingImages:
    plain = np.full((HEIGHT, WIDTH), 128, dtype=np.uint8)
    return WorkingImages((plain,) * FRAMES, np.ones((HEIGHT, WIDTH), dtype=np.bool_), WIDTH, HEIGHT)


def tracks_of(paths: Array) -> Tracks:
    """Points that are seen wherever their path (N, F, 2) is inside of the image."""
    paths = np.nan_to_num(paths, nan=-1.0)
    inside = ((paths >= 0) & (paths <= [WIDTH - 1, HEIGHT - 1])).all(axis=2)
    inside &= (inside.sum(axis=1) >= 2)[:, None]
    number = np.cumsum(inside.any(axis=1)) - 1
    point, frame = np.nonzero(inside)
    return Tracks(number[point], frame, paths[point, frame], int(inside.any(axis=1).sum()))


def road(count: int = 900, step: float = 1.0) -> Array:
    """Paths of points of a street that the camera drives along: everything between 4 and 15 steps away."""
    rng = np.random.default_rng(0)
    pixel = rng.uniform([0, 0], [WIDTH, HEIGHT], (count, 2))
    depth = rng.uniform(4.0, 15.0, count)
    x = (pixel[:, 0] - CAMERA.cx) / CAMERA.fx * depth
    y = (pixel[:, 1] - CAMERA.cy) / CAMERA.fy * depth
    # what is passed is behind the camera then, and thus nowhere
    return np.stack([project(np.stack([x, y, depth - step * k], axis=1), CAMERA) for k in POSITIONS], axis=1)


def behind_a_truck() -> tuple[Tracks, npt.NDArray[np.bool_]]:
    """The road where the truck does not hide it, and the truck: half of the width, which grows by 1% a step."""
    scene = road()
    visible = np.abs(scene[:, 0, 0] - WIDTH / 2) > 160
    rng = np.random.default_rng(1)
    start = rng.uniform([WIDTH / 2 - 150, 8], [WIDTH / 2 + 150, HEIGHT - 16], (600, 2))
    middle = np.array([WIDTH / 2, HEIGHT / 2])
    truck = np.stack([middle + 1.01**k * (start - middle) + [np.sin(k), 0.0] for k in POSITIONS], axis=1)
    tracks = tracks_of(np.concatenate([scene[visible], truck]))
    return tracks, np.arange(tracks.count) >= tracks.count - len(truck)


def test_a_truck_ahead_is_found_with_all_its_points() -> None:
    tracks, is_truck = behind_a_truck()
    found = companions.find(tracks, POSITIONS, working())
    assert found is not None
    assert found.points[is_truck].mean() > 0.98
    assert found.points[~is_truck].mean() < 0.1
    assert found.others[~is_truck].mean() > 0.8
    assert not (found.points & found.others).any()
    for position in POSITIONS:
        hidden = found.hidden[position]
        assert hidden[20:-20, WIDTH // 2 - 140 : WIDTH // 2 + 140].mean() > 0.99
        assert hidden[:, :120].mean() < 0.05
        assert hidden[:, -120:].mean() < 0.05


def test_an_open_road_holds_none() -> None:
    assert companions.find(tracks_of(road()), POSITIONS, working()) is None


def test_no_tracks_hold_none() -> None:
    nothing = np.zeros(0, dtype=np.int64)
    assert companions.find(Tracks(nothing, nothing, np.zeros((0, 2)), 0), POSITIONS, working()) is None


@pytest.mark.parametrize(("deepest", "is_flat"), [(1.0, True), (8.0, False)])
def test_one_plane_is_told_from_a_scene(deepest: float, is_flat: bool) -> None:
    """The camera moves sideways past a wall, or past things up to eight times as far."""
    rng = np.random.default_rng(2)
    start = rng.uniform([0, 0], [WIDTH, HEIGHT], (500, 2))
    shift = 40.0 / rng.uniform(1.0, deepest, 500)
    paths = np.stack([start - np.stack([shift * k, np.zeros(500)], axis=1) for k in POSITIONS], axis=1)
    assert companions.is_flat(tracks_of(paths), POSITIONS) is is_flat
