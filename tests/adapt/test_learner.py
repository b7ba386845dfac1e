"""The online learner: sizes, optimiser schedule, starts of the gate, and fits that must be discarded."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import random

from helpers import random_starts, replace_fields, tiny_preset
from retrim.adapt import OnlineLearner, RollingBuffer, Verdict
from retrim.adapt import learner as module
from retrim.adapt.optimisers import CarriedAdam, FreshAdam
from retrim.config import Setup
from retrim.learn import PolicyState, bptt
from retrim.learn.residuals import FittedResidual
from retrim.physics import Command, PointMass, State

pytestmark = pytest.mark.usefixtures("optax_promotion")


@pytest.fixture(scope="module")
def setup():
    """Return a setup whose learning rate for low-rank deltas differs from that for all weights."""
    return Setup.from_preset(tiny_preset(adapt={"low_rank_learning_rate": 0.04}))


@pytest.fixture(scope="module")
def fresh(setup):
    """Return the learner state before the first fit."""
    return setup.learner.init(setup.new_policy(random.key(0)), random.key(0))


@pytest.fixture(scope="module")
def window(setup):
    """Return ticks of a point mass under a constant push along x."""
    buffer, x, model = RollingBuffer(40), State.at(jnp.array([0.0, 0.0, 1.2])), PointMass(setup.preset.dt)
    step = jax.jit(model.step)
    for i in range(40):
        buffer.push(0.02 * i, x, Command.hover())
        x = step(x, Command.hover(), jnp.array([0.5, 0.0, 0.0]))
    return buffer.window()


@pytest.mark.parametrize(("field", "value"), [("num_updates", 0), ("num_envs", -1), ("plant_delay_ticks", -1)])
def test_invalid_sizes_are_refused_at_construction(setup, field, value):
    fields = {f.name: getattr(setup.learner, f.name) for f in dataclasses.fields(setup.learner)}
    with pytest.raises(ValueError, match=rf"OnlineLearner\.{field} = {value}"):
        OnlineLearner(**(fields | {field: value}))


def test_residual_fit_without_steps_is_refused(setup):
    with pytest.raises(ValueError, match=r"EnsembleModel\.steps = 0"):
        replace_fields(setup.learner.residual_model, steps=0)


def test_fresh_residual_predicts_zero(setup, fresh):
    learner, state = setup.learner, fresh
    x = State.at(jnp.array([0.3, -0.2, 1.5]))
    np.testing.assert_array_equal(learner.residual_model.predict(state.residual, x, Command.hover()), 0.0)


def test_fit_recovers_push_and_second_fit_continues(setup, fresh, window):
    learner, state = setup.learner, fresh
    errors, residual = [], state.residual
    for _ in range(5):
        residual, report = learner.fit_residual(residual, window)
        assert bool(report.accepted)
        errors.append(float(report.rms_error))
    assert errors[-1] < 0.5 * errors[0]
    result = learner.residual_model.predict(residual, jax.tree.map(lambda leaf: leaf[20], window.x), Command.hover())
    np.testing.assert_allclose(result, [0.5, 0.0, 0.0], atol=0.1)


def test_nonfinite_fit_is_discarded(setup, fresh):
    learner, state = setup.learner, fresh
    buffer = RollingBuffer(40)
    for i in range(10):
        buffer.push(0.02 * i, State.at(jnp.array([0.0, 0.0, 1.0 + float("nan") * (i == 5)])), Command.hover())
    new_state, report = learner.fit_residual(state.residual, buffer.window())
    assert not bool(report.accepted)
    jax.tree.map(np.testing.assert_array_equal, new_state, state.residual)


def test_window_without_complete_row_is_discarded(setup, fresh):
    learner, state = setup.learner, fresh
    buffer = RollingBuffer(40)
    buffer.push(0.0, State.at(jnp.array([0.0, 0.0, 1.0])), Command.hover())
    new_state, report = learner.fit_residual(state.residual, buffer.window())
    assert not bool(report.accepted)
    jax.tree.map(np.testing.assert_array_equal, new_state, state.residual)


def test_learning_rate_follows_cosine():
    """Under constant gradients, each step of Adam has the length of the learning rate along each coordinate."""
    optimiser = FreshAdam(jnp.array(0.01), jnp.array(jnp.inf)).transformation(10)
    params, update = jnp.zeros(3), jax.jit(optimiser.update)
    memory, steps = optimiser.init(params), []
    for _ in range(10):
        change, memory = update(jnp.ones(3), memory, params)
        steps.append(-float(change[0]))
    np.testing.assert_allclose(steps, 0.01 * 0.5 * (1.0 + np.cos(np.pi * np.arange(10) / 10)), rtol=1e-5)
    assert steps[-1] < 0.03 * steps[0]


@pytest.mark.parametrize("kind", [FreshAdam, CarriedAdam])
def test_gradient_is_clipped_by_norm(kind):
    """A huge gradient after small ones moves Adam no farther than a gradient at the limit."""

    def move(huge):
        optimiser = kind(jnp.array(1e-3), jnp.array(0.5)).transformation(3)
        params = jnp.zeros(4)
        memory = optimiser.init(params)
        for gradient in (0.01, 0.01, huge):
            change, memory = optimiser.update(jnp.full(4, gradient), memory, params)
        return change

    move = jax.jit(move)

    np.testing.assert_allclose(move(1e6), move(0.25))  # four entries of 0.25 have the norm 0.5
    assert not np.allclose(move(0.1), move(0.25))


@pytest.mark.usefixtures("optax_promotion")
def test_carried_adam_has_constant_rate_and_continues():
    """Two short updates equal one long update."""
    optimiser, params = CarriedAdam(jnp.array(0.01), jnp.array(jnp.inf)), jnp.ones(3)
    gradients = jnp.sin(jnp.arange(12.0)).reshape(4, 3)

    @jax.jit
    def after(updates):
        x, memory = params, optimiser.transformation(len(updates[0])).init(params)
        for update in updates:
            adam = optimiser.transformation(len(update))
            for gradient in update:
                change, memory = adam.update(gradient, memory, x)
                x = x + change
        return x

    np.testing.assert_array_equal(after([gradients[:2], gradients[2:]]), after([gradients]))
    one = optimiser.transformation(1)
    change, _ = one.update(jnp.array([3.0, -0.2, 0.01]), one.init(params), params)
    np.testing.assert_allclose(change, [-0.001, 0.001, -0.001], rtol=1e-5)  # regardless of the scale of the gradient


@pytest.mark.usefixtures("optax_promotion")
def test_updates_of_carried_adam_have_equal_length(setup):
    """Along the same gradient, the momentum starts from zero in each update, and the scale of the gradient is kept."""
    policy = setup.new_policy(random.key(0))
    optimiser, num = CarriedAdam(jnp.array(0.01), jnp.array(jnp.inf)), 5
    state = PolicyState(policy, optimiser.transformation(num).init(policy.params))
    begin = eqx.filter_jit(lambda state: optimiser.begin(state, num))

    @eqx.filter_jit
    def step(state):
        ones = jax.tree.map(jnp.ones_like, state.policy.params)
        change, memory = optimiser.transformation(num).update(ones, state.optimiser, state.policy.params)
        return PolicyState(state.policy, memory), -change[0].bias[0]

    steps = []
    for _ in range(4):
        state, far = begin(state), []
        for _ in range(num):
            state, shift = step(state)
            far.append(float(shift))
        steps.append(far)
    np.testing.assert_allclose(steps, np.tile(0.01 * (1.0 - 0.9 ** np.arange(1, num + 1)), (4, 1)), rtol=1e-4)


def test_paper_update_is_bptt_from_task_starts(setup, fresh, window):
    """The expected update is written out: starts of the task, a fresh Adam with a cosine schedule, the world frame."""
    learner, state = setup.learner, fresh
    trained_policy, _ = learner.update_policy(state.policy, state.residual, window, random.key(8))

    @eqx.filter_jit
    def expected_update(policy, residual):
        schedule = optax.cosine_decay_schedule(1.0, learner.num_updates)
        adam = optax.chain(
            optax.clip_by_global_norm(setup.preset.adapt.max_grad_norm),
            optax.scale_by_adam(),
            optax.scale_by_schedule(lambda step: -setup.preset.adapt.learning_rate * schedule(step)),
        )
        x0 = random_starts(setup.flight_task, random.split(random.key(8), 3)[0], learner.num_updates, learner.num_envs)
        env = setup.env.with_residual(FittedResidual(learner.residual_model, residual))
        return bptt(PolicyState(policy, adam.init(policy.params)), env, x0, optimiser=adam)[0]

    expected = expected_update(state.policy.policy, state.residual)
    for result, target in zip(trained_policy.policy.layers, expected.policy.layers, strict=True):
        np.testing.assert_allclose(result.weight, target.weight, rtol=1e-9, atol=1e-12)


def test_each_update_starts_with_fresh_optimiser(setup, fresh, window):
    """Moments, counters and the schedule of an earlier update have no effect."""
    learner, state = setup.learner, fresh
    used, _ = learner.update_policy(state.policy, state.residual, window, random.key(1))
    # the optimiser counted its steps
    assert any(int(leaf) == 3 for leaf in jax.tree.leaves(used.optimiser) if leaf.ndim == 0)
    stale = eqx.tree_at(lambda s: s.policy, used, state.policy.policy)
    again, _ = learner.update_policy(stale, state.residual, window, random.key(1))
    jax.tree.map(np.testing.assert_array_equal, again, used)


def test_update_trains_in_corrected_model(setup, fresh, window):
    """With a residual fitted to a push, the update returns a different policy than without it."""
    learner, state = setup.learner, fresh
    fit_result, _ = learner.fit_residual(state.residual, window)
    plain, before = learner.update_policy(state.policy, state.residual, window, random.key(1))
    with_push, after = learner.update_policy(state.policy, fit_result, window, random.key(1))
    assert float(after.incumbent) > float(before.incumbent)  # the push moves the vehicle away from the goal
    assert not np.array_equal(plain.policy.layers[0].weight, with_push.policy.layers[0].weight)


def test_gate_uses_different_starts_than_training(setup, fresh, window, monkeypatch):
    """Four starts are new starts of the task, and four are states of the window's valid ticks."""
    training_starts, gate_starts = [], []

    def training(state, env, x0, *, optimiser):
        training_starts.append(x0)
        return state, jnp.zeros(3)

    def judging(candidate, incumbent, env, x0):
        gate_starts.append(x0)
        return Verdict(jnp.array(True), jnp.array(True), jnp.array(0.0), jnp.array(0.0))

    monkeypatch.setattr(module, "bptt", training)
    monkeypatch.setattr(module, "judge", judging)
    learner, state = setup.learner, fresh

    @eqx.filter_jit
    def starts_of(state, window):
        OnlineLearner.update_policy.__wrapped__(learner, state.policy, state.residual, window, random.key(1))
        return training_starts, gate_starts

    half = eqx.tree_at(lambda w: w.valid, window, jnp.arange(40) >= 30)
    (starts,), (gate,) = jax.tree.map(np.asarray, starts_of(state, half))
    assert starts.x.p.shape == (3, 4, 3)
    assert gate.x.p.shape == (8, 3)
    observation = starts.x.p.reshape(-1, 3)
    for p in gate.x.p[:4]:
        assert np.linalg.norm(observation - p, axis=1).min() > 1e-6
    for t, p in zip(gate.t[4:], gate.x.p[4:], strict=True):
        row = round(float(t) / 0.02)
        assert row >= 30
        np.testing.assert_array_equal(p, np.asarray(window.x.p)[row])


