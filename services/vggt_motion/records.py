"""The records of the log and the payloads of jobs, as frozen dataclasses: what the stages hand to one another.

Each mirrors a message of ``proto/vggt_motion/v1`` (the only definition of the wire format); ``bus/codec.py`` is the one
place that converts. Records carry references to blobs, never arrays. Identifiers are made here and nowhere else,
so that a restarted stage finds again what it did before.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.geometry.sim3 import Sim3

SUBMAPS_PER_SEGMENT = 2  # one, or two halves


class Stream(StrEnum):
    """The streams of the log (DESIGN section 4)."""

    KEYFRAME = "keyframe"
    SEGMENT = "segment"
    DESCRIPTOR = "descriptor"
    SUBMAP = "submap"
    CONSTRAINT = "constraint"
    GRAPH = "graph"
    EVENT = "event"


class MotionState(StrEnum):
    """Motion state of a frame (paper eq. 3): standing, turning or straight driving."""

    STATIC = "S"
    TURNING = "T"
    LINEAR = "L"


class DropReason(StrEnum):
    """Why an input frame is not a keyframe."""

    STATIC = "static"  # inside a static interval
    LOW_PARALLAX = "low_parallax"  # too close to the last keyframe
    STRATEGY = "strategy"  # uniform sampling and the like passed it over


@dataclass(frozen=True)
class BlobRef:
    """Reference to a payload in the ledger's blob store, addressed by its content."""

    sha256: str  # 64 lower-case hexadecimal digits
    size_bytes: int
    media_type: str  # "image/jpeg", "image/png", "application/vnd.vggt-motion.depth"


@dataclass(frozen=True)
class Keyframe:
    """One keyframe. Its image blob holds exactly the bytes that the frontend decoded."""

    camera: str
    epoch: int  # a restarted live camera begins a new epoch
    frame_index: int
    capture_time_ns: int
    state: MotionState
    width_px: int
    height_px: int
    image: BlobRef
    zero_motion_copy_of: str | None = None  # id of the keyframe at the other end of the stop; shares its pose

    @property
    def keyframe_id(self) -> str:
        """``camera/epoch/frame index``, sortable as text within an epoch."""
        return keyframe_id(self.camera, self.epoch, self.frame_index)


@dataclass(frozen=True)
class FrameEntry:
    """One input frame in a segment's list, used or not."""

    frame_index: int
    capture_time_ns: int
    state: MotionState
    is_keyframe: bool
    drop_reason: DropReason | None = None


@dataclass(frozen=True)
class Segment:
    """Base segment R_k with its overlap O_k (paper section 3.1), closed by the frontend.

    ``frames`` lists every input frame after the last frame of segment k-1 up to the last one of this segment.
    """

    index: int
    camera: str
    epoch: int
    base_keyframe_ids: tuple[str, ...]  # R_k, in time order
    overlap_keyframe_ids: tuple[str, ...]  # O_k: the last min(N_ovlp, |R_(k-1)|) keyframes of R_(k-1), in time order
    frames: tuple[FrameEntry, ...]
    closed_by: str  # "budget", "turn_end", "turn_cap", "stream_end", or the name of another strategy's rule
    ego_mask: BlobRef | None = None  # PNG, non-zero = part of the vehicle or of an overlay, never to be used

    @property
    def record_id(self) -> str:
        """Identity in the log."""
        return segment_id(self.index)


@dataclass(frozen=True)
class FocalHint:
    """Running estimate of the camera, the fold of earlier submaps' results in index order (DESIGN 3.4)."""

    focal_over_width: float  # focal length divided by the image width
    relative_sigma: float  # its standard deviation, relative
    radial_k1: float = 0.0
    is_fixed: bool = False  # given by the user: not to be replaced by an estimate
    # Of the images as recorded, where the user gave all of them; refined within the accuracy of a calibration.
    intrinsics: Intrinsics | None = None
    radial_shape: float = 0.0  # k2 as a multiple of k1 squared


class SubmapPart(StrEnum):
    """Which half of a segment's base a submap holds, where the whole could not be predicted."""

    FIRST_HALF = "first_half"
    SECOND_HALF = "second_half"


