"""Screening of windows finds wrong measurements with their reasons, and keeps the others."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from retrim.learn import Window
from retrim.learn.screening import REASONS, describe_counts, screen
from retrim.physics import Command, PointMass, State

DT, N = 0.02, 60
screen_window = eqx.filter_jit(lambda window: screen(window, DT))


@pytest.fixture(scope="module")
def window():
    """Return a flight with a changing command and without noise."""
    model = PointMass(DT)

    def tick(x, k):
        u = Command(9.81 + random.normal(k, ()), random.normal(random.fold_in(k, 1), (3,)))
        return model.step(x, u, jnp.array([0.5, 0.0, 0.0])), (x, u)

    _, (x, u) = jax.lax.scan(tick, State.at(jnp.array([0.0, 0.0, 1.0])), random.split(random.key(0), N))
    return Window(DT * jnp.arange(float(N)), x, u, jnp.ones(N, dtype=bool), None)


def change(window, **fields):
    whole = {name: getattr(window.x, name) for name in ("p", "R", "v")} | fields
    return dataclasses.replace(window, x=jax.vmap(State)(*(whole[name] for name in ("p", "R", "v"))))


def counts(result):
    return dict(zip(REASONS, np.asarray(result.counts).tolist(), strict=True))


def test_clean_window_is_kept(window):
    result = screen_window(window)
    assert result.steps.all()
    assert result.samples.all()
    assert result.trusted
    assert result.note() == ""


@pytest.mark.parametrize("noise", [1e-3, 2e-3])
def test_noisy_window_is_mostly_kept(window, noise):
    p = window.x.p + noise * random.normal(random.key(1), (N, 3))
    v = window.x.v + 10.0 * noise * random.normal(random.key(2), (N, 3))
    result = screen_window(change(window, p=p, v=v))
    assert int((~result.steps).sum()) <= 1
    assert result.trusted


@pytest.mark.parametrize("rows", [[20], [5, 30, 50]])
def test_wrong_velocity_excludes_adjacent_steps_only(window, rows):
    at = jnp.array(rows)
    result = screen_window(change(window, v=window.x.v.at[at, 0].add(2.0)))
    np.testing.assert_array_equal(np.flatnonzero(~result.steps), sorted([*(at - 1).tolist(), *at.tolist()]))
    np.testing.assert_array_equal(np.flatnonzero(~result.samples), rows)
    assert counts(result)["velocity is not the derivative of position"] == 2 * len(rows)
    assert result.trusted


def test_step_after_repeated_measurement_is_excluded(window):
    x = jax.tree.map(lambda leaf: leaf.at[31].set(leaf[30]), window.x)
    result = screen_window(dataclasses.replace(window, x=x))
    assert not result.steps[30]
    assert not result.steps[31]
    assert int((~result.steps).sum()) == 2
    assert counts(result)["repeated"] == 1


def test_window_with_mostly_contradictory_steps_is_excluded(window):
    wrong = screen_window(change(window, v=2.0 * window.x.v + 1.0))
    assert not wrong.trusted
    assert int((~wrong.steps).sum()) > N // 2


def test_invalid_ticks_are_not_screened(window):
    valid = jnp.arange(N) >= 30
    result = screen_window(dataclasses.replace(change(window, v=window.x.v.at[10, 0].add(5.0)), valid=valid))
    assert int(result.counts.sum()) == 0
    np.testing.assert_array_equal(result.samples, valid)
    assert result.trusted


def test_step_of_several_ticks_is_not_screened(window):
    """Five measurements are missing while the vehicle continues to fly."""
    left = jnp.concatenate([jnp.arange(25), jnp.arange(30, N)])
    result = screen_window(jax.tree.map(lambda leaf: leaf[left], window))
    assert int(result.counts.sum()) == 0
    assert result.steps.all()
    assert result.samples.all()


def test_counts_in_words():
    assert describe_counts(jnp.zeros(5, int)) == ""
    assert describe_counts([3, 0, 1, 0, 0]) == "repeated: 3, acceleration out of range: 1"
