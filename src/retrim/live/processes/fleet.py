"""Process that learns for many vehicles. Vehicles may join and leave while the process runs."""

import contextlib
import os
import pickle
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import jax

from ...errors import RetrimError
from ...io.files import write_whole
from ...onboard.launch import launch
from ...onboard.messages import pack_note
from ...onboard.realtime import ParentWatch
from ...runkit.compile_cache import enable_compile_cache
from ...transport.shared_memory import SharedMemoryBus
from .fleet_learner import FleetLearner
from .learner import CHECK_EVERY, NICENESS, LearnerPlan

FAILED = ".failed"
LOOK_EVERY = 0.1  # [s] between two checks for vehicles that have joined or left


@dataclass(frozen=True)
class FleetPlan:
    """Arguments of the process."""

    folder: Path
    """Folder of the plans: one file ``NAME.plan`` per vehicle and layer. Files appear and disappear during a run."""
    parent: int


def learn_for_all(plan: FleetPlan) -> None:
    """Learn until the parent has ended; this is the main function of the process."""
    with contextlib.suppress(OSError, AttributeError):
        os.nice(NICENESS)
    enable_compile_cache()
    fleet, parent, last_look, done = FleetLearner(), ParentWatch(plan.parent), 0.0, set[str]()
    while not parent.has_ended():
        if time.monotonic() - last_look > LOOK_EVERY:
            last_look = time.monotonic()
            _look(fleet, plan.folder, done)
        if not fleet.step():
            time.sleep(CHECK_EVERY)


def _look(fleet: FleetLearner, folder: Path, done: set[str]) -> None:
    """Add vehicles that have joined; drop vehicles that have left or whose flight is over.

    Args:
        fleet: Learners.
        folder: Folder of the plans.
        done: Names of plans whose flight is over or that cannot be executed. This function adds names to the set.
    """
    there = {path.stem: path for path in folder.glob("*.plan")}
    done |= {name for name, loop in fleet.loops.items() if loop.bus.latest("ended") is not None}
    for name in (fleet.loops.keys() - there.keys()) | (fleet.loops.keys() & done):
        fleet.drop(name)
    new = sorted(there.keys() - fleet.loops.keys() - done)
    for name in new:
        try:
            result: LearnerPlan = pickle.loads(there[name].read_bytes())  # written by the parent of this process
            bus = SharedMemoryBus(result.folder)
            if bus.latest("ended") is not None:
                done.add(name)
                continue
            fleet.add(name, result, bus, there[name].exists)
        except RetrimError as error:
            done.add(name)
            print(error, file=sys.stderr, flush=True)
            there[name].with_suffix(FAILED).touch()
        except (OSError, EOFError):  # the vehicle has left again
            continue
    if not new:
        return
    fleet.warm_up()
    device = jax.devices()[0].platform
    for name in fleet.loops.keys() & set(new):
        loop = fleet.loops[name]
        loop.bus.publish(f"ready.{loop.plan.layer}", pack_note("ready", base=loop.plan.base, device=device))


@dataclass
class FleetProcess:
    """Process of a :class:`FleetLearner`. It starts with the first vehicle; if it dies, it restarts with the next."""

    folder: Path
    cores: set[int] | None = None
    """Allowed CPU cores; None for any core."""
    process: "subprocess.Popen[bytes] | None" = None
    count: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def start(self, layer: str, plan: LearnerPlan, complaints: Path) -> "FleetSlot":
        """Start learning for a vehicle and layer. This method may be called from any thread."""
        with self.lock:
            return self._start(layer, plan, complaints)

    def _start(self, layer: str, plan: LearnerPlan, complaints: Path) -> "FleetSlot":
        if self.process is None or self.process.poll() is not None:
            main, fleet = "retrim.live.processes.fleet:learn_for_all", FleetPlan(self.folder, os.getpid())
            self.process = launch(main, fleet, self.folder / "learners.log", self.cores)
        self.count += 1
        path = self.folder / f"{self.count:06d}-{layer}.plan"
        write_whole(path, pickle.dumps(plan))
        complaints.unlink(missing_ok=True)
        complaints.symlink_to(self.folder / "learners.log")
        return FleetSlot(self.process, path)

    def close(self) -> None:
        """Kill the process."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()


@dataclass(frozen=True)
class FleetSlot:
    """One vehicle and layer in the shared process; the ground station treats the slot like a separate process."""

    process: "subprocess.Popen[bytes]"
    path: Path

    def poll(self) -> int | None:
        """Return the exit code of the process, or 1 if the process cannot execute the plan; None while it learns."""
        return 1 if self.path.with_suffix(FAILED).exists() else self.process.poll()

    def kill(self) -> None:
        """Stop learning for this vehicle."""
        self.path.unlink(missing_ok=True)

    def wait(self) -> None:
        """Return immediately, since the process continues for the other vehicles."""
