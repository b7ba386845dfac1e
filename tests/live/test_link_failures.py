"""Flights for each row of the table of failures: the tests observe a peer while processes or links fail.

The tests assert the first words of the cells for retrim and the vehicle, and the numbers of seconds.
"""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest

from failure_rigs import HOME, Rig, add_roles, fly, kill_all, spec_of, start_supervised_flight
from helpers import tiny_preset
from retrim import Scenario
from retrim.config.setup import Setup
from retrim.export.c_header import write_c
from retrim.export.checking import FLAGS
from retrim.export.portable import portable_of
from retrim.onboard.guard import Mode
from retrim.onboard.recorder import read_log
from retrim.plants.bridges.betaflight_firmware import RUN_WITH_PARENT

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "failures.md"
PORT = 24610
AUTOPILOTS, PILOTED = ("mavlink", "ros2:px4"), ("ros2:mavros", "ros")
LINKS = (*AUTOPILOTS, *PILOTED, "crazyflie")
LATE_S = 0.8  # [s], since the peer, the flight and other programs share the cores
MODES = {Mode.BLIND, Mode.HOLD, Mode.DESCEND, Mode.LANDED, Mode.WATCHDOG}  # WATCHDOG if control was late


class Row(NamedTuple):
    """A row of the table."""

    retrim: str
    vehicle: str
    after: float
    """Time from the failure to the vehicle's reaction [s]."""
    test: str


def read_page():
    rows = {}
    for line in PAGE.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 6 and re.fullmatch(r"[\d.]+", cells[4]):
            link, failure, retrim, vehicle, after, test = cells
            for name in re.findall(r"`([^`]+)`", link) or [link]:
                assert (name, failure) not in rows
                rows[name, failure] = Row(retrim, vehicle, float(after), test.strip("`"))
    return rows


ROWS = read_page()
CHECKED: dict[tuple[str, str], str] = {}


def check_rows(failures, links, *, fly_by=None):
    """Record the rows that a test checks, and run it with some of their links; links in one cell share code."""

    def mark(function):
        CHECKED.update({(link, failure): function.__name__ for link in links for failure in failures})
        if fly_by == ():
            return pytest.mark.slow(function)
        return pytest.mark.slow(pytest.mark.parametrize("rig", fly_by or links, indirect=True)(function))

    return mark


def test_rows_of_page_correspond_to_tests():
    assert {key: row.test for key, row in ROWS.items()} == CHECKED


# ---- peers


def mavlink_rig(port=PORT):
    pytest.importorskip("pymavlink")
    from retrim.testing.mavlink_peer import HOLD, MavlinkPeer

    def reset(peer):
        peer.mode, peer.armed, peer.failsafes, peer._rates = HOLD, True, 0, None
        peer._place, peer._yaw = HOME, 0.0

    return Rig(MavlinkPeer(Scenario(plant="simple"), port=port), f"mavlink:udp:127.0.0.1:{port}", reset)


def crazyflie_rig():
    from retrim.testing.crazyflie_peer import CrazyfliePeer

    def reset(peer):
        peer.armed, peer.locked, peer._lands = True, False, False
        peer._setpoint, peer._place, peer._yaw = None, HOME, 0.0

    return Rig(CrazyfliePeer(Scenario(plant="simple"), port=PORT + 1), f"crazyflie:udp:127.0.0.1:{PORT + 1}", reset)


def wait_for_pilot(peer):
    peer._place, peer._yaw, peer._target_time, peer._last_command_time = HOME, 0.0, -np.inf, -np.inf


def ros2_rig(dialect):
    pytest.importorskip("cyclonedds")
    from retrim.ros2.backends import open_node
    from retrim.testing import ros2_px4_peer
    from retrim.testing.ros2_peer import make_peer, parse

    def reset(peer):
        peer.mode, peer.armed, peer._rates, peer._place, peer._yaw = ros2_px4_peer.HOLD, True, None, HOME, 0.0

    peer = make_peer(open_node("cyclonedds", ()), parse([dialect, "--plant", "simple"]))
    return Rig(peer, f"ros2:cyclonedds:{dialect}", reset if dialect == "px4" else wait_for_pilot)


@contextlib.contextmanager
def ros1_rig():
    from retrim_paper.latency import rosmaster

    with rosmaster() as address:
        if address is None:
            pytest.skip("needs rosmaster and rospy: make test-ros installs them")
        from retrim.ros1.peer import RosPeer

        master = f"{address.host}:{address.port}"
        peer = RosPeer(f"http://{master}", Scenario(plant="simple"), place=HOME, yaw=0.0)
        yield Rig(peer, f"ros:{master}", wait_for_pilot)


