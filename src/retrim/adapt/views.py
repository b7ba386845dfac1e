"""How a learner looks at the world it trains in: as it is, or in the frame of the gravity that is felt there."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..control.gravity_frame import tilted, turned
from ..learn.env import Env
from ..learn.window import Window
from ..physics import so3
from ..physics.actuators import Trimmed
from ..physics.dynamics import Residual
from ..physics.state import Command, State


class AbstractView(eqx.Module):
    """A change of coordinates for training; the policy is flown in the same ones."""

    @abc.abstractmethod
    def __call__(self, env: Env, residual: Residual, window: Window) -> tuple[Env, Window]:
        """Return the corrected environment and the flown window, as the policy sees them.

        Args:
            env: Task and nominal model.
            residual: What the nominal model misses, world frame [m/s^2].
            window: Ticks of flight.
        """


class WorldView(AbstractView):
    """The world as it is (the paper)."""

    def __call__(self, env: Env, residual: Residual, window: Window) -> tuple[Env, Window]:
        """Add the residual to the model."""
        return env.with_residual(residual), window


class GravityView(AbstractView):
    """The frame of the gravity that a vehicle feels at the goal; see :mod:`retrim.control.gravity_frame`.

    What the residual predicts at rest at the goal is gravity there; only what differs from it is left to learn.
    """

    pivot: Float[Array, "3"]
    """The goal: the frame is turned about it, world [m]."""
    limit: Float[Array, ""]
    """Largest norm of the disturbance that turns the frame [m/s^2]."""

    def __call__(self, env: Env, residual: Residual, window: Window) -> tuple[Env, Window]:
        """Turn the residual and the window about the goal."""
        d = residual(State.at(self.pivot), Command.hover())
        d = d * jnp.minimum(1.0, self.limit / jnp.sqrt(jnp.sum(d * d) + 1e-12))
        Q, extra = tilted(d)
        x = jax.vmap(lambda x: turned(Q, self.pivot, x))(window.x)
        u = jax.vmap(lambda u: Command(u.c - extra, u.omega))(window.u)
        trimmed = Env(Trimmed(env.dynamics, extra), env.task, env.delay_ticks)
        return trimmed.with_residual(TurnedResidual(residual, d, self.pivot)), Window(window.t, x, u, window.valid)


class TurnedResidual(eqx.Module):
    """A residual in the frame of g + ``d``, less what that frame answers by itself.

    Eq. (1) with this residual and |g + d| - |g| more thrust (``Trimmed``), in the turned frame, is Eq. (1) with the
    original one in the world frame, exactly.
    """

    residual: Residual
    d: Float[Array, "3"]
    """Constant disturbance that turns the frame, world [m/s^2]."""
    pivot: Float[Array, "3"]

    def __call__(self, x: State, u: Command) -> Float[Array, "3"]:
        """Return the residual acceleration, turned frame [m/s^2].

        Args:
            x: State in the turned frame.
            u: Command of the policy, without the correction of the thrust.
        """
        Q, extra = tilted(self.d)
        missed = self.residual(turned(Q.T, self.pivot, x), Command(u.c + extra, u.omega))
        excess = extra * jnp.array([0.0, 0.0, 1.0], dtype=x.p.dtype)  # of gravity, in the turned frame
        return so3.act(Q, missed - self.d) - excess
