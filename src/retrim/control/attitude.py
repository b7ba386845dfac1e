"""Conversion of a desired acceleration into a command."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics import so3
from ..physics.state import STANDARD_GRAVITY, Command, State
from ..tasks.abstract_reference import Point
from ..tasks.flatness import flat_command

LEAST_LIFT = 2.0  # [m/s^2], smallest upward part of a desired thrust; without it, the attitude is not defined
STEEPEST = 4.0  # tangent of the largest desired tilt, 76 degrees


def flyable(thrust: Float[Array, "3"]) -> Float[Array, "3"]:
    """Limit a thrust to directions to which a quadrotor can turn: upward, and tilted by at most 76 degrees.

    Args:
        thrust: Desired mass-normalised thrust, world [m/s^2].
    """
    up = jnp.maximum(thrust[2], LEAST_LIFT)
    sideways = jnp.sqrt(jnp.sum(thrust[:2] ** 2) + 1e-12)
    return jnp.append(thrust[:2] * jnp.minimum(1.0, STEEPEST * up / sideways), up)


def attitude_of(thrust: Float[Array, "3"], heading: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Return the attitude whose z axis lies along ``thrust`` and whose x axis points towards ``heading`` [rad]."""
    z = thrust / jnp.sqrt(jnp.sum(thrust * thrust))
    sideways = jnp.cross(z, jnp.stack([jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(heading)]))
    y = sideways / jnp.sqrt(jnp.sum(sideways * sideways))
    return jnp.stack([jnp.cross(y, z), y, z], axis=1)


def thrust_of(acceleration: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the mass-normalised thrust for an acceleration, in the world frame [m/s^2]."""
    return acceleration + jnp.array([0.0, 0.0, STANDARD_GRAVITY], dtype=acceleration.dtype)


def command_for(x: State, thrust: Float[Array, "3"], setpoint: Point, gain: Float[Array, "3"]) -> Command:
    """Return the command that turns a vehicle towards a thrust; the collective thrust is its part along the z axis.

    Args:
        x: State in which the command begins to act.
        thrust: Desired mass-normalised thrust, world [m/s^2].
        setpoint: Reference, which provides the heading and the attitude rate.
        gain: Body rate per radian of attitude error, about each body axis [1/s].

    Source:
        Lee, Leok and McClamroch 2010, at the level of body rates, with the rotation vector as the attitude error.
    """
    thrust = flyable(thrust)
    R = attitude_of(thrust, setpoint.heading)
    feed = flat_command(thrust, setpoint.jerk, setpoint.heading, setpoint.heading_rate)[1:]
    error = so3.mul(x.R.T, R)
    return Command(jnp.maximum(jnp.sum(thrust * x.R[:, 2]), 0.0), so3.act(error, feed) + gain * so3.log(error))
