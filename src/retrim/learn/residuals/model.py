"""Interface between the online learner and a model of the residual acceleration."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
from jaxtyping import Array, Float, Key

from ...physics.state import Command, State
from .rates import RateFit
from .targets import Targets


@runtime_checkable
class ResidualModel(Protocol):
    """A model of the residual. It is an ``eqx.Module`` that holds settings; the learned parameters are its *state*.

    Every method is pure and traceable. The state is a pytree of arrays with fixed shapes. A model that also identifies
    the bias and lag of the body rates has a method ``turning``, which maps its state to a
    :class:`~retrim.learn.residuals.rates.RateFit`. A model that quantifies its uncertainty has a method ``spread``,
    which takes the arguments of ``predict`` and returns one standard deviation per axis [m/s^2]. A model with a part
    that depends on position has a method ``at_place``, which maps its state and a position [m] to this part [m/s^2]. A
    model that remembers over flights has a method ``recall``, which maps the state at the end of a flight to the state
    at the start of the next one, and a method ``strength``, which returns the largest acceleration in a state [m/s^2].
    A model for a vehicle with a load on a cable has a method ``load``, which maps its state to the estimated
    :class:`~retrim.estimation.slung_load.Load`; in flight, the frame of the effective gravity then compensates a load.
    """

    def init(self, key: Key[Array, ""]) -> Any:
        """Return the state before the first fit; this state must predict zero. The key is consumed."""
        ...

    def fit(self, state: Any, rows: Targets) -> tuple[Any, Float[Array, ""]]:
        """Fit to ``rows``, starting from ``state``.

        Returns:
            The new state, and the root mean square of the error over the valid rows [m/s^2].
        """
        ...

    def predict(self, state: Any, x: State, u: Command) -> Float[Array, "3"]:
        """Return the predicted residual acceleration in the world frame [m/s^2]."""
        ...


class FittedResidual(eqx.Module):
    """A residual model with its state: a function of (x, u), as required by :class:`retrim.physics.Hybrid`."""

    model: ResidualModel
    state: Any

    @property
    def turning(self) -> RateFit | None:
        """Identified bias and lag of the body rates; None for a model of the acceleration alone."""
        turning: Callable[[Any], RateFit] | None = getattr(self.model, "turning", None)
        return None if turning is None else turning(self.state)

    @property
    def place(self) -> "PlaceResidual | None":
        """Part of the residual that depends on position; None for a model without such a part."""
        return PlaceResidual(self.model, self.state) if hasattr(self.model, "at_place") else None

    def __call__(self, x: State, u: Command) -> Float[Array, "3"]:
        """Return the predicted residual acceleration in the world frame [m/s^2]."""
        return self.model.predict(self.state, x, u)


class PlaceResidual(eqx.Module):
    """The part of a fitted residual that depends on position, as a function of the position."""

    model: Any
    state: Any

    def __call__(self, p: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the acceleration at a position, world [m/s^2]; ``p`` is in the world frame [m]."""
        a: Array = self.model.at_place(self.state, p)
        return a
