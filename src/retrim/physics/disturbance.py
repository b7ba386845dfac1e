"""Define disturbances as functions (t, x) -> :class:`ExternalEffects`.

This module contains pushes; see also the modules ``wind`` and ``faults``. Disturbances belong to the plant; the nominal
model does not contain them. Their random numbers are drawn at construction, so a disturbance is repeatable.

A disturbance may have its own state, such as that of a load on a cable (:class:`StatefulDisturbance`). The plant
advances this state together with the vehicle, in the same substeps.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, ArrayLike, Float, Key

from .effects import ExternalEffects
from .state import State
from .vehicle import Vehicle


@runtime_checkable
class Disturbance(Protocol):
    """Protocol of a disturbance: any function of time [s] and state."""

    def __call__(self, t: Float[Array, ""], x: State, /) -> ExternalEffects:
        """Return the external effects at time ``t`` in the state ``x``."""
        ...


@runtime_checkable
class StatefulDisturbance(Disturbance, Protocol):
    """Protocol of a disturbance with its own state. A call without it gives the effects of its state of rest."""

    def init(self, x: State, /) -> Any:
        """Return the state of the disturbance at the start of a flight in the state ``x``: a pytree of arrays."""
        ...

    def advance(self, s: Any, t: Float[Array, ""], x: State, h: float, /) -> tuple[ExternalEffects, Any]:
        """Return the effects on the vehicle during a substep, and the state of the disturbance at its end.

        Args:
            s: State of the disturbance at the start of the substep.
            t: Time at the start of the substep [s].
            x: State of the vehicle at the start of the substep.
            h: Length of the substep [s].
        """
        ...


@eqx.filter_jit
def effects_at(times: ArrayLike, x: State, disturbance: Disturbance) -> ExternalEffects:
    """Return the external effects in the state ``x`` at each of ``times`` [s] (leading axis)."""
    result: ExternalEffects = jax.vmap(lambda t: disturbance(t, x))(jnp.asarray(times, dtype=x.p.dtype))
    return result


class Push(eqx.Module):
    """A disturbance defined by a function (t, x) -> external acceleration in the world frame [m/s^2]."""

    a_ext: Callable[[Float[Array, ""], State], Float[Array, "3"]]

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the push ``a_ext(t, x)``."""
        return ExternalEffects.of(x.p.dtype, push=self.a_ext(t, x))


class SumOfDisturbances(eqx.Module):
    """Several disturbances at once."""

    parts: tuple[Disturbance, ...]

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the sum of the parts."""
        return sum((part(t, x) for part in self.parts), start=ExternalEffects.calm(x.p.dtype))

    def for_vehicle(self, vehicle: Vehicle) -> "SumOfDisturbances":
        """Return the sum of the parts for a vehicle."""
        return SumOfDisturbances(tuple(for_vehicle(part, vehicle) for part in self.parts))


def parts_of(disturbance: Disturbance) -> tuple[Disturbance, ...]:
    """Return the parts of a sum of disturbances, also of nested sums; a disturbance that is no sum is its only part."""
    if not isinstance(disturbance, SumOfDisturbances):
        return (disturbance,)
    return tuple(part for summand in disturbance.parts for part in parts_of(summand))


def stateful_parts(disturbance: Disturbance) -> tuple[StatefulDisturbance, ...]:
    """Return the parts of a disturbance that have their own state."""
    return tuple(part for part in parts_of(disturbance) if isinstance(part, StatefulDisturbance))


def start(disturbance: Disturbance, x: State) -> tuple[Any, ...]:
    """Return the states of the stateful parts of a disturbance at the start of a flight in the state ``x``."""
    return tuple(part.init(x) for part in stateful_parts(disturbance))


def advance(
    disturbance: Disturbance, states: tuple[Any, ...], t: Float[Array, ""], x: State, h: float
) -> tuple[ExternalEffects, tuple[Any, ...]]:
    """Return the effects of a disturbance during a substep, and the states of its stateful parts at the end.

    Args:
        disturbance: The disturbance.
        states: States of its stateful parts at the start of the substep, from :func:`start`; empty without such parts.
        t: Time at the start of the substep [s].
        x: State of the vehicle at the start of the substep.
        h: Length of the substep [s].
    """
    if not states:
        return disturbance(t, x), states
    effects, after, remaining = ExternalEffects.calm(x.p.dtype), list[Any](), iter(states)
    for part in parts_of(disturbance):
        if isinstance(part, StatefulDisturbance):
            more, state = part.advance(next(remaining), t, x, h)
            after.append(state)
        else:
            more = part(t, x)
        effects = effects + more
    return effects, tuple(after)


def for_vehicle(disturbance: Disturbance, vehicle: Vehicle) -> Disturbance:
    """Return a disturbance for a vehicle; one whose effects depend on the rotors has a method ``for_vehicle``.

    Args:
        disturbance: Disturbance by name.
        vehicle: Vehicle of the flight.
    """
    fit: Callable[[Vehicle], Disturbance] | None = getattr(disturbance, "for_vehicle", None)
    return disturbance if fit is None else fit(vehicle)


class HeldEffects(eqx.Module):
    """Constant effects of any kind; the owner may replace the effects in flight."""

    effects: ExternalEffects

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the effects."""
        return ExternalEffects.calm(x.p.dtype) + self.effects


