"""A flight is watched and landed whatever the terminal does."""

import inspect
import threading
import time

import pytest

from retrim.live.child_processes import watched
from retrim.live.events import LiveEvents
from retrim.live.status import Status
from retrim.runtime.events import Event


class Flying:
    """Ends a moment after it was told to land."""

    def __init__(self):
        self.began, self.landed, self.finished = time.monotonic(), None, False

    def take_off(self):
        self.began = time.monotonic()

    def land(self):
        self.landed = self.landed or time.monotonic()

    @property
    def landing(self):
        return self.landed is not None

    def finish(self):
        self.finished = True

    def watch(self):
        over = self.landing and time.monotonic() > self.landed + 0.2
        t = time.monotonic() - self.began
        control = {"mode": "policy", "swaps": [[0.1, "policy", 1, 0.1]]}
        return Status(t, control, {}, {}, {}, "landed" if over else None, [], False, 0, None)


def shown_by(show, seconds=0.3, stop=None):
    flight, stop = Flying(), stop or threading.Event()
    status = inspect.unwrap(watched)(flight, seconds, LiveEvents(), show, stop)
    assert flight.finished
    assert status.ended == "landed"
    return flight, stop


def test_all_events_are_shown_once_and_the_end_too():
    seen, times = list[Event](), []

    def show(status, new):
        seen.extend(new)
        times.append(status.ended)

    shown_by(show)
    assert [event.kind for event in seen] == ["policy"]
    assert times[-1] == "landed"


def test_a_report_of_swaps_costs_no_look_at_those_before():
    class Unread(list):
        def __iter__(self):
            raise AssertionError("all swaps so far are looked at")

    def status(first):
        swaps = [[0.1 * i, half, i, 0.1] for i in range(first, first + 50) for half in ("policy", "residual")]
        return Status(1.0, {"swaps": swaps}, {}, {}, {}, None, [], False, 0, None)

    events = LiveEvents()
    events.swaps = Unread()
    for first in (1, 1, 11, 41):
        events.take(status(first))
    assert [event.kind for event in events.all] == ["policy", "residual"] * 90
    assert len(events.swaps) == 180


def test_what_is_ignored_of_a_vehicle_is_told_once():
    events = LiveEvents()
    for notes in ([], ["ODOMETRY in frame 7"], ["ODOMETRY in frame 7"], ["ODOMETRY in frame 7", "another"]):
        events.take(Status(1.0, {}, {"notes": notes}, {}, {}, None, [], False, 0, None))
    assert [event.note for event in events.all] == [
        f"vehicle: {what}; such messages are ignored" for what in ("ODOMETRY in frame 7", "another")
    ]


def test_a_terminal_that_stands_still_stops_nobody():
    blocked, stop = threading.Event(), threading.Event()
    threading.Timer(0.3, stop.set).start()
    began = time.monotonic()
    try:
        flight, _ = shown_by(lambda status, new: blocked.wait(30.0), seconds=1000.0, stop=stop)
        assert 0.2 < flight.landed - began < 1.0
        assert time.monotonic() - began < 5.0
    finally:
        blocked.set()


@pytest.mark.parametrize("error", [BrokenPipeError, SystemExit])
def test_when_nobody_reads_any_more_it_lands(error):
    def show(status, new):
        raise error

    flight, stop = shown_by(show, seconds=1000.0)
    assert stop.is_set()
    assert flight.landing
