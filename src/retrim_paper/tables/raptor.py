"""Compares RAPTOR, the foundation policy, with our policies: hover and a figure-8, undisturbed and disturbed."""

from retrim.config.loading import with_vehicle
from retrim.config.scenario import Scenario
from retrim.config.vehicles import name_of
from retrim.evaluation.study import table_presets
from retrim.runkit.document import Document
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run

from .levels import Levels, fly_levels

INTRO = """\
Made by `retrim reproduce raptor`. RAPTOR is one network for quadrotors of 32 g to 2.4 kg that lift 1.5 to 5 times their
weight; it commands the four motors at 100 Hz and adapts in its hidden state, without any training. Here it is on board
of the blade-element plant instead of the rate controller: it reads the state itself, without delay, and its commands
act immediately; all other methods command body rates at 50 Hz with 20 ms of delay. Error over the last 2 s of hover and
the last 10 s of tracking [m]: mean ± standard deviation over flights. Trained policies receive the vehicle's mass and
limits; RAPTOR does not receive vehicle data. Learning is charged to flight time by the preset's fixed latencies."""
DISTURBANCES = {
    "none": "no disturbance",
    "weak-rotor": "weak rotor",
    "payload": "payload of 70 g",
    "wind=6": "wind of 6 m/s",
    "large": "large, 2 m/s² per axis",
}
METHODS = ("raptor", "base", "base-i", "geometric-i", "indi", "full", "lora")


def raptor(
    run: Run,
    reporter: Reporter,
    *,
    presets: tuple[str, str] = ("hover/retrim", "track/retrim"),
    vehicles: tuple[str, ...] = ("kingfisher",),
    methods: tuple[str, ...] = METHODS,
    seeds: tuple[int, ...] = (0, 1, 2),
    seconds: float = 30.0,
    starts: int = 8,
) -> None:
    """RAPTOR, a motor-command policy that does not need re-training, compared with our policies.

    Args:
        run: Folder for raptor.md, raptor.json and the pictures.
        reporter: Receives progress and the sections.
        presets: One preset for hover and one for tracking.
        vehicles: Vehicles to fly; our policies are trained for each. small and large can lift more than the vehicles
            for which RAPTOR was made.
        methods: Methods to fly.
        seeds: Training seeds.
        seconds: Length of a flight [s].
        starts: Flights per condition, method and seed.
    """
    (hover,) = table_presets(presets[:1], "hover", seeds=seeds, starts=starts, seconds=seconds)
    (track,) = table_presets(presets[1:], "track", seeds=seeds, starts=starts, seconds=seconds)
    sections = list[Levels]()
    for vehicle in vehicles:
        for what, preset, reference in (("Hover", hover, None), ("Figure-8", track, "figure8")):
            own = with_vehicle(preset, vehicle)
            name = name_of(own.vehicle)
            title, stem = f"{what}, {name}", f"raptor_{what.lower().replace('-', '')}_{name}"
            drawn_methods = ("raptor", "full")
            sections.append(
                Levels(
                    title,
                    own,
                    Scenario(reference=reference),
                    stem,
                    methods,
                    levels=DISTURBANCES,
                    drawn_methods=drawn_methods,
                )
            )
    document = Document(run, "raptor", "RAPTOR, without re-training", INTRO, seeds, reporter)
    fly_levels(document, sections, starts=starts, seconds=seconds)
