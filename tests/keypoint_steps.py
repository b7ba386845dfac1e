"""Compiled steps of an observation of keypoints, and states and commands with which points stay in view."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import random

from retrim.physics import Command, PointMass, State, so3

begin = eqx.filter_jit(lambda o, x: o.init(x))
step = eqx.filter_jit(lambda x, u: PointMass(0.02).step(x, u, jnp.zeros(3)))
see = eqx.filter_jit(lambda o, memory, x, last: o(memory, jnp.array(0.0), x, last))
rotation = jax.jit(so3.exp)
pixels_of = eqx.filter_jit(lambda o, x: o.pixels(x))


def near_state():
    """Return a state with all points visible for a while."""
    return State(jnp.array([0.05, -0.1, 1.1]), jnp.eye(3), jnp.array([0.1, 0.2, -0.05]))


def small_commands(key, n):
    draws = jax.jit(jax.vmap(lambda k: (random.normal(k, ()), random.normal(k, (3,)))))(random.split(key, n))
    return [
        Command(jnp.asarray(9.81 + 0.5 * c), jnp.asarray(0.3 * w)) for c, w in zip(*map(np.asarray, draws), strict=True)
    ]
