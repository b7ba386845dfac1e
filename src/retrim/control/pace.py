"""Largest pace along a reference that the model of a vehicle permits.

The path ahead is evaluated at the present pace. For each instant, the largest factor by which the pace may change
follows from four limits:

    thrust      |factor^2 a + g - d| is at most the largest thrust: a quadratic equation in factor^2; d is the expected
                disturbance,
    lift        the thrust vector has an upward component,
    body rates  the rates, with the lead that a slow rate loop needs, are at most the largest rates,
    corners     the vehicle absorbs a jump of the velocity within a given distance of the corner.

A factor at the instant tau bounds the relative growth of the pace by log(factor) / tau. The smallest bound decides, so
the vehicle brakes for a narrow part of the path before it arrives there.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.state import STANDARD_GRAVITY
from ..tasks.abstract_reference import AbstractReference, Point
from ..tasks.paced_reference import Clock, at_pace

STEP, STEPS = 0.04, 25  # [s], interval between the instants ahead, and their number
SHORTEST_ADAPTATION = 0.1  # [s], shortest time within which the pace adapts to a limit
LEAST_LIFT = 3.0  # [m/s^2]: with less upward thrust, the attitude turns fast for small changes of the path
LEAST_FACTOR, LARGEST_FACTOR = 0.05, 20.0  # limits of a factor
TINY = 1e-9


class PaceLimits(eqx.Module):
    """Limits that a flight along a reference must not exceed."""

    thrust: Float[Array, ""]
    """Largest mass-normalised thrust [m/s^2]."""
    rates: Float[Array, "3"]
    """Largest body rates [rad/s]."""
    lag: Float[Array, "3"]
    """Time constants with which the body rates follow their commands [s]."""
    corner: Float[Array, ""]
    """Largest distance between the vehicle and a corner of the path [m]."""
    turning: Float[Array, ""]
    """Acceleration with which the vehicle turns at a corner [m/s^2]."""


def points_ahead(reference: AbstractReference, clock: Clock) -> tuple[Float[Array, " n"], Point]:
    """Return instants of the next second and the points of a reference at these instants, at the present pace.

    Args:
        reference: Reference as a function of the phase.
        clock: Present phase and pace.

    Returns:
        Times from now [s], and points with a leading axis.
    """
    tau = STEP * jnp.arange(STEPS + 1, dtype=clock.phase.dtype)
    points = jax.vmap(reference)(clock.phase + clock.pace * tau)
    return tau, jax.vmap(at_pace, (0, None, None))(points, clock.pace, jnp.zeros_like(clock.pace))


def largest_growth(tau: Float[Array, " n"], factors: Float[Array, " n"], share: Float[Array, ""]) -> Float[Array, ""]:
    """Return the largest relative growth of the pace for which no instant exceeds its factor [1/s].

    Args:
        tau: Times from now [s].
        factors: Largest factors of the pace at these times.
        share: Share of each factor that is used.
    """
    return jnp.min(jnp.log(share * factors) / jnp.maximum(tau, SHORTEST_ADAPTATION))


def largest_factors(
    points: Point, limits: PaceLimits, d: Float[Array, "n 3"], step: float | Float[Array, ""] = STEP
) -> Float[Array, " n"]:
    """Return, for each point of a path, the largest factor by which the pace may change.

    Args:
        points: Points at the present pace, with a leading axis.
        limits: Limits of the vehicle.
        d: Expected disturbance at the points, world [m/s^2].
        step: Time between the points [s].
    """
    by_force = jnp.sqrt(jnp.minimum(*_forces(points, limits, d)))
    # The yaw rate that keeps the nose in its direction on a tilted path is not limited: it affects only the heading.
    rates = jnp.concatenate([points.u[:, 1:3], points.heading_rate[:, None]], axis=1)
    lead = jnp.abs(rates) + limits.lag[None] * jnp.abs(jnp.asarray(jnp.gradient(rates, axis=0))) / step
    by_rates = 1.0 / jnp.sqrt(jnp.max(lead / limits.rates[None], axis=1) + TINY)
    smooth = 0.5 * (points.a[1:] + points.a[:-1]) * step
    jumps = jnp.sqrt(jnp.sum((jnp.diff(points.v, axis=0) - smooth) ** 2, axis=1) + TINY)
    # A vehicle that turns with the acceleration a cuts a jump of the velocity by jump^2 / (8 a).
    by_corners = jnp.sqrt(8.0 * limits.turning * limits.corner) / jnp.append(jumps, jumps[-1])
    return jnp.clip(jnp.minimum(jnp.minimum(by_force, by_rates), by_corners), LEAST_FACTOR, LARGEST_FACTOR)


def _forces(points: Point, limits: PaceLimits, d: Float[Array, "n 3"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return the squares of the factors at which the thrust reaches its limit and the lift its least value."""
    up = jnp.array([[0.0, 0.0, STANDARD_GRAVITY]], dtype=d.dtype) - d
    square = jnp.sum(points.a**2, axis=1) + TINY
    along = jnp.sum(points.a * up, axis=1)
    room = limits.thrust**2 - jnp.sum(up**2, axis=1)
    thrust = (jnp.sqrt(jnp.maximum(along**2 + square * room, 0.0)) - along) / square
    sinking = jnp.maximum(-points.a[:, 2], TINY)
    return jnp.maximum(thrust, 0.0), jnp.maximum(up[:, 2] - LEAST_LIFT, 0.0) / sinking
