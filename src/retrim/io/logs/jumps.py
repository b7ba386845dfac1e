"""Ticks at which an estimate jumps though no vehicle moves so: resets of an estimator, swapped markers."""

import numpy as np

from .on_one_clock import Ticks

LEAST = {"velocity": 4.0, "attitude": 4.0}  # [m/s^2], [rad/s] by which one tick must stand out from those around it
LEAST_SPEED = 2.0  # [m/s] by which the step of a position must
BEYOND = 5.0  # times the noise
ENDS = 3.0  # times as far must a step at an end of the log stand out
CALM = 0.25  # share of a step at an end of the log by which those beside it may differ
BESIDE = 2  # ticks before and after with which one is compared: one sample in two ticks is spread over both


def jumps_of(ticks: Ticks, name: str) -> np.ndarray:
    """Return the ticks since whose one before a velocity or an attitude has jumped, (n,).

    A step of an estimate is one tick of an acceleration, or of a rate, that is there neither before nor after.
    """
    from scipy.spatial.transform import Rotation  # here: it takes as long to import as all of retrim

    if name == "velocity":
        steps = np.diff(ticks.v, axis=0) / ticks.dt
    else:
        steps = Rotation.from_matrix(np.swapaxes(ticks.R[:-1], 1, 2) @ ticks.R[1:]).as_rotvec() / ticks.dt
    return np.concatenate([[False], stands_out(steps, ticks.known[1:] & ticks.known[:-1], LEAST[name])])


def stands_out(steps: np.ndarray, known: np.ndarray, least: float) -> np.ndarray:
    """Return which steps are unlike those before and after, by more than the noise.

    Args:
        steps: Per time, (n, columns).
        known: Which of them tell the noise, (n,).
        least: By which a step must stand out, whatever the noise is.
    """
    if len(steps) < 4 * BESIDE:
        return np.zeros(len(steps), dtype=bool)
    before, after = np.zeros_like(steps), np.zeros_like(steps)
    before[BESIDE:] = steps[BESIDE:] - steps[:-BESIDE]
    after[:-BESIDE] = steps[:-BESIDE] - steps[BESIDE:]
    before[:BESIDE] = np.where(np.abs(after[BESIDE : 2 * BESIDE]) < CALM * np.abs(after[:BESIDE]), after[:BESIDE], 0.0)
    late = np.abs(before[-2 * BESIDE : -BESIDE]) < CALM * np.abs(before[-BESIDE:])
    after[-BESIDE:] = np.where(late, before[-BESIDE:], 0.0)
    far = np.where(before * after > 0.0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    bent = np.abs(0.5 * (before + after))[known] if known.any() else np.zeros((1, 3))
    limit = np.maximum(least, BEYOND * 1.4826 * np.median(bent, axis=0))
    far[:BESIDE] /= ENDS  # a vehicle that starts, or stops, is no jump
    far[-BESIDE:] /= ENDS
    return np.asarray(np.any(far > limit, axis=1))
