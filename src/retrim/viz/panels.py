"""Plain panels of curves, for pictures of a model."""

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from .plots import ADAPTED, BASE, INK, PUSH, UPDATE

COLORS = (ADAPTED, BASE, UPDATE, PUSH, "#CC79A7", "#56B4E9")


@dataclass(frozen=True)
class Curve:
    """One line, or with ``marks`` only points."""

    x: np.ndarray
    y: np.ndarray
    label: str
    dashed: bool = False
    marks: bool = False
    color: int | None = None
    """Which of the colours; the next by default."""


@dataclass(frozen=True)
class Panel:
    """One pair of axes."""

    title: str
    x: str
    y: str
    curves: Sequence[Curve]
    columns: int = 1
    """Of the legend."""


def panel_figure(title: str, panels: Sequence[Panel], *, across: int = 3) -> Figure:
    """Panels in rows of ``across``."""
    down = -(-len(panels) // across)
    with plt.rc_context(
        {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "svg.fonttype": "none"}
    ):
        figure, grid = plt.subplots(
            down, across, figsize=(4.6 * across, 3.7 * down), layout="constrained", facecolor="white", squeeze=False
        )
        figure.suptitle(title, fontsize=14, fontweight="bold", color=INK)
        for axes, panel in zip(grid.flat, panels, strict=False):
            for i, curve in enumerate(panel.curves):
                color = COLORS[(i if curve.color is None else curve.color) % len(COLORS)]
                style = "none" if curve.marks else "--" if curve.dashed else "-"
                marker = "o" if curve.marks else None
                axes.plot(
                    curve.x, curve.y, linestyle=style, marker=marker, markersize=4, color=color, label=curve.label
                )
            axes.set(xlabel=panel.x, ylabel=panel.y)
            axes.set_title(panel.title, fontsize=11, color=INK)
            axes.grid(alpha=0.25)
            axes.legend(fontsize=8, frameon=False, ncols=panel.columns)
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
    return figure
