"""Correct the command of a re-trained policy at the point where the vehicle should come to rest.

An update improves a policy over the next few seconds, but moves the policy's rest point by a millimetre, each time in a
different direction. The rest point does not need training: it is the point where the policy commands hover.
"""

import abc

import equinox as eqx
import jax.numpy as jnp

from ..control.lora import LoraPolicy
from ..control.policy import AbstractPolicy
from ..learn.env import Env
from ..learn.window import Window
from ..physics import so3
from ..physics.state import Command, State


class AbstractTrim(eqx.Module):
    """Correction of the command at rest after an update."""

    @abc.abstractmethod
    def __call__(self, policy: AbstractPolicy | LoraPolicy, env: Env, window: Window) -> AbstractPolicy | LoraPolicy:
        """Return the corrected policy.

        Args:
            policy: The re-trained policy.
            env: The corrected model in which the policy was trained.
            window: The flight for which the policy was trained.
        """


class NoTrim(AbstractTrim):
    """Leaves the policy unchanged (as in the paper)."""

    def __call__(self, policy: AbstractPolicy | LoraPolicy, env: Env, window: Window) -> AbstractPolicy | LoraPolicy:
        """Return the policy unchanged."""
        return policy


class RestTrim(AbstractTrim):
    """Shifts the policy's output so that it commands hover at rest at home, with the heading of the flight.

    In the frame of the effective gravity, this command keeps the vehicle there even under a disturbance. Use this trim
    for tasks in which the vehicle rests at home with any heading: the vehicle keeps its present heading.
    """

    def __call__(self, policy: AbstractPolicy | LoraPolicy, env: Env, window: Window) -> AbstractPolicy | LoraPolicy:
        """Return the shifted policy."""
        home, newest = env.task.home(), jnp.max(jnp.where(window.valid, jnp.arange(window.valid.shape[0]), 0))
        R = window.x.R[newest]
        hover = Command.hover(home.dtype)
        frame = env.frame(State.at(home), hover)
        if frame is not None:
            R = so3.mul(frame.Q, R)
        heading = jnp.arctan2(R[1, 0], R[0, 0])
        o = env.task.observation.at_rest(State(home, so3.rotz(heading), jnp.zeros_like(home)))
        return policy.shifted(-policy.merged().output(o))
