"""One live flight from the warm-up to its files."""

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from ..adapt.learner import LearnerState
from ..experiments.flights import Flight
from ..experiments.outputs import clear_outputs, write_events, write_learnt
from ..experiments.reporter import Reporter
from ..experiments.run import Run
from ..io.logs.recording import Recording, write_npz
from ..io.logs.viewers import can_record, record
from ..onboard.guard import Mode
from ..onboard.messages import ACCOUNTS, COMMAND, MEASURED, TRUE
from ..runtime.events import Event
from ..tasks.transition import spliced
from .events import LiveEvents
from .page_access import page_url
from .report import complaints, flight_of, histograms, learnt_in, missing, results
from .session import LEARNING, LiveRequest, live_spec
from .status import Status
from .supervisor import Supervisor
from .watching import watched
from .wishes import Wishes

Display = Callable[[LiveEvents], AbstractContextManager[Callable[[Status, list[Event]], None]]]
"""From all events so far to a context in which a function is told how the flight stands and what is new."""


class LiveFlight(NamedTuple):
    """What a live flight was."""

    flight: Flight
    rows: list[dict[str, Any]]
    """Those of ``results.json``."""
    paths: list[Path]
    """Files that it left, those that a person looks at first."""
    request: LiveRequest
    """The request, on all that was followed."""
    landed: bool
    """Whether the vehicle came down by this flight's own doing: it was not lost, and did not crash."""
    faults: list[str]
    """What is missing of its files, each in a line."""


def fly_live(
    request: LiveRequest, run: Run, reporter: Reporter, display: Display, opened: Callable[[str], None]
) -> LiveFlight | None:
    """Fly, and write what the flight leaves.

    Args:
        request: What is asked.
        run: Its folder, and whether somebody interrupts it.
        reporter: Told what happens before take-off and at the end.
        display: Shows the flight.
        opened: Called with where the page is, once it is there.

    Returns:
        The flight; None if it was interrupted before take-off.

    Raises:
        ConfigError: The method cannot be flown live.
        PlantError: The flight could not begin, or left no log.
    """
    run.folder.mkdir(parents=True, exist_ok=True)
    clear_outputs(run.folder)
    for old in (*run.folder.glob("*.log"), run.folder / "flight.csv"):
        old.unlink(missing_ok=True)
    events = LiveEvents()
    with ExitStack() as screen:  # it closes last, since a terminal that stands still would keep everything else waiting
        with Supervisor(live_spec(request)) as supervisor:
            if not _warmed_up(supervisor, run, reporter):
                return None
            page = supervisor.spec.page
            if request.page is not None and page is not None and supervisor.page_port is not None:
                opened(page_url(request.page[0], supervisor.page_port, page.token))
            show = screen.enter_context(display(events))
            with closing(Wishes(request, supervisor)) as wishes:
                status = watched(supervisor, request.seconds, events, show, run.stop, wishes)
            if request.until_stopped and status.ended == "landed":
                run.stop.clear()  # it ended as it was meant to
            start, trust = supervisor.start, supervisor.spec.trust
            learnt = learnt_in(supervisor.bus, status, start, trust) if request.method in LEARNING else None
        if len(pieces := wishes.following.pieces) > 1:  # errors and pictures are of all that was followed
            request = replace(request, setup=request.setup.on(spliced(pieces)))
        done = _written(request, run, status, events, learnt, supervisor.refused)
    reporter.say(f"flight over: {status.ended}")
    return done


def _written(
    request: LiveRequest,
    run: Run,
    status: Status,
    events: LiveEvents,
    learnt: LearnerState | None,
    refused: dict[str, list[str]],
) -> LiveFlight:
    """Write what a flight leaves."""
    flight, rows = flight_of(request, events.all, status, learnt)
    found, faults = results(request, flight, rows, status, events), missing(rows, status, request.setup.preset.dt)
    run.write_results(
        found, seeds=[request.seed], preset=request.setup.preset.name, seconds=float(flight.log.t[-1]),
        ended=status.ended, faults=faults, scheduling=refused, histograms_ms=histograms(rows),
    )  # fmt: skip
    write_events([flight], run.folder)
    write_learnt([flight], request.setup.preset, run.folder)
    recorded = _recorded(request, rows, events)
    for start in run.folder.glob("start*.safetensors"):  # what learners went on from; it is in what they learnt
        start.unlink()
    paths = [*recorded, run.folder / "results.json", run.folder / "flight.csv", *complaints(run.folder)]
    return LiveFlight(flight, found, paths, request, status.ended == "landed", faults)


def _recorded(request: LiveRequest, rows: np.ndarray, events: LiveEvents) -> list[Path]:
    """Write the flight, the landing too, as NPZ and for viewers; return where the recording is that was asked for."""
    target = np.asarray(jax.jit(jax.vmap(request.setup.flown.target))(rows[:, 1]), dtype=float)
    recording = Recording(
        rows[:, 1], rows[:, MEASURED], rows[:, TRUE], rows[:, 2], rows[:, COMMAND],
        np.linalg.norm(rows[:, TRUE][:, :3] - target, axis=1), target,
        flown_by=[Mode(int(row[-1])).name.lower() for row in rows], policy_age=rows[:, ACCOUNTS["policy_age"]],
        events=events.all,
    )  # fmt: skip
    write_npz(request.folder / "flight.npz", recording)
    paths = {".mcap": request.folder / "flight.mcap"}
    if request.record is not None:
        paths[request.record.suffix] = request.record
    for path in filter(can_record, paths.values()):
        record(path, recording)
    return [] if request.record is None else [request.record]


def _warmed_up(supervisor: Supervisor, run: Run, reporter: Reporter) -> bool:
    """Wait until all are ready; return whether nobody interrupted that."""
    with reporter.progress("warming up") as advance:
        for waiting, _ in supervisor.warm_up():
            advance(0.5, f"compiling; not ready: {waiting}")
            if run.interrupted:
                reporter.say("interrupted before take-off; nothing has flown")
                return False
    for role, refused in supervisor.refused.items():
        for what in refused:
            reporter.say(f"{role}: no {what}")
    return True
