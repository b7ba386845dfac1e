"""PPO: advantages as defined, a solved task with a known optimum, and bootstrapping at truncated episodes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from retrim.learn.problem import Outcome
from retrim_paper.datt.advantages import Experience, advantages
from retrim_paper.datt.ppo import PpoSettings, PpoState, log_prob, ppo

pytestmark = pytest.mark.usefixtures("optax_promotion")

A, B, NOISE, EFFORT, DISCOUNT = 0.9, 0.5, 0.1, 0.5, 0.9


class Linear(eqx.Module):
    """x' = A x + B a + noise, with the reward -(x^2 + EFFORT a^2), truncated after 20 steps."""

    def reset(self, key):
        return random.uniform(key, (), minval=-1.0, maxval=1.0), jnp.array(0)

    def observe(self, s, key):
        return s[0][None]

    def step(self, s, action, key):
        x, k = s
        reward = -(x**2 + EFFORT * action[0] ** 2)
        after = A * x + B * action[0] + NOISE * random.normal(key, ())
        return (after, k + 1), Outcome(reward, jnp.array(False), k + 1 >= 20)


class Gain(eqx.Module):
    """A linear policy and a quadratic value, the forms of the optimum."""

    gain: jax.Array
    value: jax.Array
    log_std: jax.Array

    def __call__(self, o):
        return self.gain * o, self.value[0] + self.value[1] * o[0] ** 2


def optimum():
    """Return gain and value of the discounted linear-quadratic regulator, by iterating Riccati's equation."""
    p = 1.0
    for _ in range(500):
        p = 1.0 + DISCOUNT * A**2 * p - (DISCOUNT * A * B * p) ** 2 / (EFFORT + DISCOUNT * B**2 * p)
    return -DISCOUNT * A * B * p / (EFFORT + DISCOUNT * B**2 * p), -p * (1.0 - DISCOUNT)


def test_solves_regulator_with_known_optimum(key):
    settings = PpoSettings(envs=64, steps=32, minibatches=4, epochs=4, learning_rate=0.02, discount=DISCOUNT)
    net = Gain(jnp.zeros(1), jnp.zeros(2), jnp.full(1, -1.0))
    learner_state = list(ppo(Linear(), PpoState.of(Linear(), net, key, settings), settings, steps=64 * 32 * 160))
    net, figures = learner_state[-1][0].net, [message for _, message in learner_state]
    gain, curvature = optimum()
    assert float(net.gain[0]) == pytest.approx(gain, rel=0.1)
    assert float(net.value[1]) == pytest.approx(curvature, rel=0.25)
    assert len(figures) == 160
    assert figures[-1]["reward"] > figures[0]["reward"]
    assert float(net.log_std[0]) < -1.5  # noise has a cost, so it decreases


def observe(key, over):
    k_r, k_v = random.split(key)
    n = over.shape[0]
    reward, value = random.normal(k_r, (n, 1)), random.normal(k_v, (n, 1))
    outcome = Outcome(reward, over[:, None], jnp.zeros((n, 1), dtype=bool))
    return Experience(jnp.zeros((n, 1, 1)), jnp.zeros((n, 1, 1)), jnp.zeros((n, 1)), value, outcome)


@pytest.mark.parametrize("ends", [(), (3,), (0, 5, 7)])
def test_advantages_are_returns_minus_values_or_temporal_differences(ends, key):
    """For lambda = 1, discounted returns up to the end of the episode; for lambda = 0, temporal differences."""
    over = jnp.zeros(8, dtype=bool).at[jnp.array(ends, dtype=int)].set(True)
    rows, last = observe(key, over), jnp.array([0.7])
    reward, value = np.asarray(rows.outcome.reward)[:, 0], np.asarray(rows.value)[:, 0]
    expected, differences, after, value_after = [], [], 0.7, 0.7
    for k in reversed(range(8)):
        goes_on = 0.0 if k in ends else 0.9
        after = reward[k] + goes_on * after
        expected.insert(0, after - value[k])
        differences.insert(0, reward[k] + goes_on * value_after - value[k])
        value_after = value[k]
    np.testing.assert_allclose(advantages(rows, last, 0.9, 1.0)[:, 0], expected, atol=1e-12)
    np.testing.assert_allclose(advantages(rows, last, 0.9, 0.0)[:, 0], differences, atol=1e-12)


def test_densities_integrate_to_one():
    mean, log_std = jnp.array([0.3]), jnp.array([-0.7])
    x = jnp.linspace(-6.0, 6.0, 4001)
    density = jnp.exp(jax.vmap(lambda a: log_prob(a[None], mean, log_std))(x))
    assert float(jnp.sum(density) * (x[1] - x[0])) == pytest.approx(1.0, abs=1e-6)


def test_indivisible_sample_count_is_refused():
    with pytest.raises(ValueError, match="PPO: 10 x 3 samples cannot be split into 4 batches"):
        PpoSettings(envs=10, steps=3, minibatches=4)
