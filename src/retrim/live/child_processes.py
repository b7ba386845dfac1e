"""Monitor a live flight from take-off to landing."""

import contextlib
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from ..runtime.events import Event
from .events import LiveEvents
from .operator.requests import OperatorRequests
from .status import Status
from .supervisor import LANDING, Supervisor

STATUS_PERIOD = 0.05  # [s] between two reads of the status
LAST = 1.0  # [s], longest wait for a terminal to display the end of a flight


def watch_flight(
    supervisor: Supervisor,
    seconds: float,
    events: LiveEvents,
    show: Callable[[Status, list[Event]], None],
    stop: threading.Event,
    wishes: OperatorRequests | None = None,
) -> Status:
    """Take off, monitor the flight until it is over, and wait until its log is written.

    Args:
        supervisor: Supervisor whose processes are ready.
        seconds: Time after which the vehicle lands [s].
        events: Events of the flight; this function adds new events.
        show: Function that is called many times per second with the status and the new events.
        stop: Event that lands the vehicle early.
        wishes: User requests in flight.

    Returns:
        The last status.
    """
    supervisor.take_off()
    deadline = float("inf")
    with _Screen(show) as screen:
        while True:
            status = supervisor.watch()
            new = events.take(status, wishes.obey(status) if wishes is not None else ())
            if not screen.show(status, new):  # the display has closed: land the vehicle
                stop.set()
            if status.end_reason is not None or time.monotonic() > deadline:
                supervisor.finish()
                return status
            if (stop.is_set() or supervisor.landing or status.t >= seconds) and deadline == float("inf"):
                supervisor.land()
                deadline = time.monotonic() + LANDING
            time.sleep(STATUS_PERIOD)


class _Screen:
    """Shows the status in a separate thread so that a blocked terminal does not block the flight."""

    def __init__(self, show: Callable[[Status, list[Event]], None]) -> None:
        self._show, self._waiting = show, list[Event]()
        self._last: Status | None = None
        self._thread = ThreadPoolExecutor(1)
        self._work: Future[None] | None = None
        self._unusable = False

    def __enter__(self) -> "_Screen":
        return self

    def __exit__(self, *_: object) -> None:
        """Show the end of the flight if the display responds within one second."""
        with contextlib.suppress(TimeoutError, OSError, SystemExit):
            if self._work is not None:
                self._work.result(LAST)
            if self._last is not None and not self._unusable:
                self._thread.submit(self._show, self._last, self._waiting).result(LAST)
        self._thread.shutdown(wait=False, cancel_futures=True)

    def show(self, status: Status, new: list[Event]) -> bool:
        """Show the status if the previous call has finished; return whether the display still works."""
        self._waiting += new
        self._last = status
        if self._unusable or (self._work is not None and not self._work.done()):
            return not self._unusable
        try:
            if self._work is not None:
                self._work.result()
        except (OSError, SystemExit):
            self._unusable = True
            return False
        self._work, self._waiting = self._thread.submit(self._show, status, self._waiting), []
        return True