@pytest.fixture(scope="module")
def rig(request):
    with pytest.MonkeyPatch.context() as patch, contextlib.ExitStack() as stack:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("ROS_DOMAIN_ID", str(20 + os.getpid() % 60))
        dialect = request.param.removeprefix("ros2:")
        if request.param == "ros":
            result = stack.enter_context(ros1_rig())
        else:
            result = {"mavlink": mavlink_rig, "crazyflie": crazyflie_rig}.get(dialect, lambda: ros2_rig(dialect))()
        result.name = request.param
        yield result
        result.close()


# ---- reactions of the vehicle, by the words on the page


def check_flight_continues(views, row, fault):
    assert all(view.follows for view in views)
    assert max(np.linalg.norm(view.p - HOME) for view in views) < 0.4


def check_hold(views, row, fault):
    """The vehicle does not follow commands, and remains near its position at that time."""
    last = max(view.at for view in views if view.follows)
    assert row.after - 0.3 < last - fault < row.after + LATE_S
    rest = [view for view in views if view.at > last + 1.5]
    assert all(view.flies for view in rest)
    assert np.linalg.norm(rest[-1].p - HOME) < 1.0
    assert np.linalg.norm(rest[-1].v) < 0.3


def check_landing(views, row, fault):
    assert views[-1].p[2] < 0.25
    assert max(np.linalg.norm(view.p[:2]) for view in views) < 0.6
    assert min(view.v[2] for view in views) > -2.0  # a fall from the initial height would end with 4 m/s


def check_fall(views, row, fault):
    off = next(view.at for view in views if not view.thrust)
    assert row.after - 0.1 < off - fault < row.after + LATE_S
    assert not any(view.flies for view in views if view.at > off + 1.0)


def check_level_descent(views, row, fault):
    """The vehicle is level and sinks, regardless of its motion before."""
    late = [view for view in views if view.at > fault + row.after + 1.2]
    assert min(view.upright for view in late) > np.cos(0.15)
    assert late[-1].v[2] < late[0].v[2] < 0.1
    assert np.linalg.norm(late[-1].p[:2] - views[0].p[:2]) < 1.5 * (late[-1].at - views[0].at)


REACTIONS = {
    "flies on": check_flight_continues,
    "holds its position": check_hold,
    "lands": check_landing,
    "falls": check_fall,
    "sinks": check_level_descent,
}
END_REASONS = {"restarts it": "", "lands the vehicle": "landed", "ends the flight": "plant", "is dead": "", "exits": ""}
"""First words of the cell for retrim, and first words of the reason for the end of the flight."""


def find_by_prefix(words, cell):
    (result,) = [value for word, value in words.items() if cell.strip("*").startswith(word)]
    return result


def check(rig, key, fault):
    views = rig.since(fault)
    for view in views[::20]:  # pytest shows it if the check fails
        print(f"{view.at - fault:5.2f} s {view.p.round(2)} m {view.v.round(2)} m/s {view.follows} {view.thrust:.2f}")
    find_by_prefix(REACTIONS, ROWS[key].vehicle)(views, ROWS[key], fault)


def check_end(key, reason):
    """Compare the end of the flight with the cell for retrim."""
    expected = find_by_prefix(END_REASONS, ROWS[key].retrim)
    assert (reason or "") == expected or (expected != "landed" and (reason or "").startswith(expected))


def fly_until(flight, condition, seconds=15.0):
    """Continue a flight until a condition is true."""
    until = time.monotonic() + seconds
    for step in flight:
        if condition(step):
            return step
        assert time.monotonic() < until
    return None


def start_flight(rig, folder, layers=()):
    """Start a flight, and return it and its steps after 0.7 s."""
    steps = fly(spec_of(rig, folder, layers), rig)
    return fly_until(steps, lambda flight: flight.status.t > 0.7, 120.0), steps


# ---- processes

RESTARTED = {"watchdog": "watchdog", "recorder": "recorder", "a learner": "policy", "identifier": "identifier",
             "page": "page"}  # fmt: skip


@check_rows([f"{name} killed" for name in (*RESTARTED, "control")], ["every link"], fly_by=["mavlink"])
def test_processes_are_killed_in_turn(rig, tmp_path):
    with add_roles():
        flight, steps = start_flight(rig, tmp_path, ("residual", "policy"))
        for name, role in RESTARTED.items():
            fault = time.monotonic()
            os.kill(flight.processes[role].pid, signal.SIGKILL)
            fly_until(steps, lambda flight, role=role: flight.status.restarts.get(role) == 1)
            check(rig, ("every link", f"{name} killed"), fault)
            check_end(("every link", f"{name} killed"), flight.status.end_reason)
        fly_until(steps, lambda flight: flight.bus.latest("ready.watchdog").version == 2)
        key, fault = ("every link", "control killed"), time.monotonic()
        os.kill(flight.processes["control"].pid, signal.SIGKILL)
        killed_t = fault - flight.epoch
        fly_until(steps, lambda flight: False, 30.0)
    rows = read_log(tmp_path / "flight.csv")
    check_end(key, flight.status.end_reason)
    assert rows[-1, -1] == Mode.WATCHDOG
    first = rows[(rows[:, -1] == Mode.WATCHDOG) & (rows[:, 1] > killed_t - 0.1)][0, 1]
    assert first - killed_t < ROWS[key].after + LATE_S
    rig.settle(0.5)  # the autopilot's part of the landing
    check(rig, key, fault)


