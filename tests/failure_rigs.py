"""Live flights of peers in this process, with killed processes and cut links."""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from live_helpers import DrillSupervisor, hover_source, plan
from live_processes import DT, level, rotation
from retrim import Scenario
from retrim.live.processes import vehicle
from retrim.live.roles import ROLES
from retrim.live.spec import LiveSpec
from retrim.onboard.guard import G
from retrim.onboard.launch import launch
from retrim.onboard.recorder import read_log
from retrim.plants.bridges import crazyflie, offboard_plant, ros2
from retrim.testing.peer_vehicle import PeerVehicle

HOME = np.array([0.0, 0.0, 0.8])
STAND_INS = dict.fromkeys(("residual", "policy", "page", "identifier"), "live_processes:learner")
TICK, STEPS = 0.01, 4  # tick of a peer [s] and steps of its vehicle in a tick


class PointVehicle(PeerVehicle):
    """A point mass that follows body rates, without JAX, because the flights use most of the cores."""

    def _place(self, p, v=None):
        self._state = p.copy(), self.R.copy(), np.zeros(3) if v is None else np.array(v, dtype=float)

    def _step_plant(self, u):
        (p, R, v), dt = self._state, TICK / STEPS
        for _ in range(STEPS):
            p, v = p + dt * v, v + dt * (u[0] * R[:, 2] - np.array([0.0, 0.0, G]))
            R = R @ rotation(dt * np.asarray(u[1:]))
        self._state = p, R, v
        return SimpleNamespace(p=p, R=R, v=v)


class View(NamedTuple):
    """The vehicle of a peer at one time."""

    at: float
    p: np.ndarray
    v: np.ndarray
    upright: float
    """Cosine of the tilt."""
    follows: bool
    """Whether the vehicle follows commands of retrim or of its guardian."""
    flies: bool
    thrust: float
    """Share of the thrust of the motors, if the peer reports it."""


class Rig:
    """A peer that flies in a thread."""

    def __init__(self, peer, plant, reset):
        self.peer, self.plant, self._reset = peer, plant, reset
        peer.vehicle.close()
        peer.vehicle = PointVehicle(Scenario(plant="simple"), heading=0.0)
        self.views = [self._view()]
        self.lock, self._over = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def hover(self):
        """Let the autopilot hold the vehicle at HOME."""
        with self.lock:
            self.peer.cut = False
            self.peer.vehicle.hover(HOME)
            self._reset(self.peer)
            self.views.clear()

    def kick(self, v):
        """Set the velocity, so that a controller commands body rates."""
        with self.lock:
            self.peer.vehicle.hover(self.peer.vehicle.p, np.asarray(v))

    def since(self, instant, until=np.inf):
        with self.lock:
            return [view for view in self.views if instant <= view.at <= until]

    def settle(self, at_least, at_most=8.0):
        """Wait until the vehicle is at rest or has landed."""
        began = time.monotonic()
        while (now := time.monotonic()) < began + at_most:
            time.sleep(0.1)
            if now > began + at_least and all(
                not view.flies or np.abs(view.v).max() < 0.08 for view in self.since(now - 0.7)
            ):
                return

    def close(self):
        self._over.set()
        self._thread.join(5.0)
        getattr(self.peer, "close", self.peer.vehicle.close)()

    def _view(self):
        x = self.peer.vehicle
        thrust = float(getattr(self.peer, "_thrust", np.nan))
        return View(time.monotonic(), x.p.copy(), x.v.copy(), float(x.R[2, 2]), self.peer.by_rates, x.flies, thrust)

    def _run(self):
        with contextlib.suppress(OSError):  # pauses of the vehicle would prevent its control
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(25))
        due = time.monotonic()
        while not self._over.is_set():
            with self.lock:
                self.peer.step()
                self.views.append(self._view())
            due = max(due + TICK, time.monotonic() - 5 * TICK)
            time.sleep(max(0.0, due - time.monotonic()))


def run_link(plan):
    """Run the link process with a short measurement of the thrust at hover, since the peers have no wind."""
    for module in (crazyflie, offboard_plant, ros2):
        module.THRUST_S = 0.5
    vehicle.fly(plan)


def spec_of(rig, folder, layers=()):
    start = folder / "start.safetensors"
    start.write_bytes(b"")
    controller = hover_source(home=HOME)
    return LiveSpec(
        controller, layers, start, None, Scenario(plant=rig.plant), "small", level(HOME), HOME,
        plan(controller).limits, DT, 1, 50, 1e9, 0, folder, mains={"plant": "failure_rigs:run_link"} | STAND_INS,
    )  # fmt: skip


@contextlib.contextmanager
def add_roles():
    """Add stand-ins for the page and the identifier."""
    before = dict(ROLES)
    try:
        for role in ("page", "identifier"):
            ROLES[role] = replace(ROLES[role], is_needed=lambda spec: True)
        yield
    finally:
        ROLES.update(before)


def fly(spec, rig) -> Iterator[DrillSupervisor]:
    """Fly; yield the flight with its newest status until its end."""
    rig.hover()
    with DrillSupervisor(spec) as flight:
        for _ in flight.warm_up():
            pass
        flight.take_off()
        until = time.monotonic() + 60.0
        while time.monotonic() < until:
            flight.status = flight.watch()
            if flight.status.end_reason is not None:
                flight.finish()
                break
            yield flight
            time.sleep(0.02)


@contextlib.contextmanager
def start_supervised_flight(spec, rig, seconds=0.6):
    """Fly with a supervisor in a process; after some seconds of flight, yield the processes by function."""
    rig.hover()
    supervisor = launch("live_helpers:supervise", spec, spec.folder / "supervisor.log")
    log, until = spec.folder / "flight.csv", time.monotonic() + 60.0
    try:
        while not (log.exists() and len(rows := read_log(log)) and rows[-1, 1] > seconds):
            assert supervisor.poll() is None
            assert time.monotonic() < until
            time.sleep(0.02)
        yield {"supervise": supervisor.pid} | children_of(supervisor.pid)
    finally:
        for pid in children_of(supervisor.pid).values():
            os.kill(pid, signal.SIGKILL)
        supervisor.kill()
        supervisor.wait()


def children_of(supervisor):
    """Return the processes of a flight by module and function."""
    result = {}
    with contextlib.suppress(OSError):
        for pid in map(int, Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text().split()):
            words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
            if len(words) > 1:  # not a zombie
                result[words[-2].decode().rpartition(".")[2]] = pid
    return result


def kill_all(processes):
    """Send SIGKILL to all processes of a flight."""
    for pid in processes.values():
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
