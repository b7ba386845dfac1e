"""An old measurement is predicted to the present."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import random_command, random_state
from retrim.estimation.latency import ahead
from retrim.physics import Command, PointMass


@pytest.mark.parametrize("age", [0.0, 0.005, 0.02])
def test_prediction_is_step_of_model(age, key):
    """The prediction is exact without rotation, and otherwise of third order in the age."""
    kx, ku = random.split(key)
    x, u, d = random_state(kx), random_command(ku), jnp.array([1.0, -2.0, 0.5])
    after = jax.jit(lambda u: ahead(x, u, d, jnp.array(age)))
    if age == 0.0:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), after(u), x)
        return
    tick = jax.jit(lambda u: PointMass(age).step(x, u, d))
    straight = Command(u.c, jnp.zeros(3))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), after(straight), tick(straight))
    result, expected = after(u), tick(u)
    np.testing.assert_allclose(result.R, expected.R, atol=1e-12)
    rate = float(jnp.linalg.norm(u.omega))
    np.testing.assert_allclose(result.v, expected.v, atol=0.5 * age**2 * rate * float(u.c) + 1e-12)
    np.testing.assert_allclose(result.p, expected.p, atol=age**3 * rate * float(u.c) + 1e-12)
