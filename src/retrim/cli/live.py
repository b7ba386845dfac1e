"""``retrim live``."""

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path

from rich.live import Live
from rich.table import Table

from ..config.loading import changed, load_for
from ..config.scenario import Scenario
from ..config.setup import Setup
from ..errors import ConfigError
from ..experiments.figures import picture
from ..experiments.interrupts import interrupts_only_set
from ..experiments.limits import check_seeds
from ..experiments.outputs import clear_outputs, write_learnt
from ..experiments.run import INTERRUPTED, Run
from ..experiments.tables.document import TableSection
from ..experiments.training import train
from ..io.trained import load_learnt, load_policy
from ..live.events import LiveEvents
from ..live.report import complaints, flight_of, histograms, learnt_in, results
from ..live.session import LEARNING, LiveRequest, live_spec
from ..live.supervisor import Status, Supervisor
from .console import RichReporter, console, show_paths, show_table, started

LONGEST = 3600.0  # [s]
LINE_EVERY = 5.0  # [s], where the output is no terminal
LANDING = 60.0  # [s], after which processes are ended
UNITS = {"steady": "m", "recovery_5cm": "s", "flight_to_swap_s": "s"}


def live(
    policy: Path | None = None,
    resume: Path | None = None,
    preset: str = "hover/retrim",
    disturbance: str = "large",
    plant: str = "bem",
    adapt: str = "full",
    reference: str | None = None,
    vehicle: str | None = None,
    sensors: str = "ideal",
    thrust_error: float = 0.035,
    delay: float = 0.02,
    residual: str | None = None,
    seconds: float | None = None,
    fence: float = 3.0,
    seed: int = 0,
    out: Path | None = None,
) -> Callable[[threading.Event], int]:
    """Fly against the clock, and learn at the same time: a process for control, for each learner, and for the plant.

    Ctrl-C lands the vehicle.

    Args:
        policy: A policy.safetensors, or the folder that holds one; without one, a policy is trained first.
        resume: A learnt.safetensors of an earlier flight, to go on from.
        preset: Preset to train with where there is neither.
        disturbance: What disturbs the flight, as for `retrim fly`.
        plant: What flies: bem, simple, rotorpy, mujoco, crazyflow, or module:name.
        adapt: full, lora: learn in flight; base-i, base-do, none: fly without learning; or module:name.
        reference: What a tracking policy follows.
        vehicle: Vehicle that the plant simulates; that which the policy was trained for by default.
        sensors: What the policy is shown of the state: ideal, mocap, onboard, rough, or module:name.
        thrust_error: By how much more than commanded the rotors give, as a share (bem and simple).
        delay: Command delay of the plant [s], in whole milliseconds (bem and simple).
        residual: Residual model: ensemble, regression, layered, or module:name.
        seconds: Length of the flight; until Ctrl-C by default.
        fence: How far from its reference the vehicle may be along any axis before the fallback flies [m].
        seed: Seed of the start, of the learners and of what is random in the scenario.
        out: Folder of what the flight leaves; a new one under runs/ by default.
    """

    def ordered(stop: threading.Event) -> int:
        check_seeds([seed])
        if not 0.5 <= fence <= 1000.0:
            raise ConfigError(f"--fence {fence:g} m must be between 0.5 and 1000")
        if seconds is not None and not 1.0 <= seconds <= LONGEST:
            raise ConfigError(f"--seconds {seconds:g} must be between 1 and {LONGEST:g}")
        if policy is not None and resume is not None:
            raise ConfigError("give either --policy FILE or --resume FILE")
        state = None
        if resume is not None:
            state, chosen = load_learnt(resume)
            weights = state.policy.policy.merged()
        elif policy is not None:
            weights, chosen = load_policy(policy)
        else:
            chosen = load_for(preset.partition("/")[0], preset)
        if residual is not None:
            if state is not None:
                raise ConfigError(f"--residual {residual}: a resumed flight goes on with its own residual")
            chosen = changed(chosen, adapt={"residual": residual})
        if chosen.track is not None and reference is None and "+" in chosen.track.reference:
            raise ConfigError(f"the policy tracks {chosen.track.reference}: say which to fly, as --reference circle")
        follows = reference or (chosen.track.reference if chosen.track is not None else None)
        scenario = Scenario(disturbance, plant, vehicle, sensors, thrust_error, follows, delay)
        setup, run = Setup.of(chosen, follows), started(Run("live", out, stop=stop))
        if policy is None and resume is None:
            weights, losses = train(Setup.of(chosen), seed, reporter=RichReporter(), stop=stop)
            if run.interrupted:
                console.print(f"interrupted while pretraining, after {len(losses)} steps; nothing has flown")
                return INTERRUPTED
        method = "base" if adapt == "none" else adapt
        run.folder.mkdir(parents=True, exist_ok=True)
        clear_outputs(run.folder)
        for old in (*run.folder.glob("*.log"), run.folder / "flight.csv"):
            old.unlink(missing_ok=True)
        request = LiveRequest(setup, weights, scenario, method, seconds or LONGEST, seed, fence, run.folder, state)
        with interrupts_only_set(run.stop):  # a Ctrl-C lands the vehicle; whoever is in the air is not dropped
            return _fly(request, run)

    return ordered


