"""What is fixed to the camera: bonnet, windscreen's dirt, logo, time stamp. Learned while the camera moves.

It stands still in the image while the rest moves, for seconds. So do clouds and the point that one drives towards, but
those move at once when the camera turns, and a cell that moves is never taken for an overlay at that moment. Without
this a bonnet of a third of the image has the majority in every median: it starves the keyframes, hides turns and, on a
motorway under an empty sky, makes the car stand.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from vggt_motion.frontend.flow import CellGrid, Flow

LEARNING_S = 2.0  # of standing still in a moving image
_MEMORY_S = 4.0
_FORGETTING = 4.0  # a moving cell loses what it has so many times faster: noise may move it once in a while
_STILL_SHARE = 0.4  # of tau_flow: 0.3 px
_MOVING_SHARE = 0.1  # of the textured cells; with fewer the image as a whole does not move


class OverlayDetector:
    """Tells the cells that are fixed to the camera, frame by frame; causal and deterministic."""

    def __init__(self, grid: CellGrid, static_flow_px: float) -> None:
        """Know nothing yet.

        Args:
            grid: of the working image.
            static_flow_px: tau_flow, px of the working image.
        """
        self._static_flow_px = static_flow_px
        self._still_s = np.zeros((grid.rows, grid.columns), np.float32)

    def update(self, flow_cells: Flow, textured: npt.NDArray[np.bool_], interval_s: float) -> npt.NDArray[np.bool_]:
        """Take in one flow field.

        Args:
            flow_cells: (rows, columns, 2) px.
            textured: (rows, columns), cells that can tell.
            interval_s: time between the two frames.

        Returns:
            (rows, columns), True where what is seen is fixed to the camera.
        """
        length = np.hypot(flow_cells[..., 0], flow_cells[..., 1])
        is_still = length < _STILL_SHARE * self._static_flow_px
        moving = np.count_nonzero((length >= self._static_flow_px) & textured)
        if moving >= max(1.0, _MOVING_SHARE * np.count_nonzero(textured)):
            # a long gap between two frames is no long observation
            seconds = min(interval_s, 0.25 * LEARNING_S)
            self._still_s += np.where(is_still, seconds, -_FORGETTING * seconds).astype(np.float32)
            np.clip(self._still_s, 0.0, _MEMORY_S, out=self._still_s)
        return np.asarray(is_still & (self._still_s >= LEARNING_S))
