"""What becomes of flights that are in the air: they land, are told of, or are given up, and none is lost."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from functools import partial

from ..errors import ConfigError, JobError
from ..runtime.flight import FlightStopped
from .flights import Flight, FlightSpec
from .interrupts import interrupts_only_set
from .lots import Lot
from .metrics import Rows, rows

GONE: "Future[list[Flight]]" = Future()
"""In the place of a future whose flights are forgotten; nobody waits for it."""
GONE.cancel()
OFTEN = 1.0  # [s]: progress is told so often while flights are in the air
Progress = Callable[[float, int], None]
"""Called with the number of flights that are over, one in the air by the share that was flown, and of all flights."""
Submit = Callable[[Lot, Callable[[float], None]], "Future[list[Flight]]"]
"""Starts a lot; the function that it gets is told the share that was flown."""


def told_by(advance: Callable[[float, str], None]) -> Progress:
    """Return the progress of a fleet for a bar: ``advance`` takes a share and a text."""
    return lambda done, n: advance(done / n, f"{done:.0f} of {n} flights")


@dataclass(frozen=True)
class Flights:
    """The flights of a fleet that were flown to their end."""

    flown: list[Flight]
    interrupted: bool
    """Some flights are missing: the fleet was stopped, or a job failed."""
    failed: dict[FlightSpec, str] = field(default_factory=dict)
    """Flights whose job failed in another process, and why, in one line."""

    def rows(self) -> Rows:
        """Return one row of results per scenario, method and seed."""
        return rows(self.flown)


def gathered(
    specs: Sequence[FlightSpec],
    lots: Sequence[Lot],
    submit: Submit,
    *,
    progress: Progress | None,
    landed: Callable[[Sequence[Flight]], None] | None,
    stop: threading.Event,
    outlive: bool = False,
    forget: bool = False,
) -> Flights:
    """Start every lot, and wait until all flights are over or given up.

    Args:
        specs: Flights, in the order in which they are returned.
        lots: The same, in lots.
        submit: Starts one.
        progress: Called in this thread when flights are over, and now and then before.
        landed: Receives flights that were flown to their end, in this thread.
        stop: Gives up what is flying. Ctrl-C does the same, and sets it.
        forget: Keep no flight once ``landed`` has seen it: thousands of logs fill a memory.
        outlive: Go on where a lot failed, and tell in the end; what does not fit together still ends everything.

    Raises:
        PlantError: A plant refused.
        JobError: Nobody can be reached any more who would fly.
    """
    futures: list[Future[list[Flight]]] = []
    aloft, flown = dict[int, float](), dict[FlightSpec, Flight | None]()
    failed = dict[FlightSpec, str]()
    try:
        for i, lot in enumerate(lots):
            futures.append(submit(lot, partial(aloft.__setitem__, i)))
        waiting = {future: i for i, future in enumerate(futures)}

        def told() -> None:
            in_air = sum(len(lots[i].specs) * aloft.get(i, 0.0) for i in waiting.values())
            if progress is not None:
                progress(len(flown) + len(failed) + in_air, len(specs))

        while waiting:
            over = wait(waiting, OFTEN, FIRST_COMPLETED).done
            for future in over:
                error = future.exception()
                if error is not None and (not outlive or isinstance(error, ConfigError | JobError | FlightStopped)):
                    raise error
                if error is not None:
                    failed |= dict.fromkeys(lots[waiting[future]].specs, _told(error))
                else:
                    flights = future.result()
                    flown |= {flight.spec: None if forget else flight for flight in flights}
                    if landed is not None:
                        with interrupts_only_set(stop):
                            landed(flights)
                    if forget:
                        futures[waiting[future]] = GONE
                del waiting[future]
                told()
            if not over and aloft:
                told()
    except (KeyboardInterrupt, FlightStopped):
        stop.set()
    except BaseException:
        stop.set()
        raise
    finally:
        with interrupts_only_set(stop):  # a further Ctrl-C must not lose what is done
            for future in futures:
                future.cancel()
            late = [future for future in futures if stop.is_set() and not future.cancelled()]
            kept = [flight for each in late if each.exception() is None for flight in each.result()]
            new = [flight for flight in kept if flight.spec not in flown]
            flown |= {flight.spec: None if forget else flight for flight in new}
            if landed is not None and new:
                landed(new)
    kept_flights = [flight for spec in specs if (flight := flown.get(spec)) is not None]
    return Flights(kept_flights, len(flown) < len(specs), failed)


def _told(error: BaseException) -> str:
    """Return an error in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())
