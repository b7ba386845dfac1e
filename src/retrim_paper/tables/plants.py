"""Flies one hover policy in many scenarios, on every plant."""

from dataclasses import replace

from retrim.config.plants import PLANTS
from retrim.config.scenario import Scenario
from retrim.errors import PlantError
from retrim.evaluation.flight_groups import clear_flights
from retrim.evaluation.metrics import cell, metres, rows
from retrim.evaluation.study import fly_all, table_presets, train_all
from retrim.runkit.document import Document, TableSection
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run

METHODS = ("base", "base-i", "base-do", "indi", "full")
COLUMNS = (
    "disturbance", "base", "integral action", "disturbance observer", "INDI", "adapted", "its peak after 5 s",
    "crashed",
)  # fmt: skip
Group = tuple[str, Scenario, tuple[str, ...]]
"""Title, scenario, and disturbances of a group of flights."""


def groups() -> tuple[Group, ...]:
    """Return the table's groups; they are created on demand because creating a scenario validates it."""
    return (
        ("bem", Scenario(), ("none", "small", "large")),
        ("bem, wind of 4 m/s: steady, Dryden gusts, the jet of a fan", Scenario(), ("wind", "gusts", "fan")),
        (
            "bem, faults: 70 g picked up at 8 s and dropped at 20 s, 70 g all the time, a battery that sags by "
            "0.2 %/s, one rotor at 90 %, a random walk within 1 m/s², all at once",
            Scenario(),
            ("pickup", "payload", "battery", "weak-rotor", "walk", "wind+payload+battery+weak-rotor"),
        ),
        ("bem, the small quadrotor's policy on the large one", Scenario(vehicle="large"), ("none", "large", "wind")),
        ("bem, the same on the kingfisher", Scenario(vehicle="kingfisher"), ("none", "large", "wind")),
        ("bem, thrust map exact", Scenario(thrust_error=0.0), ("none", "large")),
        ("bem, thrust 3.5 % below the command", Scenario(thrust_error=-0.035), ("none", "large")),
        (
            "bem, thrust 10.5 % above the command: a base error near the paper's",
            Scenario(thrust_error=0.105),
            ("none", "large"),
        ),
        ("bem, mocap sensors: 0.3 mm, 3 mm/s, 1 mrad", Scenario(sensors="mocap"), ("none", "small", "large")),
        (
            "bem, rough sensors: 1 mm, 10 mm/s, 3 mrad, 10 ms late, 5 % lost",
            Scenario(sensors="rough"),
            ("none", "large"),
        ),
        ("simple: rotors with linear drag", Scenario(plant="simple"), ("large", "wind")),
        ("rotorpy, its hummingbird (0.5 kg)", Scenario(plant="rotorpy"), ("large", "wind")),
        ("mujoco", Scenario(plant="mujoco"), ("large", "wind")),
        ("crazyflow, its cf21B_500 (0.04 kg)", Scenario(plant="crazyflow"), ("large", "wind")),
    )


def plants(
    run: Run,
    reporter: Reporter,
    *,
    preset: str = "hover/retrim",
    plant: tuple[str, ...] = ("bem", "simple", "rotorpy", "mujoco", "crazyflow"),
    seeds: tuple[int, ...] = (0,),
    seconds: float = 30.0,
    starts: int = 8,
) -> None:
    """Hover with one policy, with and without adaptation, in many scenarios and on independent simulators.

    Args:
        run: Folder for plants.md and plants.json.
        reporter: Receives progress and the sections.
        preset: Preset for the small quadrotor, with which the policy is trained.
        plant: Plants to fly on; if a plant's package is not installed, it is left out, and the page says so.
        seeds: Training seeds; each also seeds the starts, gusts and learners of its flights.
        seconds: Length of a flight [s].
        starts: Flights per disturbance, method and seed.
    """
    (base,) = table_presets([preset], "hover", seeds=seeds, starts=starts, seconds=seconds)
    for name in plant:
        PLANTS.find(name)
    own = ", ".join(f"`{name}` flies its {p.own_vehicle}" for name, p in PLANTS.items() if p.own_vehicle)
    intro = (
        "Made by `retrim reproduce plants`. A policy trained in the nominal model for the small quadrotor, flown\n"
        f"everywhere. Steady-state error [m], over the last 2 s of {seconds:g} s: mean ± standard deviation over\n"
        f"{len(seeds)} training seeds x {starts} starts. `none` to `large`: 0, 0.5 and 2 m/s² per axis. Learning is\n"
        "charged to flight time by the preset's fixed latencies. On bem and simple the small quadrotor flies with\n"
        f"3.5 % more thrust than commanded, unless the row names a different one; {own}."
    )
    document = Document(run, "plants", "Hover in many scenarios, on every plant", intro, seeds, reporter)
    study = train_all(base, seeds, run, reporter)
    for title, scenario, disturbances in groups():
        if scenario.plant not in plant or run.interrupted:
            continue
        scenarios = [replace(scenario, disturbance=name) for name in disturbances]
        try:
            flights = fly_all(study, scenarios, run, reporter, methods=METHODS, starts=starts, seconds=seconds).flights
        except PlantError as error:
            document.add(TableSection((), (), title, f"Left out: {error}"))
            continue
        result = [{**row, "group": title} for row in rows(flights)]
        by = {(row["disturbance"], row["method"]): row for row in result}
        lines = []
        for name in disturbances:
            ours = [by.get((name, method)) for method in METHODS]
            cells = ["-" if row is None else cell(row) for row in ours]
            peak = None if ours[-1] is None else ours[-1]["peak_after_5s"]
            n, crashes = (sum(row[key] for row in ours if row) for key in ("n", "crashes"))
            lines.append((name, *cells, "-" if peak is None else metres(peak), f"{crashes} of {n}"))
        document.add(TableSection(COLUMNS, tuple(lines), title), result)
    document.write()
    if not run.interrupted:
        clear_flights(run)
