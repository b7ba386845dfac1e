"""The command path in training: one program serves every delay and response, and whole ticks equal the former model."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import random

from helpers import check_slope, first_order, hover_env, hover_task, random_command, stack_trees
from retrim.control import Policy
from retrim.learn import Env, PolicyState, rollout
from retrim.learn.bptt import bptt
from retrim.learn.pretrain import random_starts
from retrim.physics import ActuatorResponse, Command, CommandPath, Hybrid, LaggedModel, PointMass, small
from retrim.physics.actuators import with_response

pytestmark = pytest.mark.usefixtures("optax_promotion")
DT = 0.02
STILL = jnp.zeros(3)
PATHS = [
    CommandPath.of(delay, ActuatorResponse.of(thrust, rate, inverse_damping=kappa))
    for delay, thrust, rate, kappa in ((0.0, 0.0, 0.0, 0.0), (0.02, 0.033, 0.033, 0.0), (0.0474, 0.05, 0.15, 2.0))
]


def policy_of(key):
    policy = Policy.of(15, small(), key=key, hidden=(8,))
    return eqx.tree_at(lambda p: p.layers[-1].weight, policy, 0.3 * random.normal(key, policy.layers[-1].weight.shape))


def fly_once(env, key):
    return eqx.filter_jit(rollout)(env, policy_of(key), env.task.reset(key))


@pytest.mark.parametrize("ticks", [0, 1, 2, 7])
def test_whole_ticks_equal_former_roll_out(ticks, key):
    """In the former model, commands wait in a list and the lag is of first order."""
    env = hover_env(LaggedModel(PointMass(DT), first_order(0.033)), delay_ticks=ticks, horizon=15)
    policy, start = policy_of(key), env.task.reset(key)
    result = fly_once(env, key)
    x, acting, queue = start.x, Command.hover(float), [Command.hover(float)] * ticks
    step, decay = eqx.filter_jit(PointMass(DT).step), np.exp(-DT / 0.033)
    left = 0.033 / DT * (1.0 - decay)
    last, memory = policy.u_hover, env.task.observation.init(x)
    for k in range(15):
        o, memory = env.task.observation(memory, start.t + k * DT, x, last)
        last = policy(o)
        queue.append(last)
        u = queue.pop(0)
        np.testing.assert_allclose(result.u.omega[k], u.omega, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(result.x.p[k], x.p, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(result.x.R[k], x.R, rtol=1e-12, atol=1e-13)
        mean, acting = (
            jax.tree.map(lambda old, new, share=share: new + share * (old - new), acting, u) for share in (left, decay)
        )
        x = step(x, mean, STILL)


def test_fractional_delay_is_mean_of_two_commands(key):
    """With zero delay, commands act when they are issued; the vehicle is frozen, so that both roll-outs have the same
    states.
    """
    policy, task = policy_of(key), hover_task(horizon=12)
    env = Env(LaggedModel(PointMass(DT), first_order(1e6)), task)  # with frozen actuators, commands have no effect
    start = task.reset(key)
    commands, late = (
        eqx.filter_jit(rollout)(env.with_path(CommandPath.of(d, first_order(1e6))), policy, start).u
        for d in (0.0, 0.026)
    )
    c = np.concatenate([np.full(2, 9.81), commands.c])
    np.testing.assert_allclose(late.c, (0.7 * c[1:] + 0.3 * c[:-1])[:12], rtol=1e-9)


def test_one_program_trains_for_every_path(key):
    """A different delay, lag or damping is a different value, as is a task with a queue of the same length."""
    optimiser, traces = optax.adam(1e-3), []
    env = hover_env(LaggedModel(PointMass(DT), first_order(0.03)), horizon=6)

    @eqx.filter_jit
    def train(state, env, starts):
        traces.append(env)
        return bptt(state, env, starts, optimiser=optimiser)

    policy, starts = policy_of(key), random_starts(env.task, key, 2, 3)
    state = PolicyState(policy, optimiser.init(policy.params))
    losses = [np.asarray(train(state, env.with_path(path), starts)[1]) for path in PATHS]
    assert len(traces) == 1
    assert np.all(np.isfinite(losses))
    assert len({float(loss[0]) for loss in losses}) == 3


def test_batch_of_vehicles_equals_members(key):
    env = hover_env(LaggedModel(PointMass(DT), first_order(0.03)), horizon=12)
    policy, start = policy_of(key), env.task.reset(key)
    fly = eqx.filter_jit(lambda paths: jax.vmap(lambda path: rollout(env.with_path(path), policy, start))(paths))
    together = fly(stack_trees(PATHS))
    for i, path in enumerate(PATHS):
        alone = fly_once(env.with_path(path), key)
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-11, atol=1e-12)


def test_path_gradient_equals_finite_differences(key):
    """The gradient is that of the reward of a roll-out with respect to the vehicle."""
    env = hover_env(LaggedModel(PointMass(DT), first_order(0.03)), horizon=10)
    policy, start = policy_of(key), env.task.reset(key)
    cost = jax.jit(lambda path: jnp.sum(rollout(env.with_path(path), policy, start).reward))
    check_slope(cost, PATHS[2], key, h=1e-6, rel=1e-4)


@pytest.mark.parametrize("wrap", [lambda model: model, lambda model: Hybrid(model, lambda x, u: STILL)])
def test_wrappers_forward_path_to_model(wrap, key):
    slow, u = first_order(0.2), random_command(key)
    expected = wrap(LaggedModel(PointMass(DT), slow))
    for model in (wrap(PointMass(DT)), wrap(LaggedModel(PointMass(DT), first_order(0.01)))):
        result = with_response(model, slow)
        x = hover_task().reset(key).x
        a, b = (eqx.filter_jit(each.step)(each.init(x), u, STILL) for each in (result, expected))
        assert result.settling_ticks == expected.settling_ticks
        np.testing.assert_array_equal(result.state(a).vector(), expected.state(b).vector())
