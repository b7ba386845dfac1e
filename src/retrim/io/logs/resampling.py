"""Resamples series to one clock: states are interpolated, and commands are held until the next sample."""

import numpy as np

from .series import Series

GAP = 2.5  # number of periods without a sample after which a quantity is unknown


def period(series: Series) -> float:
    """Return the median time between samples [s]."""
    return float(np.median(np.diff(series.t)))


def mark_known(series: Series, grid: np.ndarray, dt: float, *, hold_s: float = 0.0) -> np.ndarray:
    """Return where on a grid a series is known: between samples that are not far apart.

    Args:
        series: The samples.
        grid: Times [s].
        dt: Period of the grid [s].
        hold_s: Minimum time for which a command is held without a new sample [s].
    """
    longest = max(GAP * max(period(series), dt), hold_s)
    after = np.searchsorted(series.t, grid, side="right")
    inside = (grid >= series.t[0]) & (grid <= series.t[-1])
    left, right = np.clip(after - 1, 0, len(series.t) - 1), np.clip(after, 0, len(series.t) - 1)
    at_sample = series.t[left] == grid
    result: np.ndarray = inside & (at_sample | (series.t[right] - series.t[left] <= longest))
    return result


def interpolate(series: Series, grid: np.ndarray) -> np.ndarray:
    """Return the values at grid times, interpolated linearly between samples."""
    return np.stack([np.interp(grid, series.t, column) for column in series.values.T], axis=1)


def hold_last(series: Series, grid: np.ndarray) -> np.ndarray:
    """Return the last value at or before each grid time."""
    return series.values[np.clip(np.searchsorted(series.t, grid, side="right") - 1, 0, None)]


def mean_of_steps(series: Series, grid: np.ndarray, dt: float) -> np.ndarray:
    """Return the mean of a command over the tick after each grid time; each value is held until the next."""
    steps = np.diff(series.t)[:, None]
    total = np.concatenate([np.zeros((1, series.values.shape[1])), np.cumsum(series.values[:-1] * steps, axis=0)])
    end = series.t[-1] + 2.0 * dt
    t = np.concatenate([series.t, [end]])
    total = np.concatenate([total, total[-1:] + series.values[-1:] * (end - series.t[-1])])
    both = [np.stack([np.interp(at, t, column) for column in total.T], axis=1) for at in (grid, grid + dt)]
    return np.asarray((both[1] - both[0]) / dt)


def mean_between(series: Series, grid: np.ndarray, dt: float) -> np.ndarray:
    """Return the mean of a measured quantity over the tick after each grid time, linear between samples."""
    areas = 0.5 * np.diff(series.t)[:, None] * (series.values[1:] + series.values[:-1])
    total = np.concatenate([np.zeros((1, series.values.shape[1])), np.cumsum(areas, axis=0)])

    def area_until(at: np.ndarray) -> np.ndarray:
        k = np.clip(np.searchsorted(series.t, at, side="right") - 1, 0, len(series.t) - 2)
        step = np.clip(at, series.t[0], series.t[-1]) - series.t[k]
        slope = (series.values[k + 1] - series.values[k]) / (series.t[k + 1] - series.t[k])[:, None]
        beyond = at - np.clip(at, series.t[0], series.t[-1])
        return np.asarray(total[k] + step[:, None] * (series.values[k] + 0.5 * step[:, None] * slope)
                          + beyond[:, None] * series.values[np.where(at < series.t[0], 0, -1)])  # fmt: skip

    return np.asarray((area_until(grid + dt) - area_until(grid)) / dt)


def interpolate_attitudes(t: np.ndarray, R: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return the attitudes at grid times, interpolated along the shortest rotation between samples."""
    from scipy.spatial.transform import Rotation, Slerp  # local, because it takes as long to import as all of retrim

    inside = np.clip(grid, t[0], t[-1])
    return np.asarray(Slerp(t, Rotation.from_matrix(R))(inside).as_matrix())


def derivative(values: np.ndarray, dt: float) -> np.ndarray:
    """Return the five-point derivative of columns on a grid; two rows at each end repeat their neighbour."""
    inner = (values[:-4] - 8.0 * values[1:-3] + 8.0 * values[3:-1] - values[4:]) / (12.0 * dt)
    return np.concatenate([inner[:1], inner[:1], inner, inner[-1:], inner[-1:]])


def smooth(x: np.ndarray, rows: int) -> np.ndarray:
    """Return the centred mean of a column over about ``rows`` rows, and over fewer at the ends."""
    kernel = np.ones(min(rows, len(x)))
    return np.asarray(np.convolve(x, kernel, mode="same") / np.convolve(np.ones(len(x)), kernel, mode="same"))


def around(valid: np.ndarray, reach: int) -> np.ndarray:
    """Return where all rows up to ``reach`` before and after are valid."""
    mask = np.concatenate([np.zeros(reach, bool), valid, np.zeros(reach, bool)])
    return np.asarray(np.all([mask[k : k + len(valid)] for k in range(2 * reach + 1)], axis=0))


def runs(flags: np.ndarray, length: int) -> np.ndarray:
    """Return where flags belong to a run of at least ``length`` rows."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    result = np.zeros(len(flags), dtype=bool)
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        result[first:last] = last - first >= length
    return result
