"""Draws pictures of flights."""

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from ..config.methods import find_method
from ..config.scenario import Scenario
from ..config.setup import Setup
from ..physics.effects import ExternalEffects
from ..physics.state import State
from ..runkit.disturbance_text import describe_effects
from ..runkit.flights import Flight
from ..runkit.recovery import FREQUENT, timeline
from ..tasks.observation import AbstractObservation
from ..tasks.reference import Reference
from ..tasks.track import AbstractTrack
from ..tasks.transition import SplicedReference
from ..viz import animation, plots

LONGEST_STEM = 200  # [bytes]; file systems accept names of 255
USER_EVENTS = ("request", "asked", "knobs", "reference")
"""Kinds of events that a user causes in a live flight; "asked" is in earlier recordings."""


def picture(
    flights: Sequence[Flight],
    setup: Setup,
    scenario: Scenario,
    folder: Path,
    *,
    stem: str | None = None,
    title: str | None = None,
    labels: Mapping[str, str] = MappingProxyType({}),
) -> list[Path]:
    """Draw the flights of one scenario, with all methods in one picture.

    Args:
        flights: Flights; those of other scenarios are left out.
        setup: Set-up of the policy's preset, with the scenario's reference.
        scenario: Scenario whose flights are drawn.
        folder: Output folder.
        stem: Name of the files, without a suffix; by default the task and the disturbance.
        title: Title of the picture; by default the conditions of the flights.
        labels: Method labels by name; by default those in tables.

    Returns:
        Paths of the PNG and the SVG; an empty list if no flight belongs to this scenario.
    """
    shown_flights = [f for f in flights if f.spec.scenario == scenario]
    if not shown_flights:
        return []
    methods = list(dict.fromkeys(f.spec.method for f in shown_flights))
    by = {method: [f for f in shown_flights if f.spec.method == method] for method in methods}
    names = {method: labels.get(method, find_method(method).label.strip("*")) for method in methods}
    colours = _colours(methods)
    groups = [plots.Group(names[method], [_track(f) for f in by[method]], colours[method]) for method in methods]
    seconds = max(float(track.t[-1]) for group in groups for track in group.tracks)
    task, preset = setup.flight_task, setup.preset
    where = f"{shown_flights[0].vehicle} on plant {scenario.plant!r}"
    kind = preset.task if ":" in preset.task else preset.task.capitalize()
    title = title or f"{kind}: {where}, disturbance {scenario.disturbance!r}, preset {preset.name!r}"

    firsts = [_image_track(setup.env.task.observation, by[method][0].log.true.as_state()) for method in methods]
    at_home = _image_track(setup.env.task.observation, jax.tree.map(lambda leaf: leaf[None], State.at(task.home())))
    if at_home is not None:
        visible_flights = [
            plots.Group(names[method], [track], colours[method])
            for method, track in zip(methods, firsts, strict=True)
            if track is not None
        ]
        beside = partial(plots.camera, groups=visible_flights, goal=at_home.pixel[0])
    elif isinstance(task, AbstractTrack) and isinstance(task.reference, Reference):
        beside = partial(plots.laps, groups=groups, lap=np.asarray(task.reference.rows)[:, :3])
    elif isinstance(task, AbstractTrack) and isinstance(task.reference, SplicedReference):
        last = shown_flights[0].log.t >= shown_flights[0].log.t[-1] - plots.LAPS_S
        beside = partial(plots.laps, groups=groups, lap=np.asarray(shown_flights[0].target)[last])
    else:
        x, y, z = (float(value) for value in task.home())
        beside = partial(plots.paths, groups=groups, goal=(x, y, z))
    figure = plots.flight_figure(title, groups, spans(scenario.disturbance, task.home(), seconds), beside)
    return plots.save(figure, folder, stem or file_stem(f"{preset.task}_{scenario.disturbance}"))


def file_stem(name: str) -> str:
    """Return a file name without its suffix for a name; a digest replaces the end of a name that is too long."""
    stem = "".join(sign if sign.isalnum() or sign in "-." else "_" for sign in name)
    if len(stem.encode()) <= LONGEST_STEM:
        return stem
    return f"{stem[: LONGEST_STEM // 4]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def animate(
    flights: Sequence[Flight], setup: Setup, scenario: Scenario, title: str, labels: Mapping[str, str]
) -> bytes:
    """Return an animated GIF with the first flight of each method in one scenario.

    Args:
        flights: Flights; those of other scenarios are left out, and at least one must remain.
        setup: Set-up of the policy's preset.
        scenario: Scenario whose flights are shown.
        title: Title of the animation.
        labels: Method labels by name; by default those in tables.
    """
    firsts = dict[str, Flight]()
    for flight in flights:
        if flight.spec.scenario == scenario:
            firsts.setdefault(flight.spec.method, flight)
    home, colours = setup.flight_task.home(), _colours(list(firsts))
    actors = [
        animation.Actor(
            labels.get(method, find_method(method).label.strip("*")), plots.GROUPS[colours[method] % len(plots.GROUPS)],
            flight.log.t, flight.log.p - np.asarray(home), flight.log.R, flight.error, flight.log.terminated,
        )
        for method, flight in firsts.items()
    ]  # fmt: skip
    seconds = max(float(actor.t[-1]) for actor in actors)
    return animation.animate(title, actors, spans(scenario.disturbance, home, seconds))


def spans(name: str, home: Array, seconds: float) -> list[plots.Span]:
    """Return the time spans of a disturbance, with labels; a disturbance that changes all the time has one span."""
    times, result, changes = timeline(name, home, seconds)
    if len(changes) > FREQUENT:
        return [plots.Span(0.0, seconds, name, strong=False)]
    marks = []
    for first, after in itertools.pairwise([0, *changes, len(times)]):
        end = float(times[after]) if after < len(times) else seconds
        here: ExternalEffects = jax.tree.map(lambda leaf, i=first: np.asarray(leaf)[i], result)
        if label := describe_effects(here):
            marks.append(plots.Span(float(times[first]), end, label, strong=bool(here.push[0] < 0)))
    return marks


def _colours(methods: Sequence[str]) -> dict[str, int]:
    """Return the colour index of each method.

    The base policy and full adaptation have fixed colours. Other methods receive the remaining ones in order. If full
    adaptation is absent, its colour is also available.
    """
    own = {"base": 0, "full": 1}
    left = itertools.count(2 if "full" in methods else 1)
    return {method: own[method] if method in own else next(left) for method in methods}


def _track(flight: Flight) -> plots.Track:
    return plots.Track(
        flight.log.t, flight.log.p, flight.error, flight.swaps, flight.log.terminated, flight.steady_seconds,
        tuple((event.t, event.note) for event in flight.log.events if event.kind in USER_EVENTS),
    )  # fmt: skip


def _image_track(observation: AbstractObservation[Any], x: State) -> plots.ImageTrack | None:
    points = _image(observation, x)
    return None if points is None else plots.ImageTrack(*map(np.asarray, points))


@eqx.filter_jit
def _image(observation: AbstractObservation[Any], x: State) -> tuple[Array, Array] | None:
    points: tuple[Array, Array] | None = jax.vmap(observation.image)(x)
    return points
