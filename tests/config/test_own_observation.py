"""A user's observation has the same features as a built-in one, through its members only."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from fake_flights import flight
from helpers import brief_preset
from retrim.adapt.views import GravityView, RestView
from retrim.config import Setup, TaskRequest, changed
from retrim.config.baselines import baseline_request
from retrim.config.learners import check_frame
from retrim.config.methods import MethodRequest
from retrim.control.baselines import BASELINES
from retrim.control.controller import PolicyController
from retrim.control.pose_filtered import PoseFilteredController
from retrim.control.pose_frame import PoseFrame
from retrim.errors import ConfigError
from retrim.evaluation.figures import picture
from retrim.learn.encoder import pretrain_encoder
from retrim.physics import State
from retrim.tasks import AbstractObservation, StateEstimate, StateObs
from retrim.tasks.heading_obs import HeadingObs

DT = 0.02


class Sonar(AbstractObservation[StateEstimate]):
    """Distances to three walls. The memory is an estimate with an error of a centimetre and a known push."""

    state: StateObs

    @property
    def size(self):
        return 3

    def init(self, x):
        return StateEstimate(x, jnp.zeros(3))

    def __call__(self, memory, t, x, last):
        near = State(x.p + 0.01, x.R, x.v)
        return x.p - self.state.origin, StateEstimate(near, jnp.array([1.0, 0.0, 0.0]))

    def in_frame(self, frame):
        return self

    @property
    def measures_state(self):
        return False

    @property
    def has_frame_in_memory(self):
        return True

    def state_examples(self, motions):
        def draw(key):
            x, _ = motions.draw(key, self.state.origin)
            return x.p - self.state.origin, jnp.concatenate([x.p, x.R.reshape(9), x.v])

        return draw

    def image(self, x):
        return x.p[None, :2] / 10.0, jnp.array([True])


class Estimating(Sonar):
    """The same observation with an estimator."""

    @property
    def state_estimator(self):
        return lambda memory: memory


def blind(request: TaskRequest):
    return dataclasses.replace(request.hover(), observation=Sonar(request.state_observation()))


def estimating(request: TaskRequest):
    return dataclasses.replace(request.hover(), observation=Estimating(request.state_observation()))


def linear(request):
    return eqx.nn.Linear(request.size, 4, key=request.key)


def make(kind, **changes):
    return Setup.from_preset(changed(brief_preset(), name="sonar", task=f"{__name__}:{kind}", **changes))


@pytest.fixture(scope="module")
def sonar_setup():
    return make("estimating")


def test_controller_receives_estimated_state(sonar_setup, key):
    controller = MethodRequest(sonar_setup, None).by_state(
        BASELINES["geometric"].controller(baseline_request(sonar_setup))
    )
    assert isinstance(controller, PoseFilteredController)
    x = State(sonar_setup.flight_task.home() + 0.2, jnp.eye(3), jnp.zeros(3))
    by_estimate, _ = controller(controller.init(x), jnp.array(0.0), x)
    near = State(x.p + 0.01, x.R, x.v)
    plain = controller.inner
    by_state, _ = plain(plain.init(x), jnp.array(0.0), near)
    np.testing.assert_allclose(by_estimate.vector(), by_state.vector(), rtol=1e-6)


def test_settings_and_methods_follow_from_observation(sonar_setup, key):
    baseline = BASELINES["geometric"]
    assert baseline.settings_for(sonar_setup.flight_task) is baseline.settings_from_keypoints
    policy = sonar_setup.new_policy(key)
    with pytest.raises(ConfigError, match="base-i"):
        sonar_setup.pilot(policy, "base-i")
    with pytest.raises(ConfigError, match="raptor"):
        sonar_setup.pilot(policy, "raptor")
    without = make("blind")
    with pytest.raises(ConfigError, match="method 'indi' needs the state"):
        without.pilot(None, "indi", key)
    with pytest.raises(ConfigError, match="effective gravity needs"):
        check_frame(without.preset, without.flight_task)


def test_frame_follows_estimated_disturbance(sonar_setup, key):
    """A push of 1 m/s^2 along x in the memory turns the command; without a push the command is unchanged."""
    controller = sonar_setup.pilot(sonar_setup.new_policy(key), "base-do").controller
    assert isinstance(controller, PoseFrame)
    x = State.at(sonar_setup.flight_task.home())
    memory = controller.init(x)
    plain, _ = controller.inner(memory, jnp.array(0.0), x)
    first, memory = controller(memory, jnp.array(0.0), x)
    second, _ = controller(memory, jnp.array(DT), x)
    np.testing.assert_allclose(first.vector(), plain.vector(), rtol=1e-5, atol=1e-6)
    assert float(second.c) > float(first.c)  # effective gravity is stronger than gravity


def test_controller_refuses_observation_without_estimator(sonar_setup, key):
    with pytest.raises(ValueError, match="must have a state_estimator, got Sonar"):
        PoseFilteredController(
            BASELINES["geometric"].controller(baseline_request(sonar_setup)),
            Sonar(sonar_setup.env.task.observation.state),
        )
    blind = PolicyController(Sonar(sonar_setup.env.task.observation.state), sonar_setup.new_policy(key))
    with pytest.raises(ValueError, match="must have a state_estimator, got Sonar"):
        PoseFrame(blind, jnp.array(6.0))


def test_learner_keeps_frame_that_memory_needs(sonar_setup):
    assert isinstance(make("estimating", adapt={"frame": "gravity"}).learner.view, RestView)
    assert isinstance(Setup.from_preset(changed(brief_preset(), adapt={"frame": "gravity"})).learner.view, GravityView)


@pytest.mark.usefixtures("optax_promotion")
def test_encoder_is_trained_with_examples_of_observation(sonar_setup, key):
    observation, policy = sonar_setup.env.task.observation, sonar_setup.new_policy(key)
    _, errors = pretrain_encoder(policy, observation, key, steps=60, batch=16)
    assert float(errors[-10:].mean()) < float(errors[:5].mean())
    vision = Setup.from_preset(changed(brief_preset("vision/retrim"), pretrain={"network": f"{__name__}:linear"}))
    assert vision.preset.vision.encoder_steps > 0
    for task in (sonar_setup.env.task, vision.env.task):
        with pytest.raises(ConfigError, match=r"encoder_steps needs a perceptron"):
            dataclasses.replace(vision, env=dataclasses.replace(vision.env, task=task)).pretraining()
    task = Setup.from_preset(brief_preset()).env.task
    # a state needs no encoder
    dataclasses.replace(vision, env=dataclasses.replace(vision.env, task=task)).pretraining()


def test_image_of_observation_is_drawn(sonar_setup, tmp_path):
    display = flight(0.1)
    text = picture([display], sonar_setup, display.spec.scenario, tmp_path)[1].read_text()
    assert "points in the image" in text


def test_wrapped_observation_measures_no_more(sonar_setup):
    inner = sonar_setup.env.task.observation
    around = HeadingObs(inner, jnp.zeros(3))
    assert (around.size, around.measures_state, around.has_frame_in_memory) == (3, False, True)
    assert around.state_estimator is None  # its estimate would be that of the rotated state
