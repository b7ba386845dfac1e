"""Benchmark many live vehicles on one machine, with one process that learns for all of them."""

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..config.loading import load
from ..config.scenario import Scenario
from ..config.setup import Setup
from ..learn.stacking import stack
from ..live.processes.fleet import FleetProcess
from ..live.processes.learner import LearnerPlan
from ..live.roles import ROLES, RoleRequest
from ..live.session import LAYERS, LiveRequest, live_spec
from ..live.spec import LiveSpec
from ..live.topics import topics
from ..onboard.control import ControlLoop
from ..onboard.guard import Mode
from ..onboard.launch import PYTHON
from ..onboard.messages import Sample, last_note
from ..onboard.realtime import sleep_until
from ..physics.state import Command, State
from ..plants.sim import SimPlant, SimState, Simulation
from ..transport.shared_memory import SharedMemoryBus
from .machine import last_core, on_core

PRESET, SECONDS, SETTLING_S = "hover/retrim", 15.0, 3.0
PUSH = "small"


def live_fleet(n: int) -> dict[str, Any]:
    """Fly ``n`` vehicles in real time on one core, with one learning process on another; return the table row.

    Raises:
        OSError: The vehicles did not complete the flight.
    """
    process = subprocess.run([*PYTHON, "retrim.bench.vehicles", str(n)], stdout=subprocess.PIPE, text=True, check=False)
    if process.returncode != 0 or not process.stdout:
        raise OSError(f"the {n} vehicles did not fly to the end")
    result: dict[str, Any] = json.loads(process.stdout.splitlines()[-1])
    remarks = (
        f"{result['updates_per_s']:.1f} updates a second, {result['policies_per_s']:.1f} of them better and flown, "
        f"{result['swap_s']:.2f} s from flight to swap (median; worst "
        f"{result['worst_swap_s']:.2f}), {result['steady_m']:.4f} m off, "
        f"{result['late']} of {result['ticks']} ticks late"
    )
    return {"compile_s": result["warm_s"], "run_s": result["swap_s"], "units": None, "remarks": remarks}


class Air:
    """All vehicles: one program that simulates them, and a bus and a control loop for each vehicle."""

    def __init__(self, n: int, place: Path) -> None:
        setup = Setup.from_preset(load(PRESET))
        self.dt = setup.preset.dt
        scenario, starts = Scenario(PUSH, plant="simple"), setup.flight_starts(n)
        request = LiveRequest(setup, setup.pretrained(), scenario, "full", SECONDS, 0, 5.0, place)
        self.spec = live_spec(request)
        self.buses = [SharedMemoryBus.create(topics(self.spec)) for _ in range(n)]
        self.loops = [self._loop(self.spec, bus) for bus in self.buses]
        plants = [scenario.make("small", dt=self.dt, seed=i) for i in range(n)]
        self._simulations = stack([plant.simulation for plant in plants if isinstance(plant, SimPlant)])
        self._states, measurements = _launch(self._simulations, stack(starts))
        self._measurements = np.asarray(measurements, dtype=float)
        self._commands = np.tile(np.asarray(Command.hover().vector(), dtype=float), (n, 1))
        self.tick = 0

    def plans(self) -> list[tuple[str, LearnerPlan]]:
        """Return the learner plans, one for each vehicle and layer."""
        return [
            (layer, ROLES[layer].plan(RoleRequest(replace(self.spec, seed=i), self.spec.start, bus.folder)))
            for i, bus in enumerate(self.buses)
            for layer in LAYERS
        ]

    def fly(self) -> None:
        """Advance every vehicle by a tick: measure, compute the command, simulate."""
        now, t, commands = time.monotonic(), self.tick * self.dt, []
        for bus, loop, x, command in zip(self.buses, self.loops, self._measurements, self._commands, strict=True):
            bus.publish("sample", Sample(self.tick, t, now, 0.0, x, x, command).pack())
            setpoint = loop.tick(time.monotonic())
            loop.idle()
            commands.append(loop.plan.limits.low if setpoint is None else setpoint.u)
        u = jnp.asarray(np.stack(commands), dtype=float)
        self._states, measurements, command = _step(self._simulations, self._states, u, jnp.asarray(self.tick))
        self._commands, self._measurements = np.asarray(command, dtype=float), np.asarray(measurements, dtype=float)
        self.tick += 1

    def updates(self) -> int:
        """Return the number of policy updates of all vehicles so far, including those that the gate rejected."""
        return sum(int(last_note(bus, "learner.policy").get("learnt", 0)) for bus in self.buses)

    def compile(self) -> None:
        """Compile the program of a tick; the simulated result is discarded."""
        u = jnp.asarray(self._commands, dtype=float)
        jax.block_until_ready(_step(self._simulations, self._states, u, jnp.asarray(0)))

    @staticmethod
    def _loop(spec: LiveSpec, bus: SharedMemoryBus) -> ControlLoop:
        loop = ControlLoop(ROLES["control"].plan(RoleRequest(spec, spec.start, bus.folder)), bus)
        loop.warm_up()
        return loop


