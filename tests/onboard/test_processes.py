"""The clock of the control process, the watchdog, the recorder and the timing records, without a real clock."""

import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from live_helpers import HIGH, LOW, TOPICS
from live_processes import DT, HOME, level, move
from retrim.onboard.control_process import PATIENCE, Schedule
from retrim.onboard.guard import G, Limits, Mode
from retrim.onboard.launch import launch
from retrim.onboard.log_file import log_path
from retrim.onboard.messages import (
    ACCOUNTS,
    COLUMNS,
    COMMAND,
    FlightRows,
    Sample,
    Setpoint,
    Stamp,
    last_note,
    pack_note,
)
from retrim.onboard.realtime import ParentWatch, cores_of
from retrim.onboard.recorder import Recorder, RecorderPlan, read_log, record
from retrim.onboard.tick_budget import MARGIN, PHASE, ROOM, SHARE
from retrim.onboard.timing_stats import is_from_control, summary
from retrim.onboard.watchdog import Watchdog, WatchdogPlan
from retrim.transport.in_process import InProcessBus
from retrim.transport.shared_memory import SharedMemoryBus

LIMITS = Limits(np.full(3, -5.0), np.full(3, 5.0), LOW, HIGH)


def sample(tick, sending, x=None):
    state = level() if x is None else x
    return Sample(tick, tick * DT, sending, 0.0, state, state, np.array([G, 0.0, 0.0, 0.0]))


def steps(sending, work=0.001, ticks=60):
    """Return the start times of steps for samples that are sent at ``sent(tick)``, and the sample of each step."""
    schedule, observation, result = Schedule(0.0, DT), None, []
    now = 0.0
    for _ in range(ticks):
        now = max(now, schedule.next())
        until, last = now + PATIENCE * DT, -1 if observation is None else observation.tick
        coming = [k for k in range(last + 1, last + 40) if sending(k) <= until]
        if coming:
            observation = Stamp(coming[-1], sending(coming[-1]))
            now = max(now, observation.send_time)
        result.append((now, None if observation is None else observation.tick))
        now += work
        schedule.done(now, observation)
    return np.array(result, dtype=float)


def test_steps_follow_samples_one_by_one():
    result = steps(lambda k: k * DT)
    np.testing.assert_array_equal(result[:, 1], np.arange(60))
    np.testing.assert_allclose(result[:, 0], (np.arange(60) + PHASE) * DT, atol=1e-9)


@pytest.mark.parametrize("rate", [0.999, 1.001])
def test_clock_drift_is_followed(rate):
    result = steps(lambda k: k * DT * rate, ticks=500)
    np.testing.assert_array_equal(result[:, 1], np.arange(500))
    assert np.abs(result[:, 0] - result[:, 1] * DT * rate - PHASE * DT).max() < 1e-3


@pytest.mark.parametrize("pause", [0.003, 0.009, 0.05, 1.0])
def test_paused_plant_is_followed_again(pause):
    result = steps(lambda k: k * DT + (pause if k >= 20 else 0.0), ticks=160)
    last = result[-20:]
    np.testing.assert_array_equal(np.diff(last[:, 1]), 1.0)
    assert (last[:, 0] - (last[:, 1] * DT + pause) < (PHASE + PATIENCE) * DT).all()
    answer = set(result[:, 1])
    assert set(range(int(last[-1, 1]))) - answer <= set(range(20, 30))


def test_single_late_sample_does_not_shift_clock():
    result = steps(lambda k: k * DT + (0.0045 if k == 20 else 0.0))
    np.testing.assert_array_equal(result[:, 1], np.arange(60))
    np.testing.assert_allclose(result[21:, 0], (np.arange(21, 60) + PHASE) * DT, atol=1e-9)


def test_step_that_ends_in_next_tick_skips_none():
    result = steps(lambda k: k * DT, work=DT + 1e-4)
    assert np.diff(result[:, 1]).max() <= 2.0
    short = steps(lambda k: k * DT, work=0.9 * DT)
    np.testing.assert_array_equal(short[:, 1], np.arange(60))


def test_slow_decision_arrives_within_waiting_time():
    assert PHASE + ROOM + MARGIN <= SHARE + 1e-9
    result = steps(lambda k: k * DT, work=ROOM * DT)
    np.testing.assert_array_equal(result[:, 1], np.arange(60))
    assert (result[:, 0] + ROOM * DT - result[:, 1] * DT <= (SHARE - MARGIN) * DT + 1e-9).all()


