"""How a learner looks at the world it trains in: as it is, or in the frame of the gravity that is felt there."""

import abc
import dataclasses

import equinox as eqx
from jaxtyping import Array, Float

from ..control.gravity_frame import Capped, capped
from ..learn.env import Env
from ..physics.dynamics import Residual
from ..physics.state import Command, State


class AbstractView(eqx.Module):
    """The environment of an update; the policy is flown in the same coordinates."""

    @abc.abstractmethod
    def __call__(self, env: Env, residual: Residual) -> Env:
        """Return the corrected environment, as the policy sees it.

        Args:
            env: Task and nominal model.
            residual: What the nominal model misses, world frame [m/s^2].
        """


class WorldView(AbstractView):
    """The world as it is (the paper)."""

    def __call__(self, env: Env, residual: Residual) -> Env:
        """Add the residual to the model."""
        return env.with_residual(residual)


class GravityView(AbstractView):
    """The frame of the gravity that the vehicle feels, at each tick; see :mod:`retrim.control.gravity_frame`."""

    limit: Float[Array, ""]
    """Largest norm of the disturbance that turns the frame [m/s^2]."""

    def __call__(self, env: Env, residual: Residual) -> Env:
        """Add the residual to the model, and let the frame answer it."""
        return dataclasses.replace(env.with_residual(residual), felt=Capped(residual, self.limit))


class RestView(AbstractView):
    """The frame of the gravity that the vehicle feels at rest at home, everywhere: pictures of it can be remembered."""

    limit: Float[Array, ""]
    """Largest norm of the disturbance that turns the frame [m/s^2]."""

    def __call__(self, env: Env, residual: Residual) -> Env:
        """Add the residual to the model, and let the frame answer what it says at rest."""
        home = env.task.home()
        d = capped(residual(State.at(home), Command.hover(home.dtype)), self.limit)
        return dataclasses.replace(env.with_residual(residual), felt=Same(d))


class Same(eqx.Module):
    """The same disturbance whatever the state and the command."""

    d: Float[Array, "3"]
    """World [m/s^2]."""

    def __call__(self, x: State, u: Command) -> Float[Array, "3"]:
        """Return it."""
        return self.d
