"""Weights in both layouts: the layers are equal, and products read their matrices along rows."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random
from jax.extend.core import ClosedJaxpr, Jaxpr

from helpers import draw_starts, hover_env
from retrim.control import Policy
from retrim.learn import policy_gradient
from retrim.learn.residuals import EnsembleResidual
from retrim.learn.transposed_layers import TransposedLinear, with_transposed_copy
from retrim.physics import Hybrid, PointMass, small


@pytest.mark.parametrize("use_bias", [True, False])
def test_transposed_layer_equals_layer(use_bias, key):
    """Values and gradients with respect to weight, bias and input are equal, for one input and for several."""
    layer = eqx.nn.Linear(5, 3, use_bias=use_bias, key=key)

    def cost(layer, x):
        return jnp.sum(jnp.sin(jax.vmap(layer)(x)))

    both = eqx.filter_jit(jax.value_and_grad(lambda both: cost(with_transposed_copy(both[0]), both[1])))
    plain = eqx.filter_jit(jax.value_and_grad(lambda both: cost(*both)))
    x = random.normal(key, (4, 5))
    for result, expected in zip(jax.tree.leaves(both((layer, x))), jax.tree.leaves(plain((layer, x))), strict=True):
        np.testing.assert_allclose(result, expected, rtol=1e-13)


def test_stacked_layers_are_transposed_individually(key):
    """The layers are created and called as in an ensemble."""
    setup = eqx.filter_vmap(lambda key: eqx.nn.MLP(4, 2, 3, 1, key=key))(random.split(key, 5))

    @eqx.filter_jit
    def members(setup, x):
        return eqx.filter_vmap(lambda one, x: one(x), in_axes=(eqx.if_array(0), None))(setup, x)

    x = random.normal(key, (4,))
    np.testing.assert_allclose(members(with_transposed_copy(setup), x), members(setup, x), rtol=1e-14)


def test_nested_layers_are_transposed_and_other_leaves_kept(key):
    """A layer of scalars has no matrix, and a subclass of a layer may compute something different."""

    class DoubleLinear(eqx.nn.Linear):
        def __call__(self, x, *, key=None):
            return 2.0 * super().__call__(x)

    scalar = eqx.nn.Linear("scalar", 3, key=key)
    tree = {"deep": [eqx.nn.Linear(2, 2, key=key), jnp.ones(3)], "scalar": scalar, "word": "w"}
    assert type(with_transposed_copy(DoubleLinear(2, 2, key=key))) is DoubleLinear
    copies = with_transposed_copy(tree)
    assert isinstance(copies["deep"][0], TransposedLinear)
    assert copies["deep"][1] is tree["deep"][1]
    assert (copies["scalar"], copies["word"]) == (scalar, "w")


def test_products_in_scan_read_matrices_along_rows(key):
    """This holds forward and backward, for the policy and for networks in the model."""
    residual = EnsembleResidual.of(jnp.zeros(3), small().omega_max, key=key, members=2, hidden=(8, 8))
    env = hover_env(Hybrid(PointMass(0.02), residual, backprop=True), horizon=8, history=2)
    policy = Policy.of(23, small(), key=key, hidden=(8, 8))
    program = jax.make_jaxpr(lambda policy, x0: policy_gradient(policy, env, x0))(policy, draw_starts(env.task, key, 3))
    products = [
        (eqn.params["dimension_numbers"], [each.aval.shape for each in eqn.invars])
        for scan in find("scan", program.jaxpr)
        for eqn in find("dot_general", scan.params["jaxpr"].jaxpr)
    ]
    of_layers = [axes for (axes, _), shapes in products if len(shapes[1]) == 2 and set(shapes[1]) <= {23, 8, 4, 19, 3}]
    assert len(of_layers) >= 2 * 3 + 2 * 2 * 3  # each layer, forward and backward
    assert set(of_layers) == {((1,), (0,))}


def find(name, jaxpr):
    """Return the equations of a name, in a program and in its subprograms."""
    for eqn in jaxpr.eqns:
        if eqn.primitive.name == name:
            yield eqn
        for inner in jax.tree.leaves(list(eqn.params.values())):  # programs have no leaves of their own
            if isinstance(inner, (Jaxpr, ClosedJaxpr)):
                yield from find(name, getattr(inner, "jaxpr", inner))