class WatchdogTest:
    def __init__(self):
        self.bus = InProcessBus(TOPICS)
        plan = WatchdogPlan(Path(), LIMITS, DT, HOME, frozenset({0}), 40, os.getpid(), os.getpid())
        self.watchdog = Watchdog(plan, self.bus)

    def report(self, tick, now, target=HOME):
        self.bus.publish("setpoint", Setpoint(tick, now, np.array([G, 0.0, 0.0, 0.0]), np.array(target)).pack())


def test_watchdog_is_silent_while_control_reports():
    watchdog_test = WatchdogTest()
    for k in range(50):
        watchdog_test.bus.publish("sample", sample(k, k * DT).pack())
        watchdog_test.report(k, k * DT)
        assert watchdog_test.watchdog.check(k * DT, control_ended=False) is None


@pytest.mark.parametrize(("loss", "within"), [(True, 0.001), (False, 0.04)])
def test_watchdog_commands_soon_after_loss_of_control(loss, within):
    watchdog_test = WatchdogTest()
    watchdog_test.bus.publish("sample", sample(0, 0.0, level((1.0, 2.0, 1.5))).pack())
    watchdog_test.report(0, 0.0, target=(1.0, 2.0, 1.5))
    watchdog_test.watchdog.check(0.0, control_ended=False)
    now, result = 0.0, None
    while result is None and now < 1.0:
        now += 0.001
        if round(now / DT, 6) == round(now / DT):
            watchdog_test.bus.publish("sample", sample(round(now / DT), now, level((1.0, 2.0, 1.5))).pack())
        result = watchdog_test.watchdog.check(now, control_ended=loss)
    assert now <= within
    np.testing.assert_allclose(result.u, [G, 0.0, 0.0, 0.0], atol=1e-6)  # it holds the target position


def test_invalid_command_counts_as_silence():
    watchdog_test, result = WatchdogTest(), []
    watchdog_test.bus.publish("sample", sample(0, 0.0).pack())
    watchdog_test.report(0, 0.0)
    watchdog_test.watchdog.check(0.0, control_ended=False)
    for k in range(1, 20):
        watchdog_test.bus.publish("sample", sample(k, k * DT).pack())
        watchdog_test.report(k, k * DT, target=(0.0, np.nan, 1.0))
        result.append(watchdog_test.watchdog.check(k * DT, control_ended=False))
    assert all(each is not None for each in result[1:])
    np.testing.assert_array_equal(result[-1].target, HOME)


def test_watchdog_responds_to_refused_measurements():
    watchdog_test = WatchdogTest()
    watchdog_test.bus.publish("sample", sample(0, 0.0).pack())
    result = [watchdog_test.watchdog.check(0.0, control_ended=True)]
    for k in range(1, 20):
        watchdog_test.bus.publish("sample", sample(k, k * DT, np.full(15, np.nan)).pack())
        result.append(watchdog_test.watchdog.check(k * DT, control_ended=True))
    assert [each.tick for each in result] == [*range(20)]  # the plant accepts no other command
    assert result[-1].u[0] < result[0].u[0]  # the vehicle sinks
    message = FlightRows.unpack(watchdog_test.bus.latest("fallback.flight").data).rows
    np.testing.assert_array_equal(message[:, 0], [0])
    np.testing.assert_array_equal(message[0, COMMAND], result[0].u)


def test_watchdog_commands_if_control_never_reported():
    watchdog_test, result = WatchdogTest(), []
    for k in range(20):
        watchdog_test.bus.publish("sample", sample(k, k * DT).pack())
        result.append(watchdog_test.watchdog.check(k * DT, control_ended=True))
    assert sum(each is not None for each in result) >= 18


def test_watchdog_lands_and_ends():
    watchdog_test = WatchdogTest()
    x, acting, modes = level((0.0, 0.0, 0.6)), np.array([G, 0.0, 0.0, 0.0]), []
    for k in range(400):
        watchdog_test.bus.publish("sample", sample(k, k * DT, x).pack())
        result = watchdog_test.watchdog.check(k * DT, control_ended=True)
        if watchdog_test.watchdog.done:
            break
        u = acting if result is None else result.u
        x, acting = move(x, acting), u
        modes.append(x[2])
    assert watchdog_test.watchdog.done
    assert 0.0 < x[2] < 0.15


def rows(first, n, mode=Mode.POLICY, step=1e-3):
    setup = np.zeros((n, len(COLUMNS)))
    setup[:, 0], setup[:, ACCOUNTS["step"]] = np.arange(first, first + n), step
    setup[:, -1] = mode
    return FlightRows(setup).pack()


