"""The whole method in one process, without bus and ledger: for accuracy tests, ablation and benchmarks.

The stages, the planner and the encodings are those of the services, so the result is theirs too, bit for bit.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable
from dataclasses import dataclass, field

from vggt_motion.backend import planner, posegraph
from vggt_motion.backend.state import LogState
from vggt_motion.backend.trajectory import Trajectory, compose
from vggt_motion.config import Config
from vggt_motion.errors import SourceTruncatedError
from vggt_motion.frontend.pipeline import FrontendPipeline, KeyframeOutput
from vggt_motion.inference.task import predict_submap
from vggt_motion.records import Event, EventKind, PredictTask
from vggt_motion.registration.task import register_submaps
from vggt_motion.sources.registry import open_source


@dataclass
class OfflineRun:
    """What a run without processes leaves: the folded log, the payloads, the trajectory."""

    state: LogState
    blobs: dict[str, bytes]
    trajectory: Trajectory
    seconds: dict[str, float] = field(default_factory=dict)  # wall time per stage
    truncated: str = ""


def run_offline(
    location: str, config: Config, *, start: int = 0, end: int | None = None, stride: int = 1
) -> OfflineRun:
    """Run a source through frontend, prediction, registration and pose graph.

    Raises:
        SourceError: not one frame can be read.
        VggtMotionError: a stage refused its input.
    """
    state = LogState()
    blobs: dict[str, bytes] = {}
    seconds = dict.fromkeys(("frontend", "prediction", "registration", "pose_graph"), 0.0)
    begin = time.perf_counter()
    truncated = _run_frontend(location, config, state, blobs, start=start, end=end, stride=stride)
    seconds["frontend"] = time.perf_counter() - begin
    while jobs := planner.next_jobs(state, config):
        for job in jobs:
            begin = time.perf_counter()
            if isinstance(job.task, PredictTask):
                images = [blobs[keyframe.image.sha256] for keyframe in job.task.keyframes]
                record, payloads = predict_submap(job.task, images, None, config.inference)
                _keep(blobs, payloads)
                state.apply(record)
                seconds["prediction"] += time.perf_counter() - begin
            else:
                refs = [frame.depth for shared in job.task.shared for frame in (shared.in_i, shared.in_j)]
                depths = [blobs[ref.sha256] for ref in refs]
                state.apply(register_submaps(job.task, depths, config.registration)[0])
                seconds["registration"] += time.perf_counter() - begin
    begin = time.perf_counter()
    submaps = state.usable_submaps()
    nodes = [(index, geometry.spec.revision) for index, geometry in submaps.items()]
    constraints = planner.current_constraints(state)
    graph = posegraph.solve(
        nodes,
        constraints,
        config.backend,
        revision=state.graph_input_count,
        is_final=True,
        is_metric=state.is_metric,
    )
    state.apply(graph)
    trajectory = compose(
        list(state.keyframes.values()),
        [state.segments[index] for index in sorted(state.segments)],
        submaps,
        graph,
        known_distance_m=config.backend.known_distance_m,
    )
    seconds["pose_graph"] = time.perf_counter() - begin
    return OfflineRun(state, blobs, trajectory, seconds, truncated)


def _run_frontend(
    location: str,
    config: Config,
    state: LogState,
    blobs: dict[str, bytes],
    *,
    start: int,
    end: int | None,
    stride: int,
) -> str:
    source = open_source(location, start=start, end=end, stride=stride)
    pipeline = FrontendPipeline(config.frontend, config.run.camera)
    truncated = ""
    outputs = []
    try:
        for frame in source.frames():
            outputs.extend(pipeline.push(frame))
    except SourceTruncatedError as error:
        truncated = str(error)
    finally:
        source.close()
    outputs.extend(pipeline.finish())
    for output in outputs:
        if isinstance(output, KeyframeOutput):
            blobs[output.keyframe.image.sha256] = output.encoded
            state.apply(output.keyframe)
        else:
            state.apply(output.segment)
    detail = {"frame_count": str(pipeline.frame_count), "segment_count": str(pipeline.segment_count)}
    state.apply(Event("stream_ended", EventKind.STREAM_ENDED, truncated, 0, detail))
    return truncated


def _keep(blobs: dict[str, bytes], payloads: Iterable[bytes]) -> None:
    for payload in payloads:
        blobs[hashlib.sha256(payload).hexdigest()] = payload
