"""Fly an unchanged controller in the frame of the effective gravity.

A constant disturbance tilts and scales gravity (:mod:`retrim.physics.effective_gravity`). In the frame of this
effective gravity, the vehicle is undisturbed, so a controller performs its task under a constant push without further
inputs or training. A disturbance that changes is treated as if it were constant: with its present value or, for an
identified vehicle, with the value predicted for the time at which the command acts (:mod:`retrim.estimation.trend`).
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..estimation.disturbance_observer import DisturbanceObserver, ObserverState
from ..estimation.latency import ahead
from ..estimation.trend import Trend
from ..physics.actuator_response import ActuatorState
from ..physics.command_path import CommandPath, CommandQueue
from ..physics.dynamics import Hybrid, Residual
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.path_family import Member
from ..physics.state import Command, State, where
from .controller import AbstractController
from .slung_load import LoadCompensation, LoadMemory

SHARE_OF_RESPONSE_TIME = 0.25  # time constant of the observer as a share of an identified delay plus rate lag
FASTEST, SLOWEST = 0.015, 0.05  # [s], limits of this time constant
TILT_TIME = 2.5  # time in which a policy tilts the thrust, as a multiple of delay plus rate lag


class GravityFrameState(eqx.Module):
    """Memory of the observer and of the inner controller."""

    observer: ObserverState
    inner: Any
    frame: EffectiveGravityFrame
    """Frame of the last command."""
    trend: Trend
    """Recent course of the estimated disturbance."""
    load: LoadMemory | None = None
    """Memory of the compensation of a load, if a load is expected."""


class GravityFrame(AbstractController[GravityFrameState]):
    """Flies a controller in the frame of the effective gravity, given a known and an estimated disturbance."""

    inner: AbstractController[Any]
    observer: DisturbanceObserver
    """Observer that estimates the unknown part of the disturbance."""
    known_residual: Residual | None = None
    """Learned residual in the world frame [m/s^2]. The deviation from its value at rest is used directly, since an
    estimate of this deviation would be late."""
    age: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.0))
    """Age of measurements [s]; the inner controller receives the state extrapolated to the current time."""
    rate_bias: Float[Array, "3"] = eqx.field(default_factory=lambda: jnp.zeros(3))
    """Actual minus commanded body rates [rad/s]; this difference is subtracted from the command."""
    trust_estimate: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(1.0))
    """Share of the disturbance that turns the frame; with 0, the inner controller flies without compensation."""
    trust_residual: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(1.0))
    """Share of the learned residual and of the learned rate bias that is used."""
    actuators: ActuatorState | None = None
    """Present thrust and body rates; by default, those of the last command."""
    place: Callable[[Float[Array, "3"]], Float[Array, "3"]] | None = None
    """Learned acceleration as a function of position, world [m/s^2]. The frame uses its value at the position at which
    the command acts, since an estimate of this value would be late. By default, the residual does not depend
    on position."""
    lead: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.0))
    """Time from a measurement that is not late until the thrust has followed a command [s]."""
    horizon: Float[Array, "3"] = eqx.field(default_factory=lambda: jnp.zeros(3))
    """Time until the vehicle has compensated a change in each component of the disturbance [s], for a measurement that
    is not late."""
    certainty: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.0))
    """Share of the predicted change in the disturbance that is used. It is zero unless the belief about the vehicle is
    narrow, since a prediction for a wrong time can sustain an oscillation."""
    steady: Float[Array, "3"] = eqx.field(default_factory=lambda: jnp.zeros(3))
    """Disturbance that turns the frame in addition to the estimated one, in the world frame [m/s^2]."""
    load: LoadCompensation | None = None
    """Compensation of a load on a cable, if a load is expected."""

    def with_age(self, age: float | Float[Array, ""]) -> "GravityFrame":
        """Return the same controller for measurements that are ``age`` seconds old."""
        return dataclasses.replace(self, age=jnp.array(age))

    def with_vehicle(self, member: Member) -> "GravityFrame":
        """Return the same controller for an identified vehicle.

        The observer uses the vehicle's delay and thrust lag, and it is as fast as the vehicle permits, since the frame
        must not turn much faster than the vehicle can follow. The less certain the response time is, the less of the
        predicted change in the disturbance is used.
        """
        observer = dataclasses.replace(self.observer, path=member.path)
        lead = lead_of(member.path, observer.nominal.dt).astype(self.lead.dtype)
        if member.response_time is not None:
            tau = jnp.clip(SHARE_OF_RESPONSE_TIME * member.response_time, FASTEST, SLOWEST)
            observer = dataclasses.replace(observer, tau=tau.astype(self.observer.tau.dtype))
        result = dataclasses.replace(self, inner=self.inner.with_vehicle(member), observer=observer, lead=lead)
        if member.certainty is None:
            return result
        tilt_time = TILT_TIME * member.path.response_time
        horizon = jnp.stack([tilt_time, tilt_time, lead]).astype(self.horizon.dtype)
        return dataclasses.replace(result, horizon=horizon, certainty=member.certainty.astype(self.certainty.dtype))

    def with_actuators(self, actuators: ActuatorState) -> "GravityFrame":
        """Return the same controller for a tick in which thrust and body rates are known."""
        return dataclasses.replace(self, actuators=actuators)

    def disturbance(self, memory: GravityFrameState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the estimated disturbance, the state-dependent part of the learned residual, and the pull of a load.

        In a planned state, the load is expected to hang along the thrust.
        """
        result = self.trust_estimate.astype(x.p.dtype) * memory.observer.d_hat
        if self.known_residual is not None:
            result = result + StateDependentResidual(self.known_residual, self.trust_residual, self.place)(x, u)
        if memory.load is not None:
            share = self.trust_residual.astype(x.p.dtype) * memory.load.estimate.load.share
            result = result - share * u.c * x.R[:, 2]
        return result

    def init(self, x: State) -> GravityFrameState:
        """Return the memory at the start of a flight."""
        observer_state = self.observer.init(x)
        hover = observer_state.commands.newest
        command = Command(hover.c, hover.omega - self._bias(x.p.dtype))
        commands = jax.tree.map(
            lambda leaf, new: jnp.broadcast_to(new, leaf.shape), observer_state.commands, CommandQueue(command)
        )
        observer_state = dataclasses.replace(observer_state, commands=commands)
        load = None if self.load is None else self.load.init(x)
        d = observer_state.d_hat
        trend = Trend.start(d, self.observer.nominal.dt)
        return GravityFrameState(observer_state, self.inner.init(x), EffectiveGravityFrame.of(d), trend, load)

    def __call__(self, memory: GravityFrameState, t: Float[Array, ""], x: State) -> tuple[Command, GravityFrameState]:
        """Return the command of the inner controller, in the frame of the effective gravity when it will act."""
        observer, disturbance, unsteady = self.observer, jnp.zeros_like(x.p), None
        if self.known_residual is not None:
            unsteady = StateDependentResidual(self.known_residual, self.trust_residual, self.place)
            disturbance = unsteady(x, memory.observer.commands.newest)
            observer = dataclasses.replace(observer, nominal=Hybrid(observer.nominal, unsteady))
            if self.place is not None:
                there = x.p + (self.lead + self.age).astype(x.p.dtype) * x.v
                change = self.place(there) - self.place(x.p)
                disturbance = disturbance + self.trust_residual.astype(x.p.dtype) * change
            if self.inner.previews_residual:
                disturbance = jnp.zeros_like(x.p)
        observer_state, load, pull = self._observe(observer, memory, t, x, unsteady)
        now = x
        if load is not None:
            share, sway = self.trust_residual.astype(x.p.dtype), load.sway
            disturbance = disturbance + share * (pull - sway.a)
            now = State(x.p - share * sway.p, x.R, x.v - share * sway.v)
        trend, change = self._predict(memory, observer_state)
        present = self._limited(observer_state.d_hat + disturbance)
        frame = EffectiveGravityFrame.of(self._limited(observer_state.d_hat + change + disturbance))
        bias, last = self._bias(x.p.dtype), observer.arrival(memory.observer)
        acting, flying = Command(last.c, last.omega + bias), self.inner
        if unsteady is not None:
            flying = flying.with_residual(unsteady)
        if self.actuators is not None:
            acting, flying = self.actuators.command, flying.with_actuators(frame.actuators(self.actuators))
        x = ahead(now, acting, present, self.age.astype(x.p.dtype))
        u, inner = flying.in_frame(frame)(memory.inner, t, frame.state(x))
        u = frame.world_command(u)
        u = Command(u.c, u.omega - bias)
        return u, GravityFrameState(observer.issue(observer_state, u), inner, frame, trend, load)

    def _observe(
        self,
        observer: DisturbanceObserver,
        memory: GravityFrameState,
        t: Float[Array, ""],
        x: State,
        known: Residual | None,
    ) -> tuple[ObserverState, LoadMemory | None, Float[Array, "3"]]:
        """Return the memory of the observer, that of the load, and the pull of the load on the vehicle [m/s^2].

        The observer estimates the disturbance without the pull.
        """
        before, load, dt = memory.observer, memory.load, observer.nominal.dt
        if self.load is None or load is None:
            return observer(before, t, x), None, jnp.zeros_like(x.p)
        load, pull = self.load.predict(load, before.last, x, dt)
        without = self.trust_residual.astype(x.p.dtype) * pull
        after = dataclasses.replace(observer, nominal=Hybrid(observer.nominal, ConstantResidual(without)))(before, t, x)
        u, _ = observer.acting(before, x)
        missed = after.innovation + without
        if known is not None:
            missed = missed + known(before.last, u)
        valid = jnp.any(after.innovation != before.innovation)  # the observer holds it if the tick is not usable
        load = self.load.correct(load, missed, before.last, x, u, after.noise, valid, dt)
        pull, load = self.load.plan(load, t, (self.lead + self.age).astype(x.p.dtype), dt)
        return after, load, pull

    def accept(self, memory: GravityFrameState, u: Command) -> GravityFrameState:
        """Remember the accepted command in the observer and, transformed to the frame, in the inner controller."""
        observer = self.observer.accept(memory.observer, u)
        command = memory.frame.command(Command(u.c, u.omega + self._bias(u.omega.dtype)))
        return dataclasses.replace(memory, observer=observer, inner=self.inner.accept(memory.inner, command))

    def _predict(self, memory: GravityFrameState, observed: ObserverState) -> tuple[Trend, Float[Array, "3"]]:
        """Return the trend, and the change in the disturbance until the command has acted [m/s^2].

        While measurements contradict each other, no change is predicted, since the estimate decays.
        """
        horizon, dt = self.horizon + self.age, self.observer.nominal.dt
        valid = jnp.any(observed.innovation != memory.observer.innovation)  # the observer holds it otherwise
        trend = where(valid, memory.trend.after(observed.d_hat, horizon, dt), memory.trend)
        change = self.certainty.astype(observed.d_hat.dtype) * trend.change(horizon)
        return trend, jnp.where(observed.consistency.certain, change, 0.0)

    def _limited(self, d: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the disturbance that turns the frame, for an estimated disturbance ``d`` [m/s^2]."""
        d = self.trust_estimate.astype(d.dtype) * d + self.steady.astype(d.dtype)
        return limit_norm(d, self.observer.limit)

    def _bias(self, dtype: Any) -> Float[Array, "3"]:
        return (self.trust_residual * self.rate_bias).astype(dtype)


class StateDependentResidual(eqx.Module):
    """Part of a residual beyond its value at rest, and its part that depends on position."""

    residual: Residual
    share: Float[Array, ""]
    """Share of these parts that is used."""
    place: Callable[[Float[Array, "3"]], Float[Array, "3"]] | None = None
    """Part that depends on position, if there is one."""

    def __call__(self, x: State, u: Command) -> Float[Array, "3"]:
        """Return this part of the residual acceleration in the world frame [m/s^2]."""
        beyond = self.residual(x, u) - self.residual(State.at(x.p), Command.hover(x.p.dtype))
        if self.place is not None:
            beyond = beyond + self.place(x.p)
        return self.share.astype(x.p.dtype) * beyond


class ConstantResidual(eqx.Module):
    """A residual that is independent of state and command."""

    a: Float[Array, "3"]
    """Acceleration in the world frame [m/s^2]."""

    def __call__(self, x: State, u: Command) -> Float[Array, "3"]:
        """Return the acceleration."""
        return self.a


class NormLimited(eqx.Module):
    """A residual with a limited norm, which ensures that the frame of the effective gravity is defined."""

    residual: Residual
    limit: Float[Array, ""]
    """Largest norm [m/s^2]."""

    def __call__(self, x: State, u: Command) -> Float[Array, "3"]:
        """Return the residual acceleration in the world frame [m/s^2]."""
        return limit_norm(self.residual(x, u), self.limit)


def lead_of(path: CommandPath, dt: float) -> Float[Array, ""]:
    """Return the mean time from a command's tick until the thrust has followed it [s].

    Args:
        path: Command path of the vehicle.
        dt: Control tick [s].
    """
    lag = jnp.zeros_like(path.delay) if path.response is None else path.response.thrust_lag
    return path.delay + lag + 0.5 * dt


def limit_norm(d: Float[Array, "3"], limit: Float[Array, ""]) -> Float[Array, "3"]:
    """Return ``d`` with its norm limited to ``limit``."""
    return d * jnp.minimum(1.0, limit / jnp.sqrt(jnp.sum(d * d) + 1e-12))
