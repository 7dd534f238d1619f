"""Plots and point-cloud pictures, against closed forms, brute force and OpenCV's projection."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vggt_motion.evaluation import map_plots, plots, render
from vggt_motion.evaluation.plot_style import to_png, to_svg
from vggt_motion.evaluation.report_data import CameraView, ComponentTrack, GroundTruth, PointCloud
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.geometry.track import PoseTrack
from vggt_motion.records import (
    Constraint,
    ConstraintKind,
    FrameEntry,
    MotionState,
    RegistrationSpec,
    Segment,
)

PERIOD_NS = 100_000_000


def straight(count: int, step: float = 1.0) -> PoseTrack:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = step * np.arange(count)
    return PoseTrack(np.arange(count) * PERIOD_NS, poses)


def one_part(track: PoseTrack) -> ComponentTrack:
    return ComponentTrack(track, np.zeros(len(track), np.int64))


def segments_of(states: str, borders: tuple[int, ...] = ()) -> tuple[Segment, ...]:
    """One frame per letter, every third a keyframe; a segment ends before each border."""
    out = []
    edges = [0, *borders, len(states)]
    for index, (begin, end) in enumerate(itertools.pairwise(edges)):
        entries = tuple(FrameEntry(i, i * PERIOD_NS, MotionState(states[i]), i % 3 == 0) for i in range(begin, end))
        base = tuple(f"front/0/{entry.frame_index:08d}" for entry in entries if entry.is_keyframe)
        out.append(Segment(index, "front", 0, base, (), entries, "budget"))
    return tuple(out)


def constraint(
    j: int, accepted: bool = True, scale: float = 1.0, kind: ConstraintKind = ConstraintKind.ADJACENT
) -> Constraint:
    spec = RegistrationSpec(j - 1, j, 1, 1, kind, ("front/0/00000000",))
    ratio = 0.9 if accepted else 0.2
    return Constraint(
        spec, accepted, "" if accepted else "too few", Sim3(scale=scale), ratio, 0.01 * j, np.eye(7), 1000, ()
    )


def test_overlay_shows_the_error_that_was_put_in() -> None:
    truth = straight(21, step=2.0)
    moved = truth.world_from_camera.copy()
    moved[:, 0, 3] += 0.3
    # In the estimate's own world everything is turned, shifted and four times smaller.
    truth_from_world = Sim3(se3.so3_exp(np.array([0.2, 1.1, -0.4])), np.array([3.0, -1.0, 7.0]), 4.0)
    world = np.array([truth_from_world.inverse().act_pose(pose) for pose in moved])
    frames = one_part(PoseTrack(truth.times_ns, world))
    figure = plots.overlay_figure(frames, GroundTruth(truth, {0: truth_from_world}))
    above, below = figure.axes
    line = below.lines[0]
    np.testing.assert_allclose(line.get_xdata(), 2.0 * np.arange(21), atol=1e-9)
    np.testing.assert_allclose(line.get_ydata(), 0.3, atol=1e-9)
    assert above.get_aspect() == 1.0
    assert any("RMSE 0.3 m" in text.get_text() for text in below.texts)


def test_overlay_pairs_poses_by_time_and_ignores_frames_without_truth() -> None:
    truth = straight(10)
    every_second = PoseTrack(truth.times_ns[1::2] + 400_000, truth.world_from_camera[1::2])  # 0.4 ms of jitter
    late = PoseTrack(
        np.append(every_second.times_ns, 10**12), np.append(every_second.world_from_camera, np.eye(4)[None], 0)
    )
    below = plots.overlay_figure(one_part(late), GroundTruth(truth, {0: Sim3.identity()})).axes[1]
    np.testing.assert_allclose(below.lines[0].get_xdata(), [1, 3, 5, 7, 9], atol=1e-9)
    np.testing.assert_allclose(below.lines[0].get_ydata(), 0.0, atol=1e-9)


def test_trajectory_draws_unconnected_parts_in_panels_of_their_own() -> None:
    track = straight(30)
    frames = ComponentTrack(track, np.repeat([0, 4, 9], 10))
    figure = plots.trajectory_figure(frames, frames, "m")
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title(loc="left") for axes in panels] == [f"part from submap {k} (10 frames)" for k in (0, 4, 9)]
    for axes, first in zip(panels, (0, 10, 20), strict=True):
        np.testing.assert_allclose(axes.lines[0].get_xdata(), np.arange(first, first + 10))  # long ahead: to the right
        assert axes.get_aspect() == 1.0


def test_trajectory_puts_a_long_drive_ahead_along_the_paper() -> None:
    track = straight(50)
    axes = plots.trajectory_figure(one_part(track), one_part(track), "m").axes[0]
    np.testing.assert_allclose(axes.lines[0].get_xdata(), np.arange(50))
    assert "ahead" in axes.get_xlabel() and "(m)" in axes.get_xlabel()
    low, high = axes.get_ylim()
    assert low > high  # right of the camera is downwards, as on a map turned by a quarter


@pytest.mark.parametrize("count", [0, 1, 2])
def test_hardly_any_pose_is_drawn_without_error(count: int) -> None:
    frames = one_part(straight(count))
    to_svg(plots.trajectory_figure(frames, frames, "units"))
    to_svg(plots.motion_figure(segments_of("L" * max(count, 1)), frames, None, "units"))
    if count:
        to_svg(plots.overlay_figure(frames, GroundTruth(straight(count), {0: Sim3.identity()})))


def test_camera_that_did_not_move_is_drawn_without_error() -> None:
    frames = one_part(straight(12, step=0.0))
    to_svg(plots.trajectory_figure(frames, frames, "units"))
    to_svg(plots.motion_figure(segments_of("S" * 12), frames, None, "units"))
    cloud = PointCloud(np.zeros((5, 3)), np.zeros((5, 3), np.uint8))
    to_png(map_plots.map_figure(cloud, frames, "units"), 50)


def test_poses_that_are_not_finite_are_left_out() -> None:
    track = straight(9)
    track.world_from_camera[4] = np.nan
    axes = plots.trajectory_figure(one_part(track), one_part(track), "m").axes[0]
    np.testing.assert_allclose(axes.lines[0].get_xdata(), [0, 1, 2, 3, 5, 6, 7, 8])


def test_motion_band_covers_every_frame_once() -> None:
    states = "LLLTTTTLLSSSSSL"
    figure = plots.motion_figure(segments_of(states, (6,)), one_part(straight(len(states))), None, "m")
    band = figure.axes[0]
    spans: dict[str, float] = {}
    for bars in band.collections:
        name = str(bars.get_label())
        if name[:1] in "STL" and name[1:3] == "  ":
            spans[name[0]] = sum(float(np.ptp(path.vertices[:, 0])) for path in bars.get_paths())
    assert {name: round(width, 9) for name, width in spans.items()} == {"L": 0.6, "T": 0.4, "S": 0.5}
    labels = [text.get_text() for text in band.get_legend().get_texts()]
    assert "keyframes (5)" in labels and "submap borders (1)" in labels


@pytest.mark.parametrize("degrees_per_second", [20.0, -35.0])
def test_motion_shows_speed_and_signed_yaw_rate_of_a_circle(degrees_per_second: float) -> None:
    seconds = np.arange(40) / 10.0
    heading = np.radians(degrees_per_second) * seconds  # about y, which points down: to the right is positive
    poses = np.tile(np.eye(4), (40, 1, 1))
    for pose, angle in zip(poses, heading, strict=True):
        pose[:3, :3] = cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
    radius = 8.0 / np.radians(degrees_per_second)
    poses[:, 0, 3] = radius * (1.0 - np.cos(heading))
    poses[:, 2, 3] = radius * np.sin(heading)
    track = PoseTrack((seconds * 1e9).astype(np.int64), poses)
    _, speed, yaw = plots.motion_figure(segments_of("T" * 40), one_part(track), None, "m").axes
    np.testing.assert_allclose(yaw.lines[0].get_ydata(), degrees_per_second, rtol=1e-6)
    np.testing.assert_allclose(speed.lines[0].get_ydata(), 8.0, rtol=1e-3)  # the chord of a step is a little shorter


def test_speed_is_not_measured_across_a_break() -> None:
    track = straight(10)
    track.world_from_camera[5:, 2, 3] += 1000.0
    frames = ComponentTrack(track, np.repeat([0, 3], 5))
    speed = plots.motion_figure(segments_of("L" * 10), frames, None, "m").axes[1].lines[0].get_ydata()
    assert np.isnan(speed[4])
    np.testing.assert_allclose(np.delete(speed, 4), 10.0)


def test_edges_tell_refused_from_accepted_and_leave_the_scale_of_refused_ones_out() -> None:
    edges = [constraint(1), constraint(2, accepted=False, scale=40.0), constraint(3, scale=0.5)]
    edges.append(constraint(7, scale=2.0, kind=ConstraintKind.LOOP))
    top, middle, bottom = plots.edges_figure(edges, 0.5).axes
    labels = [text.get_text() for text in top.get_legend().get_texts()]
    assert labels == ["adjacent, accepted (2)", "loop, accepted (1)", "adjacent, refused (1)", "least accepted (0.5)"]
    drawn = {(x, y) for line in bottom.lines if line.get_marker() != "None" for x, y in line.get_xydata()}
    assert drawn == {(1.0, 1.0), (3.0, 0.5), (7.0, 2.0)}
    residuals = sorted(y for line in middle.lines for y in line.get_ydata())
    assert residuals == pytest.approx([1.0, 2.0, 3.0, 7.0])


def test_constraints_without_numbers_are_drawn_without_error() -> None:
    lost = constraint(1, accepted=False)
    lost = Constraint(lost.spec, False, "no points", Sim3(), float("nan"), float("nan"), np.eye(7), 0)
    to_svg(plots.edges_figure([lost], None))


def test_names_from_outside_are_not_read_as_mathematics() -> None:
    svg = to_svg(plots.stages_figure({r"$\frac{": 1.0, "<b>&": 2.0}))
    assert svg.startswith(b"<?xml")


def test_files_of_the_same_figure_are_the_same_bytes() -> None:
    def make() -> tuple[bytes, bytes]:
        frames = one_part(straight(20))
        figure = plots.trajectory_figure(frames, frames, "m")
        return to_svg(figure), to_png(figure, 60)

    assert make() == make()


def test_overlay_png_is_a_picture(tmp_path: Path) -> None:
    plots.write_overlay_png(
        tmp_path / "overlay.png", one_part(straight(5)), GroundTruth(straight(5), {0: Sim3.identity()})
    )
    picture = cv2.imread(str(tmp_path / "overlay.png"))
    assert picture is not None and picture.shape[1] > 1000 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 10


# Point clouds


def brute_force(
    points: npt.NDArray[np.float64],
    colors: npt.NDArray[np.uint8],
    world_from_camera: npt.NDArray[np.float64],
    intrinsics: Intrinsics,
) -> npt.NDArray[np.uint8]:
    """One pixel per point, point by point, with OpenCV's projection."""
    camera_from_world = np.linalg.inv(world_from_camera)
    image = np.full((intrinsics.height_px, intrinsics.width_px, 3), render.BACKGROUND_RGB, np.uint8)
    depth = np.full(image.shape[:2], np.inf)
    rotation = cv2.Rodrigues(camera_from_world[:3, :3])[0]
    pixels = cv2.projectPoints(points, rotation, camera_from_world[:3, 3], intrinsics.matrix(), np.zeros(4))[0][:, 0]
    z = points @ camera_from_world[2, :3] + camera_from_world[2, 3]
    for (u, v), distance, color in zip(pixels, z, colors, strict=True):
        if distance <= 1e-6:
            continue
        column, row = round(u), round(v)
        if 0 <= column < intrinsics.width_px and 0 <= row < intrinsics.height_px and distance < depth[row, column]:
            depth[row, column] = distance
            image[row, column] = color
    return image


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 400))
def test_camera_view_equals_a_loop_over_the_points(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 2.0, (count, 3)) + np.array([0.0, 0.0, 4.0])
    colors = rng.integers(0, 256, (count, 3), dtype=np.uint8)
    world_from_camera = se3.exp(rng.normal(0.0, 0.3, 6))
    intrinsics = Intrinsics.centred(30.0, 41, 23)
    image = render.camera_view(points, colors, world_from_camera, intrinsics, point_size=1e-6)
    np.testing.assert_array_equal(image, brute_force(points, colors, world_from_camera, intrinsics))


