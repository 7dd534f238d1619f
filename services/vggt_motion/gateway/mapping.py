"""The map as a file."""

from __future__ import annotations

import tempfile
from pathlib import Path

from vggt_motion.backend.session_map import build_session_map
from vggt_motion.errors import VggtMotionError
from vggt_motion.gateway.results import compose_snapshot
from vggt_motion.gateway.state import GatewayState, Snapshot


def map_as_ply(snapshot: Snapshot, state: GatewayState) -> bytes:
    """Binary PLY of the confident points of a snapshot, in the frame and scale of the trajectory.

    Raises:
        VggtMotionError: the payloads cannot be read.
    """
    if state.read_blob is None:
        raise VggtMotionError("this gateway has no access to the payloads that a map is made of")
    points = build_session_map(
        snapshot.keyframes,
        snapshot.submaps,
        snapshot.graph,
        compose_snapshot(snapshot, state.config),
        state.config.backend,
        state.read_blob,
    )
    with tempfile.TemporaryDirectory(prefix="vggt-motion-map-") as folder:
        file = Path(folder) / "map.ply"
        points.write_ply(file)
        return file.read_bytes()
