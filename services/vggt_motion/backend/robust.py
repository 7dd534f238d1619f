"""Solve one connected graph and switch off the loops that disagree (DESIGN 3.6).

False loops are the rule where streets look alike. Measured on simulated drives along KITTI roads with 10, 30 and 50 %
false loops (tests/benchmarks/bench_posegraph.py): Huber alone multiplies the error by more than ten; GTSAM's graduated
non-convexity keeps it, except in 4 of 16 drives with half of the loops false, at the price of dozens of solves; Cauchy
started from the chain keeps it in nearly all, since the true loops pull the drive home and the false ones lose their
hold. What is then farther off than any honest error is switched off and the rest is solved under Huber: the error is
that of the drive without the false loops.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vggt_motion.backend.factors import Edge, Loss, Solved, optimise, robust_weight
from vggt_motion.backend.skeleton import reduce_chain
from vggt_motion.config import BackendConfig
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.records import EdgeReport

Array = npt.NDArray[np.float64]

_MAX_SELECTIONS = 4
_FIRST_GATE = 2.0
_CAUCHY_TOLERANCE, _GATE_TOLERANCE, _FINE_TOLERANCE = 1e-2, 1e-3, 1e-6
# The reduced graph pays where it leaves out enough submaps.
_MIN_REDUCED_SUBMAPS, _MAX_KEPT_SHARE = 200, 0.5


@dataclass(frozen=True)
class ComponentSolution:
    """One connected part, solved."""

    poses: Mapping[int, Sim3]
    reports: tuple[EdgeReport, ...]
    cost: float


def solve_component(
    chain: Mapping[int, Sim3],
    adjacent: Sequence[Edge],
    loops: Sequence[Edge],
    config: BackendConfig,
    *,
    is_metric: bool,
) -> ComponentSolution:
    """Solve a connected graph.

    Args:
        chain: start poses, composed of the adjacent edges.
        adjacent: edges that are believed, up to the Huber loss.
        loops: edges that may be false.
        config: losses and the gate of the loops.
        is_metric: SE(3).

    Raises:
        OptimizationError: the solver failed.
    """
    if len(adjacent) == len(chain) - 1 and not loops:
        # the chain meets every constraint: there is nothing to optimise
        return ComponentSolution(chain, tuple(EdgeReport(e.edge_id, 0.0, is_used=True) for e in adjacent), 0.0)
    start = chain
    used = np.ones(len(loops), dtype=np.bool_)
    if config.loop_loss == "cauchy":
        loops = _under_cauchy(loops, config)
    if loops and config.loop_loss != "huber":
        start, used = _select(chain, adjacent, loops, config, is_metric=is_metric)
    active = [loop for loop, is_used in zip(loops, used, strict=True) if is_used]
    passive = [loop for loop, is_used in zip(loops, used, strict=True) if not is_used]
    solved = optimise(
        start,
        [*adjacent, *active],
        is_metric=is_metric,
        relative_tolerance=_FINE_TOLERANCE,
        only_scored=passive,
    )
    residuals = solved.weighted_residuals.tolist()
    reports = [
        EdgeReport(edge.edge_id, left, True, robust_weight(edge.loss, left, is_metric=is_metric))
        for edge, left in zip([*adjacent, *active], residuals, strict=False)
    ]
    reports += [
        EdgeReport(edge.edge_id, left, False, 0.0)
        for edge, left in zip(passive, residuals[len(adjacent) + len(active) :], strict=True)
    ]
    return ComponentSolution(solved.poses, tuple(reports), solved.cost)


def _under_cauchy(loops: Sequence[Edge], config: BackendConfig) -> list[Edge]:
    return [replace(loop, loss=Loss("cauchy", config.loop_cauchy_sigma)) for loop in loops]


def _select(
    chain: Mapping[int, Sim3],
    adjacent: Sequence[Edge],
    loops: Sequence[Edge],
    config: BackendConfig,
    *,
    is_metric: bool,
) -> tuple[Mapping[int, Sim3], npt.NDArray[np.bool_]]:
    """Start poses near the solution, and which loops (L,) to use."""
    skeleton = None
    if len(chain) >= _MIN_REDUCED_SUBMAPS:
        skeleton = reduce_chain(chain, adjacent, loops, is_metric=is_metric)
        if skeleton is not None and len(skeleton.kept) > _MAX_KEPT_SHARE * len(chain):
            skeleton = None
    start, between = (chain, adjacent) if skeleton is None else (skeleton.start(), skeleton.edges)

    def run(poses: Mapping[int, Sim3], used: Sequence[Edge], unused: Sequence[Edge], tolerance: float) -> Solved:
        return optimise(
            poses,
            [*between, *used],
            is_metric=is_metric,
            relative_tolerance=tolerance,
            only_scored=unused,
        )

    solved = run(start, _under_cauchy(loops, config), (), _CAUCHY_TOLERANCE)
    left = solved.weighted_residuals[len(between) :]
    used = np.ones(len(loops), dtype=np.bool_)
    if config.loop_loss == "cauchy_gate":
        # the first look is a rough one: what the others have yet to pull into place is not thrown out
        gates = [_FIRST_GATE * config.loop_gate_sigma] + [config.loop_gate_sigma] * _MAX_SELECTIONS
        for attempt, gate in enumerate(gates):
            following = left <= gate
            if attempt > 0 and np.array_equal(following, used):
                break
            used = following
            yes, no = np.flatnonzero(used).tolist(), np.flatnonzero(~used).tolist()
            solved = run(solved.poses, [loops[n] for n in yes], [loops[n] for n in no], _GATE_TOLERANCE)
            left = np.empty(len(loops))
            left[yes + no] = solved.weighted_residuals[len(between) :]
    return (solved.poses if skeleton is None else skeleton.expand(solved.poses)), used
