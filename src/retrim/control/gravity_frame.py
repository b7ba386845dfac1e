"""Fly an unchanged controller in the frame of the gravity that the vehicle feels.

A constant disturbance is gravity, tilted and scaled (:mod:`retrim.physics.felt_frame`): in that frame nothing disturbs
the vehicle, so a controller needs no other input, and no other training, to do its task under a constant push. What
changes with state and command is answered as if it stayed as it is now.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..estimation.disturbance_observer import DisturbanceObserver, ObserverState
from ..estimation.latency import ahead
from ..physics.actuator_response import ActuatorState
from ..physics.command_path import CommandQueue
from ..physics.dynamics import Hybrid, Residual
from ..physics.felt_frame import FeltFrame
from ..physics.path_family import Member
from ..physics.state import Command, State
from ..tasks.occluded import OccludedMemory
from .controller import AbstractController, PolicyController

SHARE_OF_LATENESS = 0.25  # of delay and rate lag: time constant of the observer for an identified vehicle
FASTEST, SLOWEST = 0.015, 0.05  # [s], its limits


class GravityFrameState(eqx.Module):
    """Memory of the observer and of the controller inside."""

    observer: ObserverState
    inner: Any
    frame: FeltFrame
    """Frame of the last command."""


class GravityFrame(AbstractController[GravityFrameState]):
    """Any controller that can be turned, in the gravity that is known and that a disturbance observer estimates."""

    inner: AbstractController[Any]
    observer: DisturbanceObserver
    """It estimates what is not known."""
    known: Residual | None = None
    """Residual that has been learnt, world frame [m/s^2]: what it says beyond what it says at rest needs no estimate,
    which would come late."""
    age: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.0))
    """How old measurements are [s]: the controller inside is shown what they say of now."""
    rate_bias: Float[Array, "3"] = eqx.field(default_factory=lambda: jnp.zeros(3))
    """The vehicle turns so much faster than it is told [rad/s], so it is told less."""
    trust_estimate: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(1.0))
    """Share of the disturbance that turns the frame: 0 flies the controller inside as it is."""
    trust_known: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(1.0))
    """Share of what has been learnt, residual and bias of the rates, that is used."""
    actuators: ActuatorState | None = None
    """Present thrust and body rates; None: the last command acts."""
    steady: Float[Array, "3"] = eqx.field(default_factory=lambda: jnp.zeros(3))
    """Disturbance that turns the frame beside the estimated one, world [m/s^2]."""

    def with_age(self, age: float | Float[Array, ""]) -> "GravityFrame":
        """Return the same for measurements that are ``age`` old [s]."""
        return dataclasses.replace(self, age=jnp.array(age))

    def with_vehicle(self, member: Member) -> "GravityFrame":
        """Return the same for a vehicle that was identified.

        The observer uses its delay and the lag of its thrust. It is as fast as the vehicle permits: the frame must not
        turn much faster than the vehicle can follow.
        """
        observer = dataclasses.replace(self.observer, path=member.path)
        if member.lateness is not None:
            tau = jnp.clip(SHARE_OF_LATENESS * member.lateness, FASTEST, SLOWEST)
            observer = dataclasses.replace(observer, tau=tau.astype(self.observer.tau.dtype))
        return dataclasses.replace(self, inner=self.inner.with_vehicle(member), observer=observer)

    def with_actuators(self, actuators: ActuatorState) -> "GravityFrame":
        """Return the same for a tick in which thrust and body rates are known."""
        return dataclasses.replace(self, actuators=actuators)

    def init(self, x: State) -> GravityFrameState:
        """Return the memory at the start of a flight."""
        observed = self.observer.init(x)
        hover = observed.commands.newest
        told = Command(hover.c, hover.omega - self._bias(x.p.dtype))
        rows = jax.tree.map(lambda leaf, new: jnp.broadcast_to(new, leaf.shape), observed.commands, CommandQueue(told))
        observed = dataclasses.replace(observed, commands=rows)
        return GravityFrameState(observed, self.inner.init(x), FeltFrame.of(observed.d_hat))

    def __call__(self, memory: GravityFrameState, t: Float[Array, ""], x: State) -> tuple[Command, GravityFrameState]:
        """Return the inner controller's command in the frame of what is felt now."""
        observer, felt = self.observer, jnp.zeros_like(x.p)
        if self.known is not None:
            unsteady = Unsteady(self.known, self.trust_known)
            felt = unsteady(x, memory.observer.commands.newest)
            observer = dataclasses.replace(observer, nominal=Hybrid(observer.nominal, unsteady))
        observed = observer(memory.observer, t, x)
        felt = self.trust_estimate.astype(x.p.dtype) * (observed.d_hat + felt) + self.steady.astype(x.p.dtype)
        frame = FeltFrame.of(capped(felt, observer.limit))
        bias, last = self._bias(x.p.dtype), observer.arrival(memory.observer)
        acting, flying = Command(last.c, last.omega + bias), self.inner
        if self.actuators is not None:
            acting, flying = self.actuators.command, flying.with_actuators(frame.actuators(self.actuators))
        x = ahead(x, acting, frame.d, self.age.astype(x.p.dtype))
        u, inner = flying.in_frame(frame)(memory.inner, t, frame.state(x))
        u = frame.world_command(u)
        u = Command(u.c, u.omega - bias)
        return u, GravityFrameState(observer.issued(observed, u), inner, frame)

    def accepted(self, memory: GravityFrameState, u: Command) -> GravityFrameState:
        """Remember the accepted command, in the observer and, as the frame has it, in the controller inside."""
        observer = self.observer.accepted(memory.observer, u)
        meant = memory.frame.command(Command(u.c, u.omega + self._bias(u.omega.dtype)))
        return GravityFrameState(observer, self.inner.accepted(memory.inner, meant), memory.frame)

    def _bias(self, dtype: Any) -> Float[Array, "3"]:
        return (self.trust_known * self.rate_bias).astype(dtype)


