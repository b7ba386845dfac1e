"""Fly a simulated plant as one program. The code handles one vehicle; use ``jax.vmap`` for many."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Int

from ..control.condition import Condition
from ..control.controller import AbstractController
from ..control.vehicle_report import VehicleReport
from ..physics.state import Command, State, where
from ..plants.sim import SimState, Simulation
from ..tasks.paced_reference import Clock


class InFlight(eqx.Module):
    """State of a flight between two ticks."""

    sim: SimState
    memory: Any
    """Memory of the controller."""
    tick: Int[Array, ""]
    """Number of ticks so far."""


class Ticks(eqx.Module):
    """Record of a flight, with a leading time axis: one row per tick."""

    true: State
    """True state at the end of the tick."""
    measured: State
    """Measured state at the end of the tick."""
    issued: Command
    """Command that the controller issued."""
    accepted: Command
    """Command that the plant accepted for the tick."""
    condition: Condition | None
    """Condition of the controller after its command; None for a controller that never steps back."""
    vehicle: VehicleReport | None = None
    """Vehicle that the controller has identified; None for a controller that does not identify the vehicle."""
    clock: Clock | None = None
    """Clock of the reference; None for a controller whose reference follows the flight time."""


def take_off(simulation: Simulation, controller: AbstractController[Any], x0: State) -> InFlight:
    """Return a flight that begins at ``x0``."""
    sim = simulation.launch(x0)
    return in_flight(controller, sim, simulation.measure(sim))


def in_flight(controller: AbstractController[Any], sim: SimState, measurement: State) -> InFlight:
    """Return a flight in a simulation that has already been launched.

    Args:
        controller: The controller.
        sim: State of the simulation.
        measurement: Measured state of the vehicle.
    """
    return InFlight(sim, controller.init(measurement), jnp.array(0))


def fly_ticks(
    simulation: Simulation,
    controller: AbstractController[Any],
    flight: InFlight,
    ticks: Int[ArrayLike, ""],
    *,
    room: int,
) -> tuple[InFlight, Ticks]:
    """Continue one vehicle's flight for a number of ticks.

    The controller may differ from the previous one if its memory has the same structure. The physics matches, tick for
    tick, that of a :class:`retrim.SimPlant` with a :class:`retrim.ControllerPilot`. A flight never terminates early.

    Args:
        simulation: The simulated plant.
        controller: The controller.
        flight: The flight so far.
        ticks: Number of ticks to fly; it may be traced.
        room: Number of rows to return; rows beyond ``ticks`` are zero.

    Returns:
        The flight after these ticks, and their record.
    """

    controller = controller.with_age(simulation.age)

    def tick(flight: InFlight) -> tuple[InFlight, Ticks]:
        s, k = flight.sim, flight.tick
        inertial = simulation.inertial(s, k)
        now = controller if inertial is None else controller.with_inertial(*inertial)
        command, memory = now(flight.memory, simulation.time(k, s.a.dtype), simulation.measure(s))
        accepted_command = simulation.within_limits(command)
        is_limited = jnp.any(accepted_command.vector() != command.vector())
        memory = where(is_limited, controller.accept(memory, accepted_command), memory)
        s, condition = simulation.advance(s, accepted_command, k), controller.condition(memory)
        vehicle, clock = controller.vehicle(memory), controller.clock(memory)
        return InFlight(s, memory, k + 1), Ticks(
            simulation.true(s), simulation.measure(s), command, accepted_command, condition, vehicle, clock
        )

    def step(i: Array, carry: tuple[InFlight, Ticks]) -> tuple[InFlight, Ticks]:
        flight, row = tick(carry[0])
        return flight, jax.tree.map(lambda whole, new: whole.at[i].set(new), carry[1], row)

    x = simulation.true(flight.sim)
    u = Command.hover(x.p.dtype)
    memory = flight.memory
    row = Ticks(x, x, u, u, controller.condition(memory), controller.vehicle(memory), controller.clock(memory))
    blank = jax.tree.map(lambda leaf: jnp.zeros((room, *leaf.shape), leaf.dtype), row)
    result: tuple[InFlight, Ticks] = lax.fori_loop(0, ticks, step, (flight, blank))
    return result


def batch_flight(simulation: Simulation, controller: AbstractController[Any], x0: State, *, ticks: int) -> Ticks:
    """Fly one vehicle from its start; apply ``jax.vmap`` or ``lax.map`` for many vehicles, starts or policies.

    Args:
        simulation: The simulated plant, e.g. that of a :class:`retrim.SimPlant`.
        controller: The controller.
        x0: State at the start.
        ticks: Length of the flight [ticks].
    """
    return fly_ticks(simulation, controller, take_off(simulation, controller, x0), ticks, room=ticks)[1]