def test_recorder_fills_gaps_from_reports_and_continues_after_kill(tmp_path):
    bus, path = InProcessBus(TOPICS), tmp_path / "flight.csv"
    recorder = Recorder(path, bus)
    bus.publish("flight", rows(0, 10))
    assert recorder.step() == 10
    assert recorder.step() == 0
    bus.publish("flight", rows(5, 20))
    assert recorder.step() == 15
    with path.open("a") as file:
        file.write("25,0.5,0")  # incomplete
    again = Recorder(path, bus)
    bus.publish("flight", rows(10, 30))
    assert again.step() == 15
    np.testing.assert_array_equal(read_log(path)[:, 0], np.arange(40))


def test_watchdog_flight_is_recorded_without_gap(tmp_path):
    watchdog_test = WatchdogTest()
    recorder = Recorder(tmp_path / "flight.csv", watchdog_test.bus)
    for k in range(30):
        now = k * DT
        watchdog_test.bus.publish("sample", sample(k, now).pack())
        if k < 10:  # control reports one tick late, and dies
            watchdog_test.report(k, now)
            watchdog_test.bus.publish("flight", rows(0, k)) if k else None
        watchdog_test.watchdog.check(now, control_ended=k >= 10)
    recorder.step()
    result = read_log(tmp_path / "flight.csv")
    np.testing.assert_array_equal(result[:, 0], np.arange(30))
    np.testing.assert_allclose(result[:, 1][10:], DT * np.arange(10, 30))
    assert (result[:10, -1] == Mode.POLICY).all()
    assert (result[10:, -1] == Mode.WATCHDOG).all()


def test_late_reports_of_control_are_recorded(tmp_path):
    bus, path = InProcessBus(TOPICS), tmp_path / "flight.csv"
    recorder = Recorder(path, bus)
    bus.publish("flight", rows(0, 2))
    # control was late, and the watchdog missed two ticks
    bus.publish("fallback.flight", rows(4, 3, Mode.WATCHDOG, 0.0))
    assert recorder.step() == 5
    bus.publish("flight", rows(0, 5))
    assert recorder.step() == 3
    assert Recorder(path, bus).step() == 0
    result = read_log(path)
    np.testing.assert_array_equal(result[:, 0], np.arange(7))
    np.testing.assert_array_equal(result[:, -1], [Mode.POLICY] * 4 + [Mode.WATCHDOG] * 3)


@pytest.mark.parametrize("first", ["flight", "fallback.flight"])
def test_log_has_delay_of_hang_and_active_controller(tmp_path, first):
    bus, path = InProcessBus(TOPICS), tmp_path / "flight.csv"
    own, observation = (FlightRows.unpack(rows(0, n, step=step)).rows for n, step in ((4, 1e-3), (6, 0.0)))
    own[3, [ACCOUNTS["step"], ACCOUNTS["policy_age"]]] = 0.06, 2.0  # control hung in its fourth tick
    observation[3:, -1] = Mode.WATCHDOG
    message = {"flight": own, "fallback.flight": observation}
    for topic in sorted(message, key=lambda topic: topic != first):
        bus.publish(topic, FlightRows(message[topic]).pack())
        assert Recorder(path, bus).step()
    assert Recorder(path, bus).step() == 0
    result = read_log(path)
    np.testing.assert_array_equal(result[:, 0], np.arange(6))
    np.testing.assert_array_equal(result[:, -1], [Mode.POLICY] * 3 + [Mode.WATCHDOG] * 3)
    np.testing.assert_allclose(result[:, ACCOUNTS["step"]], [1e-3, 1e-3, 1e-3, 0.06, 0.0, 0.0])
    assert result[3, ACCOUNTS["policy_age"]] == 2.0
    np.testing.assert_array_equal(is_from_control(result), [True] * 4 + [False] * 2)


def test_reports_just_after_end_are_recorded(tmp_path):
    bus = SharedMemoryBus.create(TOPICS | {"ready.recorder": 4096})
    try:
        bus.publish("ended", pack_note("ended", reason="crashed"))
        plan = RecorderPlan(bus.folder, tmp_path / "flight.csv", 0.1, os.getpid())
        thread = threading.Thread(target=record, args=(plan,))
        thread.start()
        while bus.latest("ready.recorder") is None:
            time.sleep(1e-3)
        time.sleep(plan.dt)
        bus.publish("flight", rows(0, 3))
        thread.join(20.0)
    finally:
        bus.remove()
    np.testing.assert_array_equal(read_log(tmp_path / "flight.csv")[:, 0], np.arange(3))


