"""Determines the times at which a disturbance changes, and a flight's recovery times."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array

from ..config.disturbances import disturbance
from ..physics.disturbance import effects_at
from ..physics.effects import ExternalEffects
from ..physics.state import State

STEP = 0.1  # time between samples of a disturbance [s]
SAME_CHANGE = 0.5  # changes within this time count as one [s]
FREQUENT = 10  # a disturbance with more changes per flight counts as changing all the time


def timeline(name: str, home: Array, seconds: float) -> tuple[np.ndarray, ExternalEffects, list[int]]:
    """Sample a disturbance's effects at a position.

    Args:
        name: Name of the disturbance.
        home: Position, world [m].
        seconds: Length of the timeline [s].

    Returns:
        The times [s], the effects at each of them (leading axis), and the samples that differ from the previous one.
    """
    times = np.linspace(0.0, seconds, max(1, round(seconds / STEP)), endpoint=False)
    result = effects_at(times, State.at(home), disturbance(name))
    values = np.concatenate([np.asarray(leaf).reshape(len(times), -1) for leaf in jax.tree.leaves(result)], axis=1)
    changes = np.flatnonzero(np.any(np.diff(values, axis=0) != 0, axis=1)) + 1
    return times, result, changes.tolist()


def change_times(name: str, home: Array, seconds: float) -> list[float]:
    """Return the times at which a disturbance changes in flight [s]; empty if it changes all the time, or never.

    Changes within half a second count as one; a kick is one change, not two.
    """
    times, _, changes = timeline(name, home, seconds)
    if len(changes) > FREQUENT:
        return []
    result = [float(times[i]) for i in changes]
    return [t for i, t in enumerate(result) if i == 0 or t - result[i - 1] > SAME_CHANGE]


def recoveries(
    t: np.ndarray, error: np.ndarray, changes: Sequence[float], limit: float, *, terminated: bool = False
) -> list[float]:
    """Return the time after each change [s] from which the error stays below ``limit`` until the next change.

    Args:
        t: Times in a flight [s].
        error: Error at each time [m].
        changes: Times at which the world changed [s].
        limit: Largest error after recovery [m].
        terminated: Whether the flight was terminated; all recovery times are then infinite.

    Returns:
        One time for each change; it is infinite if the error is above the limit just before the next change, or at the
        end. Without changes, one time from the start of the flight.
    """
    starts = list(changes) or [0.0]
    result = list[float]()
    for start, end in zip(starts, [*starts[1:], np.inf], strict=True):
        rows = (t >= start - 1e-6) & (t < end - 1e-6)
        outside = error[rows] >= limit
        if terminated or not len(outside) or outside[-1]:
            result.append(float("inf"))
        else:
            result.append(float(t[rows][np.flatnonzero(outside)[-1] + 1] - start) if outside.any() else 0.0)
    return result
