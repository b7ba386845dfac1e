"""A policy with any network equals the built-in perceptron for the same network, including its gradient."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import draw_starts, hover_env
from retrim import learn
from retrim.config import NetworkRequest, changed, load, register_network
from retrim.config.networks import NETWORKS, make_policy
from retrim.control import NetworkPolicy, Policy
from retrim.errors import ConfigError
from retrim.physics import small

policy_gradient = eqx.filter_jit(learn.policy_gradient)


class Perceptron(eqx.Module):
    layers: tuple[eqx.nn.Linear, ...]
    calls: jax.Array  # a constant

    def __call__(self, observation):
        h = observation
        for layer in self.layers[:-1]:
            h = jax.nn.relu(layer(h))
        return self.layers[-1](h)


@pytest.fixture
def both_policies(key):
    env = hover_env()
    policy = Policy.of(env.task.observation.size, small(), key=key, hidden=(8, 8))
    policy = jax.tree.map(lambda leaf: leaf, policy)
    policy = policy.with_params(jax.tree.map(lambda leaf: 5.0 * leaf, policy.layers))
    return env, policy, NetworkPolicy.create(Perceptron(policy.layers, jnp.array(3)), small())


def test_commands_equal_perceptron(both_policies, key):
    env, policy, network = both_policies
    o = random.normal(key, (env.task.observation.size,))
    np.testing.assert_allclose(network(o).vector(), policy(o).vector(), rtol=1e-12)
    by = jnp.array([0.1, -0.2, 0.3, 0.0])
    np.testing.assert_allclose(network.shifted(by)(o).vector(), policy.shifted(by)(o).vector(), rtol=1e-12)


def test_gradients_equal_perceptron(both_policies, key):
    env, policy, network = both_policies
    x0 = draw_starts(env.task, key, 3)
    loss, gradient = policy_gradient(network, env, x0)
    expected_loss, expected = policy_gradient(policy, env, x0)
    np.testing.assert_allclose(loss, expected_loss, rtol=1e-12)
    assert jax.tree.structure(gradient) == jax.tree.structure(network.params)
    for mine, theirs in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-7, atol=1e-12)


def test_only_floating_point_leaves_are_trained(both_policies):
    _, _, network = both_policies
    assert len(network.params) == len(network.leaves) - 1
    changed_policy = network.with_params(tuple(2.0 * leaf for leaf in network.params))
    assert int(next(leaf for leaf in changed_policy.leaves if leaf.dtype.kind == "i")) == 3


def request_for(name):
    preset = changed(load("hover/fast"), pretrain={"network": name})
    return NetworkRequest(preset, 15, small(), random.key(0))


def test_unsuitable_networks_are_refused():
    class Three(eqx.Module):
        def __call__(self, o):
            return o[:3]

    class Square(eqx.Module):
        def __call__(self, o):
            return jnp.eye(4) @ o

    setup = {"three": lambda request: Three(), "square": lambda request: Square(), "none": lambda request: 3}
    for name, make in setup.items():
        register_network(name, make)
    try:
        with pytest.raises(ConfigError, match=r"network 'three' returns an array of shape \(3,\), expected \(4,\)"):
            make_policy(request_for("three"))
        with pytest.raises(ConfigError, match="network 'square' cannot be called with an observation of 15 numbers"):
            make_policy(request_for("square"))
        with pytest.raises(ConfigError, match=r"returns int, expected a callable equinox\.Module"):
            make_policy(request_for("none"))
    finally:
        for name in setup:
            del NETWORKS._objects[name]
    with pytest.raises(ConfigError, match="no network 'mpl'; did you mean 'mlp'"):
        make_policy(request_for("mpl"))
