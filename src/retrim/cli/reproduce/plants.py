"""``retrim reproduce plants``: one policy in many surroundings, on every plant."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from ... import presets
from ...adapt.plant import PlantError
from ...control.policy import Policy
from ...presets import Preset
from ...testbed import OWN_VEHICLE, PlantName, Setting
from ..flights import Campaign, Flight, Plan
from ..scores import cell, rows
from ..session import Stopwatch, commit, console, machine, run_folder, write_results
from ..training import nominal_error, train


@dataclass(frozen=True)
class Group:
    """Flights in one setting."""

    title: str
    setting: Setting
    disturbances: tuple[str, ...]


GROUPS = (
    Group("bem", Setting(), ("none", "small", "large")),
    Group("bem, wind of 4 m/s: steady, Dryden gusts, a fan's jet", Setting(), ("wind", "gusts", "fan")),
    Group(
        "bem, trouble: 70 g picked up at 8 s and dropped at 20 s, 70 g all the time, a battery that sags by 0.2 %/s, "
        "one rotor at 90 %, a random walk within 1 m/s², all at once",
        Setting(),
        ("pickup", "payload", "battery", "weak-rotor", "walk", "wind+payload+battery+weak-rotor"),
    ),
    Group("bem, the small quadrotor's policy on the large one", Setting(vehicle="large"), ("none", "large", "wind")),
    Group("bem, the same on the kingfisher", Setting(vehicle="kingfisher"), ("none", "large", "wind")),
    Group("bem, thrust map exact", Setting(thrust_error=0.0), ("none", "large")),
    Group("bem, thrust 3.5 % below the command instead of above", Setting(thrust_error=-0.035), ("none", "large")),
    Group(
        "bem, rough sensors: 1 mm, 10 mm/s, 3 mrad, 10 ms late, 5 % lost", Setting(sensing="rough"), ("none", "large")
    ),
    Group("simple: rotors with linear drag", Setting("simple"), ("large", "wind")),
    Group("rotorpy, its hummingbird (0.5 kg)", Setting("rotorpy"), ("large", "wind")),
    Group("mujoco", Setting("mujoco"), ("large", "wind")),
    Group("crazyflow, its cf21B_500 (0.04 kg)", Setting("crazyflow"), ("large", "wind")),
)


def plants(
    preset: str = "fast",
    plant: tuple[PlantName, ...] = ("bem", "simple", "rotorpy", "mujoco", "crazyflow"),
    seeds: tuple[int, ...] = (0,),
    seconds: float = 30.0,
    starts: int = 8,
    out: Path | None = None,
) -> int:
    """Hover of one policy, as it is and adapted, in many surroundings and on plants that others wrote.

    Args:
        preset: Preset to train with, for the small quadrotor.
        plant: Plants to fly on. One whose extra is not installed is left out, with a line that says so.
        seeds: Training seeds; each also seeds the starts, the gusts and the learners of its flights.
        seconds: Length of a flight.
        starts: Flights per disturbance, method and seed.
        out: Folder for plants.md and plants.json; a new one under runs/ by default.
    """
    watch = Stopwatch()
    folder = run_folder(out, "reproduce")
    settings = presets.load(preset)
    policies = list[tuple[int, Policy]]()
    for seed in seeds:
        policy, _, interrupted = train(settings, seed)
        if interrupted:
            console.print("interrupted while pretraining; nothing was saved")
            return 130
        policies.append((seed, policy))
    errors = ", ".join(f"{1000 * nominal_error(settings, policy):.1f}" for _, policy in policies)
    head = [*_head(settings, seeds, seconds, starts), f"Hover error in its own model, by seed: {errors} mm.", ""]
    lines, table, interrupted = list[str](), list[dict[str, Any]](), False
    for group in GROUPS:
        if group.setting.plant not in plant:
            continue
        try:
            flights, interrupted = _flown(settings, policies, group, seconds, starts)
        except PlantError as error:
            console.print(f"[bold red]left out:[/] {group.title}: {error}", soft_wrap=True)
            lines += [f"| {group.title} | left out: {error} | | | |"]
            continue
        found = rows(flights, task=settings.task, setting=group.setting)
        table += [{**row, "group": group.title, "thrust_error": group.setting.thrust_error} for row in found]
        lines += _lines(group, found)
        console.print(_shown(group, found))
        foot = [f"Compiling {watch.compile_s:.0f} s, all else {watch.total_s - watch.compile_s:.0f} s."]
        foot += ["Interrupted: incomplete."] if interrupted else []
        # after each group, so that an interruption loses nothing
        (folder / "plants.md").write_text("\n".join([*head, *COLUMNS, *lines, "", *foot, ""]))
        write_results(folder, name="plants", seeds=seeds, watch=watch, rows=table, interrupted=interrupted)
        if interrupted:
            break
    console.print(f"[bold]{folder / 'plants.md'}[/]", soft_wrap=True)
    return 130 if interrupted else 0


COLUMNS = ["| plant | disturbance | base | adapted | crashed |", "|---|---|---|---|---|"]


def _flown(
    settings: Preset, policies: Sequence[tuple[int, Policy]], group: Group, seconds: float, starts: int
) -> tuple[list[Flight], bool]:
    flights = list[Flight]()
    for seed, policy in policies:
        setting = group.setting
        campaign = Campaign(settings, policy, setting=setting, seconds=seconds, starts=starts, seed=seed)
        campaign.warm_up(group.disturbances)
        plans = [Plan(d, method, i) for d in group.disturbances for method in ("base", "full") for i in range(starts)]
        flown, interrupted = campaign.fly(plans)
        flights += flown
        if interrupted:
            return flights, True
    return flights, False


def _lines(group: Group, found: list[dict[str, Any]]) -> list[str]:
    by = {(row["disturbance"], row["method"]): row for row in found}
    lines = []
    for i, name in enumerate(dict.fromkeys(row["disturbance"] for row in found)):
        pair = [by[name, method] for method in ("base", "full") if (name, method) in by]
        cells = " | ".join(cell(row) for row in pair) if len(pair) == 2 else f"{cell(pair[0])} | -"
        crashed = f"{sum(row['crashes'] for row in pair)} of {sum(row['n'] for row in pair)}"
        lines.append(f"| {group.title if i == 0 else ''} | {name} | {cells} | {crashed} |")
    return lines


def _shown(group: Group, found: list[dict[str, Any]]) -> Table:
    shown = Table(title=group.title)
    for heading in ("disturbance", "method", "error \\[m]"):
        shown.add_column(heading)
    for row in found:
        shown.add_row(row["disturbance"], row["method"], cell(row))
    return shown


def _head(settings: Preset, seeds: tuple[int, ...], seconds: float, starts: int) -> list[str]:
    own = ", ".join(f"`{plant}` flies its {vehicle}" for plant, vehicle in OWN_VEHICLE.items())
    return [
        "# Hover in many surroundings, on every plant",
        "",
        f"Made by `retrim reproduce plants`. A policy of preset `{settings.name}`, trained in the nominal model for",
        f"the small quadrotor, flown everywhere. Training seeds {', '.join(map(str, seeds))}; {starts} starts each.",
        f"Steady-state error [m], over the last 2 s of {seconds:g} s: mean ± standard deviation over flights. `none`",
        "to `large`: 0, 0.5 and 2 m/s² per axis. Learning is charged to flight time, by the preset's fixed figures.",
        "On bem and simple the small quadrotor flies with 3.5 % more thrust than commanded, unless the row says",
        f"otherwise; {own}.",
        "",
        f"Commit {commit()}; {machine()}.",
        "",
    ]
