"""Computes the nominal model's error at each tick of a log."""

import jax
import jax.numpy as jnp
import numpy as np

from ..io.logs import FlightLog
from ..io.logs.on_one_clock import UP
from ..learn.residuals.targets import Targets
from ..physics.state import Command, State


def acting_commands(command: np.ndarray, dt: float, delay: float, lag: float) -> np.ndarray:
    """Return the mean of the acting command over each tick: delayed, then behind a first-order lag.

    Args:
        command: Command at each tick, (n,) or (n, columns).
        dt: Tick [s].
        delay: Delay [s]; it must not be negative.
        lag: Time constant [s]; zero disables the lag.
    """
    late = int(np.ceil(delay / dt - 1e-6))
    share = max(0.0, late - delay / dt)  # share of a tick in which the newer command already acts
    ticks = np.arange(len(command)) - late
    old, new = (command[np.clip(ticks + k, 0, len(command) - 1)] for k in (0, 1))
    if lag <= 0.0:
        return np.asarray((1.0 - share) * old + share * new)
    from scipy.signal import lfilter  # local, because it takes as long to import as all of retrim

    first, second = np.exp(-(1.0 - share) * dt / lag), np.exp(-share * dt / lag)
    weighted_mean = (1.0 - first) * second * old + (1.0 - second) * new
    end = lfilter([1.0], [1.0, -first * second], weighted_mean, axis=0, zi=first * second * command[:1])[0]
    begin = np.concatenate([command[:1], end[:-1]])
    between = old + (begin - old) * first
    lagged_command = (1.0 - share) * old + share * new
    left = (begin - old) * (1.0 - first) + (between - new) * (1.0 - second)
    return np.asarray(lagged_command + left * lag / dt)


def rows_of(log: FlightLog, *, delay: float = 0.0, lag: float = 0.0) -> Targets:
    """Return the rows for a residual fit: a_res = a - (c R e3 - g e3), the acceleration error of the point mass.

    Args:
        log: A flight. Without commanded body rates, the measured ones are used.
        delay: Delay between a command and its thrust [s].
        lag: Time constant of the thrust after the delay [s].

    Returns:
        One row per tick.
    """
    c = acting_commands(log.c, log.dt, delay, lag)
    rate_command = log.rates if log.command is None else log.command
    errors = log.a + UP - c[:, None] * log.R[:, :, 2]
    x = jax.vmap(State)(jnp.asarray(log.p), jnp.asarray(log.R), jnp.asarray(log.v))
    u = jax.vmap(Command)(jnp.asarray(c), jnp.asarray(rate_command))
    return Targets(x, u, jnp.asarray(errors), jnp.asarray(log.rates), jnp.asarray(log.valid))
