"""Methods by name: the presets that they support and the ones that they refuse."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from jax import random

from helpers import brief_preset
from retrim import AdaptivePilot, ConfigError, Setup, State, changed, load
from retrim.config.methods import METHODS, MethodRequest, find_method
from retrim.control.pose_filtered import PoseFilteredController
from retrim.plants.plant import Measurement
from retrim_paper.raptor.passive import HoverController


@pytest.fixture(scope="module")
def keypoint_setups():
    """Return setups whose policies observe keypoints, with and without a pose filter."""
    return {name: Setup.from_preset(brief_preset(f"vision/{name}")) for name in ("retrim", "ideal")}


@pytest.mark.parametrize(
    ("name", "method", "message"),
    [
        (
            "retrim",
            "base-i",
            "method 'base-i' shifts the measured position; a policy that observes keypoints receives none",
        ),
        ("ideal", "base-i", "method 'base-i' shifts the measured position"),
        (
            "retrim",
            "raptor",
            "method 'raptor' needs the measured state; a policy that observes keypoints receives none",
        ),
        (
            "ideal",
            "indi",
            r"method 'indi' needs the state, and preset 'vision/ideal' observes keypoints.*occlusion = true",
        ),
        ("retrim", "datt", "method 'datt' has its own network: `retrim reproduce hover --methods datt` trains"),
    ],
)
def test_methods_that_need_more_than_keypoints_are_refused(keypoint_setups, name, method, message, key):
    setup = keypoint_setups[name]
    with pytest.raises(ConfigError, match=message) as error:
        setup.pilot(setup.new_policy(key), method, key)
    assert "\n" not in str(error.value)


def test_controller_receives_pose_of_filter(keypoint_setups, key):
    setup = keypoint_setups["retrim"]
    pilot = setup.pilot(setup.new_policy(key), "indi", key)
    assert type(pilot.controller) is PoseFilteredController
    pilot.reset(Measurement(0.0, setup.flight_starts(1)[0]))
    plain = Setup.from_preset(brief_preset()).pilot(None, "indi", key)
    assert type(plain.controller) is not PoseFilteredController
    own = HoverController()
    assert MethodRequest(Setup.from_preset(brief_preset()), None).by_state(own) is own
    with pytest.raises(ConfigError, match="method 'HoverController' needs the state"):
        MethodRequest(keypoint_setups["ideal"], None).by_state(own)


@pytest.mark.parametrize("method", ["full", "lora"])
def test_learning_method_needs_key(method):
    setup = Setup.from_preset(brief_preset(pretrain={"hidden_sizes": (16, 16)}))
    with pytest.raises(ValueError, match="a method that learns needs a key"):
        setup.pilot(setup.new_policy(random.key(0)), method)


def test_labels_are_unique_and_only_raptor_is_on_board():
    names = [*METHODS, "datt", "raptor"]  # the last two are entry points of a different package
    labels = [find_method(name).label for name in names]
    assert len(set(labels)) == len(labels)
    assert [name for name in names if find_method(name).on_board is not None] == ["raptor"]
    with pytest.raises(ConfigError, match=r"method 'math:pi' is a float, not a retrim\.config\.MethodEntry"):
        find_method("math:pi")


def test_low_rank_delta_is_drawn_once(key):
    setup = Setup.from_preset("hover/retrim")
    policy = setup.new_policy(key)
    one, same, other = (setup.low_rank(policy, random.key(seed)).delta[0].down for seed in (1, 1, 2))
    assert jnp.array_equal(one, same)
    assert not jnp.array_equal(one, other)
    has_one = setup.low_rank(policy, key)
    assert setup.low_rank(has_one, random.key(3)) is has_one
    assert setup.pilot(policy).dt == setup.preset.dt


@pytest.mark.parametrize("method", ["base", "base-do", "base-swing", "base-id", "full", "lora"])
@pytest.mark.parametrize("name", ["hover/any", "track/any"])
def test_methods_of_universal_policy_return_commands(name, method):
    """Methods are traced, not compiled; each wraps the policy in different controllers."""
    setup = Setup.from_preset(changed(load(name), pretrain={"hidden_sizes": (16, 16)}))
    pilot = setup.pilot(setup.new_policy(random.key(0)), method, random.key(1))
    learning = isinstance(pilot, AdaptivePilot)
    controller = pilot.controller_of(pilot.state) if learning else pilot.controller
    x = State.at(setup.flight_task.home())
    memory = eqx.filter_eval_shape(controller.init, x)
    u, after = eqx.filter_eval_shape(controller, memory, jnp.zeros_like(x.p[0]), x)
    assert (u.c.shape, u.omega.shape) == ((), (3,))
    assert jax.tree.structure(memory) == jax.tree.structure(after)