@dataclass(frozen=True)
class SubmapSpec:
    """Composed submap M_k = O_k, R_k, L_k (paper eq. 4)."""

    submap_index: int  # orders the submaps along the drive, see :func:`submap_index`
    revision: int  # 1, or 2 when predicted again with a settled focal length
    overlap_keyframe_ids: tuple[str, ...]
    base_keyframe_ids: tuple[str, ...]
    loop_keyframe_ids: tuple[str, ...] = ()
    zero_motion_copies: tuple[tuple[str, str], ...] = ()  # (copy, original), both of this submap
    focal_hint: FocalHint | None = None
    ego_mask: BlobRef | None = None
    part: SubmapPart | None = None  # None = the whole base of its segment

    @property
    def keyframe_ids(self) -> tuple[str, ...]:
        """All keyframes in the order of the submap: overlap, base, loop."""
        return self.overlap_keyframe_ids + self.base_keyframe_ids + self.loop_keyframe_ids


@dataclass(frozen=True)
class PredictTask:
    """Payload of a predict job: everything that a worker without memory needs."""

    spec: SubmapSpec
    keyframes: tuple[Keyframe, ...]  # in the order of ``spec.keyframe_ids``


class ScaleKind(StrEnum):
    """Whether a submap's unit is arbitrary or metres."""

    RELATIVE = "relative"
    METRIC = "metric"


class SubmapVerdict(StrEnum):
    """What a predictor says of its own result."""

    GOOD = "good"
    LOW_QUALITY = "low_quality"  # usable, but to be shown as doubtful
    ROTATION_ONLY = "rotation_only"  # no parallax: rotations hold, translations are zero, there is no scale
    FAILED = "failed"  # no geometry; frames is empty and reason says why


class DepthCodec(StrEnum):
    """How a depth blob is encoded; the enum is the wire's."""

    F16_SHUFFLE_ZSTD = "f16_shuffle_zstd"  # float16 depth byte-shuffled, then uint8 confidence, zstd


@dataclass(frozen=True)
class FrameGeometry:
    """Geometry of one keyframe in its submap; depth and confidence are in the blob."""

    keyframe_id: str
    intrinsics: Intrinsics  # of the depth lattice, ``width_px`` x ``height_px``
    submap_from_camera: npt.NDArray[np.float64]  # (4, 4), submap units
    depth: BlobRef
    codec: DepthCodec = DepthCodec.F16_SHUFFLE_ZSTD


@dataclass(frozen=True)
class SubmapQuality:
    """How far a predicted submap can be trusted; NaN where a predictor cannot tell."""

    registered_frame_count: int
    mean_reprojection_error_px: float
    track_inlier_ratio: float
    median_parallax_deg: float
    focal_over_width: float  # of the image width, as solved or held
    focal_relative_sigma: float  # how well this submap alone sees it; inf where it was held
    radial_k1: float = 0.0
    attempts: tuple[str, ...] = ()  # every way that was tried, in order, with its outcome
    radial_shape: float = 0.0  # k2 as a multiple of k1 squared


@dataclass(frozen=True)
class SubmapGeometry:
    """Result of a predict job: the record of the submap stream (paper eq. 5)."""

    spec: SubmapSpec
    verdict: SubmapVerdict
    reason: str  # one line; empty when good
    scale_kind: ScaleKind
    model: str
    frames: tuple[FrameGeometry, ...]
    quality: SubmapQuality
    stage_seconds: dict[str, float] = field(default_factory=dict)  # informative only, not part of the identity

    @property
    def record_id(self) -> str:
        """Identity in the log."""
        return submap_id(self.spec.submap_index, self.spec.revision, self.spec.part)

    def frame(self, keyframe_id: str) -> FrameGeometry | None:
        """The geometry of one keyframe, or None where the predictor did not register it."""
        return next((frame for frame in self.frames if frame.keyframe_id == keyframe_id), None)


class ConstraintKind(StrEnum):
    """Where a constraint's shared frames come from."""

    ADJACENT = "adjacent"
    LOOP = "loop"


@dataclass(frozen=True)
class RegistrationSpec:
    """Which two submaps to align, and the frames that both contain, in time order."""

    i: int
    j: int
    i_revision: int
    j_revision: int
    kind: ConstraintKind
    shared_keyframe_ids: tuple[str, ...]  # W for adjacent pairs; the injected keyframe for loops

    @property
    def record_id(self) -> str:
        """Identity in the log, shared by the job and its constraint."""
        return constraint_id(self.kind, self.i, self.i_revision, self.j, self.j_revision)


