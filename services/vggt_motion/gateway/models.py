"""What the gateway says, as pydantic models: the answers of the interface and their description in OpenAPI."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class Answer(BaseModel):
    """Base of all answers."""

    model_config = ConfigDict(frozen=True)


class ErrorAnswer(Answer):
    """What went wrong, in one line."""

    error: str = Field(examples=["query 'format': input should be 'tum', 'kitti', 'csv' or 'json', not 'xyz'"])


class LivenessAnswer(Answer):
    """The process answers."""

    status: Literal["ok"] = "ok"


class ReadinessAnswer(Answer):
    """Whether the gateway's picture of the session is complete and current."""

    is_ready: bool
    reason: str = Field(description="one line; empty when ready", examples=["", "the ledger does not answer"])


class ServiceStatus(Answer):
    """One process of the session."""

    service: str = Field(examples=["inference"])
    instance: str = Field(examples=["inference-1a2b3c"])
    state: str = Field(description="one word; 'silent' when alive without a report", examples=["working"])
    detail: str = Field(examples=["submap 12"])
    report_age_s: float | None = Field(description="seconds since its last report of health", examples=[0.4])
    resident_bytes: int | None = Field(examples=[412_000_000])
    counters: dict[str, float] = Field(examples=[{"jobs_done": 12.0}])


class StreamStatus(Answer):
    """One stream of the log."""

    stream: str = Field(examples=["keyframe"])
    ledger_position: int | None = Field(
        description="records in the ledger; null when it does not answer", examples=[84]
    )
    gateway_position: int = Field(description="records that the gateway has taken in", examples=[84])


class JobStatus(Answer):
    """Jobs of one kind, by state."""

    kind: str = Field(examples=["predict"])
    open: int = 0
    leased: int = 0
    done: int = 0
    dead: int = 0
    cancelled: int = 0


class DeadJob(Answer):
    """A job that was given up."""

    job_id: str = Field(examples=["submap/000004/r1"])
    kind: str = Field(examples=["predict"])
    reason: str = Field(examples=["took longer than 300 s and was ended"])
    traceback: str = ""


class MotionStatus(Answer):
    """Motion states of the input frames: S standing, T turning, L straight."""

    current: Literal["S", "T", "L"] | None = Field(description="state of the newest keyframe", examples=["L"])
    frame_counts: dict[Literal["S", "T", "L"], int] = Field(
        description="frames by state, as far as segments are closed", examples=[{"S": 0, "T": 12, "L": 188}]
    )


class SubmapStatus(Answer):
    """Submaps by what their predictor says of them."""

    closed_segments: int = Field(examples=[9])
    predicted: int = Field(examples=[8])
    verdicts: dict[str, int] = Field(examples=[{"good": 7, "low_quality": 1, "rotation_only": 0, "failed": 0}])
    doubtful: list[str] = Field(
        description="one line for each of the latest that are not good", examples=[["submap 3: low_quality: ..."]]
    )


class ConstraintStatus(Answer):
    """Registrations between submaps."""

    accepted: int = Field(examples=[7])
    refused: int = Field(examples=[0])
    loops_accepted: int = Field(examples=[0])


class GraphStatus(Answer):
    """The newest pose graph."""

    revision: int = Field(examples=[15])
    is_final: bool
    submaps: int = Field(examples=[8])
    components: int = Field(description="connected parts; more than one = the trajectory is broken", examples=[1])
    edges_used: int = Field(examples=[7])
    edges_switched_off: int = Field(examples=[0])
    breaks: list[str] = Field(description="one line for each break", examples=[[]])


class LagStatus(Answer):
    """How far the trajectory is behind the camera."""

    keyframes: int = Field(description="keyframes whose submap is not in the graph yet", examples=[14])
    video_s: float | None = Field(description="seconds of video between the two", examples=[2.8])
    submaps: int = Field(description="closed segments without a submap", examples=[1])
    jobs_waiting: int = Field(description="jobs that are open or being worked on", examples=[2])


class LedgerStatusAnswer(Answer):
    """The ledger, as it sees itself."""

    is_answering: bool
    is_accepting: bool = Field(description="false below the reserve of free disk")
    detail: str = ""
    stored_bytes: int = Field(examples=[48_000_000])
    free_bytes: int = Field(examples=[98_000_000_000])
    refused_requests: int = Field(examples=[0])


class PredictorStatus(Answer):
    """Who makes the geometry."""

    configured: str = Field(examples=["sfm"])
    reason: str = Field(
        description="why it was chosen, where `auto` was asked for", examples=["chosen by the configuration"]
    )
    models: dict[str, int] = Field(description="submaps by the model that made them", examples=[{"sfm": 8}])


class Notice(Answer):
    """An event of the session."""

    kind: str = Field(examples=["warning"])
    message: str = Field(examples=["the camera did not move"])
    time_ns: int = Field(description="wall clock", examples=[1_700_000_000_000_000_000])


class ClientStatus(Answer):
    """Those who listen to the live events."""

    connected: int = Field(examples=[1])
    missed_events: int = Field(description="events that slow clients were not sent", examples=[0])


class StatusAnswer(Answer):
    """The state of the session."""

    version: str = Field(examples=["0.1.0"])
    session: str = Field(examples=["default"])
    phase: Literal["waiting", "running", "input_ended", "finished"] = Field(
        description="finished = the final graph is there"
    )
    readiness: ReadinessAnswer
    services: list[ServiceStatus]
    streams: list[StreamStatus]
    ledger: LedgerStatusAnswer
    jobs: list[JobStatus]
    dead_jobs: list[DeadJob]
    dead_job_count: int
    motion: MotionStatus
    keyframes: int = Field(examples=[84])
    submaps: SubmapStatus
    constraints: ConstraintStatus
    graph: GraphStatus | None
    lag: LagStatus
    predictor: PredictorStatus
    notices: list[Notice] = Field(description="the latest events of the session, newest last")
    live_clients: ClientStatus
