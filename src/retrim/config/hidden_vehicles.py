"""Draw a benchmark population of vehicles that are unknown to the methods.

One size factor determines each vehicle: small vehicles turn fast and large ones turn slowly, so mass, inertia, delay
and lags grow together. Independent ranges of these values would contain impossible vehicles.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..physics.state import STANDARD_GRAVITY
from ..physics.vehicle import small
from .limits import check_seeds
from .scenario import Scenario
from .vehicle_file import VehicleSpec

LIGHTEST, HEAVIEST = 0.03, 3.0  # [kg]
RATE_LAG = (0.015, 0.15)  # [s]: of the lightest and the heaviest vehicle
DELAY = (0.0, 0.06)  # [s]
THRUST_LAG = (0.01, 0.08)  # [s]
SPREAD, DELAY_SPREAD = 0.2, 0.012  # standard deviations of the log-lags, and of the delay [s]
DAMPING = (0.4, 1.2)
THRUST_GAIN = (0.6, 1.6)  # ratio of thrust to commanded thrust
THRUST_TO_WEIGHT = (1.6, 5.0)  # at full command, if the gain were 1
LEAST_THRUST = 1.4  # smallest ratio of the thrust at full command to the weight
SEED_TAG = 46


@dataclass(frozen=True)
class HiddenVehicle:
    """A vehicle of the population. Methods do not receive its parameters."""

    spec: VehicleSpec
    """Mass, limits, lags, damping and delay."""
    size: float
    """Size factor: 0 for the lightest vehicle, 1 for the heaviest."""
    thrust_gain: float
    """Ratio of thrust to commanded thrust."""
    wrong_spec: VehicleSpec
    """A vehicle file whose mass, inertia, thrust, damping, delay and lags are wrong by up to a factor of two each."""

    @property
    def rate_lag(self) -> float:
        """Time constant of the roll and pitch rates [s]."""
        assert self.spec.rate_lag is not None
        return self.spec.rate_lag[0]

    @property
    def damping(self) -> float:
        """Damping ratio of the rate loop."""
        assert self.spec.rate_damping is not None
        return self.spec.rate_damping[0]

    @property
    def delay(self) -> float:
        """Command delay [s]."""
        assert self.spec.command_delay is not None
        return self.spec.command_delay

    @property
    def thrust_to_weight(self) -> float:
        """Ratio of the thrust at full command to the weight."""
        return self.thrust_gain * self.spec.thrust_max / (self.spec.mass * STANDARD_GRAVITY)

    def scenario(self, disturbance: str, *, sensors: str = "ideal", reference: str | None = None) -> Scenario:
        """Return the scenario of a flight with this vehicle on the second-order plant.

        Args:
            disturbance: Name of a disturbance.
            sensors: Name of a sensor model.
            reference: Reference of a tracking policy.
        """
        return Scenario(
            disturbance,
            plant="second-order",
            vehicle=self.spec,
            sensors=sensors,
            reference=reference,
            thrust_error=self.thrust_gain - 1.0,
            delay=self.delay,
        )


def draw_vehicles(count: int, seed: int = 0) -> list[HiddenVehicle]:
    """Draw vehicles.

    Args:
        count: Number of vehicles.
        seed: Seed of the population; for one seed, the first vehicles are the same for every ``count``.

    Raises:
        ConfigError: The seed is negative or exceeds 32 bits.
    """
    check_seeds((seed,), "draw")
    return [_draw(np.random.default_rng((SEED_TAG, seed, n)), n) for n in range(count)]


def _draw(draw: np.random.Generator, number: int) -> HiddenVehicle:
    size = draw.uniform()

    def grow(low: float, high: float) -> float:
        value = low * (high / low) ** size * np.exp(draw.normal(0.0, SPREAD))
        return _round(np.clip(value, low, high))

    like = small()
    mass = _round(LIGHTEST * (HEAVIEST / LIGHTEST) ** size)
    length = (mass / float(like.mass)) ** (1.0 / 3.0)
    rate_lag, thrust_lag = grow(*RATE_LAG), grow(*THRUST_LAG)
    delay = float(np.clip(DELAY[1] * size + draw.normal(0.0, DELAY_SPREAD), *DELAY))
    damping = _round(draw.uniform(*DAMPING))
    gain = _round(np.exp(draw.uniform(*np.log(THRUST_GAIN))))
    ratio = max(np.exp(draw.uniform(*np.log(THRUST_TO_WEIGHT))), LEAST_THRUST / gain)
    inertia = mass * length**2 / float(like.mass) * np.asarray(like.inertia, dtype=float)
    rates = np.asarray(like.omega_max, dtype=float)
    spec = VehicleSpec(
        name=f"hidden-{number}",
        mass=mass,
        inertia=(float(inertia[0]), float(inertia[1]), float(inertia[2])),
        arm=(float(like.arm[0]) * length, float(like.arm[1]) * length),
        thrust_max=float(ratio * mass * STANDARD_GRAVITY),
        rates_max=(float(rates[0]), float(rates[1]), float(rates[2])),
        motor_tau=thrust_lag,
        rate_lag=(rate_lag, rate_lag, rate_lag),
        rate_damping=(damping, damping, damping),
        command_delay=round(delay, 4),
    )
    return HiddenVehicle(spec, float(size), gain, _distort(draw, spec))


def _distort(draw: np.random.Generator, spec: VehicleSpec) -> VehicleSpec:
    """Return a specification with random errors; the ratio of thrust to weight remains that of a quadrotor."""

    def wrong(value: float) -> float:
        return _round(value * 2.0 ** draw.uniform(-1.0, 1.0))

    def wrong_alike(values: tuple[float, float, float]) -> tuple[float, float, float]:
        factor = wrong(1.0)
        return (values[0] * factor, values[1] * factor, values[2] * factor)

    assert spec.rate_lag is not None
    assert spec.rate_damping is not None
    assert spec.command_delay is not None
    weight = spec.mass * STANDARD_GRAVITY
    ratio = max(wrong(spec.thrust_max / weight), 1.01 * THRUST_TO_WEIGHT[0])
    mass = wrong(spec.mass)
    return replace(
        spec,
        mass=mass,
        inertia=wrong_alike(spec.inertia),
        thrust_max=ratio * mass * STANDARD_GRAVITY,
        motor_tau=wrong(spec.motor_tau),
        rate_lag=wrong_alike(spec.rate_lag),
        rate_damping=wrong_alike(spec.rate_damping),
        command_delay=wrong(spec.command_delay),
    )


def _round(value: float) -> float:
    """Round to three digits, as in a vehicle file."""
    return float(f"{value:.3g}")
