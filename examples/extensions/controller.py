"""Controller: proportional-derivative control of position. `retrim fly --adapt controller:pd`."""

import jax.numpy as jnp

import retrim


class Pd(retrim.AbstractController):
    task: retrim.AbstractTask

    def init(self, x):
        return ()

    def __call__(self, memory, t, x):
        goal = self.task.setpoint(t)
        a = goal.a + 8.0 * (goal.p - x.p) + 4.0 * (goal.v - x.v)
        thrust = x.R.T @ (a + jnp.array([0.0, 0.0, 9.81]))
        return retrim.Command(thrust[2], jnp.array([-thrust[1], thrust[0], 0.0])), memory


pd = retrim.MethodEntry(lambda request: retrim.ControllerPilot(Pd(request.setup.flight_task)), "PD")
