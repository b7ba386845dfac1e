"""The L1 estimator converges to a constant with its stated law, for any motion of the vehicle."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import call
from retrim.estimation.l1 import L1Estimator, L1State
from retrim.physics import State, so3

DT = 0.02


@partial(jax.jit, static_argnames="ticks")
def estimates(estimator, d, key, ticks=400):
    """Return estimates by tick for a vehicle that tumbles under random thrust and a disturbance ``d``."""

    def tick(carry, xs):
        (x, memory), (k, t) = carry, xs
        k_c, k_w = random.split(k)
        thrust = (9.81 + 3.0 * random.normal(k_c)) * x.R[:, 2]
        v = x.v + DT * (thrust + jnp.array([0.0, 0.0, -9.81]) + d)
        x = State(x.p + DT * x.v, x.R @ so3.exp(DT * random.normal(k_w, (3,))), v)
        memory = estimator(memory, t, x, thrust)
        return (x, memory), memory.d_hat

    x = State.at(jnp.zeros(3))
    first = estimator(L1State.start(x), jnp.array(0.0), x, jnp.zeros(3))
    return lax.scan(tick, (x, first), (random.split(key, ticks), DT * jnp.arange(1.0, ticks + 1.0)))[1]


@pytest.mark.parametrize("pole", [-0.01, -0.2, -2.0])
@pytest.mark.parametrize("tau", [0.2, 2.0])
def test_converges_to_constant_with_its_time_constant(pole, tau, key):
    d = jnp.array([2.0, -0.5, 1.0])
    estimator = L1Estimator(jnp.array(pole), jnp.exp(jnp.array(-DT / tau)), DT)
    result = np.asarray(estimates(estimator, d, key))
    t = DT * np.arange(1, len(result) + 1)
    expected = np.asarray(d) * (1.0 - np.exp(-t / tau))[:, None]
    # the law is exact up to A_s dt
    np.testing.assert_allclose(result, expected, atol=2.0 * DT * abs(pole) * 1.1 + 1e-3)
    np.testing.assert_allclose(result[0] / result[-1], -np.expm1(-DT / tau) / -np.expm1(-t[-1] / tau), rtol=0.05)


def test_estimate_is_linear_in_disturbance(key):
    estimator = L1Estimator(jnp.array(-0.2), jnp.array(0.95), DT)
    one, other = jnp.array([1.0, 0.0, -2.0]), jnp.array([0.0, 3.0, 0.5])
    a, b, both = (estimates(estimator, d, key, ticks=50) for d in (one, other, one + 2.0 * other))
    np.testing.assert_allclose(both, a + 2.0 * b, atol=1e-9)


def test_irregular_intervals_are_not_disturbance():
    """This applies to the first measurement and to missed ticks; afterwards the law continues to hold."""
    d, thrust = jnp.array([1.0, -0.5, 0.3]), jnp.array([2.0, 0.0, 11.0])
    estimator = L1Estimator(jnp.array(-0.2), jnp.exp(jnp.array(-DT / 0.1)), DT)
    gain = DT * (thrust + jnp.array([0.0, 0.0, -9.81]) + d)

    def after(ticks):
        memory, result = L1State.start(State.at(jnp.zeros(3))), []
        for k in ticks:
            x = State(jnp.zeros(3), jnp.eye(3), jnp.array([3.0, 0.0, 0.0]) + k * gain)
            memory = call(estimator, memory, jnp.array(DT * k), x, thrust)
            result.append(np.asarray(memory.d_hat))
        return np.stack(result)

    whole, error = after(range(40)), after([*range(20), *range(23, 40)])
    np.testing.assert_array_equal(whole[0], 0.0)
    np.testing.assert_array_equal(error[20], error[19])
    np.testing.assert_allclose(error[21:], whole[20:36], atol=0.02)
    np.testing.assert_allclose(error[-1], d, atol=0.03)
