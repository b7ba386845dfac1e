"""Identify the vehicle in flight, and use the result in the controller.

The estimator of the command path (:mod:`retrim.estimation.command_path`) receives every measurement and command. Its
90 % intervals become the belief of a policy that is trained for a family of vehicles, and the thrust gain scales the
commands. A new belief needs neither training nor compilation, since beliefs are inputs. Beliefs change slowly, so an
estimate, right or wrong, does not make the commands jump.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..estimation.command_path import PathEstimate, PathEstimator, ringing_of
from ..estimation.command_path import PathState as EstimatorState
from ..estimation.latency import follows
from ..estimation.lateness import Lateness
from ..physics.path_family import Member, PathBelief, PathFamily
from ..physics.state import Command, State
from .caution import REPORT_LEVEL, Caution
from .condition import Cause, Condition, Stage
from .controller import AbstractController
from .excitation import Excitation
from .vehicle_report import VehicleEstimate, VehicleReport
from .wrapped_controller import WrappedController

PACE = 2.0  # [1/s]: an unknown coordinate is known after half a second at the earliest
GAIN_PACE = 1.0  # [1/s], largest rate of change of the thrust gain
GAINS = (0.4, 2.5)


class BeliefState(eqx.Module):
    """Memory of a flight with a belief, and of the inner controller."""

    belief: PathBelief
    """Belief that was used for the last command."""
    gain: Float[Array, ""]
    """Thrust gain that was used for the last command."""
    inner: Any
    caution: Caution


class BeliefFlight(WrappedController[BeliefState]):
    """Flies a controller for a family of vehicles with a belief that slowly follows the identified vehicle."""

    family: PathFamily
    prior: PathBelief
    """Belief at take-off."""
    estimate: VehicleEstimate
    """Vehicle that the belief follows."""
    dt: float = eqx.field(static=True)
    """Control tick [s]."""
    watches: bool = eqx.field(static=True, default=True)
    """Whether a self-induced oscillation makes the controller assume a slower vehicle. In a task with a reference, the
    tilt swings even without such an oscillation."""

    def condition(self, memory: BeliefState) -> Condition | None:
        """Return the condition of the inner controller, or that of the caution for an inner controller without one."""
        inside = super().condition(memory)
        if inside is not None or not self.watches:
            return inside
        cautious, rests = memory.caution.level > REPORT_LEVEL, memory.caution.rest > 0.0
        cause = jnp.where(cautious, Cause.SWINGS, jnp.where(rests, Cause.NO_EFFECT, Cause.CALM))
        return Condition(jnp.where(cautious, Stage.CAUTIOUS, Stage.ADAPTED), cause)

    def disturbance(self, memory: BeliefState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the disturbance that the inner controller expects, and the thrust that the thrust gain changes."""
        missing = (1.0 - 1.0 / memory.gain) * u.c * x.R[:, 2]
        return missing + super().disturbance(memory, x, u)

    def init(self, x: State) -> BeliefState:
        """Return the memory at the start of a flight."""
        caution = Caution.none(x)
        return BeliefState(self.prior, jnp.ones_like(x.p[0]), self._flying(self.prior, caution).init(x), caution)

    def __call__(self, memory: BeliefState, t: Float[Array, ""], x: State) -> tuple[Command, BeliefState]:
        """Return the command of the inner controller for the present belief about the vehicle."""
        dt = self.dt
        belief = memory.belief.towards(self.estimate.belief, PACE * dt)
        caution = memory.caution.after(x, dt) if self.watches else memory.caution
        level = caution.gain(self.estimate.gain.astype(x.p.dtype))
        gain = memory.gain + jnp.clip(level - memory.gain, -GAIN_PACE * dt, GAIN_PACE * dt)
        u, inner = self._flying(belief, caution)(memory.inner, t, x)
        return Command(u.c / gain, u.omega), BeliefState(belief, gain, inner, caution)

    def accept(self, memory: BeliefState, u: Command) -> BeliefState:
        """Remember the accepted command."""
        flying = self._flying(memory.belief, memory.caution)
        inner = flying.accept(memory.inner, Command(u.c * memory.gain, u.omega))
        return dataclasses.replace(memory, inner=inner)

    def _flying(self, belief: PathBelief, caution: Caution) -> AbstractController[Any]:
        """Return the inner controller for the belief, which the caution changes."""
        middle, slowest = (self.family.path(end).response_time for end in (belief.centre, belief.ends[1]))
        # The assumed vehicle of a cautious flight is not an estimate.
        certainty = (1.0 - caution.level) * jnp.clip(2.0 - slowest / (middle + 1e-6), 0.0, 1.0)
        belief = caution.apply(belief)
        time = self.family.path(belief.ends[1]).response_time
        return self.inner.with_vehicle(Member(self.family.path(belief.centre), belief, time, certainty))


class IdentifiedState(eqx.Module):
    """Memory of the identification and of the flight that uses its result."""

    path: EstimatorState
    lateness: Lateness
    """Estimate of the undeclared lateness of measurements; without an inertial unit, the path estimate contains it."""
    flight: BeliefState


