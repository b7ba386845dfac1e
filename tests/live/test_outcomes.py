"""Flights that lose their terminal, folder or supervisor save and report the learned state.

`make drill` repeats each flight with several times of the fault.
"""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from commands import SMALL, results, retrim, start_process
from retrim import load_learner_state, load_policy
from retrim.onboard.guard import Mode
from retrim.onboard.messages import TRUE
from retrim.onboard.recorder import read_log
from retrim.onboard.timing_stats import has_measurement
from retrim.transport.shared_memory import SharedMemoryBus

pytestmark = [pytest.mark.usefixtures("as_a_user"), pytest.mark.slow]
DRILLS = range(int(os.environ.get("RETRIM_DRILLS", "1")))
SECONDS = 7.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory, as_a_user):
    """Return a folder with a small policy in p/."""
    here = tmp_path_factory.mktemp("user")
    (here / "small.toml").write_text(
        SMALL.replace("num_updates = 150", "num_updates = 150\nnum_envs = 8\nhorizon = 60")
    )
    retrim("pretrain", "hover", "--config", "small.toml", "--out", "p", cwd=here)
    return here


def processes_of(supervisor):
    """Return the process numbers of a flight with the name of the function that each process runs."""
    result = {}
    for pid in Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text().split():
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        result[int(pid)] = words[-2].decode().rpartition(":")[2]
    return result


def bus_of(process):
    """Return the folder of the bus that a process has mapped."""
    maps = re.findall(r"(/dev/shm/retrim-\w+)/sample$", Path(f"/proc/{process}/maps").read_text(), re.M)
    return sorted(set(maps))


def wait_for(condition, seconds=120.0):
    until = time.monotonic() + seconds
    while not condition() and time.monotonic() < until:
        time.sleep(0.02)
    assert condition()


def fly_once(folder, out, act, seed, page=("--no-page",), seconds=SECONDS):
    """Fly, and act after the first policy update; return exit code and output."""
    words = "live", "--policy", "p", "--disturbance", "small", "--seconds", seconds, *page, "--out", out
    process, log = start_process(words, folder), folder / out / "flight.csv"
    at = 50.0 * np.random.default_rng(seed).uniform(3.0, SECONDS - 2.0)  # ticks
    wait_for(lambda: process.poll() is not None or (log.exists() and log.read_text().count("\n") > at))
    act(process)
    message, _ = process.communicate(timeout=120)
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", message.decode())
    assert "Traceback" not in text, text
    return process.returncode, text


def read_whole_log(path):
    """Return a log after asserting that it contains the flight and its landing."""
    rows = read_log(path)
    assert rows[0, 0] == 0
    assert np.diff(rows[:, 0]).max() < 25
    assert rows[-1, -1] == Mode.LANDED
    return rows


def check_saved_state(folder):
    """Assert that the learner state can be loaded and contains the adapted policy."""
    state, _ = load_learner_state(folder / "learner_state.safetensors")
    adapted_policy, _ = load_policy(folder / "adapted.safetensors")
    np.testing.assert_array_equal(adapted_policy.layers[0].weight, state.policy.policy.layers[0].weight)


@pytest.mark.parametrize("seed", DRILLS)
def test_hung_processes_are_restarted_and_log_is_complete(folder, seed):
    out, roles = f"suspended{seed}", {"record": "recorder", "show": "page", "watch": "watchdog"}

    def suspend(process):
        for pid, function in processes_of(process.pid).items():
            if function in (*roles, "learn"):
                os.kill(pid, signal.SIGSTOP)

    code, text = fly_once(folder, out, suspend, seed, ("--page", "--page-port", "18380"), seconds=14.0)
    result = results(folder / out)
    assert (code, result["ended"], result["faults"]) == (0, "landed", []), text
    for role in (*roles.values(), "residual", "policy"):
        assert f"restarted: the {role} process hung: it said nothing for 2 s and was ended" in text
    assert {row["metric"]: row["value"] for row in result["rows"]}["restarts"] == 5
    assert len(read_whole_log(folder / out / "flight.csv")) > 50 * 14.0 - 25
    check_saved_state(folder / out)


@pytest.mark.parametrize("seed", DRILLS)
@pytest.mark.parametrize("role", ["plant", "control"])
def test_hung_plant_or_control_ends_flight_in_defined_way(folder, role, seed):
    out, function = f"{role}{seed}", {"plant": "simulate", "control": "fly"}[role]

    def suspend(process):
        (pid,) = (pid for pid, name in processes_of(process.pid).items() if name == function)
        os.kill(pid, signal.SIGSTOP)

    code, text = fly_once(folder, out, suspend, seed)
    result, rows = results(folder / out), read_log(folder / out / "flight.csv")
    steady = next(row for row in result["rows"] if row["metric"] == "steady")
    assert result["faults"] == []
    assert f"guard: the {role} process hung: it said nothing for 2 s and was ended" in text
    check_saved_state(folder / out)
    if role == "plant":
        height = rows[has_measurement(rows)][-1, TRUE][2]
        assert result["ended"].startswith(f"stopped without measurements at {height:.2f} m: the plant process hung")
        assert (code, steady["crashes"], steady["value"]) == (1, 1, None)
        assert np.isin(rows[~has_measurement(rows), -1], (Mode.BLIND, Mode.DROP)).all()
    else:
        assert (code, result["ended"], steady["crashes"]) == (0, "landed", 0)
        assert rows[-1, -1] == Mode.WATCHDOG


