"""Motion of a load below a vehicle on a given path, and the inputs of a load filter."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from retrim.physics import SlungLoad, State

DT, H = 0.02, 1e-3


class Rows(eqx.Module):
    """Ticks of a flight (leading axis)."""

    missed: jax.Array
    """Mean acceleration that a model without the load misses, world [m/s^2]."""
    p: jax.Array
    """Position at the start of the tick [m]."""
    before: jax.Array
    """Velocity at the start of the tick [m/s]."""
    v: jax.Array
    """Velocity at the end of the tick [m/s]."""
    thrust: jax.Array
    """Mean mass-normalised thrust [m/s^2]."""
    direction: jax.Array
    """Direction of the load at the end of the tick."""
    pull: jax.Array
    """Mean acceleration of the vehicle by the cable, world [m/s^2]."""


def seconds(n, step=DT):
    """Return the times of ``n`` steps [s]."""
    return jnp.asarray(step * np.arange(n), jnp.zeros(()).dtype)


def path(t):
    """Return a position of an irregular motion within about a metre."""
    waves = ((1.3, 0.0, 0.5), (2.9, 1.0, 0.2), (4.1, 2.0, 0.06))
    side = lambda k: sum(a * jnp.sin(w * t + p + k) for w, p, a in waves)  # noqa: E731
    return jnp.stack([side(0.0), side(2.0), 1.0 + 0.3 * jnp.sin(1.7 * t)])


@partial(jax.jit, static_argnums=1)
def rows(load, ticks, push, drag, noise=0.0, key=None):
    """Return the rows of a flight along the path, with a push [m/s^2] and a drag [1/s] outside the model."""
    speed, level = jax.jacfwd(path), jnp.eye(3)

    def substep(s, t):
        effects, s = load.advance(s, t, State(path(t), level, speed(t)), H)
        r = s.p - path(t + H)
        return s, (effects.push, r / jnp.linalg.norm(r))

    n = round(DT / H)
    times = seconds(ticks * n, H)
    zero = times[0]
    start = load.init(State(path(zero), level, speed(zero)))
    pulls, directions = lax.scan(substep, start, times)[1]
    pull = pulls.reshape(ticks, n, 3).mean(axis=1)
    v = jax.vmap(speed)(seconds(ticks + 1))
    p = jax.vmap(path)(seconds(ticks))
    middle = jax.vmap(speed)(seconds(ticks) + 0.5 * DT)
    missed = pull + push[None] - drag * middle
    if key is not None:
        missed = missed + noise * jax.random.normal(key, missed.shape)
    a = jnp.diff(v, axis=0) / DT
    thrust = a - missed + jnp.array([[0.0, 0.0, 9.81]])
    return Rows(missed, p, v[:-1], v[1:], thrust, directions[n - 1 :: n], pull)


def flight(share, length=0.5, ticks=500, push=(0.3, -0.2, 0.4), drag=0.3, key=None, noise=0.0, **changes):
    """Return the rows of a flight with a load."""
    load = SlungLoad.of(share, length=length, **changes)
    return rows(load, ticks, jnp.array(push), jnp.array(drag), jnp.array(noise), key)


def angle_between(a, b):
    """Return the angle between unit vectors [rad]."""
    return np.arccos(np.clip(np.sum(np.asarray(a) * np.asarray(b), axis=-1), -1.0, 1.0))
