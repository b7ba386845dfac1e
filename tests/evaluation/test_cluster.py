"""Sweeps on a Dask scheduler give the same table as one process, despite killed workers and cut connections."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import tomllib
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import pytest

from commands import OVERLAY, retrim
from retrim import ConfigError, Fleet, Scenario, Setup, changed, load
from retrim.config import named_presets
from retrim.errors import JobError
from retrim.evaluation import cluster, jobs
from retrim.evaluation.cluster import Cluster
from retrim.evaluation.metrics import cell, failed_record, summary
from retrim.runkit import training
from retrim.runkit.flights import FlightSpec

distributed = pytest.importorskip("distributed")
pytestmark = [
    pytest.mark.usefixtures("as_a_user"),
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore:Port .* in use"),
]
SWEEP = (
    """
presets = ["hover/retrim"]
seeds = [0, 1]
methods = ["base", "full"]
disturbances = ["gusts"]
starts = {starts}
seconds = 1.2
"""
    + OVERLAY
)


def small():
    """Return the preset of the sweep; all tests share its compiled programs."""
    return changed(load("hover/retrim"), **tomllib.loads(OVERLAY)["overlay"])


@pytest.fixture(scope="module")
def here(as_a_user):
    """Return the address of a scheduler with two workers, which are threads of this process."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, protocol="tcp://", dashboard_address=None, host="127.0.0.1"
    ) as result:
        yield result.scheduler_address


@pytest.fixture(scope="module")
def fleet(as_a_user):
    preset = small()
    policy = Setup.from_preset(preset).new_policy(jax.random.key(0))
    return Fleet(preset, policy, [Scenario("gusts")], starts=2, seconds=1.2)  # the programs of the sweep


def test_remote_flights_equal_local_flights(here, fleet):
    with Cluster(here) as there:
        assert there.workers == 2
        away = fleet.run(there, by_batch=True)
    assert away.rows() == fleet.run().rows()
    assert not away.failed


def test_failed_job_is_reported_and_others_finish(here, fleet, monkeypatch):
    fly = jobs.fly_batch

    def fail_job(setup, policies, specs, *rest, **more):
        if specs[0].method == "full":
            raise OSError("the disk\nis full")
        return fly(setup, policies, specs, *rest, **more)

    monkeypatch.setattr(jobs, "fly_batch", fail_job)
    monkeypatch.setattr("retrim.evaluation.batches.lanes", lambda: 1)
    with Cluster(here) as there:
        flights = fleet.run(there, by_batch=True)
    assert [flight.spec.method for flight in flights.flights] == ["base", "base"]
    assert {spec.method for spec in flights.failed} == {"full"}
    assert set(flights.failed.values()) == {"OSError: the disk is full"}
    assert flights.interrupted


def test_failed_flight_is_a_row_with_its_error():
    flight = {**failed_record(FlightSpec(Scenario(), "full", 0), "small", "m", ""), "error": 0.01, "failed": None}
    gap = failed_record(FlightSpec(Scenario(), "full", 1), "small", "m", "OSError: gone")
    row = summary([flight, gap])
    assert (row["n"], row["crashes"], row["failures"]) == (2, 0, ["OSError: gone"])
    assert (row["mean"], row["max"], row["median"]) == (0.01, 0.01, 0.01)
    assert cell(row) == "0.010, 1 of 2 failed"
    assert cell(summary([gap])) == "1 of 1 failed"


def test_incomplete_table_is_not_written(here, tmp_path, monkeypatch):
    def fail_job(*_, **__):
        raise OSError("the disk is full")

    monkeypatch.setattr(jobs, "fly_batch", fail_job)
    monkeypatch.setitem(named_presets.PRESETS, "hover/fast", small())
    words = "--presets", "hover/fast", "--methods", "base", "--seeds", "0", "--starts", "4", "--seconds", "1"
    text = retrim("reproduce", "hover", *words, "--on", here, "--out", "h", cwd=tmp_path, code=1)
    assert "flights failed in other processes, the first with OSError: the disk is full" in text


def test_failed_training_does_not_affect_others(here, tmp_path, monkeypatch):
    train = training.train

    def fail_job(setup, seed):
        if seed == 1:
            raise MemoryError("too large")
        return train(setup, seed)

    monkeypatch.setattr(training, "train", fail_job)
    (tmp_path / "study.toml").write_text(SWEEP.format(starts=1))
    text = retrim("sweep", "study.toml", "--on", here, "--out", "s", cwd=tmp_path, code=1)
    assert "1 of 2 trainings of hover/retrim failed: seed 1: too large" in text
    assert [path.stem[-5:] for path in (tmp_path / "s/policies").iterdir()] == ["seed0"]


