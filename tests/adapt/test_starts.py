"""Starts of updates: in the region of the flight, or from the task."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import hover_task, random_starts, random_state, replace_fields
from retrim.adapt.starts import TaskStarts, WindowStarts
from retrim.learn import Window

draw = eqx.filter_jit(lambda starts, *more: starts(*more))


@pytest.fixture
def window(key):
    """Return 20 ticks far from the goal; the first five are farther away and invalid."""
    x = jax.vmap(random_state)(random.split(key, 20))
    p = 7.0 + 0.01 * jnp.arange(20.0)[:, None] + jnp.zeros((1, 3))
    u = jnp.zeros((20, 3))
    setup = Window.of(0.02 * jnp.arange(20.0), p.at[:5].set(100.0), x.R, x.v, jnp.full(20, 9.81), u)
    return Window(setup.t, setup.x, setup.u, jnp.arange(20) >= 5)


def test_paper_starts_equal_training_starts(window, key):
    result = draw(TaskStarts(), hover_task(), window, key, 3, 4)
    jax.tree.map(np.testing.assert_array_equal, result, random_starts(hover_task(), key, 3, 4))


@pytest.mark.parametrize("from_task", [0, 2, 4, 9])
def test_window_starts_are_states_of_window(window, key, from_task):
    task = hover_task()
    result = draw(WindowStarts(jnp.array(0.0), from_task), task, window, key, 5, 4)
    assert result.x.R.shape == (5, 4, 3, 3)
    far = min(from_task, 4)
    p = np.asarray(result.x.p)
    assert (np.abs(p[:, :far] - np.array([0.0, 0.0, 1.0])) <= 1.0).all()  # box of the task
    rows = np.asarray(window.x.p)
    for each in p[:, far:].reshape(-1, 3):
        row = np.flatnonzero((rows == each).all(axis=1))
        assert len(row) == 1
        assert row[0] >= 5


def test_start_noise_has_stated_size(window, key):
    exact, noisy = (draw(WindowStarts(jnp.array(s), 0), hover_task(), window, key, 50, 40) for s in (0.0, 0.1))
    for name in ("p", "v"):
        shift = np.asarray(getattr(noisy.x, name)) - np.asarray(getattr(exact.x, name))
        assert shift.std() == pytest.approx(0.1, rel=0.05)
    np.testing.assert_array_equal(noisy.x.R, exact.x.R)
    np.testing.assert_array_equal(noisy.t, exact.t)


def test_start_time_includes_measurement_age(window, key):
    """A delayed measurement has an earlier start time; otherwise the start would be behind the reference."""
    old = replace_fields(window, age=jnp.full_like(window.t, 0.03))
    now, then = (draw(WindowStarts(jnp.array(0.0), 0), hover_task(), each, key, 3, 4) for each in (window, old))
    np.testing.assert_array_equal(now.x.p, then.x.p)
    np.testing.assert_allclose(then.t, now.t - 0.03, atol=1e-12)
