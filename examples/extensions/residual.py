"""Residual model: a constant acceleration. `retrim fly --residual residual:constant`."""

import equinox as eqx
import jax.numpy as jnp


class Constant(eqx.Module):
    def init(self, key):
        return jnp.zeros(3)

    def fit(self, state, rows):
        weight = rows.valid[:, None] / jnp.maximum(jnp.sum(rows.valid), 1)
        mean = jnp.sum(weight * rows.a_res, axis=0)
        return mean, jnp.sqrt(jnp.sum(weight * (rows.a_res - mean) ** 2))

    def predict(self, state, x, u):
        return state


def constant(request):
    return Constant()
