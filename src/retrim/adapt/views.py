"""How a learner looks at the world it trains in: as it is, or in the frame of the gravity that is felt there."""

import abc
import dataclasses

import equinox as eqx
from jaxtyping import Array, Float

from ..control.gravity_frame import Capped, capped
from ..learn.env import Env
from ..learn.residuals.model import FittedResidual
from ..learn.residuals.rates import RateFit
from ..physics.actuators import Lagged, RateBiased
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
        """Add the residual to the model, which turns as the vehicle was seen to turn."""
        return as_it_turns(env, turning_of(residual)).with_residual(residual)


class GravityView(AbstractView):
    """The frame of the gravity that the vehicle feels, at each tick; see :mod:`retrim.control.gravity_frame`."""

    limit: Float[Array, ""]
    """Largest norm of the disturbance that turns the frame [m/s^2]."""

    def __call__(self, env: Env, residual: Residual) -> Env:
        """Add the residual to the model, and let the frame answer it, and a bias of the rates."""
        env = with_lag(env, turning_of(residual))
        return dataclasses.replace(env.with_residual(residual), felt=Capped(residual, self.limit))


class RestView(AbstractView):
    """The frame of the gravity that the vehicle feels at rest at home, everywhere: pictures of it can be remembered."""

    limit: Float[Array, ""]
    """Largest norm of the disturbance that turns the frame [m/s^2]."""

    def __call__(self, env: Env, residual: Residual) -> Env:
        """Add the residual to the model; the frame answers what it says at rest, and leaves a bias of the rates."""
        home = env.task.home()
        d = capped(residual(State.at(home), Command.hover(home.dtype)), self.limit)
        env = as_it_turns(env, turning_of(residual))
        return dataclasses.replace(env.with_residual(residual), felt=Same(d))


def turning_of(residual: Residual) -> RateFit | None:
    """Return what was learnt of how the vehicle turns, if something was."""
    return residual.turning if isinstance(residual, FittedResidual) else None


def with_lag(env: Env, found: RateFit | None) -> Env:
    """Return the environment with the lag that was identified, if it has a lag and one was.

    It is that of the rates; thrust comes from the same motors, and has that of roll and pitch in the model.
    """
    if found is None or not isinstance(env.dynamics, Lagged):
        return env
    response = dataclasses.replace(env.dynamics.response, thrust_lag=found.tau[0], rate_lag=found.tau)
    return dataclasses.replace(env, dynamics=Lagged(env.dynamics.base, response))


def as_it_turns(env: Env, found: RateFit | None) -> Env:
    """Return the environment with the lag and the bias of the rates that were identified, if they were."""
    env = with_lag(env, found)
    return env if found is None else dataclasses.replace(env, dynamics=RateBiased(env.dynamics, found.bias))


class Same(eqx.Module):
    """The same disturbance whatever the state and the command."""

    d: Float[Array, "3"]
    """World [m/s^2]."""

    def __call__(self, x: State, u: Command) -> Float[Array, "3"]:
        """Return it."""
        return self.d
