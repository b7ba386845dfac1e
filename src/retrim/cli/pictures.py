"""From flights to pictures."""

import itertools
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from .. import build, presets
from ..physics.state import State
from ..presets import Preset
from ..viz import plots
from .flights import Flight


def picture(flights: Sequence[Flight], preset: Preset, disturbance: str, vehicle: str, folder: Path) -> list[Path]:
    """``hover_<disturbance>.png`` and ``.svg`` of the flights under one disturbance; returns their paths."""
    base, adapted = (
        [_track(f) for f in flights if f.plan.disturbance == disturbance and f.plan.method == method]
        for method in ("base", "full")
    )
    seconds = max(float(track.t[-1]) for track in (*base, *adapted))
    title = f"Hover of the {vehicle} quadrotor, {disturbance} disturbance, preset {preset.name!r}"
    figure = plots.flight_figure(title, base, adapted, pushes(disturbance, seconds), preset.goal)
    return plots.save(figure, folder, f"hover_{disturbance}")


def pushes(disturbance: str, seconds: float) -> list[plots.Push]:
    """The spans of constant push of a disturbance that depends on time alone."""
    t = np.arange(round(seconds / presets.DT)) * presets.DT
    push, nowhere = build.disturbance(disturbance), State.at(jnp.zeros(3))
    a = np.stack([np.asarray(push(jnp.asarray(float(t_i)), nowhere)) for t_i in t[::5]])
    times = t[::5]
    edges = [0, *(np.flatnonzero(np.any(np.diff(a, axis=0) != 0, axis=1)) + 1), len(times)]
    spans = []
    for first, after in itertools.pairwise(edges):
        end = float(times[after]) if after < len(times) else seconds
        if np.any(a[first]):
            spans.append(
                plots.Push(float(times[first]), end, (float(a[first][0]), float(a[first][1]), float(a[first][2])))
            )
    return spans


def _track(flight: Flight) -> plots.Track:
    return plots.Track(flight.log.t, flight.log.p, flight.error, flight.swaps, flight.log.crashed)
