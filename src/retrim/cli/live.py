"""``retrim live``: fly and learn in real time."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import tyro
from rich.live import Live
from rich.table import Table

from ..config.limits import check_seeds
from ..config.loading import load_for
from ..config.setup import Setup
from ..errors import ConfigError
from ..evaluation.figures import picture
from ..io.logs.viewers import check_recording
from ..live.display import figures, live_line, live_rows
from ..live.events import LiveEvents
from ..live.flying import fly_live
from ..live.operator.page import page_address
from ..live.operator.page_opening import open_page
from ..live.session import LONGEST, LiveRequest, check_limits, learners_at, live_setup
from ..live.status import Status
from ..replay.flight_vehicle import check_vehicle_file, write_flight_vehicle
from ..runkit.document import TableSection
from ..runkit.flight_memory import FlightMemory, recall_flight, write_memory
from ..runkit.interrupts import interrupts_only_set
from ..runkit.run import INTERRUPTED, Run
from ..runkit.training import train
from ..runtime.events import Event
from ..transport.remote import LOOPBACK
from .arguments import METHOD, RESIDUAL, FlightArguments, load_inputs, with_residual
from .console import RichReporter, Trust, console, refuse, report_start, show_paths, show_table
from .options import option

LINE_EVERY = 5.0  # [s]: interval between status lines if the output is not a terminal


def live(
    policy: Path | None = None,
    resume: Path | None = None,
    preset: str = "hover/retrim",
    flight: tyro.conf.OmitArgPrefixes[FlightArguments] = FlightArguments(),  # noqa: B008
    adapt: Annotated[str, option(METHOD)] = "full",
    residual: Annotated[str | None, option(RESIDUAL, optional=True)] = None,
    seconds: float | None = None,
    fence: float = 3.0,
    policy_age: float | None = None,
    seed: int = 0,
    learners: str | None = None,
    key: Path | None = None,
    page: tyro.conf.FlagCreatePairsOff[bool] = False,
    no_page: tyro.conf.FlagCreatePairsOff[bool] = False,
    page_host: str = LOOPBACK[0],
    page_port: int = 8080,
    record: Path | None = None,
    save_vehicle: Path | None = None,
    trust: Trust = (),
    out: Path | None = None,
) -> Callable[[threading.Event], int]:
    """Fly in real time and learn at the same time, with separate processes for control, each learner and the plant.

    Ctrl-C lands the vehicle. A flight without `--seconds` ends in this way, with exit code 0.

    Args:
        policy: A policy.safetensors, or the folder that contains one; by default, a policy is trained first.
        resume: A learner_state.safetensors from an earlier flight, from which to continue.
        preset: Preset to train with if there is neither --policy nor --resume.
        flight: Plant, vehicle and disturbances of the flight.
        adapt: Method of the flight; full and lora re-train the policy in flight.
        residual: Residual model of the learners.
        seconds: Length of the flight [s]; by default, until Ctrl-C.
        fence: Distance from the reference along any axis at which the fallback controller takes over [m].
        policy_age: Age of a learned policy's flight data at which the fallback controller takes over [s]; by default
            unlimited.
        seed: Seed of the start, the learners and the random parts of the scenario.
        learners: Address at which learners on another machine, started by `retrim learn`, reach this one:
            zenoh:HOST:PORT (this machine listens there), ros2:DOMAIN, or ros:HOST:PORT of a rosmaster. Default: here.
        key: File with the key that `retrim learn` also has; by default the key in RETRIM_KEY. Learners on another
            machine need one.
        page: Show the flight in a browser, with controls. Without `--seconds`, this is the default.
        no_page: Show the flight in the terminal only.
        page_host: Address that the page listens on. The printed address contains a token, which every request needs.
        page_port: Port of the page; if it is in use, the next free port.
        record: FILE.mcap for Foxglove and PlotJuggler, or FILE.rrd for rerun; by default flight.mcap in the folder.
        save_vehicle: Vehicle file (TOML) to write for pretraining, with the vehicle identified in the flight.
        trust: Python name that a file may contain, such as mine:task; its code is run. Repeat the option for each name.
        out: Folder for the results of the flight; by default, a new one under runs/.
    """

    def execute(stop: threading.Event) -> int:
        check_seeds([seed])
        check_recording(record)
        check_vehicle_file(save_vehicle, flight.vehicle)
        if page and no_page:
            raise ConfigError("--page and --no-page: choose one")
        check_limits(fence, seconds, policy_age)
        state, weights, base = None, None, load_for(preset.partition("/")[0], preset)
        if policy is not None or resume is not None:
            weights, base, state = load_inputs(policy, resume, trust=trust)
        base = with_residual(base, residual, state)
        scenario = flight.scenario(base)
        shows_page = page or (seconds is None and not no_page)
        address = page_address(page_host, page_port, is_explicit=page, say=RichReporter().say) if shows_page else None
        ground = learners_at(learners, RichReporter().say, key)
        setup = live_setup(base, scenario.reference, "base" if adapt == "none" else adapt)
        run = report_start(Run("live", out, stop=stop, inputs=(policy, resume)))
        if weights is None:
            weights, losses = train(Setup.from_preset(base), seed, reporter=RichReporter(), stop=stop)
            if run.interrupted:
                console.print(f"interrupted while pretraining, after {len(losses)} steps; the flight did not start")
                return INTERRUPTED
        memory, state = recall_flight(flight.memory, setup, scenario, weights, state, adapt, seed, RichReporter().say)
        request = LiveRequest(
            setup, weights, scenario, "base" if adapt == "none" else adapt, seconds or LONGEST, seed, fence, run.folder,
            state, address, ground, policy_age=policy_age or float("inf"), record=record, until_stop=seconds is None,
        )  # fmt: skip
        with interrupts_only_set(run.stop):  # a Ctrl-C must land the vehicle, not end the processes
            return _fly(request, run, save_vehicle, memory)

    return execute


def _fly(request: LiveRequest, run: Run, vehicle_file: Path | None, memory: FlightMemory | None) -> int:
    """Run one flight and show its results."""
    done = fly_live(request, run, RichReporter(), _display, lambda url: _open_page(url, run.folder))
    if done is None:
        return INTERRUPTED
    flights, setup = [done.flight], done.request.setup
    pictures = done.outlet.write("the picture", lambda out: picture(flights, setup, request.scenario, out, stem="live"))
    show_table(TableSection(("figure", "unit", "value"), figures(done.rows), f"live, {done.flight.log.t[-1]:.1f} s"))
    vehicle_path = write_flight_vehicle(done.flight, setup, vehicle_file, done.outlet.faults, run.folder)
    memories = write_memory(memory, flights, setup, done.outlet.faults)
    show_paths([*(pictures or [])[:1], *done.paths, *vehicle_path, *memories])
    codes = [refuse(fault) for fault in done.outlet.faults]
    return run.exit_code or max(codes, default=int(not done.has_landed))


def _open_page(url: str, folder: Path) -> None:
    """Print the address of the page, and open it in a browser if the output is a terminal."""
    console.print(f"page: {url}", soft_wrap=True)
    if console.is_terminal:
        open_page(url, folder)


@contextmanager
def _display(events: LiveEvents) -> Iterator[Callable[[Status, list[Event]], None]]:
    """Show a flight as a table in a terminal or as periodic lines elsewhere, and show events when they occur."""
    last = float("-inf")

    def show(status: Status, new: list[Event]) -> None:
        nonlocal last
        if console.is_terminal:
            screen.update(_screen(status, events), refresh=True)
        elif status.t - last >= LINE_EVERY:
            last = status.t
            console.print(live_line(status), soft_wrap=True)
        for event in new:
            if event.kind not in ("policy", "residual", "rejected"):
                screen.console.print(f"{event.t:.1f} s {event.kind}: {event.note}", soft_wrap=True)

    with Live(console=console, auto_refresh=False) as screen:
        yield show


def _screen(status: Status, events: LiveEvents) -> Table:
    table = Table("what", "now", title=f"live, {max(0.0, status.t):.1f} s; Ctrl-C lands", min_width=60)
    for row in live_rows(status, events):
        table.add_row(*row)
    return table
