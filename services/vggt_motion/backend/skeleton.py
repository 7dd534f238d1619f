"""The graph without the submaps between loop ends: its loops are told true from false at a fraction of the cost.

A stretch of the drive without a loop end is a chain, and a chain is one edge: the transforms composed, the covariances
carried to its end by the adjoint and summed (the marginal, to first order). What the skeleton moves is handed down to
the submaps between as a share of the correction, and is where the full solve starts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from vggt_motion.backend.factors import Edge
from vggt_motion.geometry import sim3_batch
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.geometry.sim3_batch import Sim3Batch

Array = npt.NDArray[np.float64]

_MAX_EXPANSIONS = 2


@dataclass(frozen=True)
class Skeleton:
    """A chain of submaps of which some are kept."""

    members: tuple[int, ...]  # submap indices along the chain
    kept: npt.NDArray[np.intp]  # (M,) positions in ``members``, ascending, the first is 0
    chain: Sim3Batch  # world_from_submap of all members by the chain alone
    edges: tuple[Edge, ...]  # between successive kept submaps
    covariances: Array  # (N, 7, 7) of the edge that ends at each member; the first is nothing
    is_metric: bool

    def start(self) -> dict[int, Sim3]:
        """Chain poses of the kept submaps."""
        return {self.members[position]: self.chain[position] for position in self.kept.tolist()}

    def expand(self, poses: Mapping[int, Sim3]) -> dict[int, Sim3]:
        """Poses of all members from those of the kept ones.

        What a stretch misses its second end by is laid on its edges as their covariances bid: the optimum to first
        order, and once more for what the first order leaves. Beyond the last kept submap the chain goes on.
        """
        ends = Sim3Batch.of([poses[self.members[position]] for position in self.kept.tolist()])
        steps = self.chain.take(np.arange(len(self.members) - 1)).inverse()
        steps = steps @ self.chain.take(np.arange(1, len(self.members)))  # m-1 from m, for m = 1 ...
        placed = self._compose(ends, steps)
        for _ in range(_MAX_EXPANSIONS):
            reached = placed.take(self.kept[1:])
            missed = reached.inverse() @ ends.take(np.arange(1, len(ends)))
            left = sim3_batch.log(missed)
            steps = steps @ sim3_batch.exp(self._shares(placed, left)[1:])
            placed = self._compose(ends, steps)
        return dict(zip(self.members, placed.to_list(), strict=True)) | {
            self.members[position]: ends[n] for n, position in enumerate(self.kept.tolist())
        }

    def _compose(self, ends: Sim3Batch, steps: Sim3Batch) -> Sim3Batch:
        """Poses (N) along the chain: each stretch from its first end, and its second end as the stretch reaches it."""
        count = len(self.members)
        rotation, translation, scale = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty(count)
        rotation[0], translation[0], scale[0] = ends.rotation[0], ends.translation[0], ends.scale[0]
        lengths = np.diff(np.append(self.kept, count - 1))
        at, alive = ends, np.ones(len(lengths), dtype=np.bool_)
        # all stretches at once, one submap further each time
        for offset in range(1, int(lengths.max(initial=0)) + 1):
            going_on = lengths >= offset
            starts = self.kept[going_on]
            at = at.take(np.flatnonzero(going_on[alive])) @ steps.take(starts + offset - 1)
            alive = going_on
            places = starts + offset
            rotation[places], translation[places], scale[places] = at.rotation, at.translation, at.scale
        return Sim3Batch(rotation, translation, scale)

    def _shares(self, placed: Sim3Batch, left: Array) -> Array:
        """Errors (N, 7) of the edges, each in the frame of its end, that sum up to what is ``left`` (M - 1, 7).

        The least ones by their covariances: ``error_m = C_m A_m^T (sum of A C A^T)^-1 left`` with the adjoint A from
        m to the end of its stretch.
        """
        out = np.zeros((len(placed), 7))
        size = 6 if self.is_metric else 7
        for n, (a, b) in enumerate(pairwise(self.kept.tolist())):
            own = np.arange(a + 1, b + 1)
            carry = (placed.take(np.full(len(own), b)).inverse() @ placed.take(own)).adjoint()
            covariances = self.covariances[own]
            total = (carry @ covariances @ carry.transpose(0, 2, 1)).sum(axis=0)
            pull = np.zeros(7)
            pull[:size] = np.linalg.solve(total[:size, :size], left[n, :size])
            out[own] = np.einsum("mij,mkj,k->mi", covariances, carry, pull)
        return out


def reduce_chain(
    chain: Mapping[int, Sim3], adjacent: Sequence[Edge], loops: Sequence[Edge], *, is_metric: bool
) -> Skeleton | None:
    """The skeleton of a component, or None where its adjacent edges are no single chain.

    Args:
        chain: start poses of all submaps, composed of the adjacent edges.
        adjacent: edges between successive submaps.
        loops: edges whose ends are kept.
        is_metric: scales are known: their uncertainty takes no part.
    """
    members = tuple(sorted(chain))
    by_end = {edge.j: edge for edge in adjacent}
    is_chain = len(adjacent) == len(members) - 1 and all(b in by_end and by_end[b].i == a for a, b in pairwise(members))
    if not is_chain:
        return None
    place = {index: position for position, index in enumerate(members)}
    kept = np.array(sorted({0} | {place[end] for edge in loops for end in (edge.i, edge.j)}), dtype=np.intp)
    poses = Sim3Batch.of([chain[index] for index in members])
    covariances = np.zeros((len(members), 7, 7))
    covariances[1:] = _covariances([by_end[index].information for index in members[1:]], is_metric=is_metric)
    next_kept = kept[np.minimum(np.searchsorted(kept, np.arange(len(members))), len(kept) - 1)]
    carry = (poses.take(next_kept).inverse() @ poses).adjoint()
    carried = carry @ covariances @ carry.transpose(0, 2, 1)
    edges = []
    for a, b in pairwise(kept.tolist()):
        first, last = by_end[members[a + 1]], by_end[members[b]]
        if b == a + 1:
            edges.append(last)
            continue
        information = _information(carried[a + 1 : b + 1].sum(axis=0), is_metric=is_metric)
        name = f"{first.edge_id} to {last.edge_id}"
        edges.append(Edge(name, members[a], members[b], poses[b].inverse() @ poses[a], information, last.loss))
    return Skeleton(members, kept, poses, tuple(edges), covariances, is_metric)


def _covariances(informations: Sequence[Array], *, is_metric: bool) -> Array:
    """Covariances (N, 7, 7); without uncertainty of scale where it is known."""
    size = 6 if is_metric else 7
    out = np.zeros((len(informations), 7, 7))
    if informations:
        out[:, :size, :size] = np.linalg.inv(np.array(informations)[:, :size, :size])
    return out


def _information(covariance: Array, *, is_metric: bool) -> Array:
    size = 6 if is_metric else 7
    out = np.zeros((7, 7))
    out[:size, :size] = np.linalg.inv(covariance[:size, :size])
    return out
