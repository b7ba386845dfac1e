"""Roll-outs and their gradients: against finite differences, and taps against plain autodiff."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import random

from helpers import GOAL, hover_task
from retrim.control import Policy
from retrim.learn import EnsembleResidual, PolicyState, bptt, policy_gradient, policy_loss, pretrain, rollout
from retrim.learn.pretrain import starts
from retrim.physics import Hybrid, LinearDragQuadrotor, PointMass, State, StraightThrough, small
from retrim.tasks import Start


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


@pytest.mark.parametrize("which", ["simple", "hybrid", "through residual", "straight through"])
@pytest.mark.parametrize("delay", [0, 2])
def test_taps_equal_plain_gradient(which, delay, key):
    task = hover_task(horizon=6, history=2)
    policy, model = awake(key, task.observation.size), models(key)[which]
    x0 = jax.vmap(task.reset)(random.split(key, 3))
    value, gradient = policy_gradient(policy, model, task, x0, delay=delay)

    def merged(layers):
        return policy_loss(eqx.tree_at(lambda p: p.layers, policy, layers), model, task, x0, delay=delay)

    expected_value, expected = jax.value_and_grad(plain)(policy.layers)
    assert value == pytest.approx(float(expected_value), rel=1e-14)
    for found, wanted in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        scale = max(float(jnp.abs(wanted).max()), 1e-12)
        np.testing.assert_allclose(found, wanted, atol=1e-13 * scale)
    assert max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(gradient)) > 1e-4


def test_gradient_against_finite_differences(key):
    """Residual off, horizon 3: along random directions in weight space."""
    task = hover_task(horizon=3)
    policy, model = awake(key, 15), PointMass(0.02)
    x0 = jax.vmap(task.reset)(random.split(key, 2))
    _, gradient = policy_gradient(policy, model, task, x0)
    loss = jax.jit(lambda layers: policy_loss(eqx.tree_at(lambda p: p.layers, policy, layers), model, task, x0))
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
    task = hover_task(horizon=8)
    policy, x0 = awake(key, 15), task.reset(key)
    for delay in (1, 3):
        flown = rollout(PointMass(0.02), task, policy, x0, delay=delay)
        np.testing.assert_allclose(flown.u.c[:delay], 9.81)
        seen = jax.tree.map(lambda leaf: leaf[0], flown.x)
        o, _ = task.observation(task.observation.init(seen), jnp.array(0.0), seen, policy.u_hover)
        np.testing.assert_allclose(flown.u.c[delay], policy(o).c, rtol=1e-12)


def test_external_acceleration_reaches_the_rollout(key):
    task = hover_task(horizon=2)
    policy, x0 = Policy.of(15, small(), key=key), Start(jnp.array(0.0), State.at(jnp.array(GOAL)))
    pushed = rollout(PointMass(0.02), task, policy, x0, a_ext=jnp.array([2.0, 0.0, 0.0]))
    assert pushed.x.v[1, 0] == pytest.approx(0.04, rel=1e-2)


def test_the_dead_are_frozen_charged_and_give_finite_gradients(key):
    """Pushed out of a small box: alive goes false for good, the state stays, the worst reward is charged."""
    task = hover_task(horizon=40, box=1.05)
    policy = awake(key, 15)
    x0 = Start(jnp.array(0.0), State(jnp.array([1.0, 0.0, 1.0]), jnp.eye(3), jnp.array([1.0, 0.0, 0.0])))
    flown = rollout(PointMass(0.02), task, policy, x0)
    died = int(jnp.argmin(flown.alive))
    assert 1 <= died < 10
    assert not flown.alive[died:].any()
    np.testing.assert_array_equal(flown.x.p[died:], jnp.broadcast_to(flown.x.p[died], flown.x.p[died:].shape))
    np.testing.assert_allclose(flown.reward[died:], flown.reward[:died].min())
    batch = jax.tree.map(lambda leaf: leaf[None], x0)
    _, gradient = policy_gradient(policy, PointMass(0.02), task, batch)
    assert float(flown.reward[0]) < 0.0  # a start outside the box is charged too, from its first tick
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.usefixtures("optax_promotion")
def test_a_gradient_that_is_not_finite_changes_nothing(key):
    task = hover_task(horizon=3)
    policy, optimiser = awake(key, 15), optax.adam(1e-2)
    state = PolicyState(policy, optimiser.init(policy.layers))
    x0 = starts(task, key, 1, 2)
    broken = eqx.tree_at(lambda s: s.x.v, x0, x0.x.v.at[0, 0, 0].set(jnp.nan))
    after, losses = bptt(state, PointMass(0.02), task, broken, optimiser=optimiser)
    assert not np.isfinite(losses).all()
    jax.tree.map(np.testing.assert_array_equal, after, state)


@pytest.mark.usefixtures("optax_promotion")
def test_training_lowers_the_loss_and_leaves_limits_alone(key):
    task = hover_task(horizon=75, heading=0.3)
    policy = Policy.of(15, small(), key=key, hidden=(64, 64))
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(5e-3))
    run = pretrain(policy, PointMass(0.02), task, key, optimiser=optimiser, epochs=40, envs=8, chunk=20)
    history = list(run)
    assert jnp.concatenate([losses for _, losses in history]).shape == (40,)
    trained = history[-1][0].policy
    x0 = jax.vmap(task.reset)(random.split(random.key(9), 32))
    before, after = (float(policy_loss(p, PointMass(0.02), task, x0)) for p in (policy, trained))
    assert after < 0.5 * before
    jax.tree.map(np.testing.assert_array_equal, (trained.u_min, trained.u_max), (policy.u_min, policy.u_max))


def test_chunks_do_not_change_the_program(key):
    with pytest.raises(ValueError, match="epochs = 25 must be a positive multiple of 10"):
        next(
            iter(
                pretrain(
                    Policy.of(15, small(), key=key),
                    PointMass(0.02),
                    hover_task(),
                    key,
                    optimiser=optax.adam(1e-3),
                    epochs=25,
                    envs=2,
                )
            )
        )