def _fly(request: LiveRequest, run: Run) -> int:
    """Fly one flight, and show and write what it leaves."""
    events, status = LiveEvents(), None
    with Supervisor(live_spec(request)) as supervisor:
        with RichReporter().progress("warming up") as advance:
            for waiting, _ in supervisor.warm_up():
                advance(0.5, f"compiling; not ready: {waiting}")
                if run.interrupted:
                    console.print("interrupted before take-off; nothing has flown")
                    return INTERRUPTED
        for role, refused in supervisor.refused.items():
            for what in refused:
                console.print(f"{role}: no {what}", markup=False, soft_wrap=True)
        supervisor.take_off()
        status = _watched(supervisor, request, run, events)
        supervisor.finish()
        learnt = learnt_in(request, supervisor.bus) if request.method in LEARNING else None
    console.print(f"flight over: {status.ended}", markup=False, soft_wrap=True)
    flight, rows = flight_of(request, events.all, status, learnt)
    found = results(request, flight, rows, status)
    run.write_results(
        found, seeds=[request.seed], preset=request.setup.preset.name, seconds=float(flight.log.t[-1]),
        ended=status.ended, scheduling=supervisor.refused, histograms_ms=histograms(rows),
    )  # fmt: skip
    said = [{"event": event.kind, "t": round(event.t, 6), "note": event.note} for event in events.all]
    run.write_text("events.jsonl", "".join(json.dumps(line) + "\n" for line in said))
    write_learnt([flight], request.setup.preset, run.folder)
    lines = tuple((row["metric"], UNITS.get(row["metric"], ""), _shown(row["value"])) for row in found)
    show_table(TableSection(("figure", "unit", "value"), lines, f"live, {flight.log.t[-1]:.1f} s"))
    drawn = picture([flight], request.setup, request.scenario, run.folder, stem="live")
    show_paths([*drawn[:1], run.folder / "results.json", run.folder / "flight.csv", *complaints(run.folder)])
    return run.exit_code


def _watched(supervisor: Supervisor, request: LiveRequest, run: Run, events: LiveEvents) -> Status:
    """Show the flight until it is over; Ctrl-C, or the end of its time, lands it."""
    landed_by, last = float("inf"), float("-inf")
    with Live(console=console, refresh_per_second=5, auto_refresh=False) as screen:
        while True:
            status = supervisor.watch()
            new = events.take(status)
            if status.ended is not None or time.monotonic() > landed_by:
                return status
            if (run.interrupted or status.t >= request.seconds) and landed_by == float("inf"):
                supervisor.land()
                landed_by = time.monotonic() + LANDING
            if console.is_terminal:
                screen.update(_screen(status, events), refresh=True)
            elif status.t - last >= LINE_EVERY:
                last = status.t
                console.print(_line(status), markup=False, soft_wrap=True)
            for event in new:
                if event.kind not in ("policy", "residual"):
                    screen.console.print(f"{event.t:.1f} s {event.kind}: {event.note}", markup=False, soft_wrap=True)
            time.sleep(0.05)


def _line(status: Status) -> str:
    control = status.control
    versions = ", ".join(f"{half} {n}" for half, n in control.get("versions", {}).items())
    return (
        f"{max(0.0, status.t):.0f} s, {control.get('mode', 'not started')}, error {control.get('error', 0.0):.3f} m, "
        f"versions: {versions}, missed ticks: {control.get('missed', 0)}"
    )


def _screen(status: Status, events: LiveEvents) -> Table:
    control = status.control
    table = Table(title=f"live, {max(0.0, status.t):.1f} s; Ctrl-C lands", min_width=60)
    table.add_column("what")
    table.add_column("now")
    table.add_row("flown by", control.get("mode", "not started"))
    table.add_row("error", f"{control.get('error', 0.0):.4f} m")
    for half, version in control.get("versions", {}).items():
        table.add_row(f"{half} swaps", str(version))
    table.add_row("missed ticks", str(control.get("missed", 0)))
    table.add_row("late samples, held commands", f"{status.world.get('late', 0)}, {status.world.get('held', 0)}")
    table.add_row("processes", ", ".join(role if alive else f"{role} (dead)" for role, alive in status.alive.items()))
    if events.all:
        table.add_row("last event", f"{events.all[-1].t:.1f} s {events.all[-1].kind}: {events.all[-1].note}")
    return table


def _shown(value: object) -> str:
    return "-" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)
