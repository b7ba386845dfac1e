"""A simulated vehicle whose motors are commanded by a firmware, in steps of a few milliseconds."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ...physics.bem import BemQuadrotor, BemState
from ...physics.disturbance import Disturbance
from ...physics.motors import CommandedSpeeds
from ...physics.so3 import rotz
from ...physics.state import STANDARD_GRAVITY, Command, State
from ...physics.substep import SUBSTEP

Advance = Callable[[BemState, np.ndarray, float], tuple[BemState, Array]]
"""Maps a state, motor commands from 0 to 1 and the time [s] to the next state, and to the position, attitude, velocity,
body rates and specific force [21]."""


def place_at_rest(model: BemQuadrotor, x: State) -> BemState:
    """Return a vehicle with spinning rotors; the leaves have the types that a step returns."""
    s: BemState = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), model.init(x))
    return s


def compile_step(model: BemQuadrotor, disturbance: Disturbance, *, substeps: int = 1, floor: bool = False) -> Advance:
    """Compile a step of the world.

    Args:
        model: The vehicle; its rate controller is not used.
        disturbance: External effects, as a function of time and state.
        substeps: Length of a step [ms].
        floor: Whether a vehicle below z = 0 is put back on the floor, level and at rest.
    """
    vehicle, hover = model.vehicle, Command.hover()

    def substep(s: BemState, motors: Float[Array, "4"], t: Float[Array, ""]) -> BemState:
        speeds = jnp.clip(vehicle.esc.speed(motors), vehicle.motor_min, vehicle.motor_max)
        model_at_speeds = BemQuadrotor(vehicle, CommandedSpeeds(speeds, model.loop.thrust_map), model.dt)
        after = model_at_speeds.substep(s, hover, disturbance(t, model.state(s)))
        return _stand(after) if floor else after

    @jax.jit
    def advance(s: BemState, motors: Float[Array, "4"], t: Float[Array, ""]) -> tuple[BemState, Array]:
        def tick(s: BemState, k: Array) -> tuple[BemState, None]:
            return substep(s, motors, t + SUBSTEP * k), None

        after = lax.scan(tick, s, jnp.arange(substeps, dtype=t.dtype))[0]
        x, rotors = model.state(after), model.rotor_state(after)
        gravity = jnp.array([0.0, 0.0, STANDARD_GRAVITY], x.v.dtype)
        specific_force = x.R.T @ ((x.v - model.state(s).v) / (substeps * SUBSTEP) + gravity)
        return after, jnp.concatenate([x.p, x.R.reshape(9), x.v, rotors.omega, specific_force])

    dtype: Any = jnp.result_type(float)

    def step(s: BemState, motors: np.ndarray, t: float) -> tuple[BemState, Array]:
        result: tuple[BemState, Array] = advance(s, motors.astype(dtype), np.asarray(t, dtype))
        return result

    s = place_at_rest(model, State.at(jnp.array([0.0, 0.0, 1.0])))
    for _ in range(2):  # compile before the flight, also for the types that a step returns
        s, output = step(s, np.full(4, 0.3), 0.0)
    jax.block_until_ready(output)
    return step


def _stand(s: BemState) -> BemState:
    """Return the state above the floor; a vehicle below it is level and at rest on the floor."""
    x = s.body.x
    is_below = x.p[2] < 0.0
    on_floor = State(x.p.at[2].set(0.0), rotz(jnp.arctan2(x.R[1, 0], x.R[0, 0])), jnp.zeros_like(x.v))
    bodies = (on_floor, jnp.zeros_like(s.body.omega)), (x, s.body.omega)
    body = jax.tree.map(lambda standing, free: jnp.where(is_below, standing, free), *bodies)
    result: BemState = eqx.tree_at(lambda each: (each.body.x, each.body.omega), s, body)
    return result
