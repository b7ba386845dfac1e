"""Roll-outs and their gradients, compared with finite differences and with plain autodiff."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import random
from jax.flatten_util import ravel_pytree

from helpers import GOAL, draw_starts, hover_env, hover_task, random_starts, replace_fields
from retrim import learn
from retrim.control import LoraPolicy, Policy
from retrim.learn import Env, PolicyState, pretrain
from retrim.learn.residuals import EnsembleResidual
from retrim.physics import Hybrid, LinearDragQuadrotor, PointMass, State, StraightThrough, small
from retrim.tasks import Start

# Compiled programs: without jit, each call compiles its scan again.
bptt, policy_gradient, policy_loss, rollout = map(
    eqx.filter_jit, (learn.bptt, learn.policy_gradient, learn.policy_loss, learn.rollout)
)


reset = eqx.filter_jit(lambda task, key: task.reset(key))


@eqx.filter_jit
def fresh(key, size=23, hidden=(8, 8)):
    """Return a policy with a history of two commands by default."""
    return Policy.of(size, small(), key=key, hidden=hidden)


@eqx.filter_jit
def random_policy(key):
    """Return a fresh policy with weights large enough to have an effect."""
    policy = fresh(key)
    layers = tuple(
        eqx.tree_at(lambda l: l.weight, l, 0.4 * random.normal(k, l.weight.shape))
        for l, k in zip(policy.layers, random.split(key, len(policy.layers)), strict=True)
    )
    return eqx.tree_at(lambda p: p.layers, policy, layers)


@eqx.filter_jit
def residual(key):
    ensemble = EnsembleResidual.of(jnp.array(GOAL), small().omega_max, key=key, members=2, hidden=(8, 8))
    return jax.tree.map(lambda leaf: leaf + 0.05, ensemble)


def shared_env(dynamics=None, **options):
    """Return the environment of most tests, in one size, so that they share compiled programs."""
    return hover_env(dynamics, horizon=8, history=2, **options)


def models(key):
    simple, r = PointMass(0.02), residual(key)
    return {
        "simple": simple,
        "hybrid": Hybrid(simple, r),
        "through residual": Hybrid(simple, r, backprop=True),
        "straight through": StraightThrough(Hybrid(LinearDragQuadrotor.of(small(), 0.02), r), simple),
    }


@pytest.mark.parametrize(
    ("which", "delay", "jump_cost"),
    [("simple", 0, None), ("hybrid", 2, None), ("through residual", 0, 0.3), ("straight through", 2, None)],
)
def test_perturbations_equal_plain_gradient(which, delay, jump_cost, key):
    """The gradient includes the cost of jumps, for every model."""
    env = shared_env(models(key)[which], delay_ticks=delay)
    env = env if jump_cost is None else replace_fields(env, jump_cost=jnp.array(jump_cost))
    policy, x0 = random_policy(key), draw_starts(env.task, key, 3)
    value, gradient = policy_gradient(policy, env, x0)

    def plain(layers):
        return policy_loss(eqx.tree_at(lambda p: p.layers, policy, layers), env, x0)

    expected_value, expected = jax.jit(jax.value_and_grad(plain))(policy.layers)
    assert value == pytest.approx(float(expected_value), rel=1e-14)
    for result, target in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(result, target, atol=1e-13 * max(np.abs(target).max(), 1e-12))
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(gradient)) > 1e-4


def test_second_derivative_equals_finite_differences(key):
    """Meta-learning differentiates through the gradient."""
    env, policy = shared_env(), random_policy(key)
    x0 = draw_starts(env.task, key, 2)
    flat, unravel = ravel_pytree(policy.layers)
    way = np.random.default_rng(1).normal(size=flat.size)
    way, step = jnp.asarray(way / np.linalg.norm(way)), 1e-5

    @jax.jit
    def gradient(w):
        value, by_layer = policy_gradient(eqx.tree_at(lambda p: p.layers, policy, unravel(w)), env, x0)
        return value, ravel_pytree(by_layer)[0]

    (_, here), (slope, curvature) = jax.jit(lambda w: jax.jvp(gradient, (w,), (way,)))(flat)
    ahead, behind = (gradient(flat + sign * step * way) for sign in (1.0, -1.0))
    assert float(slope) == pytest.approx(float(here @ way), rel=1e-9)
    np.testing.assert_allclose(curvature, (ahead[1] - behind[1]) / (2.0 * step), rtol=1e-4, atol=1e-7)


def test_gradient_equals_finite_differences(key):
    """Without a residual, along random directions in weight space."""
    env, policy = shared_env(), random_policy(key)
    x0 = draw_starts(env.task, key, 3)
    _, gradient = policy_gradient(policy, env, x0)
    flat, unravel = ravel_pytree(policy.layers)
    losses = jax.jit(jax.vmap(lambda w: policy_loss(eqx.tree_at(lambda p: p.layers, policy, unravel(w)), env, x0)))
    ways, step = np.random.default_rng(0).normal(size=(4, flat.size)), 1e-5
    ahead, behind = (np.asarray(losses(np.asarray(flat) + sign * step * ways)) for sign in (1.0, -1.0))
    slopes = ways @ np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(gradient)])
    np.testing.assert_allclose(slopes, (ahead - behind) / (2 * step), rtol=1e-6)


def test_commands_act_after_delay(key):
    """In the first ``delay`` ticks hover acts; then each command acts that many ticks after it was issued."""
    policy = random_policy(key)

    @eqx.filter_jit
    def first_commands(task, x):
        o, _ = task.observation(task.observation.init(x), jnp.array(0.0), x, policy.u_hover)
        return policy(o).c

    for delay in (1, 3):
        env = shared_env(delay_ticks=delay)
        flight = jax.tree.map(np.asarray, rollout(env, policy, reset(env.task, key)))
        np.testing.assert_allclose(flight.u.c[:delay], 9.81)
        first = first_commands(env.task, jax.tree.map(lambda leaf: leaf[0], flight.x))
        np.testing.assert_allclose(flight.u.c[delay], first, rtol=1e-12)


@pytest.mark.parametrize("delay", [0, 3])
def test_jump_costs_its_square_when_issued(key, delay):
    env, policy = shared_env(delay_ticks=delay), random_policy(key)
    start = reset(env.task, key)
    free, cost_of_charge = (
        rollout(each, policy, start) for each in (env, replace_fields(env, jump_cost=jnp.array(0.3)))
    )
    jax.tree.map(np.testing.assert_array_equal, (free.x, free.u), (cost_of_charge.x, cost_of_charge.u))
    commands = np.column_stack([free.u.c, free.u.omega])[delay:]  # it acts after the delay
    jumps = np.diff(commands, axis=0, prepend=[policy.u_hover.vector()])
    cost = (np.asarray(free.reward) - np.asarray(cost_of_charge.reward))[: len(commands)]
    np.testing.assert_allclose(cost, 0.3 * np.sum(jumps**2, axis=1), rtol=1e-9)
    assert np.max(cost) > 1e-3


def test_roll_out_includes_residual(key):
    policy, x0 = fresh(key), Start(jnp.array(0.0), State.at(jnp.array(GOAL)))
    env = shared_env()
    with_push = rollout(env.with_residual(lambda x, u: jnp.array([2.0, 0.0, 0.0])), policy, x0)
    assert np.asarray(rollout(env, policy, x0).x.v)[1, 0] == pytest.approx(0.0, abs=1e-2)
    assert np.asarray(with_push.x.v)[1, 0] == pytest.approx(0.04, rel=1e-2)


def test_terminated_roll_outs_are_frozen_with_worst_reward_and_finite_gradient(key):
    """A push moves the vehicle out of a small box: it stays terminated, its state is constant, and its reward is the
    worst.
    """
    env, policy = shared_env(box=1.05), random_policy(key)
    x0 = Start(jnp.array(0.0), State(jnp.array([1.0, 0.0, 1.0]), jnp.eye(3), jnp.array([1.0, 0.0, 0.0])))
    flight = jax.tree.map(np.asarray, rollout(env, policy, x0))
    end = int(np.argmax(flight.terminated))
    assert 1 <= end < 6
    assert flight.terminated[end:].all()
    np.testing.assert_array_equal(flight.x.p[end:], np.broadcast_to(flight.x.p[end], flight.x.p[end:].shape))
    np.testing.assert_allclose(flight.reward[end:], flight.reward[:end].min())
    batch = jax.tree.map(lambda leaf: jnp.asarray(np.stack(3 * [leaf])), x0)
    _, gradient = policy_gradient(policy, env, batch)
    assert flight.reward[0] < 0.0  # a start outside the box has the worst reward from its first tick
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.usefixtures("optax_promotion")
@pytest.mark.parametrize("low_rank", [False, True])
def test_nonfinite_gradient_changes_nothing(low_rank, key):
    env, policy, optimiser = shared_env(), random_policy(key), optax.adam(1e-2)
    policy = LoraPolicy.of(policy, key=key, ranks=(3, 4, 1)) if low_rank else policy
    state = PolicyState(policy, jax.jit(optimiser.init)(policy.params))
    x0 = random_starts(env.task, key, 1, 2)
    bad = eqx.tree_at(lambda s: s.x.v, x0, x0.x.v.at[0, 0, 0].set(jnp.nan))
    after, losses = bptt(state, env, bad, optimiser=optimiser)
    assert not np.isfinite(losses).all()
    jax.tree.map(np.testing.assert_array_equal, after, state)


@pytest.mark.usefixtures("optax_promotion")
def test_training_lowers_loss_and_keeps_limits(key):
    env = hover_env(horizon=75, heading=0.3)
    policy = fresh(key, 15, (64, 64))
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(5e-3))
    run = pretrain(policy, env, key, optimiser=optimiser, num_updates=40, num_envs=8, chunk=20)
    history = list(run)
    assert np.concatenate([losses for _, losses in history]).shape == (40,)
    trained_policy = history[-1][0].policy
    x0 = draw_starts(env.task, random.key(9), 32)
    before, after = (float(policy_loss(p, env, x0)) for p in (policy, trained_policy))
    assert after < 0.5 * before
    jax.tree.map(
        np.testing.assert_array_equal, (trained_policy.u_min, trained_policy.u_max), (policy.u_min, policy.u_max)
    )


def test_chunks_do_not_change_training(key):
    with pytest.raises(ValueError, match="num_updates = 25 must be a positive multiple of 10"):
        next(
            pretrain(
                fresh(key, 15),
                hover_env(),
                key,
                optimiser=optax.adam(1e-3),
                num_updates=25,
                num_envs=2,
            )
        )


def test_environment_requires_one_tick_and_sufficient_queue():
    """A model and a task with different ticks are inconsistent."""
    with pytest.raises(ValueError, match=r"the model ticks every 0\.01 s, the task every 0\.02 s"):
        Env(PointMass(0.01), hover_task(dt=0.02))
    with pytest.raises(ValueError, match=r"Env\.delay = -0\.02 s must be 0 to 0\.2 s"):
        hover_env(delay_ticks=-1)
    with pytest.raises(ValueError, match=r"Env\.delay = 0\.24 s must be 0 to 0\.2 s; set longest_delay for more"):
        hover_env(delay_ticks=12)
    assert Env(PointMass(0.01), hover_task(dt=0.01), jnp.array(0.3), longest_delay=0.3).delay == 0.3
    assert Env(PointMass(0.01), hover_task(dt=0.01)).delay == 0.0