def test_near_points_cover_more_pixels_and_hide_far_ones() -> None:
    points = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0]])
    colors = np.array([[255, 0, 0], [0, 255, 0]], np.uint8)
    intrinsics = Intrinsics.centred(100.0, 41, 41)
    image = render.camera_view(points, colors, np.eye(4), intrinsics, point_size=0.06)
    assert (image == colors[0]).all(axis=2).sum() == 9  # 3 px at distance 2
    assert not (image == colors[1]).all(axis=2).any()
    assert (image[19:22, 19:22] == colors[0]).all()


def test_points_behind_the_camera_and_without_number_are_not_drawn() -> None:
    points = np.array([[0.0, 0.0, -2.0], [np.nan, 0.0, 2.0], [0.0, 0.0, np.inf]])
    image = render.camera_view(
        points, np.full((3, 3), 200, np.uint8), np.eye(4), Intrinsics.centred(50.0, 21, 21), 0.01
    )
    assert (image == render.BACKGROUND_RGB).all()


def test_plan_view_puts_the_highest_point_on_top_at_its_place() -> None:
    # x right, y down, z ahead; the picture spans 10 x 20 units at 10 px per unit.
    points = np.array([[2.55, 1.5, 5.05], [2.55, -3.0, 5.05], [7.05, 0.0, 19.95], [100.0, 0.0, 5.0]])
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 9, 9]], np.uint8)
    view = render.plan_view(np.tile(points, (2, 1)), np.tile(colors, (2, 1)), (0.0, 10.0, 0.0, 20.0), 100)
    assert view.image.shape == (200, 100, 3)
    assert tuple(view.image[149, 25]) == (0, 255, 0)
    assert tuple(view.image[0, 70]) == (0, 0, 255)
    open_view = render.plan_view(points, colors, (0.0, 10.0, 0.0, 20.0), 100, ceiling=-1.0)
    assert tuple(open_view.image[149, 25]) == (255, 0, 0)


