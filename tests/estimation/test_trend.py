"""The trend predicts smooth disturbances, ignores noise and steps, and has the symmetries of the disturbance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from retrim.estimation.trend import SPAN, Trend

DT = 0.02


def follow(d: np.ndarray, horizon: float) -> np.ndarray:
    """Return the predicted change in ``d`` after each tick, (ticks, 3)."""
    return np.asarray(_changes(jnp.asarray(d), jnp.full(3, horizon)))


@jax.jit
def _changes(d: jax.Array, horizon: jax.Array) -> jax.Array:
    def tick(trend: Trend, now: jax.Array) -> tuple[Trend, jax.Array]:
        trend = trend.after(now, horizon, DT)
        return trend, trend.change(horizon)

    return jax.lax.scan(tick, Trend.start(d[0], DT), d)[1]


def later(d: np.ndarray, horizon: float) -> np.ndarray:
    """Return the true change in ``d`` over the horizon, for the ticks for which it is known."""
    n = round(horizon / DT)
    return d[n:] - d[:-n]


@pytest.mark.parametrize("horizon", [0.04, 0.1, 0.2])
@pytest.mark.parametrize("period", [2.0, 4.0])
def test_smooth_disturbance_is_predicted(horizon: float, period: float) -> None:
    """The error of a prediction for a sinusoid is less than half of the error without a prediction."""
    t = DT * np.arange(600)
    d = np.stack([np.sin(2 * np.pi * t / period + phase) for phase in (0.0, 1.0, 2.0)], axis=1)
    true, predicted = later(d, horizon), follow(d, horizon)[: -round(horizon / DT)]
    error = (true - predicted)[200:]
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.sqrt(np.mean(true[200:] ** 2))


@pytest.mark.parametrize("smoothing", [1, 5])
def test_noise_is_not_predicted(smoothing: int) -> None:
    """Predictions add less than 10 % to the deviation of noise, also if the observer has smoothed it."""
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(4000, 3))
    kernel = np.ones(smoothing) / smoothing
    d = np.stack([np.convolve(axis, kernel, "valid") for axis in noise.T], axis=1)
    predicted = follow(d, 0.2)
    assert np.std((d + predicted)[200:]) < 1.1 * np.std(d[200:])


@pytest.mark.parametrize(("tau", "horizon"), [(0.015, 0.08), (0.05, 0.2)])
def test_steps_are_hardly_exceeded(tau: float, horizon: float) -> None:
    """Estimate plus predicted change exceed the steps of a filtered disturbance by less than a fifth."""
    steps = np.repeat([0.0, 2.0, 0.0, 2.0], 40)
    d, share = np.zeros_like(steps), 1.0 - np.exp(-DT / tau)
    for k in range(1, len(steps)):
        d[k] = d[k - 1] + share * (steps[k] - d[k - 1])
    d = np.stack([d, -d, d], axis=1)
    size = np.abs(d + follow(d, horizon))
    assert size.max() < 2.4


def test_step_during_a_smooth_disturbance_is_limited() -> None:
    """A step in a predictable disturbance changes the prediction by little more than the usual predictions."""
    t = DT * np.arange(600)
    d = 0.5 * np.stack([np.sin(2 * np.pi * t / 2.0)] * 3, axis=1)
    usual = np.abs(follow(d, 0.1)).max()
    d[400:] += 3.0
    assert np.abs(follow(d, 0.1)).max() < 2.0 * usual


@given(st.floats(0.0, 6.28), st.integers(0, 10**6))
def test_prediction_is_equivariant_under_rotation_about_the_vertical(angle: float, seed: int) -> None:
    """A rotated disturbance has a rotated prediction, and a negative disturbance a negative prediction."""
    rng = np.random.default_rng(seed)
    t, phases = DT * np.arange(150), rng.uniform(0.0, 6.28, 3)
    d = np.stack([np.sin(2 * np.pi * t / 3.0 + phase) for phase in phases], axis=1)
    Q = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    once, turned = follow(d, 0.1), follow(d @ Q.T, 0.1)
    np.testing.assert_allclose(turned, once @ Q.T, atol=1e-5)
    np.testing.assert_allclose(follow(-d, 0.1), -once, atol=1e-6)


def test_constant_disturbance_and_zero_horizon_have_no_trend() -> None:
    """A constant disturbance predicts no change, and neither does a horizon of zero."""
    d = np.tile([1.0, 2.0, 3.0], (50, 1))
    np.testing.assert_array_equal(follow(d, 0.1), 0.0)
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(follow(np.cumsum(rng.normal(size=(100, 3)), axis=0), 0.0), 0.0)


def test_horizon_is_limited() -> None:
    """A horizon beyond the memory gives the prediction for the longest horizon."""
    t = DT * np.arange(300)
    d = np.stack([np.sin(2 * np.pi * t / 4.0)] * 3, axis=1)
    np.testing.assert_allclose(follow(d, 2.0), follow(d, SPAN), atol=1e-6)
