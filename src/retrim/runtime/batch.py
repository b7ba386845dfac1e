"""A whole flight of a simulated plant as one program, for many flights at once without learning."""

from typing import Any

import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Key

from ..control.controller import AbstractController
from ..physics.disturbance import Disturbance
from ..physics.state import Command, State
from ..physics.substep import AbstractSubstepDynamics
from ..plants.sensors import SensorModel
from ..plants.sim import SimState, advance, launch, measured_state


def batch_flight(
    model: AbstractSubstepDynamics[Any],
    disturbance: Disturbance,
    controller: AbstractController[Any],
    x0: State,
    *,
    ticks: int,
    delay_s: float = 0.02,
    sensors: SensorModel | None = None,
    key: Key[Array, ""] | None = None,
) -> tuple[State, Command]:
    """Fly one vehicle; ``jax.vmap`` or ``lax.map`` this over starts.

    The physics is the same, tick for tick, as flying :class:`retrim.SimPlant` with a
    :class:`retrim.ControllerPilot`. A flight never terminates.

    Args:
        model: The vehicle.
        disturbance: External effects.
        controller: What flies.
        x0: State at the start.
        ticks: Length of the flight.
        delay_s: Command delay [s], a whole number of milliseconds.
        sensors: None: every measurement is exact.
        key: Noise of the sensors; consumed.

    Returns:
        The true state at the end of each tick, and the command issued for it (leading time axis).

    Raises:
        ValueError: There are sensors but no key.
    """
    if sensors is not None and key is None:
        raise ValueError("batch_flight: sensors need a key")
    base = random.key(0) if key is None else key

    def tick(carry: tuple[SimState, Any], k: Array) -> tuple[tuple[SimState, Any], tuple[State, Command]]:
        s, memory = carry
        u, memory = controller(memory, s.t, measured_state(s))
        s = advance(model, disturbance, delay_s, sensors, s, u, random.fold_in(base, k))
        return (s, memory), (model.state(s.model), u)

    first = launch(model, delay_s, sensors, x0, base)
    start = first, controller.init(measured_state(first))
    _, flown = lax.scan(tick, start, jnp.arange(ticks))
    return flown
