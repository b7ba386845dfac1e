"""Run an exported policy with NumPy only.

This file does not need the rest of its package: copy it together with the NPZ file.

    policy = Runner("policy.npz")
    policy.reset()
    c, *omega = policy.step(p, R, v)      # at every control tick
    if policy.repeats > 50: ...           # no finite measurement for 50 ticks: the last command was repeated

The world frame is ENU, and the body frame is forward-left-up. The command consists of the mass-normalised collective
thrust [m/s^2] and the body rates [rad/s].
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

TOLERANCE = 1e-5  # largest error at the test vectors in the file, as a fraction of the command range
LARGEST = 2.0**20  # valid measurements are smaller, in SI units; networks overflow only far beyond this limit


class Runner:
    """A policy from an NPZ file; the constructor checks it against the file's test vectors."""

    def __init__(self, path: str | Path, delta: str | Path | None = None) -> None:
        """Read a policy.

        Args:
            path: NPZ file of the policy.
            delta: NPZ file with a learned low-rank delta to add to the policy.

        Raises:
            ValueError: The policy fails the test vectors of the file, or the delta belongs to a different policy.
        """
        with np.load(path, allow_pickle=False) as file:
            self._arrays = {name: file[name] for name in file.files}
        self.about: dict[str, Any] = json.loads(str(self._arrays["about"]))
        self._layers = [(self._arrays[f"w{i}"], self._arrays[f"b{i}"]) for i in range(self.about["layers"])]
        result = self.command(self._arrays["test_observations"])
        deviation = np.abs(result - self._arrays["test_commands"]) / (self._arrays["high"] - self._arrays["low"])
        if not deviation.max() <= TOLERANCE:
            raise ValueError(
                f"{path}: its results deviate from the test vectors by {deviation.max():.1e} of the command range"
            )
        if not self._survives_bad_numbers():
            raise ValueError(f"{path}: a number that is not finite changes more than the command of its tick")
        if delta is not None:
            self._apply(delta)
        self.reset()

    @property
    def dt(self) -> float:
        """Control tick [s]."""
        return float(self.about["dt"])

    @property
    def repeats(self) -> int:
        """Number of ticks for which the last command has been repeated; 0 if it results from the newest state."""
        return self._repeats

    def command(self, observation: np.ndarray) -> np.ndarray:
        """Return the command [c, omega] for an observation or for rows of them; NaN if one is not finite."""
        with np.errstate(over="ignore", invalid="ignore"):
            o = np.asarray(observation, dtype=np.float32)
            is_finite = _is_finite(o)
            h = np.where(is_finite, o, np.float32(0.0))
            for w, b in self._layers[:-1]:
                h = np.maximum(h @ w + b, np.float32(0.0))
            w, b = self._layers[-1]
            y = h @ w + b + self._arrays["y0"]
            low, high = self._arrays["low"], self._arrays["high"]
            u = low + (high - low) / (np.float32(1.0) + np.exp(-y))
            return np.where(is_finite & _is_finite(u), u, np.float32(np.nan))

    def reset(self) -> None:
        """Reset the history of commands to hover."""
        self._repeats = 0
        observation = self.about["observation"]
        self._past = np.zeros((0 if observation is None else observation["history"], 4), dtype=np.float32)
        self._last = np.array([0.0 if observation is None else observation["gravity"], 0.0, 0.0, 0.0], np.float32)

    def step(self, p: np.ndarray, R: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the command for a state; call this method once per control tick.

        If the state or the command is not finite, the last command is repeated, :attr:`repeats` increases, and the
        history of commands does not change.

        Args:
            p: Position, world [m].
            R: Attitude, body to world, 3 x 3.
            v: Velocity, world [m/s].
        """
        past = self._past
        with np.errstate(over="ignore", invalid="ignore"):
            x = np.concatenate([np.ravel(each) for each in (p, R, v)]).astype(np.float32)
            u = self.command(self.observe(p, R, v))
        if _is_finite(x).item() and _is_finite(u).item():
            self._last, self._repeats = u, 0
        else:
            self._past, self._repeats = past, self._repeats + 1
        return self._last.copy()

    def observe(self, p: np.ndarray, R: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the observation of a state, after the last command of :meth:`step`."""
        observation = self.about["observation"]
        if observation is None:
            raise ValueError("this policy does not observe only the state; call command() with its observation")
        past = np.concatenate(
            [[self._last[0] / observation["gravity"] - 1.0], self._last[1:] / np.array(observation["rates_max"])]
        )
        self._past = np.concatenate([self._past, past[None].astype(np.float32)])[1:]
        near = (np.asarray(p) - np.array(observation["origin"])) / observation["position_scale"]
        parts = [near, np.asarray(R).reshape(9), np.asarray(v) / observation["velocity_scale"], self._past.reshape(-1)]
        return np.concatenate(parts).astype(np.float32)

    def _survives_bad_numbers(self) -> bool:
        """Return whether NaN, infinite and too large numbers at each index are reported and leave the memory intact."""
        rows, bad = self._arrays["test_observations"], (np.nan, np.inf, -np.inf, LARGEST)
        spoilt = [np.where(np.arange(rows.shape[1]) == i, x, rows[0]) for x in bad for i in range(rows.shape[1])]
        if not np.isnan(self.command(np.array(spoilt))).all():
            return False
        if self.about["observation"] is None:
            return True
        self.reset()
        state = np.concatenate([[0.1, 0.2, 0.3], np.eye(3).ravel(), np.zeros(3)])
        first = self.step(state[:3], state[3:12].reshape(3, 3), state[12:])
        past = self._past
        for number in bad:
            for i in range(15):
                x = np.where(np.arange(15) == i, number, state)
                if not np.array_equal(self.step(x[:3], x[3:12].reshape(3, 3), x[12:]), first):
                    return False
        return self._repeats == 15 * len(bad) and self._past is past

    def _apply(self, path: str | Path) -> None:
        with np.load(path, allow_pickle=False) as file:
            delta = {name: file[name] for name in file.files}
        about = json.loads(str(delta["about"]))
        if about["base"] != self.about["weights"]:
            raise ValueError(
                f"{path}: made for a different policy, {about['base'][:12]}..., not {self.about['weights'][:12]}..."
            )
        for i, (w, b) in enumerate(self._layers):
            self._layers[i] = (w + np.float32(about["scale"]) * (delta[f"up{i}"] @ delta[f"down{i}"]).T, b)
        w, b = self._layers[-1]
        self._layers[-1] = (w, b + delta["shift"])


def _is_finite(x: np.ndarray) -> np.ndarray:
    """Return whether all numbers of each row are smaller than LARGEST in magnitude; NaN is not."""
    return np.asarray((np.abs(x) < LARGEST).all(axis=-1, keepdims=True))
