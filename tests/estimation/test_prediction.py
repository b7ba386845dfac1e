"""What is predicted of the moment when a command begins to act is what the nominal model does until then."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import first_order, random_command, random_state
from retrim.estimation.prediction import Prediction
from retrim.physics import Command, PointMass
from retrim.physics.actuators import Lagged

DT, TAU = 0.02, 0.033


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_it_is_what_the_lagged_model_does(delay, key):
    """Commands under way act first, each for a tick; then the new one begins."""
    model, d = Lagged(PointMass(DT), first_order(TAU)), jnp.array([0.5, -1.0, 0.3])
    k_x, *keys = random.split(key, 9)
    s = model.init(random_state(k_x))
    prediction = Prediction(jnp.array(TAU), DT, delay)
    memory = prediction.init(model.state(s))
    queue = [Command.hover(s.inner.p.dtype)] * delay
    for k in keys:
        soon, acting = prediction(memory, model.state(s), d)
        after = s
        for u in queue:
            after = model.step(after, u, d)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), soon, model.state(after))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), acting, after.actuators.command)
        u = random_command(k)
        memory = prediction.issued(memory, u)
        queue.append(u)
        s = model.step(s, queue.pop(0), d)


def test_what_the_plant_accepted_is_what_counts(key):
    x, (k_a, k_b) = random_state(key), random.split(key)
    prediction = Prediction(jnp.array(TAU), DT, 1)
    issued, accepted = random_command(k_a), random_command(k_b)
    told = prediction.accepted(prediction.issued(prediction.init(x), issued), accepted)
    known = prediction.issued(prediction.init(x), accepted)
    for a, b in zip(prediction(told, x, jnp.zeros(3)), prediction(known, x, jnp.zeros(3)), strict=True):
        jax.tree.map(np.testing.assert_array_equal, a, b)


def test_an_old_measurement_is_brought_to_now(key):
    """A vehicle in a steady turn, seen 20 ms late, is where it is."""
    x, u = random_state(key), random_command(key)
    prediction = Prediction(jnp.array(1e-6), DT, 0)
    memory = prediction.issued(prediction.init(x), u)
    now = PointMass(DT).step(x, u, jnp.zeros(3))
    late, _ = prediction.with_age(DT)(memory, x, jnp.zeros(3))
    np.testing.assert_allclose(late.R, now.R, atol=1e-9)
    np.testing.assert_allclose(late.p, now.p, atol=5e-3)  # its acceleration is taken as constant
