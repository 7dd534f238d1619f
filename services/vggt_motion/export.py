"""The command ``vggt-motion export``: the results of a stored session in the form that another program reads."""

from __future__ import annotations

import os
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Literal

import cv2

from vggt_motion.backend import colmap_export, posegraph
from vggt_motion.backend.planner import current_constraints, undecided_joints
from vggt_motion.backend.session_map import build_session_map, main_component, map_frames
from vggt_motion.backend.state import LogState
from vggt_motion.backend.trajectory import NO_COMPONENT, Trajectory, compose
from vggt_motion.bus import codec
from vggt_motion.bus.log import RECORD_OF_STREAM
from vggt_motion.config import Config
from vggt_motion.errors import CodecError, InputError, LedgerError, RequestRefusedError
from vggt_motion.evaluation.trajectory_io import to_csv, to_json, to_kitti, to_tum
from vggt_motion.ledger.directory import DATABASE_NAME, stored_blob
from vggt_motion.ledger.sqlite import read_only
from vggt_motion.ledger.store import sha256_hex
from vggt_motion.records import BlobRef, GraphUpdate
from vggt_motion.sources.encoded import decode_rgb

_PAGE = 256


class ExportFormat(StrEnum):
    """What can be written."""

    TUM = "tum"
    KITTI = "kitti"
    CSV = "csv"
    JSON = "json"
    PLY = "ply"
    COLMAP = "colmap"


@dataclass(frozen=True)
class ExportOptions:
    """What a person may choose; not all of it matters to every form."""

    frames: Literal["key", "all"] = "all"  # TUM and KITTI: keyframes or all frames
    component: int | None = None  # which connected part; None: TUM and KITTI all of them, PLY and COLMAP the largest
    is_text: bool = False  # COLMAP: text instead of binary
    undistort: bool = False  # COLMAP: pinhole images
    max_points: int = 300_000  # COLMAP
    max_observations: int = 4096  # COLMAP: of one image


class StoredSession:
    """A session on disk, read without a service; it may be served meanwhile."""

    def __init__(self, directory: Path) -> None:
        """Read the log.

        Args:
            directory: of the ledger.

        Raises:
            LedgerError: there is no ledger, or it is damaged.
            CodecError: a record is none.
        """
        self._directory = directory
        self.state = LogState()
        with read_only(directory / DATABASE_NAME) as reader:
            for stream, record_type in RECORD_OF_STREAM.items():
                position = 0
                while rows := reader.records(stream.value, position, _PAGE):
                    position = rows[-1].sequence + 1
                    for row in rows:
                        self.state.apply(codec.decode(record_type, row.payload))

    def load_blob(self, ref: BlobRef) -> bytes:
        """A payload, verified.

        Raises:
            LedgerError: it is not there, or damaged.
        """
        try:
            data = stored_blob(self._directory, ref.sha256)
        except RequestRefusedError as error:
            raise LedgerError(str(error)) from error
        if sha256_hex(data) != ref.sha256:
            raise LedgerError(f"blob {ref.sha256} is damaged")
        return data


