"""From flights to pictures."""

import itertools
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .. import build, testbed
from ..physics.conditions import Conditions
from ..physics.state import State
from ..presets import Preset
from ..tasks.keypoints import Keypoints
from ..tasks.reference import Reference
from ..testbed import Setting
from ..viz import plots
from .flights import Flight


def picture(
    flights: Sequence[Flight],
    preset: Preset,
    disturbance: str,
    setting: Setting,
    folder: Path,
    flown: Reference | None = None,
    *,
    stem: str | None = None,
) -> list[Path]:
    """``<task>_<disturbance>`` (or ``stem``) as PNG and SVG, of the flights under one disturbance; returns their paths."""
    shown = [f for f in flights if f.plan.disturbance == disturbance]
    before = [f for f in shown if f.plan.method == "base"]
    after = [f for f in shown if f.plan.method != "base"]
    base, adapted = ([_track(f) for f in group] for group in (before, after))
    seconds = max(float(track.t[-1]) for track in (*base, *adapted))
    where = f"{setting.flown} on plant {setting.plant!r}"
    title = f"{preset.task.capitalize()}: {where}, disturbance {disturbance!r}, preset {preset.name!r}"

    if preset.task == "vision":
        at_goal = _sighting(preset, jax.tree.map(lambda leaf: leaf[None], State.at(jnp.array(preset.goal)))).pixel[0]
        first, last = ([_sighting(preset, f.log.x) for f in group[:1]] for group in (before, after))
        beside = partial(plots.camera, base=first, adapted=last, wanted=at_goal)
    elif flown is not None:
        beside = partial(plots.laps, base=base, adapted=adapted, lap=np.asarray(flown.rows)[:, :3])
    else:
        beside = partial(plots.paths, base=base, adapted=adapted, goal=preset.goal)
    figure = plots.flight_figure(title, base, adapted, spans(disturbance, preset.goal, seconds), beside)
    return plots.save(figure, folder, stem or f"{preset.task}_{disturbance.replace('+', '_')}")


def spans(disturbance: str, goal: tuple[float, float, float], seconds: float) -> list[plots.Span]:
    """When something disturbs the flight, and what; one span for all that changes all the time."""
    times = np.linspace(0.0, seconds, round(10 * seconds), endpoint=False)
    around, x = testbed.disturbance(disturbance), State.at(jnp.array(goal))
    found = jax.vmap(lambda t: around(t, x))(jnp.asarray(times, dtype=x.p.dtype))
    values = np.concatenate([np.asarray(leaf).reshape(len(times), -1) for leaf in jax.tree.leaves(found)], axis=1)
    edges = [0, *(np.flatnonzero(np.any(np.diff(values, axis=0) != 0, axis=1)) + 1), len(times)]
    if len(edges) > 12:
        return [plots.Span(0.0, seconds, disturbance, strong=False)]
    marked = []
    for first, after in itertools.pairwise(edges):
        end = float(times[after]) if after < len(times) else seconds
        here: Conditions = jax.tree.map(lambda leaf, i=first: np.asarray(leaf)[i], found)
        if label := _label(here):
            marked.append(plots.Span(float(times[first]), end, label, strong=bool(here.push[0] < 0)))
    return marked


def _label(here: Conditions) -> str:
    """Conditions in words; empty when calm."""
    words = list[str]()
    if np.any(here.push):
        same = len(set(here.push.tolist())) == 1
        vector = ", ".join(f"{a:+g}" for a in here.push)
        words.append(f"pushed by {here.push[0]:+g} m/s² per axis" if same else f"pushed by ({vector}) m/s²")
    if np.any(here.wind):
        words.append(f"wind of {np.linalg.norm(here.wind):.1f} m/s")
    if here.mass > 0:
        words.append(f"{1000 * here.mass:.0f} g of load")
    if np.any(here.gain != 1):
        words.append("rotors at " + ", ".join(f"{100 * g:.0f}" for g in here.gain) + " %")
    return "; ".join(words)


def _track(flight: Flight) -> plots.Track:
    return plots.Track(flight.log.t, flight.log.p, flight.error, flight.swaps, flight.log.crashed)


def _sighting(preset: Preset, x: State) -> plots.Sighting:
    return plots.Sighting(*map(np.asarray, _pixels(build.keypoints(preset), x)))


@jax.jit
def _pixels(observation: Keypoints, x: State) -> tuple[Array, Array]:
    return jax.vmap(observation.pixels)(x)
