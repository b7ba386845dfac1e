"""The task and the declared command path of a set-up, for controllers without a policy."""

from typing import TYPE_CHECKING

from jax import random
from jaxtyping import Array, Key

from ..control.baselines import BaselineRequest
from ..estimation.prediction import Prediction
from ..physics.actuator_response import ActuatorResponse
from ..physics.command_path import CommandPath
from .command_paths import ACTUATOR_LAG, declared_path, lag_of

if TYPE_CHECKING:
    from .setup import Setup


def baseline_request(setup: "Setup", key: Key[Array, ""] | None = None) -> BaselineRequest:
    """Return the request of a baseline for the flight of a set-up.

    Args:
        setup: Set-up of the flight.
        key: Random key, consumed; None for a fixed key.
    """
    key = random.key(0) if key is None else key
    return BaselineRequest(setup.flight_task, setup.vehicle, prediction_of(setup), slowness(setup), key)


def prediction_of(setup: "Setup") -> Prediction:
    """Return the nominal model of the set-up's vehicle."""
    path = declared_path(setup.preset, setup.vehicle)
    if lag_of(setup.preset, setup.vehicle) is None:
        path = CommandPath(path.delay, ActuatorResponse.of(ACTUATOR_LAG, ACTUATOR_LAG))
    return Prediction.of(path, setup.preset.dt)


def slowness(setup: "Setup") -> float:
    """Return the ratio of command delay plus rate lag to the same sum in the tuning search; at least 1."""
    path = declared_path(setup.preset, setup.vehicle)
    delay, lag = float(path.delay), float(path.response.rate_lag[0])
    return max(1.0, (delay + lag) / (delay + ACTUATOR_LAG))
