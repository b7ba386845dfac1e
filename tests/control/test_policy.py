"""The policy: bounded, centred at hover, differentiable at its limits; sizes as published."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from retrim.control import Policy
from retrim.control.policy import Policy as PolicyType
from retrim.learn.residuals import EnsembleResidual
from retrim.physics import large, small
from retrim_paper.datt.controller import DattNet


def size(tree):
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize(("inputs", "parameters"), [(15, 272_900), (27, 279_044), (82, 307_204)])
def test_parameter_counts_of_the_paper(inputs, parameters, key):
    assert size(Policy.of(inputs, small(), key=key).layers) == parameters


def test_parameter_count_of_the_residual(key):
    residual = EnsembleResidual.of(jnp.zeros(3), small().omega_max, key=key)
    assert [size(member) for member in residual.layers] == [19_459] * 3


@pytest.mark.parametrize("make", [small, large])
def test_output_is_bounded_and_centred(make, key):
    vehicle = make()
    policy = Policy.of(15, vehicle, key=key, hidden=(8,))
    np.testing.assert_allclose(policy.limit(jnp.zeros(4)).vector(), [9.81, 0, 0, 0], atol=1e-12)
    for y in (jnp.full(4, 1e3), jnp.full(4, -1e3)):
        u = policy.limit(y).vector()
        limit = (vehicle.command_max if y[0] > 0 else vehicle.command_min).vector()
        np.testing.assert_allclose(u, limit, rtol=1e-12)


def test_every_output_has_a_gradient_near_its_limit(key):
    policy = Policy.of(15, small(), key=key, hidden=(8,))
    for y in (-6.0, 0.0, 6.0):
        J = jax.jacobian(lambda y: policy.limit(y).vector())(jnp.full(4, y))
        assert (np.diag(J) > 1e-3).all()
        assert np.count_nonzero(J - np.diag(np.diag(J))) == 0


def test_fresh_policy_hovers(key):
    policy = Policy.of(15, small(), key=key)
    o = random.normal(key, (15,))
    np.testing.assert_allclose(policy(o).vector(), [9.81, 0, 0, 0], atol=0.05)


@pytest.mark.parametrize(
    "make", [lambda key: Policy.of(15, small(), key=key, hidden=(8,)), lambda key: DattNet.of(key=key)]
)
def test_fresh_network_has_types_of_trained_network(make, key):
    """A weak type would compile the same program twice."""
    arrays = jax.tree.leaves(eqx.filter(make(key), eqx.is_array))
    assert arrays
    assert not any(leaf.weak_type for leaf in arrays)


def test_zero_perturbations_have_no_effect(key):
    policy: PolicyType = Policy.of(15, small(), key=key, hidden=(8, 8))
    policy = jax.tree.map(lambda leaf: leaf + 0.2, policy)
    o = random.normal(key, (15,))
    u, inputs = policy.perturb(o, tuple(jnp.zeros(n) for n in (8, 8, 4)))
    np.testing.assert_array_equal(u.vector(), policy(o).vector())
    assert [len(h) for h in inputs] == [15, 8, 8]
