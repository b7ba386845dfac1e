"""Gains of a simulated rate loop: those of the platform where they suit the vehicle, else gains that follow from it.

About an axis, motors of time constant tau turn the body: tau w'' + w' = A (u + lead u'). The loop u = P e + I int(e) -
D w' leaves tau s^3 + (1 + b + a lead) s^2 + (a + i lead) s + i, with a, i, b = A P, A I, A D.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .state import STANDARD_GRAVITY
from .vehicle import Vehicle

LEAST_DAMPING, LEAST_MARGIN = 0.41, 2.7
"""Of the platform's gains: they overshoot by 40 % where a loop just has both."""
DAMPING, MARGIN, LEAST_D = 0.8, 20.0, 2.0
"""Of gains that follow from the vehicle: they overshoot by a tenth."""


class Gains(NamedTuple):
    """Gains in units of angular acceleration, per axis."""

    a: Float[Array, "3"]
    """Of the rate error [1/s]."""
    i: Float[Array, "3"]
    """Of its integral [1/s^2]."""
    b: Float[Array, "3"]
    """Of the measured angular acceleration [-]."""


class Authority(NamedTuple):
    """What throttle turns a hovering vehicle by, per axis."""

    alpha: Float[Array, "3"]
    """A: angular acceleration per throttle [rad/s^2]."""
    lead: Float[Array, "3"]
    """Angular acceleration for a rate of throttle, over A [s]: the reaction of rotors that speed up, about yaw."""


def authority(vehicle: Vehicle, coefficient: Float[Array, ""]) -> Authority:
    """Return the authority of a vehicle that hovers.

    Args:
        vehicle: Its constants.
        coefficient: True T / Omega^2 of one rotor [N s^2].
    """
    hover = jnp.sqrt(vehicle.mass * STANDARD_GRAVITY / (4.0 * coefficient))
    throttle, h = vehicle.esc.throttle(hover), 1e-3
    slope = (vehicle.esc.speed(throttle + h) - vehicle.esc.speed(throttle - h)) / (2.0 * h)
    levers = jnp.stack([vehicle.arm[1], vehicle.arm[0], vehicle.torque_ratio])
    alpha = 8.0 * coefficient * hover * slope * levers / vehicle.inertia
    spin = 4.0 * vehicle.rotor_inertia * slope / vehicle.inertia[2]
    return Authority(alpha, jnp.zeros(3, dtype=alpha.dtype).at[2].set(spin / alpha[2]))


def is_damped(
    gains: Gains, lead: Float[Array, "3"], tau: Float[Array, ""], *, least_margin: float = LEAST_MARGIN
) -> Bool[Array, "3"]:
    """Return, per axis, whether a loop has the least damping and the least margin.

    Args:
        gains: Its gains.
        lead: As that of an :class:`Authority` [s].
        tau: Time constant of the motors [s].
        least_margin: How many times as large as at the limit of stability: more for an integral that never pauses.
    """
    a, i, b = gains
    damping = 1.0 + b + a * lead
    ratio = damping / (2.0 * jnp.sqrt(a * tau))
    margin = damping * (a + i * lead) / (tau * i)  # Routh: stable above 1
    return (ratio >= LEAST_DAMPING) & (margin >= least_margin)


def tuned(gains: Gains, tau: Float[Array, ""]) -> Gains:
    """Return gains that follow from the motors: damping 0.8, and an integral that does not disturb it.

    Args:
        gains: The platform's; the D term is never less, nor the ratio of integral and error more.
        tau: Time constant of the motors [s].
    """
    b = jnp.maximum(gains.b, LEAST_D)
    a = (1.0 + b) ** 2 / (4.0 * DAMPING**2 * tau)
    return Gains(a, jnp.minimum(gains.i / gains.a, (1.0 + b) / (MARGIN * tau)) * a, b)
