"""Measure policy updates per second on one core, during a real-time flight on another core."""

import json
import os
import statistics
import subprocess
import sys
import time
from typing import Any

import jax
from jax import random

from ..config.loading import load
from ..config.scenario import Scenario
from ..config.setup import Setup
from ..onboard.launch import PYTHON
from .flight import learner_in_flight
from .machine import on_core
from .timing import time_runs

POLICIES = 40
PRESET = "hover/retrim"


def policies() -> dict[str, Any]:
    """Fit and re-train as fast as one core permits, during a 50 Hz flight on another core; return the table row.

    Raises:
        OSError: The flight did not begin or ended early, or the system does not let a process choose its core.
    """
    command = [*PYTHON, "retrim.bench.background_load"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as flight:
        on_core(-1)  # after the start of the flight, whose process must be able to choose any core
        learner, state, window = learner_in_flight(PRESET)
        keys = iter(random.split(random.key(0), 2 * POLICIES))

        def one() -> Any:
            residual, _ = learner.fit_residual(state.residual, window)
            return learner.update_policy(state.policy, residual, window, next(keys))

        began = time.perf_counter()
        jax.block_until_ready(jax.tree.leaves(one()))
        compile_s = time.perf_counter() - began
        if flight.stdin is None or flight.stdout is None or not flight.stdout.readline():
            raise OSError("the parallel flight did not begin")
        row = time_runs(compile_s, one, POLICIES)
        flight.stdin.close()
        line = flight.stdout.readline()
    if not line:
        raise OSError("the parallel flight did not continue")
    report = json.loads(line)
    rate = f"{1.0 / row['run_s']:.0f} policies a second; {report['late']} of {report['ticks']} ticks beside ended late"
    remarks = f"{rate}, a tick took {1000 * report['tick_s']:.1f} ms"
    return {"compile_s": compile_s, "run_s": None, "one_core": row, "remarks": remarks}


def _fly() -> None:
    """Fly in real time until standard input is closed, and print the result."""
    on_core(0)
    setup = Setup.from_preset(load(PRESET))
    pilot = setup.pilot(setup.new_policy(random.key(0)), "base-do")
    plant, dt = Scenario().make(), setup.preset.dt
    measurement = plant.reset(setup.flight_starts(1)[0])
    pilot.warm_up(measurement)
    plant.step(pilot.act(measurement))
    measurement = plant.reset(setup.flight_starts(1)[0])
    pilot.reset(measurement)
    print("ready", flush=True)
    os.set_blocking(sys.stdin.fileno(), False)
    took, late, due = list[float](), 0, time.perf_counter()
    while not _over():
        began = time.perf_counter()
        u = pilot.act(measurement)
        measurement, accepted_command = plant.step(u)
        if accepted_command is not u:
            pilot.accept(accepted_command)
        took.append(time.perf_counter() - began)
        due += dt
        left = due - time.perf_counter()
        late += left < 0.0
        time.sleep(max(left, 0.0))
    print(json.dumps({"ticks": len(took), "late": late, "tick_s": statistics.median(took)}), flush=True)


def _over() -> bool:
    """Return whether standard input has been closed."""
    try:
        return os.read(sys.stdin.fileno(), 1) == b""
    except BlockingIOError:
        return False


if __name__ == "__main__":
    _fly()
