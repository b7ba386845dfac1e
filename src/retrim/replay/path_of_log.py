"""Identifies the command path of a log with the in-flight estimator."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ..estimation.command_path import PathEstimate, PathEstimator, PathState
from ..io.logs import FlightLog
from ..physics.state import STANDARD_GRAVITY, Command, State

MEMORY = 1e4  # [s]: the vehicle does not change during a log
BATCH = 5  # ticks between two estimates; each estimate sets the noise level for the next measurements


def path_of_log(log: FlightLog) -> PathEstimate:
    """Return the command path estimated from the attitudes and velocities of a log.

    The measured body rates in a log are not used, because the autopilot's attitude filter has often smoothed them.

    Args:
        log: A flight. Without commanded body rates, only the thrust is identified.
    """
    n = BATCH * (len(log.t) // BATCH)
    omega = np.zeros_like(log.v) if log.command is None else log.command
    # At ticks outside the flight, the time is made discontinuous.
    t = np.where(log.valid, log.t, log.t + 0.5 * log.dt)
    columns = (t, log.p, log.R, log.v, np.nan_to_num(log.c, nan=STANDARD_GRAVITY), np.nan_to_num(omega))
    room = BATCH << (n // BATCH - 1).bit_length()  # a power of two, so that logs of similar lengths share a program
    padded_columns = [np.pad(x[:n], [(0, room - n), *[(0, 0)] * (x.ndim - 1)]) for x in columns]
    rows = tuple(jnp.asarray(x.reshape(-1, BATCH, *x.shape[1:]), jnp.float32) for x in padded_columns)
    return _estimate(PathEstimator.of(log.dt, memory=MEMORY), rows, jnp.array(n // BATCH))


@eqx.filter_jit
def _estimate(estimator: PathEstimator, rows: tuple[jax.Array, ...], count: Int[Array, ""]) -> PathEstimate:
    def tick(s: PathState, row: tuple[jax.Array, ...]) -> tuple[PathState, None]:
        t, p, R, v, c, omega = row
        return estimator.issue(estimator.observe(s, t, State(p, R, v)), Command(c, omega)), None

    def batch(k: Int[Array, ""], s: PathState) -> PathState:
        return estimator.estimate_path(jax.lax.scan(tick, s, tuple(x[k] for x in rows))[0])

    first = State(*(row[0, 0] for row in rows[1:4]))
    end: PathState = jax.lax.fori_loop(0, count, batch, estimator.init(first))
    return end.estimate
