"""``retrim fly``: fly a policy."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from ..config.loading import overlaid
from ..config.scenario import Scenario
from ..config.setup import Latency, Setup
from ..config.trained_values import same_policy
from ..errors import ConfigError
from ..evaluation.executor import report_progress
from ..evaluation.figures import picture
from ..evaluation.fleet import Fleet
from ..evaluation.flight_table import figure_cells, figure_columns
from ..evaluation.metrics import notes, rows
from ..replay.flight_vehicle import check_vehicle_file, write_flight_vehicle
from ..runkit.document import TableSection
from ..runkit.flight_memory import FlightMemory, recall_flight, write_memory
from ..runkit.flights import Flight
from ..runkit.interrupts import interrupts_only_set
from ..runkit.outlet import Outlet
from ..runkit.run import INTERRUPTED, Run
from .arguments import METHOD, RESIDUAL, FlightArguments, load_inputs, with_residual
from .console import RichReporter, Trust, console, refuse, report_start, show_paths, show_table, warn
from .options import option


def fly(
    policy: Path | None = None,
    resume: Path | None = None,
    delta: Path | None = None,
    flight: tyro.conf.OmitArgPrefixes[FlightArguments] = FlightArguments(),  # noqa: B008
    adapt: Annotated[str, option(METHOD)] = "full",
    residual: Annotated[str | None, option(RESIDUAL, optional=True)] = None,
    config: Path | None = None,
    latency: Latency = "fixed",
    seconds: float | None = None,
    starts: int = 1,
    seed: int = 0,
    save_vehicle: Path | None = None,
    trust: Trust = (),
    out: Path | None = None,
) -> Callable[[threading.Event], int]:
    """Fly a policy on a plant, unchanged and, with --adapt full or lora, also with re-training in flight.

    Args:
        policy: A policy.safetensors, or the folder that contains one.
        resume: A learner_state.safetensors from an earlier flight, from which to continue; used instead of a policy.
        delta: A low-rank delta.safetensors from an earlier flight, to add to the policy.
        flight: Plant, vehicle and disturbances of the flight.
        adapt: Method of the flight; full and lora re-train the policy in flight.
        residual: Residual model of the learners.
        config: TOML file with values that replace those of the policy's preset, for example a table [adapt].
        latency: Flight time that learning takes: fixed (the time in the preset, so that a run is reproducible bit for
            bit), or measured (the computing time).
        seconds: Length of each flight; by default 30 s for hover and 60 s for tracking.
        starts: Number of flights, each from a different start.
        seed: Seed of the starts, the learners and the random parts of the scenario, 0 to 4294967295.
        save_vehicle: Vehicle file (TOML) to write for pretraining, with the vehicle identified in the last flight.
        trust: Python name that a file may contain, such as mine:task; its code is run. Repeat the option for each name.
        out: Folder for results.json, events.jsonl, logs/, learned parameters and the picture; a new one under runs/ by
            default.
    """

    def execute(stop: threading.Event) -> int:
        check_vehicle_file(save_vehicle, flight.vehicle)
        if flight.is_vehicle:
            if delta or config or starts != 1 or latency != "fixed":
                raise ConfigError("a vehicle flies live, without --delta, --config, --starts and --latency")
            from .live import live  # imported here, because other flights do not need it

            length = 30.0 if seconds is None else seconds
            return live(
                policy, resume, flight=flight, adapt=adapt, residual=residual, seconds=length, seed=seed,
                save_vehicle=save_vehicle, trust=trust, out=out,
            )(stop)  # fmt: skip
        weights, preset, state = load_inputs(policy, resume, delta, trust=trust)
        if config is not None:
            preset = same_policy(preset, overlaid(preset, config, trust=trust), config)
        preset = with_residual(preset, residual, state)
        scenario = flight.scenario(preset)
        setup, say = Setup.from_preset(preset, scenario.reference), RichReporter().say
        memory, state = recall_flight(flight.memory, setup, scenario, weights, state, adapt, seed, say)
        methods: tuple[str, ...] = ("base",) if adapt in ("none", "base") else ("base", adapt)
        fleet = Fleet(preset, {seed: weights}, [scenario], methods=methods, starts=starts, seconds=seconds,
                      latency=latency, state=state)  # fmt: skip
        run = report_start(Run("fly", out, stop=stop, inputs=(policy, resume, delta)))
        _warn(setup, scenario)
        return _fly(fleet, scenario, run, save_vehicle, memory)

    return execute


def _fly(fleet: Fleet, scenario: Scenario, run: Run, vehicle_file: Path | None, memory: FlightMemory | None) -> int:
    setup = fleet.setups[scenario.reference]
    flights = list[Flight]()  # a Ctrl-C may come before the first flight ends
    with run.interruptible(), RichReporter().progress("flying") as advance:
        advance(0.0, "compiling the programs of a flight (kept in a cache for the next time)")
        flights = fleet.run(stop=run.stop, progress=report_progress(advance)).flights
    if not flights:
        console.print("interrupted before the first flight was over; nothing was saved")
        return INTERRUPTED
    result, preset, outlet = rows(flights), setup.preset, Outlet(run.folder, run.inputs)
    with interrupts_only_set(run.stop):
        outlet.write_flights(flights, preset)
        pictures = outlet.write("the picture", lambda folder: picture(flights, setup, scenario, folder)) or []
        results = outlet.write_results(run, result, seeds=list(fleet.policies), preset=preset.name)
        memories = write_memory(memory, flights, setup, outlet.faults)
    n, steady = result[0]["n"], min(flights[0].steady_seconds, fleet.seconds)
    title = f"{preset.task} error, last {steady:g} s of {fleet.seconds:g} s, {n} start{'s' * (n > 1)}"
    title += f", plant {scenario.plant}, sensors {scenario.sensors}"
    lines = tuple((row["disturbance"], row["method"], *figure_cells(row)) for row in result)
    show_table(TableSection(("disturbance", "method", *figure_columns(fleet.seconds)), lines, title))
    for note in notes(flights, preset):
        console.print(note, soft_wrap=True)
    vehicle_path = write_flight_vehicle(flights[-1], setup, vehicle_file, outlet.faults, run.folder)
    show_paths([*pictures, *([] if results is None else [results]), *vehicle_path, *memories])
    return run.exit_code or max((refuse(fault) for fault in outlet.faults), default=0)


def _warn(setup: Setup, scenario: Scenario) -> None:
    """Warn if the reference exceeds the limits of the vehicle."""
    if wrong := setup.limits_exceeded(scenario.make_vehicle(setup.preset.vehicle)):
        who = scenario.vehicle_name(setup.preset.vehicle)
        warn(f"vehicle {who} cannot fly all of reference {scenario.reference}: {wrong}")
