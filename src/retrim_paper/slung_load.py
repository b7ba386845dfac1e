"""The reference and the scores of flights with a load on a cable."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from retrim.physics import LoadState, SlungLoad, State
from retrim.physics.disturbance import stateful_parts
from retrim.physics.slung_load import swing_angle
from retrim.physics.substep import SUBSTEP
from retrim.runkit.flights import Flight
from retrim.tasks.reference import Reference
from retrim.tasks.shapes import smooth_start

STOP, BRAKING, END = 14.0, 0.6, 26.0  # [s]: begin of the stop, its duration, and the end of the reference
REST_SWING = math.radians(5.0)  # swing below which the load is at rest


def circle_and_stop() -> Reference:
    """Return a circle of 1 m in 3 s from (0, 0, 1), from which the vehicle stops within 0.6 s."""

    def path(t: float) -> list[float]:
        brake = min(max((t - STOP) / BRAKING, 0.0), 1.0)
        # The speed falls as 1 - (3 x^2 - 2 x^3), so the acceleration is continuous.
        lap_time = smooth_start(min(t, STOP)) + BRAKING * (brake - brake**3 + 0.5 * brake**4)
        phi = 2.0 * math.pi * lap_time / 3.0
        return [1.0 - math.cos(phi), -math.sin(phi), 1.0]

    return Reference.of(path, seconds=END, points=1301)


def swing_angles(flight: Flight) -> np.ndarray:
    """Return the angle between cable and vertical at the end of each tick of a flight [rad].

    The log does not contain the load. Its motion follows from that of the vehicle, which is interpolated between ticks.

    Raises:
        ValueError: The scenario has no load on a cable.
    """
    load = next((p for p in stateful_parts(flight.spec.scenario.make_disturbance()) if isinstance(p, SlungLoad)), None)
    if load is None:
        raise ValueError(f"the scenario {flight.spec.scenario.disturbance!r} has no load on a cable")
    n = round(flight.log.dt / SUBSTEP)
    p, v = _interpolate(np.asarray(flight.log.true.p), np.asarray(flight.log.true.v), flight.log.dt, n)
    angles = _angles(load, *(jnp.asarray(a, jnp.zeros(()).dtype) for a in (p, v, SUBSTEP * np.arange(len(p)))))
    return np.asarray(angles)[n - 1 :: n]


def seconds_to_calm(flight: Flight) -> float:
    """Return the time from the end of the stop until the swing remains below five degrees [s].

    A flight whose swing never remains below this angle has the time until its end.
    """
    t, angles = np.asarray(flight.log.t)[1:], swing_angles(flight)
    large = t[(angles > REST_SWING) & (t > STOP + BRAKING)]
    return float(large[-1] - STOP - BRAKING) if len(large) else 0.0


def _interpolate(p: np.ndarray, v: np.ndarray, dt: float, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities at ``n`` times in each tick, by cubic Hermite interpolation."""
    s = (np.arange(n) / n)[None, :, None]
    p0, p1, v0, v1 = p[:-1, None], p[1:, None], dt * v[:-1, None], dt * v[1:, None]
    blend, slope = 3.0 * s**2 - 2.0 * s**3, (6.0 * s - 6.0 * s**2) / dt
    positions = p0 + blend * (p1 - p0) + (s**3 - 2.0 * s**2 + s) * v0 + (s**3 - s**2) * v1
    velocities = slope * (p1 - p0) + ((3.0 * s**2 - 4.0 * s + 1.0) * v0 + (3.0 * s**2 - 2.0 * s) * v1) / dt
    return positions.reshape(-1, 3), velocities.reshape(-1, 3)


@jax.jit
def _angles(
    load: SlungLoad, p: Float[Array, "n 3"], v: Float[Array, "n 3"], t: Float[Array, " n"]
) -> Float[Array, " n"]:
    level = jnp.eye(3, dtype=p.dtype)

    def substep(s: LoadState, row: tuple[Array, Array, Array]) -> tuple[LoadState, Array]:
        x = State(row[0], level, row[1])
        _, s = load.advance(s, row[2], x, SUBSTEP)
        return s, swing_angle(s, x)

    angles: Array = lax.scan(substep, load.init(State(p[0], level, v[0])), (p, v, t))[1]
    return angles
