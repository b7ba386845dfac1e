"""The linear residual: recursive least squares equals one least squares of all rows; what is counted, and how often."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import random

from helpers import random_command, random_state, replaced
from retrim.learn.residuals import LinearModel, Targets
from retrim.learn.residuals.linear import features_of
from retrim.testing import check_residual

DT, EVERY, N = 0.02, 0.4, 40
STEP = round(EVERY / DT)
MODEL = LinearModel.of(DT, every=EVERY, memory=1.5, noise=0.4)


def flight(key, n=120, noise=0.3):
    """Random states and commands, and what random weights make of them."""
    k_x, k_u, k_w, k_noise = random.split(key, 4)
    x = jax.vmap(random_state)(random.split(k_x, n))
    u = jax.vmap(random_command)(random.split(k_u, n))
    weights = MODEL.prior[:, None] * random.normal(k_w, (19, 3))
    a_res = jax.vmap(features_of)(x, u) @ weights + noise * random.normal(k_noise, (n, 3))
    return Targets(x, u, a_res, u.omega, jnp.ones(n, dtype=bool))


def part(rows, start, stop):
    return jax.tree.map(lambda leaf: leaf[start:stop], rows)


def carried(model, rows, count):
    """States after each of ``count`` windows of N rows, STEP apart."""
    fit, state, states = eqx.filter_jit(model.fit), model.init(random.key(0)), []
    for k in range(count):
        state, rms = fit(state, part(rows, k * STEP, k * STEP + N))
        states.append((state, rms))
    return states


def test_the_laws_of_a_residual_model():
    check_residual(MODEL)


def test_windows_one_by_one_are_all_rows_at_once(key):
    """Weighted ridge regression in NumPy on every row that was seen, each once."""
    rows, count = flight(key), 5
    states = carried(MODEL, rows, count)
    seen = N + (count - 1) * STEP
    features = np.asarray(jax.vmap(features_of)(rows.x, rows.u))[:seen]
    weight = np.exp(-DT * np.arange(seen - 1, -1, -1) / 1.5) / 0.4**2
    precision = np.diag(1.0 / np.asarray(MODEL.prior) ** 2) + features.T @ (weight[:, None] * features)
    wanted = np.linalg.solve(precision, features.T @ (weight[:, None] * np.asarray(rows.a_res)[:seen]))
    state, rms = states[-1]
    np.testing.assert_allclose(state.weights, wanted, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(state.covariance, np.linalg.inv(precision), rtol=1e-7, atol=1e-12)
    error = np.asarray(rows.a_res)[seen - N : seen] - features[-N:] @ wanted
    np.testing.assert_allclose(rms, np.sqrt(np.mean(np.sum(error**2, axis=1))), rtol=1e-7)


def test_it_becomes_more_certain_and_is_as_wrong_as_it_says(key):
    rows = flight(key, n=400)
    states = [state for state, _ in carried(replaced(MODEL, memory=jnp.array(1e6), noise=jnp.array(0.3)), rows, 15)]
    new = part(rows, 380, 400)
    spreads = [jax.vmap(lambda x, u, s=state: MODEL.spread(s, x, u))(new.x, new.u) for state in states]
    assert float(spreads[-1].max()) < 0.5 * float(spreads[0].max())
    truth = jnp.linalg.norm(new.a_res - jax.vmap(lambda x, u: MODEL.predict(states[-1], x, u))(new.x, new.u), axis=1)
    assert float(jnp.sqrt(jnp.mean(truth**2) / 3)) < 2.0 * 0.3


def test_an_invalid_row_does_not_count(key):
    rows = flight(key, n=N)
    valid = jnp.arange(N) % 3 > 0
    spoilt = dataclasses.replace(rows, a_res=jnp.where(valid[:, None], rows.a_res, 99.0), valid=valid)
    clean = dataclasses.replace(rows, valid=valid)
    for a, b in zip(*(jax.tree.leaves(MODEL.fit(MODEL.init(key), each)) for each in (spoilt, clean)), strict=True):
        np.testing.assert_array_equal(a, b)
    nothing = dataclasses.replace(rows, valid=jnp.zeros(N, dtype=bool))
    state, _ = MODEL.fit(MODEL.init(key), rows)
    kept, _ = MODEL.fit(state, nothing)
    jax.tree.map(np.testing.assert_array_equal, kept, state)


def test_single_precision_is_enough(key):
    """Ten minutes of flight, and a memory that keeps them all."""
    rows, model = flight(key, n=2000), replaced(MODEL, memory=jnp.array(600.0))
    fit = eqx.filter_jit(model.fit)
    single = lambda tree: jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == jnp.float64 else a, tree)  # noqa: E731
    small = eqx.filter_jit(single(model).fit)
    state, coarse = model.init(key), single(model.init(key))
    for k in range(15):
        window = part(rows, 100 * k, 100 * k + 100)
        for _ in range(20):
            state, _ = fit(state, window)
            coarse, _ = small(coarse, single(window))
    new = part(rows, 1800, 1900)
    exact, rough = (new.a_res - jax.vmap(features_of)(new.x, new.u) @ s.weights.astype(float) for s in (state, coarse))
    assert coarse.weights.dtype == jnp.float32
    np.testing.assert_allclose(rough, exact, atol=0.02)