@check_rows(["supervisor killed"], ["every link"], fly_by=["ros2:mavros"])
def test_supervisor_is_killed(rig, tmp_path):
    key = "every link", "supervisor killed"
    with start_supervised_flight(spec_of(rig, tmp_path), rig) as processes:
        before, fault = read_log(tmp_path / "flight.csv")[-1, 1], time.monotonic()
        os.kill(processes["supervise"], signal.SIGKILL)
        ends = [Path(f"/proc/{processes[name]}") for name in ("control_process:fly", "recorder:record")]
        while any(end.exists() for end in ends) and time.monotonic() < fault + 20.0:
            time.sleep(0.05)
        rig.settle(0.5)
    rows = read_log(tmp_path / "flight.csv")
    check_end(key, "landed" if rows[-1, -1] == Mode.LANDED else "")
    assert rows[rows[:, -1] == Mode.DESCEND][0, 1] - before < ROWS[key].after + LATE_S
    check(rig, key, fault)


@check_rows(["link process killed"], LINKS, fly_by=["mavlink", "ros2:mavros", "crazyflie"])
def test_link_process_is_killed(rig, tmp_path):
    key = rig.name, "link process killed"
    flight, steps = start_flight(rig, tmp_path)
    fault = time.monotonic()
    os.kill(flight.processes["plant"].pid, signal.SIGKILL)
    fly_until(steps, lambda flight: False)
    check_end(key, flight.status.end_reason.removeprefix("the "))
    assert len(read_log(tmp_path / "flight.csv")) > 20
    rig.settle(ROWS[key].after + 2.5)
    check(rig, key, fault)


@check_rows(["all processes killed"], LINKS, fly_by=["mavlink", "ros2:px4", "ros2:mavros", "crazyflie"])
def test_all_processes_are_killed(rig, tmp_path):
    key = rig.name, "all processes killed"
    with start_supervised_flight(spec_of(rig, tmp_path), rig) as processes:
        assert len(processes) >= 5
        fault = time.monotonic()
        kill_all(processes)
        rig.settle(ROWS[key].after + 2.5)
        check(rig, key, fault)


@check_rows(["all processes killed, last target held"], PILOTED)
def test_all_processes_are_killed_before_stack_that_holds_last_target(rig, tmp_path):
    """The vehicle has just been pushed, so the last target contains body rates."""
    key = rig.name, "all processes killed, last target held"
    before, rig.peer.fresh = rig.peer.fresh, np.inf
    try:
        with start_supervised_flight(spec_of(rig, tmp_path), rig) as processes:
            rig.kick([1.0, 0.0, 0.0])
            time.sleep(0.08)
            fault = time.monotonic()
            kill_all(processes)
            wait_until(fault + 2.5)
            check(rig, key, fault)
    finally:
        rig.peer.fresh = before


# ---- cables and networks


def cut_for(rig, seconds):
    """Cut the link in both directions, and return the time of the cut."""
    fault = time.monotonic()
    rig.peer.cut = True
    wait_until(fault + seconds)
    rig.peer.cut = False
    return fault


@check_rows(["cut for 0.3 s", "cut for 1 s"], LINKS, fly_by=["mavlink", "ros2:mavros", "crazyflie"])
def test_link_is_cut_twice_for_short_times(rig, tmp_path):
    flight, steps = start_flight(rig, tmp_path)
    cuts = []
    for seconds in (0.3, 1.0):  # the second cut begins while the guard holds the vehicle after the first one
        cuts.append(time.monotonic())
        rig.peer.cut = True
        fly_until(steps, lambda flight: time.monotonic() > cuts[-1] + seconds)  # noqa: B023
        rig.peer.cut = False
        fly_until(steps, lambda flight: time.monotonic() > cuts[-1] + seconds + 0.5)  # noqa: B023
    fly_until(steps, lambda flight: False, 30.0)
    rows = read_log(tmp_path / "flight.csv")
    rig.settle(0.5)
    for fault, seconds in zip(cuts, (0.3, 1.0), strict=True):
        key = rig.name, f"cut for {seconds:g} s"
        t = fault - flight.epoch
        blind = rows[(rows[:, -1] == Mode.BLIND) & (rows[:, 1] > t)]
        assert blind[0, 1] - t < ROWS[key].after + LATE_S
        assert set(rows[rows[:, 1] > blind[0, 1], -1]) <= MODES
        check_end(key, flight.status.end_reason)
        check(rig, key, fault)


