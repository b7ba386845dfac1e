"""Draw pictures of flights."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from .sheet import sheet

if TYPE_CHECKING:
    import matplotlib.axes
    import matplotlib.figure

T = TypeVar("T")

# Okabe and Ito's colours, which people with any colour vision can distinguish.
BASE, ADAPTED, UPDATE, PUSH, INK = "#D55E00", "#0072B2", "#009E73", "#E69F00", "#333333"
GROUPS = (BASE, ADAPTED, "#CC79A7", "#56B4E9")
LAPS_S = 10.0  # [s]: duration at the end of a flight for which the path is drawn from above
MOST_WORDS = 8  # maximum number of marks with text
ASPECT = 720 / 1280  # aspect ratio of a camera's image, whose axes both run from -1 to 1


@dataclass(frozen=True)
class Track:
    """One flight to draw."""

    t: np.ndarray
    """Times [s]."""
    p: np.ndarray
    """Positions in the world frame [m], ticks x 3."""
    error: np.ndarray
    """Error [m]."""
    swaps: tuple[float, ...] = ()
    """Times of policy swaps [s]."""
    crashed: bool = False
    last_s: float = 2.0
    """Duration at the end of the flight over which the error is averaged [s]."""
    marks: tuple[tuple[float, str], ...] = ()
    """Time [s] and text of each user action."""


@dataclass(frozen=True)
class Group(Generic[T]):
    """Flights of one method."""

    name: str
    tracks: Sequence[T]
    colour: int = 0
    """Index in :data:`GROUPS`."""


@dataclass(frozen=True)
class ImageTrack:
    """Image points of the camera during one flight."""

    pixel: np.ndarray
    """Image coordinates, ticks x points x 2; the image is [-1, 1] x [-1, 1]."""
    visible: np.ndarray
    """Visibility of the points, ticks x points."""


@dataclass(frozen=True)
class Span:
    """A disturbance and its duration."""

    start: float
    """Start [s]."""
    end: float
    label: str
    strong: bool
    """Whether the span is drawn darker, to distinguish a push from its reverse."""


def flight_figure(
    title: str,
    groups: Sequence[Group[Track]],
    spans: Sequence[Span],
    beside: Callable[["matplotlib.axes.Axes"], None],
) -> "matplotlib.figure.Figure":
    """Draw the errors of all groups over time, with thick lines for the means; ``beside`` draws the right panel."""
    with sheet((13.0, 5.4), 11.0) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1.9, 1))
        figure.suptitle(title, fontsize=14, fontweight="bold", color=INK)
        _errors(left, groups, spans)
        beside(right)
        figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=10)
    return figure


def save(figure: "matplotlib.figure.Figure", folder: Path, name: str) -> list[Path]:
    """Write the figure as a PNG and an SVG file; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.{kind}" for kind in ("png", "svg")]
    for path in paths:
        figure.savefig(path, dpi=130, metadata={"Date": None} if path.suffix == ".svg" else None)
        figure.set_layout_engine("none")  # keep the layout of the first file
    return paths


def _colour_groups(groups: Sequence[Group[T]]) -> Iterator[tuple[Sequence[T], str, str]]:
    """Yield the tracks, the colour and the name of each group."""
    for group in groups:
        yield group.tracks, GROUPS[group.colour % len(GROUPS)], group.name


def _errors(axes: "matplotlib.axes.Axes", groups: Sequence[Group[Track]], spans: Sequence[Span]) -> None:
    every = [track for group in groups for track in group.tracks]
    finite = [track.error[np.isfinite(track.error)] for track in every]  # errors at the end of a flight may be NaN
    top = 1.15 * max((float(error.max()) for error in finite if len(error)), default=1.0)
    for span in spans:
        axes.axvspan(span.start, span.end, color=PUSH, alpha=0.28 if span.strong else 0.13, linewidth=0)
        axes.text(
            (span.start + span.end) / 2, 0.985 * top, span.label,
            ha="center", va="top", color="#8a5a00", fontsize=9 if len(spans) > 1 else 11, zorder=5,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 2},
        )  # fmt: skip
    swaps = sorted({round(t, 2) for track in every for t in track.swaps})
    few = len(swaps) <= 12  # many lines would hide the flights, so only ticks on the time axis are drawn
    for i, t in enumerate(swaps):
        axes.axvline(
            t, ymax=1.0 if few else 0.03, color=UPDATE, linestyle="--" if few else "-", linewidth=1.2,
            label=None if i else "new policy takes over",
        )  # fmt: skip
    _marks(axes, sorted({mark for track in every for mark in track.marks}), top)
    for tracks, color, name in _colour_groups(groups):
        for i, track in enumerate(tracks):
            label = f"{name}: single flights" if len(tracks) > 1 and i == 0 else None
            axes.plot(track.t, track.error, color=color, alpha=0.35, linewidth=0.8, label=label)
            if track.crashed:
                finite_points = np.flatnonzero(np.isfinite(track.error))
                end = track.t[-1], track.error[finite_points[-1]] if len(finite_points) else 0.0
                axes.plot(*end, "x", color=color, markersize=10, clip_on=False)
                axes.annotate("crashed", end, color=color, fontsize=9, ha="right")
        whole = [track for track in tracks if not track.crashed]
        if whole:
            mean, first = np.mean([track.error for track in whole], axis=0), whole[0]
            late = first.t > first.t[-1] - first.last_s
            centimetres = 100 * mean[late].mean()
            number = f"{centimetres:.1f}" if centimetres >= 0.05 else "below 0.1"
            final = f"{number} cm over the last {first.last_s:g} s"
            axes.plot(first.t, mean, color=color, linewidth=2.4, label=f"{name}: {final}")
    axes.set(xlabel="time [s]", ylabel="distance from where it should be [m]", ylim=(0, top))
    axes.margins(x=0)