def test_failed_flight_keeps_others_and_sets_exit_code(here, tmp_path, monkeypatch):
    fly = jobs.fly_batch

    def fail_job(setup, policies, specs, *rest, **more):
        if specs[0].method == "indi":
            raise OSError("gone")
        return fly(setup, policies, specs, *rest, **more)

    monkeypatch.setattr(jobs, "fly_batch", fail_job)
    monkeypatch.setattr("retrim.evaluation.batches.lanes", lambda: 1)
    (tmp_path / "study.toml").write_text(SWEEP.format(starts=1).replace('"full"', '"indi"'))
    text = retrim("sweep", "study.toml", "--on", here, "--out", "s", cwd=tmp_path, code=1)
    assert "2 flights failed in other processes, the first with OSError: gone; the same command flies them" in text
    base, indi = rows(tmp_path / "s")
    assert "failures" not in base
    assert (indi["n"], indi["failures"], indi["mean"]) == (2, ["OSError: gone"] * 2, None)
    monkeypatch.undo()
    retrim("sweep", "study.toml", "--on", here, "--out", "s", cwd=tmp_path)
    assert [row.get("failures") for row in rows(tmp_path / "s")] == [None, None]


def test_lost_scheduler_ends_sweep(here):
    there = Cluster(here)
    there.shutdown()
    with pytest.raises(JobError, match=r"no job can be given to the scheduler at tcp://"):
        there.submit(int).result()


def test_unpicklable_result_is_reported_and_cancelled_job_stays_cancelled(here):
    with Cluster(here) as there:
        with pytest.raises(ZeroDivisionError):
            there.submit(divmod, 1, 0).result(30)
        assert there.submit(divmod, 7, 2).result(30) == (3, 1)
        slow = there.submit(time.sleep, 0.5)
        assert slow.cancel()
        assert slow.cancelled()


@pytest.mark.parametrize(
    "address", ["127.0.0.1:8786", "tcp://127.0.0.1", "http://127.0.0.1:8786", "tcp://127.0.0.1:99999", "tls://:8786"]
)
def test_invalid_address_is_refused(address):
    with pytest.raises(ConfigError, match=r"expected tcp://HOST:PORT or tls://HOST:PORT of a Dask scheduler"):
        Cluster(address)


def test_missing_scheduler_is_reported():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(ConfigError, match=f"127.0.0.1:{port}: no scheduler responds there"):
        Cluster(f"tcp://127.0.0.1:{port}")


def test_different_versions_are_refused_before_first_job(here, monkeypatch):
    with pytest.raises(ConfigError, match=r"a worker has different versions: jax 0\.1, here"):
        cluster.check_alike({**cluster.ours(), "jax": "0.1"}, "a worker")
    with pytest.raises(ConfigError, match="who sent this job"):
        cluster.call({**cluster.ours(), "retrim": "9"}, int, (), {})
    monkeypatch.setattr(Cluster, "_check", lambda self: cluster.check_alike({}, "worker w"))
    with pytest.raises(ConfigError, match="worker w has different versions"):
        Cluster(here)


def test_remote_sweep_gives_same_table_and_repeats_failed_flights(here, tmp_path, monkeypatch):
    """The workers also train the policies."""
    (tmp_path / "study.toml").write_text(SWEEP.format(starts=1))
    text = retrim("sweep", "study.toml", "--on", here, "--out", "there", cwd=tmp_path)
    assert f"2 workers at {here}" in text
    retrim("sweep", "study.toml", "--out", "here", cwd=tmp_path)
    assert rows(tmp_path / "there") == rows(tmp_path / "here")
    records = [json.loads(line) for line in (tmp_path / "there/flights.jsonl").read_text().splitlines()]
    records[0] |= {"failed": "OSError: gone", "error": None}
    (tmp_path / "there/flights.jsonl").write_text("".join(json.dumps(row) + "\n" for row in records))
    retrim("sweep", "study.toml", "--on", here, "--out", "there", cwd=tmp_path)
    assert [row["n"] for row in rows(tmp_path / "there")] == [2] * 2
    assert not any("failures" in row for row in rows(tmp_path / "there"))


