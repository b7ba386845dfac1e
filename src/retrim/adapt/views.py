"""Coordinates in which a learner trains the policy: those of the world frame, or of the effective-gravity frame."""

import abc
import dataclasses

import equinox as eqx
from jaxtyping import Array, Float

from ..control.gravity_frame import ConstantResidual, NormLimited, limit_norm
from ..learn.env import Env
from ..learn.residuals.model import FittedResidual
from ..learn.residuals.rates import RateFit
from ..physics.actuators import LaggedModel, RateBiasedModel
from ..physics.dynamics import Residual
from ..physics.state import Command, State


class AbstractView(eqx.Module):
    """Provides the environment of an update; the policy flies in the same coordinates."""

    @abc.abstractmethod
    def __call__(self, env: Env, residual: Residual) -> Env:
        """Return the corrected environment, in the coordinates of the policy.

        Args:
            env: Task and nominal model.
            residual: Residual acceleration of the nominal model, world frame [m/s^2].
        """


class WorldView(AbstractView):
    """The coordinates of the world (as in the paper)."""

    def __call__(self, env: Env, residual: Residual) -> Env:
        """Add the residual, and the identified lag and bias of the body rates, to the model."""
        return as_it_turns(env, turning_of(residual)).with_residual(residual)


class GravityView(AbstractView):
    """The frame of the effective gravity at each tick; see :mod:`retrim.control.gravity_frame`."""

    limit: Float[Array, ""]
    """Largest norm of the disturbance that turns the frame [m/s^2]."""

    def __call__(self, env: Env, residual: Residual) -> Env:
        """Add the residual to the model; the controller compensates for it (with the frame) and for a rate bias."""
        env = with_lag(env, turning_of(residual))
        if env.task.observation.previews_residual:
            return dataclasses.replace(env.with_residual(residual), task=env.task.with_residual(residual))
        return dataclasses.replace(env.with_residual(residual), frame_disturbance=NormLimited(residual, self.limit))


class RestView(AbstractView):
    """The frame of the effective gravity at rest at home, for every state; a constant frame keeps old images valid."""

    limit: Float[Array, ""]
    """Largest norm of the disturbance that turns the frame [m/s^2]."""

    def __call__(self, env: Env, residual: Residual) -> Env:
        """Add the residual to the model; the frame compensates for its value at rest, but not for a rate bias."""
        home = env.task.home()
        d = limit_norm(residual(State.at(home), Command.hover(home.dtype)), self.limit)
        env = as_it_turns(env, turning_of(residual))
        return dataclasses.replace(env.with_residual(residual), frame_disturbance=ConstantResidual(d))


def turning_of(residual: Residual) -> RateFit | None:
    """Return the identified bias and lag of the body rates; None if the residual model does not identify them."""
    return residual.turning if isinstance(residual, FittedResidual) else None


def with_lag(env: Env, fit: RateFit | None) -> Env:
    """Return the environment with the identified lag, if its model has a lag and one was identified.

    The identified lag is that of the rates. In the model, thrust has the lag of roll and pitch, since the same motors
    generate it.
    """
    if fit is None or not isinstance(env.dynamics, LaggedModel):
        return env
    response = dataclasses.replace(env.dynamics.response, thrust_lag=fit.tau[0], rate_lag=fit.tau)
    return dataclasses.replace(env, dynamics=LaggedModel(env.dynamics.base, response))


def as_it_turns(env: Env, fit: RateFit | None) -> Env:
    """Return the environment with the identified lag and bias of the rates, if they were identified."""
    env = with_lag(env, fit)
    return env if fit is None else dataclasses.replace(env, dynamics=RateBiasedModel(env.dynamics, fit.bias))
