"""Drills: any process may die at any time; the flight continues, or ends in the defined fallback."""

import os
import signal
import time
from dataclasses import replace
from subprocess import Popen

import numpy as np
import pytest

from live_helpers import DrillSupervisor, hover_source, plan
from live_processes import DT, HOME, level
from retrim.config import PRESETS, Scenario
from retrim.config.loading import dump
from retrim.live.events import LiveEvents
from retrim.live.spec import LiveSpec
from retrim.onboard.guard import Mode
from retrim.onboard.launch import launch
from retrim.onboard.messages import COMMAND, TRUE, Setpoint
from retrim.onboard.recorder import read_log
from retrim.onboard.timing_stats import has_measurement
from retrim.transport.message import pack_arrays

DRILL = {"plant": "live_processes:plant", "residual": "live_processes:learner", "policy": "live_processes:learner"}
SECONDS = 1.5
FLOOR = 0.6  # [m], far above the ground, so that landings take less than a second


@pytest.fixture(scope="module")
def controller():
    return hover_source()


def make_spec(folder, controller, floor=FLOOR, **changes):
    start = folder / "start.safetensors"
    start.write_bytes(pack_arrays({}, kind="learnt", about={"preset": dump(PRESETS["hover/retrim"])}))
    limits = plan(controller, floor=floor).limits
    return replace(
        LiveSpec(
            controller, ("residual", "policy"), start, None, Scenario(), "small", level(np.array([0.0, 0.0, 0.5])),
            HOME, limits, DT, 1, 150, SECONDS, 0, folder, mains=DRILL,
        ),
        **changes,
    )  # fmt: skip


def fly_once(spec, kills=None, seconds=SECONDS, number=signal.SIGKILL, is_enough=lambda status: False):
    """Fly, and kill processes at given times; land after some seconds, or as soon as the status is enough.

    Returns:
        The last status, the events, the time until the watchdog's first command [s], and whether the system allowed
        real-time scheduling: without it, a busy machine is late.
    """
    events, took, kills = LiveEvents(), None, dict(kills or {})
    with DrillSupervisor(spec) as drill:
        for _ in drill.warm_up():
            pass
        drill.take_off()
        until = time.monotonic() + 20.0
        while (status := drill.watch()).end_reason is None and time.monotonic() < until:
            events.take(status)
            for role in [role for role, at in kills.items() if status.t >= at]:
                del kills[role]
                os.kill(drill.processes[role].pid, number)
                took = _fallback_delay(drill.bus, time.monotonic()) if role == "control" else None
            if status.t > seconds or is_enough(status):
                drill.land()
            time.sleep(0.02)
        drill.finish()
        events.take(status)
        folder = drill.bus.folder
    assert not folder.exists()
    assert all(process.poll() is not None for process in drill.processes.values())
    return status, events.all, took, not any(drill.refusals.values())


def _fallback_delay(bus, kill):
    """Return the time from the kill to the watchdog's first command [s]."""
    while (message := bus.latest("fallback")) is None and time.monotonic() < kill + 1.0:
        time.sleep(1e-3)
    return Setpoint.unpack(message.data).send_time - kill


