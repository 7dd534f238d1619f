"""What a run leaves in its folder: trajectories, map, report, metrics."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import math
import os
import platform
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from vggt_motion import __version__
from vggt_motion.backend import focal, posegraph
from vggt_motion.backend.planner import current_constraints, undecided_joints
from vggt_motion.backend.session_map import build_session_map, main_component
from vggt_motion.backend.state import LogState
from vggt_motion.backend.trajectory import NO_COMPONENT, PoseOrigin, Trajectory, TrajectoryPose, compose
from vggt_motion.config import Config
from vggt_motion.disk import NO_SPACE
from vggt_motion.errors import CodecError, DiskFullError, InputError
from vggt_motion.evaluation import metrics as evaluation
from vggt_motion.evaluation.report import write_report
from vggt_motion.evaluation.report_data import (
    CameraView,
    ComponentTrack,
    GroundTruth,
    PointCloud,
    ReportData,
    empty_track,
)
from vggt_motion.evaluation.summary import error_table, is_kitti
from vggt_motion.evaluation.trajectory_io import read_kitti, read_tum, to_csv, to_kitti, to_tum
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.geometry.track import PoseTrack
from vggt_motion.records import BlobRef, EventKind, GraphUpdate, JobReport, SubmapGeometry, SubmapVerdict
from vggt_motion.sources.encoded import decode_rgb

METRICS_FILE = "metrics.json"
_MIN_ALIGNED_POSES = 3
_PACKAGES = ("eclipse-zenoh", "opencv-python-headless", "pycolmap", "gtsam", "numpy", "protobuf", "mcap")


@dataclass(frozen=True)
class RunFacts:
    """What the results need to know of a run beside its log."""

    source: str
    exit_code: int
    interrupted: bool
    wall_seconds: float
    start_up_seconds: float
    restart_count: int
    predictor: str = ""
    predictor_reason: str = ""
    first_frame: int = 0  # of the source, with --start and --stride: which line of the ground truth frame n belongs to
    stride: int = 1
    dead_jobs: tuple[JobReport, ...] = ()
    missing_frame_count: int = 0  # in the recording


def read_ground_truth(path: Path) -> PoseTrack | list[PoseTrack]:
    """Read a reference trajectory: KITTI (twelve numbers a line) or TUM (eight).

    Returns:
        A track with times for TUM; for KITTI, which has none, a list with the one track, to be matched by frame index.

    Raises:
        InputError: the file cannot be read or is of neither form.
    """
    return [read_kitti(path)] if is_kitti(path) else read_tum(path)


def write_results(
    out: Path,
    state: LogState,
    config: Config,
    facts: RunFacts,
    load_blob: Callable[[BlobRef], bytes],
    ground_truth: PoseTrack | list[PoseTrack] | None,
) -> dict[str, Any]:
    """Compose the trajectory and write every file of the folder; ``metrics.json`` comes last, complete or not at all.

    Args:
        out: folder, which exists.
        state: the log, folded.
        config: the effective configuration.
        facts: of the run.
        load_blob: fetches a payload.
        ground_truth: as :func:`read_ground_truth` returned it.

    Returns:
        The content of ``metrics.json``.

    Raises:
        InputError: a file cannot be written.
        DiskFullError: there is no space for it; may be repeated.
    """
    _catch_up(state, config)
    graph = state.latest_graph() or GraphUpdate(0, False, (), ())
    submaps = state.usable_submaps()
    segments = tuple(state.segments[index] for index in sorted(state.segments))
    trajectory = compose(
        list(state.keyframes.values()), segments, submaps, graph, known_distance_m=config.backend.known_distance_m
    )
    has_metres = state.is_metric or config.backend.known_distance_m is not None
    component = main_component(trajectory)
    cloud = None
    if component != NO_COMPONENT and graph.poses:
        cloud = build_session_map(state.keyframes, submaps, graph, trajectory, config.backend, load_blob)
    reference = _reference_of(trajectory, ground_truth, facts)
    metrics = _metrics(state, trajectory, facts, component, has_metres=has_metres)
    truth = None
    if reference is not None:
        metrics["ground_truth"] = _errors(trajectory, reference, component)
        truth = GroundTruth(reference, _alignments(trajectory, reference))
    data = ReportData(
        source=facts.source,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        length_unit="m" if has_metres else "units",
        segments=segments,
        submaps=tuple(state.submaps[key] for key in sorted(state.submaps)),
        constraints=tuple(constraint for _, constraint in sorted(state.constraints.items())),
        graph=state.latest_graph(),
        keyframes=_component_track(trajectory.keyframes),
        frames=_component_track(trajectory.frames),
        ground_truth=truth,
        cloud=None if cloud is None else PointCloud(cloud.points, cloud.colors, component, cloud.voxel),
        camera_view=_camera_view(state, trajectory, component, load_blob),
        metrics=metrics,
        warnings=tuple(metrics["warnings"]),
        stage_seconds=_stage_seconds(state, facts),
        events=tuple(state.events.values()),
        dead_jobs=facts.dead_jobs,
        min_inlier_ratio=config.registration.min_inlier_ratio,
        config_yaml=config.to_yaml(),
        versions=_versions(),
    )
    try:
        _write(out / "trajectory_keyframes.tum", to_tum(trajectory.track("key")))
        _write(out / "trajectory_frames.tum", to_tum(trajectory.track("all")))
        _write(out / "trajectory_frames.kitti", to_kitti(trajectory.track("all")))
        _write(out / "trajectory_frames.csv", to_csv(trajectory))
        if cloud is not None:
            cloud.write_ply(out / "map.ply")
        write_report(out, data)
        _write(out / METRICS_FILE, json.dumps(_finite(metrics), indent=2) + "\n")
    except OSError as error:
        kind = DiskFullError if error.errno in NO_SPACE else InputError
        raise kind(f"cannot write results to {out}: {error.strerror or error}") from error
    return metrics


def _catch_up(state: LogState, config: Config) -> None:
    """Solve what came after the newest graph, where a run was ended before the backend did."""
    graph = state.latest_graph()
    inputs = state.graph_input_count
    nodes = [(index, geometry.spec.revision) for index, geometry in state.usable_submaps().items()]
    if not nodes or (graph is not None and (graph.is_final or graph.revision >= inputs)):
        return
    state.apply(
        posegraph.solve(
            nodes,
            current_constraints(state),
            config.backend,
            revision=inputs,
            is_final=False,
            is_metric=state.is_metric,
            undecided=undecided_joints(state, config),
        )
    )


def _write(path: Path, text: str) -> None:
    partial = path.with_name(path.name + ".part")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)  # noqa: PTH105 - replaces atomically on every system


def _finite(value: Any) -> Any:
    """JSON has no NaN: what is not known is null."""
    if isinstance(value, Mapping):
        return {name: _finite(item) for name, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _component_track(frames: tuple[TrajectoryPose, ...]) -> ComponentTrack:
    posed = [frame for frame in frames if frame.world_from_camera is not None]
    if not posed:
        return empty_track()
    track = PoseTrack(
        np.array([frame.capture_time_ns for frame in posed], dtype=np.int64),
        np.array([frame.world_from_camera for frame in posed], dtype=np.float64),
    )
    doubtful = [frame.verdict not in (None, SubmapVerdict.GOOD) for frame in posed]
    return ComponentTrack(track, np.array([frame.component for frame in posed], dtype=np.int64), np.array(doubtful))


def _camera_view(
    state: LogState, trajectory: Trajectory, component: int, load_blob: Callable[[BlobRef], bytes]
) -> CameraView | None:
    """The middle keyframe of the main part: the report draws the map as this camera saw it."""
    submaps = state.usable_submaps()
    chosen = [frame for frame in trajectory.keyframes if frame.component == component]
    for frame in chosen[len(chosen) // 2 :]:
        keyframe_id = f"{frame.camera}/{frame.epoch}/{frame.frame_index:08d}"
        geometry = next((found for s in submaps.values() if (found := s.frame(keyframe_id)) is not None), None)
        if geometry is None or frame.world_from_camera is None:
            continue
        pixels = None
        with contextlib.suppress(CodecError):
            pixels = decode_rgb(load_blob(state.keyframes[keyframe_id].image))
        return CameraView(frame.frame_index, frame.world_from_camera, geometry.intrinsics, pixels)
    return None


def _reference_of(
    trajectory: Trajectory, ground_truth: PoseTrack | list[PoseTrack] | None, facts: RunFacts
) -> PoseTrack | None:
    """The ground truth with the capture times of our frames, where it has none of its own."""
    if ground_truth is None or isinstance(ground_truth, PoseTrack):
        return ground_truth
    poses = ground_truth[0].world_from_camera
    lines = [facts.first_frame + frame.frame_index * facts.stride for frame in trajectory.frames]
    pairs = [
        (frame.capture_time_ns, line) for frame, line in zip(trajectory.frames, lines, strict=True) if line < len(poses)
    ]
    times = np.array([time for time, _ in pairs], dtype=np.int64)
    return PoseTrack(times, poses[np.array([line for _, line in pairs], dtype=np.intp)])


def _median_focal(submaps: Iterable[SubmapGeometry]) -> float | None:
    """What the submaps used where none of them claims to know it: a given focal length, or those of a network."""
    used = [submap.quality.focal_over_width for submap in submaps if submap.quality.focal_over_width > 0.0]
    return float(np.median(used)) if used else None


def _alignments(trajectory: Trajectory, reference: PoseTrack) -> dict[int, Sim3]:
    aligned = {}
    for component in trajectory.components:
        try:
            errors = evaluation.evaluate(reference, trajectory.track("all", component))
        except InputError:
            continue
        if errors.matched_count >= _MIN_ALIGNED_POSES:
            aligned[component] = errors.ate_sim3.reference_from_estimate
    return aligned


def _errors(trajectory: Trajectory, reference: PoseTrack, component: int) -> dict[str, Any]:
    """Errors of the main part; how much of the drive that is stands beside them."""
    try:
        frames = evaluation.evaluate(reference, trajectory.track("all", component))
        keyframes = evaluation.evaluate(reference, trajectory.track("key", component))
    except InputError as error:
        return {"not_evaluated": str(error)}
    return {
        **error_table(frames),
        "ate_rmse_keyframes_m": keyframes.ate_sim3.position_m.rmse,
        "reference_pose_count": len(reference),
    }


def _metrics(
    state: LogState, trajectory: Trajectory, facts: RunFacts, component: int, *, has_metres: bool
) -> dict[str, Any]:
    submaps = state.usable_submaps()
    verdicts = Counter(_verdicts(state).values())
    constraints = state.constraints.values()
    graph = state.latest_graph()
    ended = state.stream_ended
    hint = focal.fold(
        geometry.quality for (_, revision), geometry in sorted(state.submaps.items()) if revision == 1
    ).hint()
    states = Counter(frame.state.name.lower() for frame in trajectory.frames)
    unit = "m" if has_metres else "units"
    return {
        "version": __version__,
        "source": facts.source,
        "predictor": facts.predictor,
        "predictor_reason": facts.predictor_reason,
        "exit_code": facts.exit_code if facts.interrupted or _has_pose(trajectory) else InputError.exit_code,
        "is_complete": graph is not None and graph.is_final and not facts.interrupted,
        "truncated": ended.detail.get("truncated", "") if ended is not None else "",
        "frame_count": len(trajectory.frames),
        "keyframe_count": len(state.keyframes),
        "segment_count": len(state.segments),
        "submap_count": len(submaps),
        "submaps": {verdict.value: verdicts[verdict] for verdict in SubmapVerdict if verdicts[verdict]},
        "accepted_constraint_count": sum(constraint.accepted for constraint in constraints),
        "refused_constraint_count": sum(not constraint.accepted for constraint in constraints),
        "dead_job_count": len(state.dead_jobs),
        "component_count": len(trajectory.components),
        "main_component": component,
        "break_count": len(graph.breaks) if graph is not None else 0,
        f"path_length_{unit}": trajectory.path_length(),
        "pose_origins": {origin.value: count for origin, count in sorted(trajectory.origin_counts().items())},
        "motion_states": dict(sorted(states.items())),
        "focal_over_width": hint.focal_over_width if hint is not None else _median_focal(submaps.values()),
        "focal_relative_sigma": hint.relative_sigma if hint is not None else None,
        "video_seconds": _video_seconds(trajectory),
        "wall_seconds": facts.wall_seconds,
        "start_up_seconds": facts.start_up_seconds,
        "stage_seconds": _stage_seconds(state, facts),
        "restart_count": facts.restart_count,
        "warnings": warnings(state, trajectory, facts.missing_frame_count),
    }


def _video_seconds(trajectory: Trajectory) -> float:
    """From the first capture to the last."""
    times = [frame.capture_time_ns for frame in trajectory.frames]
    return (max(times) - min(times)) / 1e9 if times else 0.0


def _verdicts(state: LogState) -> dict[int, SubmapVerdict]:
    """Of each submap, the verdict on the revision that the trajectory uses, or on the last one where none is usable."""
    last = {index: state.submaps[index, revision].verdict for index, revision in sorted(state.submaps)}
    return last | {index: geometry.verdict for index, geometry in state.usable_submaps().items()}


def _has_pose(trajectory: Trajectory) -> bool:
    return any(frame.world_from_camera is not None for frame in trajectory.frames)


def warnings(state: LogState, trajectory: Trajectory, missing_frame_count: int = 0) -> list[str]:
    """What a person should know before trusting the result, one line each."""
    lines = [event.message for event in state.events.values() if event.kind is EventKind.WARNING]
    ended = state.stream_ended
    if ended is not None and ended.detail.get("truncated"):
        lines.append(f"the input ended early: {ended.detail['truncated']}")
    if len(trajectory.track("all")) > 1 and trajectory.path_length() == 0.0:
        lines.append("the camera did not move, or nothing shows that it did: all poses are the same")
    graph = state.latest_graph()
    lines.extend(graph.breaks if graph is not None else ())
    for index, verdict in _verdicts(state).items():
        if verdict is not SubmapVerdict.GOOD:
            used = state.submap(index)
            reasons = [g.reason for (k, _), g in sorted(state.submaps.items()) if k == index and g.reason]
            reasons += [used.reason] if used is not None and used.reason else []
            lines.append(
                f"submap {index} is {verdict.value.replace('_', ' ')}" + (f": {reasons[-1]}" if reasons else "")
            )
    lines.extend(f"job {job_id} was given up: {event.message}" for job_id, event in sorted(state.dead_jobs.items()))
    missing = sum(frame.world_from_camera is None for frame in trajectory.frames)
    if missing:
        lines.append(f"{missing} of {len(trajectory.frames)} frames have no pose")
    held = trajectory.origin_counts().get(PoseOrigin.HELD, 0)
    if held:
        lines.append(f"{held} of {len(trajectory.frames)} frames hold the pose of the nearest keyframe that has one")
    if missing_frame_count:
        lines.append(
            f"the recording lacks {missing_frame_count} frames, which went by while no recorder was there; "
            "a run of the recording gives another trajectory"
        )
    return lines


def _stage_seconds(state: LogState, facts: RunFacts) -> dict[str, float]:
    totals: dict[str, float] = defaultdict(float)
    for geometry in state.submaps.values():
        for stage, seconds in geometry.stage_seconds.items():
            totals[stage.removesuffix("_s").replace("_", " ")] += seconds
    slowest_first = sorted(totals.items(), key=lambda item: -item[1])
    stages = {f"prediction: {name}": seconds for name, seconds in slowest_first}
    return {"start-up": facts.start_up_seconds, "whole run": facts.wall_seconds, **stages}


def _versions() -> dict[str, str]:
    found = {"vggt-motion": __version__, "Python": platform.python_version(), "platform": platform.platform()}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found
