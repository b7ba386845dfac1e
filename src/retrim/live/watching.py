"""A live flight from take-off to landing."""

import threading
import time
from collections.abc import Callable

from ..runtime.events import Event
from .events import LiveEvents
from .status import Status
from .supervisor import LANDING, Supervisor
from .wishes import Wishes

EVERY = 0.05  # [s]


def watched(
    supervisor: Supervisor,
    seconds: float,
    events: LiveEvents,
    show: Callable[[Status, list[Event]], None],
    stop: threading.Event,
    wishes: Wishes | None = None,
) -> Status:
    """Take off, watch until the flight is over, and wait until its log is written.

    Args:
        supervisor: Its processes are ready.
        seconds: After which the vehicle lands [s].
        events: They are collected here.
        show: Called many times a second with how the flight stands and what is new.
        stop: Lands the vehicle, too.
        wishes: What a person asks for in flight.

    Returns:
        The last status.
    """
    supervisor.take_off()
    landed_by = float("inf")
    while True:
        status = supervisor.watch()
        new = events.take(status, wishes.obey(status) if wishes is not None else ())
        try:
            show(status, new)
        except (OSError, SystemExit):  # nobody reads any more: whoever is in the air lands
            stop.set()
            show = _nobody
        if status.ended is not None or time.monotonic() > landed_by:
            supervisor.finish()
            return status
        if (stop.is_set() or status.t >= seconds) and landed_by == float("inf"):
            supervisor.land()
            landed_by = time.monotonic() + LANDING
        time.sleep(EVERY)


def _nobody(status: Status, new: list[Event]) -> None:
    del status, new
