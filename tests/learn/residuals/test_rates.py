"""Bias and lag of body rates are identified, with and without noise, and noise is not identified as bias."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import first_order, random_state, replace_fields, residual_targets
from retrim.learn import Window
from retrim.learn.residuals import RateModel
from retrim.physics import Command, LaggedModel, PointMass, so3
from retrim.physics.actuators import RateBiasedModel

DT = 0.02
MODEL = RateModel.of(DT, memory=0.5)
ENDLESS = replace_fields(MODEL, memory=jnp.array(1e9))


@eqx.filter_jit
def window_of(key, tau, bias, noise=0.0, n=100):
    """Return a flight under random commands of a vehicle with a rate lag and bias, measured with noise [rad]."""
    k_x, k_c, k_w, k_noise = random.split(key, 4)
    model = LaggedModel(RateBiasedModel(PointMass(DT), bias), first_order(tau))
    c = 9.81 + random.normal(k_c, (n,))
    u = jax.vmap(Command)(c, jnp.repeat(random.normal(k_w, (n // 4, 3)), 4, axis=0))

    def tick(s, u):
        return model.step(s, u, jnp.zeros(3)), model.state(s)

    _, x = lax.scan(tick, model.init(random_state(k_x)), u)
    R = jax.vmap(lambda R, e: so3.mul(R, so3.exp(noise * e)))(x.R, random.normal(k_noise, (n, 3)))
    return Window(DT * jnp.arange(float(n)), eqx.tree_at(lambda x: x.R, x, R), u, jnp.ones(n, dtype=bool))


@eqx.filter_jit
def fit(model, window):
    return model.fit(residual_targets(window, PointMass(DT)))


@pytest.mark.parametrize("tau", [0.01, 0.03, 0.08])
@pytest.mark.parametrize("bias", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.1)])
def test_lag_and_bias_are_identified(key, tau, bias):
    result = fit(ENDLESS, window_of(key, jnp.array(tau), jnp.array(bias)))
    np.testing.assert_allclose(result.bias, bias, atol=0.01)
    np.testing.assert_allclose(np.log(result.tau / tau), 0.0, atol=0.15)  # the step of the grid is a fifth


@pytest.mark.parametrize("yaw", [0.02, 0.2, 0.5])
def test_yaw_has_separate_lag(key, yaw):
    lag = Command(jnp.array(0.03), jnp.array([0.06, 0.06, yaw]))
    result = fit(ENDLESS, window_of(key, lag, jnp.array([0.1, -0.1, 0.1]), n=200))
    np.testing.assert_allclose(np.log(result.tau / lag.omega), 0.0, atol=0.2)
    assert result.tau[0] == result.tau[1]
    np.testing.assert_allclose(result.bias, [0.1, -0.1, 0.1], atol=0.03)


def test_noise_does_not_shorten_lag(key):
    """Attitude noise of 0.2 degrees corresponds to rate noise of 0.25 rad/s over one tick."""
    window = window_of(key, jnp.array(0.06), jnp.array([0.2, 0.0, -0.2]), noise=0.0035, n=200)
    result = fit(ENDLESS, window)
    np.testing.assert_allclose(result.bias, [0.2, 0.0, -0.2], atol=3.0 * float(result.deviation[0]))
    assert ((result.tau > 0.04) & (result.tau < 0.09)).all()


def test_new_bias_is_learned_within_memory(key):
    before, after = (window_of(key, jnp.array(0.03), jnp.array([b, 0.0, 0.0])) for b in (0.0, 0.4))
    whole = jax.tree.map(lambda a, b: jnp.concatenate([a[:50], b[50:]]), before, after)
    assert abs(float(fit(replace_fields(MODEL, memory=jnp.array(0.2)), whole).bias[0]) - 0.4) < 0.06


def test_posterior_without_data_is_prior(key):
    window = window_of(key, jnp.array(0.03), jnp.array([0.4, 0.0, 0.0]))
    result = fit(MODEL, replace_fields(window, valid=jnp.zeros(100, dtype=bool)))
    jax.tree.map(np.testing.assert_array_equal, result, MODEL.init())


def test_hover_does_not_identify_lag(key):
    """Constant commands leave the prior of the time constant unchanged, and identify the bias."""
    window = window_of(key, jnp.array(0.1), jnp.array([0.2, 0.0, 0.0]))
    still = replace_fields(window, u=jax.tree.map(jnp.zeros_like, window.u))
    R = jax.vmap(lambda t: so3.exp(t * jnp.array([0.2, 0.0, 0.0])))(still.t)
    result = fit(ENDLESS, eqx.tree_at(lambda w: w.x.R, still, R))
    np.testing.assert_allclose(result.bias[0], 0.2, atol=0.01)
    ratio = result.tau / MODEL.tau_prior
    assert ((ratio > 0.5) & (ratio < 2.0)).all()


@pytest.mark.parametrize("period", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("phase", [0.0, 1.5, 3.0])
def test_swing_is_not_bias(key, period, phase):
    """A vehicle swings, and the lag does not explain it: compensation of a bias that follows the swing increases it."""
    rows = residual_targets(window_of(key, jnp.array(0.03), jnp.zeros(3)), PointMass(DT))
    swing = jnp.sin(2.0 * jnp.pi * DT / period * jnp.arange(float(rows.omega.shape[0])) + phase)
    rows = replace_fields(rows, omega=rows.omega + swing[:, None])
    assert (jnp.abs(MODEL.fit(rows).bias) < 0.1).all()
