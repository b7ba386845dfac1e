"""Trajectories to track: position, velocity, heading and the required command, as functions of time.

Every reference is a table of the same type, which a policy takes as data. A new trajectory therefore does not need a
new compilation, and a policy trained on a family can fly a member on which it was not trained.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import STANDARD_GRAVITY
from ..physics.vehicle import Vehicle
from .abstract_reference import AbstractReference, Point, TurnedReference
from .feasibility import unflyable
from .flatness import STEP, Path3, flat_rows

POINTS = 1024  # number of rows in a table


class Reference(AbstractReference):
    """An evenly sampled trajectory; see :meth:`of`."""

    rows: Float[Array, "n 18"]
    """Rows with the fields of :class:`Point`."""
    every: Float[Array, ""]
    """Time between rows [s]."""
    lap: Float[Array, "2"]
    """Start and end of the repeating lap [s]; equal if the last row is held."""
    joins: Float[Array, "m 2"]
    """Time spans in which a roll-out may start [s]; each is equally likely."""
    since: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros(()))
    """Time of the first row [s]."""

    @classmethod
    def of(cls, path: Path3, *, seconds: float, lap: float | None = None, points: int = POINTS) -> "Reference":
        """Sample a path.

        Args:
            path: Function of the time since take-off [s]. The function returns the world coordinates x, y, z [m] and,
                optionally, the heading [rad] (default 0), which may jump by whole turns. The function is evaluated in
                [0, ``seconds``], and a few milliseconds beyond if there is a lap.
            seconds: End of the table [s].
            lap: Start of the repeating lap, which extends to the end [s]; None if the end is held.
            points: Number of rows. References with the same number of rows share one compiled program.

        Returns:
            The table, with velocities and commands from finite differences of the path.

        Raises:
            ValueError: The sizes are invalid, or the path does not return 3 or 4 finite numbers; the message then
                contains the time.
        """
        if not seconds > 0:
            raise ValueError(f"Reference: seconds must be positive, got {seconds}")
        if points < 2:
            raise ValueError(f"Reference: points must be at least 2, got {points}")
        if lap is not None and not 0 <= lap < seconds:
            raise ValueError(f"Reference: lap must be at least 0 and less than seconds = {seconds}, got {lap}")
        times = np.linspace(0.0, seconds, points)
        last = seconds - STEP if lap is None else math.inf
        rows = flat_rows(path, times, last)
        ends = (seconds, seconds) if lap is None else (lap, seconds)
        joins = [(0.0, seconds)] if lap is None else [(0.0, lap), (lap, seconds), (lap, seconds)]
        return cls(jnp.asarray(rows), jnp.array(times[1]), jnp.array(ends), jnp.array(joins))

    @classmethod
    def from_rows(cls, rows: Float[Array, "n 18"], every: Float[Array, ""]) -> "Reference":
        """Return a reference without a lap from evenly spaced rows.

        Args:
            rows: Rows with the fields of :class:`Point`.
            every: Time between rows [s].
        """
        end = every * (rows.shape[0] - 1)
        return cls(rows, every, jnp.stack([end, end]), jnp.stack([jnp.zeros_like(end), end])[None])

    def __call__(self, t: Float[Array, ""]) -> Point:
        """Return the reference at time ``t`` [s], linearly interpolated between rows, or hover once the end is held."""
        start, end = self.lap[0], self.lap[1]
        length = end - start
        lap_time = start + (t - start) % jnp.where(length > 0, length, 1.0)
        t = jnp.where(t < end, t, jnp.where(length > 0, lap_time, end))
        where = jnp.clip((t - self.since) / self.every, 0.0, self.rows.shape[0] - 1.0)
        i = jnp.clip(jnp.floor(where), 0, self.rows.shape[0] - 2).astype(jnp.int32)
        part = (where - i.astype(where.dtype)).astype(self.rows.dtype)
        before, after = lax.dynamic_slice_in_dim(self.rows, i, 2)  # one gather under vmap
        row = (1.0 - part) * before + part * after
        over = (length <= 0) & (t >= end)  # at rest, where the end is held
        hover = jnp.zeros(4, dtype=row.dtype).at[0].set(STANDARD_GRAVITY)
        v, u = jnp.where(over, jnp.zeros_like(row[3:6]), row[3:6]), jnp.where(over, hover, row[6:10])
        moving = jnp.where(over, jnp.zeros_like(row[11:]), row[11:])
        return Point(row[:3], v, u, row[10], moving[:3], moving[3:6], moving[6])

    def distance(self, p: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the cross-track error [m]: the distance from ``p`` to the polyline of the lap's rows.

        Without a lap, the polyline contains all rows.

        Args:
            p: Position, world [m].
        """
        times = self.since + self.every * jnp.arange(self.rows.shape[0] - 1, dtype=self.every.dtype)
        on_lap = (times >= self.lap[0] - self.every) | (self.lap[0] == self.lap[1])
        begin, along = self.rows[:-1, :3], jnp.diff(self.rows[:, :3], axis=0)
        length = jnp.sum(along * along, axis=1)
        part = jnp.sum((p[None] - begin) * along, axis=1) / jnp.where(length > 0.0, length, 1.0)
        nearest = begin + jnp.clip(part, 0.0, 1.0)[:, None] * along
        away = jnp.sqrt(jnp.sum((nearest - p[None]) ** 2, axis=1))
        return jnp.min(jnp.where(on_lap, away, jnp.inf))

    def in_frame(self, frame: EffectiveGravityFrame) -> TurnedReference:
        """Return the trajectory in the coordinates of ``frame``."""
        return TurnedReference(self, frame)

    def infeasibility(self, vehicle: Vehicle) -> str | None:
        """Return the reasons why the vehicle cannot fly the reference, in words; None if the vehicle can fly all of it.

        Possible reasons are a start or end at speed, velocity jumps, a lap that does not close, excessive thrust, a
        descent faster than free fall, excessive body rates, and positions below the ground.

        Args:
            vehicle: Vehicle to fly the reference.
        """
        lap = (float(self.lap[0] - self.since), float(self.lap[1] - self.since))
        return "; ".join(unflyable(np.asarray(self.rows, dtype=float), float(self.every), lap, vehicle)) or None


def join_references(
    references: Sequence[AbstractReference], *, seconds: float = 20.0, every: float = 0.02
) -> Reference:
    """Join a family of references end to end into one table for training.

    Args:
        references: The members.
        seconds: Duration of each member [s]; roll-outs of up to 4 s stay within a member.
        every: Time between rows [s].

    Returns:
        A reference without a lap. A roll-out may start in any member, but not within 5 s of that member's end.

    Raises:
        ValueError: The family is empty, or the duration is too short.
    """
    if not references or seconds < 6.0:
        raise ValueError(f"joined: {len(references)} references of {seconds} s; at least 1, of at least 6 s")
    times = every * jnp.arange(round(seconds / every), dtype=float)
    rows = []
    for reference in references:
        rows.append(_sample(reference, times))
    joins = [(k * seconds, (k + 1) * seconds - 5.0) for k in range(len(references))]
    end = len(references) * seconds
    return Reference(jnp.concatenate(rows), jnp.asarray(every, float), jnp.array([end, end]), jnp.array(joins))


@eqx.filter_jit
def _sample(reference: AbstractReference, times: Float[Array, " n"]) -> Float[Array, "n 18"]:
    points = jax.vmap(reference)(times)
    points = points._replace(heading=jnp.unwrap(points.heading))  # it may jump by whole turns between laps
    return jnp.concatenate([leaf.reshape(times.shape[0], -1) for leaf in points], axis=1)
