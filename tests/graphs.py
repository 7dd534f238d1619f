"""Simulated submap graphs for tests and benchmarks: a drive in laps along given poses, with true and false loops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vggt_motion.geometry import se3, sim3, umeyama
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import Constraint, ConstraintKind, GraphUpdate, RegistrationSpec

# Errors per axis of an edge between two submaps of real drives against ground truth: radians, metres, logarithm of
# scale.
EDGE_SIGMA = np.array([0.007] * 3 + [0.21] * 3 + [0.02])
MIN_LOOP_GAP = 10  # submaps
LOOP_RADIUS_M, FALSE_LOOP_DISTANCE_M = 8.0, 30.0


@dataclass(frozen=True)
class SimulatedDrive:
    """Truth and measurements."""

    truth: tuple[Sim3, ...]  # world_from_submap; every submap has a unit of its own
    metres_per_unit: float  # of the world, which is the frame of submap 0
    constraints: tuple[Constraint, ...]
    true_loops: frozenset[str]  # ids of those loops that are true

    @property
    def nodes(self) -> list[tuple[int, int]]:
        return [(k, 1) for k in range(len(self.truth))]

    def without_false_loops(self) -> list[Constraint]:
        return [c for c in self.constraints if c.spec.kind is ConstraintKind.ADJACENT or c.record_id in self.true_loops]


def circle(count: int, radius_m: float) -> np.ndarray:
    """Poses (count, 4, 4) along a circle, looking along it."""
    poses = []
    for angle in 2 * np.pi * np.arange(count) / count:
        rotation = se3.so3_exp(np.array([0.0, angle, 0.0]))
        poses.append(se3.make(rotation, radius_m * np.array([1 - np.cos(angle), 0.0, np.sin(angle)])))
    return np.array(poses)


def simulate(
    road: np.ndarray, submap_count: int, loop_count: int, false_share: float, seed: int, *, metric: bool = False
) -> SimulatedDrive:
    """Drive along poses (N, 4, 4) in laps, one submap per pose.

    Loops are drawn from the places where the road is revisited facing the same way; a false one claims that two distant
    submaps are the same place, as look-alike streets do. If the road is not revisited often enough there are fewer
    loops, in the same proportion.
    """
    rng = np.random.default_rng(seed)
    units = np.ones(submap_count) if metric else np.exp(rng.normal(0, 0.3, submap_count))
    truth = [
        Sim3(se3.nearest_rotation(pose[:3, :3]), pose[:3, 3], float(unit))
        for pose, unit in zip((road[k % len(road)] for k in range(submap_count)), units, strict=True)
    ]
    origin = truth[0].inverse()
    truth = [origin @ pose for pose in truth]
    # the world is the frame of submap 0, in its unit
    places = units[0] * np.array([pose.translation for pose in truth])
    headings = np.array([pose.rotation[:, 2] for pose in truth])

    def measure(i: int, j: int, kind: ConstraintKind, believed: Sim3) -> Constraint:
        sigma = EDGE_SIGMA.copy()
        sigma[3:6] *= 1.0 / units[j]
        noise = rng.normal(0, sigma)
        if metric:
            noise[6] = 0.0
        spec = RegistrationSpec(i, j, 1, 1, kind, ("k",))
        information = np.diag(1 / sigma**2)
        return Constraint(spec, True, "", sim3.exp(noise) @ believed, 1.0, 0.01, information, 80_000)

    constraints = [
        measure(k, k + 1, ConstraintKind.ADJACENT, truth[k + 1].inverse() @ truth[k]) for k in range(submap_count - 1)
    ]
    revisits = []
    for j in range(MIN_LOOP_GAP, submap_count):
        distance = np.linalg.norm(places[: j - MIN_LOOP_GAP + 1] - places[j], axis=1)
        near = np.flatnonzero(distance < LOOP_RADIUS_M)
        if len(near):
            i = int(rng.choice(near))
            if headings[i] @ headings[j] > 0.8:
                revisits.append((i, j))
    wanted = loop_count - round(loop_count * false_share)
    if len(revisits) > wanted:
        revisits = [revisits[k] for k in np.sort(rng.choice(len(revisits), wanted, replace=False))]
    true_loops = [measure(i, j, ConstraintKind.LOOP, truth[j].inverse() @ truth[i]) for i, j in revisits]
    taken, false_loops = set(revisits), []
    while len(false_loops) < round(len(revisits) * false_share / max(1e-9, 1 - false_share)):
        i, j = sorted(rng.integers(0, submap_count, 2).tolist())
        apart = np.linalg.norm(places[i] - places[j]) > FALSE_LOOP_DISTANCE_M
        if j - i >= MIN_LOOP_GAP and apart and (i, j) not in taken:
            taken.add((i, j))
            turn, shift = se3.so3_exp(rng.normal(0, 0.1, 3)), rng.normal(0, 2, 3) / units[j]
            believed = Sim3(turn, shift, float(units[i] / units[j]))
            false_loops.append(measure(i, j, ConstraintKind.LOOP, believed))
    ids = frozenset(c.record_id for c in true_loops)
    return SimulatedDrive(tuple(truth), float(units[0]), (*constraints, *true_loops, *false_loops), ids)


def position_error(drive: SimulatedDrive, poses: Sequence[Sim3]) -> float:
    """RMSE of the submap origins after Sim(3) alignment, metres."""
    truth = np.array([pose.translation for pose in drive.truth])
    found = np.array([pose.translation for pose in poses])
    aligned = umeyama.align(found, truth).act(found)
    return float(np.sqrt(np.mean(np.sum((aligned - truth) ** 2, axis=1)))) * drive.metres_per_unit


def poses_of(update: GraphUpdate) -> list[Sim3]:
    return [pose.world_from_submap for pose in update.poses]
