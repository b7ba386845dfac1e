"""The residual: targets to the digit, recovery of known fields, the spectral penalty against the exact norm."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import random

from helpers import GOAL, random_command, random_state, stacked
from retrim.learn import EnsembleResidual, ResidualState, Window, ZeroResidual, fit_residual, residual_targets
from retrim.learn.residuals.ensemble import _spectral
from retrim.physics import Command, PointMass, State, small

OPTIMISER = optax.adam(1e-2)

pytestmark = pytest.mark.usefixtures("optax_promotion")


def logged(field, key, *, n=100, delay=0):
    """A flight under random commands in a world that is Eq. (1) plus ``field``; commands act ``delay`` ticks late."""
    model, commands, states = PointMass(0.02), [], [State.at(jnp.array(GOAL))]
    for k in random.split(key, n):
        kc, kw = random.split(k)
        commands.append(Command(9.81 + random.normal(kc, ()), 0.5 * random.normal(kw, (3,))))
        acting = commands[-1 - delay] if len(commands) > delay else Command.hover()
        x = states[-1]
        states.append(model.step(x, acting, field(x, acting)))
    return Window(0.02 * jnp.arange(n), stacked(states[:n]), stacked(commands), jnp.ones(n, dtype=bool))


def ensemble(key, members=3, hidden=(128, 128)):
    return EnsembleResidual.of(jnp.array(GOAL), small().omega_max, key=key, members=members, hidden=hidden)


def linear_drag(x, u):
    return -0.4 * x.v + jnp.array([0.5, 0.0, 0.2])


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_targets_are_exact_when_the_delay_is_right(delay, key):
    window = logged(linear_drag, key, n=20, delay=delay)
    rows = residual_targets(window, PointMass(0.02), delay=delay)
    assert rows.a_res.shape == (19 - delay, 3)
    expected = jax.vmap(lambda x, u: linear_drag(x, u))(rows.x, rows.u)
    np.testing.assert_allclose(rows.a_res, expected, atol=1e-10)
    wrong = residual_targets(window, PointMass(0.02), delay=delay + 1)
    assert float(jnp.abs(wrong.a_res - jax.vmap(linear_drag)(wrong.x, wrong.u)).max()) > 0.1


def test_a_window_must_be_longer_than_the_delay(key):
    with pytest.raises(ValueError, match="window of 3 ticks is too short for a delay of 2"):
        residual_targets(logged(linear_drag, key, n=3), PointMass(0.02), delay=2)


def test_a_filling_window_counts_only_what_was_flown(key):
    window = logged(lambda x, u: jnp.array([1.0, 0.0, 0.0]), key, n=40)
    spoilt = eqx.tree_at(lambda w: (w.x.v, w.valid), window, (window.x.v.at[:10].set(100.0), jnp.arange(40) >= 11))
    state = ResidualState.of(ensemble(key), OPTIMISER)
    rows = residual_targets(spoilt, PointMass(0.02))
    fitted, errors = fit_residual(state, rows, optimiser=OPTIMISER, iters=100, beta=1e-4)
    assert float(errors[-1]) < 1e-2
    predicted = jax.vmap(fitted.residual)(rows.x, rows.u)[np.asarray(rows.valid)]
    np.testing.assert_allclose(predicted, np.broadcast_to([1.0, 0.0, 0.0], predicted.shape), atol=0.3)


def fitted_on(field, key, fits=3):
    state = ResidualState.of(ensemble(key), OPTIMISER)
    rows = residual_targets(logged(field, key), PointMass(0.02))
    fit = jax.jit(lambda s: fit_residual(s, rows, optimiser=OPTIMISER, iters=100, beta=1e-4))
    for _ in range(fits):  # warm starts
        state, errors = fit(state)
    return state, rows, errors


def test_recovers_a_constant(key):
    a = jnp.array([2.0, -0.5, 0.3])
    state, rows, _ = fitted_on(lambda x, u: a, key)
    predicted = jax.vmap(state.residual)(rows.x, rows.u)
    np.testing.assert_allclose(predicted, np.broadcast_to(a, predicted.shape), atol=0.05)


def test_recovers_a_field_linear_in_velocity(key):
    state, rows, _ = fitted_on(linear_drag, key)
    predicted = jax.vmap(state.residual)(rows.x, rows.u)
    spread = float(jnp.std(rows.a_res))
    assert float(jnp.sqrt(jnp.mean((predicted - rows.a_res) ** 2))) < 0.1 * spread


def test_warm_start_continues(key):
    once, rows, first = fitted_on(linear_drag, key, fits=1)
    _, second = fit_residual(once, rows, optimiser=OPTIMISER, iters=100, beta=1e-4)
    assert float(second[0]) < 3.0 * float(first[-1]) < 0.1 * float(first[0])


def test_fresh_ensemble_predicts_nothing_and_its_members_differ(key):
    residual, x, u = ensemble(key), random_state(key), random_command(key)
    np.testing.assert_array_equal(residual(x, u), 0.0)
    np.testing.assert_array_equal(ZeroResidual()(x, u), 0.0)
    assert not np.allclose(residual.layers[0][0].weight, residual.layers[1][0].weight)


def test_prediction_is_the_mean_of_the_members(key):
    state, rows, _ = fitted_on(linear_drag, key, fits=1)
    x, u = jax.tree.map(lambda leaf: leaf[5], (rows.x, rows.u))
    np.testing.assert_allclose(state.residual(x, u), state.residual.members(x, u).mean(axis=0))


def test_power_iteration_finds_the_spectral_norm_and_its_gradient(key):
    W = random.normal(key, (30, 20))
    v = jnp.ones(20) / jnp.sqrt(20.0)
    for _ in range(300):
        squared, v = _spectral(W, v)
    U, S, Vt = np.linalg.svd(W)
    assert float(squared) == pytest.approx(S[0] ** 2, rel=1e-6)
    gradient = jax.grad(lambda W: _spectral(W, v)[0])(W)
    np.testing.assert_allclose(gradient, 2 * S[0] * np.outer(U[:, 0], Vt[0]), atol=1e-4 * S[0])


def test_the_penalty_of_a_zero_matrix_is_zero_and_finite():
    squared, v = _spectral(jnp.zeros((3, 5)), jnp.ones(5))
    assert float(squared) == 0.0
    np.testing.assert_array_equal(v, 1.0)
    assert np.isfinite(jax.grad(lambda W: _spectral(W, jnp.ones(5))[0])(jnp.zeros((3, 5)))).all()


def test_the_penalty_shrinks_the_spectral_norm(key):
    rows = residual_targets(logged(linear_drag, key), PointMass(0.02))

    def norm(beta):
        state = ResidualState.of(ensemble(key, members=1), OPTIMISER)
        state, _ = fit_residual(state, rows, optimiser=OPTIMISER, iters=200, beta=beta)
        return np.linalg.norm(state.residual.layers[0][1].weight, 2)

    assert norm(1.0) < 0.7 * norm(0.0)


def test_features_are_of_order_one(key):
    residual = ensemble(key)
    x = State(jnp.array([1.0, -1.0, 2.0]), jnp.eye(3), jnp.array([3.0, -3.0, 1.0]))
    u = Command(jnp.array(15.0), jnp.array([5.0, -5.0, 3.0]))
    features = (jnp.concatenate([x.vector(), u.vector()]) - residual.offset) / residual.scale
    assert float(jnp.abs(features).max()) <= 1.0
