"""Task: hold a height with the nose to the north. `retrim pretrain task:task`."""

import jax.numpy as jnp

import retrim


class Height(retrim.AbstractTask):
    observation: retrim.StateObs
    dt: float = 0.02
    horizon: int = 100

    def home(self):
        return jnp.array([0.0, 0.0, 2.0])

    def reward(self, t, x, u):
        away = x.p - self.home()
        return -jnp.sqrt(away @ away + 0.01) - 0.1 * x.v @ x.v - 0.1 * u.omega @ u.omega - x.R[1, 0] ** 2


def task(request):
    return Height(request.state_observation(), request.preset.dt, request.preset.pretrain.horizon)