@pytest.mark.parametrize("gap", range(cluster.ATTEMPTS + 1))
def test_lost_job_is_resubmitted_a_limited_number_of_times(gap):
    """The result arrives unless the job is lost more often than the limit."""

    class LostFuture:
        def __init__(self, status):
            self.status = status

        def add_done_callback(self, over):
            over(self)

        def result(self):
            return "whole"

        def release(self):
            pass

    calls, outer = [], Future()

    def submit():
        calls.append("lost" if len(calls) < gap else "finished")
        return LostFuture(calls[-1])

    Cluster.__new__(Cluster)._start(outer, submit, cluster.ATTEMPTS)
    assert len(calls) == min(gap + 1, cluster.ATTEMPTS)
    if gap < cluster.ATTEMPTS:
        assert outer.result(0) == "whole"
    else:
        with pytest.raises(JobError, match=rf"lost {cluster.ATTEMPTS} times \(lost\)"):
            outer.result(0)


def test_table_grows_by_its_command(tmp_path, monkeypatch):
    monkeypatch.setitem(named_presets.PRESETS, "hover/fast", small())
    words = "--preset", "hover/fast", "--flights", "8", "16", "--seconds", "1"  # in pairs, like the sweeps
    text = retrim("reproduce", "scaling", *words, "--out", "s", cwd=tmp_path)
    whole = json.loads((tmp_path / "s" / "scaling.json").read_text())
    result = whole["rows"]
    assert whole["seeds"] == [0]
    assert [row["flights"] for row in result] == [8, 16]
    assert all(row["run_s"] > 0 and row["peak_mb"] > 50 for row in result)
    assert "flights a second" in text
    assert (tmp_path / "s" / "scaling.png").stat().st_size > 5000
    assert "(scaling.png)" in (tmp_path / "s" / "scaling.md").read_text()
    assert "--flights 6 must be a positive multiple of 4" in retrim(
        "reproduce", "scaling", "--flights", "6", cwd=tmp_path, code=1
    )


def rows(folder):
    return json.loads((folder / "sweep.json").read_text())["rows"]


class Wire:
    """A TCP connection to a scheduler that can be cut."""

    def __init__(self, port):
        self._to, self._pairs, self._open = port, [], True
        self._door = socket.create_server(("127.0.0.1", 0))
        self.port = self._door.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._door.accept()
                if not self._open:
                    near.close()
                    continue
                far = socket.create_connection(("127.0.0.1", self._to))
                self._pairs.append((near, far))
                for a, b in ((near, far), (far, near)):
                    threading.Thread(target=self._carry, args=(a, b), daemon=True).start()

    def _carry(self, a, b):
        with contextlib.suppress(OSError):
            while data := a.recv(65536):
                b.sendall(data)
        for end in (a, b):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def cut(self, seconds):
        self._open = False
        for pair in self._pairs:
            for end in pair:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
        time.sleep(seconds)
        self._open = True

    def close(self):
        self._door.close()


@contextlib.contextmanager
def processes(folder):
    """Start a scheduler and three workers in separate processes; yield the port and the workers."""
    dask = [sys.executable, "-m", "dask"]
    place = ["--no-dashboard", "--scheduler-file", str(folder / "scheduler.json")]
    quiet = {"cwd": folder, "stdout": subprocess.DEVNULL, "stderr": (folder / "dask.log").open("w")}
    with contextlib.ExitStack() as stack:

        def start(*words):
            result = subprocess.Popen([*dask, *words], start_new_session=True, **quiet)
            stack.callback(result.wait, 30)
            stack.callback(lambda: os.killpg(result.pid, signal.SIGKILL))
            return result

        start("scheduler", "--host", "127.0.0.1", "--port", "0", *place)
        while not (folder / "scheduler.json").exists():
            time.sleep(0.1)
        address = json.loads((folder / "scheduler.json").read_text())["address"]
        yield (
            int(address.rpartition(":")[2]),
            [start("worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny") for _ in range(3)],
        )


@pytest.mark.slow
def test_killed_worker_and_cut_connection_change_nothing(tmp_path):
    (tmp_path / "study.toml").write_text(SWEEP.format(starts=16))
    flights = tmp_path / "there" / "flights.jsonl"
    with processes(tmp_path) as (port, workers), ThreadPoolExecutor(1) as beside:
        wire = Wire(port)

        def disturb():
            until = time.monotonic() + 300.0
            while not flights.exists() and time.monotonic() < until:
                time.sleep(0.1)
            workers[0].kill()
            wire.cut(5.0)

        done = beside.submit(disturb)
        retrim("sweep", "study.toml", "--on", f"tcp://127.0.0.1:{wire.port}", "--out", "there", cwd=tmp_path)
        assert done.done()
        wire.close()
    retrim("sweep", "study.toml", "--out", "here", cwd=tmp_path)
    assert rows(tmp_path / "there") == rows(tmp_path / "here")
    keys = [json.loads(line)["key"] for line in flights.read_text().splitlines()]
    assert len(keys) == len(set(keys)) == 2 * 2 * 16
