"""The trim: a re-trained policy comes to rest at the goal under any constant push and with any heading."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import GOAL, hover_env
from retrim.adapt.trim import NoTrim, RestTrim
from retrim.adapt.views import GravityView, WorldView
from retrim.config import Setup, changed, load
from retrim.control import LoraPolicy, Policy
from retrim.errors import ConfigError
from retrim.learn import Window, rollout
from retrim.physics import Command, State, small, so3
from retrim.tasks import Start

TRIM, HOME = eqx.filter_jit(RestTrim()), jnp.array(GOAL)
roll = eqx.filter_jit(rollout)
low_rank = eqx.filter_jit(LoraPolicy.of)


def always(d, x, u):
    """Return ``d``. ``eqx.Partial`` makes ``d`` a value, so that a different ``d`` needs no new compilation."""
    return d


@eqx.filter_jit
def random_policy(key, size):
    """Return a policy whose command is not hover."""
    fresh = Policy.of(size, small(), key=key, hidden=(8, 8))
    weights = [0.3 * random.normal(k, l.weight.shape) for k, l in zip(random.split(key, 3), fresh.layers, strict=True)]
    return eqx.tree_at(lambda p: [l.weight for l in p.layers], fresh, weights)


def window_of(R):
    """Return a window of two ticks, the last with the attitude ``R``."""
    zero = np.zeros((2, 3))
    return Window.of(0.02 * np.arange(2.0), zero, np.stack([np.eye(3), R]), zero, np.full(2, 9.81), zero)


@pytest.mark.parametrize("lora", [False, True])
@pytest.mark.parametrize("d", [(0.0, 0.0, 0.0), (1.0, -0.5, 2.0)])
def test_trimmed_policy_rests_at_goal_under_push(key, d, lora):
    """The goal, at rest and with the heading of the flight, is a fixed point of the corrected model."""
    d = jnp.array(d)
    env = GravityView(jnp.array(6.0))(hover_env(horizon=20, history=2), eqx.Partial(always, d))
    policy = random_policy(key, env.task.observation.size)
    if lora:
        policy = low_rank(policy, key=key, ranks=(1, 1, 1))
    frame = env.frame(State.at(HOME), Command.hover())
    R = so3.mul(frame.Q.T, so3.rotz(jnp.array(0.7)))  # the vehicle tilts against the push
    start = Start(jnp.array(0.0), State(HOME, R, jnp.zeros(3)))
    before, after = (roll(env, each.merged(), start) for each in (policy, TRIM(policy, env, window_of(R))))
    np.testing.assert_allclose(after.x.p, np.broadcast_to(HOME, (20, 3)), atol=1e-9)
    np.testing.assert_allclose(after.u.c, frame.world_command(Command.hover()).c, rtol=1e-9)
    assert np.abs(np.asarray(before.x.p) - np.array(GOAL)).max() > 0.01


def test_trim_shifts_only_output(key):
    env = WorldView()(hover_env(horizon=20, history=2), eqx.Partial(always, jnp.zeros(3)))
    policy = random_policy(key, env.task.observation.size)
    trim_result = TRIM(policy, env, window_of(jnp.eye(3)))
    observe = random.normal(key, (2, env.task.observation.size))
    trimmed_policy = eqx.filter_jit(
        lambda trim_result, policy: jax.vmap(lambda o: trim_result.output(o) - policy.output(o))(observe)
    )
    np.testing.assert_allclose(*trimmed_policy(trim_result, policy), atol=1e-12)
    jax.tree.map(np.testing.assert_array_equal, trim_result.layers[:-1], policy.layers[:-1])
    assert NoTrim()(policy, env, window_of(jnp.eye(3))) is policy


def test_trim_heading_is_independent_of_tilt(key):
    env = WorldView()(hover_env(horizon=20, history=2), eqx.Partial(always, jnp.zeros(3)))
    policy = random_policy(key, env.task.observation.size)
    lean = so3.rotz(jnp.array(-1.1)) @ so3.roty(jnp.array(0.3))
    o = env.task.observation.at_rest(State(HOME, so3.rotz(jnp.array(-1.1)), jnp.zeros(3)))
    np.testing.assert_allclose(TRIM(policy, env, window_of(lean))(o).vector(), Command.hover().vector(), atol=1e-12)


def test_camera_at_rest_has_no_noise(key):
    observation = Setup.from_preset("vision/retrim").env.task.observation

    @eqx.filter_jit
    def observe(observation, x):
        noisy, _ = observation(observation.init(x), jnp.array(0.0), x, Command.hover())
        return observation.at_rest(x), noisy

    first, noisy = observe(observation, State.at(HOME))
    second, _ = observe(observation, State.at(HOME))
    np.testing.assert_array_equal(first, second)
    assert np.abs(np.asarray(first) - np.asarray(noisy)).max() > 1e-3


def test_trim_without_rest_point_is_refused():
    with pytest.raises(ConfigError, match=r"adapt.trim = 'rest' is for a task that rests"):
        Setup.from_preset(changed(load("track/retrim"), adapt={"trim": "rest"}))
    with pytest.raises(ConfigError, match=r"adapt.trim = 'rest' needs adapt.frame = 'gravity'"):
        changed(load("hover/retrim"), adapt={"frame": "world"})
