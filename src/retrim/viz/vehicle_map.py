"""Draw maps of vehicles, with lag on the x axis, delay on the y axis, and each vehicle's error as a colour."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from .plots import INK
from .sheet import sheet

if TYPE_CHECKING:
    import matplotlib.figure

SMALLEST, LARGEST = 1e-3, 1.0  # [m]: ends of the colour scale
PANELS_PER_ROW = 4  # panels per row
LOST = "#D55E00"


def vehicle_map(
    title: str, lag: np.ndarray, delay: np.ndarray, errors: Mapping[str, np.ndarray], colour: str
) -> "matplotlib.figure.Figure":
    """Draw one panel per method, with a dot for each vehicle.

    Args:
        title: Title of the figure.
        lag: Time constant of the body rates of each vehicle [s].
        delay: Command delay of each vehicle [s].
        errors: Error of each vehicle [m], by method; infinite for a lost vehicle.
        colour: Label of the colour scale.
    """
    from matplotlib.colors import LogNorm

    down, across = -(-len(errors) // PANELS_PER_ROW), min(PANELS_PER_ROW, len(errors))
    with sheet((2.9 * across + 0.8, 2.9 * down + 0.6), 9.0, boxed=True) as figure:
        grid = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
        figure.suptitle(title, fontsize=12, fontweight="bold", color=INK)
        image = None
        for axes, (name, values) in zip(grid.flat, errors.items(), strict=False):
            missing = ~np.isfinite(values)
            image = axes.scatter(
                1000 * lag[~missing],
                1000 * delay[~missing],
                c=np.clip(values[~missing], SMALLEST, LARGEST),
                norm=LogNorm(SMALLEST, LARGEST),
                cmap="viridis_r",
                s=16,
                linewidths=0,
            )
            axes.scatter(1000 * lag[missing], 1000 * delay[missing], color=LOST, marker="x", s=22, linewidths=1.2)
            axes.set_title(f"{name}: {int(missing.sum())} of {len(values)} lost", fontsize=9, color=INK)
            axes.set_xscale("log")
            axes.set_xticks([15, 30, 60, 100, 150], ["15", "30", "60", "100", "150"])
            axes.minorticks_off()
            axes.grid(alpha=0.25)
        for axes in grid[-1]:
            axes.set_xlabel("lag of the body rates [ms]")
        for axes in grid[:, 0]:
            axes.set_ylabel("delay of commands [ms]")
        for axes in grid.flat[len(errors) :]:
            axes.set_visible(False)
        if image is not None:
            bar = figure.colorbar(image, ax=grid, shrink=0.8, label=colour)
            bar.set_ticks([1e-3, 1e-2, 1e-1, 1.0], labels=["0.001", "0.01", "0.1", "1"])
    return figure
