"""``retrim fly``."""

from pathlib import Path
from typing import Literal

from rich.table import Table

from .. import build, presets, testbed
from ..adapt.sink import JsonlSink
from ..checkpoint import load_delta, load_policy, save_delta, save_policy
from ..control.lora import LoraPolicy
from ..presets import Preset
from ..tasks.reference import Reference
from ..testbed import PlantName, SensingName, Setting, VehicleName
from .flights import STEADY, Campaign, Flight, Method, Plan
from .pictures import picture
from .scores import cell, rows
from .session import Stopwatch, console, run_folder, write_results

SECONDS = {"hover": 30.0, "vision": 30.0, "track": 60.0}  # of a flight, as in the paper


def fly(
    policy: Path,
    delta: Path | None = None,
    disturbance: str = "large",
    plant: PlantName = "bem",
    adapt: Literal["none", "full", "lora"] = "full",
    reference: str | None = None,
    vehicle: VehicleName | None = None,
    sensing: SensingName = "ideal",
    thrust_error: float = 0.035,
    config: Path | None = None,
    charge: Literal["fixed", "measured"] = "fixed",
    seconds: float | None = None,
    starts: int = 1,
    seed: int = 0,
    out: Path | None = None,
) -> int:
    """Fly a policy on a plant, as it is and, with --adapt full or lora, adapting as it flies.

    Args:
        policy: A policy.safetensors, or the folder that holds one.
        delta: A low-rank delta.safetensors of an earlier flight, to put on the policy.
        disturbance: What disturbs the flight: none, small, large, reversing, walk, wind, gusts, fan, payload, pickup,
            battery, weak-rotor, or several at once, as wind+payload.
        adapt: full: re-train all weights in flight; lora: a low-rank delta (ranks 4, 10, 1); none: fly as it is.
        reference: What a tracking policy follows: circle, figure8, star or a CSV file of t, x, y, z[, yaw]; what it was
            trained on by default. Another one needs a policy that sees its reference (preset track).
        plant: bem: blade-element rotors; simple: rotors with linear drag; rotorpy, mujoco, crazyflow: independent
            simulators, each an extra to install.
        vehicle: Quadrotor that the plant simulates; that which the policy was trained for by default. rotorpy and
            crazyflow fly their own.
        sensing: What the policy sees of the state: ideal, mocap (0.3 mm, 3 mm/s, 1 mrad) or rough (1 mm, 10 mm/s,
            3 mrad, 10 ms late, 5 % of the samples lost).
        thrust_error: By how much more than commanded the rotors give, as a share (bem and simple).
        config: TOML file that overlays the policy's own preset, for example with a table [adapt].
        charge: fixed: learning costs the preset's flight time, so that a run repeats bit for bit; measured: what the
            clock says.
        seconds: Length of a flight; 30 s for hover, 60 s for tracking by default.
        starts: Number of flights, each from another start.
        seed: Seed of the starts and of the learners.
        out: Folder for results.json, events.jsonl, what was learnt and the picture; a new one under runs/ by default.
    """
    watch = Stopwatch()
    weights, preset = load_policy(policy)
    if delta is not None:
        weights = load_delta(delta, weights).plain()
    if config is not None:
        preset = _same_policy(preset, presets.overlaid(preset, config), config)
    seconds = seconds or SECONDS[preset.task]
    if seconds < 3.0 or starts < 1:
        raise presets.PresetError(f"--seconds {seconds:g} --starts {starts}: at least 3 s and 1 start are needed")
    setting = setting_for(preset, plant, vehicle, sensing, thrust_error)
    testbed.disturbance(disturbance)  # a wrong name is refused before anything else happens
    flown = followed(preset, reference)
    folder = run_folder(out, "fly")
    campaign = Campaign(
        preset,
        weights,
        setting=setting,
        seconds=seconds,
        starts=starts,
        seed=seed,
        measured=charge == "measured",
        flown=flown,
    )
    methods: tuple[Method, ...] = ("base",) if adapt == "none" else ("base", adapt)
    campaign.warm_up([disturbance], methods)
    plans = [Plan(disturbance, method, i) for method in methods for i in range(starts)]
    flights, interrupted = campaign.fly(plans)
    if not flights:
        console.print("interrupted before the first flight was over; nothing was saved")
        return 130
    write_events(flights, folder)
    save_learnt(flights, preset, folder)
    table = rows(flights, task=preset.task, setting=setting)
    write_results(folder, seeds=[seed], watch=watch, rows=table, interrupted=interrupted, preset=presets.values(preset))
    many = f"{starts} start{'s' * (starts > 1)}"
    shown = Table(title=f"{preset.task} error \\[m], last {STEADY[preset.task]:g} s of {seconds:g} s, {many}")
    for heading in ("disturbance", "method", "error"):
        shown.add_column(heading)
    for row in table:
        shown.add_row(row["disturbance"], row["method"], cell(row))
    console.print(shown)
    for path in picture(flights, preset, disturbance, setting, folder, flown):
        console.print(f"[bold]{path}[/]", soft_wrap=True)
    return 130 if interrupted else 0