class Constant(eqx.Module):
    """A constant acceleration, e.g. the paper's cases none, small and large (Sec. IV-B)."""

    a: Float[Array, "3"]

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the push ``a`` [m/s^2]."""
        return ExternalEffects.of(x.p.dtype, push=self.a)


class Step(eqx.Module):
    """An acceleration that begins at a given time and remains."""

    a: Float[Array, "3"]
    since: Float[Array, ""]
    """Start time [s]."""

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return a push of zero before ``since``, and ``a`` [m/s^2] from then on."""
        return ExternalEffects.of(x.p.dtype, push=jnp.where(t >= self.since, self.a, jnp.zeros_like(self.a)))


class Kick(eqx.Module):
    """An acceleration of short duration."""

    a: Float[Array, "3"]
    since: Float[Array, ""]
    """Start time [s]."""
    duration: Float[Array, ""]
    """Duration [s]."""

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the push ``a`` [m/s^2] from ``since`` on, for ``duration``, and zero otherwise."""
        acts = (t >= self.since) & (t < self.since + self.duration)
        return ExternalEffects.of(x.p.dtype, push=jnp.where(acts, self.a, jnp.zeros_like(self.a)))


class Reversing(eqx.Module):
    """An acceleration that alternates between ``a`` and ``-a`` every ``period`` seconds.

    In the paper, the period is 15 s (Sec. IV-B.3).
    """

    a: Float[Array, "3"]
    period: Float[Array, ""]

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the period is not positive."""
        if not isinstance(self.period, jax.core.Tracer) and not self.period > 0:
            raise ValueError(f"Reversing.period = {float(self.period)} s must be positive")

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the push ``a`` in the first period, ``-a`` in the second, and so on."""
        first = jnp.floor(t / self.period) % 2.0 == 0.0
        return ExternalEffects.of(x.p.dtype, push=jnp.where(first, self.a, -self.a))


class RandomWalk(eqx.Module):
    """An acceleration that wanders within ±``bound`` per axis, linearly between points ``every`` seconds apart.

    The walk is a Brownian path folded back at the bounds. After its last point, the walk is retraced backwards.
    """

    points: Float[Array, "n 3"]
    """Points of the walk [m/s^2]."""
    every: Float[Array, ""]

    @classmethod
    def of(cls, rate: float, bound: float, *, key: Key[Array, ""], every: float = 0.1, n: int = 1200) -> "RandomWalk":
        """Draw a walk from zero with a standard deviation of ``rate`` [m/s^2] after one second, far from the bounds."""
        if not (bound > 0 and rate >= 0 and every > 0 and n >= 2):
            raise ValueError(
                "RandomWalk: bound and every must be positive, rate at least 0 and n at least 2, got "
                f"bound = {bound}, every = {every}, rate = {rate}, n = {n}"
            )
        path = jnp.cumsum(rate * every**0.5 * random.normal(key, (n, 3)), axis=0)
        path = path - path[:1]
        return cls(bound - jnp.abs((path + bound) % (4.0 * bound) - 2.0 * bound), jnp.array(every))

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the walk's acceleration at ``t`` as a push."""
        last = self.points.shape[0] - 1
        where = last - jnp.abs((t / self.every) % (2.0 * last) - last)  # there and back again
        i = jnp.clip(jnp.floor(where), 0, last - 1).astype(jnp.int32)
        part = where - i.astype(where.dtype)
        return ExternalEffects.of(x.p.dtype, push=(1.0 - part) * self.points[i] + part * self.points[i + 1])
