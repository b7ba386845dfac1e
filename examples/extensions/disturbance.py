"""Disturbance: a thermal, air that rises around a vertical axis. `retrim fly --disturbance disturbance:thermal=2`."""

import equinox as eqx
import jax.numpy as jnp

import retrim


class Thermal(eqx.Module):
    speed: jnp.ndarray

    def __call__(self, t, x):
        rise = self.speed * jnp.exp(-jnp.sum(x.p[:2] ** 2))
        return retrim.ExternalEffects.of(x.p.dtype, wind=rise * jnp.array([0.0, 0.0, 1.0]))


def thermal(key, size):
    """Return the disturbance; the size is the speed of the air on the axis [m/s]."""
    return Thermal(jnp.array(2.0 if size is None else size))
