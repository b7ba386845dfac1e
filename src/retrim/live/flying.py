"""Fly a live flight, from the warm-up to the output files."""

import re
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from ..adapt.learner_state import LearnerState
from ..config.methods import find_method
from ..errors import PlantError
from ..io.logs.recording import Recording, write_npz
from ..io.logs.viewers import can_record, record
from ..onboard.guard import Mode
from ..onboard.log_file import log_path
from ..onboard.messages import ACCOUNTS, COMMAND, MEASURED, PHASE, TRUE
from ..runkit.earlier_outputs import EarlierOutputs
from ..runkit.flights import Flight
from ..runkit.outlet import Outlet
from ..runkit.outputs import clear_outputs, write_events, write_learner_state, write_state
from ..runkit.reporter import Reporter
from ..runkit.run import Run
from ..runtime.events import Event
from ..tasks.transition import splice
from .child_processes import watch_flight
from .events import LiveEvents
from .operator.page_access import page_url
from .operator.requests import OperatorRequests
from .report import collect_learner_state, complaints, flight_of, histograms, missing, results
from .roles import ROLES
from .session import LiveRequest, live_spec
from .status import Status
from .supervisor import Supervisor

OUTPUTS = ("flight.csv", "flight.npz", "flight.mcap", "flight.rrd", "results.json")
START = re.compile(r"start(-\d+)?\.safetensors")
"""Name of an initial state of the learners."""
Display = Callable[[LiveEvents], AbstractContextManager[Callable[[Status, list[Event]], None]]]
"""Function that takes all events so far and returns a context manager. The context manager yields a function, which is
called with the status and the new events."""


class LiveFlight(NamedTuple):
    """Result of a live flight."""

    flight: Flight
    rows: list[dict[str, Any]]
    """Rows of ``results.json``."""
    paths: list[Path]
    """Output files, with the most interesting ones first."""
    request: LiveRequest
    """Request for the flight; its set-up follows all references of the flight in sequence."""
    has_landed: bool
    """Whether the vehicle landed normally, rather than being lost or crashing."""
    outlet: Outlet
    """Folder of the output files, with descriptions of the faults for missing files."""


def fly_live(
    request: LiveRequest, run: Run, reporter: Reporter, display: Display, on_page: Callable[[str], None]
) -> LiveFlight | None:
    """Fly, and write the output files.

    Args:
        request: Request for the flight.
        run: Run with the flight's folder and the interruption flag.
        reporter: Reporter that receives messages before take-off and at the end.
        display: Display of the flight.
        on_page: Function that is called with the page's address when the page is ready.

    Returns:
        The flight; None if it was interrupted before take-off.

    Raises:
        ConfigError: The method cannot be used in a live flight.
        PlantError: The flight could not begin, or did not write a log.
    """
    run.folder.mkdir(parents=True, exist_ok=True)
    events, outlet = LiveEvents(), Outlet(run.folder, run.inputs)
    for role in ROLES:
        (run.folder / f"{role}.log").unlink(missing_ok=True)
    # The display closes last, since a blocked terminal would delay everything else.
    with EarlierOutputs(run.folder, OUTPUTS) as earlier, ExitStack() as screen:
        with Supervisor(replace(live_spec(request), spare=outlet.spare)) as supervisor:
            if not _warm_up(supervisor, run, reporter):
                return None
            earlier.discard()
            clear_outputs(run.folder, run.inputs)
            page = supervisor.spec.page
            if request.page is not None and page is not None and supervisor.page_port is not None:
                on_page(page_url(request.page[0], supervisor.page_port, page.token))
            show = screen.enter_context(display(events))
            with closing(OperatorRequests(request, supervisor)) as wishes:
                status = watch_flight(supervisor, request.seconds, events, show, run.stop, wishes)
            if request.until_stop and status.end_reason == "landed":
                run.stop.clear()  # this is the intended end
            start, trust = supervisor.start, supervisor.spec.trust
            learns = find_method(request.method).learns is not None
            state = collect_learner_state(supervisor.bus, status, start, trust) if learns else None
        if len(pieces := wishes.following.pieces) > 1:  # errors and figures cover all references of the flight
            request = replace(request, setup=request.setup.on(splice(pieces)))
        done = _write(request, run, outlet, status, events, state, supervisor.refusals)
    reporter.say(f"flight over: {status.end_reason}")
    return done