@pytest.fixture(scope="module")
def low_rank(window):
    """Return a low-rank policy, and the state after an update of one step."""
    setup = Setup.from_preset(tiny_preset(adapt={"num_updates": 1, "low_rank_learning_rate": 0.04}))
    policy = setup.low_rank(setup.new_policy(random.key(0)), random.key(0))
    with jax.numpy_dtype_promotion("standard"):
        state = setup.learner.init(policy, random.key(0))
        after, _ = setup.learner.update_policy(state.policy, state.residual, window, random.key(1))
    return policy, after


def test_low_rank_update_leaves_base_unchanged(low_rank):
    policy, after = low_rank
    jax.tree.map(np.testing.assert_array_equal, after.policy.base, policy.base)
    sizes = sum(leaf.size for leaf in jax.tree.leaves(after.optimiser))
    assert sizes < 3 * sum(leaf.size for leaf in jax.tree.leaves(policy.delta)) + 10


def test_low_rank_delta_has_separate_learning_rate(low_rank):
    """The first step of Adam has the length of the learning rate."""
    policy, after = low_rank
    change = jax.tree.map(lambda a, b: np.abs(np.asarray(a) - np.asarray(b)).max(), after.policy.delta, policy.delta)
    assert max(jax.tree.leaves(change)) == pytest.approx(0.04, rel=1e-3)


@pytest.mark.parametrize("name", ["ensemble", "regression", "layered", "linear", "place", "swing"])
def test_fitted_residual_has_types_of_fresh_residual(window, name, key):
    """Weak types are also equal; otherwise a program for the first state is compiled again in flight."""
    learner = Setup.from_preset(tiny_preset(adapt={"residual": name, "fit_steps": 2})).learner
    fresh = jax.eval_shape(learner.residual_model.init, key)
    fit_result, _ = eqx.filter_eval_shape(type(learner).fit_residual, learner, fresh, window)
    types = lambda tree: [(leaf.shape, leaf.dtype, leaf.weak_type) for leaf in jax.tree.leaves(tree)]  # noqa: E731
    assert types(fit_result) == types(fresh)
    assert not any(weak for _, _, weak in types(fresh))
