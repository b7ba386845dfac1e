"""The command path that a log shows, by the estimator that flies."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..estimation.command_path import PathEstimate, PathEstimator, PathState
from ..io.logs import FlightLog
from ..physics.state import STANDARD_GRAVITY, Command, State

MEMORY = 1e4  # [s]: the vehicle of a log is one vehicle
BATCH = 5  # ticks from one estimate to the next: each one says how noisy the next measurements are


def path_of_log(log: FlightLog) -> PathEstimate:
    """Return what attitudes and velocities of a log say of the command path.

    The body rates of a log are not used: they are often those that the attitude filter of the autopilot has smoothed.

    Args:
        log: A flight. Without commanded body rates only the thrust is known.
    """
    n = BATCH * (len(log.t) // BATCH)
    omega = np.zeros_like(log.v) if log.command is None else log.command
    # A tick that is not part of the flight has a time that does not follow the one before it.
    t = np.where(log.valid, log.t, log.t + 0.5 * log.dt)
    columns = (t, log.p, log.R, log.v, np.nan_to_num(log.c, nan=STANDARD_GRAVITY), np.nan_to_num(omega))
    rows = tuple(jnp.asarray(x[:n].reshape(-1, BATCH, *x.shape[1:]), jnp.float32) for x in columns)
    return _estimate(PathEstimator.of(log.dt, memory=MEMORY), rows)


@eqx.filter_jit
def _estimate(estimator: PathEstimator, rows: tuple[jax.Array, ...]) -> PathEstimate:
    def tick(s: PathState, row: tuple[jax.Array, ...]) -> tuple[PathState, None]:
        t, p, R, v, c, omega = row
        return estimator.issued(estimator.measured(s, t, State(p, R, v)), Command(c, omega)), None

    def batch(s: PathState, part: tuple[jax.Array, ...]) -> tuple[PathState, None]:
        return estimator.estimated(jax.lax.scan(tick, s, part)[0]), None

    first = State(*(row[0, 0] for row in rows[1:4]))
    end: PathState = jax.lax.scan(batch, estimator.init(first), rows)[0]
    return end.estimate
