"""Draw panels of curves, heat maps and bars."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from .plots import ADAPTED, BASE, INK, PUSH, UPDATE
from .sheet import sheet

if TYPE_CHECKING:
    import matplotlib.figure

COLORS = (ADAPTED, BASE, UPDATE, PUSH, "#CC79A7", "#56B4E9")


@dataclass(frozen=True)
class Curve:
    """A line, or only points if ``marks`` is true."""

    x: np.ndarray
    y: np.ndarray
    label: str
    dashed: bool = False
    marks: bool = False
    color: int | None = None
    """Index of the colour; by default, the next one."""


@dataclass(frozen=True)
class Panel:
    """A pair of axes with curves."""

    title: str
    x: str
    y: str
    curves: Sequence[Curve]
    columns: int = 1
    """Number of columns of the legend."""
    log: bool = False
    """Whether both axes are logarithmic."""


def panel_figure(title: str, panels: Sequence[Panel], *, across: int = 3) -> "matplotlib.figure.Figure":
    """Draw panels in rows of ``across``."""
    down = -(-len(panels) // across)
    with sheet((4.6 * across, 3.7 * down), 10.0) as figure:
        grid = figure.subplots(down, across, squeeze=False)
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
            if panel.log:
                axes.set(xscale="log", yscale="log")
                for label in (*axes.get_xticklabels(which="both"), *axes.get_yticklabels(which="both")):
                    label.set_parse_math(True)  # for powers of ten; other names are plain text
            axes.set_title(panel.title, fontsize=11, color=INK)
            axes.grid(alpha=0.25)
            axes.legend(fontsize=8, frameon=False, ncols=panel.columns)
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
    return figure


def heat_map(
    titles: Sequence[str], rows: Sequence[str], columns: Sequence[str], values: np.ndarray
) -> "matplotlib.figure.Figure":
    """Draw tables of numbers side by side, with darker cells for larger numbers.

    Each table has its own logarithmic colour scale.

    Args:
        titles: Title of each table.
        rows: Labels of the rows.
        columns: Labels of the columns.
        values: Tables x rows x columns, not negative; infinity is written as a symbol, and NaN cells stay white.
    """
    size = (2.6 + len(titles) * (0.6 + 0.75 * len(columns)), 1.2 + 0.3 * len(rows))
    with sheet(size, 9.0, boxed=True) as figure:
        grid = figure.subplots(1, len(titles), squeeze=False, sharey=True)
        for axes, title, table in zip(grid.flat, titles, values, strict=True):
            finite = table[np.isfinite(table)]
            top = max(finite.max(initial=1e-3), 1e-3)
            shade = np.log10(np.clip(np.where(np.isinf(table), top, table), 1e-3 * top, top))
            axes.imshow(shade, cmap="Blues", aspect="auto", vmin=np.log10(1e-3 * top), vmax=np.log10(top) + 0.5)
            for i, j in np.ndindex(table.shape):
                if not np.isnan(table[i, j]):
                    text = "∞" if np.isinf(table[i, j]) else f"{table[i, j]:.3g}"
                    dark = shade[i, j] > np.log10(top) - 0.5
                    axes.text(j, i, text, ha="center", va="center", color="white" if dark else INK, fontsize=8)
            axes.set_xticks(range(len(columns)), columns, rotation=30, ha="right")
            axes.set_yticks(range(len(rows)), rows)
            axes.set_title(title, fontsize=10, color=INK)
    return figure


def bars(title: str, groups: dict[str, dict[str, list[float]]]) -> "matplotlib.figure.Figure":
    """Draw a group of bars for each label, with a bar for the mean of each method and a dot for each flight.

    An infinite value means a crashed flight; the number of crashes is written at the bar's position.
    """
    methods = list(dict.fromkeys(method for group in groups.values() for method in group))
    with sheet((max(6.0, 1.1 * len(groups) * len(methods)), 4.5), 10.0) as figure:
        axes = figure.subplots()
        width = 0.8 / len(methods)
        others = cycle(color for color in COLORS if color != BASE)
        for k, method in enumerate(methods):
            places = np.arange(len(groups)) + (k - (len(methods) - 1) / 2) * width
            color = BASE if method == "base" else next(others)
            finite = [[v for v in group.get(method, []) if np.isfinite(v)] for group in groups.values()]
            means = [float(np.mean(result)) if result else 0.0 for result in finite]
            axes.bar(places, means, 0.9 * width, color=color, alpha=0.5, label=method)
            for place, group, result in zip(places, groups.values(), finite, strict=True):
                axes.plot(np.full(len(result), place), result, "o", color=color, markersize=4)
                if crashes := len(group.get(method, [])) - len(result):
                    axes.annotate(
                        f"{crashes} crashed", (place, 0.0), color=color, rotation=90, ha="center", va="bottom"
                    )
        axes.set_xticks(np.arange(len(groups)), list(groups), rotation=20 if len(groups) > 4 else 0, ha="center")
        axes.set(ylabel="error [m]")
        axes.set_title(title, fontsize=12, color=INK)
        axes.legend(frameon=False)
    return figure
