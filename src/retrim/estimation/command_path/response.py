"""Compute the response of a second-order lag to a step of its command, as a function of time.

The transfer function is 1 / (1 + tau s + kappa tau^2 s^2): tau = 2 zeta / omega_n is the delay in following a
ramp, and kappa = 1 / (4 zeta^2). A first-order lag has kappa = 0. The coordinate ``ringing`` = kappa / (kappa + 1/2) =
1 / (1 + 2 zeta^2) covers all shapes in [0, 1): 0 is first order, 1/3 is critical damping.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

SMALLEST_KAPPA = 1e-3  # below it the second pole is a thousand times faster than the first
SMALLEST_ROOT = 1e-2  # root of |1 - 4 kappa|; nearer to critical damping, the two poles cancel in single precision
NARROW_WIDTH = 1e-4  # [s], width below which a mean is computed as a value
LONGEST = 60.0  # exponents beyond which the exponential is zero to rounding
SHARE_AT = np.linspace(0.0, 0.6, 7)
SHARE = np.array([1.0, 0.94, 0.88, 0.79, 0.70, 0.61, 0.56])  # share of the lag in lag + delay, first order


def ringing_of(damping: Any) -> Any:
    """Return the coordinate ``ringing`` of a damping ratio."""
    return 1.0 / (1.0 + 2.0 * damping**2)


def damping_of(ringing: Any) -> Any:
    """Return the damping ratio of the coordinate ``ringing``."""
    return jnp.sqrt(0.5 * (1.0 / jnp.maximum(ringing, SMALLEST_KAPPA) - 1.0))


def mean_step_response(
    t: Float[Array, "..."], width: Float[Array, ""], lag: Float[Array, "..."], ringing: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Return the mean of the step response over the ``width`` seconds that end at ``t``.

    Args:
        t: Time since the step [s]; the response before the step is zero.
        width: Length of the averaging interval [s]; zero for the value at ``t``.
        lag: Time constant tau [s].
        ringing: Shape of the response; see the module docstring.
    """
    value, integral = _step_and_ramp(t, lag, ringing)
    _, before = _step_and_ramp(t - width, lag, ringing)
    return jnp.where(width < NARROW_WIDTH, value, (integral - before) / jnp.maximum(width, NARROW_WIDTH))


def _step_and_ramp(
    t: Float[Array, "..."], lag: Float[Array, "..."], ringing: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return the step response and its integral; both poles are written so that no intermediate result overflows."""
    kappa = jnp.maximum(0.5 * ringing / (1.0 - ringing), SMALLEST_KAPPA)
    after = jnp.maximum(t, 0.0)
    root = jnp.maximum(jnp.sqrt(jnp.abs(1.0 - 4.0 * kappa)), SMALLEST_ROOT)
    slow, fast = 2.0 / (lag * (1.0 + root)), (1.0 + root) / (2.0 * kappa * lag)
    one, two = jnp.exp(-jnp.minimum(slow * after, LONGEST)), jnp.exp(-jnp.minimum(fast * after, LONGEST))
    ratio = slow / fast
    step = 1.0 - (one - ratio * two) / (1.0 - ratio)
    ramp = after - lag + (one / slow - ratio / fast * two) / (1.0 - ratio)
    decay = 1.0 / (2.0 * kappa * lag)
    phase = decay * root * after
    left, cos, sin = jnp.exp(-jnp.minimum(decay * after, LONGEST)), jnp.cos(phase), jnp.sin(phase) / root
    rung_step = 1.0 - left * (cos + sin)
    rung_ramp = after - lag + left * lag * (cos + (1.0 - 2.0 * kappa) * sin)
    rings = kappa > 0.25
    return jnp.where(rings, rung_step, step), jnp.where(rings, rung_ramp, ramp)


def first_order_equivalent(delay: Any, lag: Any, damping: Any) -> tuple[Any, Any]:
    """Return the delay and lag [s] of the first-order path with the step response nearest to a second-order path's.

    Both paths have the same sum of delay and lag. The share of the lag is fitted to minimise the squared difference
    between the step responses, for damping ratios from 0.3 to infinity.
    """
    ringing = ringing_of(damping)
    share = jnp.interp(ringing, *(jnp.asarray(x, ringing.dtype) for x in (SHARE_AT, SHARE)))
    return delay + (1.0 - share) * lag, share * lag
