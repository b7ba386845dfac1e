"""The hover observation is independent of the heading, in the world and in a different frame."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import random_command, random_state
from retrim.config import Setup, changed, load
from retrim.errors import ConfigError
from retrim.physics import State, so3
from retrim.physics.effective_gravity import EffectiveGravityFrame
from retrim.tasks import StateObs
from retrim.tasks.heading_obs import HeadingObs


def observe(observation, x, u):
    return observation(observation.init(x), jnp.array(0.0), x, u)[0]


def rotate_state(x, angle, origin):
    """Return the state rotated about the vertical through ``origin``."""
    turn = so3.rotz(jnp.array(angle))
    return State(origin + turn @ (x.p - origin), turn @ x.R, turn @ x.v)


@pytest.fixture
def observation():
    origin = jnp.array([0.3, -0.2, 1.0])
    return HeadingObs(StateObs(origin, jnp.full(3, 6.0), 2), origin)


@pytest.mark.parametrize("angle", [0.3, 2.0, math.pi, -2.5])
def test_observation_is_invariant_to_rotation_about_goal(observation, angle, key):
    a, b = random.split(key)
    x, u = random_state(a), random_command(b)
    same = rotate_state(x, angle, observation.origin)
    np.testing.assert_allclose(observe(observation, same, u), observe(observation, x, u), atol=1e-12)


def test_heading_along_x_gives_world_observation(observation, key):
    x = State(jnp.array([1.0, 2.0, 3.0]), so3.exp(jnp.array([0.4, -0.3, 0.0])), jnp.array([0.1, 0.2, 0.3]))
    u = random_command(key)
    np.testing.assert_allclose(observe(observation, x, u), observe(observation.inner, x, u), atol=1e-12)


def test_lengths_heights_and_tilt_are_invariant(observation, key):
    a, b = random.split(key)
    x, u = random_state(a), random_command(b)
    view, world = observe(observation, x, u), observe(observation.inner, x, u)
    for part in (slice(0, 3), slice(12, 15)):
        assert jnp.linalg.norm(view[part]) == pytest.approx(float(jnp.linalg.norm(world[part])), rel=1e-12)
    for row in (2, 14, *range(9, 12)):  # height, vertical velocity, and the vertical in body axes
        assert view[row] == pytest.approx(float(world[row]), rel=1e-12)


def test_invariance_holds_in_other_frame(observation, key):
    """In that frame the vertical is the thrust that balances a disturbance."""
    frame = EffectiveGravityFrame.of(jnp.array([1.0, -2.0, 0.5]))
    other, a, b = observation.in_frame(frame), *random.split(key)
    x, u = random_state(a), random_command(b)
    same = rotate_state(x, 1.2, frame.vector(observation.origin))
    np.testing.assert_allclose(observe(other, same, u), observe(other, x, u), atol=1e-12)


def test_gradients_are_finite_upside_down(observation, key):
    x = State(observation.origin, so3.rotx(jnp.array(math.pi)), jnp.zeros(3))
    u = random_command(key)
    gradient = jax.grad(lambda v: jnp.sum(observe(observation, State(x.p, x.R, v), u)))(x.v)
    assert np.isfinite(gradient).all()
    gradient = jax.grad(lambda R: jnp.sum(observe(observation, State(x.p, R, x.v), u)))(x.R)
    assert np.isfinite(gradient).all()


def test_commands_of_policy_are_independent_of_heading(key):
    setup = Setup.from_preset(changed(load("hover/any"), pretrain={"hidden_sizes": (8,)}))
    policy = setup.new_policy(key)
    x, last = random_state(key), random_command(key)
    task = setup.env.task

    def command(x):
        return policy(observe(task.observation, x, last)).vector()

    np.testing.assert_allclose(command(rotate_state(x, 1.0, task.home())), command(x), atol=1e-9)


def test_only_hover_is_independent_of_heading():
    with pytest.raises(ConfigError, match="axes = 'heading' is for task = 'hover', not for 'track'"):
        changed(load("track/paper"), axes="heading")