class IdentifiedFlight(AbstractController[IdentifiedState]):
    """Flies a controller for a family of vehicles, and identifies the vehicle.

    With an inertial unit, the flight also estimates by how much the states are older than declared. The inner
    controller then receives readings that are as late as the states.
    """

    inner: AbstractController[Any]
    estimator: PathEstimator
    family: PathFamily
    prior: PathBelief
    """Belief at take-off."""
    declared: Float[Array, "2"] | None = None
    """Command delay and rate lag from the vehicle file [s], if the file states both."""
    omega: Float[Array, "3"] | None = None
    """Measured body rates [rad/s], if there is an inertial unit."""
    a: Float[Array, "3"] | None = None
    """Measured acceleration in the world frame [m/s^2], if there is an inertial unit."""
    age: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.0))
    """Age of measurements [s]."""
    watches: bool = eqx.field(static=True, default=True)
    """Whether a self-induced oscillation makes the controller assume a slower vehicle; see :class:`BeliefFlight`."""
    excitation: Excitation | None = None
    """Small command doublets until the estimate is narrow, if the preset excites the vehicle."""

    def with_age(self, age: float | Float[Array, ""]) -> "IdentifiedFlight":
        """Return the same controller for measurements that are ``age`` seconds old."""
        return dataclasses.replace(self, inner=self.inner.with_age(age), age=jnp.array(age))

    def with_inertial(self, omega: Float[Array, "3"], a: Float[Array, "3"]) -> "IdentifiedFlight":
        """Return the same controller for a tick in which body rates and acceleration were measured."""
        return dataclasses.replace(self, omega=omega, a=a)

    def condition(self, memory: IdentifiedState) -> Condition | None:
        """Return the condition of the flight."""
        return self.follow(self._estimate(memory.path, memory.lateness)).condition(memory.flight)

    def vehicle(self, memory: IdentifiedState) -> VehicleReport:
        """Return the present estimate of the vehicle."""
        return VehicleReport(memory.path.estimate, self.declared, memory.lateness.value)

    def disturbance(self, memory: IdentifiedState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the disturbance that the flight expects."""
        return self.follow(self._estimate(memory.path, memory.lateness)).disturbance(memory.flight, x, u)

    def init(self, x: State) -> IdentifiedState:
        """Return the memory at the start of a flight."""
        path, lateness = self.estimator.init(x), Lateness.start(self.estimator.dt, x.p.dtype)
        return IdentifiedState(path, lateness, self.follow(self._estimate(path, lateness)).init(x))

    def __call__(self, memory: IdentifiedState, t: Float[Array, ""], x: State) -> tuple[Command, IdentifiedState]:
        """Update the identification, and return the command of the inner controller for the present estimate."""
        dt, lateness = self.estimator.dt, memory.lateness
        path = self.estimator.update(memory.path, t, x, self.omega, self.a, self.age + lateness.value)
        inner = self.inner
        if self.omega is not None and self.a is not None:
            successive, certain = follows(path.t, memory.path.t, dt), path.consistency.certain
            usable = successive & certain
            lateness = lateness.observe(memory.path.x, x, successive, usable, self.omega, self.a, self.age, dt)
            inner = inner.with_inertial(*lateness.late_readings(dt))
        follower = dataclasses.replace(self, inner=inner).follow(self._estimate(path, lateness))
        # A late state belongs to an earlier time of the task; otherwise the vehicle would be ahead of its reference.
        u, flight = follower(memory.flight, t - lateness.value.astype(t.dtype), x)
        if self.excitation is not None:
            doublet = self.excitation(t, path.estimate)
            u = Command(u.c + doublet.c.astype(u.c.dtype), u.omega + doublet.omega.astype(u.omega.dtype))
            flight = follower.accept(flight, u)
        return u, IdentifiedState(self.estimator.issue(path, u), lateness, flight)

    def accept(self, memory: IdentifiedState, u: Command) -> IdentifiedState:
        """Remember the accepted command."""
        path = self.estimator.accept(memory.path, u)
        follower = self.follow(self._estimate(path, memory.lateness))
        return IdentifiedState(path, memory.lateness, follower.accept(memory.flight, u))

    @property
    def identifies(self) -> bool:
        """Whether the controller identifies its vehicle in flight: always true."""
        return True

    def follow(self, estimate: VehicleEstimate) -> BeliefFlight:
        """Return the controller for an identification result, from this or another process.

        Args:
            estimate: Present estimate of the vehicle.
        """
        return BeliefFlight(self.inner, self.family, self.prior, estimate, self.estimator.dt, self.watches)

    def _estimate(self, path: EstimatorState, lateness: Lateness) -> VehicleEstimate:
        """Return the estimate of the vehicle from states that are as old as declared.

        States that are late show the same motion as a vehicle whose commands are later by the same time.
        """
        late, delay = lateness.value, path.estimate.delay
        total_delay = dataclasses.replace(delay, mean=delay.mean + late, low=delay.low + late, high=delay.high + late)
        return vehicle_estimate(self.family, dataclasses.replace(path.estimate, delay=total_delay))


def vehicle_estimate(family: PathFamily, estimate: PathEstimate) -> VehicleEstimate:
    """Return the estimate of the vehicle from an estimate of its command path.

    Args:
        family: Family of the vehicle.
        estimate: Estimate of the command path.
    """
    return VehicleEstimate(belief_from(family, estimate), limit_gain(estimate))


def belief_from(family: PathFamily, estimate: PathEstimate) -> PathBelief:
    """Return the belief from an estimate: the 90 % interval of each coordinate of the path.

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


def limit_gain(estimate: PathEstimate) -> Float[Array, ""]:
    """Return the thrust gain of an estimate, clipped to the range of possible vehicles."""
    return jnp.clip(estimate.thrust_gain.mean, *GAINS)
