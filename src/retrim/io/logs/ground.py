"""Detects when a vehicle is on the ground: its thrust is below hover thrust, but it does not move."""

import numpy as np

from ...physics.state import STANDARD_GRAVITY
from .on_one_clock import UP, Ticks
from .resampling import runs, smooth

FLIGHT_THRUST = 0.3  # share of the largest thrusts below which a vehicle is not in the air
AVERAGING_TIME, LEAST_DURATION = 0.3, 0.5  # averaging time, and shortest duration of a contact [s]
CONTACT_SPEED = 0.2  # [m/s], largest speed in contact
REST_SPEED = 0.1  # [m/s], largest speed before the vehicle leaves its position
CONTACT_ACCELERATION, CONTACT_RATES = 1.0, 0.2  # [m/s^2], [rad/s]: a vehicle in contact accelerates and turns less
LEAST_SUPPORT = 0.85  # share of hover thrust below which a vehicle cannot stay in the air
PLACE = 0.05  # height tolerance around the contact height [m]
FLIGHT_SPEED, FLIGHT_HEIGHT = 0.3, 0.3  # [m/s], [m] above the lowest position: a vehicle that exceeds either one flies
LEAST_FLIGHT = 2.0  # flight time that is sufficient to determine hover thrust [s]


def on_ground(ticks: Ticks) -> np.ndarray:
    """Return a mask of the ticks at which the vehicle is not in the air, (n,)."""
    idle = mark_idle(ticks.thrust, ticks.known, max(1, round(1.0 / ticks.dt)))
    rows = max(1, round(AVERAGING_TIME / ticks.dt))
    speed, push, turn = (
        np.linalg.norm(np.stack([smooth(column, rows) for column in x.T], axis=1), axis=1)
        for x in (ticks.v, ticks.a, ticks.rates)
    )
    hover = _hover(ticks, ~idle & ticks.known, speed)
    lift = smooth(ticks.thrust * ticks.R[:, 2, 2], rows)
    stands = (speed < CONTACT_SPEED) & (push < CONTACT_ACCELERATION) & (turn < CONTACT_RATES)
    z = ticks.p[:, 2]
    contact = runs(stands & (lift < LEAST_SUPPORT * hover), max(1, round(LEAST_DURATION / ticks.dt)))
    for first, last in _spans(np.minimum(speed, np.linalg.norm(ticks.v, axis=1)) < REST_SPEED):
        part = slice(first, last)
        if contact[part].any():
            height = float(np.median(z[part][contact[part]]))
            contact[part] |= np.abs(z[part] - height) < PLACE
    return np.asarray(idle | contact)


def mark_idle(thrust: np.ndarray, known: np.ndarray, rows: int) -> np.ndarray:
    """Return where the mean thrust over ``rows`` rows is below that of a flight.

    A few damaged samples do not change the result.

    Args:
        thrust: Upward thrust in any unit, (n,).
        known: Ticks at which it is known, (n,); at least one.
        rows: Number of rows.
    """
    positive = thrust[known & (thrust > 0.0)]
    largest = np.percentile(positive, 95) if positive.size else 0.0
    mean = smooth(np.clip(np.nan_to_num(thrust), 0.0, largest), rows)
    return np.asarray(mean <= FLIGHT_THRUST * np.percentile(mean[known], 95))


def _hover(ticks: Ticks, candidates: np.ndarray, speed: np.ndarray) -> float:
    """Return the hover thrust, in the log's unit, from ticks at which the vehicle certainly flies."""
    if not candidates.any():
        return 0.0
    z = ticks.p[:, 2]
    flies = candidates & ((speed > FLIGHT_SPEED) | (z > np.percentile(z[candidates], 5) + FLIGHT_HEIGHT))
    if np.sum(flies) * ticks.dt < LEAST_FLIGHT:
        flies = candidates
    upwards = np.maximum((ticks.a + UP)[flies, 2], 0.3 * STANDARD_GRAVITY)  # vertical only, as wind pushes sideways
    return float(np.median(ticks.thrust[flies] * ticks.R[flies, 2, 2] * STANDARD_GRAVITY / upwards))


def _spans(flags: np.ndarray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
