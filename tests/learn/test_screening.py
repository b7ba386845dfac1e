"""Screening of windows: the wrong measurements are found, with their reasons, and the others stay."""

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
    """A flight with a changing command, without noise."""
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


def test_a_clean_window_loses_nothing(window):
    result = screen_window(window)
    assert result.steps.all()
    assert result.samples.all()
    assert result.trusted
    assert result.note() == ""


@pytest.mark.parametrize("noise", [1e-3, 2e-3])
def test_noise_loses_next_to_nothing(window, noise):
    p = window.x.p + noise * random.normal(random.key(1), (N, 3))
    v = window.x.v + 10.0 * noise * random.normal(random.key(2), (N, 3))
    result = screen_window(change(window, p=p, v=v))
    assert int((~result.steps).sum()) <= 1
    assert result.trusted


@pytest.mark.parametrize("rows", [[20], [5, 30, 50]])
def test_a_wrong_velocity_loses_the_steps_to_and_from_it_and_no_other(window, rows):
    at = jnp.array(rows)
    result = screen_window(change(window, v=window.x.v.at[at, 0].add(2.0)))
    np.testing.assert_array_equal(np.flatnonzero(~result.steps), sorted([*(at - 1).tolist(), *at.tolist()]))
    np.testing.assert_array_equal(np.flatnonzero(~result.samples), rows)
    assert counts(result)["velocity is not the derivative of position"] == 2 * len(rows)
    assert result.trusted


def test_the_step_after_a_repeated_measurement_does_not_count(window):
    x = jax.tree.map(lambda leaf: leaf.at[31].set(leaf[30]), window.x)
    result = screen_window(dataclasses.replace(window, x=x))
    assert not result.steps[30]
    assert not result.steps[31]
    assert int((~result.steps).sum()) == 2
    assert counts(result)["repeated"] == 1


def test_nothing_is_learned_if_most_steps_contradict(window):
    wrong = screen_window(change(window, v=2.0 * window.x.v + 1.0))
    assert not wrong.trusted
    assert int((~wrong.steps).sum()) > N // 2


def test_invalid_ticks_are_not_judged(window):
    valid = jnp.arange(N) >= 30
    result = screen_window(dataclasses.replace(change(window, v=window.x.v.at[10, 0].add(5.0)), valid=valid))
    assert int(result.counts.sum()) == 0
    np.testing.assert_array_equal(result.samples, valid)
    assert result.trusted


def test_a_step_of_several_ticks_is_not_judged(window):
    """Five measurements are lost; the vehicle flies on."""
    left = jnp.concatenate([jnp.arange(25), jnp.arange(30, N)])
    result = screen_window(jax.tree.map(lambda leaf: leaf[left], window))
    assert int(result.counts.sum()) == 0
    assert result.steps.all()
    assert result.samples.all()


def test_counts_in_words():
    assert describe_counts(jnp.zeros(5, int)) == ""
    assert describe_counts([3, 0, 1, 0, 0]) == "repeated: 3, acceleration out of range: 1"