def _write(
    request: LiveRequest, run: Run, outlet: Outlet, status: Status, events: LiveEvents, state: LearnerState | None,
    refusals: dict[str, list[str]],
) -> LiveFlight:  # fmt: skip
    """Write the output files of a flight, the learned parameters first."""
    preset, log = request.setup.preset, log_path(run.folder / "flight.csv", outlet.spare)
    try:
        flight, rows = flight_of(request, events.all, status, state, log)
    except (PlantError, OSError):
        if state is not None:
            outlet.write("the learner state", partial(write_state, state, preset))
        raise
    outlet.faults += missing(rows, status, preset.dt)
    if log.parent != run.folder:
        outlet.faults.append(status.log_moved or f"flight.csv cannot be written to {run.folder}; it is in {log.parent}")
    outlet.write("the learner state", partial(write_learner_state, [flight], preset))
    outlet.write("events.jsonl", partial(write_events, [flight]))
    recording_path = _record(request, rows, events, outlet)
    result = results(request, flight, rows, status, events)
    path = outlet.write_results(
        run, result, seeds=[request.seed], preset=preset.name, seconds=float(flight.log.t[-1]),
        ended=status.end_reason, scheduling=refusals, histograms_ms=histograms(rows),
    )  # fmt: skip
    for start in run.folder.glob("start*.safetensors"):  # initial states, which the learned state contains
        if START.fullmatch(start.name) and start.resolve() not in run.inputs:
            start.unlink(missing_ok=True)
    paths = [*recording_path, *([] if path is None else [path]), log, *complaints(run.folder)]
    return LiveFlight(flight, result, paths, request, status.end_reason == "landed", outlet)


def _record(request: LiveRequest, rows: np.ndarray, events: LiveEvents, outlet: Outlet) -> list[Path]:
    """Write the flight with its landing as NPZ and for viewers; return the path of the requested recording, if any."""
    target = np.asarray(jax.jit(jax.vmap(request.setup.flight_task.target))(rows[:, PHASE]), dtype=float)
    recording = Recording(
        rows[:, 1], rows[:, MEASURED], rows[:, TRUE], rows[:, 2], rows[:, COMMAND],
        np.linalg.norm(rows[:, TRUE][:, :3] - target, axis=1), target,
        controllers=[Mode(int(row[-1])).name.lower() for row in rows], policy_age=rows[:, ACCOUNTS["policy_age"]],
        events=events.all,
    )  # fmt: skip
    outlet.write("flight.npz", lambda folder: write_npz(folder / "flight.npz", recording))
    paths = {".mcap": request.folder / "flight.mcap"}
    if request.record is not None:
        paths[request.record.suffix] = request.record

    def put(path: Path, folder: Path) -> Path:
        place = path if folder == outlet.folder else folder / path.name
        record(place, recording)
        return place

    result = {path: outlet.write(path.name, partial(put, path)) for path in filter(can_record, paths.values())}
    return [place for path, place in result.items() if path == request.record and place is not None]


def _warm_up(supervisor: Supervisor, run: Run, reporter: Reporter) -> bool:
    """Wait until all processes are ready; return False if the user interrupted the wait."""
    with reporter.progress("warming up") as advance:
        for waiting, _ in supervisor.warm_up():
            advance(0.5, f"not ready: {waiting}")
            if run.interrupted:
                reporter.say("interrupted before take-off; the flight did not start")
                return False
    for role, refusals in supervisor.refusals.items():
        for what in refusals:
            reporter.say(f"{role}: no {what}")
    return True
