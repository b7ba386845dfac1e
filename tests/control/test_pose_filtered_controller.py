"""Controllers that need the state, flown from keypoints: they hover, reject a step, and use the keypoints only."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import GOAL, first_order, random_state, replace_fields
from retrim import ConfigError, Setup
from retrim.config.baselines import baseline_request
from retrim.config.methods import MethodRequest
from retrim.control.baselines import BASELINES
from retrim.control.pose_filtered import PoseFilteredController
from retrim.physics import Command, PointMass, State, so3
from retrim.physics.actuators import LaggedModel
from retrim.physics.state import STANDARD_GRAVITY

DT, TAU = 0.02, jnp.array(0.033)
HERE = State(jnp.array(GOAL), jnp.eye(3), jnp.zeros(3))
ELSEWHERE = State(jnp.array([2.0, -1.0, 3.0]), so3.exp(jnp.array([0.3, -0.2, 0.5])), jnp.ones(3))


@pytest.fixture(scope="module")
def setup():
    with jax.numpy_dtype_promotion("standard"):
        return Setup.from_preset("vision/retrim")


def make(setup, name, **changes):
    """Return the baseline as result tables fly it from keypoints."""
    controller = MethodRequest(setup, None).by_state(BASELINES[name].controller(baseline_request(setup)))
    assert isinstance(controller, PoseFilteredController)
    return replace_fields(controller, observation=replace_fields(controller.observation, **changes))


@pytest.mark.parametrize("name", ["geometric-i", "indi"])
def test_hovers_and_rejects_step_from_keypoints(setup, name):
    controller, model = make(setup, name), LaggedModel(PointMass(DT), first_order(TAU))
    x0 = State(jnp.array([0.3, -0.2, 1.2]), jnp.eye(3), jnp.zeros(3))

    def tick(carry, k):
        s, last, memory, waiting = carry
        x = model.state(s)
        now = controller.with_inertial(waiting.omega, (x.v - last.v) / DT)
        u, memory = now(memory, DT * k.astype(float), x)
        push = jnp.where(k >= 300, jnp.array([1.0, -0.5, 0.5]), 0.0)
        return (model.step(s, waiting, push), x, memory, u), x

    start = (model.init(x0), x0, controller.init(x0), Command.hover(x0.p.dtype))
    path = jax.jit(lambda: lax.scan(tick, start, jnp.arange(600))[1])()
    off = np.linalg.norm(np.asarray(path.p) - np.array(GOAL), axis=1)
    assert off[200:300].mean() < 0.02  # before the step
    assert 0.01 < off[300:400].max() < 0.3  # the step has an effect
    assert off[-100:].mean() < 0.02  # the step is rejected


def test_commands_depend_on_keypoints_only(setup):
    """Without visible points, commands follow from the filter and the clock for any position of the vehicle."""
    blind, seeing = (make(setup, "geometric-i", dropout=jnp.array(error)) for error in (1.0, 0.0))
    memory = blind.init(HERE)
    call = eqx.filter_jit(lambda controller, x: controller(memory, jnp.array(0.0), x)[0].vector())
    np.testing.assert_array_equal(call(blind, HERE), call(blind, ELSEWHERE))
    assert np.any(np.asarray(call(seeing, HERE)) != np.asarray(call(seeing, ELSEWHERE)))


def test_inertial_unit_does_not_reveal_attitude(setup, key):
    """The same reading in the body frame gives the same command for any attitude of the vehicle."""
    blind = make(setup, "indi", dropout=jnp.array(1.0))
    memory, specific_force = blind.init(HERE), random.normal(key, (3,)) + jnp.array([0.0, 0.0, STANDARD_GRAVITY])
    gravity = jnp.array([0.0, 0.0, -STANDARD_GRAVITY])
    call = eqx.filter_jit(lambda omega, a, x: blind.with_inertial(omega, a)(memory, jnp.array(0.0), x)[0].vector())
    omega = jnp.array([0.3, -0.1, 0.2])
    states = [random_state(k, 0.5) for k in random.split(key, 2)]
    one, other = (call(omega, so3.act(x.R, specific_force) + gravity, x) for x in states)
    np.testing.assert_allclose(one, other, rtol=1e-9)
    assert np.any(np.abs(np.asarray(call(2.0 * omega, gravity, HERE)) - np.asarray(one)) > 1e-3)


def test_inner_controller_receives_accepted_commands_and_ages(setup):
    controller = make(setup, "geometric-i")
    _, memory = eqx.filter_jit(controller)(controller.init(HERE), jnp.array(0.0), HERE)
    u = Command(jnp.array(7.0), jnp.array([1.0, -2.0, 0.5]))
    accepted_command = controller.accept(memory, u)
    assert eqx.tree_equal(accepted_command.last, u)
    assert eqx.tree_equal(accepted_command.inner, controller.inner.accept(memory.inner, u))
    assert not eqx.tree_equal(accepted_command.inner, memory.inner)
    assert float(controller.with_age(0.015).inner.prediction.age) == pytest.approx(0.015)


def test_controller_without_filter_is_refused():
    with jax.numpy_dtype_promotion("standard"):
        setup = Setup.from_preset("vision/ideal")
    with pytest.raises(
        ConfigError, match="'GeometricController' needs the state, and preset 'vision/ideal' observes keypoints"
    ):
        MethodRequest(setup, None).by_state(BASELINES["geometric"].controller(baseline_request(setup)))
