"""Solves linear least squares with delayed and lagged commands, over a grid of delays and lags, block by block."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

DELAYS = np.arange(0.0, 0.1601, 0.005)  # grid of delays [s]
LAGS = np.concatenate([[0.0], np.geomspace(0.005, 1.0, 33)])  # grid of lags [s]
LEAST_EXPLANATION = 0.6  # least share of the changes that the commands must explain
POOLS = (1, 5)  # numbers of rows to average
PIECES = 3.0  # minimum number of blocks that contribute to the explained share

Features = Callable[[float, float], np.ndarray]
"""Maps a delay and a lag [s] to the features of each row, (n, outputs, k)."""


class Sums(NamedTuple):
    """Sums of squares in each block, for every pair of a delay and a lag."""

    xx: np.ndarray
    """Sums of feature products, (delays, lags, blocks, k, k)."""
    xy: np.ndarray
    """Sums of feature-output products, (delays, lags, blocks, k)."""
    yy: np.ndarray
    """Sums of squared outputs, (blocks,)."""
    n: np.ndarray
    """Numbers of output values, (blocks,)."""

    @classmethod
    def of(
        cls, features: Features, y: np.ndarray, blocks: np.ndarray, delays: np.ndarray, lags: np.ndarray, pool: int
    ) -> "Sums":
        """Sum over each block's rows, after averaging ``y`` (n, outputs) and its features over ``pool`` rows."""

        def pool_rows(rows: np.ndarray) -> np.ndarray:
            parts = rows[blocks.reshape(len(blocks), -1, pool)].mean(axis=2)
            return np.asarray(parts.reshape(len(blocks), -1, *parts.shape[3:]))

        xx, xy = [], []
        Y = pool_rows(y[..., None])[..., 0].reshape(len(blocks), -1)
        for delay in delays:
            for lag in lags:
                X = pool_rows(features(float(delay), float(lag)).reshape(len(y), y.shape[1], -1))
                X = X.reshape(len(blocks), -1, X.shape[-1])
                xx.append(np.swapaxes(X, 1, 2) @ X)
                xy.append((np.swapaxes(X, 1, 2) @ Y[:, :, None])[:, :, 0])
        shape, k = (len(delays), len(lags), len(blocks)), np.shape(xy)[-1]
        squares = np.sum(Y**2, axis=1)
        count = np.full(len(blocks), float(Y.shape[1]))
        return cls(np.reshape(xx, (*shape, k, k)), np.reshape(xy, (*shape, k)), squares, count)

    def fit(self, draw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the misfit n log(mean square) and the parameters for each pair.

        Args:
            draw: How often each block is used, (blocks,).
        """
        xx, xy = np.einsum("dlbij,b->dlij", self.xx, draw), np.einsum("dlbi,b->dli", self.xy, draw)
        size = np.sqrt(np.einsum("dlii->dli", xx) + 1e-12)
        scaled_xx = xx / size[..., :, None] / size[..., None, :] + 1e-9 * np.eye(xx.shape[-1])
        theta = np.linalg.solve(scaled_xx, (xy / size)[..., None])[..., 0] / size
        left = np.maximum(self.yy @ draw - np.einsum("dli,dli->dl", theta, xy), 1e-12)
        count = self.n @ draw
        return count * np.log(left / count), theta

    def left(self) -> np.ndarray:
        """Return the residual sum of squares in each block for the best pair."""
        misfit, theta = self.fit(np.ones(len(self.yy)))
        best = np.unravel_index(np.argmin(misfit), misfit.shape)
        t, xx, xy = theta[best], self.xx[best], self.xy[best]
        return np.asarray(self.yy - 2.0 * xy @ t + np.einsum("i,bij,j->b", t, xx, t))


class Channel(NamedTuple):
    """One output of a vehicle, and the command that it follows."""

    sums: Sums
    still: Sums
    """Sums for a command that is held at its mean."""

    @classmethod
    def of(
        cls,
        features: Callable[[np.ndarray], np.ndarray],
        acting: Features,
        y: np.ndarray,
        blocks: np.ndarray,
    ) -> "Channel":
        """Build a channel; if single rows are too noisy, average a few rows.

        Args:
            features: Maps the acting command to the features of each row.
            acting: Maps a delay and a lag to the acting command.
            y: The output to explain, (n, outputs).
            blocks: Row indices of each block; their number is a multiple of ten.
        """
        rest, none = acting(0.0, 0.0), np.zeros(1)
        mean = np.broadcast_to(rest[blocks].mean(axis=(0, 1)), rest.shape)
        for pool in POOLS:
            channel = cls(
                Sums.of(lambda delay, lag: features(acting(delay, lag)), y, blocks, DELAYS, LAGS, pool),
                Sums.of(lambda delay, lag: features(mean), y, blocks, none, none, pool),
            )
            if channel.is_significant():
                break
        return channel

    def is_significant(self) -> bool:
        """Return whether changes in the command explain the changes in the output.

        If a controller reacts to measurement noise, the noise in the next difference of measurements looks like an
        immediate response to the command. This effect explains up to half of that noise. The threshold is therefore
        above one half.
        """
        before, after = self.still.left(), self.sums.left()
        gain = np.clip(before - after, 0.0, None)
        pieces = gain.sum() ** 2 / max(float(np.sum(gain**2)), 1e-12)
        return bool(1.0 - after.sum() / max(float(before.sum()), 1e-12) > LEAST_EXPLANATION and pieces > PIECES)


def lowest(grid: np.ndarray, misfit: np.ndarray, k: int) -> float:
    """Return the minimum of a parabola through the lowest point of a grid and its neighbours."""
    if not 0 < k < len(grid) - 1:
        return float(grid[k])
    curvature, slope, _ = np.polyfit(grid[k - 1 : k + 2] - grid[k], misfit[k - 1 : k + 2], 2)
    if curvature <= 0.0:
        return float(grid[k])
    return float(np.clip(grid[k] - 0.5 * slope / curvature, grid[k - 1], grid[k + 1]))
