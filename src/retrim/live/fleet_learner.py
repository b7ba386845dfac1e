"""One process that learns for many vehicles: what is due at an instant is learnt as one program."""

import contextlib
import os
import pickle
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from ..config.loading import dump
from ..config.presets import Preset
from ..config.setup import Setup
from ..errors import RetrimError
from ..experiments.compile_cache import enable_compile_cache
from ..io.files import write_whole
from ..learn.window import Window
from ..onboard.launch import launch
from ..onboard.messages import pack_note
from ..onboard.realtime import Lifeline
from ..runtime.fleet_learning import learn_together, room_for
from ..transport.bus import Bus
from ..transport.shared_memory import SharedMemoryBus
from .learner_process import CHECK_EVERY, NICE, LearnerLoop, LearnerPlan

AT_ONCE, MANY = 4, 1024  # vehicles of one program: on a CPU, on an accelerator
LOOK_EVERY = 0.1  # [s] for vehicles that have come or gone


class FleetLearner:
    """The learners of many vehicles. A vehicle whose window is late is not waited for."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Build one without vehicles; ``clock`` tells the time [s]."""
        self.loops: dict[str, LearnerLoop] = {}
        """By the name of a vehicle and layer."""
        self._clock, self._setups = clock, dict[tuple[str, str | None], Setup]()
        self._compiled = set[tuple[Any, int]]()
        self._most = AT_ONCE if jax.default_backend() == "cpu" else MANY

    def add(self, name: str, plan: LearnerPlan, bus: Bus) -> None:
        """Learn for one more vehicle and layer, from now on."""
        loop = LearnerLoop(plan, bus, self._clock, self._setup_of)
        loop.catch_up()
        self.loops[name] = loop

    def drop(self, name: str) -> None:
        """Learn no more for it."""
        self.loops.pop(name, None)

    def warm_up(self) -> None:
        """Compile what the present vehicles need, however many of them are due at once."""
        for kind, loops in self._kinds(list(self.loops.values())).items():
            for n in (1 << k for k in range(room_for(min(len(loops), self._most)).bit_length())):
                if (kind, n) in self._compiled:
                    continue
                some = [loops[i % len(loops)] for i in range(n)]
                learn_together([loop.new_worker() for loop in some], [loop.made_up_window() for loop in some])
                self._compiled.add((kind, n))

    def step(self) -> int:
        """Learn for vehicles that are due, those first that have waited longest; return for how many.

        On a CPU a few of them fill a core, and more at once would only let each wait for the others. Those that are
        left are due in the next step, and learn from a window that is as new as that.
        """
        done = 0
        for loops in self._kinds(list(self.loops.values())).values():
            windows = list[tuple[LearnerLoop, Window]]()
            for loop in loops:
                if len(windows) < self._most and (window := loop.due()) is not None:
                    windows.append((loop, window))
            if not windows:
                continue
            updates = learn_together([loop.worker for loop, _ in windows], [window for _, window in windows])
            for (loop, _), update in zip(windows, updates, strict=True):
                loop.learnt(update)
            served = {id(loop) for loop, _ in windows}
            self.loops = dict(sorted(self.loops.items(), key=lambda each: id(each[1]) in served))  # to the end
            done += len(windows)
        return done

    def _setup_of(self, preset: Preset, reference: str | None) -> Setup:
        """Vehicles with the same preset and reference share a learner, so that they can be one program."""
        key = dump(preset), reference
        if key not in self._setups:
            self._setups[key] = Setup.of(preset, reference)
        return self._setups[key]

    def _kinds(self, loops: list[LearnerLoop]) -> dict[Any, list[LearnerLoop]]:
        """Return loops by what can be one program: the layer, the learner, and whether all weights are learnt."""
        found: dict[Any, list[LearnerLoop]] = {}
        for loop in loops:
            kind = loop.plan.layer, id(loop.setup), type(loop.state.policy.policy)
            found.setdefault(kind, []).append(loop)
        return found


@dataclass(frozen=True)
class FleetPlan:
    """Everything that the process is started with."""

    folder: Path
    """A plan for each vehicle and layer, ``NAME.plan``; they come and go."""
    parent: int


def learn_for_all(plan: FleetPlan) -> None:
    """Learn until the parent is gone: the main function of the process."""
    with contextlib.suppress(OSError, AttributeError):
        os.nice(NICE)
    enable_compile_cache()
    fleet, parent, looked = FleetLearner(), Lifeline(plan.parent), 0.0
    while not parent.gone():
        if time.monotonic() - looked > LOOK_EVERY:
            looked = time.monotonic()
            _look(fleet, plan.folder)
        if not fleet.step():
            time.sleep(CHECK_EVERY)


def _look(fleet: FleetLearner, folder: Path) -> None:
    """Take vehicles that have come, and let those go that are gone or whose flight is over."""
    there = {path.stem: path for path in folder.glob("*.plan")}
    over = {name for name, loop in fleet.loops.items() if loop.bus.latest("ended") is not None}
    for name in (fleet.loops.keys() - there.keys()) | over:
        fleet.drop(name)
    new = [name for name in sorted(there.keys() - fleet.loops.keys()) if name not in over]
    for name in new:
        with contextlib.suppress(OSError, EOFError, RetrimError):  # gone again
            found: LearnerPlan = pickle.loads(there[name].read_bytes())  # written by the parent of this process
            bus = SharedMemoryBus(found.folder)
            if bus.latest("ended") is None:
                fleet.add(name, found, bus)
    if not new:
        return
    fleet.warm_up()
    device = jax.devices()[0].platform
    for name in fleet.loops.keys() & set(new):
        loop = fleet.loops[name]
        loop.bus.publish(f"ready.{loop.plan.layer}", pack_note("ready", base=loop.plan.base, device=device))


@dataclass
class FleetProcess:
    """The process of a :class:`FleetLearner`, started when the first vehicle needs it, and again if it died."""

    folder: Path
    cores: set[int] | None = None
    """Where it may run; None for anywhere."""
    process: "subprocess.Popen[bytes] | None" = None
    count: int = 0

    def start(self, layer: str, plan: LearnerPlan, complaints: Path) -> "Seat":
        """Have it learn for a vehicle and layer."""
        if self.process is None or self.process.poll() is not None:
            main, fleet = "retrim.live.fleet_learner:learn_for_all", FleetPlan(self.folder, os.getpid())
            self.process = launch(main, fleet, self.folder / "learners.log", self.cores)
        self.count += 1
        path = self.folder / f"{self.count:06d}-{layer}.plan"
        write_whole(path, pickle.dumps(plan))
        complaints.unlink(missing_ok=True)
        complaints.symlink_to(self.folder / "learners.log")
        return Seat(self.process, path)

    def close(self) -> None:
        """End it."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()


@dataclass(frozen=True)
class Seat:
    """One vehicle and layer in the process of all; to a ground station it looks like a process of its own."""

    process: "subprocess.Popen[bytes]"
    path: Path

    def poll(self) -> int | None:
        """Return the exit code of the process; None while it runs."""
        return self.process.poll()

    def kill(self) -> None:
        """Have it learn for this vehicle no more."""
        self.path.unlink(missing_ok=True)

    def wait(self) -> None:
        """Return at once: the process goes on for the others."""
