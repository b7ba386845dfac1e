"""Supervisor of a live flight: it starts the processes, arms and ends the flight, and restarts dead processes."""

import contextlib
import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from subprocess import Popen, TimeoutExpired
from typing import Any

from ..errors import MessageError, PlantError
from ..onboard.heartbeat import Heart
from ..onboard.launch import last_words, launch
from ..onboard.messages import STOPPED, last_height, last_note, last_send_time, pack_note, ticks_of
from ..onboard.note_fields import plain
from ..onboard.pulses import SILENCE, Pulses, is_last_command
from ..onboard.realtime import cores_of
from ..onboard.recorder import Recorder
from ..transport.message import describe
from ..transport.shared_memory import SharedMemoryBus
from .refused_notes import RefusedNotes
from .remote_learners import RemoteLearners
from .roles import ROLES, RoleRequest
from .spec import LiveSpec
from .status import Status
from .topics import topics

LANDING = 60.0  # [s], longest time for a landing; the processes then end wherever the vehicle is
LAST = 5  # [ticks] after the end of the plant, during which the log receives the last reports from control
ATTEMPTS = 5  # restarts per process
READY_S = 300.0  # [s], longest time until all processes are ready, including compilation


@dataclass
class Supervisor:
    """Processes of one flight. Leaving the context ends all of them."""

    spec: LiveSpec
    processes: dict[str, "Popen[bytes]"] = field(default_factory=dict)
    restarts: dict[str, int] = field(default_factory=dict)
    hangs: dict[str, int] = field(default_factory=dict)
    """Number of times each process was ended because it was silent."""
    refusals: dict[str, list[str]] = field(default_factory=dict)
    """Requests that the operating system refused, by role."""
    epoch: float | None = None
    _landing: bool = False
    _log_location: str = ""
    _airborne_ordered: bool = False
    _report_versions: dict[str, int] = field(default_factory=dict)
    _remote: RemoteLearners | None = None

    def __enter__(self) -> "Supervisor":
        """Create the bus."""
        self.bus, self.floor = SharedMemoryBus.create(topics(self.spec)), 0
        self.start = self.bus.take_in(self.spec.start)  # the results folder may disappear
        self.spec = replace(self.spec, start=self.start)
        self._notes, self._pulses = RefusedNotes(self.bus, topics(self.spec)), Pulses(self.bus)
        self._heart = Heart(self.bus, "supervisor")
        self._remote = None if self.spec.learners is None else RemoteLearners(self.spec, self.bus)
        self._cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
        if self._cores:
            os.sched_setaffinity(0, cores_of("learn"))
        return self

    def __exit__(self, *_: object) -> None:
        """Land a vehicle that still flies, end the running processes, and remove the bus."""
        aloft = self.epoch is not None or self._airborne_ordered
        if aloft and self._alive("plant") and not last_note(self.bus, "ended"):
            self.land()
            until = time.monotonic() + LANDING
            while self._alive("plant") and not last_note(self.bus, "ended") and time.monotonic() < until:
                time.sleep(0.05)
        if self._remote is not None:
            if not last_note(self.bus, "ended"):
                self.bus.publish("ended", pack_note("ended", reason="the flight did not come to its end"))
            self._remote.part()
        if self._cores:
            os.sched_setaffinity(0, self._cores)
        for process in self.processes.values():
            if process.poll() is None:
                process.terminate()
        for process in self.processes.values():
            with contextlib.suppress(TimeoutExpired):
                process.wait(2.0)
            if process.poll() is None:
                process.kill()
                process.wait()
        self.bus.remove()

    def warm_up(self) -> Iterator[tuple[str, float]]:
        """Start the processes; yield the names of the processes that are not ready, and the waiting time [s].

        Raises:
            PlantError: A process ended (the message contains its last line of output), or was not ready in time.
        """
        began = time.monotonic()
        if self._remote is not None:
            self._remote.announce(self.start)
        for name, role in ROLES.items():
            if role.is_needed(self.spec):
                self._start(name)
        while waiting := self._not_ready():
            self._check_alive()
            if time.monotonic() - began > READY_S:
                raise PlantError(f"not ready after {READY_S:g} s: {', '.join(waiting)}; the flight did not start")
            yield ", ".join(waiting), time.monotonic() - began
            time.sleep(0.1)
        if failure := last_note(self.bus, "ready.recorder", "ready").get("failed"):
            raise PlantError(f"the log of the flight cannot be written: {failure}")
        for name in (name for name, role in ROLES.items() if role.priority):
            self.refusals[name] = last_note(self.bus, f"ready.{name}", "ready").get("refused", [])
        if last_note(self.bus, "ready.plant", "ready").get("stands"):
            yield from self._lift_off()

    def take_off(self) -> None:
        """Publish the order to start; the first tick of all processes is 0.5 s later.

        Raises:
            PlantError: A process has ended after it was ready.
        """
        self._check_alive()
        self.epoch = time.monotonic() + 0.5
        self.bus.publish("order", pack_note("order", epoch=self.epoch))
        for role in self.processes:
            self._pulses.expect(role)

    def _lift_off(self) -> Iterator[tuple[str, float]]:
        """Make a vehicle take off under its autopilot's control."""
        began, self._airborne_ordered = time.monotonic(), True
        self.bus.publish("order", pack_note("order", order="take off"))
        while self.bus.latest("airborne") is None:
            self._check_alive()
            usual = self.spec.scenario.entry.awaits
            yield str(last_note(self.bus, "world").get("waits_for") or usual), time.monotonic() - began
            time.sleep(0.1)

    def land(self) -> None:
        """Publish the order to land; further calls have no effect."""
        if not self._landing:
            self._landing = True
            self.bus.publish("order", pack_note("order", epoch=self.epoch, order="land"))

    def learn(self, *, pause: bool, active: bool) -> None:
        """Run or pause the learners, and fly with the learned parameters or the initial ones."""
        self.bus.publish("learning", pack_note("learning", paused=pause, flown=active))

    def learn_from(self, start: Path) -> None:
        """Restart the policy learner from the learned state in a file."""
        self.start, newest = start, self.bus.latest("parameters.policy")
        self.floor = 0 if newest is None else newest.version
        if self._remote is not None:
            self._remote.announce(start)
            return
        self._end("policy")
        with contextlib.suppress(OSError):
            self._start("policy")
            self._pulses.expect("policy", READY_S)

    @property
    def landing(self) -> bool:
        """Whether the order to land was published."""
        return self._landing

    @property
    def page_port(self) -> int | None:
        """Port of the page, if there is one."""
        return last_note(self.bus, "ready.page", "ready").get("port")

    def watch(self) -> Status:
        """Restart processes that died or hang if their role permits a restart; return the flight's status."""
        assert self.epoch is not None
        self._heart.beat()
        reason = last_note(self.bus, "ended").get("reason")
        if reason is None:
            self._end_hanging()
            for role, process in self.processes.items():
                has_failed = process.poll() not in (None, 0)  # a regular exit means that the flight is over
                if ROLES[role].restarts and has_failed and self.restarts.get(role, 0) < ATTEMPTS:
                    self._restart(role)
            if self.processes["plant"].poll() is not None:
                reason = self._lost_plant()
        alive = {role: process.poll() is None for role, process in self.processes.items()}
        if self._remote is not None:
            alive |= self._remote.alive()
        control, world = last_note(self.bus, "status"), last_note(self.bus, "world")
        log = last_note(self.bus, "ready.recorder", "ready")
        self._log_location = log.get("moved") or self._log_location
        t, fallback = time.monotonic() - self.epoch, self.bus.latest("fallback")
        by_watchdog = last_send_time(self.bus, "fallback") > last_send_time(self.bus, "setpoint")
        ticks = 0 if fallback is None else fallback.version
        stalls, fit = last_note(self.bus, "stalls"), last_note(self.bus, "learner.residual")
        return Status(
            t, control, world, alive, dict(self.restarts), reason, self._rejections(), by_watchdog, ticks,
            log.get("failed"), stalls, self._notes.look(), self._notes.count, fit.get("excluded", []),
            dict(self.hangs), self._log_location,
            ticks_of(self.bus), last_note(self.bus, "identified").get("reports", []),
        )  # fmt: skip

    def finish(self, patience: float = 3.0) -> None:
        """Wait until the log is complete; write the missing part if the recorder does not finish in time."""
        until, flew, recorder = time.monotonic() + patience, time.monotonic(), self.processes["recorder"]
        while recorder.poll() is None and time.monotonic() < until:
            if self._alive("plant"):
                flew = time.monotonic()
            elif self._alive("control") and time.monotonic() > flew + LAST * self.spec.dt:
                self.processes["control"].terminate()  # the plant has ended
            time.sleep(0.02)
        if recorder.poll() != 0:
            self._end("recorder")
            self._record()

    def _end_hanging(self) -> None:
        """End processes that are alive but silent."""
        allowances = {"plant": LANDING} if is_last_command(self.bus) else {}
        for role in self._pulses.hanging([role for role in self.processes if self._alive(role)], allowances):
            self.hangs[role] = self.hangs.get(role, 0) + 1
            self._end(role)

    def _end(self, role: str) -> None:
        """End a process immediately, even if it is suspended."""
        self.processes[role].kill()
        with contextlib.suppress(TimeoutExpired):  # a disk or a device may delay the end
            self.processes[role].wait(1.0)

    def _restart(self, role: str) -> None:
        self.restarts[role] = self.restarts.get(role, 0) + 1
        if role == "recorder":
            self._record()  # otherwise ticks may drop out of the reports before the new recorder runs
        with contextlib.suppress(OSError):  # the flight continues without the process
            self._start(role)
            self._pulses.expect(role, READY_S)

    def _record(self) -> None:
        """Write the reported ticks that are not in the log; no other process may write at the same time."""
        Recorder(self.spec.folder / "flight.csv", self.bus, self.spec.spare).step()

    def _lost_plant(self) -> str:
        """Return the reason for the end of a flight whose plant process has ended."""
        if reason := last_note(self.bus, "ended").get("reason"):
            return str(reason)
        if "plant" in self.hangs:
            flies_on = self.spec.scenario.entry.is_vehicle
            what = "left to its autopilot" if flies_on else STOPPED
            why = f"the plant process hung: it said nothing for {SILENCE:g} s and was ended"
            why = f"{what} at {last_height(self.bus):.2f} m: {why}"
        else:
            why = f"the plant process is gone: {last_words(self._complaints('plant'))}"
        self.bus.publish("ended", pack_note("ended", reason=why))
        return why

    def _not_ready(self) -> list[str]:
        waiting = [role for role in self.processes if self.bus.latest(f"ready.{role}") is None]
        if self._remote is not None:
            waiting += [layer for layer in self.spec.layers if not self._remote.ready(layer)]
        return waiting

    def _alive(self, role: str) -> bool:
        return role in self.processes and self.processes[role].poll() is None

    def _check_alive(self) -> None:
        if self._remote is not None and (failure := self._remote.failed()) is not None:
            raise PlantError(failure)
        if why := last_note(self.bus, "ended").get("reason"):
            raise PlantError(f"the flight ended before it began: {why}")
        for role in self.processes:
            if not self._alive(role):
                raise PlantError(f"the {role} process ended before take-off: {last_words(self._complaints(role))}")

    def _rejections(self) -> list[str]:
        result = []
        for layer in self.spec.layers:
            message = self.bus.latest(f"said.{layer}", self._report_versions.get(layer, 0))
            if message is None:
                continue
            self._report_versions[layer] = message.version
            with contextlib.suppress(MessageError, KeyError, ValueError, TypeError):
                content = json.loads(describe(message.data, kind="rejected", source=layer)["update"])
                result.append(f"{layer}: {plain(str(content['reason']))}")
        return result

    def _start(self, role: str) -> None:
        cores = cores_of("fly" if ROLES[role].priority else "learn", self._cores)
        main = self.spec.mains.get(role, ROLES[role].main)
        self.processes[role] = launch(main, self._plan(role), self._complaints(role), cores)

    def _complaints(self, role: str) -> Path:
        return self.spec.folder / f"{role}.log"

    def _plan(self, role: str) -> Any:
        control = self.processes["control"].pid if "control" in self.processes else 0
        fly = frozenset(cores_of("fly", self._cores))
        return ROLES[role].plan(RoleRequest(self.spec, self.start, self.bus.folder, self.floor, fly, control))
