"""A policy that is shifted at each tick commands hover at its rest point, in every frame and for every belief."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import GOAL, random_state
from retrim.control import Policy
from retrim.control.controller import PolicyController
from retrim.control.resting import RestingController
from retrim.physics import Command, State, small, so3
from retrim.physics.effective_gravity import EffectiveGravityFrame
from retrim.physics.path_family import PathBelief
from retrim.tasks import StateObs
from retrim.tasks.vehicle_obs import VehicleObs


@pytest.fixture(scope="module")
def controller():
    observation = VehicleObs.of(
        StateObs(jnp.array(GOAL), small().omega_max, 2), small().omega_max, PathBelief.unknown()
    )
    policy = Policy.of(observation.size, small(), key=random.key(0), hidden=(16, 16))
    layers = jax.tree.map(lambda leaf: leaf + 0.3 * jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), policy.layers)
    return RestingController(observation, policy.with_params(layers), jnp.array(GOAL))


@eqx.filter_jit
def command(controller, x):
    return controller(controller.init(x), jnp.zeros(()), x)[0].vector()


@pytest.mark.parametrize("heading", [0.0, 1.0, -3.0])
@pytest.mark.parametrize("model", [0.0, 0.4, 1.0])
def test_commands_hover_at_rest(controller, heading, model):
    belief = PathBelief.between(-model * jnp.ones(4), model * jnp.ones(4))
    message = eqx.tree_at(lambda c: c.observation.belief, controller, belief)
    x = State(jnp.array(GOAL), so3.rotz(jnp.array(heading)), jnp.zeros(3))
    np.testing.assert_allclose(command(message, x), Command.hover().vector(), atol=1e-6)
    plain = PolicyController(message.observation, message.policy)
    assert np.abs(command(plain, x) - Command.hover().vector()).max() > 0.01  # otherwise the test is vacuous


def test_resting_policy_is_equivariant(controller):
    frame = EffectiveGravityFrame.of(jnp.array([1.0, -2.0, 0.5]))
    in_frame, x = controller.in_frame(frame), random_state(random.key(1))
    home = frame.state(State.at(jnp.array(GOAL)))
    heading = jnp.arctan2(home.R[1, 0], home.R[0, 0])
    rest = State(home.p, so3.rotz(heading), jnp.zeros(3))
    np.testing.assert_allclose(command(in_frame, rest), Command.hover().vector(), atol=1e-6)
    assert np.all(np.isfinite(command(in_frame, frame.state(x))))