def export(directory: Path, form: ExportFormat, out: Path, config: Config, options: ExportOptions) -> str:
    """Write one form of a session's results.

    Args:
        directory: of the ledger.
        form: which.
        out: file, or for COLMAP the folder that gets ``images`` and ``sparse/0``.
        config: of the session.
        options: see there.

    Returns:
        One line that says what was written.

    Raises:
        InputError: there is nothing to export yet, no such part, or the file cannot be written.
        LedgerError: no session, or a damaged one.
    """
    session = StoredSession(directory)
    graph = _graph(session.state, config)
    trajectory = compose(
        list(session.state.keyframes.values()),
        [session.state.segments[index] for index in sorted(session.state.segments)],
        session.state.usable_submaps(),
        graph,
        known_distance_m=config.backend.known_distance_m,
    )
    component = main_component(trajectory) if options.component is None else options.component
    if component == NO_COMPONENT:
        raise InputError(f"{directory}: no frame has a pose yet")
    if component not in trajectory.components:
        known = ", ".join(map(str, trajectory.components))
        raise InputError(f"{directory} has no part {component}: its parts are {known}")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        if form is ExportFormat.COLMAP:
            return _export_colmap(session, graph, trajectory, component, out, config, options)
        if form is ExportFormat.PLY:
            cloud = build_session_map(
                session.state.keyframes,
                session.state.usable_submaps(),
                graph,
                trajectory,
                config.backend,
                session.load_blob,
                component,
            )
            cloud.write_ply(out)
            return f"{out}: {len(cloud.points)} points of part {component}"
        track = trajectory.track(options.frames, options.component)
        texts = {
            ExportFormat.TUM: lambda: to_tum(track),
            ExportFormat.KITTI: lambda: to_kitti(track),
            ExportFormat.CSV: lambda: to_csv(trajectory),
            ExportFormat.JSON: lambda: to_json(trajectory),
        }
        _write(out, texts[form]().encode())
    except OSError as error:
        raise InputError(f"cannot write {out}: {error.strerror or error}") from error
    count = len(track) if form in (ExportFormat.TUM, ExportFormat.KITTI) else len(trajectory.frames)
    return f"{out}: {count} frames, graph revision {graph.revision}{'' if graph.is_final else ' (not final)'}"


def _graph(state: LogState, config: Config) -> GraphUpdate:
    """The final graph, or a solve of what there is where the run was not finished."""
    graph = state.latest_graph()
    if graph is not None and graph.is_final:
        return graph
    return posegraph.solve(
        [(index, geometry.spec.revision) for index, geometry in state.usable_submaps().items()],
        current_constraints(state),
        config.backend,
        revision=state.graph_input_count,
        is_final=False,
        is_metric=state.is_metric,
        undecided=undecided_joints(state, config),
    )


def _export_colmap(
    session: StoredSession,
    graph: GraphUpdate,
    trajectory: Trajectory,
    component: int,
    out: Path,
    config: Config,
    options: ExportOptions,
) -> str:
    state, submaps = session.state, session.state.usable_submaps()
    recorded = colmap_export.collect_images(trajectory, list(state.keyframes.values()), submaps, component)
    images = [colmap_export.without_distortion(image) for image in recorded] if options.undistort else recorded
    limited = config.backend.model_copy(update={"map_max_points": options.max_points})
    cloud = build_session_map(state.keyframes, submaps, graph, trajectory, limited, session.load_blob, component)
    frames = map_frames(state.keyframes, submaps, graph, component, session.load_blob)
    model = colmap_export.build_model(
        images, cloud, frames, scale=trajectory.scale, max_per_image=options.max_observations
    )
    colmap_export.write_colmap(out / "sparse" / "0", model, "text" if options.is_text else "binary")
    (out / "images").mkdir(exist_ok=True)
    for image, original in zip(images, recorded, strict=True):
        _write(out / "images" / image.name, _image_file(session, image, original))
    return f"{out}: {len(images)} images, {len(model.points)} points, {len(model.pixels)} observations"


def _image_file(session: StoredSession, image: colmap_export.ColmapImage, recorded: colmap_export.ColmapImage) -> bytes:
    """The file of a keyframe, byte for byte as recorded unless its distortion is taken out."""
    data = session.load_blob(session.state.keyframes[image.keyframe_id].image)
    if image.intrinsics == recorded.intrinsics:
        return data
    try:
        pixels = decode_rgb(data)
    except CodecError as error:
        raise InputError(f"keyframe {image.keyframe_id} is {error}") from error
    straight = colmap_export.undistort(pixels, recorded.intrinsics)
    return bytes(cv2.imencode(".png", cv2.cvtColor(straight, cv2.COLOR_RGB2BGR))[1])


def _write(path: Path, data: bytes) -> None:
    partial = path.with_name(path.name + ".part")
    partial.write_bytes(data)
    os.replace(partial, path)  # noqa: PTH105 - replaces atomically on every system
