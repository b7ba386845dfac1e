"""The acceleration that the nominal model misses in a window of flight (paper, Sec. III-D)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...physics import so3
from ...physics.dynamics import AbstractDynamics
from ...physics.state import Command, State
from ..window import Window

ROUNDING = 0.01  # ticks, rounding error of an age that is a whole number of ticks


class Targets(eqx.Module):
    """Rows of a residual fit: inputs, the acceleration that the model misses, and a mask of the rows that count."""

    x: State
    """State at the start of each tick (leading axis n)."""
    u: Command
    """Command *acting* during the tick (leading axis n)."""
    a_res: Float[Array, "n 3"]
    """Missed acceleration in the world frame [m/s^2]."""
    omega: Float[Array, "n 3"]
    """Mean body rates of the vehicle over the tick [rad/s]."""
    valid: Bool[Array, " n"]


def residual_targets(
    window: Window,
    nominal: AbstractDynamics[Any],
    *,
    delay_ticks: int = 0,
    a_gt: Float[Array, "n 3"] | None = None,
    consistent: Bool[Array, " steps"] | None = None,
) -> Targets:
    """Compute a_res = a_gt - a_hat for each tick.

    a_gt is the forward difference of velocity over the tick; a_hat is that of the nominal model from the same state.
    Both result from the command that was acting, accepted ``delay_ticks`` plus the measurement's age earlier.

    A row does not count if its time step, or a step between its command and the row, is not one tick long (a gap in the
    measurements). Nor does it count while the model's hidden state (an actuator lag) still depends on the assumed hover
    start.

    Args:
        window: n ticks of flight.
        nominal: The analytical model.
        delay_ticks: Declared command delay of the plant [ticks].
        a_gt: Measured accelerations, the mean over the tick that begins in each row, world [m/s^2]; by default the
            differences of velocity.
        consistent: Whether each of the n - 1 steps from one measurement to the next is usable for learning; None if all
            of them are.

    Returns:
        n - 1 - ``delay_ticks`` rows.

    Raises:
        ValueError: The window is too short for the delay.
    """
    n = window.valid.shape[0]
    rows = n - 1 - delay_ticks
    if rows < 1:
        raise ValueError(f"a window of {n} ticks is too short for a delay of {delay_ticks} ticks")
    x = jax.tree.map(lambda leaf: leaf[delay_ticks : delay_ticks + rows], window.x)
    v_next = window.x.v[delay_ticks + 1 :]
    u, before, is_complete = _acting(window, rows, delay_ticks, nominal.dt)

    def tick(s: Any, row: tuple[State, Command, Float[Array, "3"]]) -> tuple[Any, Float[Array, "3"]]:
        x, u, v_next = row
        after = nominal.step(nominal.with_state(s, x), u, jnp.zeros_like(x.p))  # keeps hidden state, such as a lag
        return after, (v_next - nominal.state(after).v) / nominal.dt

    first = nominal.init(jax.tree.map(lambda leaf: leaf[0], x))
    if a_gt is not None:
        v_next = x.v + nominal.dt * a_gt[delay_ticks : delay_ticks + rows]
    _, a_res = lax.scan(tick, first, (x, u, v_next))
    omega = jax.vmap(_turn_between)(x.R, window.x.R[delay_ticks + 1 :]) / nominal.dt
    has_settled = _mark_settled(window, nominal.settling_ticks)[:rows]
    valid = is_complete & _regular(window, nominal.dt, delay_ticks, before) & has_settled
    if consistent is not None:
        valid &= consistent[delay_ticks : delay_ticks + rows]
        a_res = jnp.where(
            valid[:, None], a_res, 0.0
        )  # a row that is not finite must not enter a sum, even with weight 0
    return Targets(x, u, a_res, omega, valid)


def _acting(
    window: Window, rows: int, delay_ticks: int, dt: float
) -> tuple[Command, Int[Array, " rows"], Bool[Array, " rows"]]:
    """Return the mean command over the tick of each measurement, its first row, and whether the window contains it.

    If the age of the measurements is not a whole number of ticks, two commands share a tick.
    """
    if window.age is None:
        first: Command = jax.tree.map(lambda leaf: leaf[:rows], window.u)
        return first, jnp.arange(rows), window.valid[:rows]
    ticks = jnp.arange(rows, dtype=window.t.dtype)
    at = ticks - window.age[delay_ticks : delay_ticks + rows] / dt
    since = jnp.maximum(at, 0.0)
    whole = jnp.floor(since)
    before, share = whole.astype(int), since - whole

    def mix(leaf: Array) -> Array:
        weight = share.reshape(-1, *(1,) * (leaf.ndim - 1)).astype(leaf.dtype)
        return (1.0 - weight) * leaf[before] + weight * leaf[before + 1]

    acting: Command = jax.tree.map(mix, window.u)
    return acting, before, (at > -ROUNDING) & window.valid[before]


def _turn_between(before: Float[Array, "3 3"], after: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return the rotation vector from one attitude to another, in the body frame [rad]."""
    return so3.log(so3.mul(before.T, after))


def _regular(window: Window, dt: float, delay_ticks: int, before: Int[Array, " rows"]) -> Bool[Array, " rows"]:
    """Return whether all steps from a row's command to its next velocity are one tick long, within a quarter tick.

    Steps are checked on the clock of commands and at the times at which the states were true. The command of an old
    measurement is found at row ``before`` by counting rows, so every step from that row on must be regular.
    """
    one_tick = jnp.abs(jnp.diff(window.t) - dt) < 0.25 * dt
    if window.age is not None:
        one_tick &= jnp.abs(jnp.diff(window.t - window.age) - dt) < 0.25 * dt
    others = jnp.concatenate([jnp.zeros(1, int), jnp.cumsum((~one_tick).astype(int))])
    return others[delay_ticks + 1 :] == others[before]


def _mark_settled(window: Window, ticks: int | Float[Array, ""]) -> Bool[Array, " n"]:
    """Return whether at least ``ticks`` valid ticks precede this one in the window."""
    return jnp.cumsum(window.valid.astype(window.t.dtype)) > ticks
