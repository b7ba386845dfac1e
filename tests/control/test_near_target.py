"""NearTarget leaves a controller unchanged near the target, and limits the error that it sees from far away."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import hover_task, random_state
from retrim.config.families import policy_controller
from retrim.config.loading import changed, load
from retrim.config.setup import Setup
from retrim.control import Policy, PolicyController
from retrim.control.near_target import LARGEST_REACH, WEAK_REACH, NearTarget, safe_reach
from retrim.physics import State, small
from retrim.physics.effective_gravity import EffectiveGravityFrame
from retrim.physics.state import STANDARD_GRAVITY

REACH = 0.3


@pytest.fixture(scope="module")
def controller():
    task = hover_task()
    policy = Policy.of(task.observation.size, small(), key=random.key(1), hidden=(16, 16))
    inner = PolicyController(task.observation, jax.tree.map(lambda leaf: 3.0 * leaf, policy))
    return NearTarget(inner, task, jnp.array(REACH))


@eqx.filter_jit
def command(controller, x):
    return controller(controller.init(x), jnp.zeros(()), x)[0].vector()


@pytest.mark.parametrize("distance", [0.0, 0.1, 0.29, 0.31, 2.0, 50.0])
def test_controller_sees_limited_error(controller, distance):
    x = random_state(random.key(0))
    direction = x.p / jnp.linalg.norm(x.p)
    far, display = (
        State(controller.task.home() + each * direction, x.R, x.v) for each in (distance, min(distance, REACH))
    )
    np.testing.assert_allclose(command(controller, far), command(controller.inner, display), rtol=1e-5, atol=1e-5)


def test_infinite_limit_has_no_effect(controller):
    wide = NearTarget(controller.inner, controller.task, jnp.array(jnp.inf))
    x = random_state(random.key(2))
    np.testing.assert_array_equal(command(wide, x), command(controller.inner, x))


def test_near_target_is_equivariant(controller):
    frame, x = EffectiveGravityFrame.of(jnp.array([1.0, -2.0, 0.5])), random_state(random.key(3))
    in_frame, observation = controller.in_frame(frame), frame.state(x)
    home = in_frame.task.home()
    near = home + REACH * (observation.p - home) / jnp.linalg.norm(observation.p - home)
    np.testing.assert_allclose(
        command(in_frame, observation),
        command(controller.inner.in_frame(frame), State(near, observation.R, observation.v)),
        rtol=1e-5,
        atol=1e-5,
    )


def test_reach_grows_with_thrust():
    """The reach grows with the thrust, from a positive value to a constant for strong vehicles."""
    weight = small().mass * STANDARD_GRAVITY
    ratios = [1.1, 1.3, 1.8, 2.5, 3.2, 5.0, 10.0]
    reaches = [float(safe_reach(dataclasses.replace(small(), thrust_max=ratio * weight))) for ratio in ratios]
    assert 0.0 < reaches[0] < reaches[1] < reaches[2] < reaches[3] < reaches[4] == reaches[5] == reaches[6]
    np.testing.assert_allclose([reaches[2], reaches[-1]], [WEAK_REACH, LARGEST_REACH], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "is_limited"),
    [
        ("hover/retrim", True),
        ("hover/any", True),
        ("track/retrim", True),
        ("hover/paper", False),
        ("vision/retrim", False),
    ],
)
def test_limit_applies_to_measured_distance_outside_loop_of_paper(name, is_limited):
    setup = Setup.from_preset(changed(load(name), pretrain={"hidden_sizes": (8, 8)}))
    controller = policy_controller(setup.preset, setup.flight_task, setup.new_policy(random.key(0)))
    assert isinstance(controller, NearTarget) == is_limited
