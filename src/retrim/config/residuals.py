"""Registry of residual models."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp

from ..errors import ConfigError
from ..learn.residuals.ensemble import EnsembleModel
from ..learn.residuals.layered import LayeredModel
from ..learn.residuals.linear import LinearModel
from ..learn.residuals.model import ResidualModel
from ..learn.residuals.place import PlaceModel
from ..learn.residuals.regression import BLOCK, RegressionModel
from ..learn.residuals.swing import SwingModel
from ..physics.vehicle import Vehicle
from .command_paths import lag_of
from .presets import Preset
from .registry import Registry


@dataclass(frozen=True)
class ResidualRequest:
    """The inputs from which a residual model is built."""

    preset: Preset
    vehicle: Vehicle


RESIDUALS: Registry[Callable[[ResidualRequest], ResidualModel]] = Registry(
    "residual",
    example="module:name",
    expected="a function of a ResidualRequest",
    accepts=lambda thing: callable(thing) or isinstance(thing, ResidualModel),
)
register_residual = RESIDUALS.register


def make_residual(request: ResidualRequest) -> ResidualModel:
    """Build the residual model of a preset.

    Raises:
        ConfigError: The name does not exist, or the object is not a residual model.
    """
    name = request.preset.adapt.residual
    result = RESIDUALS.find(name)
    model = result if isinstance(result, ResidualModel) and not isinstance(result, type) else result(request)
    if not isinstance(model, ResidualModel):
        raise ConfigError(f"residual {name!r} returns {type(model).__name__} without init, fit and predict")
    return model


SMALL = (32, 32)  # widths of an ensemble that learns only the error of a closed form and runs in every burst


def _ensemble(request: ResidualRequest, hidden: tuple[int, ...] = (128, 128)) -> EnsembleModel:
    a = request.preset.adapt
    return EnsembleModel(
        jnp.array(request.preset.goal),
        request.vehicle.omega_max,
        jnp.array(a.fit_learning_rate),
        jnp.array(a.spectral_weight),
        steps=a.fit_steps,
        hidden=hidden,
    )


def _regression(request: ResidualRequest) -> RegressionModel:
    p, a, v = request.preset, request.preset.adapt, request.vehicle
    limits, lag = (v.command_min, v.command_max), lag_of(p, v)
    roll, pitch, yaw = (0.03,) * 3 if lag is None else lag.omega.tolist()
    return RegressionModel.of(p.dt, memory=a.memory, thrust_prior=a.thrust_prior, tau=(roll, pitch, yaw), limits=limits)


def _make_layered(request: ResidualRequest) -> ResidualModel:
    p, least = request.preset, BLOCK * request.preset.dt
    if p.adapt.fit_every < least:
        raise ConfigError(
            f"adapt.residual = 'layered' is evaluated on the {BLOCK} newest ticks, outside its fits: "
            f"adapt.fit_every = {p.adapt.fit_every:g} s must be at least {least:g} s"
        )
    return LayeredModel(_regression(request), _ensemble(request, SMALL))


def _place(request: ResidualRequest) -> PlaceModel:
    p = request.preset
    return PlaceModel.of(_regression(request), p.dt, every=p.adapt.fit_every)


def _swing(request: ResidualRequest) -> SwingModel:
    return SwingModel(_regression(request), request.preset.dt, request.preset.adapt.fit_every)


def _linear(request: ResidualRequest) -> LinearModel:
    return LinearModel.of(request.preset.dt, every=request.preset.adapt.fit_every)


register_residual("ensemble", _ensemble)
register_residual("regression", _regression)
register_residual("layered", _make_layered)
register_residual("linear", _linear)
register_residual("place", _place)
register_residual("swing", _swing)
