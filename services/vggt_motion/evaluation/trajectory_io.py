"""Trajectory files: TUM and KITTI (poses only), CSV and JSON (every frame, with what is known of it).

All hold ``world_from_camera``, OpenCV camera axes. TUM: ``time tx ty tz qx qy qz qw`` a line, seconds. KITTI: the upper
(3, 4) part of the matrix, row by row, one line a frame, no times.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np

from vggt_motion.backend.trajectory import PoseOrigin, Trajectory, TrajectoryPose
from vggt_motion.errors import InputError
from vggt_motion.geometry import se3
from vggt_motion.geometry.track import PoseTrack
from vggt_motion.records import MotionState, SubmapVerdict

_NS = 1_000_000_000
_JSON_SCHEMA = "vggt_motion.trajectory/1"
_CSV_COLUMNS = (
    *("camera", "epoch", "frame_index", "capture_time_ns", "state", "is_keyframe", "origin", "component"),
    *("tx", "ty", "tz", "qx", "qy", "qz", "qw", "submap_verdict"),
)
_ORTHONORMAL_TOLERANCE = 1e-2  # KITTI files are often written with six digits


def to_tum(track: PoseTrack) -> str:
    """The poses as TUM lines; times to the nanosecond."""
    lines = []
    for time_ns, pose in zip(track.times_ns.tolist(), track.world_from_camera, strict=True):
        lines.append(" ".join([_seconds(time_ns), *(f"{value:.9g}" for value in _translation_quaternion(pose))]))
    return "".join(line + "\n" for line in lines)


def to_kitti(track: PoseTrack) -> str:
    """The poses as KITTI lines."""
    return "".join(" ".join(f"{value:.9e}" for value in pose[:3].ravel()) + "\n" for pose in track.world_from_camera)


def to_csv(trajectory: Trajectory) -> str:
    """Every frame as a line of CSV under a header; a frame without a pose has empty cells."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_CSV_COLUMNS)
    for frame in trajectory.frames:
        pose = frame.world_from_camera
        cells = [""] * 7 if pose is None else [f"{value:.9g}" for value in _translation_quaternion(pose)]
        writer.writerow(
            [
                *(frame.camera, frame.epoch, frame.frame_index, frame.capture_time_ns, frame.state.value),
                *(int(frame.is_keyframe), frame.origin.value, frame.component),
                *cells,
                frame.verdict.value if frame.verdict is not None else "",
            ]
        )
    return out.getvalue()


def to_json(trajectory: Trajectory) -> str:
    """Every frame as JSON; a frame without a pose has ``world_from_camera`` null."""
    return json.dumps(
        {
            "schema": _JSON_SCHEMA,
            "graph_revision": trajectory.graph_revision,
            "is_final": trajectory.is_final,
            "scale": trajectory.scale,
            "frames": [
                {
                    "camera": frame.camera,
                    "epoch": frame.epoch,
                    "frame_index": frame.frame_index,
                    "capture_time_ns": frame.capture_time_ns,
                    "state": frame.state.value,
                    "is_keyframe": frame.is_keyframe,
                    "origin": frame.origin.value,
                    "component": frame.component,
                    "submap_verdict": frame.verdict.value if frame.verdict is not None else None,
                    "world_from_camera": None
                    if frame.world_from_camera is None
                    else frame.world_from_camera[:3].tolist(),
                }
                for frame in trajectory.frames
            ],
        },
        allow_nan=False,
    )


def read_tum(path: Path) -> PoseTrack:
    """Read a TUM file; empty lines and lines that begin with ``#`` are passed over.

    Raises:
        InputError: the file cannot be read or a line is not eight finite numbers.
    """
    times, poses = [], []
    for number, line in _lines(path):
        fields = line.replace(",", " ").split()
        values = _numbers(path, number, fields, 8)
        try:
            times.append(int((Decimal(fields[0]) * _NS).to_integral_value()))
        except InvalidOperation as error:
            raise InputError(f"{path}:{number}: the time is not a number") from error
        x, y, z, w = values[4:]
        if x * x + y * y + z * z + w * w < 1e-12:
            raise InputError(f"{path}:{number}: the quaternion is zero")
        poses.append(se3.make(se3.rotation_from_quaternion(np.array([w, x, y, z])), np.array(values[1:4])))
    return _track(path, times, poses)


