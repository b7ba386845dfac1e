"""Plant: a point mass with drag and a constant push. `retrim fly --plant plant:toy`."""

import jax.numpy as jnp

import retrim


class Toy(retrim.Plant):
    def __init__(self, dt):
        self.dt, self.model, self.x = dt, retrim.PointMass(dt), None

    def reset(self, x0):
        self.t, self.x = 0.0, retrim.State.at(jnp.array([0.0, 0.0, 1.0])) if x0 is None else x0
        return retrim.Measurement(self.t, self.x)

    def step(self, u):
        retrim.check_command(u, "Toy")
        if self.x is None:
            raise retrim.PlantError("Toy: not flying; call reset first")
        self.t, self.x = self.t + self.dt, self.model.step(self.x, u, jnp.array([1.0, -1.5, 0.5]) - 0.3 * self.x.v)
        return retrim.Measurement(self.t, self.x), u

    def stop(self):
        self.x = None


def toy(request):
    return Toy(request.dt)
