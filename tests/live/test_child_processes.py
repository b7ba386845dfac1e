"""A flight is observed and landed regardless of the terminal."""

import inspect
import threading
import time

import pytest

from retrim.live.child_processes import watch_flight
from retrim.live.events import LiveEvents
from retrim.live.status import Status
from retrim.runtime.events import Event


class FakeFlight:
    """A flight that ends 0.2 s after the command to land."""

    def __init__(self):
        self.began, self.landing_time, self.finished = time.monotonic(), None, False

    def take_off(self):
        self.began = time.monotonic()

    def land(self):
        self.landing_time = self.landing_time or time.monotonic()

    @property
    def landing(self):
        return self.landing_time is not None

    def finish(self):
        self.finished = True

    def watch(self):
        over = self.landing and time.monotonic() > self.landing_time + 0.2
        t = time.monotonic() - self.began
        control = {"mode": "policy", "swaps": [[0.1, "policy", 1, 0.1]]}
        return Status(t, control, {}, {}, {}, "landed" if over else None, [], False, 0, None)


def run_with(show, seconds=0.3, stop=None):
    flight, stop = FakeFlight(), stop or threading.Event()
    status = inspect.unwrap(watch_flight)(flight, seconds, LiveEvents(), show, stop)
    assert flight.finished
    assert status.end_reason == "landed"
    return flight, stop


def test_events_and_end_are_shown_once():
    events, reasons = list[Event](), []

    def show(status, new):
        events.extend(new)
        reasons.append(status.end_reason)

    run_with(show)
    assert [event.kind for event in events] == ["policy"]
    assert reasons[-1] == "landed"


def test_new_swaps_are_added_without_reading_earlier_ones():
    class UnreadableList(list):
        def __iter__(self):
            raise AssertionError("the function reads earlier swaps")

    def status(first):
        swaps = [[0.1 * i, part, i, 0.1] for i in range(first, first + 50) for part in ("policy", "residual")]
        return Status(1.0, {"swaps": swaps}, {}, {}, {}, None, [], False, 0, None)

    events = LiveEvents()
    events.swaps = UnreadableList()
    for first in (1, 1, 11, 41):
        events.take(status(first))
    assert [event.kind for event in events.all] == ["policy", "residual"] * 90
    assert len(events.swaps) == 180


def test_ignored_messages_of_vehicle_are_reported_once():
    events = LiveEvents()
    for notes in ([], ["ODOMETRY in frame 7"], ["ODOMETRY in frame 7"], ["ODOMETRY in frame 7", "another"]):
        events.take(Status(1.0, {}, {"notes": notes}, {}, {}, None, [], False, 0, None))
    assert [event.note for event in events.all] == [
        f"vehicle: {what}; such messages are ignored" for what in ("ODOMETRY in frame 7", "another")
    ]


def test_blocked_terminal_does_not_delay_landing():
    blocker, stop = threading.Event(), threading.Event()
    threading.Timer(0.3, stop.set).start()
    began = time.monotonic()
    try:
        flight, _ = run_with(lambda status, new: blocker.wait(30.0), seconds=1000.0, stop=stop)
        assert 0.2 < flight.landing_time - began < 1.0
        assert time.monotonic() - began < 5.0
    finally:
        blocker.set()


@pytest.mark.parametrize("error", [BrokenPipeError, SystemExit])
def test_closed_output_lands_vehicle(error):
    def show(status, new):
        raise error

    flight, stop = run_with(show, seconds=1000.0)
    assert stop.is_set()
    assert flight.landing