def read_whole_log(folder, status=None, until=None):
    """Return the log after asserting that it has every tick of the flight and that every command is finite.

    ``until`` is the time up to which missed ticks are counted [s]: if control dies, no process counts the ticks that
    are lost until the watchdog takes over.
    """
    rows = read_log(folder / "flight.csv")
    assert len(rows) > 10
    measured = rows[has_measurement(rows)]  # other rows contain commands without a measurement
    ticks = measured[:, 0]
    assert ticks[0] == 0
    assert (np.diff(ticks) >= 1).all()
    # A missed tick, or one with a late sample, is counted and has no row. Without a count, one tick in twenty may be
    # missing, because other tests run at the same time.
    if status is not None:
        # the count excludes the landing
        last = measured[measured[:, -1] == Mode.POLICY][-1, 1] if until is None else until
        count = ticks[: np.searchsorted(measured[:, 1], last)]
        assert np.sum(np.diff(count) - 1) <= status.control["missed"] + 1
    missed = 0 if status is None else status.control["missed"]
    assert ticks[-1] + 1 - len(ticks) <= missed + max(2, ticks[-1] // 20)
    assert np.isfinite(rows).all()
    return rows


def test_flight_without_faults_lands(tmp_path, controller):
    status, events, *_ = fly_once(make_spec(tmp_path, controller))
    rows = read_whole_log(tmp_path, status)
    assert status.end_reason == "landed"
    assert rows[-1, -1] == Mode.LANDED
    assert FLOOR - 0.1 < rows[-1, 5] <= FLOOR
    assert next(e.note for e in events if e.kind == "guard") == "descend: landing"
    assert sum(e.kind == "policy" for e in events) >= 3
    assert np.linalg.norm(rows[rows[:, 1] > 1.2][0, 3:6] - HOME) < 0.2


@pytest.mark.parametrize("seed", range(int(os.environ.get("RETRIM_DRILLS", "1"))))  # `make drill` uses four
@pytest.mark.parametrize("roles", ["control", "plant", "watchdog recorder residual policy"])
def test_flight_survives_processes_killed_at_random_times(tmp_path, controller, roles, seed):
    """One flight loses all processes that it does not need; each is restarted."""
    names = roles.split()
    kills = dict(zip(names, np.random.default_rng([seed, len(roles)]).uniform(0.0, SECONDS, len(names)), strict=True))
    at = kills[names[0]]
    status, events, took, punctual = fly_once(make_spec(tmp_path, controller), kills)
    rows = read_whole_log(tmp_path, status, at - 2 * DT if roles == "control" else None)
    if roles == "plant":
        assert status.end_reason.startswith("the plant process is gone")
        assert abs(rows[has_measurement(rows)][-1, 1] - at) < 0.3
        return
    assert status.end_reason == "landed"
    assert np.abs(rows[:, 3:5]).max() < 0.3
    if roles == "control":
        assert took < (0.04 if punctual else 1.0)
        assert rows[-1, -1] == Mode.WATCHDOG
        assert any(e.note.startswith("watchdog: ") for e in events)
    else:
        assert status.restarts == dict.fromkeys(kills, 1)
        assert rows[-1, -1] == Mode.LANDED
        assert not punctual or (rows[rows[:, 1] < SECONDS, -1] == Mode.POLICY).all()


@pytest.mark.parametrize("seed", range(int(os.environ.get("RETRIM_DRILLS", "1"))))
@pytest.mark.parametrize("roles", ["control", "plant", "watchdog recorder residual policy"])
def test_hung_processes_are_detected_at_random_times(tmp_path, controller, roles, seed):
    names = roles.split()
    times = np.random.default_rng([seed, len(roles)]).uniform(0.0, 1.0, len(names))
    stops = dict(zip(names, times, strict=True))
    # The landing without control takes longer than the detection.
    spec = make_spec(tmp_path, controller, 0.1 if roles == "control" else FLOOR, seconds=10.0)
    are_found = lambda status: status.hangs.keys() == stops.keys()  # noqa: E731
    status, events, *_ = fly_once(spec, stops, seconds=10.0, number=signal.SIGSTOP, is_enough=are_found)
    rows = read_whole_log(tmp_path, status, times[0] - 2 * DT if roles == "control" else None)
    notes = [event.note for event in events if "hung" in event.note]
    assert status.hangs == dict.fromkeys(stops, 1)
    assert sorted(note.split()[1] for note in notes) == sorted(names)
    if roles == "plant":
        measured = rows[has_measurement(rows)]
        height = f"{measured[-1, TRUE][2]:.2f}"
        assert status.end_reason.startswith(f"stopped without measurements at {height} m: the plant process hung")
        assert abs(measured[-1, 1] - times[0]) < 0.3
        assert np.isin(rows[len(measured) :, -1], (Mode.BLIND, Mode.DROP)).all()
        assert rows[-1, 1] > times[0] + 1.5  # commands that no plant received
        return
    assert status.end_reason == "landed"
    assert np.abs(rows[:, 3:5]).max() < 0.3
    assert rows[-1, -1] == (Mode.WATCHDOG if roles == "control" else Mode.LANDED)
    assert status.restarts == ({} if roles == "control" else dict.fromkeys(stops, 1))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_vehicle_lands_without_supervisor_and_log_is_complete(tmp_path, controller, number):
    mains = DRILL | ({"control": "quick_control:fly"} if number == signal.SIGSTOP else {})
    spec = make_spec(tmp_path, controller, seconds=1.5 if number == signal.SIGKILL else 60.0, mains=mains)
    process: Popen[bytes] = launch("live_helpers:supervise", spec, tmp_path / "supervisor.log")
    log = tmp_path / "flight.csv"
    until = time.monotonic() + 30.0
    while (not log.exists() or len(log.read_text().splitlines()) < 20) and time.monotonic() < until:
        time.sleep(0.05)
    process.send_signal(number)
    while time.monotonic() < until and (not len(read_log(log)) or read_log(log)[-1, -1] != Mode.LANDED):
        time.sleep(0.1)
    process.send_signal(signal.SIGCONT)  # a suspended supervisor continues and detects the end
    assert process.wait(30.0) == (0 if number == signal.SIGSTOP else -number)
    rows = read_whole_log(tmp_path)
    assert rows[-1, -1] == Mode.LANDED
    assert Mode.DESCEND in rows[:, -1]
    assert np.isfinite(rows[:, COMMAND]).all()
