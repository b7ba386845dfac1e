"""``retrim fly``."""

import threading
from collections.abc import Callable
from pathlib import Path

from ..config.loading import changed, overlaid
from ..config.scenario import Scenario
from ..config.setup import Latency, Setup
from ..errors import ConfigError
from ..experiments.asked import flown_reference, loaded, same_policy
from ..experiments.figures import picture
from ..experiments.fleet import Fleet
from ..experiments.gathering import told_by
from ..experiments.interrupts import interrupts_only_set
from ..experiments.metrics import cell, notes, rows
from ..experiments.outputs import clear_outputs, write_events, write_learnt, write_logs
from ..experiments.run import INTERRUPTED, Run
from ..experiments.tables.document import TableSection
from .console import RichReporter, console, show_paths, show_table, started


def fly(
    policy: Path | None = None,
    resume: Path | None = None,
    delta: Path | None = None,
    disturbance: str = "large",
    plant: str = "bem",
    adapt: str = "full",
    reference: str | None = None,
    vehicle: str | None = None,
    sensors: str = "ideal",
    thrust_error: float = 0.035,
    delay: float = 0.02,
    residual: str | None = None,
    config: Path | None = None,
    latency: Latency = "fixed",
    seconds: float | None = None,
    starts: int = 1,
    seed: int = 0,
    out: Path | None = None,
) -> Callable[[threading.Event], int]:
    """Fly a policy on a plant, as it is and, with --adapt full or lora, adapting as it flies.

    Args:
        policy: A policy.safetensors, or the folder that holds one.
        resume: Instead of a policy: a learnt.safetensors of an earlier flight (policy, residual, optimiser states),
            to go on from.
        delta: A low-rank delta.safetensors of an earlier flight, to put on the policy.
        disturbance: What disturbs the flight: none, small, large, push, step, kick, reversing, walk, wind, gusts, fan,
            payload, pickup, battery, weak-rotor, with a size, as wind=6 [m/s] or payload=0.2 [kg], several at once, as
            wind+payload=0.1, or module:name.
        plant: bem: blade-element rotors; simple: rotors with linear drag; rotorpy, mujoco, crazyflow: independent
            simulators, each an extra to install; or module:name.
        adapt: full, lora: re-train in flight, all weights or a few; base-i: integral action; base-do: observer; none:
            as it is; geometric, geometric-i, indi, mppi, l1-mpc, raptor: another controller; or module:name.
        reference: What a tracking policy follows: circle, figure8, star, module:name or a CSV file of t, x, y, z[,
            yaw]; what it was trained on by default. A closed file repeats as laps, another is flown once;
            my.csv:laps and my.csv:once insist. Another reference than that of training needs a policy that sees it.
        vehicle: Vehicle that the plant simulates: small, large, kingfisher, a vehicle file or module:name; that which
            the policy was trained for by default. rotorpy and crazyflow fly their own.
        sensors: What the policy is shown of the state: ideal, mocap (0.3 mm, 3 mm/s, 1 mrad), onboard (0.6 mm,
            6 mm/s, 2 mrad, 10 ms late, 1 % of the samples lost), rough (1 mm, 10 mm/s, 3 mrad, 10 ms late, 5 % of
            the samples lost), or module:name.
        thrust_error: By how much more than commanded the rotors give, as a share (bem and simple).
        delay: Command delay of the plant [s], in whole milliseconds (bem and simple); the policy does not know of it.
        residual: Residual model: ensemble, regression, layered, or module:name.
        config: TOML file that overlays the policy's own preset, for example with a table [adapt].
        latency: fixed: learning costs the preset's flight time, so that a run repeats bit for bit; measured: what the
            clock says.
        seconds: Length of a flight; 30 s for hover, 60 s for tracking by default.
        starts: Number of flights, each from another start.
        seed: Seed of the starts, of the learners and of what is random in the scenario, 0 to 4294967295.
        out: Folder for results.json, events.jsonl, logs/, what was learnt and the picture; a new one under runs/ by
            default.
    """

    def ordered(stop: threading.Event) -> int:
        weights, preset, state = loaded(policy, resume, delta)
        if config is not None:
            preset = same_policy(preset, overlaid(preset, config), config)
        if residual is not None:
            if state is not None:
                raise ConfigError(f"--residual {residual}: a resumed flight goes on with its own residual")
            preset = changed(preset, adapt={"residual": residual})
        follows = flown_reference(preset, reference)
        scenario = Scenario(disturbance, plant, vehicle, sensors, thrust_error, follows, delay)
        methods: tuple[str, ...] = ("base",) if adapt in ("none", "base") else ("base", adapt)
        fleet = Fleet(
            preset, {seed: weights}, [scenario], methods=methods, starts=starts, seconds=seconds, latency=latency,
            state=state,
        )  # fmt: skip
        run, setup = started(Run("fly", out, stop=stop)), fleet.setups[follows]
        _warn(setup, scenario)
        return _fly(fleet, setup, scenario, run)

    return ordered


def _fly(fleet: Fleet, setup: Setup, scenario: Scenario, run: Run) -> int:
    with run.interruptible(), RichReporter().progress("flying") as advance:
        advance(0.0, "compiling the programs of a flight (kept in a cache for the next time)")
        flights = fleet.run(stop=run.stop, progress=told_by(advance)).flown
    if not flights:
        console.print("interrupted before the first flight was over; nothing was saved")
        return INTERRUPTED
    found, preset = rows(flights), setup.preset
    with interrupts_only_set(run.stop):
        run.write_results(found, seeds=list(fleet.policies), preset=preset.name)
        clear_outputs(run.folder)
        write_events(flights, run.folder)
        write_logs(flights, run.folder)
        write_learnt(flights, preset, run.folder)
    n, steady = found[0]["n"], min(flights[0].steady_seconds, fleet.seconds)
    kind = preset.task.rpartition(":")[2]
    title = f"{kind} error [m], last {steady:g} s of {fleet.seconds:g} s, {n} start{'s' * (n > 1)}"
    lines = tuple((row["disturbance"], row["method"], cell(row)) for row in found)
    show_table(TableSection(("disturbance", "method", "error"), lines, title))
    for note in notes(flights, preset):
        console.print(note, markup=False, soft_wrap=True)
    show_paths([*picture(flights, setup, scenario, run.folder), run.folder / "results.json"])
    return run.exit_code


def _warn(setup: Setup, scenario: Scenario) -> None:
    """Say what the vehicle that flies cannot fly of the reference."""
    if wrong := setup.limits_exceeded(scenario.make_vehicle(setup.preset.vehicle)):
        who = scenario.vehicle_name(setup.preset.vehicle)
        console.print(f"[yellow]warning:[/] vehicle {who} cannot fly all of reference {scenario.reference}: {wrong}")
