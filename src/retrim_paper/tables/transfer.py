"""Repeats the paper's real flights in simulation (Sec. IV-D): a load, a fan, and a policy on an unknown vehicle."""

from retrim.config.scenario import Scenario
from retrim.errors import ConfigError
from retrim.evaluation.study import table_presets
from retrim.runkit.document import Document
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run

from ..datt.training import DATT_STEPS
from .levels import Levels, fly_levels

INTRO = """\
Made by `retrim reproduce transfer`. The real flights of the paper, on the blade-element plant: a load of 70 g below the
small quadrotor (190 g become 260 g, +37 %, and a different inertia), a fan that blows diagonally, and policies of the
small quadrotor on the large one (600 g, different rotors, a different response of the rate controller). Error over the
last 2 s of hover and the last 10 s of tracking [m]: mean ± standard deviation over flights. The load, the fan and the
vehicle are unknown to all methods; the thrust command is normalised by the mass that the flight controller knows.
Learning is charged to flight time by the preset's fixed latencies. The paper gives no figures for these flights."""
ENTRANTS = ("base", "base-i", "base-do", "geometric-i", "indi", "l1-mpc", "full", "lora")
"""The base policy, and methods that compensate for a load or wind."""
HOVER_LEVELS = {"none": "alone", "payload": "with a load", "fan": "in front of a fan", "payload+fan": "load and fan"}
TRACK_LEVELS = {"none": "calm air", "wind=4": "wind of 4 m/s"}


def transfer(
    run: Run,
    reporter: Reporter,
    *,
    presets: tuple[str, str] = ("hover/retrim", "track/retrim"),
    methods: tuple[str, ...] = ENTRANTS,
    seeds: tuple[int, ...] = (0, 1, 2),
    seconds: float = 30.0,
    starts: int = 8,
    plant: str = "bem",
    datt_steps: int = DATT_STEPS,
) -> None:
    """The paper's real flights in simulation: a load, a fan, and a policy on an unknown vehicle.

    Args:
        run: Folder for transfer.md, transfer.json and the pictures.
        reporter: Receives progress and the sections.
        presets: One preset for hover and one for tracking.
        methods: Methods for the policies, and baselines without a policy.
        seeds: Training seeds.
        seconds: Length of a flight [s].
        starts: Flights per condition, method and seed.
        plant: Plant for the flights; bem or simple.
        datt_steps: Number of training steps for DATT, if it is among the methods.
    """
    (hover,) = table_presets(presets[:1], "hover", seeds=seeds, starts=starts, seconds=seconds)
    (track,) = table_presets(presets[1:], "track", seeds=seeds, starts=starts, seconds=seconds)
    for preset in (hover, track):
        if preset.vehicle != "small":
            raise ConfigError(f"preset {preset.name!r} is for vehicle {preset.vehicle!r}; this table begins with small")
    sections = [
        Levels("Hover, small quadrotor", hover, Scenario(plant=plant), "transfer_hover", methods, levels=HOVER_LEVELS),
        Levels(
            "Hover, on the large quadrotor", hover, Scenario(plant=plant, vehicle="large"), "transfer_hover_large",
            methods, levels=HOVER_LEVELS,
        ),
        Levels(
            "Figure-8, on the large quadrotor", track, Scenario(plant=plant, vehicle="large", reference="figure8"),
            "transfer_figure8_large", methods, levels=TRACK_LEVELS,
        ),
    ]  # fmt: skip
    document = Document(run, "transfer", "Transfer (Sec. IV-D of the paper)", INTRO, seeds, reporter)
    fly_levels(document, sections, starts=starts, seconds=seconds, datt_steps=datt_steps)
