"""The ensemble on the remainder of the closed form helps if there is a remainder, and is never harmful."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import GOAL
from retrim.learn import EnsembleModel, Targets
from retrim.learn.residuals import LayeredModel, RegressionModel
from retrim.physics import Command, State, small, so3
from retrim.testing import check_residual

pytestmark = pytest.mark.usefixtures("optax_promotion")

FIRST = RegressionModel.of(0.02, memory=1e9)
SECOND = EnsembleModel(jnp.array(GOAL), small().omega_max, jnp.array(1e-2), jnp.array(1e-4), steps=20)
MODEL = LayeredModel(FIRST, SECOND)
N = 100

fit, fresh = eqx.filter_jit(MODEL.fit), eqx.filter_jit(MODEL.init)
alone = eqx.filter_jit(lambda rows: FIRST.fit(FIRST.init(random.key(0)), rows)[0])


@eqx.filter_jit
def rows_of(field, key, start=0, noise=0.0, n=N):
    """Return ticks from ``start`` on of a smooth flight through waves of position, attitude and thrust."""
    k_a, k_f, k_phase, k_noise = random.split(key, 4)
    size, phase = random.uniform(k_a, (7,)), 2.0 * jnp.pi * random.uniform(k_phase, (7,))
    rate = 1.0 + 2.0 * random.uniform(k_f, (7,))
    angle = 0.02 * (start + jnp.arange(float(n)))[:, None] * rate[None] + phase[None]
    wave, slope = size[None] * jnp.sin(angle), size[None] * rate[None] * jnp.cos(angle)
    R = jax.vmap(so3.exp)(0.3 * wave[:, 3:6])
    x = jax.vmap(State)(jnp.array([GOAL]) + wave[:, :3], R, slope[:, :3])
    u = jax.vmap(Command)(9.81 + wave[:, 6], 0.3 * slope[:, 3:6])
    a_res = jax.vmap(field)(x, u) + noise * random.normal(k_noise, (n, 3))
    return Targets(x, u, a_res, u.omega, jnp.ones(n, dtype=bool))


@eqx.filter_jit
def rms_error(state, rows, first=None):
    """Return the root mean square error of both layers, or of a closed form alone."""
    predict = MODEL.predict if first is None else lambda _, x, u: FIRST.predict(first, x, u)
    prediction = jax.vmap(lambda x, u: predict(state, x, u))(rows.x, rows.u)
    return jnp.sqrt(jnp.mean(jnp.sum((rows.a_res - prediction) ** 2, axis=1)))


def fly_once(field, key, fits=20):
    """Return the errors of both layers and of the closed form alone, ten ticks ahead of each window of a flight."""
    state, errors = fresh(key), []
    for i in range(fits):
        state, _ = fit(state, rows_of(field, key, jnp.array(10.0 * i)))
        ahead = rows_of(field, key, jnp.array(10.0 * i + 10.0))
        errors.append((float(rms_error(state, ahead)), float(rms_error(state, ahead, state.first))))
    return state, np.array(errors)


def jet(x, u):
    """A push that depends on position, which no physical feature of the closed form describes."""
    return jnp.array([1.0, 0.0, 0.0]) + 3.0 * jnp.tanh(2.0 * x.p[2] - 2.0) * jnp.array([0.0, 1.0, 0.5])


@pytest.fixture(scope="module")
def in_the_jet():
    with jax.numpy_dtype_promotion("standard"):
        return fly_once(jet, random.key(0))


def test_remainder_of_closed_form_is_learned(in_the_jet):
    """The ensemble reduces the error, and increases it in no window."""
    _, errors = in_the_jet
    both, alone = errors.T
    assert both[5:].mean() < 0.93 * alone[5:].mean()
    assert (both < 1.03 * alone).all()


def test_noise_is_not_learned(key):
    """For white noise, and for noise of a velocity whose differences are the targets, the share is almost zero."""
    push = lambda x, u: jnp.array([1.0, -0.5, 0.0])  # noqa: E731
    state = fresh(key)
    for i, k in enumerate(random.split(key, 10)):
        rows = rows_of(push, key, jnp.array(10.0 * i))
        dv = 0.01 * random.normal(k, (N + 1, 3))
        noisy = eqx.tree_at(
            lambda r: (r.x.v, r.a_res), rows, (rows.x.v + dv[:-1], rows.a_res + jnp.diff(dv, axis=0) / 0.02)
        )
        state, _ = fit(state, noisy)
    assert float(state.share) < 0.05
    state, _ = fit(state, rows_of(push, key, jnp.array(100.0), 0.5))
    assert float(state.share) < 0.2


def test_ensemble_of_different_disturbance_is_not_used(in_the_jet, key):
    """The disturbance changes after the ensemble was fitted. Within two fits the closed form alone is not better."""
    state, _ = in_the_jet
    opposite = lambda x, u: -jet(x, u)  # noqa: E731
    for i in range(2):
        rows = rows_of(opposite, key, jnp.array(250.0 + 10.0 * i))
        state, _ = fit(state, rows)
    ahead = rows_of(opposite, key, jnp.array(280.0))
    assert float(rms_error(state, ahead)) < 1.1 * float(rms_error(state, ahead, alone(rows)))


def test_conformance():
    check_residual(MODEL)


def test_rates_equal_those_of_closed_form(key):
    rows = rows_of(jet, key)
    rows = eqx.tree_at(lambda r: r.omega, rows, rows.omega + jnp.array([[0.3, 0.0, -0.2]]))
    state, _ = fit(fresh(key), rows)
    np.testing.assert_allclose(MODEL.turning(state).bias, [0.3, 0.0, -0.2], atol=0.02)


def test_window_without_valid_rows_changes_no_layer(key):
    """Neither layer changes while commands are at a limit."""
    limits = Command(jnp.array(5.0), -10.0 * jnp.ones(3)), Command(jnp.array(25.0), 10.0 * jnp.ones(3))
    model = LayeredModel(RegressionModel.of(0.02, limits=limits), SECOND)
    limited, rows = eqx.filter_jit(model.fit), rows_of(jet, key)
    names, _ = limited(model.init(key), rows)
    idle = Targets(rows.x, jax.vmap(Command)(jnp.full(N, 5.1), rows.u.omega), rows.a_res, rows.omega, rows.valid)
    after, rms = limited(names, idle)
    jax.tree.map(np.testing.assert_array_equal, eqx.filter(after, eqx.is_array), eqx.filter(names, eqx.is_array))
    assert float(rms) == 0.0
