"""A minimal controller, plan and supervisor for tests of live flight."""

import os
import time
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from live_processes import DT, HOME, DrillPlan
from retrim.config.setup import Setup
from retrim.control import AbstractController
from retrim.live.processes.controllers import _source, plain_source
from retrim.live.spec import LiveSpec
from retrim.live.supervisor import Supervisor
from retrim.onboard.guard import UP, G, Limits
from retrim.onboard.plan import ControlPlan
from retrim.physics import Command, State
from retrim.physics.dynamics import f_a

LOW, HIGH = np.array([0.0, -6.0, -6.0, -2.0]), np.array([30.0, 6.0, 6.0, 2.0])
TOPICS = {"sample": 4096, "setpoint": 4096, "fallback": 4096, "order": 4096, "ended": 4096, "status": 65536,
          "flight": 300_000, "fallback.flight": 300_000, "parameters.policy": 300_000,
          "parameters.residual": 100_000, "learning": 4096, "learner.residual": 8192,
          "learner.policy": 8192}  # fmt: skip


class HoverController(AbstractController[Float[Array, ""]]):
    """A controller that holds a position with two gains and counts its ticks."""

    gains: Float[Array, "2"] = eqx.field(default_factory=lambda: jnp.array([4.0, 3.5]))
    home: tuple[float, ...] = eqx.field(default=tuple(HOME.tolist()), static=True)

    def init(self, x: State) -> Float[Array, ""]:
        return jnp.zeros_like(x.p[0])

    def __call__(self, memory, t, x):
        a = self.gains[0] * (jnp.asarray(self.home, x.p.dtype) - x.p) - self.gains[1] * x.v
        force = a + G * jnp.asarray(UP, x.p.dtype)
        d = x.R.T @ force / jnp.sqrt(force @ force)
        rates = 8.0 * jnp.stack([-d[1], d[0], jnp.zeros_like(d[0])])
        return Command(force @ x.R[:, 2], rates), memory + 1.0


def setup() -> Setup:
    return Setup.from_preset("hover/retrim")


def plan(controller, *, folder=Path(), parent=0, window=50, delay_ticks=1, seconds=1e9, **limits) -> ControlPlan:
    box = Limits(np.array([-3.0, -3.0, -0.3]), np.array([3.0, 3.0, 4.0]), LOW, HIGH, **limits)
    return ControlPlan(folder, controller, box, DT, delay_ticks, window, seconds, frozenset({0}), 20, parent)


def hover_source(gains=(4.0, 3.5), *, fit_result=False, home=HOME):
    """Return the programs of the hover controller; ``fit_result`` adds a residual part without effect."""
    if not fit_result:
        return plain_source(setup(), HoverController(jnp.array(gains), tuple(map(float, home))))
    arrays, fixed = eqx.partition(HoverController(jnp.array(gains), tuple(map(float, home))), eqx.is_array)
    parameters = {"policy": arrays, "residual": {"fit": jnp.array(0.0)}}

    def predict(parameters, inputs):
        return f_a(*inputs, jnp.zeros(3)).v + 0.0 * parameters["residual"]["fit"]

    return _source(setup(), lambda result: eqx.combine(result["policy"], fixed), predict, parameters)


class DrillSupervisor(Supervisor):
    """A supervisor whose roles with a function of ``live_processes`` have the plan of a drill."""

    def _plan(self, role):
        if self.spec.mains.get(role, "").startswith("live_processes:"):
            return DrillPlan(self.bus.folder, os.getpid(), role, self.spec.x0, self.spec.controller.base)
        return super()._plan(role)


def supervise(spec: LiveSpec) -> None:
    """Run a flight until its end; as the function of a process, it is a supervisor that a test can kill."""
    with DrillSupervisor(spec) as flight:
        for _ in flight.warm_up():
            pass
        flight.take_off()
        while flight.watch().end_reason is None:
            time.sleep(0.02)