def test_unwritable_log_ends_only_log(tmp_path):
    bus = InProcessBus(TOPICS | {"ready.recorder": 4096})
    (tmp_path / "file").touch()
    recorder = Recorder(tmp_path / "file" / "flight.csv", bus)
    assert recorder.failed == f"{tmp_path}/file/flight.csv: Not a directory"
    bus.publish("flight", rows(0, 3))
    assert recorder.step() == 0


def remove(folder):
    shutil.rmtree(folder)


def rename(folder):
    folder.rename(folder.with_name("renamed"))


def replace_fields(folder):
    shutil.rmtree(folder)
    folder.write_text("a file of the same name")


@pytest.mark.parametrize("change", [remove, rename, replace_fields])
def test_log_of_lost_folder_continues_in_other_folder(tmp_path, change):
    bus, folder, spare = InProcessBus(TOPICS | {"ready.recorder": 4096}), tmp_path / "out", tmp_path / "spare"
    path = folder / "flight.csv"
    recorder = Recorder(path, bus, (spare,))
    bus.publish("flight", rows(0, 10))
    assert recorder.step() == 10
    change(folder)
    bus.publish("flight", rows(5, 20))
    assert recorder.step() == 15
    result = log_path(path, (spare,))
    assert result == (spare / "flight.csv" if change is replace_fields else path)
    assert last_note(bus, "ready.recorder", "ready")["moved"].startswith(f"{path}: ")
    bus.publish("flight", rows(10, 30))  # of a restarted recorder
    assert Recorder(path, bus, (spare,)).step() == 15
    np.testing.assert_array_equal(read_log(result)[:, 0], np.arange(40))


def test_log_on_full_disk_continues_in_first_temporary_folder_with_space(tmp_path, monkeypatch):
    bus, spare = InProcessBus(TOPICS | {"ready.recorder": 4096}), (tmp_path / "full", tmp_path / "spare")
    path, write = tmp_path / "out" / "flight.csv", os.write
    recorder = Recorder(path, bus, spare)
    bus.publish("flight", rows(0, 10))
    recorder.step()

    def full(file, data):
        if "spare" in os.readlink(f"/proc/self/fd/{file}"):
            return write(file, data)
        if len(data) > 1:
            return write(file, data[: len(data) // 2])  # the rows that fit are written
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    bus.publish("flight", rows(5, 20))
    assert recorder.step() == 15
    np.testing.assert_array_equal(read_log(path)[:, 0], np.arange(10))  # no incomplete lines
    np.testing.assert_array_equal(read_log(log_path(path, spare))[:, 0], np.arange(25))
    assert recorder.notice == f"{path}: No space left on device; the log continues in {tmp_path}/spare/flight.csv"


def test_lifeline_reports_immediately():
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    line = ParentWatch(process.pid)
    assert not line.has_ended()
    os.kill(process.pid, signal.SIGKILL)
    assert line.has_ended(5.0)
    process.wait()


def test_cores_are_distributed():
    assert cores_of("fly", {2, 3, 5}) == {2}
    assert cores_of("learn", {2, 3, 5}) == {3, 5}
    assert cores_of("fly", {4}) == cores_of("learn", {4}) == {4}


def test_statistics_equal_durations():
    result = summary(np.array([1e-4] * 98 + [3e-3, 0.2]))
    assert result["p50"] == pytest.approx(0.1)
    assert result["max"] == pytest.approx(200.0)
    assert sum(result["histogram"]) == 100
    assert result["histogram"][-1] == 1
    assert summary(np.array([]))["p99"] is None


# ---- modules


OWN = """
import calendar, numpy, pathlib
from retrim.cli import main

def write(place):
    pathlib.Path(place).write_text("\\n".join(module.__file__ for module in (calendar, numpy)))
"""


@pytest.mark.parametrize("appendix", [False, True])
def test_process_imports_from_current_folder_only_if_needed(tmp_path, monkeypatch, appendix):
    name = f"own_{os.getpid()}"
    (tmp_path / f"{name}.py").write_text(OWN)
    for shadow in ("calendar", "numpy", "json", "pickle", "retrim", "jax"):
        (tmp_path / f"{shadow}.py").write_text(f"open({str(tmp_path / 'mark')!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", str(tmp_path), *sys.path] if appendix else sys.path)
    launch_code = launch(f"{name}:write", str(tmp_path / "done"), tmp_path / "log")
    assert (launch_code.wait(60) == 0) == appendix
    assert not (tmp_path / "mark").exists()
    if appendix:
        result = (tmp_path / "done").read_text().splitlines()
        assert len(result) == 2
        assert not any(str(tmp_path) in each for each in result)
    else:
        assert f"No module named '{name}'" in (tmp_path / "log").read_text()
