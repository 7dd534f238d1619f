"""The look of our plots and what they share: colours, axes seen from above, and files without a clock in them.

Colours are those of Okabe and Ito, which colour-blind readers tell apart; nothing is told by colour alone. Text that
came from outside is never read as mathematics.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vggt_motion.geometry.track import PoseTrack

BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY, YELLOW = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#56B4E9",
    "#F0E442",
)
INK, MUTED, GRID = "#1b1f24", "#6a737d", "#e3e6ea"
PART_COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
WIDTH_IN = 9.6

_STYLE: dict[Any, Any] = {
    "font.size": 10.5,
    "font.family": "sans-serif",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlesize": 11.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": GRID,
    "legend.fontsize": 9.5,
    "svg.fonttype": "path",
    "svg.hashsalt": "vggt_motion",  # without it the identifiers in the file differ from run to run
    "figure.facecolor": "white",
    "text.parse_math": False,
}


@contextmanager
def styled() -> Iterator[None]:
    """Our look, for whatever builds or writes a figure."""
    with matplotlib.rc_context(_STYLE):
        yield


@styled()
def to_svg(figure: Figure) -> bytes:
    """The figure as an SVG file, the same bytes for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


@styled()
def to_png(figure: Figure, dots_per_inch: int = 160) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png", dpi=dots_per_inch, metadata={"Software": None})
    return buffer.getvalue()


@dataclass(frozen=True)
class Plan:
    """Which world axes lie on the paper: x right and z up or, for a drive much longer ahead, z right and x down."""

    is_turned: bool

    def horizontal(self, positions: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        """Of positions (N, 3), what goes along the paper: (N,)."""
        return positions[:, 2] if self.is_turned else positions[:, 0]

    def vertical(self, positions: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        """Of positions (N, 3), what goes up or down the paper: (N,)."""
        return positions[:, 0] if self.is_turned else positions[:, 2]

    def label(self, axes: Any, unit: str) -> None:
        """Name both axes, with their unit."""
        ahead, right = f"ahead, z ({unit})", f"to the right, x ({unit})"
        axes.set_xlabel(ahead if self.is_turned else right)
        axes.set_ylabel(right if self.is_turned else ahead)


def mark_ends(axes: Any, plan: Plan, positions: npt.NDArray[np.floating], is_labelled: bool) -> None:
    """Mark the first and the last of positions (N, 3)."""
    h, v = plan.horizontal(positions), plan.vertical(positions)
    axes.plot(h[0], v[0], "o", ms=9, mfc="white", mec=INK, mew=1.8, zorder=6, label="start" if is_labelled else None)
    axes.plot(h[-1], v[-1], "s", ms=8, mfc=INK, mec="white", mew=1.2, zorder=6, label="end" if is_labelled else None)


def legend_above(axes: Any) -> None:
    """A legend in rows over the axes, where it covers nothing."""
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5, frameon=False, borderaxespad=0.1, handlelength=1.4
    )


def finite(track: PoseTrack) -> PoseTrack:
    """The poses without NaN or infinity."""
    return track.subset(np.flatnonzero(np.isfinite(track.world_from_camera).all(axis=(1, 2))))


def panel_inches(ratio: float, width: float, lowest: float = 1.7, highest: float = 7.2) -> float:
    """Height of a panel of a given width and height over width, within what a page can show."""
    return float(np.clip(ratio * width, lowest, highest))
