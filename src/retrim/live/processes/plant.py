"""Process of a simulated plant. The plant runs in wall-clock time, like a vehicle."""

import contextlib
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...config.scenario import Scenario
from ...errors import MessageError, PlantError
from ...onboard.commands import wait_for_take_off
from ...onboard.messages import Sample, Setpoint, pack_note
from ...onboard.realtime import ParentWatch, be_punctual, sleep_until
from ...onboard.tick_budget import SHARE
from ...physics.state import Command
from ...plants.plant import Measurement, as_numpy
from ...runkit.compile_cache import enable_compile_cache
from ...runkit.flying import FLOOR
from ...transport.bus import Bus
from ...transport.shared_memory import SharedMemoryBus
from ..operator.manual_disturbance import ManualDisturbance, PlantWithKnobs
from ..states import state_of, vector_of

SUPERVISOR_TIMEOUT = 5.0  # [s] without a command, after which a plant without a supervisor ends
CRASHED = "crashed"
"""Reason for the end of a flight without a landing."""


@dataclass(frozen=True)
class PlantPlan:
    """Arguments of the process."""

    folder: Path
    scenario: Scenario
    vehicle: Any
    """Vehicle used in training: a name or a specification."""
    x0: np.ndarray
    """Initial state: p, R by rows and v."""
    dt: float
    seed: int
    cores: frozenset[int]
    priority: int
    parent: int


def simulate(plan: PlantPlan) -> None:
    """Simulate until the flight ends; this is the main function of the process."""
    jax.config.update("jax_cpu_enable_async_dispatch", False)  # compute each tick synchronously, without a thread pool
    enable_compile_cache()
    bus, parent = SharedMemoryBus(plan.folder), ParentWatch(plan.parent)
    x0 = state_of(plan.x0, jnp.zeros(0).dtype)
    try:
        with plan.scenario.make(plan.vehicle, dt=plan.dt, seed=plan.seed) as plant:
            knob_plant = PlantWithKnobs(plant, plan.scenario.make_disturbance(plan.vehicle, seed=plan.seed))
            for load in (0.0, 0.01):  # compile and run every program
                plant.reset(x0)
                knob_plant.turn(ManualDisturbance(load=load))
                for _ in range(5):
                    knob_plant.step(Command.hover(x0.p.dtype))
            knob_plant.turn(ManualDisturbance())
            measurement = plant.reset(x0)
            refusals = be_punctual(plan.priority, set(plan.cores))
            bus.publish("ready.plant", pack_note("ready", refused=refusals))
            epoch = wait_for_take_off(bus, parent)
            if epoch is None:
                return
            reason = _fly(plan, knob_plant, bus, parent, measurement, epoch)
    except PlantError as error:
        reason = f"plant lost: {error}"
    bus.publish("ended", pack_note("ended", reason=reason))


def _fly(
    plan: PlantPlan, plant: PlantWithKnobs, bus: Bus, parent: ParentWatch, measurement: Measurement, epoch: float
) -> str:
    """Simulate the flight; return the reason for its end."""
    tick, late, holds, silent_ticks, knob_version = 0, 0, 0, 0, 0
    u = accepted_command = as_numpy(Command.hover()).astype(float)
    while True:
        sleep_until(epoch + tick * plan.dt)
        now = time.monotonic()
        sample = Sample(
            tick,
            measurement.t,
            now,
            measurement.age,
            vector_of(measurement.x),
            vector_of(measurement.true_state),
            accepted_command,
        )
        bus.publish("sample", sample.pack())
        if not np.isfinite(sample.truth).all() or sample.truth[2] < FLOOR:
            return CRASHED
        setpoint = answer(bus, tick, epoch + (tick + SHARE) * plan.dt)
        silent_ticks = 0 if setpoint is not None else silent_ticks + 1
        if setpoint is None:
            holds += 1  # like a vehicle, keep the last command
            if silent_ticks * plan.dt > SUPERVISOR_TIMEOUT and parent.has_ended():
                return "no commands arrive, and the supervisor is gone"
        elif setpoint.is_final:
            return setpoint.ending(float(sample.truth[2]))
        else:
            u = setpoint.u
        if (message := bus.latest("knobs", knob_version)) is not None:
            knob_version = message.version
            with contextlib.suppress(MessageError):
                plant.turn(ManualDisturbance.unpack(message.data))
        dtype = measurement.x.p.dtype
        measurement, accepted_u = plant.step(Command(jnp.asarray(u[0], dtype), jnp.asarray(u[1:], dtype)))
        accepted_command, tick = as_numpy(accepted_u).astype(float), tick + 1
        behind = time.monotonic() - (epoch + tick * plan.dt)
        if behind > 0:
            late += 1
            epoch += max(0.0, behind - plan.dt)  # the simulation falls behind rather than skipping time
        if tick % 25 == 0:
            bus.publish("world", pack_note("world", late=late, held=holds, knobs_refused=plant.refusal))


def answer(bus: Bus, tick: int, until: float) -> Setpoint | None:
    """Return the setpoint from control or the fallback for a tick; None if no setpoint arrives by ``until`` [s]."""
    while True:
        for topic in ("setpoint", "fallback"):
            message = bus.latest(topic)
            if message is None:
                continue
            try:
                result = Setpoint.unpack(message.data)
            except MessageError:
                continue
            if result.tick == tick or result.is_final:
                return result
        if time.monotonic() >= until:
            return None
        time.sleep(3e-4)
