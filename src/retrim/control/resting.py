"""A policy that commands hover at its rest point, whatever it observes in addition to the state."""

import dataclasses
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics import so3
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import Command, State
from .controller import PolicyController


class RestingController(PolicyController):
    """Subtracts a policy's output at rest at home, with the present heading, from its output.

    A policy for many vehicles has a different rest point for each belief. The shift moves the rest point to home, as
    :class:`~retrim.adapt.trim.RestTrim` does after an update.
    """

    home: Float[Array, "3"]
    """Position at which the vehicle rests [m]."""

    def __call__(
        self, memory: tuple[Any, Command], t: Float[Array, ""], x: State
    ) -> tuple[Command, tuple[Any, Command]]:
        """Evaluate the observation and the policy once, and the policy also at rest."""
        heading = jnp.arctan2(x.R[1, 0], x.R[0, 0])
        home = self.home.astype(x.p.dtype)
        o = self.observation.at_rest(State(home, so3.rotz(heading), jnp.zeros_like(home)))
        inner = PolicyController(self.observation, self.policy.shifted(-self.policy.output(o)))
        return inner(memory, t, x)

    def in_frame(self, frame: EffectiveGravityFrame) -> "RestingController":
        """Return the same policy with observation and home in ``frame``."""
        return dataclasses.replace(self, observation=self.observation.in_frame(frame), home=frame.vector(self.home))