def test_map_is_cropped_to_the_drive_and_not_to_the_horizon() -> None:
    rng = np.random.default_rng(3)
    near = rng.uniform([-8.0, 0.0, 0.0], [8.0, 2.0, 50.0], (5000, 3))
    far = rng.normal(0.0, 5000.0, (400, 3))
    points = np.concatenate([near, far])
    cloud = PointCloud(points, np.full(points.shape, 180, np.uint8))
    axes = map_plots.map_figure(cloud, one_part(straight(51)), "m").axes[0]
    left, right = sorted(axes.get_xlim())
    assert -20.0 < left <= 0.0 and 50.0 <= right < 70.0


def test_camera_view_figure_sets_the_recorded_frame_beside_the_map() -> None:
    cloud = PointCloud(np.array([[0.0, 0.0, 5.0]]), np.array([[255, 0, 0]], np.uint8))
    recorded = np.full((94, 310, 3), 77, np.uint8)
    view = CameraView(12, np.eye(4), Intrinsics.centred(300.0, 310, 94), recorded)
    first, second = map_plots.camera_view_figure(cloud, view).axes
    assert first.get_title(loc="left") == "recorded frame 12"
    np.testing.assert_array_equal(first.images[0].get_array(), recorded)
    drawn = np.argwhere((np.asarray(second.images[0].get_array()) == (255, 0, 0)).all(axis=2))
    np.testing.assert_allclose(drawn.mean(axis=0), [(291 - 1) / 2, (960 - 1) / 2], atol=1.0)


def test_points_are_drawn_as_large_as_the_voxels_that_made_them() -> None:
    point, color = np.array([[0.0, 0.0, 5.0]]), np.array([[255, 0, 0]], np.uint8)
    view = CameraView(0, np.eye(4), Intrinsics.centred(960.0, 960, 300))
    areas = []
    for size in (0.005, 0.026):  # 1 px and 5 px at that distance
        image = map_plots.camera_view_figure(PointCloud(point, color, 0, size), view).axes[0].images[0].get_array()
        areas.append(int((np.asarray(image) == color[0]).all(axis=2).sum()))
    assert areas == [1, 25]
