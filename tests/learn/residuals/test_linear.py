"""The linear residual: recursive least squares equals least squares over all rows; rows count once."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random

from helpers import random_command, random_state, replace_fields
from retrim.learn.residuals import LinearModel, Targets
from retrim.learn.residuals.linear import features_of
from retrim.testing import check_residual

DT, EVERY, N = 0.02, 0.4, 40
STEP = round(EVERY / DT)
MODEL = LinearModel.of(DT, every=EVERY, memory=1.5, noise=0.4)


@partial(jax.jit, static_argnames="n")
def flight(key, n=120, noise=0.3):
    """Return random states and commands, and the accelerations for random weights."""
    k_x, k_u, k_w, k_noise = random.split(key, 4)
    x = jax.vmap(random_state)(random.split(k_x, n))
    u = jax.vmap(random_command)(random.split(k_u, n))
    weights = MODEL.prior[:, None] * random.normal(k_w, (19, 3))
    a_res = jax.vmap(features_of)(x, u) @ weights + noise * random.normal(k_noise, (n, 3))
    return Targets(x, u, a_res, u.omega, jnp.ones(n, dtype=bool))


fit = eqx.filter_jit(lambda model, state, rows: model.fit(state, rows))
features = jax.jit(jax.vmap(features_of))


def part(rows, start, stop):
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[start:stop]), rows)


def carry(model, rows, count):
    """Return the states after each of ``count`` windows of N rows, STEP apart."""
    state, states = model.init(random.key(0)), []
    for k in range(count):
        state, rms = fit(model, state, part(rows, k * STEP, k * STEP + N))
        states.append((state, rms))
    return states


def test_conformance():
    check_residual(MODEL)


def test_recursive_fit_equals_ridge_regression(key):
    """Weighted ridge regression in NumPy uses every row once."""
    rows, count = flight(key), 5
    states = carry(MODEL, rows, count)
    observation = N + (count - 1) * STEP
    phi = np.asarray(features(rows.x, rows.u))[:observation]
    weight = np.exp(-DT * np.arange(observation - 1, -1, -1) / 1.5) / 0.4**2
    precision = np.diag(1.0 / np.asarray(MODEL.prior) ** 2) + phi.T @ (weight[:, None] * phi)
    expected = np.linalg.solve(precision, phi.T @ (weight[:, None] * np.asarray(rows.a_res)[:observation]))
    state, rms = states[-1]
    np.testing.assert_allclose(state.weights, expected, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(state.covariance, np.linalg.inv(precision), rtol=1e-7, atol=1e-12)
    error = np.asarray(rows.a_res)[observation - N : observation] - phi[-N:] @ expected
    np.testing.assert_allclose(rms, np.sqrt(np.mean(np.sum(error**2, axis=1))), rtol=1e-7)


def test_spread_shrinks_and_is_calibrated(key):
    rows = flight(key, n=400)
    states = [state for state, _ in carry(replace_fields(MODEL, memory=jnp.array(1e6), noise=jnp.array(0.3)), rows, 15)]
    new = part(rows, 380, 400)
    spread = eqx.filter_jit(lambda state: jax.vmap(lambda x, u: MODEL.spread(state, x, u))(new.x, new.u))
    assert float(spread(states[-1]).max()) < 0.5 * float(spread(states[0]).max())
    prediction = eqx.filter_jit(lambda state: jax.vmap(lambda x, u: MODEL.predict(state, x, u))(new.x, new.u))
    error = np.asarray(new.a_res) - np.asarray(prediction(states[-1]))
    assert np.sqrt(np.mean(error**2)) < 2.0 * 0.3


def test_invalid_row_has_no_effect(key):
    rows = flight(key, n=N)
    valid = jnp.arange(N) % 3 > 0
    spoilt = dataclasses.replace(rows, a_res=jnp.where(valid[:, None], rows.a_res, 99.0), valid=valid)
    clean = dataclasses.replace(rows, valid=valid)
    for a, b in zip(*(jax.tree.leaves(fit(MODEL, MODEL.init(key), each)) for each in (spoilt, clean)), strict=True):
        np.testing.assert_array_equal(a, b)
    nothing = dataclasses.replace(rows, valid=jnp.zeros(N, dtype=bool))
    state, _ = fit(MODEL, MODEL.init(key), rows)
    after, _ = fit(MODEL, state, nothing)
    jax.tree.map(np.testing.assert_array_equal, after, state)


def test_single_precision_suffices(key):
    """Ten minutes of flight, with a memory that keeps all of them."""
    rows, model = flight(key, n=2000), replace_fields(MODEL, memory=jnp.array(600.0))
    single = lambda tree: jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == jnp.float64 else a, tree)  # noqa: E731

    @eqx.filter_jit
    def twenty_times(model, state, window):
        return lax.fori_loop(0, 20, lambda _, state: model.fit(state, window)[0], state)

    state, coarse = model.init(key), single(model.init(key))
    for k in range(15):
        window = part(rows, 100 * k, 100 * k + 100)
        state = twenty_times(model, state, window)
        coarse = twenty_times(single(model), coarse, single(window))
    new = part(rows, 1800, 1900)
    phi = np.asarray(features(new.x, new.u))
    exact, rough = (np.asarray(new.a_res) - phi @ np.asarray(s.weights, dtype=float) for s in (state, coarse))
    assert coarse.weights.dtype == jnp.float32
    np.testing.assert_allclose(rough, exact, atol=0.02)
