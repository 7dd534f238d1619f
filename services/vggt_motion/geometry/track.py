"""A sequence of timed camera poses: what metrics compare and trajectory files hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class PoseTrack:
    """Poses of one camera, in the order of the file or of time."""

    times_ns: npt.NDArray[np.int64]  # (N,) capture times
    world_from_camera: npt.NDArray[np.float64]  # (N, 4, 4)

    def __post_init__(self) -> None:
        if self.times_ns.ndim != 1 or self.world_from_camera.shape != (len(self.times_ns), 4, 4):
            raise ValueError(f"shapes do not fit: {self.times_ns.shape} times, {self.world_from_camera.shape} poses")

    def __len__(self) -> int:
        return len(self.times_ns)

    @property
    def positions(self) -> npt.NDArray[np.float64]:
        """Camera centres (N, 3) in the world."""
        return self.world_from_camera[:, :3, 3]

    def path_length(self) -> float:
        """Length of the polyline through the camera centres, world units."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def subset(self, indices: npt.NDArray[np.integer]) -> PoseTrack:
        """The poses at the given positions, in their order."""
        return PoseTrack(self.times_ns[indices], self.world_from_camera[indices])
