"""The closed-form residual: its posterior, its forgetting, and the parameters that it identifies."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import random_command, random_field_flight, random_state, replace_fields, residual_targets
from retrim.learn.residuals import RegressionModel, Targets
from retrim.learn.residuals.regression import BLOCK, features_of
from retrim.physics import Command, PointMass, so3

MODEL = RegressionModel.of(0.02, memory=0.5, noise=0.5)
ENDLESS = replace_fields(MODEL, memory=jnp.array(1e9))


def rows_of(parameters, key, n=96, noise=0.0, valid=None):
    """Return random states and commands, and the accelerations for ``parameters`` (n x 10, or 10)."""
    parameters = jnp.asarray(np.broadcast_to(parameters, (n, 10)))
    return _rows_of(parameters, key, jnp.array(noise), jnp.ones(n, dtype=bool) if valid is None else valid)


@jax.jit
def _rows_of(parameters, key, noise, valid):
    (k_x, k_u, k_noise), n = random.split(key, 3), len(parameters)
    x = jax.vmap(random_state)(random.split(k_x, n))
    u = jax.vmap(random_command)(random.split(k_u, n))
    a_res = jnp.einsum("nik,nk->ni", jax.vmap(features_of)(x, u), parameters)
    return Targets(x, u, a_res + noise * random.normal(k_noise, a_res.shape), u.omega, valid)


def push(*d):
    return jnp.asarray(np.append(d, np.zeros(7)))


_fit = eqx.filter_jit(lambda model, state, rows: model.fit(state, rows))


def fit(model, rows):
    return _fit(model, model.init(random.key(0)), rows)


def test_posterior_without_data_is_prior(key):
    rows = rows_of(push(1.0, 2.0, 3.0), key, valid=jnp.zeros(96, dtype=bool))
    state, _ = fit(MODEL, rows)
    jax.tree.map(np.testing.assert_allclose, state, MODEL.init(key))
    x, u = random_state(key), random_command(key)
    np.testing.assert_array_equal(MODEL.predict(state, x, u), 0.0)


def test_posterior_equals_kalman_recursion(key):
    """The recursion in NumPy, row by row, ends at the closed form."""
    rows = rows_of(0.3 * random.normal(key, (10,)) * MODEL.prior, key, n=40, noise=0.3)
    mean, covariance = np.zeros(10), np.diag(np.asarray(MODEL.prior) ** 2)
    for phi, a in zip(np.asarray(jax.vmap(features_of)(rows.x, rows.u)), np.asarray(rows.a_res), strict=True):
        gain = covariance @ phi.T @ np.linalg.inv(phi @ covariance @ phi.T + 0.25 * np.eye(3))
        mean, covariance = mean + gain @ (a - phi @ mean), covariance - gain @ phi @ covariance
    state, _ = fit(ENDLESS, rows)
    np.testing.assert_allclose(state.mean, mean, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(state.covariance, covariance, rtol=1e-7, atol=1e-12)


def test_old_rows_have_less_weight(key):
    """For a slow drift without a detected change, a short memory follows more closely than a long one."""
    drift = np.linspace(0.0, 0.4, 96)[:, None] * np.asarray(push(1.0, 0.0, 0.0))
    rows = rows_of(drift, key)
    short, long = (float(fit(replace_fields(MODEL, memory=jnp.array(m)), rows)[0].mean[0]) for m in (0.1, 1e9))
    assert 0.33 < short < 0.4
    assert 0.15 < long < 0.25


@pytest.mark.parametrize("since", [BLOCK, 2 * BLOCK, 5 * BLOCK])
def test_rows_before_change_are_discarded(key, since):
    """After a step of 2 m/s^2 on each axis, earlier rows have no effect."""
    n = 96
    before = (jnp.arange(n) < n - since)[:, None]
    rows = rows_of(jnp.where(before, push(-1.0, -1.0, -1.0), push(1.0, 1.0, 1.0)), key, noise=0.1)
    state, _ = fit(MODEL, rows)
    np.testing.assert_allclose(state.mean[:3], 1.0, atol=0.2)


def test_noise_is_not_a_change(key):
    """Nearly all of several hundred windows with noise of the stated size are used completely."""
    model = ENDLESS

    def precision(key):
        return model.fit(model.init(key), rows_of(np.zeros(10), key, noise=0.5))[0].covariance[0, 0]

    result = np.asarray(jax.jit(jax.vmap(precision))(random.split(key, 400)))
    whole = np.asarray(fit(model, rows_of(jnp.zeros(10), key))[0].covariance[0, 0])
    assert (result < 1.5 * whole).mean() > 0.98


@pytest.mark.parametrize(
    ("field", "parameter", "value", "tolerance"),
    [
        (lambda x, u: jnp.array([0.5, -1.0, 2.0]), slice(0, 3), [0.5, -1.0, 2.0], 0.02),
        (lambda x, u: 0.2 * (u.c - 9.81) * x.R[:, 2], 3, 0.2, 0.03),
        (lambda x, u: -0.4 * x.v, slice(4, 7), 0.4, 0.1),
    ],
    ids=["push", "thrust gain", "drag"],
)
def test_known_disturbances_are_identified(key, field, parameter, value, tolerance):
    """The data are states and commands of a flight with the delay of the plant; priors are wide, since the data are
    many.
    """
    model = replace_fields(ENDLESS, prior=10.0 * MODEL.prior, noise=jnp.array(0.05))
    window = random_field_flight(field, key, n=100, delay_ticks=1)
    rows = residual_targets(window, PointMass(0.02), delay_ticks=1)
    state, rms = fit(model, rows)
    np.testing.assert_allclose(state.mean[parameter], value, atol=tolerance)
    assert float(rms) < 0.05


def test_prediction_is_equivariant_to_rotation(key):
    """Rotated rows give the rotated prediction: features are physical and independent of the axes."""
    isotropic = replace_fields(MODEL, prior=MODEL.prior)
    Q = so3.exp(random.normal(key, (3,)))
    rows = rows_of(0.5 * random.normal(key, (10,)) * MODEL.prior, key, noise=0.2)
    x = jax.vmap(lambda x: type(x)(so3.act(Q, x.p), so3.mul(Q, x.R), so3.act(Q, x.v)))(rows.x)
    turned_rows = Targets(x, rows.u, rows.a_res @ Q.T, rows.omega, rows.valid)
    here, there = fit(isotropic, rows)[0], fit(isotropic, turned_rows)[0]
    one = jax.tree.map(lambda leaf: leaf[3], rows.x), jax.tree.map(lambda leaf: leaf[3], rows.u)
    other = jax.tree.map(lambda leaf: leaf[3], x), one[1]
    np.testing.assert_allclose(MODEL.predict(there, *other), so3.act(Q, MODEL.predict(here, *one)), atol=1e-9)


def test_spread_shrinks_with_data(key):
    x, u = random_state(key), random_command(key)
    wide = MODEL.spread(MODEL.init(key), x, u)
    narrow = MODEL.spread(fit(MODEL, rows_of(jnp.zeros(10), key))[0], x, u)
    assert (np.asarray(narrow) < 0.2 * np.asarray(wide)).all()
    assert (np.asarray(narrow) > 0.0).all()


LIMITS = Command(jnp.array(0.5), -10.0 * jnp.ones(3)), Command(jnp.array(40.5), 10.0 * jnp.ones(3))


def test_commands_at_limit_are_excluded(key):
    """At least thrust, a mixer adds thrust in order to rotate; this is neither a thrust gain nor a rate bias."""
    rows, model = rows_of(push(1.0, 0.0, 0.0), key), replace_fields(ENDLESS, limits=LIMITS)
    at = jnp.arange(96) % 2 == 0
    idle = jax.vmap(Command)(jnp.where(at, 1.0, rows.u.c), jnp.where(at[:, None], 9.5, rows.u.omega))
    lift = jnp.where(at[:, None], 10.0 * rows.x.R[:, :, 2], 0.0)
    mixture = replace_fields(rows, u=idle, a_res=rows.a_res + lift, omega=jnp.where(at[:, None], 0.0, rows.omega))
    message, left = fit(model, mixture)[0], fit(model, replace_fields(mixture, valid=~at))[0]
    jax.tree.map(np.testing.assert_array_equal, message, left)
    np.testing.assert_allclose(message.mean, push(1.0, 0.0, 0.0), atol=0.05)
    assert float(fit(ENDLESS, mixture)[0].mean[3]) < -0.5  # the gain that would explain the data


def test_window_without_valid_rows_changes_nothing(key):
    model = replace_fields(MODEL, limits=LIMITS)
    names, _ = fit(model, rows_of(push(1.0, 0.0, 0.0), key))
    assert float(names.mean[0]) > 0.5
    rows = rows_of(push(0.0, 2.0, 0.0), key)
    idle = replace_fields(rows, u=jax.vmap(Command)(jnp.zeros(96), rows.u.omega))
    state, _ = _fit(model, names, idle)
    jax.tree.map(np.testing.assert_array_equal, state, names)
