"""Transition from one reference to another in flight, without jumps in position, velocity, acceleration or jerk."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.vehicle import Vehicle
from .abstract_reference import AbstractReference, Point, TurnedReference
from .feasibility import beyond_limits
from .flatness import FULL_TURN
from .reference import Reference

LEAD_TIME = 1.0  # [s], duration of the old reference in the table of a transition
DURATIONS = (2.0, 3.0, 4.0, 6.0, 8.0)  # [s], possible durations; the first one that the vehicle can fly is used


def transition_between(old: Reference, new: Reference, at: float, vehicle: Vehicle) -> Reference:
    """Return a reference that follows ``old`` until ``at``, and then changes to ``new``.

    ``new`` begins from rest at ``at``, and its share grows in a 7th-order smooth step. The step is slow enough for the
    vehicle to fly, but lasts at most eight seconds.

    Args:
        old: Reference before the transition.
        new: Reference after the transition; its table begins at 0 s.
        at: Start of the transition [s].
        vehicle: Vehicle of the flight.

    Returns:
        A table with the same sizes as ``old``, so that it can replace ``old`` in a compiled program. The table begins
        one second before ``at``. A roll-out may start in the lap of ``new``.
    """
    for lasting in DURATIONS:
        table = _table(old, new, at, lasting)
        if not beyond_limits(np.asarray(table.rows, dtype=float), float(table.every), vehicle):
            break
    return table


class SplicedReference(AbstractReference):
    """A flight's successive references, combined into one; see :func:`splice`."""

    pieces: Reference
    """Tables of equal size; every leaf has a leading axis."""
    began: Float[Array, " k"]
    """Time from which each piece is followed [s], in order."""

    @property
    def lap(self) -> Float[Array, "2"]:
        """Lap of the last piece [s]."""
        return self.pieces.lap[-1]

    @property
    def joins(self) -> Float[Array, "m 2"]:
        """Time spans of the last piece in which a roll-out may start [s]."""
        return self.pieces.joins[-1]

    def __call__(self, t: Float[Array, ""]) -> Point:
        """Return the active reference at time ``t`` [s]."""
        now = jnp.maximum(jnp.sum(self.began <= t) - 1, 0)
        piece: Reference = jax.tree.map(lambda leaf: leaf[now], self.pieces)
        return piece(t)

    def distance(self, p: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the distance from ``p`` to the nearest lap of any piece [m]."""
        return jnp.min(jax.vmap(lambda piece: piece.distance(p))(self.pieces))

    def in_frame(self, frame: EffectiveGravityFrame) -> TurnedReference:
        """Return the same reference in the coordinates of ``frame``."""
        return TurnedReference(self, frame)


def splice(pieces: Sequence[tuple[float, Reference]]) -> SplicedReference:
    """Combine a flight's successive references into one reference.

    Args:
        pieces: Time from which each reference was followed [s], and the reference, in order; tables of equal size.
    """
    began, tables = zip(*pieces, strict=True)
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *tables)
    return SplicedReference(together, jnp.asarray(began, together.every.dtype))


def _table(old: Reference, new: Reference, at: float, lasting: float) -> Reference:
    start, end = (float(t) for t in new.lap)
    if start < end:
        begins = at + max(start, lasting)
        lap = (begins, begins + end - start)
    else:
        lap = (at + max(end, lasting),) * 2
    since = at - LEAD_TIME
    times = np.linspace(since, lap[1], old.rows.shape[0])
    join = lap if lap[0] < lap[1] else (since, lap[1])
    dtype = old.every.dtype
    rows = _mix(old, new, *(jnp.asarray(value, dtype) for value in (times, at, lasting)))
    return Reference(
        rows,
        jnp.asarray(times[1] - times[0], dtype),
        jnp.asarray(lap, dtype),
        jnp.broadcast_to(jnp.asarray(join, dtype), old.joins.shape),
        jnp.asarray(since, dtype),
    )


@eqx.filter_jit
def _mix(
    old: Reference, new: Reference, times: Float[Array, " n"], at: Float[Array, ""], lasting: Float[Array, ""]
) -> Float[Array, "n 18"]:
    first, last = jax.vmap(old)(times), jax.vmap(new)(jnp.maximum(times - at, 0.0))
    # A heading may jump by whole turns between laps, and a share of such a jump is not a whole turn.
    first, last = (points._replace(heading=jnp.unwrap(points.heading)) for points in (first, last))
    away = (first.heading - last.heading)[jnp.sum(times < at)]
    turns = FULL_TURN * jnp.round(away / FULL_TURN)  # the shortest way round

    def row(t: Float[Array, ""], before: Point, after: Point) -> Float[Array, "18"]:
        s, s1, s2, s3 = _smooth_step(jnp.clip((t - at) / lasting, 0.0, 1.0))
        s1, s2, s3 = s1 / lasting, s2 / lasting**2, s3 / lasting**3
        p, v, a = after.p - before.p, after.v - before.v, after.a - before.a
        turn, rate = after.heading + turns - before.heading, after.heading_rate - before.heading_rate
        moving_a = before.a + s * a + 2.0 * s1 * v + s2 * p
        jerk = before.jerk + s * (after.jerk - before.jerk) + 3.0 * s1 * a + 3.0 * s2 * v + s3 * p
        heading, heading_rate = before.heading + s * turn, before.heading_rate + s * rate + s1 * turn
        point = Point.of(before.p + s * p, before.v + s * v + s1 * p, moving_a, jerk, heading, heading_rate)
        return jnp.concatenate([leaf.reshape(-1) for leaf in point])

    return jax.vmap(row)(times, first, last)


def _smooth_step(x: Float[Array, ""]) -> tuple[Float[Array, ""], ...]:
    """Return a 7th-order step from 0 to 1, and its first three derivatives, which are zero at both ends."""
    s = x**4 * (35.0 - 84.0 * x + 70.0 * x**2 - 20.0 * x**3)
    first = 140.0 * x**3 * (1.0 - x) ** 3
    second = 420.0 * x**2 * (1.0 - x) ** 2 * (1.0 - 2.0 * x)
    third = 840.0 * x * (1.0 - x) * (1.0 - 5.0 * x + 5.0 * x**2)
    return s, first, second, third