@pytest.mark.parametrize("seed", DRILLS)
def test_closed_terminal_lands_vehicle_and_results_are_written(folder, seed):
    out = f"hangup{seed}"
    code, _ = fly_once(folder, out, lambda process: process.send_signal(signal.SIGHUP), seed)
    result = results(folder / out)
    assert (code, result["interrupted"], result["ended"], result["faults"]) == (130, True, "landed", [])
    assert result["seconds"] < SECONDS - 0.5
    read_whole_log(folder / out / "flight.csv")
    check_saved_state(folder / out)


@pytest.mark.parametrize("seed", DRILLS)
@pytest.mark.parametrize("how", ["removed", "renamed"])
def test_lost_folder_is_created_again_with_log_and_learner_state(folder, how, seed):
    out = folder / f"{how}{seed}"
    loss = (lambda: shutil.rmtree(out)) if how == "removed" else (lambda: out.rename(f"{out}-elsewhere"))
    code, text = fly_once(folder, out.name, lambda process: loss(), seed)
    assert code == 0, text
    assert f"log: {out.name}/flight.csv: No such file or directory; the log is written again" in text
    result = results(out)
    assert (result["ended"], result["faults"]) == ("landed", [])
    assert len(read_whole_log(out / "flight.csv")) > 50 * SECONDS - 25
    check_saved_state(out)


def find_saved_file(text, name, reason):
    """Return the temporary folder of a file that the output names."""
    line = rf"retrim: {re.escape(name)} cannot be written to \S+ \({reason}\); it is in (\S+)"
    return Path(re.search(line, text)[1])


@pytest.mark.parametrize("seed", DRILLS)
def test_results_are_saved_elsewhere_if_file_replaces_folder(folder, seed):
    out = folder / f"replaced{seed}"

    def replace(process):
        shutil.rmtree(out)
        out.write_text("a foreign file")

    code, text = fly_once(folder, out.name, replace, seed)
    assert code == 1, text
    place = find_saved_file(text, "the learner state", "File exists")
    result = results(find_saved_file(text, "results.json", "File exists"))
    assert result["ended"] == "landed"
    assert any(fault.startswith(f"{out.name}/flight.csv: ") for fault in result["faults"])
    assert len(read_whole_log(place / "flight.csv")) > 50 * SECONDS - 25
    check_saved_state(place)
    shutil.rmtree(place)


@pytest.fixture
def small_disk(folder, tmp_path):
    """Return a folder on a small disk, which the log of a few seconds fills."""
    disk = folder / tmp_path.name
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=260k", "none", disk], check=False).returncode:
        pytest.skip("a test of a full disk needs the right to mount a file system")
    yield disk
    subprocess.run(["umount", "--lazy", disk], check=True)


@pytest.mark.parametrize("seed", DRILLS)
def test_results_are_saved_elsewhere_if_disk_is_full(folder, small_disk, seed):
    full = "No space left on device"
    code, text = fly_once(folder, small_disk.name, lambda process: fill(small_disk), seed)
    assert code == 1, text
    place = find_saved_file(text, "the learner state", full)
    assert f"retrim: {small_disk.name}/flight.csv: {full}; the log continues in {place}/flight.csv" in text
    result = results(find_saved_file(text, "results.json", full))
    assert result["ended"] == "landed"
    assert len(result["faults"]) >= 4
    assert len(read_whole_log(place / "flight.csv")) > 50 * SECONDS - 25
    check_saved_state(place)
    shutil.rmtree(place)


def fill(disk):
    with (disk / "filler").open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(bytes(1024)):
            pass


@pytest.mark.parametrize("seed", DRILLS)
def test_learner_state_survives_loss_of_supervisor_and_recorder(folder, seed):
    out, flight, bus = folder / f"alone{seed}", {}, []

    def kill(process):
        bus.extend(bus_of(process.pid))
        flight.update(processes_of(process.pid))
        os.kill(process.pid, signal.SIGKILL)
        (recorder,) = (pid for pid, function in flight.items() if function == "record")
        os.kill(recorder, signal.SIGKILL)

    code, _ = fly_once(folder, out.name, kill, seed)
    assert code == -signal.SIGKILL
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in flight))
    check_saved_state(out)
    assert not (out / "results.json").exists()
    bus_folder = Path(bus[0])
    assert bus_folder.exists()
    SharedMemoryBus.create({}).remove()  # the next flight removes it
    assert not bus_folder.exists()
