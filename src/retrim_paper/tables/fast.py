"""Makes the table of fast flights: references at a vehicle's limits, in wind."""

import re

from retrim.config.presets import Preset
from retrim.config.scenario import Scenario
from retrim.evaluation.study import table_presets
from retrim.runkit.document import Document
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run

from .levels import Levels, fly_levels

INTRO = """\
Made by `retrim reproduce fast`. Mean distance from the present point of the reference [m], over the last 10 s: mean ±
standard deviation over flights. In step: after the best constant shift in time. Cross-track: distance from the nearest
point of the lap. `circle=8`: a top speed of 8 m/s, on a circle as large as the vehicle's acceleration needs;
`star=1.5`: this speed also through its corners, which no vehicle can fly. A file is a loop that was not part of
training; `race.csv` comes with the examples. The wind is steady. Learning is charged to flight time by the preset's
fixed latencies. The paper has no such table."""
LEVELS = {"none": "no disturbance", "wind=4": "wind of 4 m/s", "large": "large, 2 m/s² per axis"}


def fast(
    run: Run,
    reporter: Reporter,
    *,
    preset: str = "track/fast",
    references: tuple[str, ...] = ("circle=8", "figure8=8", "star=1.5"),
    methods: tuple[str, ...] = ("base", "base-i", "base-do", "geometric-i", "indi", "full", "lora"),
    seeds: tuple[int, ...] = (0,),
    seconds: float = 60.0,
    starts: int = 8,
    plant: str = "bem",
) -> None:
    """References at the vehicle's limits: undisturbed, in wind and under a large push.

    Args:
        run: Folder for fast.md, fast.json and the pictures.
        reporter: Receives progress and the sections.
        preset: Preset to train and fly, on its own vehicle.
        references: References to fly: shapes with a top speed [m/s], and CSV files.
        methods: Methods to fly.
        seeds: Training seeds.
        seconds: Length of a flight [s].
        starts: Flights per disturbance, method and seed.
        plant: Plant for the flights.
    """
    (base,) = table_presets([preset], "track", seeds=seeds, starts=starts, seconds=seconds)
    sections = [_section(base, reference, plant, methods) for reference in references]
    document = Document(run, "fast", "Fast flight", INTRO, seeds, reporter)
    fly_levels(document, sections, starts=starts, seconds=seconds)


def _section(preset: Preset, reference: str, plant: str, methods: tuple[str, ...]) -> Levels:
    stem = "fast_" + re.sub(r"[^A-Za-z0-9]+", "-", reference).strip("-")
    scenario = Scenario(plant=plant, reference=reference)
    return Levels(reference, preset, scenario, stem, methods, levels=LEVELS)
