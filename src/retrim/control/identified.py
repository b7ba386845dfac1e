"""Identify the vehicle in flight, and tell the controller inside.

The estimator of the command path (:mod:`retrim.estimation.command_path`) sees every measurement and command. Its 90 %
intervals become the belief of a policy that is trained for a family of vehicles, and the gain of the thrust scales the
commands. Nothing is trained or compiled for that: beliefs are inputs. They change slowly, so that no estimate, right or
wrong, changes the commands by a jump.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..estimation.command_path import PathEstimate, PathEstimator, ringing_of
from ..estimation.command_path import PathState as EstimatorState
from ..physics.path_family import Member, PathBelief, PathFamily
from ..physics.state import Command, State
from .condition import Condition
from .controller import AbstractController
from .vehicle_report import VehicleReport

PACE = 2.0  # [1/s]: an unknown coordinate is known after half a second at the earliest
GAIN_PACE = 1.0  # [1/s], change of the gain of the thrust
GAINS = (0.4, 2.5)


class IdentifiedState(eqx.Module):
    """Memory of the identification and of the controller inside."""

    path: EstimatorState
    belief: PathBelief
    """Belief of the last command."""
    gain: Float[Array, ""]
    """Gain of the thrust that the last command allows for."""
    inner: Any


class IdentifiedFlight(AbstractController[IdentifiedState]):
    """Flies a controller for a family of vehicles, and tells it which vehicle it is."""

    inner: AbstractController[Any]
    estimator: PathEstimator
    family: PathFamily
    prior: PathBelief
    """Belief at take-off."""
    declared: Float[Array, "2"] | None = None
    """Command delay and rate lag of the vehicle file [s]; None if it states none."""
    omega: Float[Array, "3"] | None = None
    """Measured body rates [rad/s]; None if they are not measured."""
    a: Float[Array, "3"] | None = None
    """Measured acceleration, world [m/s^2]; None if it is not measured."""
    age: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.0))
    """Age of measurements [s]."""

    def aged(self, age: float | Float[Array, ""]) -> "IdentifiedFlight":
        """Return the same for measurements that are ``age`` old [s]."""
        return dataclasses.replace(self, inner=self.inner.aged(age), age=jnp.array(age))

    def sensing(self, omega: Float[Array, "3"], a: Float[Array, "3"]) -> "IdentifiedFlight":
        """Return the same for a tick in which body rates and acceleration were measured."""
        return dataclasses.replace(self, inner=self.inner.sensing(omega, a), omega=omega, a=a)

    def condition(self, memory: IdentifiedState) -> Condition | None:
        """Return the condition of the controller inside."""
        return self.inner.condition(memory.inner)

    def vehicle(self, memory: IdentifiedState) -> VehicleReport:
        """Return the vehicle as it is known now."""
        return VehicleReport(memory.path.estimate, self.declared)

    def init(self, x: State) -> IdentifiedState:
        """Return the memory at the start of a flight."""
        one = jnp.ones_like(x.p[0])
        return IdentifiedState(self.estimator.init(x), self.prior, one, self._flying(self.prior).init(x))

    def __call__(self, memory: IdentifiedState, t: Float[Array, ""], x: State) -> tuple[Command, IdentifiedState]:
        """Identify, and return the command of the controller inside for the vehicle as it is known now."""
        dt = self.estimator.dt
        path = self.estimator.update(memory.path, t, x, self.omega, self.a, self.age)
        belief = memory.belief.towards(belief_from(self.family, path.estimate), PACE * dt)
        found = bounded_gain(path.estimate).astype(x.p.dtype)
        gain = memory.gain + jnp.clip(found - memory.gain, -GAIN_PACE * dt, GAIN_PACE * dt)
        u, inner = self._flying(belief)(memory.inner, t, x)
        issued = Command(u.c / gain, u.omega)
        return issued, IdentifiedState(self.estimator.issued(path, issued), belief, gain, inner)

    def accepted(self, memory: IdentifiedState, u: Command) -> IdentifiedState:
        """Remember the accepted command."""
        path = self.estimator.accepted(memory.path, u)
        inner = self._flying(memory.belief).accepted(memory.inner, Command(u.c * memory.gain, u.omega))
        return dataclasses.replace(memory, path=path, inner=inner)

    def _flying(self, belief: PathBelief) -> AbstractController[Any]:
        slowest = self.family.path(belief.ends[1])
        lateness = slowest.delay + slowest.response.rate_lag[0]
        return self.inner.with_vehicle(Member(self.family.path(belief.centre), belief, lateness))


def belief_from(family: PathFamily, estimate: PathEstimate) -> PathBelief:
    """Return what an estimate says of the coordinates of a path: the 90 % interval of each.

    Args:
        family: Family of the vehicle.
        estimate: Estimate of the command path.
    """
    low, high = (
        family.coordinates(
            getattr(estimate.delay, end),
            getattr(estimate.rate_lag, end),
            ringing_of(getattr(estimate.rate_damping, other)),
            getattr(estimate.thrust_lag, end),
        )
        for end, other in (("low", "high"), ("high", "low"))
    )
    return PathBelief.between(low, high)


def bounded_gain(estimate: PathEstimate) -> Float[Array, ""]:
    """Return the gain of the thrust of an estimate, within what a vehicle may have."""
    return jnp.clip(estimate.thrust_gain.mean, *GAINS)