@dataclass(frozen=True)
class SharedGeometry:
    """One keyframe as two submaps see it."""

    in_i: FrameGeometry
    in_j: FrameGeometry


@dataclass(frozen=True)
class RegisterTask:
    """Payload of a register job: everything that a worker without memory needs."""

    spec: RegistrationSpec
    shared: tuple[SharedGeometry, ...]  # in the order of ``spec.shared_keyframe_ids``
    fix_scale: bool = False  # both sides are metric: SE(3)


@dataclass(frozen=True)
class RegistrationAttempt:
    """One anchor that was tried for a constraint."""

    anchor: str  # "window1", "window3", "window5", "full"
    keyframe_ids: tuple[str, ...]
    point_count: int
    inlier_ratio: float
    median_relative_residual: float
    outcome: str  # "accepted", or why not


@dataclass(frozen=True)
class Constraint:
    """Sim(3) constraint between two submaps (paper eq. 7 to 10); ``x_j = j_from_i.act(x_i)``."""

    spec: RegistrationSpec
    accepted: bool
    reason: str  # one line; empty when accepted
    j_from_i: Sim3
    inlier_ratio: float
    median_relative_residual: float
    information: npt.NDArray[np.float64]  # (7, 7): rotation, translation, log-scale; left perturbation, frame j
    point_count: int
    attempts: tuple[RegistrationAttempt, ...] = ()

    @property
    def record_id(self) -> str:
        """Identity in the log."""
        return self.spec.record_id


@dataclass(frozen=True)
class SubmapPose:
    """Optimised pose X_k of one submap."""

    submap_index: int
    submap_revision: int
    component: int  # index of the first submap of the connected part; poses of different components share no frame
    world_from_submap: Sim3


@dataclass(frozen=True)
class EdgeReport:
    """How one constraint fared in the solve."""

    constraint_id: str
    weighted_residual: float  # sqrt(r^T Omega r) at the solution; NaN where the ends are in different components
    is_used: bool  # False where a loop was switched off
    robust_weight: float = 1.0  # in [0, 1]


@dataclass(frozen=True)
class GraphUpdate:
    """A solved pose graph: the record of the graph stream (paper eq. 12)."""

    revision: int
    is_final: bool
    poses: tuple[SubmapPose, ...]
    edges: tuple[EdgeReport, ...]
    breaks: tuple[str, ...] = ()  # one line for each place where the trajectory is broken, and why
    final_cost: float = 0.0

    @property
    def record_id(self) -> str:
        """Identity in the log."""
        return "graph/final" if self.is_final else f"graph/{self.revision:08d}"


class EventKind(StrEnum):
    """Events of a session."""

    SESSION_STARTED = "session_started"
    STREAM_ENDED = "stream_ended"
    JOB_DEAD = "job_dead"
    WARNING = "warning"
    RUN_ENDED = "run_ended"


@dataclass(frozen=True)
class Event:
    """Something that happened once and matters to the planner or to the person who watches."""

    event_id: str
    kind: EventKind
    message: str
    time_ns: int  # wall clock; informative only, not part of the identity
    detail: dict[str, str] = field(default_factory=dict)


class JobKind(StrEnum):
    """Capabilities that a worker may offer."""

    DESCRIBE = "describe"
    PREDICT = "predict"
    REGISTER = "register"


@dataclass(frozen=True)
class Job:
    """A unit of work in the ledger's queue; ``payload`` is the encoded spec, opaque to the ledger."""

    job_id: str  # the record id of its result: the planner asks the log whether it is done
    kind: JobKind
    payload: bytes
    payload_type: str  # name of the message in ``payload``
    priority: int = 0  # lower is sooner; ties go by submission order
    model: str = ""  # a worker must offer it; empty = any worker of the kind


@dataclass(frozen=True)
class Lease:
    """A claimed job: valid while heartbeats arrive before ``duration_s`` runs out and the worker's token is alive."""

    job: Job
    lease_id: str
    attempt: int  # 1 for the first
    duration_s: float


