"""The trim: what a re-trained policy commands where the vehicle should come to rest.

An update makes a policy better over the next seconds, and moves the point where it comes to rest by a millimetre, every
time another way. That point needs no training: it is where the policy commands hover.
"""

import abc

import equinox as eqx
import jax.numpy as jnp

from ..control.lora import LoraPolicy
from ..control.policy import Policy
from ..learn.env import Env
from ..learn.window import Window
from ..physics import so3
from ..physics.state import Command, State


class AbstractTrim(eqx.Module):
    """What is done to the command at rest after an update."""

    @abc.abstractmethod
    def __call__(self, policy: Policy | LoraPolicy, env: Env, window: Window) -> Policy | LoraPolicy:
        """Return the policy that flies.

        Args:
            policy: The re-trained policy.
            env: The corrected model in which it was trained.
            window: The flight that it was trained for.
        """


class Untrimmed(AbstractTrim):
    """Nothing is done (the paper)."""

    def __call__(self, policy: Policy | LoraPolicy, env: Env, window: Window) -> Policy | LoraPolicy:
        """Return the policy as it was trained."""
        return policy


class RestTrim(AbstractTrim):
    """The policy's output is shifted so that at rest at home, with the heading of the flight, it commands hover.

    In the frame of the gravity that is felt, that command keeps the vehicle there under a disturbance, too. It is for
    tasks that rest at home and leave the heading free: at the heading that it has, the vehicle stays.
    """

    def __call__(self, policy: Policy | LoraPolicy, env: Env, window: Window) -> Policy | LoraPolicy:
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