class SeenFrame(AbstractController[tuple[OccludedMemory, Command]]):
    """A policy behind :class:`OccludedKeypoints`, in the gravity that its pose filter estimates; it needs no state."""

    inner: PolicyController
    limit: Float[Array, ""]
    """Largest norm of the disturbance that turns the frame [m/s^2]."""

    def init(self, x: State) -> tuple[OccludedMemory, Command]:
        """Return the memory at the start of a flight."""
        return self.inner.init(x)

    def __call__(
        self, memory: tuple[OccludedMemory, Command], t: Float[Array, ""], x: State
    ) -> tuple[Command, tuple[OccludedMemory, Command]]:
        """Return the inner controller's command in the frame of what was felt a tick ago."""
        seen, last = memory
        frame = FeltFrame.of(capped(seen.pose.d, self.limit))
        u, (seen, _) = self.inner.in_frame(frame)((seen, frame.command(last)), t, frame.state(x))
        u = frame.world_command(u)
        return u, (seen, u)

    def accepted(self, memory: tuple[OccludedMemory, Command], u: Command) -> tuple[OccludedMemory, Command]:
        """Remember the accepted command."""
        return memory[0], u


class Unsteady(eqx.Module):
    """What a residual predicts beyond what it predicts at rest: that part depends on state and command."""

    residual: Residual
    share: Float[Array, ""]
    """Share of it that is used."""

    def __call__(self, x: State, u: Command) -> Float[Array, "3"]:
        """Return the rest of the residual acceleration, world frame [m/s^2]."""
        rest = self.residual(x, u) - self.residual(State.at(x.p), Command.hover(x.p.dtype))
        return self.share.astype(x.p.dtype) * rest


class Capped(eqx.Module):
    """A residual whose norm is limited, so that there is a frame of the gravity that is felt."""

    residual: Residual
    limit: Float[Array, ""]
    """[m/s^2]"""

    def __call__(self, x: State, u: Command) -> Float[Array, "3"]:
        """Return the residual acceleration, world frame [m/s^2]."""
        return capped(self.residual(x, u), self.limit)


def capped(d: Float[Array, "3"], limit: Float[Array, ""]) -> Float[Array, "3"]:
    """Return ``d``, shortened to ``limit`` if it is longer."""
    return d * jnp.minimum(1.0, limit / jnp.sqrt(jnp.sum(d * d) + 1e-12))
