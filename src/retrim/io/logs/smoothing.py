"""Derives velocities from a log's positions with local cubics in centred windows, without a lag."""

from pathlib import Path

import numpy as np

from ...errors import LogError
from .jumps import LEAST_SPEED, stands_out
from .on_one_clock import SHORTEST
from .resampling import GAP
from .series import Series

LEAST_SAMPLES, LONGEST_HALF_WIDTH = 2, 0.15  # half-width of a window: smallest number of samples, and longest time [s]
NOISE_TARGET = 0.3  # noise in the second derivative at which a window is wide enough [m/s^2]
PROBES, CHUNK = 2000, 4096  # number of samples used to choose the window, and number fitted at a time


def slope_of(path: Path, position: Series, metres: float) -> tuple[Series, str]:
    """Return the derivative of positions, and a note on its window and noise.

    A cubic is fitted to the samples around each sample. The window is centred, so the derivative has no lag. It is
    the shortest window for which the noise in the second derivative is at most ``NOISE_TARGET``, but it extends by at
    most ``LONGEST_HALF_WIDTH`` to each side.

    Args:
        path: The log file, for messages.
        position: Positions in the log's unit.
        metres: Metres per unit.

    Raises:
        LogError: There are too few samples.
    """
    t, p = position.t, position.values
    if len(t) < 4 * LEAST_SAMPLES + 2:
        raise LogError(f"{path}: {len(t)} positions are too few to differentiate")
    tick = float(np.median(np.diff(t)))
    if tick < SHORTEST:
        raise LogError(f"{path}: position comes every {tick:.3g} s; is time in ms, us or ns?")
    steps = metres * np.diff(p, axis=0) / np.diff(t)[:, None]
    jumps = stands_out(steps, np.ones(len(steps), dtype=bool), LEAST_SPEED)
    pieces = np.concatenate([[0], np.cumsum(jumps | (np.diff(t) >= GAP * tick))])
    most = min(max(LEAST_SAMPLES, int(LONGEST_HALF_WIDTH / tick)), (len(t) - 1) // 2)
    for half in sorted({min(most, round(LEAST_SAMPLES * 1.4**k)) for k in range(20)}):
        probes = np.linspace(half, len(t) - 1 - half, min(PROBES, len(t) - 2 * half)).astype(int)
        noise, shake = (metres * each for each in _cubics(t, p, pieces, probes, half, tick)[1:])
        if shake <= NOISE_TARGET:
            break
    v = np.full(p.shape, np.nan)
    for first in range(half, len(t) - half, CHUNK):
        rows = np.arange(first, min(first + CHUNK, len(t) - half))
        v[rows] = _cubics(t, p, pieces, rows, half, tick)[0]
    result = np.isfinite(v[:, 0])
    remark = (
        f"velocity is the derivative of the position, smoothed over {2000 * half * tick:.0f} ms, centred, without a "
        f"lag; its noise is about {noise:.2g} m/s"
    )
    if jumps.any():
        remark += f"; the position jumps {np.sum(jumps)} times, and the ticks around are left out"
    return Series(t[result], v[result]), remark


def _cubics(
    t: np.ndarray, p: np.ndarray, pieces: np.ndarray, rows: np.ndarray, half: int, tick: float
) -> tuple[np.ndarray, float, float]:
    """Return slopes at some samples, NaN where a piece ends, and the noise in slopes and second derivatives."""
    k = rows[:, None] + np.arange(-half, half + 1)
    whole = pieces[k[:, 0]] == pieces[k[:, -1]]
    x = np.where(whole[:, None], (t[k] - t[rows][:, None]) / (half * tick), np.linspace(-1.0, 1.0, 2 * half + 1))
    X = np.stack([np.ones_like(x), x, x**2, x**3], axis=2)
    inverse = np.linalg.solve(np.swapaxes(X, 1, 2) @ X, np.swapaxes(X, 1, 2))
    theta = inverse @ p[k]
    squares = np.sum((p[k] - X @ theta)[whole] ** 2, axis=(1, 2))
    freedom = (2 * half - 3) * p.shape[1]
    middle = freedom * (1.0 - 2.0 / (9.0 * freedom)) ** 3  # the median of the sum of ``freedom`` squares
    sigma = float(np.sqrt(np.median(squares) / middle)) if squares.size else 0.0
    slope, bend = (float(np.median(np.linalg.norm(inverse[:, order], axis=1))) for order in (1, 2))
    noise, shake = sigma * slope / (half * tick), 2.0 * sigma * bend / (half * tick) ** 2
    return np.where(whole[:, None], theta[:, 1] / (half * tick), np.nan), noise, shake