def _marks(axes: "matplotlib.axes.Axes", marks: Sequence[tuple[float, str]], top: float) -> None:
    """Draw a line for each user action, with text if there are few actions."""
    for i, (t, words) in enumerate(marks):
        axes.axvline(t, color=INK, linestyle=":", linewidth=1.2, label=None if i else "operator action")
        if len(marks) <= MOST_WORDS:
            axes.text(t, 0.9 * top, f" {words[:40]}", rotation=90, ha="right", va="top", color=INK, fontsize=8,
                      parse_math=False)  # fmt: skip


def paths(axes: "matplotlib.axes.Axes", groups: Sequence[Group[Track]], goal: tuple[float, float, float]) -> None:
    """Draw the paths to the goal, seen from above."""
    for tracks, color, name in _colour_groups(groups):
        for i, track in enumerate(tracks):
            axes.plot(track.p[:, 0], track.p[:, 1], color=color, alpha=0.35, linewidth=0.9)
            axes.plot(
                *track.p[0, :2],
                ".",
                color="#999999",
                markersize=5,
                label="starts" if i == 0 and name == groups[0].name else None,
            )
        for i, track in enumerate(tracks):
            axes.plot(
                *track.p[-1, :2], "o", color=color, markersize=7, markeredgecolor="white",
                label=None if i else f"{name}, at the end",
            )  # fmt: skip
    axes.plot(goal[0], goal[1], "+", color=INK, markersize=18, markeredgewidth=2, label="target")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="the same flights from above")
    axes.set_aspect("equal", adjustable="datalim")


def laps(axes: "matplotlib.axes.Axes", groups: Sequence[Group[Track]], lap: np.ndarray) -> None:
    """Draw the paths of the last ten seconds over the lap (points x 3), seen from above."""
    axes.plot(lap[:, 0], lap[:, 1], color="#BBBBBB", linewidth=5, label="reference", zorder=1)
    for tracks, color, name in _colour_groups(groups):
        for i, track in enumerate(track for track in tracks if not track.crashed):
            last = track.t >= track.t[-1] - LAPS_S
            axes.plot(
                track.p[last, 0], track.p[last, 1], color=color, alpha=0.8, linewidth=0.9, zorder=2,
                label=None if i else f"{name}, last {LAPS_S:g} s",
            )  # fmt: skip
    axes.set(xlabel="x [m]", ylabel="y [m]", title="the last laps from above")
    axes.set_aspect("equal", adjustable="datalim")


def camera(axes: "matplotlib.axes.Axes", groups: Sequence[Group[ImageTrack]], goal: np.ndarray) -> None:
    """Draw image points in the first flight of each group; ``goal`` (points x 2): those at the goal."""
    for sightings, color, name in _colour_groups(groups):
        for sighting in sightings[:1]:
            dots = np.where(sighting.visible[:, :, None], sighting.pixel, np.nan)
            for i in range(dots.shape[1]):
                axes.plot(dots[:, i, 0], dots[:, i, 1], color=color, alpha=0.5, linewidth=0.9)
                axes.plot(
                    dots[-1, i, 0], dots[-1, i, 1], "o", color=color, markersize=7, markeredgecolor="white",
                    label=None if i else f"{name}, at the end",
                )  # fmt: skip
            first = dots[0][sighting.visible[0]]
            axes.plot(
                first[:, 0], first[:, 1], ".", color="#999999", label="at the start" if name == groups[0].name else None
            )
    axes.plot(goal[:, 0], goal[:, 1], "+", color=INK, markersize=14, markeredgewidth=1.6, label="at the target")
    axes.set(xlabel="image, across", ylabel="image, down", title="points in the image")
    ticks = (-1.0, -0.5, 0.0, 0.5, 1.0)
    axes.set(xlim=(-1, 1), ylim=(1, -1), xticks=ticks, yticks=ticks, aspect=ASPECT)
    axes.spines[["top", "right"]].set_visible(True)
