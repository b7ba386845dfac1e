"""Draw errors, paths and commands of flights."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .plots import ADAPTED, BASE, INK, UPDATE
from .sheet import sheet

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Figure

COLOURS = (BASE, ADAPTED, "#CC79A7", "#56B4E9", "#E69F00", "#333333")
MOST_LINES = 12  # more updates are drawn as ticks on the time axis


@dataclass(frozen=True)
class FlightCurves:
    """Curves of one flight."""

    label: str
    """Flights with the same label have the same colour."""
    t: np.ndarray
    """Times [s]."""
    p: np.ndarray
    """Positions in the world frame [m], rows x 3."""
    u: np.ndarray
    """Commands: thrust [m/s^2] and body rates [rad/s], rows x 4."""
    error: np.ndarray | None
    """Error in each row [m]; None if the target is not known."""
    target: np.ndarray | None = None
    """Target positions in the world frame [m], rows x 3; None if the target is not known."""
    updates: tuple[float, ...] = ()
    """Times at which a new policy took over [s]."""
    crashed: bool = False


def curves_figure(title: str, flights: Sequence[FlightCurves]) -> "Figure":
    """Draw the errors with the updates, the paths in the horizontal plane, and the commands.

    Args:
        title: Title of the figure.
        flights: The flights; the first one of each label shows its commands.
    """
    labels = list(dict.fromkeys(flight.label for flight in flights))
    colours = {label: COLOURS[i % len(COLOURS)] for i, label in enumerate(labels)}
    with sheet((11.0, 6.0), 9.0) as figure:
        axes = figure.subplot_mosaic([["error", "error", "path"], ["thrust", "rates", "path"]])
        figure.suptitle(title, fontsize=12, fontweight="bold", color=INK)
        _draw_errors(axes["error"], flights, colours)
        _draw_paths(axes["path"], flights, colours)
        for label, colour in colours.items():
            first = next(flight for flight in flights if flight.label == label)
            axes["thrust"].plot(first.t, first.u[:, 0], color=colour, linewidth=0.9)
            axes["rates"].plot(first.t, np.linalg.norm(first.u[:, 1:], axis=1), color=colour, linewidth=0.9)
        axes["thrust"].set(xlabel="time [s]", ylabel="commanded thrust [m/s²]")
        axes["rates"].set(xlabel="time [s]", ylabel="commanded rates [rad/s]")
        for name in ("error", "thrust", "rates"):
            axes[name].margins(x=0)
    return figure


def _draw_errors(axes: "Axes", flights: Sequence[FlightCurves], colours: dict[str, str]) -> None:
    """Draw the errors over time; the coordinates if no target is known."""
    updates = sorted({round(t, 2) for flight in flights for t in flight.updates})
    few = len(updates) <= MOST_LINES
    for i, t in enumerate(updates):
        axes.axvline(
            t, ymax=1.0 if few else 0.03, color=UPDATE, linestyle="--" if few else "-", linewidth=0.9,
            label=None if i else "new policy",
        )  # fmt: skip
    known, labels = all(flight.error is not None for flight in flights), set[str]()
    for flight in flights:
        label = None if flight.label in labels else flight.label
        labels.add(flight.label)
        if known and flight.error is not None:
            axes.plot(flight.t, flight.error, color=colours[flight.label], linewidth=1.2, label=label)
            end = flight.error[-1]
        else:
            for i, name in enumerate("xyz"):
                axes.plot(flight.t, flight.p[:, i], color=COLOURS[i], linewidth=1.2, label=name if label else None)
            end = flight.p[-1, 2]
        if flight.crashed:
            axes.plot(flight.t[-1], end if np.isfinite(end) else 0.0, "x", color=INK, markersize=8, clip_on=False)
    axes.set(xlabel="time [s]", ylabel="error [m]" if known else "position [m]")
    if known:
        axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False, loc="best")


def _draw_paths(axes: "Axes", flights: Sequence[FlightCurves], colours: dict[str, str]) -> None:
    """Draw the paths and the targets from above."""
    for i, flight in enumerate(flights):
        if flight.target is not None and i == 0:
            axes.plot(flight.target[:, 0], flight.target[:, 1], color="#BBBBBB", linewidth=4)
            axes.plot(*flight.target[-1, :2], "+", color=INK, markersize=14, markeredgewidth=1.6, label="target")
        axes.plot(flight.p[:, 0], flight.p[:, 1], color=colours[flight.label], linewidth=0.9, alpha=0.8)
        axes.plot(*flight.p[0, :2], ".", color="#999999", label=None if i else "start")
        axes.plot(*flight.p[-1, :2], "o", color=colours[flight.label], markeredgecolor="white",
                  label=None if i else "end")  # fmt: skip
    axes.set(xlabel="x [m]", ylabel="y [m]", title="path from above")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(frameon=False)