def read_kitti(path: Path, times: Path | None = None) -> PoseTrack:
    """Read a KITTI pose file.

    Args:
        path: one line of twelve numbers a frame.
        times: file with one time in seconds per line; without it frame n has the time n seconds.

    Raises:
        InputError: a file cannot be read, a line is malformed, a rotation is none, or the numbers of lines differ.
    """
    poses = []
    for number, line in _lines(path):
        values = _numbers(path, number, line.split(), 12)
        pose = np.eye(4)
        pose[:3] = np.array(values).reshape(3, 4)
        if not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=_ORTHONORMAL_TOLERANCE):
            raise InputError(f"{path}:{number}: the first three columns are not a rotation")
        pose[:3, :3] = se3.nearest_rotation(pose[:3, :3])
        poses.append(pose)
    if times is None:
        return _track(path, [n * _NS for n in range(len(poses))], poses)
    stamps = [round(_numbers(times, number, line.split(), 1)[0] * _NS) for number, line in _lines(times)]
    if len(stamps) != len(poses):
        raise InputError(f"{path} has {len(poses)} poses, {times} has {len(stamps)} times")
    return _track(path, stamps, poses)


def read_csv(path: Path) -> tuple[TrajectoryPose, ...]:
    """Read what :func:`to_csv` wrote.

    Raises:
        InputError: the file cannot be read or a line is malformed.
    """
    rows = list(csv.reader(io.StringIO(_text(path))))
    if not rows or tuple(rows[0]) != _CSV_COLUMNS:
        raise InputError(f"{path}: the first line must be {','.join(_CSV_COLUMNS)}")
    frames = []
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(_CSV_COLUMNS):
            raise InputError(f"{path}:{number}: {len(row)} cells instead of {len(_CSV_COLUMNS)}")
        pose = None
        if any(row[8:15]):
            tx, ty, tz, x, y, z, w = _numbers(path, number, row[8:15], 7)
            pose = se3.make(se3.rotation_from_quaternion(np.array([w, x, y, z])), np.array([tx, ty, tz]))
        try:
            camera, epoch, index, time_ns, state, is_key, origin, component = row[:8]
            frames.append(
                TrajectoryPose(
                    *(camera, int(epoch), int(index), int(time_ns), MotionState(state), bool(int(is_key))),
                    *(PoseOrigin(origin), int(component), pose),
                    SubmapVerdict(row[15]) if row[15] else None,
                )
            )
        except ValueError as error:
            raise InputError(f"{path}:{number}: {error}") from error
    return tuple(frames)


def read_json(path: Path) -> Trajectory:
    """Read what :func:`to_json` wrote.

    Raises:
        InputError: the file cannot be read or is not of that form.
    """
    try:
        data = json.loads(_text(path))
        if data["schema"] != _JSON_SCHEMA:
            raise InputError(f"{path}: schema {data['schema']!r} is not {_JSON_SCHEMA!r}")
        frames = tuple(_frame_of(entry) for entry in data["frames"])
        return Trajectory(int(data["graph_revision"]), bool(data["is_final"]), frames, float(data["scale"]))
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path} is not a trajectory: {' '.join(str(error).split())}") from error


def _frame_of(entry: dict[str, Any]) -> TrajectoryPose:
    pose = None
    if entry["world_from_camera"] is not None:
        pose = np.eye(4)
        pose[:3] = np.asarray(entry["world_from_camera"], dtype=np.float64).reshape(3, 4)
        if not np.isfinite(pose).all():
            raise ValueError("a pose is not finite")
    return TrajectoryPose(
        *(str(entry["camera"]), int(entry["epoch"]), int(entry["frame_index"]), int(entry["capture_time_ns"])),
        *(MotionState(entry["state"]), bool(entry["is_keyframe"]), PoseOrigin(entry["origin"])),
        *(int(entry["component"]), pose),
        SubmapVerdict(entry["submap_verdict"]) if entry["submap_verdict"] is not None else None,
    )


def _seconds(time_ns: int) -> str:
    sign = "-" if time_ns < 0 else ""
    return f"{sign}{abs(time_ns) // _NS}.{abs(time_ns) % _NS:09d}"


def _translation_quaternion(pose: np.ndarray[Any, np.dtype[np.float64]]) -> list[float]:
    w, x, y, z = se3.quaternion_from_rotation(pose[:3, :3]).tolist()
    return [*pose[:3, 3].tolist(), x, y, z, w]


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text") from error


def _lines(path: Path) -> list[tuple[int, str]]:
    lines = ((number, line.strip()) for number, line in enumerate(_text(path).splitlines(), start=1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def _numbers(path: Path, number: int, fields: Sequence[str], count: int) -> list[float]:
    try:
        values = [float(field) for field in fields]
    except ValueError as error:
        raise InputError(f"{path}:{number}: {error}") from error
    if len(values) != count or not all(map(math.isfinite, values)):
        raise InputError(f"{path}:{number}: {count} finite numbers are needed")
    return values


def _track(path: Path, times: list[int], poses: list[np.ndarray[Any, np.dtype[np.float64]]]) -> PoseTrack:
    if not poses:
        raise InputError(f"{path} holds no pose")
    return PoseTrack(np.array(times, dtype=np.int64), np.array(poses))
