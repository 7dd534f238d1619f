"""What the report shows, gathered by the caller: records of the log and arrays of the final trajectory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.geometry.track import PoseTrack
from vggt_motion.records import Constraint, Event, GraphUpdate, JobReport, Segment, SubmapGeometry

MetricValue = float | int | str | bool | None
MetricTree = Mapping[str, "MetricValue | Sequence[MetricValue] | MetricTree"]


@dataclass(frozen=True)
class ComponentTrack:
    """Poses with the connected part of the pose graph that each belongs to; parts share no common frame."""

    track: PoseTrack
    components: npt.NDArray[np.int64]  # (N,): index of the first submap of the part
    doubtful: npt.NDArray[np.bool_] | None = None  # (N,): the pose comes from a submap that is not good; None = none is

    def __post_init__(self) -> None:
        if self.components.shape != (len(self.track),):
            raise ValueError(f"{self.components.shape} component ids for {len(self.track)} poses")

    def __len__(self) -> int:
        return len(self.track)

    def doubtful_part(self, component: int) -> PoseTrack | None:
        """The poses of a part that come from doubtful submaps; None if there are none."""
        if self.doubtful is None:
            return None
        chosen = np.flatnonzero(self.doubtful & (self.components == component))
        return self.track.subset(chosen) if len(chosen) else None

    def parts(self) -> tuple[tuple[int, PoseTrack], ...]:
        """(component id, its poses in time order), in order of the id."""
        return tuple(
            (int(component), self.track.subset(np.flatnonzero(self.components == component)))
            for component in np.unique(self.components)
        )


def empty_track() -> ComponentTrack:
    """A track without poses, where no trajectory could be made."""
    return ComponentTrack(PoseTrack(np.zeros(0, np.int64), np.zeros((0, 4, 4))), np.zeros(0, np.int64))


@dataclass(frozen=True)
class GroundTruth:
    """A reference trajectory in metres, and how each part of the estimate was aligned to it."""

    track: PoseTrack
    truth_from_component: Mapping[
        int, Sim3
    ]  # component id -> alignment; a part without one is not drawn over the truth


@dataclass(frozen=True)
class PointCloud:
    """Points of the map in the world of ``component``."""

    points: npt.NDArray[np.floating]  # (N, 3), world units
    colors: npt.NDArray[np.uint8]  # (N, 3) RGB
    component: int = 0
    point_size: float = 0.0  # edge of a point, world units (of the voxels that thinned the map); 0 = unknown

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3 or self.colors.shape != self.points.shape:
            raise ValueError(f"shapes do not fit: {self.points.shape} points, {self.colors.shape} colours")


@dataclass(frozen=True)
class CameraView:
    """A recorded camera from which the map is drawn, to be compared with what it saw."""

    frame_index: int
    world_from_camera: npt.NDArray[np.float64]  # (4, 4)
    intrinsics: Intrinsics
    image: npt.NDArray[np.uint8] | None = None  # (H, W, 3) RGB as recorded, of any size


@dataclass(frozen=True)
class MotionScores:
    """Smoothed scores behind the motion states, where the caller has them."""

    times_ns: npt.NDArray[np.int64]  # (N,)
    static_ratio: npt.NDArray[np.floating]  # (N,), in [0, 1]
    turning_px: npt.NDArray[np.floating]  # (N,), at the working width


@dataclass(frozen=True)
class ReportData:
    """Everything that the report of a run shows. Optional parts are left out of the page, and it says so."""

    source: str  # one line: kind, path, size
    created: str  # ISO 8601 time
    length_unit: str  # "m" for a metric or scaled trajectory, else "units"
    segments: tuple[Segment, ...]
    submaps: tuple[SubmapGeometry, ...]
    constraints: tuple[Constraint, ...]
    graph: GraphUpdate | None
    keyframes: ComponentTrack
    frames: ComponentTrack
    ground_truth: GroundTruth | None = None
    cloud: PointCloud | None = None
    camera_view: CameraView | None = None
    motion_scores: MotionScores | None = None
    metrics: MetricTree = field(default_factory=dict)  # as in metrics.json
    stage_seconds: Mapping[str, float] = field(default_factory=dict)  # wall time of the stages of the run
    events: tuple[Event, ...] = ()
    warnings: tuple[str, ...] = ()  # one line each; what events say already is not said twice
    dead_jobs: tuple[JobReport, ...] = ()
    min_inlier_ratio: float | None = None  # tau_in of the run, drawn as a line
    config_yaml: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
