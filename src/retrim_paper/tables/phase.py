"""Flies the paper's tracking formulation with several readings of its observation, from blind to state and error."""

from collections.abc import Mapping, Sequence
from typing import Any

from retrim.config.loading import changed
from retrim.config.scenario import Scenario
from retrim.errors import ConfigError
from retrim.evaluation.study import table_presets
from retrim.runkit.document import Document
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run

from .levels import Levels, fly_levels
from .track import PAPER

INTRO = """\
Made by `retrim reproduce phase`. The paper prints o = [p, R, v] as the observation of hover and tracking. This page
flies the paper's reward, network, budgets and adaptation loop (preset `track/paper`) with four readings of this
observation, with one policy for each reference and reading. Error over the last 10 s [m]: mean ± standard deviation
over flights, at the reference's own time; in step: after the best constant shift in time; cross-track: from the nearest
point of the lap. In brackets the paper's figures, which are from its own plant. Readings:"""
LIMITS = """\
A blind policy has no information about the phase of its reference: its closed loop is an autonomous oscillator, and no
command can correct a shift that it cannot observe, so that its error is about as large as the reference. A relative
policy observes its error and corrects it, but it cannot know where on the reference it is: it reacts to a corner of the
star after the corner, and a constant lag of the plant remains unless past commands show it. A policy with both observes
where it is and where it should be, can memorise one reference, and begins its turn before the corner."""
DELAY: dict[str, Any] = {"delay_ticks": 1, "command_history": 2}
READINGS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "blind": ("o = [p, R, v], 15 numbers", "blind", {}),
    "relative": ("o = [p - p_ref(t), R, v - v_ref(t)], 15 numbers", "relative", {}),
    "relative-delay": (
        "relative with the last two commands, and one tick of delay in the model, 23 numbers", "relative", DELAY,
    ),
    "both": ("o = [p, R, v, p - p_ref(t), v - v_ref(t)], 21 numbers", "both", {}),
}  # fmt: skip
"""Description, observation and preset changes of each reading."""


def phase(
    run: Run,
    reporter: Reporter,
    *,
    readings: tuple[str, ...] = tuple(READINGS),
    references: tuple[str, ...] = ("circle", "figure8", "star"),
    methods: tuple[str, ...] = ("base", "full", "lora"),
    seeds: tuple[int, ...] = (0,),
    seconds: float = 60.0,
    starts: int = 4,
    plant: str = "bem",
) -> None:
    """The paper's tracking formulation with four observations, from blind to state and tracking error.

    Args:
        run: Folder for phase.md, phase.json and the pictures.
        reporter: Receives progress and the sections.
        readings: Readings of the observation: blind, relative, relative-delay, both.
        references: References to track: circle, figure8, star.
        methods: Methods to fly.
        seeds: Training seeds.
        seconds: Length of a flight [s].
        starts: Flights per disturbance, method and seed.
        plant: Plant for the flights.
    """
    _check("reading", readings, READINGS)
    _check("reference", references, PAPER)
    (paper,) = table_presets(["track/paper"], "track", seeds=seeds, starts=starts, seconds=seconds)
    sections = []
    for reference in references:
        for reading in readings:
            _, observation, changes = READINGS[reading]
            own = changed(paper, **changes, track={"observation": observation, "reference": reference})
            scenario, stem = Scenario(plant=plant, reference=reference), f"phase_{reference}_{reading}"
            sections.append(Levels(f"{reference}, {reading}", own, scenario, stem, methods, PAPER[reference]))
    about = "\n".join(f"* {name}: {READINGS[name][0]}" for name in readings)
    title = "Readings of the paper's observation for tracking"
    document = Document(run, "phase", title, f"{INTRO}\n\n{about}\n\n{LIMITS}", seeds, reporter)
    fly_levels(document, sections, starts=starts, seconds=seconds)


def _check(what: str, names: Sequence[str], options: Mapping[str, Any]) -> None:
    for name in names:
        if name not in options:
            raise ConfigError(f"{what} {name!r}: there are {', '.join(options)}")