class JobState(StrEnum):
    """Life of a job."""

    OPEN = "open"
    LEASED = "leased"
    DONE = "done"
    DEAD = "dead"
    CANCELLED = "cancelled"  # no longer wanted by the planner


@dataclass(frozen=True)
class JobReport:
    """A job as the status shows it."""

    job_id: str
    kind: JobKind
    state: JobState
    failure_count: int
    lost_lease_count: int
    worker: str
    last_reason: str
    last_traceback: str


class DoneOutcome(StrEnum):
    """What became of the result that a worker handed in."""

    COMMITTED = "committed"  # record appended and job done, in one transaction
    ALREADY_DONE = "already_done"  # done before; this result is dropped
    DROPPED = "dropped"  # the job is unknown, cancelled or dead


@dataclass(frozen=True)
class LogEntry:
    """One durable record of a stream; ``payload`` is the encoded record, opaque to the ledger."""

    stream: str
    sequence: int  # dense per stream, from 0
    record_id: str
    payload_type: str  # full name of the message in ``payload``
    payload: bytes
    append_time_ns: int  # wall clock of the ledger; informative only


@dataclass(frozen=True)
class StreamPosition:
    """How far a stream is."""

    stream: str
    next_sequence: int  # number of records, and the sequence number of the next one


@dataclass(frozen=True)
class JobCount:
    """Number of jobs of a kind in a state."""

    kind: str
    state: str
    count: int


@dataclass(frozen=True)
class LedgerStatus:
    """What the ledger says of itself."""

    positions: tuple[StreamPosition, ...]
    job_counts: tuple[JobCount, ...]
    stored_bytes: int
    free_bytes: int
    is_accepting: bool  # False below the reserve of free disk
    detail: str  # one line for a person; empty when all is well
    refused_request_count: int  # since the ledger started
    ledger_id: str  # of this log, also of none that stood under the same session before; empty from an older ledger

    def position(self, stream: str) -> int:
        """Number of records of a stream; 0 for one that has none."""
        return next((entry.next_sequence for entry in self.positions if entry.stream == stream), 0)

    def job_count(self, state: str, kind: str | None = None) -> int:
        """Number of jobs in a state, of one kind or of all."""
        return sum(entry.count for entry in self.job_counts if entry.state == state and kind in (None, entry.kind))


@dataclass(frozen=True)
class HealthReport:
    """What a service says of itself once a second, from its Python loop."""

    service: str  # "frontend", "ledger", ...
    instance: str  # unique per process
    time_ns: int
    state: str  # one word: "starting", "idle", "working", "waiting", "ended", ...
    detail: str  # one line for a person
    resident_bytes: int
    counters: dict[str, float] = field(default_factory=dict)  # name with its unit -> value


_PART_MARKS = {None: "", SubmapPart.FIRST_HALF: "a", SubmapPart.SECOND_HALF: "b"}


def keyframe_id(camera: str, epoch: int, frame_index: int) -> str:
    """Id of a keyframe and its record."""
    return f"{camera}/{epoch}/{frame_index:08d}"


def segment_id(index: int) -> str:
    """Record id of a segment."""
    return f"segment/{index:06d}"


def submap_index(segment_index: int, part: SubmapPart | None = None) -> int:
    """Index of the submap of a segment; between two segments there is room for a second half."""
    return SUBMAPS_PER_SEGMENT * segment_index + (part is SubmapPart.SECOND_HALF)


def segment_index_of(submap_index: int) -> int:
    """Index of the segment whose base, or half of it, a submap holds."""
    return submap_index // SUBMAPS_PER_SEGMENT


def submap_id(index: int, revision: int, part: SubmapPart | None = None) -> str:
    """Record id of a submap's geometry, and of the job that predicts it.

    The first half of a base has the index of the whole and so a mark, to be another job than the one that is dead.
    """
    return f"submap/{index:06d}{_PART_MARKS[part]}/r{revision}"


def constraint_id(kind: ConstraintKind, i: int, i_revision: int, j: int, j_revision: int) -> str:
    """Record id of a constraint, and of the job that registers it."""
    return f"constraint/{kind.value}/{i:06d}.r{i_revision}/{j:06d}.r{j_revision}"
