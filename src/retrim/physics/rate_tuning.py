"""Choose the gains of a simulated rate loop: the platform's gains if suitable, otherwise gains for the vehicle.

About an axis, motors with the time constant tau turn the body: tau w'' + w' = A (u + lead u'). The loop u = P e +
I int(e) - D w' has the characteristic polynomial tau s^3 + (1 + b + a lead) s^2 + (a + i lead) s + i, with a = A P,
i = A I and b = A D.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .state import STANDARD_GRAVITY
from .vehicle import Vehicle

LEAST_DAMPING, LEAST_MARGIN = 0.41, 2.7
"""Smallest damping and margin with the platform's gains; a loop that just reaches both overshoots by 40 %."""
DAMPING, MARGIN, LEAST_D = 0.8, 20.0, 2.0
"""Damping, margin and smallest derivative term of gains for the vehicle; such a loop overshoots by a tenth."""


class Gains(NamedTuple):
    """Gains in units of angular acceleration, per axis."""

    a: Float[Array, "3"]
    """Gain of the rate error [1/s]."""
    i: Float[Array, "3"]
    """Gain of the integral of the rate error [1/s^2]."""
    b: Float[Array, "3"]
    """Gain of the measured angular acceleration [-]."""


class Authority(NamedTuple):
    """Effect of the throttle on the rotation of a hovering vehicle, per axis."""

    alpha: Float[Array, "3"]
    """Angular acceleration A per unit of throttle [rad/s^2]."""
    lead: Float[Array, "3"]
    """Angular acceleration per unit of throttle rate, over A [s]: about yaw, the reaction of accelerating rotors."""


def authority(vehicle: Vehicle, coefficient: Float[Array, ""]) -> Authority:
    """Return the authority of a hovering vehicle.

    Args:
        vehicle: Vehicle constants.
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
    """Return, per axis, whether a loop has at least the smallest damping and the smallest margin.

    Args:
        gains: Gains of the loop.
        lead: Lead of the :class:`Authority` [s].
        tau: Motor time constant [s].
        least_margin: Smallest margin, as a multiple of that at the limit of stability; it should be larger for an
            integral that does not pause.
    """
    a, i, b = gains
    damping = 1.0 + b + a * lead
    ratio = damping / (2.0 * jnp.sqrt(a * tau))
    margin = damping * (a + i * lead) / (tau * i)  # Routh: stable above 1
    return (ratio >= LEAST_DAMPING) & (margin >= least_margin)


def tune(gains: Gains, tau: Float[Array, ""]) -> Gains:
    """Return gains from the motor time constant.

    The damping is 0.8; the integral does not change the damping.

    Args:
        gains: Gains of the platform. The result's derivative term is not smaller than the platform's, and its ratio of
            integral gain to error gain is not larger.
        tau: Motor time constant [s].
    """
    b = jnp.maximum(gains.b, LEAST_D)
    a = (1.0 + b) ** 2 / (4.0 * DAMPING**2 * tau)
    return Gains(a, jnp.minimum(gains.i / gains.a, (1.0 + b) / (MARGIN * tau)) * a, b)
