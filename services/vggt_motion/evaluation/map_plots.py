"""The plots of the report about the map."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from vggt_motion.evaluation import render
from vggt_motion.evaluation.plot_style import (
    ORANGE,
    WIDTH_IN,
    Plan,
    finite,
    legend_above,
    mark_ends,
    panel_inches,
    styled,
)
from vggt_motion.evaluation.report_data import CameraView, ComponentTrack, PointCloud


@styled()
def map_figure(cloud: PointCloud, frames: ComponentTrack, length_unit: str) -> Figure:
    """The map from above with the trajectory drawn into it."""
    path = np.concatenate(
        [finite(track).positions for component, track in frames.parts() if component == cloud.component]
        or [np.zeros((0, 3))]
    )
    bounds = _map_bounds(cloud.points, path)
    plan = Plan(is_turned=bounds[3] - bounds[2] > 1.3 * (bounds[1] - bounds[0]))
    ceiling = _ceiling(cloud.points, path, bounds)
    width_px = (
        1000 if not plan.is_turned else int(np.clip(1000 * (bounds[1] - bounds[0]) / (bounds[3] - bounds[2]), 60, 1000))
    )
    view = render.plan_view(cloud.points, cloud.colors, bounds, width_px, ceiling)
    figure = Figure(layout="constrained")
    axes = figure.subplots()
    if plan.is_turned:
        # z to the right and x down: rows of the picture become columns, from near to far.
        axes.imshow(
            view.image[::-1].transpose(1, 0, 2),
            extent=(bounds[2], bounds[3], bounds[1], bounds[0]),
            interpolation="antialiased",
        )
        ratio = (bounds[1] - bounds[0]) / (bounds[3] - bounds[2])
    else:
        axes.imshow(view.image, extent=bounds, interpolation="antialiased")
        ratio = (bounds[3] - bounds[2]) / (bounds[1] - bounds[0])
    if len(path):
        axes.plot(plan.horizontal(path), plan.vertical(path), "-", color=ORANGE, lw=1.6, label="trajectory")
        mark_ends(axes, plan, path, is_labelled=True)
        legend_above(axes)
    axes.grid(False)
    plan.label(axes, length_unit)
    figure.set_size_inches(WIDTH_IN, panel_inches(ratio, WIDTH_IN - 0.9) + 0.7)
    return figure


def _map_bounds(points: npt.NDArray[np.floating], path: npt.NDArray[np.floating]) -> tuple[float, float, float, float]:
    """x_min, x_max, z_min, z_max: the drive and what lies beside it; the few points at the horizon must not rule."""
    plane = np.asarray(points[:, [0, 2]], np.float64)
    plane = plane[np.isfinite(plane).all(axis=1)]
    low, high = np.percentile(plane, [1.0, 99.0], axis=0) if len(plane) else (np.full(2, -1.0), np.full(2, 1.0))
    if len(path):
        inner_low, inner_high = path[:, [0, 2]].min(axis=0), path[:, [0, 2]].max(axis=0)
        margin = 0.3 * max(float((inner_high - inner_low).max()), 1e-6)
        low = np.minimum(np.maximum(low, inner_low - margin), inner_low - 0.05 * margin)
        high = np.maximum(np.minimum(high, inner_high + margin), inner_high + 0.05 * margin)
    high = np.maximum(high, low + 1e-3 * max(float((high - low).max()), 1e-3))
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _ceiling(
    points: npt.NDArray[np.floating], path: npt.NDArray[np.floating], bounds: tuple[float, float, float, float]
) -> float | None:
    """Height (y) above which the map is cut open, lest bridges and tree tops hide the road; None without a path."""
    if not len(path):
        return None
    y = np.asarray(points[:, 1], np.float64)
    y = y[np.isfinite(y)]
    below = y[y > float(path[:, 1].max())]
    if not len(below):
        return None
    camera_height = float(np.percentile(below, 90)) - float(np.median(path[:, 1]))
    return float(path[:, 1].min()) - 2.0 * max(camera_height, 0.0)


@styled()
def camera_view_figure(cloud: PointCloud, view: CameraView) -> Figure:
    """The map as one camera sees it, beside what it recorded."""
    target_width = 960
    scale = target_width / view.intrinsics.width_px
    intrinsics = view.intrinsics.resized(target_width, max(1, round(view.intrinsics.height_px * scale)))
    picture = render.camera_view(
        cloud.points, cloud.colors, view.world_from_camera, intrinsics, _point_size(cloud, view)
    )
    pictures = [("map, drawn from the camera", picture)]
    if view.image is not None:
        pictures.insert(0, (f"recorded frame {view.frame_index}", view.image))
    ratio = intrinsics.height_px / intrinsics.width_px
    is_wide = ratio < 0.5
    rows, columns = (len(pictures), 1) if is_wide else (1, len(pictures))
    width = WIDTH_IN / columns
    figure = Figure(figsize=(WIDTH_IN, rows * (ratio * width + 0.32)), layout="constrained")
    for axes, (title, pixels) in zip(figure.subplots(rows, columns, squeeze=False).flat, pictures, strict=True):
        axes.imshow(pixels, interpolation="antialiased")
        axes.set_title(title)
        axes.set_axis_off()
    return figure


def _point_size(cloud: PointCloud, view: CameraView) -> float:
    """Edge of a point in world units; where unknown, a pixel and a half at the median distance of what is seen."""
    if cloud.point_size > 0.0:
        return cloud.point_size
    offset = np.asarray(cloud.points, np.float64) - view.world_from_camera[:3, 3]
    depth = offset @ view.world_from_camera[:3, 2]
    seen = depth[np.isfinite(depth) & (depth > 0)]
    return 1.5 * float(np.median(seen)) / view.intrinsics.fx if len(seen) else 1e-3