def followed(preset: Preset, name: str | None) -> Reference | None:
    """The reference of a tracking flight, with a warning for what the vehicle cannot fly; None for other tasks.

    Raises :class:`PresetError` where a policy cannot follow another reference than that of its training.
    """
    if preset.task != "track":
        if name is not None:
            raise presets.PresetError(f"--reference {name}: a {preset.task} policy follows none")
        return None
    if name is None and "+" in preset.reference:
        raise presets.PresetError(f"trained on {preset.reference}: say which to fly, as --reference circle")
    if name is not None and name != preset.reference and preset.observation == "state":
        raise presets.PresetError(
            f"--reference {name}: this policy does not see its reference, and was trained for {preset.reference}"
        )
    flown = build.reference(name or preset.reference)
    if wrong := flown.worst_violation(build.vehicle(preset)):
        console.print(f"[yellow]warning:[/] reference {name or preset.reference}: {wrong}")
    return flown


def setting_for(
    preset: Preset,
    plant: PlantName,
    vehicle: VehicleName | None = None,
    sensing: SensingName = "ideal",
    thrust_error: float = 0.035,
) -> Setting:
    """Where a policy flies: on the vehicle of its training, unless another is asked for or the plant has its own."""
    own = plant in testbed.OWN_VEHICLE
    return Setting(plant, vehicle if own else vehicle or preset.vehicle, sensing, thrust_error)


def _same_policy(trained: Preset, overlaid: Preset, config: Path) -> Preset:
    """``overlaid``, unless it changes what the weights were trained for."""
    for name in ("task", "vehicle", "history", "observation"):
        before, after = getattr(trained, name), getattr(overlaid, name)
        if before != after:
            raise presets.PresetError(f"{config}: {name} = {after!r}, but the policy was trained with {before!r}")
    if trained.pretrain != overlaid.pretrain:
        raise presets.PresetError(f"{config}: [pretrain] cannot change for a policy that is trained")
    return overlaid


def save_learnt(flights: list[Flight], preset: Preset, folder: Path) -> None:
    """What the first whole flight learnt: ``adapted.safetensors``, or of a low-rank policy ``delta.safetensors``."""
    learnt = next((f.learnt for f in flights if f.learnt is not None and not f.log.crashed), None)
    if isinstance(learnt, LoraPolicy):
        save_delta(folder / "delta.safetensors", learnt)
    elif learnt is not None:
        save_policy(folder / "adapted.safetensors", learnt, preset)


def write_events(flights: list[Flight], folder: Path) -> None:
    """``events.jsonl``: what adaptation did, flight by flight."""
    sink = JsonlSink(folder / "events.jsonl")
    for flight in flights:
        for event in flight.events:
            sink.event(
                event.kind, disturbance=flight.plan.disturbance, start=flight.plan.start, t=event.t, note=event.note
            )
    sink.close()