@eqx.filter_jit
def _launch(simulations: Simulation, starts: State) -> tuple[SimState, Array]:
    def launch(simulation: Simulation, x0: State) -> tuple[SimState, Array]:
        s = simulation.launch(x0)
        return s, simulation.measure(s).vector()

    start: tuple[SimState, Array] = eqx.filter_vmap(launch)(simulations, starts)
    return start


@eqx.filter_jit
def _step(simulations: Simulation, state: SimState, u: Array, tick: Array) -> tuple[SimState, Array, Array]:
    def step(simulation: Simulation, s: SimState, u: Array) -> tuple[SimState, Array, Array]:
        accepted_command = simulation.within_limits(Command.of(u))
        s = simulation.advance(s, accepted_command, tick)
        return s, simulation.measure(s).vector(), accepted_command.vector()

    result: tuple[SimState, Array, Array] = eqx.filter_vmap(step)(simulations, state, u)
    return result


def main() -> None:
    """Fly the number of vehicles that the command line states, and print the result."""
    n, learning = int(sys.argv[1]), last_core()
    on_core(0)  # before JAX starts its threads, which then stay on this core
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        air, fleet = Air(n, place), FleetProcess(place, {learning})
        try:
            print(json.dumps(_fly_all(air, fleet, place)))
        finally:
            fleet.close()
            for bus in air.buses:
                bus.remove()


def _fly_all(air: Air, fleet: FleetProcess, place: Path) -> dict[str, Any]:
    """Fly all vehicles for a fixed time, and return the results."""
    began = time.monotonic()
    for layer, plan in air.plans():
        fleet.start(layer, plan, place / "vehicle.log")
    air.compile()
    while not all(last_note(bus, f"ready.{layer}", "ready") for bus in air.buses for layer in LAYERS):
        if fleet.process is None or fleet.process.poll() is not None:
            raise OSError("the process of the learners died")
        time.sleep(0.1)
    warm_s = time.monotonic() - began
    epoch, late, ages, versions = time.monotonic(), 0, list[float](), [0] * len(air.loops)
    before = 0
    while air.tick * air.dt < SECONDS:
        sleep_until(epoch + air.tick * air.dt)
        air.fly()
        if air.tick * air.dt <= SETTLING_S:
            before = air.updates()
        for i, loop in enumerate(air.loops):
            version = loop.intake.newest.get("policy", 0)
            if version != versions[i] and air.tick * air.dt > SETTLING_S:
                ages += [age for _, half, _, age in list(loop.intake.swaps)[-2:] if half == "policy"][-1:]
            versions[i] = version
        behind = time.monotonic() - (epoch + air.tick * air.dt)
        late += behind > 0.0
        epoch += max(0.0, behind - air.dt)  # delay the simulation instead of skipping ticks
    if fallbacks := sum(loop.mode != Mode.POLICY for loop in air.loops):
        raise OSError(
            f"{fallbacks} of {len(air.loops)} vehicles were taken over by the guard: this machine is too busy"
        )
    return {
        "warm_s": warm_s,
        "updates_per_s": (air.updates() - before) / (SECONDS - SETTLING_S),
        "policies_per_s": len(ages) / (SECONDS - SETTLING_S),
        "swap_s": float(np.median(ages)) if ages else float("nan"),
        "worst_swap_s": max(ages, default=float("nan")),
        "steady_m": float(np.mean([loop.error for loop in air.loops])),
        "late": late,
        "ticks": air.tick,
    }


if __name__ == "__main__":
    main()
