"""Fits the response of a measurement to a command: a delay, a second-order lag, a gain and a bias.

The response is linear in the steps of the command, each times the step response at its age. Products of the steps and
the measurement, summed over blocks of a flight, are therefore sufficient for every delay and lag. A bootstrap over the
blocks fits weighted sums of the same products.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..estimation.command_path.history import ages
from ..estimation.command_path.prior import LAGS, LONGEST_DELAY, MOST_RINGING

POLE_SEPARATION = 1e-6  # [s]: two poles with equal time constants are moved apart by this
DELAYS = np.linspace(0.0, LONGEST_DELAY, 13)  # [s], first grid
FIRST_LAGS = np.geomspace(*LAGS, 14)
FIRST_RINGING = (0.0, 0.3, 0.6)
STEPS = np.array([2e-3, 0.1, 0.1])  # first steps of the search: delay [s], logarithm of the lag, shape
SCALE = np.array([1e-3, 0.05, 0.05])  # units in which the search has converged to one hundredth


class Path(NamedTuple):
    """Delay [s], lag 2 zeta / omega [s] and shape of a response; the shape is ``ringing``, 0 for first order."""

    delay: float
    lag: float
    ringing: float


def mean_response(age: np.ndarray, dt: float, path: Path) -> np.ndarray:
    """Return the mean of the step response over the ``dt`` seconds that end at some ages of a step [s].

    Double precision; the same response as ``mean_step_response`` of :mod:`retrim.estimation.command_path.response`.
    """
    kappa = 0.5 * path.ringing / (1.0 - path.ringing)
    root = np.sqrt(complex(1.0 - 4.0 * kappa))
    slow, fast = 0.5 * path.lag * (1.0 + root), 0.5 * path.lag * (1.0 - root)
    if abs(slow - fast) < POLE_SEPARATION:
        slow, fast = slow + POLE_SEPARATION, fast - POLE_SEPARATION
    fast = fast if abs(fast) > POLE_SEPARATION else complex(POLE_SEPARATION)
    t = age - path.delay
    return np.asarray((_ramp(t, slow, fast) - _ramp(t - dt, slow, fast)) / dt)


def _ramp(t: np.ndarray, slow: complex, fast: complex) -> np.ndarray:
    """Return the integral of the step response with two time constants [s]."""
    after = np.maximum(t, 0.0)
    ends = slow**2 * np.exp(-after / slow) - fast**2 * np.exp(-after / fast)
    return np.asarray(after - (slow + fast).real + (ends / (slow - fast)).real)


def respond(command: np.ndarray, dt: float, path: Path) -> np.ndarray:
    """Return the mean response over each tick to a command that is held over each tick, (n,) or (n, columns)."""
    from scipy.signal import fftconvolve  # local, because it takes as long to import as all of retrim

    steps = mean_response(dt * np.arange(1, int(ages(dt)[-1]) + 1), dt, path)
    weights = np.diff(steps, prepend=0.0)
    weights[-1] += 1.0 - steps[-1]
    columns = command.reshape(len(command), -1) - command[:1].reshape(1, -1)
    out = fftconvolve(columns, weights[:, None], axes=0)[: len(command)]
    return np.asarray(command[:1] + out.reshape(command.shape))


class Products(NamedTuple):
    """Sums of products in each block, for outputs that share their response."""

    xx: np.ndarray
    """Products of features: steps of each input, then a constant for each output, (blocks, k, k)."""
    xy: np.ndarray
    """(blocks, k)."""
    yy: np.ndarray
    """(blocks,)."""
    n: np.ndarray
    """Numbers of values, (blocks,)."""

    @classmethod
    def of(
        cls, inputs: Sequence[np.ndarray], y: np.ndarray, blocks: np.ndarray, dt: float, *, bias: bool
    ) -> "Products":
        """Sum over blocks.

        Args:
            inputs: Commands of each output, (n, outputs); the response to a sum of inputs is fitted.
            y: Measurements, (n, outputs).
            blocks: Rows of each block, (blocks, rows).
            dt: Tick [s].
            bias: Whether each output has a bias.
        """
        at, outputs = ages(dt), y.shape[1]
        join = np.stack([np.interp(np.arange(1, at[-1] + 1), at, row) for row in np.eye(len(at))])
        constants = outputs if bias else 0
        k = len(inputs) * (len(at) + 1) + constants
        xx, xy = np.zeros((len(blocks), k, k)), np.zeros((len(blocks), k))
        for b, rows in enumerate(blocks):
            for axis in range(outputs):
                X = np.concatenate([_steps(u[:, axis], rows, join) for u in inputs], axis=1)
                one = np.zeros((len(rows), constants))
                one[:, axis : axis + 1] = 1.0
                X = np.concatenate([X, one], axis=1)
                xx[b] += X.T @ X
                xy[b] += X.T @ y[rows, axis]
        yy = np.sum(y[blocks] ** 2, axis=(1, 2))
        return cls(xx, xy, yy, np.full(len(blocks), float(blocks.shape[1] * outputs)))

    def weigh(self, draw: np.ndarray) -> "Products":
        """Return the sums over blocks, each counted ``draw`` times, as one block."""
        parts = (np.tensordot(draw, each, axes=1)[None] for each in self)
        return Products(*parts)


def _steps(u: np.ndarray, rows: np.ndarray, join: np.ndarray) -> np.ndarray:
    """Return the steps of a command before each row, joined by age, and the command before these steps."""
    size = join.shape[1]
    before = u[np.clip(np.arange(rows[0] - size, rows[-1] + 1), 0, None)]
    steps = np.lib.stride_tricks.sliding_window_view(np.diff(before), size)[:, ::-1]
    return np.concatenate([steps @ join.T, before[: len(rows), None]], axis=1)


class Fit(NamedTuple):
    """Best parameters of a response."""

    path: Path
    gain: float
    curve: float
    """Share of the second input, for two inputs."""
    misfit: float
    """n log(mean square)."""


def fit_response(
    products: Products, dt: float, *, start: Fit | None = None, fixed: Path | None = None, shaped: bool = True
) -> Fit:
    """Return the response with the least squared error.

    Args:
        products: Sums of one block; see :meth:`Products.weigh`.
        dt: Tick [s].
        start: Fit from which the search starts; None for a grid.
        fixed: Path whose delay and shape are not fitted.
        shaped: Whether the shape is fitted; otherwise the lag is of first order.
    """
    from scipy.optimize import minimize  # local, because it takes as long to import as all of retrim

    age = dt * ages(dt)
    sums = products.xx[0], products.xy[0], float(products.yy[0]), float(products.n[0])

    def path_of(x: np.ndarray) -> Path:
        lag = float(np.exp(np.clip(x[1], np.log(LAGS[0]), np.log(LAGS[1]))))
        if fixed is not None:
            return Path(fixed.delay, lag, fixed.ringing)
        return Path(
            float(np.clip(x[0], 0.0, LONGEST_DELAY)), lag, float(np.clip(x[2], 0.0, MOST_RINGING)) if shaped else 0.0
        )

    def misfit(x: np.ndarray) -> float:
        beyond = np.abs(x - _inside(x)) / SCALE  # so that the search does not leave the limits
        return _solve(sums, mean_response(age, dt, path_of(x)), dt).misfit + float(np.sum(beyond**2))

    if start is None:
        shapes = FIRST_RINGING if shaped else (0.0,)
        cells = [np.array([d, np.log(lag), r]) for d in DELAYS for lag in FIRST_LAGS for r in shapes]
        x = min(cells, key=misfit)
    else:
        x = np.array([start.path.delay, np.log(start.path.lag), start.path.ringing])
    simplex = np.concatenate([x[None], x[None] + np.diag(np.where(x + STEPS > _inside(x + STEPS), -STEPS, STEPS))])
    optimum = minimize(misfit, x, method="Nelder-Mead",
                     options={"initial_simplex": simplex, "xatol": 1e-5, "fatol": 1e-3, "maxiter": 400})  # fmt: skip
    path = path_of(optimum.x)
    return _solve(sums, mean_response(age, dt, path), dt)._replace(path=path)


def _inside(x: np.ndarray) -> np.ndarray:
    return np.asarray(np.clip(x, [0.0, np.log(LAGS[0]), 0.0], [LONGEST_DELAY, np.log(LAGS[1]), MOST_RINGING]))


def _solve(sums: tuple[np.ndarray, np.ndarray, float, float], step: np.ndarray, dt: float) -> Fit:
    """Return the gain, the curve and the misfit for one step response."""
    xx, xy, yy, n = sums
    m = len(step) + 1
    inputs = (len(xy) - len(xy) % m) // m if len(xy) % m else len(xy) // m
    h = np.append(step, 1.0)
    rows = np.zeros((inputs + len(xy) - inputs * m, len(xy)))
    for k in range(inputs):
        rows[k, k * m : (k + 1) * m] = h
    rows[inputs:, inputs * m :] = np.eye(len(xy) - inputs * m)
    A, b = rows @ xx @ rows.T, rows @ xy
    theta = _solve_curved(A, b) if inputs == 2 else np.linalg.solve(A + 1e-12 * np.trace(A) * np.eye(len(A)), b)
    left = max(yy - 2.0 * theta @ b + theta @ A @ theta, 1e-12 * yy + 1e-300)
    gain = float(theta[:inputs].sum())
    curve = float(theta[1] / gain) if inputs == 2 and gain else 0.0
    return Fit(Path(0.0, 0.0, 0.0), gain, curve, n * float(np.log(left / n)))


def _solve_curved(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the shares of a linear and a quadratic input, neither of which is negative."""
    theta = np.linalg.lstsq(A, b, rcond=1e-12)[0]
    if theta.min() >= 0.0:
        return np.asarray(theta)
    ends = [np.array([b[0] / A[0, 0], 0.0]), np.array([0.0, b[1] / A[1, 1]])]
    return min(ends, key=lambda each: float(each @ A @ each - 2.0 * each @ b))
