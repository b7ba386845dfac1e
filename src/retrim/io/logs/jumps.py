"""Detects jumps in an estimate that a vehicle cannot make, such as estimator resets and swapped markers."""

import numpy as np

from .on_one_clock import Ticks

LEAST = {"velocity": 4.0, "attitude": 4.0}  # minimum difference between a tick and its neighbours [m/s^2], [rad/s]
LEAST_SPEED = 2.0  # minimum difference between a position step and its neighbours [m/s]
NOISE_FACTOR = 5.0  # threshold in multiples of the noise
ENDS = 3.0  # factor on the threshold for a step at an end of the log
CALM_SHARE = 0.25  # for a step at an end of the log: largest difference between its neighbours, as a share of the step
STEP_DISTANCE = 2  # distance between compared steps in ticks; a sample every two ticks is spread over both


def jumps_of(ticks: Ticks, name: str) -> np.ndarray:
    """Return the ticks immediately after a jump in velocity or attitude, (n,).

    A jump in an estimate appears as an acceleration, or a rate, in a single tick.
    """
    from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

    if name == "velocity":
        steps = np.diff(ticks.v, axis=0) / ticks.dt
    else:
        steps = Rotation.from_matrix(np.swapaxes(ticks.R[:-1], 1, 2) @ ticks.R[1:]).as_rotvec() / ticks.dt
    return np.concatenate([[False], stands_out(steps, ticks.known[1:] & ticks.known[:-1], LEAST[name])])


def stands_out(steps: np.ndarray, usable: np.ndarray, least: float) -> np.ndarray:
    """Return the steps that differ from the steps before and after them by more than the noise.

    Args:
        steps: Steps per unit of time, (n, columns).
        usable: Steps that are used to estimate the noise, (n,).
        least: Minimum difference for a detected step, whatever the noise.
    """
    if len(steps) < 4 * STEP_DISTANCE:
        return np.zeros(len(steps), dtype=bool)
    before, after = np.zeros_like(steps), np.zeros_like(steps)
    before[STEP_DISTANCE:] = steps[STEP_DISTANCE:] - steps[:-STEP_DISTANCE]
    after[:-STEP_DISTANCE] = steps[:-STEP_DISTANCE] - steps[STEP_DISTANCE:]
    before[:STEP_DISTANCE] = np.where(
        np.abs(after[STEP_DISTANCE : 2 * STEP_DISTANCE]) < CALM_SHARE * np.abs(after[:STEP_DISTANCE]),
        after[:STEP_DISTANCE],
        0.0,
    )
    late = np.abs(before[-2 * STEP_DISTANCE : -STEP_DISTANCE]) < CALM_SHARE * np.abs(before[-STEP_DISTANCE:])
    after[-STEP_DISTANCE:] = np.where(late, before[-STEP_DISTANCE:], 0.0)
    far = np.where(before * after > 0.0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    bent = np.abs(0.5 * (before + after))[usable] if usable.any() else np.zeros((1, 3))
    limit = np.maximum(least, NOISE_FACTOR * 1.4826 * np.median(bent, axis=0))
    far[:STEP_DISTANCE] /= ENDS  # so that a vehicle that starts or stops does not count as a jump
    far[-STEP_DISTANCE:] /= ENDS
    return np.asarray(np.any(far > limit, axis=1))
