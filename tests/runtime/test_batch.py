"""A flight as one program is the same flight, tick for tick, as that of the plant and its pilot."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import hover_task
from retrim.control import Policy, PolicyController
from retrim.physics import Constant, LinearDragQuadrotor, State, small
from retrim.plants import SensorModel, SimPlant
from retrim.runtime import ControllerPilot, batch_flight, fly


@pytest.fixture(scope="module")
def parts():
    task = hover_task(history=2)
    policy = Policy.of(task.observation.size, small(), key=random.key(3), hidden=(8,))
    policy = jax.tree.map(lambda leaf: leaf + 0.02, policy)
    model, push = LinearDragQuadrotor.of(small(), 0.02), Constant(jnp.array([0.5, 0.0, 0.0]))
    return model, push, PolicyController(task.observation, policy), State.at(jnp.array([0.2, 0.1, 1.3]))


@pytest.mark.parametrize("delay_s", [0.0, 0.02, 0.025])
def test_same_as_flying_the_plant(parts, delay_s):
    model, push, controller, x0 = parts
    log = fly(SimPlant(model, push, delay_s=delay_s), ControllerPilot(controller), x0, ticks=15)
    states, commands = jax.jit(lambda x0: batch_flight(model, push, controller, x0, ticks=15, delay_s=delay_s))(x0)
    np.testing.assert_allclose(states.p, log.p[1:], atol=1e-12)
    np.testing.assert_allclose(states.R, log.R[1:], atol=1e-12)
    np.testing.assert_allclose(jax.vmap(lambda u: u.vector())(commands), log.u[1:], atol=1e-10)


def test_maps_over_starts_and_sees_through_sensors(parts):
    model, push, controller, x0 = parts
    sensors = SensorModel.of(position=0.01, latency=20)
    starts = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), x0)

    def fly_from(x, key):
        return batch_flight(model, push, controller, x, ticks=5, sensors=sensors, key=key)[1]

    commands = jax.jit(jax.vmap(fly_from))(starts, random.split(random.key(1)))
    assert commands.c.shape == (2, 5)
    assert not np.array_equal(commands.c[0], commands.c[1])  # other noise
    with pytest.raises(ValueError, match="need a key"):
        batch_flight(model, push, controller, x0, ticks=5, sensors=sensors)
