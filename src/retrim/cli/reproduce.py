"""``retrim reproduce``: a command for each table."""

import threading
from collections.abc import Callable
from pathlib import Path

from ..experiments import tables
from ..experiments.run import Run
from ..experiments.tables.vision import TITLES
from .console import RichReporter, show_paths, started

Ordered = Callable[[threading.Event], int]


def _ordered(name: str, out: Path | None, make: Callable[[Run, RichReporter], None]) -> Ordered:
    def ordered(stop: threading.Event) -> int:
        run = started(Run("reproduce", out, stop=stop))
        make(run, RichReporter())
        show_paths([run.folder / f"{name}.md"])
        return run.exit_code

    return ordered


def hover(
    presets: tuple[str, ...] = ("hover/fast", "hover/released", "hover/paper"),
    seeds: tuple[int, ...] = (0, 1, 2),
    seconds: float = 30.0,
    starts: int = 8,
    plant: str = "bem",
    sensors: str = "ideal",
    out: Path | None = None,
) -> Ordered:
    """Table I: hover under three disturbances, for each preset, over several training seeds.

    Args:
        presets: Presets to train and fly.
        seeds: Training seeds; each also seeds the starts and the learners of its flights.
        seconds: Length of a flight.
        starts: Flights per disturbance, method and seed.
        plant: Where the policies fly.
        sensors: What they are shown of the state.
        out: Folder for hover.md, hover.json and pictures; a new one under runs/ by default.
    """
    return _ordered("hover", out, lambda run, reporter: tables.hover(
        run, reporter, presets=presets, seeds=seeds, seconds=seconds, starts=starts, plant=plant, sensors=sensors
    ))  # fmt: skip


def tracking(
    presets: tuple[str, ...] = ("track/preview", "track/paper"),
    seeds: tuple[int, ...] = (0,),
    seconds: float = 60.0,
    starts: int = 8,
    plant: str = "bem",
    out: Path | None = None,
) -> Ordered:
    """Table II: circle, figure-8 and star under three disturbances, and a figure-8 that training never saw.

    Args:
        presets: Presets to train and fly.
        seeds: Training seeds.
        seconds: Length of a flight.
        starts: Flights per disturbance, method and seed.
        plant: Where the policies fly.
        out: Folder for tracking.md, tracking.json and pictures; a new one under runs/ by default.
    """
    return _ordered("tracking", out, lambda run, reporter: tables.tracking(
        run, reporter, presets=presets, seeds=seeds, seconds=seconds, starts=starts, plant=plant
    ))  # fmt: skip


def vision(
    presets: tuple[str, ...] = tuple(TITLES),
    seeds: tuple[int, ...] = (0,),
    seconds: float = 30.0,
    starts: int = 8,
    plant: str = "bem",
    out: Path | None = None,
) -> Ordered:
    """Table III: hover from seven points on the ground under three disturbances.

    Args:
        presets: Presets to train and fly; vision/paper trains for several minutes.
        seeds: Training seeds.
        seconds: Length of a flight.
        starts: Flights per disturbance, method and seed.
        plant: Where the policies fly.
        out: Folder for vision.md, vision.json and pictures; a new one under runs/ by default.
    """
    return _ordered("vision", out, lambda run, reporter: tables.vision(
        run, reporter, presets=presets, seeds=seeds, seconds=seconds, starts=starts, plant=plant
    ))  # fmt: skip


def plants(
    preset: str = "hover/fast",
    plant: tuple[str, ...] = ("bem", "simple", "rotorpy", "mujoco", "crazyflow"),
    seeds: tuple[int, ...] = (0,),
    seconds: float = 30.0,
    starts: int = 8,
    out: Path | None = None,
) -> Ordered:
    """Hover of one policy, as it is and adapted, in many scenarios and on plants that others wrote.

    Args:
        preset: Preset to train with, for the small quadrotor.
        plant: Plants to fly on. One whose package is not installed is left out, with a line that says so.
        seeds: Training seeds; each also seeds the starts, the gusts and the learners of its flights.
        seconds: Length of a flight.
        starts: Flights per disturbance, method and seed.
        out: Folder for plants.md and plants.json; a new one under runs/ by default.
    """
    return _ordered("plants", out, lambda run, reporter: tables.plants(
        run, reporter, preset=preset, only=plant, seeds=seeds, seconds=seconds, starts=starts
    ))  # fmt: skip


def reversing(
    preset: str = "hover/fast",
    plant: str = "bem",
    seeds: tuple[int, ...] = (0,),
    seconds: float = 60.0,
    starts: int = 8,
    out: Path | None = None,
) -> Ordered:
    """Hover under a push that reverses every 15 s: the error before and after each update, and the picture.

    Args:
        preset: A preset for hover, to train with.
        plant: Where the policy flies.
        seeds: Training seeds.
        seconds: Length of a flight.
        starts: Flights per method and seed.
        out: Folder for reversing.md, reversing.json and the picture; a new one under runs/ by default.
    """
    return _ordered("reversing", out, lambda run, reporter: tables.reversing(
        run, reporter, preset=preset, plant=plant, seeds=seeds, seconds=seconds, starts=starts
    ))  # fmt: skip


def model(out: Path | None = None) -> Ordered:
    """Pictures and figures of the blade-element plant: thrust, drag, inflow, rate and thrust steps, battery sag.

    Args:
        out: Folder for model.md, model.json, model.png and model.svg; a new one under runs/ by default.
    """
    return _ordered("model", out, tables.model)


COMMANDS: dict[str, Callable[..., Ordered]] = {
    each.__name__: each for each in (hover, reversing, tracking, vision, plants, model)
}
