"""Trajectory and map for those who ask: composed from a snapshot of the log, made once per state of the graph.

A result that is a few times younger than its making took is handed out again although the graph has moved on: so
that however many ask, and however long the drive, making results takes a bounded share of one core. Once the graph is
final, only the final result is handed out.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

from vggt_motion.backend.trajectory import Trajectory, compose
from vggt_motion.config import Config
from vggt_motion.errors import VggtMotionError
from vggt_motion.evaluation.trajectory_io import to_csv, to_json, to_kitti, to_tum
from vggt_motion.gateway.builder import Builder, Built
from vggt_motion.gateway.state import GatewayState, Snapshot

TrajectoryFormat = Literal["tum", "kitti", "csv", "json"]
FrameChoice = Literal["key", "all"]
Value = TypeVar("Value")

_REST = 4.0  # a result is good for so many times its making


class NothingYetError(VggtMotionError):
    """The session has not come far enough to answer."""


@dataclass(frozen=True)
class Text:
    """A trajectory in one format."""

    body: bytes
    trajectory: Trajectory


class Results:
    """The results of one session. Used on one event loop."""

    def __init__(self, state: GatewayState, build_map: Callable[[Snapshot], bytes]) -> None:
        """Nothing made yet."""
        self._state = state
        self._build_map = build_map
        self._trajectories: Builder[Trajectory] = Builder("gateway-trajectory", kept=1)
        self._texts: Builder[Text] = Builder("gateway-text", kept=8)
        self._maps: Builder[bytes] = Builder("gateway-map", kept=1)

    async def trajectory(self) -> Trajectory:
        """The trajectory of the newest graph.

        Raises:
            NothingYetError: there is no graph yet.
        """
        built = await self._get(self._trajectories, lambda: compose_snapshot(self._snapshot(), self._state.config))
        return built.value

    async def text(self, wanted: TrajectoryFormat, frames: FrameChoice, component: int | None) -> Text:
        """The trajectory in a format.

        Raises:
            NothingYetError: there is no graph yet, or no such component.
        """
        trajectory = await self.trajectory()
        if component is not None and component not in trajectory.components:
            known = ", ".join(map(str, trajectory.components)) or "none"
            raise NothingYetError(f"the trajectory has no component {component}: its components are {known}")
        key = (id(trajectory), wanted, frames, component)
        built = await self._texts.get(key, lambda: _write(trajectory, wanted, frames, component))
        return built.value

    async def map_ply(self) -> Built[bytes]:
        """The coloured map of the newest graph as a PLY file.

        Raises:
            NothingYetError: there is no graph yet.
        """
        return await self._get(self._maps, lambda: self._build_map(self._snapshot()))

    def _snapshot(self) -> Snapshot:
        snapshot = self._state.snapshot()
        if snapshot is None:
            raise NothingYetError("no trajectory yet: no submap has been optimised")
        return snapshot

    async def _get(self, builder: Builder[Value], build: Callable[[], Value]) -> Built[Value]:
        key = self._state.graph_key()
        if key is None:
            raise NothingYetError("no trajectory yet: no submap has been optimised")
        newest = builder.newest()
        if newest is not None and newest.key != key and not self._state.is_final():
            is_fresh = time.monotonic() - newest.finished_at < _REST * newest.seconds
            if is_fresh:
                return newest
        return await builder.get(key, build)


def compose_snapshot(snapshot: Snapshot, config: Config) -> Trajectory:
    """The trajectory of a snapshot, in the scale that the configuration asks for."""
    return compose(
        list(snapshot.keyframes.values()),
        [snapshot.segments[index] for index in sorted(snapshot.segments)],
        snapshot.submaps,
        snapshot.graph,
        known_distance_m=config.backend.known_distance_m,
    )


def _write(trajectory: Trajectory, wanted: TrajectoryFormat, frames: FrameChoice, component: int | None) -> Text:
    if wanted == "tum":
        text = to_tum(trajectory.track(frames, component))
    elif wanted == "kitti":
        text = to_kitti(trajectory.track(frames, component))
    else:
        chosen = trajectory.keyframes if frames == "key" else trajectory.frames
        part = replace(trajectory, frames=tuple(f for f in chosen if component is None or f.component == component))
        text = to_csv(part) if wanted == "csv" else to_json(part)
    return Text(text.encode(), trajectory)
