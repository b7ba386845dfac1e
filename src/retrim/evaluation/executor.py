"""Collects a fleet's flights: waits for them, reports progress, and keeps all completed ones after a stop."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

from ..errors import ConfigError, JobError
from ..runkit.flights import Flight, FlightSpec
from ..runkit.interrupts import interrupts_only_set
from ..runtime.flight import FlightStopped
from ..viz.flight_curves import FlightCurves, curves_figure
from .batches import FlightBatch
from .flight_table import figure_cells, figure_columns
from .metrics import Rows, rows

if TYPE_CHECKING:
    from ..viz.flight_curves import Figure

MOST_ROWS = 6  # rows of results in the text of flights
SCENARIO = ("plant", "vehicle", "sensors", "thrust_error", "delay", "fault", "reference")
"""Conditions of a scenario that the text of flights states if they differ; the disturbance is always stated."""
CANCELLED: "Future[list[Flight]]" = Future()
"""Placeholder for a future whose flights were discarded; it is cancelled, and never waited for."""
CANCELLED.cancel()
REPORT_PERIOD = 1.0  # interval between progress reports while flights are running [s]
Progress = Callable[[float, int], None]
"""Receives the numbers of completed flights and of all flights; a running flight counts by its completed share."""
Submit = Callable[[FlightBatch, Callable[[float], None]], "Future[list[Flight]]"]
"""Starts a batch; the second argument is a callback that receives the completed share."""


def report_progress(advance: Callable[[float, str], None]) -> Progress:
    """Return a progress callback for a progress bar; ``advance`` receives a share and a text."""
    return lambda done, n: advance(done / n, f"{int(done)} of {n} flights")


@dataclass(frozen=True)
class Flights:
    """The completed flights of a fleet."""

    flights: list[Flight]
    interrupted: bool
    """Whether flights are missing because the fleet was stopped or a job failed."""
    failed: dict[FlightSpec, str] = field(default_factory=dict)
    """Flights whose jobs failed in another process, each with its error in one line."""

    def rows(self) -> Rows:
        """Return one row of results per scenario and method."""
        return rows(self.flights)

    def __repr__(self) -> str:
        """Return the number of flights, and the errors of the first few scenarios and methods."""
        crashes = sum(flight.log.terminated for flight in self.flights)
        lines = [f"Flights: {len(self.flights)} flown, {crashes} crashed, {len(self.failed)} failed"]
        lines[0] += ", interrupted" if self.interrupted else ""
        groups = self._groups()
        for label, flights in list(groups.items())[:MOST_ROWS]:
            figures = zip(figure_columns(), figure_cells(rows(flights)[0]), strict=True)
            lines.append(f"  {label}: {', '.join(f'{name} {text}' for name, text in figures)}")
        return "\n".join(lines + [f"  and {len(groups) - MOST_ROWS} more rows"] * (len(groups) > MOST_ROWS))

    def plot(self) -> "Figure":
        """Draw the errors with the policy updates, the paths from above, and the commands.

        Returns:
            A matplotlib figure, which a notebook shows.
        """
        curves = [
            FlightCurves(
                label, flight.log.t, flight.log.p, flight.log.u, flight.error, flight.target, flight.swaps,
                flight.log.terminated,
            )
            for label, flights in self._groups().items()
            for flight in flights
        ]  # fmt: skip
        return curves_figure(f"{len(curves)} flight{'s' * (len(curves) != 1)}", curves)

    def _groups(self) -> dict[str, list[Flight]]:
        """Return the flights by scenario and method; the labels state the conditions in which the flights differ."""
        scenarios = {flight.spec.scenario for flight in self.flights}
        varied = [name for name in SCENARIO if len({getattr(scenario, name) for scenario in scenarios}) > 1]
        groups: dict[str, list[Flight]] = {}
        for flight in self.flights:
            spec = flight.spec
            conditions = [str(getattr(spec.scenario, name)) for name in ("disturbance", *varied)]
            groups.setdefault(", ".join([*conditions, spec.method]), []).append(flight)
        return groups


def gather_flights(
    specs: Sequence[FlightSpec],
    batches: Sequence[FlightBatch],
    submit: Submit,
    *,
    progress: Progress | None,
    on_result: Callable[[Sequence[Flight]], None] | None,
    stop: threading.Event,
    outlive: bool = False,
    forget: bool = False,
) -> Flights:
    """Start every batch, and wait until all flights are completed or aborted.

    Args:
        specs: The flights, in the order in which they are returned.
        batches: The same flights, in batches.
        submit: Starts one batch.
        progress: Called in this thread when flights are completed, and periodically while they run.
        on_result: Receives completed flights, in this thread.
        stop: Aborts the running flights when it is set. Ctrl-C sets it, too.
        forget: Discard each flight after ``on_result`` has received it; thousands of logs would fill the memory.
        outlive: Continue if a batch fails, and return the failures; a configuration error still ends everything.

    Raises:
        PlantError: A plant refused to fly.
        JobError: The executor can no longer be reached.
    """
    futures: list[Future[list[Flight]]] = []
    aloft, result = dict[int, float](), dict[FlightSpec, Flight | None]()
    failures = dict[FlightSpec, str]()
    try:
        for i, batch in enumerate(batches):
            futures.append(submit(batch, partial(aloft.__setitem__, i)))
        waiting = {future: i for i, future in enumerate(futures)}

        def report() -> None:
            in_air = sum(len(batches[i].specs) * aloft.get(i, 0.0) for i in waiting.values())
            if progress is not None:
                progress(len(result) + len(failures) + in_air, len(specs))

        while waiting:
            over = wait(waiting, REPORT_PERIOD, FIRST_COMPLETED).done
            for future in over:
                error = future.exception()
                if error is not None and (not outlive or isinstance(error, ConfigError | JobError | FlightStopped)):
                    raise error
                if error is not None:
                    failures |= dict.fromkeys(batches[waiting[future]].specs, _describe_error(error))
                else:
                    flights = future.result()
                    result |= {flight.spec: None if forget else flight for flight in flights}
                    if on_result is not None:
                        with interrupts_only_set(stop):
                            on_result(flights)
                    if forget:
                        futures[waiting[future]] = CANCELLED
                del waiting[future]
                report()
            if not over and aloft:
                report()
    except (KeyboardInterrupt, FlightStopped):
        stop.set()
    except BaseException:
        stop.set()
        raise
    finally:
        with interrupts_only_set(stop):  # a further Ctrl-C must not lose completed flights
            for future in futures:
                future.cancel()
            late = [future for future in futures if stop.is_set() and not future.cancelled()]
            complete = [flight for each in late if each.exception() is None for flight in each.result()]
            new = [flight for flight in complete if flight.spec not in result]
            result |= {flight.spec: None if forget else flight for flight in new}
            if on_result is not None and new:
                on_result(new)
    result_flights = [flight for spec in specs if (flight := result.get(spec)) is not None]
    return Flights(result_flights, len(result) < len(specs), failures)


def _describe_error(error: BaseException) -> str:
    """Return an error as one line of text."""
    return " ".join(f"{type(error).__name__}: {error}".split())
