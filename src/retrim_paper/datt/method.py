"""DATT as a flight method."""

import jax.numpy as jnp

from retrim.config.baselines import prediction_of
from retrim.config.methods import MethodEntry, MethodRequest
from retrim.config.setup import Setup
from retrim.control.baselines import L1_POLE
from retrim.errors import ConfigError
from retrim.estimation.l1 import L1Estimator
from retrim.runtime.pilot import ControllerPilot, Pilot

from .controller import DattController, DattNet
from .problem import MAX_DISTURBANCE

ESTIMATOR = 0.5  # [s], time constant of the filter; the DATT authors use 2 s


def datt_of(setup: Setup, net: DattNet) -> DattController:
    """Return the controller for a trained DATT network."""
    dt, vehicle = setup.preset.dt, setup.vehicle
    estimator = L1Estimator(jnp.array(L1_POLE), jnp.exp(jnp.array(-dt / ESTIMATOR)), dt)
    return DattController(
        net,
        setup.flight_task,
        prediction_of(setup),
        estimator,
        jnp.array(MAX_DISTURBANCE),
        vehicle.command_min,
        vehicle.command_max,
    )


def _pilot(request: MethodRequest) -> Pilot:
    if not isinstance(request.policy, DattNet):
        raise ConfigError("method 'datt' has its own network: `retrim reproduce hover --methods datt` trains it")
    return ControllerPilot(request.by_state(datt_of(request.setup, request.policy), "datt"))


entry = MethodEntry(_pilot, "DATT")
