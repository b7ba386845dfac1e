"""Flights of a real-time vehicle: preparation, take-off, hand-over, and every possible end."""

import os
import signal
import time
from dataclasses import replace

import numpy as np
import pytest

from live_helpers import DrillSupervisor, hover_source, plan
from live_processes import DT, HOME, level
from retrim import ConfigError, PlantError, Scenario, load
from retrim.evaluation import Fleet
from retrim.live.events import LiveEvents
from retrim.live.spec import VEHICLE, LiveSpec
from retrim.live.status import Status
from retrim.onboard.guard import Mode
from retrim.onboard.recorder import read_log

LEARNERS = {"residual": "live_processes:learner", "policy": "live_processes:learner"}
SECONDS = 1.5
FLOOR = 0.6  # [m], far above the ground, so that landings take less than a second


@pytest.fixture(scope="module")
def controller():
    return hover_source()


def make_spec(folder, controller):
    start = folder / "start.safetensors"
    start.write_bytes(b"")
    return LiveSpec(
        controller, ("residual", "policy"), start, None, Scenario(plant="fake_vehicle:point"), "small", level(HOME),
        HOME, plan(controller, floor=FLOOR).limits, DT, 1, 150, SECONDS, 0, folder,
        mains={"plant": VEHICLE} | LEARNERS,
    )  # fmt: skip


def fly_once(spec, kill=None):
    """Fly; return the last status and the events."""
    events = LiveEvents()
    with DrillSupervisor(spec) as flight:
        for _ in flight.warm_up():
            pass
        flight.take_off()
        until = time.monotonic() + 20.0
        while (status := flight.watch()).end_reason is None and time.monotonic() < until:
            events.take(status)
            if kill and status.t > 0.5:
                os.kill(flight.processes[kill].pid, signal.SIGKILL)
                kill = None
            if status.t > SECONDS:
                flight.land()
            time.sleep(0.02)
        flight.finish()
        events.take(status)
    return status, events.all


@pytest.fixture(scope="module")
def sample_flight(tmp_path_factory, controller):
    """Return the last status and the log of a flight whose vehicle needs some seconds for its landing."""
    spec = make_spec(tmp_path_factory.mktemp("flight"), controller)
    status, _ = fly_once(replace(spec, scenario=Scenario(plant="fake_vehicle:slow_to_land")))
    return status, read_log(spec.folder / "flight.csv")


def test_vehicle_flies_from_hand_over_to_landing(sample_flight):
    status, rows = sample_flight
    assert status.end_reason == "landed"
    assert rows[0, 0] == 0
    assert rows[-1, -1] == Mode.LANDED
    # A busy machine may skip ticks, but neither delays the flight nor changes the numbers of ticks.
    flying = rows[rows[:, 1] < SECONDS]
    np.testing.assert_allclose(flying[:, 1], flying[:, 0] * DT, atol=1e-6)
    assert np.all(np.diff(flying[:, 0]) >= 1)
    assert flying[-1, 0] > 0.8 * SECONDS / DT
    assert np.linalg.norm(flying[-1, 3:6] - HOME) < 0.3


def test_slow_landing_is_not_hang(sample_flight):
    status, _ = sample_flight
    assert status.end_reason == "landed"
    assert not status.hangs


@pytest.fixture
def plain_spec(tmp_path, controller):
    """Return the specification of a flight without learners."""
    return replace(make_spec(tmp_path, controller), layers=())


def test_watchdog_lands_vehicle_without_control(plain_spec):
    status, events = fly_once(plain_spec, "control")
    rows = read_log(plain_spec.folder / "flight.csv")
    assert status.end_reason == "landed"
    assert rows[-1, -1] == Mode.WATCHDOG
    assert any(event.note.startswith("watchdog: ") for event in events)


def test_lost_link_ends_flight_and_log_is_complete(plain_spec):
    status, _ = fly_once(replace(plain_spec, scenario=Scenario(plant="fake_vehicle:lost")))
    assert status.end_reason == "plant lost: the link has been silent"
    assert read_log(plain_spec.folder / "flight.csv")[-1, 1] > 0.1


def test_vehicle_that_refuses_to_arm_does_not_fly(plain_spec):
    spec = replace(plain_spec, scenario=Scenario(plant="fake_vehicle:unarmed"))
    with pytest.raises(PlantError, match=r"before it began: .*refuses to be armed; it said: no battery"), \
            DrillSupervisor(spec) as flight:  # fmt: skip
        for _ in flight.warm_up():
            pass
    assert not flight.bus.folder.exists()


def test_interrupt_before_take_off_leaves_vehicle_on_ground(plain_spec):
    flight = DrillSupervisor(plain_spec)
    with flight:
        for _ in flight.warm_up():
            if flight.bus.latest("ready.plant") is not None:
                break
        processes = dict(flight.processes)
    assert all(process.poll() is not None for process in processes.values())
    log = plain_spec.folder / "flight.csv"
    assert not log.exists() or not len(read_log(log))


def test_simulated_flight_of_real_vehicle_is_refused():
    preset = load("hover/retrim")
    with pytest.raises(ConfigError, match="use `retrim live`"):
        Fleet(preset, {0: None}, [Scenario(plant="mavlink")])


def status(*, flies, ticks):
    return Status(1.0, {}, {}, {}, {}, None, [], flies, ticks, None)


def test_short_flight_by_watchdog_is_reported():
    events = LiveEvents()
    for each in [status(flies=False, ticks=0), status(flies=True, ticks=2), status(flies=False, ticks=3)]:
        events.take(each)
    notes = [event.note for event in events.all]
    assert notes[0].startswith("watchdog: ")
    assert notes[1] == "watchdog: it flew 3 ticks, control was late"
    events.take(status(flies=False, ticks=3))
    assert len(events.all) == 2
