"""The ensemble: recovery of known fields, warm starts, spread, and the spectral penalty against the exact norm."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import random

from helpers import GOAL, random_command, random_field_flight, random_state, replace_fields, residual_targets
from retrim.learn import EnsembleModel, FittedResidual, ResidualModel
from retrim.learn.residuals import EnsembleResidual, EnsembleState, fit_ensemble
from retrim.learn.residuals.ensemble import _spectral
from retrim.physics import Command, PointMass, State, small

OPTIMISER = optax.adam(1e-2)

pytestmark = pytest.mark.usefixtures("optax_promotion")


@eqx.filter_jit
def _fit(state, rows, weight):
    return fit_ensemble(state, rows, optimiser=OPTIMISER, steps=100, spectral_weight=weight)


def fit(state, rows, spectral_weight=1e-4):
    """Fit with a hundred steps, as one program for all tests."""
    return _fit(state, rows, jnp.array(spectral_weight))


def ensemble(key, hidden=(64, 64)):
    fresh = eqx.filter_jit(EnsembleResidual.of)
    return fresh(jnp.array(GOAL), small().omega_max, key=key, members=3, hidden=hidden)


state_of = eqx.filter_jit(lambda residual: EnsembleState.of(residual, OPTIMISER))
predictions = eqx.filter_jit(lambda residual, rows: jax.vmap(residual)(rows.x, rows.u))
fit_of_model = eqx.filter_jit(lambda model, state, rows: model.fit(state, rows))


def linear_drag(x, u):
    return -0.4 * x.v + jnp.array([0.5, 0.0, 0.2])


def test_partly_filled_window_uses_valid_rows_only(key):
    window = random_field_flight(lambda x, u: jnp.array([1.0, 0.0, 0.0]), key)
    v = jnp.where(jnp.arange(100)[:, None] < 70, 100.0, window.x.v)
    spoilt = eqx.tree_at(lambda w: (w.x.v, w.valid), window, (v, jnp.arange(100) >= 71))
    rows = residual_targets(spoilt, PointMass(0.02))
    fit_result, errors = fit(state_of(ensemble(key)), rows)
    assert float(np.asarray(errors)[-1]) < 1e-2
    prediction = np.asarray(predictions(fit_result.residual, rows))[np.asarray(rows.valid)]
    np.testing.assert_allclose(prediction, np.broadcast_to([1.0, 0.0, 0.0], prediction.shape), atol=0.3)


def fit_on(field, key, fits=3):
    state = state_of(ensemble(key))
    rows = residual_targets(random_field_flight(field, key), PointMass(0.02))
    for _ in range(fits):  # warm starts
        state, errors = fit(state, rows)
    return state, rows, errors


def test_recovers_constant(key):
    a = jnp.array([2.0, -0.5, 0.3])
    state, rows, _ = fit_on(lambda x, u: a, key)
    prediction = np.asarray(predictions(state.residual, rows))
    np.testing.assert_allclose(prediction, np.broadcast_to(a, prediction.shape), atol=0.05)


def test_recovers_field_linear_in_velocity(key):
    state, rows, _ = fit_on(linear_drag, key)
    prediction = np.asarray(predictions(state.residual, rows))
    assert np.sqrt(np.mean((prediction - np.asarray(rows.a_res)) ** 2)) < 0.1 * np.std(rows.a_res)


def test_warm_start_continues(key):
    once, rows, first = fit_on(linear_drag, key, fits=1)
    _, second = fit(once, rows)
    assert float(second[0]) < 3.0 * float(first[-1]) < 0.1 * float(first[0])


def test_fresh_ensemble_predicts_zero_and_members_differ(key):
    residual, x, u = ensemble(key), random_state(key), random_command(key)
    np.testing.assert_array_equal(residual(x, u), 0.0)
    assert not np.allclose(residual.layers[0][0].weight, residual.layers[1][0].weight)


def test_prediction_is_mean_of_members(key):
    state, rows, _ = fit_on(linear_drag, key, fits=1)
    x, u = jax.tree.map(lambda leaf: leaf[5], (rows.x, rows.u))
    np.testing.assert_allclose(state.residual(x, u), state.residual.members(x, u).mean(axis=0))


def test_power_iteration_gives_spectral_norm_and_gradient(key):
    W = random.normal(key, (30, 20))
    v = jnp.ones(20) / jnp.sqrt(20.0)
    spectral = jax.jit(_spectral)
    for _ in range(300):
        square, v = spectral(W, v)
    U, S, Vt = np.linalg.svd(W)
    assert float(square) == pytest.approx(S[0] ** 2, rel=1e-6)
    gradient = jax.jit(jax.grad(lambda W: _spectral(W, v)[0]))(W)
    np.testing.assert_allclose(gradient, 2 * S[0] * np.outer(U[:, 0], Vt[0]), atol=1e-4 * S[0])


def test_penalty_of_zero_matrix_is_zero_with_finite_gradient():
    value_and_slope = jax.jit(jax.value_and_grad(_spectral, has_aux=True))
    (square, v), slope = value_and_slope(jnp.zeros((3, 5)), jnp.ones(5))
    assert float(square) == 0.0
    np.testing.assert_array_equal(v, 1.0)
    assert np.isfinite(slope).all()


def test_penalty_reduces_spectral_norm(key):
    rows = residual_targets(random_field_flight(linear_drag, key), PointMass(0.02))

    def norm(spectral_weight):
        state = state_of(ensemble(key))
        for _ in range(2):
            state, _ = fit(state, rows, spectral_weight)
        return np.linalg.norm(state.residual.layers[0][1].weight, 2)

    assert norm(1.0) < 0.7 * norm(0.0)


def test_features_are_of_order_one(key):
    residual = ensemble(key)
    x = State(jnp.array([1.0, -1.0, 2.0]), jnp.eye(3), jnp.array([3.0, -3.0, 1.0]))
    u = Command(jnp.array(15.0), jnp.array([5.0, -5.0, 3.0]))
    features = (jnp.concatenate([x.vector(), u.vector()]) - residual.offset) / residual.scale
    assert float(jnp.abs(features).max()) <= 1.0


# ---- as a residual model of the online learner


fresh_state = eqx.filter_jit(lambda model, key: model.init(key))


@pytest.fixture
def model():
    weights = jnp.array(1e-2), jnp.array(1e-4)
    return EnsembleModel(jnp.array(GOAL), small().omega_max, *weights, steps=30, hidden=(64, 64))


def test_fresh_model_predicts_zero_without_spread(model, key):
    assert isinstance(model, ResidualModel)
    state, x, u = fresh_state(model, key), random_state(key), random_command(key)
    np.testing.assert_array_equal(model.predict(state, x, u), 0.0)
    np.testing.assert_array_equal(model.spread(state, x, u), 0.0)
    np.testing.assert_array_equal(FittedResidual(model, state)(x, u), 0.0)


def test_fit_continues_from_last_state(model, key):
    """Two fits of 30 steps equal one of 60 in weights, moments of Adam and vectors of the power iteration."""
    rows = residual_targets(random_field_flight(linear_drag, key), PointMass(0.02))
    fresh = fresh_state(model, key)
    once, first = fit_of_model(model, fresh, rows)
    twice, second = fit_of_model(model, once, rows)
    assert float(second) < float(first)
    (adam, _), (adam_fresh, _) = twice.optimiser, fresh.optimiser
    assert int(adam_fresh.count) == 0
    assert int(adam.count) == 60
    for v, v_fresh in zip(jax.tree.leaves(twice.vectors), jax.tree.leaves(fresh.vectors), strict=True):
        assert np.abs(np.asarray(v) - np.asarray(v_fresh)).max() > 1e-3
        assert np.linalg.norm(v) == pytest.approx(1.0)
    at_once, _ = fit_of_model(replace_fields(model, steps=60), fresh, rows)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), twice, at_once)


def test_fit_reports_error_before_last_step(model, key):
    rows = residual_targets(random_field_flight(linear_drag, key), PointMass(0.02))
    _, rms = fit_of_model(replace_fields(model, steps=1), fresh_state(model, key), rows)
    assert float(rms) == pytest.approx(np.sqrt(np.mean(np.sum(np.asarray(rows.a_res) ** 2, axis=1))))


def test_spread_is_standard_deviation_of_members(model, key):
    rows = residual_targets(random_field_flight(linear_drag, key), PointMass(0.02))
    state, _ = fit_of_model(model, fresh_state(model, key), rows)
    x, u = random_state(key, spread=3.0), random_command(key)
    members = np.asarray(eqx.filter_jit(state.residual.members)(x, u))
    assert members.shape == (3, 3)
    expected = np.sqrt(((members - members.mean(axis=0)) ** 2).mean(axis=0))
    np.testing.assert_allclose(model.spread(state, x, u), expected, rtol=1e-9)
    np.testing.assert_allclose(model.predict(state, x, u), members.mean(axis=0), rtol=1e-9)
    assert (expected > 1e-4).all()


def test_spectral_weight_applies_to_every_layer_and_member(key):
    """Without valid rows, only the penalty changes the weights: one step of gradient descent shows its gradient.

    Each weight matrix then changes along its leading singular vectors by 2 w sigma u v^T; biases are unchanged.
    """
    descent = optax.sgd(1e-2)
    residual = ensemble(key, hidden=(16, 16))
    # the last layer of a fresh member is zero
    residual = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf) + 0.02), residual)
    state = EnsembleState.of(residual, descent)
    exact = jax.tree.map(
        lambda l: jnp.asarray(np.linalg.svd(np.asarray(l.weight))[2][0]),
        residual.layers,
        is_leaf=lambda l: isinstance(l, eqx.nn.Linear),
    )
    state = replace_fields(state, vectors=exact)
    rows = residual_targets(random_field_flight(linear_drag, key), PointMass(0.02))
    rows = replace_fields(rows, valid=jnp.zeros_like(rows.valid))
    one_step = eqx.filter_jit(
        lambda weight: fit_ensemble(state, rows, optimiser=descent, steps=1, spectral_weight=weight)
    )
    (after, _), (still, _) = (one_step(jnp.array(weight)) for weight in (0.5, 0.0))
    for member, shift, at_rest in zip(residual.layers, after.residual.layers, still.residual.layers, strict=True):
        for layer, new, same in zip(member, shift, at_rest, strict=True):
            U, S, Vt = np.linalg.svd(np.asarray(layer.weight))
            step = 1e-2 * 0.5 * 2.0 * S[0] * np.outer(U[:, 0], Vt[0])
            assert np.abs(step).max() > 1e-4
            np.testing.assert_allclose(np.asarray(layer.weight) - np.asarray(new.weight), step, atol=1e-9)
            np.testing.assert_array_equal(new.bias, layer.bias)
            np.testing.assert_array_equal(same.weight, layer.weight)


def test_fit_uses_spectral_weight_of_model(model, key):
    rows = residual_targets(random_field_flight(linear_drag, key), PointMass(0.02))
    heavy = replace_fields(model, spectral_weight=jnp.array(0.3), steps=5)
    fresh = fresh_state(heavy, key)
    result, _ = fit_of_model(heavy, fresh, rows)
    by_weight = eqx.filter_jit(lambda w: fit_ensemble(fresh, rows, optimiser=OPTIMISER, steps=5, spectral_weight=w)[0])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), result, by_weight(jnp.array(0.3)))
    without = by_weight(jnp.array(0.0)).residual.layers[0][1].weight
    assert np.abs(np.asarray(result.residual.layers[0][1].weight) - np.asarray(without)).max() > 1e-3


def test_fit_without_steps_is_refused():
    with pytest.raises(ValueError, match=r"EnsembleModel\.steps = 0 must be at least 1"):
        EnsembleModel(jnp.zeros(3), small().omega_max, jnp.array(0.01), jnp.array(0.0), steps=0)