@check_rows(["cut for 5 s", "cut for ever"], LINKS, fly_by=["ros2:px4", "ros", "crazyflie"])
def test_link_is_cut_for_long_time(rig, tmp_path):
    """After 5 s the state of the vehicle is final; a restored link does not change it."""
    flight, steps = start_flight(rig, tmp_path)
    fault = time.monotonic()
    rig.peer.cut = True
    fly_until(steps, lambda flight: False, 30.0)
    wait_until(fault + 5.0)
    check(rig, (rig.name, "cut for ever"), fault)
    rig.peer.cut = False
    wait_until(fault + 6.5)
    check(rig, (rig.name, "cut for 5 s"), fault)
    for failure in ("cut for 5 s", "cut for ever"):
        check_end((rig.name, failure), flight.status.end_reason)
    assert read_log(tmp_path / "flight.csv")[-1, 1] < fault - flight.epoch + 4.0


def wait_until(instant):
    time.sleep(max(0.0, instant - time.monotonic()))


# ---- programs without `retrim live`


@pytest.fixture(scope="module")
def companion(tmp_path_factory):
    """Return a peer and the companion program in C with a hover policy."""
    if shutil.which("gcc") is None:
        pytest.skip("there is no C compiler")
    folder = tmp_path_factory.mktemp("companion")
    setup = Setup.from_preset(tiny_preset(pretrain={"hidden_sizes": (64, 64), "num_updates": 150}))
    with jax.numpy_dtype_promotion("standard"):  # optax multiplies Python floats by integer counters
        write_c(folder / "policy.h", portable_of(setup.pretrained(), setup))
    shutil.copy(PAGE.parents[2] / "examples" / "companion.c", folder)
    subprocess.run(["gcc", *FLAGS, "companion.c", "-o", "companion", "-lm"], cwd=folder, check=True)
    result = mavlink_rig(port=PORT + 2)
    result.program = folder / "companion"
    yield result
    result.close()


@contextlib.contextmanager
def fly_companion(rig):
    rig.hover()
    share = 9.81 / rig.peer.vehicle.thrust_max
    process = subprocess.Popen([rig.program, str(PORT + 2), f"{share:.6f}"], stdout=subprocess.DEVNULL)
    try:
        wait_until(time.monotonic() + 1.5)
        with rig.lock:
            rig.peer.mode = (6, 0)  # the pilot selects offboard mode
        wait_until(time.monotonic() + 0.7)
        assert rig.peer.by_rates
        yield process
    finally:
        process.kill()
        process.wait()


@check_rows(["all processes killed"], ["companion.c"], fly_by=())
def test_companion_computer_is_killed(companion):
    with fly_companion(companion) as process:
        fault = time.monotonic()
        process.kill()
        companion.settle(3.5)
        check(companion, ("companion.c", "all processes killed"), fault)


@check_rows([f"cut for {time}" for time in ("0.3 s", "1 s", "5 s", "ever")], ["companion.c"], fly_by=())
def test_link_of_companion_computer_is_cut(companion):
    for seconds in (0.3, 1.0, 5.0):
        key = "companion.c", f"cut for {seconds:g} s"
        with fly_companion(companion) as process:
            fault = cut_for(companion, seconds)
            assert process.wait(LATE_S) == 3
            check_end(key, "")
            companion.settle(fault + 3.5 - time.monotonic())
            check(companion, key, fault)
    # the vehicle was in this state before the link was restored
    check(companion, ("companion.c", "cut for ever"), fault)


@check_rows(["link process killed", "all processes killed"], ["betaflight"], fly_by=())
def test_simulated_board_ends_with_link_process():
    """A program replaces the board; the kernel kills it."""
    words = f"[sys.executable, '-c', {RUN_WITH_PARENT!r}, '/bin/sleep', '60']"
    code = f"import subprocess, sys, time; print(subprocess.Popen({words}).pid, flush=True); time.sleep(60)"
    link = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    board = Path(f"/proc/{int(link.stdout.readline())}")
    time.sleep(0.5)
    assert board.exists()
    link.kill()
    link.communicate()
    for failure in ("link process killed", "all processes killed"):
        row = ROWS["betaflight", failure]
        assert row.vehicle.startswith("ends")
        until = time.monotonic() + row.after + LATE_S
        while is_running(board) and time.monotonic() < until:
            time.sleep(0.01)
        assert not is_running(board)


def is_running(process):
    with contextlib.suppress(OSError):
        return (process / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False
