"""Fly a reference as fast as the model of the vehicle and the tracking error permit."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.state import Command, State
from ..tasks.abstract_reference import AbstractReference, Point
from ..tasks.paced_reference import Clock, at_pace, pace_references, set_clock
from .attitude import attitude_of, thrust_of
from .controller import AbstractController
from .pace import PaceLimits, largest_factors, largest_growth, points_ahead
from .wrapped_controller import WrappedController

FIRST_SPEED, FIRST_ACCELERATION = 1.0, 1.0  # [m/s], [m/s^2], largest values of the first lap
TOLERANCE = 0.1  # [m]: the share of the pace limits grows while the error is smaller
RISE, FALL = 0.08, 0.5  # [1/s], largest relative rates of this share
PEAK_TAU = 2.0  # [s], time constant with which the peak of the error decays
ACCELERATION_RATE, BRAKING_RATE = 1.0, 2.0  # [1/s], largest relative changes of the pace
SAMPLES = 512  # instants at which the whole path is evaluated
SMOOTHING = 0.1  # [s], time constant of the growth of the pace


class PacedState(eqx.Module):
    """Memory of the pace and of the inner controller."""

    clock: Clock
    """Clock of the last command."""
    share: Float[Array, ""]
    """Share of the largest feasible pace that is flown."""
    least: Float[Array, ""]
    """Share of the first lap, below which a large error does not reduce the share."""
    peak: Float[Array, ""]
    """Decaying peak of the tracking error [m]."""
    inner: Any


class PacedFlight(WrappedController[PacedState]):
    """Moves the reference of a controller at a variable pace.

    The flight begins with a slow lap. While the tracking error is small, the pace grows towards the largest pace that
    the model permits, with the disturbance that the inner controller expects; a large error reduces the pace.
    """

    reference: AbstractReference
    """Reference as a function of the phase, world frame."""
    limits: PaceLimits
    dt: float = eqx.field(static=True)
    """Control tick [s]."""
    age: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.0))
    """Age of measurements [s]."""

    @classmethod
    def of(
        cls, controller: AbstractController[Any], reference: AbstractReference, limits: PaceLimits, dt: float
    ) -> "PacedFlight":
        """Return a controller that flies at a variable pace.

        Args:
            controller: Controller with tabulated references.
            reference: Reference of the flight.
            limits: Limits of the vehicle.
            dt: Control tick [s].
        """
        clock = Clock.at_pace(jnp.ones_like(reference.lap[0]))
        return cls(pace_references(controller, clock), reference, limits, dt)

    def with_age(self, age: float | Float[Array, ""]) -> "PacedFlight":
        """Return the same controller for measurements that are ``age`` seconds old."""
        return dataclasses.replace(super().with_age(age), age=jnp.array(age))

    def clock(self, memory: PacedState) -> Clock:
        """Return the clock of the last command."""
        return memory.clock

    def init(self, x: State) -> PacedState:
        """Return the memory at the start of a flight, with the pace of a slow lap."""
        pace = slow_pace(self.reference)
        share = feasible_share(self.reference, self.limits, pace).astype(x.p.dtype)
        clock = Clock.at_pace(pace.astype(x.p.dtype))
        inner = set_clock(self.inner, clock).init(x)
        return PacedState(clock, share, share, jnp.zeros_like(x.p[0]), inner)

    def __call__(self, memory: PacedState, t: Float[Array, ""], x: State) -> tuple[Command, PacedState]:
        """Choose the growth of the pace, and return the command of the inner controller."""
        clock = memory.clock
        phase, pace = clock.phase_at(t), clock.pace_at(t)
        now = Clock(t.astype(phase.dtype), phase, pace, clock.growth)
        vehicle = self.inner.vehicle(memory.inner)
        age = self.age if vehicle is None else vehicle.age(self.age)
        error = x.p - self.reference(phase - pace * age.astype(phase.dtype)).p
        decay = 1.0 - self.dt / PEAK_TAU
        peak = jnp.maximum(jnp.sqrt(jnp.sum(error * error)), decay * memory.peak)
        rate = jnp.clip(1.0 - peak / TOLERANCE, -1.0, 1.0)
        share = memory.share * jnp.exp(self.dt * jnp.where(rate > 0.0, RISE, FALL) * rate)
        share = jnp.clip(share, memory.least, 1.0)
        tau, points = points_ahead(self.reference, now)
        factors = largest_factors(points, self.limits, self._disturbances(memory.inner, points))
        now = _approach(now, largest_growth(tau, factors, share), self.dt)
        u, inner = set_clock(self.inner, now)(memory.inner, t, x)
        return u, PacedState(now, share, memory.least, peak, inner)

    def accept(self, memory: PacedState, u: Command) -> PacedState:
        """Pass the accepted command to the inner controller."""
        inner = set_clock(self.inner, memory.clock).accept(memory.inner, u)
        return dataclasses.replace(memory, inner=inner)

    def _disturbances(self, memory: Any, points: Point) -> Float[Array, "n 3"]:
        """Return the disturbance that the inner controller expects at points of the path ahead."""

        def at(point: Point) -> Float[Array, "3"]:
            x = State(point.p, attitude_of(thrust_of(point.a), point.heading), point.v)
            return self.inner.disturbance(memory, x, Command(point.u[0], point.u[1:]))

        return jax.vmap(at)(points)


def slow_pace(reference: AbstractReference) -> Float[Array, ""]:
    """Return the pace of the first lap, at most 1: the speed and the acceleration are small along the whole path.

    Args:
        reference: Reference as a function of the phase.
    """
    points = jax.vmap(reference)(_phases(reference))
    speed, acceleration = (jnp.max(jnp.sum(part**2, axis=1)) ** 0.5 for part in (points.v, points.a))
    slow = jnp.minimum(FIRST_SPEED / speed, jnp.sqrt(FIRST_ACCELERATION / acceleration))
    return jnp.minimum(slow, 1.0)


def feasible_share(reference: AbstractReference, limits: PaceLimits, pace: Float[Array, ""]) -> Float[Array, ""]:
    """Return the ratio, at most 1, of a pace to the largest feasible pace at the narrowest part of a path.

    Args:
        reference: Reference as a function of the phase.
        limits: Limits of the vehicle.
        pace: Constant pace.
    """
    phases = _phases(reference)
    points = jax.vmap(at_pace, (0, None, None))(jax.vmap(reference)(phases), pace, jnp.zeros_like(pace))
    factors = largest_factors(points, limits, jnp.zeros_like(points.p), (phases[1] - phases[0]) / pace)
    return jnp.minimum(1.0 / jnp.min(factors), 1.0)


def ideal_step(
    reference: AbstractReference, limits: PaceLimits, clock: Clock, share: Float[Array, ""], dt: float
) -> Clock:
    """Return the clock one tick later for a vehicle without tracking error and without disturbance.

    Args:
        reference: Reference as a function of the phase.
        limits: Limits of the vehicle.
        clock: Present clock.
        share: Share of the largest feasible pace.
        dt: Control tick [s].
    """
    t = clock.t + dt
    now = Clock(t, clock.phase_at(t), clock.pace_at(t), clock.growth)
    tau, points = points_ahead(reference, now)
    return _approach(now, largest_growth(tau, largest_factors(points, limits, jnp.zeros_like(points.p)), share), dt)


def _approach(clock: Clock, growth: Float[Array, ""], dt: float) -> Clock:
    """Return a clock whose growth moves towards a desired growth."""
    target = jnp.clip(growth, -BRAKING_RATE, ACCELERATION_RATE)
    return dataclasses.replace(clock, growth=clock.growth + (dt / SMOOTHING) * (target - clock.growth))


def _phases(reference: AbstractReference) -> Float[Array, " n"]:
    """Return evenly spaced phases from the start to the end of a reference [s]."""
    return jnp.linspace(0.0, 1.0, SAMPLES, dtype=reference.lap.dtype) * reference.lap[1]
