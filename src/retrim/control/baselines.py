"""Classical baseline controllers, which receive the declared delay, lag and limits of the vehicle.

``retrim reproduce tuning`` tuned their settings on separate pushes, starts and seeds: once for a measured state and
once for a pose estimated from keypoints. See docs/results/tuning.md and tuning_keypoints.md.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Key

from ..estimation.l1 import L1Estimator
from ..estimation.prediction import Prediction
from ..physics.vehicle import Vehicle
from ..tasks.task import AbstractTask
from .controller import AbstractController
from .geometric import Gains, GeometricController
from .indi import IndiController
from .mppi import MppiController

INTEGRAL_LIMIT = 6.0  # [m/s^2]: same as the largest disturbance that the policies' observer compensates
HORIZON = 0.8  # [s]: MPPI horizon
L1_POLE = -0.2  # [1/s], as in the hardware flights of DATT; its size matters little if it is small compared to 1 / dt

Settings = Mapping[str, float]


@dataclass(frozen=True)
class BaselineRequest:
    """The inputs from which a baseline is built."""

    task: AbstractTask
    """Task of the flight."""
    vehicle: Vehicle
    """Vehicle with the command limits."""
    prediction: Prediction
    """Nominal model of the vehicle, with its declared command path."""
    slowness: float
    """Ratio of command delay plus rate lag to the same sum in the tuning search; at least 1."""
    key: Key[Array, ""]
    """Random key; consumed."""


@dataclass(frozen=True)
class Baseline:
    """A controller without a policy, its settings, and their search ranges."""

    label: str
    """Name used in tables."""
    make: Callable[[BaselineRequest, Settings], AbstractController[Any]]
    """Function that takes a request and settings, and returns the controller."""
    settings: Settings
    """Settings for a measured state."""
    settings_from_keypoints: Settings
    """Settings for a pose estimated from keypoints. The estimate is late and noisy, so slower loops work better."""
    ranges: Mapping[str, tuple[float, float]]
    """Smallest and largest value of each setting in the search, which draws log-uniformly."""
    cost: int = 1
    """Relative cost of a rollout; the tuning search divides the number of candidates by this cost."""

    def controller(self, request: BaselineRequest) -> AbstractController[Any]:
        """Return the controller with the settings that suit the observation of the task."""
        return self.make(request, self.settings_for(request.task))

    def settings_for(self, task: AbstractTask) -> Settings:
        """Return the settings that suit the observation of a task in flight: a measured state or an estimate."""
        estimated = task.observation_in_flight.state_estimator is not None
        return self.settings_from_keypoints if estimated else self.settings


def _gains(r: BaselineRequest, s: Settings) -> Gains:
    """Return the gains, scaled to the slowness n of the vehicle: a gain in 1/s^k is divided by n^k."""
    n = r.slowness
    values = (s["position"] / n**2, s["velocity"] / n, s["attitude"] / n, s.get("integral", 0.0) / n**3)
    return Gains(*(jnp.array(value) for value in values))


def _geometric(r: BaselineRequest, s: Settings) -> GeometricController:
    return GeometricController(
        r.task,
        _gains(r, s),
        r.prediction,
        jnp.array(INTEGRAL_LIMIT),
        r.vehicle.command_min,
        r.vehicle.command_max,
    )


def _indi(r: BaselineRequest, s: Settings) -> IndiController:
    return IndiController(
        r.task,
        _gains(r, s),
        r.prediction,
        jnp.array(r.slowness * s["filter"]),
        r.vehicle.command_min,
        r.vehicle.command_max,
    )


def _mppi(r: BaselineRequest, s: Settings) -> MppiController:
    estimator, dt = None, r.task.dt
    if "estimator" in s:
        estimator = L1Estimator(jnp.array(L1_POLE), jnp.exp(jnp.array(-dt / s["estimator"])), dt)
    return MppiController(
        r.task,
        r.prediction,
        r.vehicle.command_min,
        r.vehicle.command_max,
        r.key,
        estimator,
        jnp.array([s["thrust"], s["rates"], s["rates"], s["rates"]]),
        jnp.array(s["correlation"]),
        jnp.array(s["temperature"]),
        jnp.array(s["position"]),
        jnp.array(s["velocity"]),
        jnp.array(s["attitude"]),
        horizon=round(HORIZON / dt),
    )


_LOOPS = {"position": (4.0, 60.0), "velocity": (3.0, 15.0), "attitude": (5.0, 30.0)}
_SAMPLING = {
    "thrust": (0.3, 3.0), "rates": (0.2, 2.0), "correlation": (0.02, 0.5), "temperature": (0.01, 0.5),
    "position": (3.0, 30.0), "velocity": (0.03, 2.0), "attitude": (0.3, 10.0),
}  # fmt: skip
BASELINES: dict[str, Baseline] = {
    "geometric": Baseline(
        "geometric controller",
        _geometric,
        {"position": 56.3, "velocity": 12.6, "attitude": 23.9},
        {"position": 51.8, "velocity": 9.98, "attitude": 19.1},
        _LOOPS,
    ),
    "geometric-i": Baseline(
        "geometric controller + integral action",
        _geometric,
        {"position": 40.2, "velocity": 6.85, "attitude": 21.4, "integral": 20.6},
        {"position": 15.1, "velocity": 5.83, "attitude": 5.88, "integral": 13.8},
        {**_LOOPS, "integral": (2.0, 60.0)},
    ),
    "indi": Baseline(
        "INDI",
        _indi,
        {"position": 46.7, "velocity": 7.55, "attitude": 22.0, "filter": 0.0335},
        {"position": 19.7, "velocity": 7.39, "attitude": 9.55, "filter": 0.0283},
        {**_LOOPS, "filter": (0.02, 0.3)},
    ),
    "mppi": Baseline(
        "MPPI",
        _mppi,
        {
            "thrust": 1.46, "rates": 1.69, "correlation": 0.133, "temperature": 0.0896, "position": 6.89,
            "velocity": 0.0514, "attitude": 2.02,
        },
        {
            "thrust": 1.46, "rates": 1.69, "correlation": 0.133, "temperature": 0.0896, "position": 6.89,
            "velocity": 0.0514, "attitude": 2.02,
        },
        _SAMPLING,
        cost=3,
    ),
    "l1-mpc": Baseline(
        "MPPI + L1",
        _mppi,
        {
            "thrust": 1.05, "rates": 1.47, "correlation": 0.0762, "temperature": 0.133, "position": 14.1,
            "velocity": 0.0528, "attitude": 0.694, "estimator": 0.126,
        },
        {
            "thrust": 0.994, "rates": 0.422, "correlation": 0.267, "temperature": 0.0889, "position": 7.15,
            "velocity": 0.427, "attitude": 1.19, "estimator": 0.22,
        },
        {**_SAMPLING, "estimator": (0.1, 2.0)},
        cost=3,
    ),
}  # fmt: skip
"""Baselines by method name. Units: position gains [1/s^2], velocity and attitude gains [1/s], integral gains [1/s^3],
time constants of the filter and the estimator [s]. MPPI: noise of the thrust [m/s^2] and the rates [rad/s], the
correlation time of this noise [s], the temperature, and the costs per second of position [1/m], velocity [s/m] and
attitude."""
