"""The map over position: a Bayesian regression that separates local forces from steady ones, and is correctable."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from retrim.learn.residuals import PlaceModel, RegressionModel, Targets
from retrim.learn.residuals.place import WANDER
from retrim.physics import Command, State
from retrim.testing import check_residual

DT, EVERY, ROWS, LAP = 0.02, 0.2, 60, 6.3
MODEL = PlaceModel.of(RegressionModel.of(DT, memory=2.0, thrust_prior=0.2), DT, every=EVERY)

fit = eqx.filter_jit(lambda model, state, rows: model.fit(state, rows))
at_place = eqx.filter_jit(lambda model, state, p: jax.vmap(lambda p: model.at_place(state, p))(p))


def on_lap(t):
    """Return position and velocity on a circle of 1 m."""
    angle = 2.0 * np.pi * t / LAP
    p = np.stack([1.0 - np.cos(angle), -np.sin(angle), np.ones_like(t)], axis=1)
    v = 2.0 * np.pi / LAP * np.stack([np.sin(angle), -np.cos(angle), np.zeros_like(t)], axis=1)
    return p, v


def local_force(p):
    """Return a downward force near the far end of the circle."""
    near = np.exp(-0.5 * ((p[:, 0] - 2.0) ** 2 + p[:, 1] ** 2) / 0.2**2)
    return near[:, None] * np.array([0.0, 0.0, -4.0])


def rows_at(p, v, a, valid=True):
    """Return rows of level hover commands along a path."""
    n = len(p)
    x = jax.vmap(lambda p, v: State(p, jnp.eye(3), v))(jnp.asarray(p), jnp.asarray(v))
    u = jax.vmap(Command)(jnp.full(n, 9.80665), jnp.zeros((n, 3)))
    return Targets(x, u, jnp.asarray(a), jnp.zeros((n, 3)), jnp.full(n, valid))


def window(end, force, noise=0.1, seed=0, valid=True):
    """Return the rows of the last ticks before ``end`` [s] with hover commands."""
    t = end - DT * np.arange(ROWS, 0, -1)
    p, v = on_lap(t)
    a = force(t, p) + noise * np.random.default_rng([seed, round(end / DT)]).normal(size=p.shape)
    return rows_at(p, v, a, valid)


def learn(force, begin=0.0, end=2.0 * LAP, state=None, model=MODEL):
    state = model.init(random.key(0)) if state is None else state
    for t in np.arange(begin + EVERY, end + 1e-9, EVERY):
        state, _ = fit(model, state, window(t, force))
    return state


@pytest.fixture(scope="module")
def fit_model():
    return learn(lambda t, p: local_force(p) + np.array([1.0, -0.5, 0.3]))


def lap_values(state):
    p, _ = on_lap(np.linspace(LAP, 2.0 * LAP, 80))
    return p, np.asarray(at_place(MODEL, state, jnp.asarray(p)))


def test_conformance():
    check_residual(MODEL)


def test_map_after_two_laps_is_local_force_without_steady_push(fit_model):
    p, a = lap_values(fit_model)
    error = a - local_force(p)
    np.testing.assert_allclose(error - error.mean(axis=0), 0.0, atol=0.5)
    assert np.sqrt(np.mean((error - error.mean(axis=0)) ** 2)) < 0.1
    assert np.abs(error.mean(axis=0)).max() < 0.4  # a small part of the push repeats and depends on the prior


def test_map_is_zero_far_from_path(fit_model):
    away = jnp.array([[0.0, 0.0, 3.0], [5.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    np.testing.assert_allclose(at_place(MODEL, fit_model, away), 0.0, atol=1e-3)


def test_push_that_changes_with_time_is_not_in_map():
    state = learn(lambda t, p: np.where(t < LAP, 2.0, -2.0)[:, None] * np.ones(3), end=3.0 * LAP)
    _, a = lap_values(state)
    assert np.abs(a).max() < 0.25 * 4.0  # of a change of 4 m/s^2


def test_fit_equals_regression_on_all_rows():
    """In NumPy, precision = prior + variance of the random-walk constant + information of the rows."""
    rows = window(1.2, lambda t, p: local_force(p - np.array([-1.0, 0.0, 0.0])) + 1.0)
    model = dataclasses.replace(MODEL, memory=jnp.array(jnp.inf))
    state, _ = fit(model, model.init(random.key(0)), rows)
    p = np.asarray(rows.x.p + 0.5 * DT * rows.x.v)
    used = np.asarray(state.map.visited) >= 0
    centres = np.asarray(state.map.centres)[used]
    bumps = np.exp(-0.5 * np.sum((p[:, None] - centres[None]) ** 2, axis=2) / 0.12**2)
    phi = np.concatenate([bumps, np.ones((ROWS, 1))], axis=1)
    variance = np.full(phi.shape[1], 2.0**2)
    variance[-1] += WANDER**2 * EVERY
    drag = jax.vmap(lambda x: MODEL._predict_drag(state.first, x))(rows.x)
    target = np.asarray(rows.a_res - drag)
    weights = np.linalg.solve(np.diag(1.0 / variance) + phi.T @ phi / 0.5**2, phi.T @ target / 0.5**2)
    np.testing.assert_allclose(np.asarray(state.map.weights)[np.append(used, True)], weights, atol=1e-8)


def test_vanished_force_loses_its_influence(fit_model):
    place = jnp.array([[2.0, 0.0, 1.0]])
    before = float(at_place(MODEL, fit_model, place)[0, 2])
    state = learn(lambda t, p: np.zeros_like(p), 2.0 * LAP, 4.0 * LAP, fit_model)
    after = float(at_place(MODEL, state, place)[0, 2])
    assert before < -3.0
    assert abs(after) < 0.35 * abs(before)
    assert float(state.share) < 0.6 < float(fit_model.share)


def test_windows_without_valid_rows_change_nothing(fit_model):
    after, _ = fit(MODEL, fit_model, window(20.0, lambda t, p: local_force(p), valid=False))
    jax.tree.map(np.testing.assert_array_equal, after, fit_model)


def test_new_places_replace_old_centres():
    """A route longer than the capacity of the map: the newest part is known, and the oldest is forgotten."""
    state = MODEL.init(random.key(0))
    speed = 2.0
    for k in range(150):
        t = EVERY * (k + 1) - DT * np.arange(ROWS, 0, -1)
        p = np.stack([speed * t, np.zeros(ROWS), np.ones(ROWS)], axis=1)
        v = np.repeat([[speed, 0.0, 0.0]], ROWS, axis=0)
        a = np.stack([np.zeros(ROWS), np.zeros(ROWS), np.sin(2.0 * np.pi * p[:, 0] / 3.0)], axis=1)
        state, _ = fit(MODEL, state, rows_at(p, v, a))
    raw = dataclasses.replace(state, agreement=jnp.array(1e9), prediction=jnp.array(1e9))  # share 1
    crest, trough, first = np.asarray(at_place(MODEL, raw, jnp.array([[x, 0.0, 1.0] for x in (57.75, 59.25, 0.75)])))[
        :, 2
    ]
    assert crest - trough > 1.2
    np.testing.assert_allclose(first, 0.0, atol=1e-6)
