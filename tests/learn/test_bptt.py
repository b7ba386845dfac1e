"""Roll-outs and their gradients: against finite differences, and perturbations against plain autodiff."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import random

from helpers import GOAL, draw_starts, hover_env, hover_task, random_starts, replaced
from retrim import learn
from retrim.control import Policy
from retrim.learn import Env, PolicyState, pretrain
from retrim.learn.residuals import EnsembleResidual
from retrim.physics import Command, Hybrid, LinearDragQuadrotor, PointMass, State, StraightThrough, small
from retrim.tasks import Start

# As programs: eagerly, each call compiles its scan again.
bptt, policy_gradient, policy_loss, rollout = map(
    eqx.filter_jit, (learn.bptt, learn.policy_gradient, learn.policy_loss, learn.rollout)
)


def awake(key, size, hidden=(8, 8)):
    """A policy with weights large enough to matter."""
    policy = Policy.of(size, small(), key=key, hidden=hidden)
    layers = tuple(
        eqx.tree_at(lambda l: l.weight, l, 0.4 * random.normal(k, l.weight.shape))
        for l, k in zip(policy.layers, random.split(key, len(policy.layers)), strict=True)
    )
    return eqx.tree_at(lambda p: p.layers, policy, layers)


def residual(key):
    ensemble = EnsembleResidual.of(jnp.array(GOAL), small().omega_max, key=key, hidden=(8, 8))
    return jax.tree.map(lambda leaf: leaf + 0.05, ensemble)


def models(key):
    simple, r = PointMass(0.02), residual(key)
    return {
        "simple": simple,
        "hybrid": Hybrid(simple, r),
        "through residual": Hybrid(simple, r, backprop=True),
        "straight through": StraightThrough(Hybrid(LinearDragQuadrotor.of(small(), 0.02), r), simple),
    }


@pytest.mark.parametrize(
    ("which", "delay"), [("simple", 0), ("hybrid", 2), ("through residual", 0), ("straight through", 2)]
)
def test_perturbations_equal_plain_gradient(which, delay, key):
    env = hover_env(models(key)[which], horizon=6, history=2, delay_ticks=delay)
    policy = awake(key, env.task.observation.size)
    x0 = draw_starts(env.task, key, 3)
    value, gradient = policy_gradient(policy, env, x0)

    def plain(layers):
        return policy_loss(eqx.tree_at(lambda p: p.layers, policy, layers), env, x0)

    expected_value, expected = jax.jit(jax.value_and_grad(plain))(policy.layers)
    assert value == pytest.approx(float(expected_value), rel=1e-14)
    for found, wanted in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        scale = max(float(jnp.abs(wanted).max()), 1e-12)
        np.testing.assert_allclose(found, wanted, atol=1e-13 * scale)
    assert max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(gradient)) > 1e-4


def test_gradient_against_finite_differences(key):
    """Residual off, horizon 3: along random directions in weight space."""
    env, policy = hover_env(horizon=3), awake(key, 15)
    x0 = draw_starts(env.task, key, 2)
    _, gradient = policy_gradient(policy, env, x0)
    loss = jax.jit(lambda layers: policy_loss(eqx.tree_at(lambda p: p.layers, policy, layers), env, x0))
    for k in random.split(key, 4):
        leaves, shape = jax.tree.flatten(policy.layers)
        way = shape.unflatten(
            [random.normal(kk, leaf.shape) for leaf, kk in zip(leaves, random.split(k, len(leaves)), strict=True)]
        )
        step = 1e-5
        ahead, behind = (jax.tree.map(lambda a, d, s=s: a + s * d, policy.layers, way) for s in (step, -step))
        difference = (loss(ahead) - loss(behind)) / (2 * step)
        slope = sum(jnp.sum(g * d) for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(way), strict=True))
        assert float(slope) == pytest.approx(float(difference), rel=1e-6)


def test_delay_holds_commands_back(key):
    """The first ``delay`` ticks hover; then each command acts that many ticks after it was issued."""
    policy = awake(key, 15)
    for delay in (1, 3):
        env = hover_env(horizon=8, delay_ticks=delay)
        task = env.task
        flown = rollout(env, policy, task.reset(key))
        np.testing.assert_allclose(flown.u.c[:delay], 9.81)
        seen = jax.tree.map(lambda leaf: leaf[0], flown.x)
        o, _ = task.observation(task.observation.init(seen), jnp.array(0.0), seen, policy.u_hover)
        np.testing.assert_allclose(flown.u.c[delay], policy(o).c, rtol=1e-12)


@pytest.mark.parametrize("delay", [0, 2])
def test_a_jump_costs_its_square_when_it_is_issued(key, delay):
    env = hover_env(horizon=8, history=2, delay_ticks=delay)
    policy = awake(key, env.task.observation.size)
    start = env.task.reset(key)
    free, charged = (rollout(each, policy, start) for each in (env, replaced(env, jump_cost=jnp.array(0.3))))
    jax.tree.map(np.testing.assert_array_equal, (free.x, free.u), (charged.x, charged.u))
    issued = jax.vmap(Command.vector)(free.u)[delay:]  # it acts so much later
    jumps = jnp.diff(jnp.concatenate([policy.u_hover.vector()[None], issued]), axis=0)
    cost = (free.reward - charged.reward)[: len(issued)]
    np.testing.assert_allclose(cost, 0.3 * jnp.sum(jumps**2, axis=1), rtol=1e-9)
    assert float(jnp.max(cost)) > 1e-3


def test_a_cost_of_jumps_is_in_the_gradient(key):
    env = replaced(hover_env(horizon=6, history=2), jump_cost=jnp.array(0.3))
    policy = awake(key, env.task.observation.size)
    x0 = draw_starts(env.task, key, 3)
    plain = jax.grad(lambda layers: policy_loss(eqx.tree_at(lambda p: p.layers, policy, layers), env, x0))(
        policy.layers
    )
    found = policy_gradient(policy, env, x0)[1]
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12 * max(float(jnp.abs(b).max()), 1e-12))


def test_a_residual_reaches_the_rollout(key):
    policy, x0 = Policy.of(15, small(), key=key), Start(jnp.array(0.0), State.at(jnp.array(GOAL)))
    env = hover_env(horizon=2)
    pushed = rollout(env.with_residual(lambda x, u: jnp.array([2.0, 0.0, 0.0])), policy, x0)
    assert rollout(env, policy, x0).x.v[1, 0] == pytest.approx(0.0, abs=1e-2)
    assert pushed.x.v[1, 0] == pytest.approx(0.04, rel=1e-2)


def test_the_terminated_are_frozen_charged_and_give_finite_gradients(key):
    """Pushed out of a small box: terminated goes true for good, the state stays, the worst reward is charged."""
    env = hover_env(horizon=40, box=1.05)
    policy = awake(key, 15)
    x0 = Start(jnp.array(0.0), State(jnp.array([1.0, 0.0, 1.0]), jnp.eye(3), jnp.array([1.0, 0.0, 0.0])))
    flown = rollout(env, policy, x0)
    end = int(jnp.argmax(flown.terminated))
    assert 1 <= end < 10
    assert flown.terminated[end:].all()
    np.testing.assert_array_equal(flown.x.p[end:], jnp.broadcast_to(flown.x.p[end], flown.x.p[end:].shape))
    np.testing.assert_allclose(flown.reward[end:], flown.reward[:end].min())
    batch = jax.tree.map(lambda leaf: leaf[None], x0)
    _, gradient = policy_gradient(policy, env, batch)
    assert float(flown.reward[0]) < 0.0  # a start outside the box is charged too, from its first tick
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.usefixtures("optax_promotion")
def test_a_gradient_that_is_not_finite_changes_nothing(key):
    env = hover_env(horizon=3)
    policy, optimiser = awake(key, 15), optax.adam(1e-2)
    state = PolicyState(policy, optimiser.init(policy.layers))
    x0 = random_starts(env.task, key, 1, 2)
    broken = eqx.tree_at(lambda s: s.x.v, x0, x0.x.v.at[0, 0, 0].set(jnp.nan))
    after, losses = bptt(state, env, broken, optimiser=optimiser)
    assert not np.isfinite(losses).all()
    jax.tree.map(np.testing.assert_array_equal, after, state)


@pytest.mark.usefixtures("optax_promotion")
def test_training_lowers_the_loss_and_leaves_limits_alone(key):
    env = hover_env(horizon=75, heading=0.3)
    policy = Policy.of(15, small(), key=key, hidden=(64, 64))
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(5e-3))
    run = pretrain(policy, env, key, optimiser=optimiser, num_updates=40, num_envs=8, chunk=20)
    history = list(run)
    assert jnp.concatenate([losses for _, losses in history]).shape == (40,)
    trained = history[-1][0].policy
    x0 = draw_starts(env.task, random.key(9), 32)
    before, after = (float(policy_loss(p, env, x0)) for p in (policy, trained))
    assert after < 0.5 * before
    jax.tree.map(np.testing.assert_array_equal, (trained.u_min, trained.u_max), (policy.u_min, policy.u_max))


def test_chunks_do_not_change_the_program(key):
    with pytest.raises(ValueError, match="num_updates = 25 must be a positive multiple of 10"):
        next(
            pretrain(
                Policy.of(15, small(), key=key),
                hover_env(),
                key,
                optimiser=optax.adam(1e-3),
                num_updates=25,
                num_envs=2,
            )
        )


def test_an_environment_has_one_tick_and_no_negative_delay():
    """A model and a task at different rates would disagree on what a tick is."""
    with pytest.raises(ValueError, match=r"the model ticks every 0\.01 s, the task every 0\.02 s"):
        Env(PointMass(0.01), hover_task(dt=0.02))
    with pytest.raises(ValueError, match=r"delay_ticks = -1 must not be negative"):
        hover_env(delay_ticks=-1)
    assert Env(PointMass(0.01), hover_task(dt=0.01)).delay_ticks == 0
