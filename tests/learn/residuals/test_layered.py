"""The ensemble on what the closed form leaves: it helps where there is something, and never makes it worse."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import GOAL, random_command, random_state
from retrim.learn import EnsembleModel, Targets
from retrim.learn.residuals import LayeredModel, RegressionModel
from retrim.physics import small
from retrim.testing import check_residual

pytestmark = pytest.mark.usefixtures("optax_promotion")

FIRST = RegressionModel.of(0.02, memory=1e9)
SECOND = EnsembleModel(jnp.array(GOAL), small().omega_max, jnp.array(1e-2), jnp.array(1e-4), steps=20)
MODEL = LayeredModel(FIRST, SECOND)
N = 100

fit = eqx.filter_jit(MODEL.fit)
alone = eqx.filter_jit(lambda rows: FIRST.fit(FIRST.init(random.key(0)), rows)[0])


@eqx.filter_jit
def rows_of(field, key, n=N):
    k_x, k_u = random.split(key)
    x = jax.vmap(lambda k: random_state(k, 0.5))(random.split(k_x, n))
    u = jax.vmap(random_command)(random.split(k_u, n))
    return Targets(x, u, jax.vmap(field)(x, u), u.omega, jnp.ones(n, dtype=bool))


@eqx.filter_jit
def missed(state, rows, first=None):
    """Root mean square of what both layers miss, or a closed form alone."""
    predict = MODEL.predict if first is None else lambda _, x, u: FIRST.predict(first, x, u)
    predicted = jax.vmap(lambda x, u: predict(state, x, u))(rows.x, rows.u)
    return jnp.sqrt(jnp.mean(jnp.sum((rows.a_res - predicted) ** 2, axis=1)))


def learnt(field, key, fits=25):
    """The state after so many windows of the same world, each new."""
    state = MODEL.init(key)
    for k in random.split(key, fits):
        state, _ = fit(state, rows_of(field, k))
    return state


def jet(x, u):
    """What no physical feature of the closed form has: a push that depends on where the vehicle is."""
    return jnp.array([1.0, 0.0, 0.0]) + 3.0 * jnp.tanh(2.0 * x.p[2] - 2.0) * jnp.array([0.0, 1.0, 0.5])


def test_what_the_closed_form_leaves_is_learnt(key):
    state, fresh = learnt(jet, key), rows_of(jet, random.key(77))
    assert float(state.share) > 0.8
    assert float(missed(state, fresh)) < 0.5 * float(missed(state, fresh, alone(fresh)))


def test_where_nothing_is_left_nothing_is_added(key):
    """In a world of the closed form, on data with noise, the ensemble has no say to speak of."""
    noise = lambda x, u: jnp.array([1.0, -0.5, 0.0]) + 0.5 * jnp.sin(1e4 * x.p)  # noqa: E731
    state, calm = learnt(noise, key), rows_of(lambda x, u: jnp.array([1.0, -0.5, 0.0]), random.key(77))
    first = eqx.filter_jit(missed)(state, calm, state.first)
    assert float(missed(state, calm)) < float(first) + 0.1


def test_an_ensemble_that_was_fitted_to_another_world_is_not_believed(key):
    """The world changes; the ensemble knows the old one. Within two fits the closed form alone is no better."""
    state = learnt(jet, key)
    opposite = lambda x, u: -jet(x, u)  # noqa: E731
    for k in random.split(random.key(5), 2):
        rows = rows_of(opposite, k)
        state, _ = fit(state, rows)
    fresh = rows_of(opposite, random.key(6))
    assert float(missed(state, fresh)) < 1.1 * float(missed(state, fresh, alone(rows)))


def test_it_is_a_residual_model():
    check_residual(MODEL)


def test_it_knows_how_the_vehicle_turns_as_the_closed_form_does(key):
    rows = rows_of(jet, key)
    state, _ = fit(MODEL.init(key), rows)
    jax.tree.map(np.testing.assert_array_equal, MODEL.turning(state), state.first.rates)
