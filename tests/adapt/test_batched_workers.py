"""Learners of several vehicles in one program, and the base that the vehicles share."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import draw_starts, random_field_flight, tiny_preset
from retrim.adapt.batched_workers import all_refuse, learn_base, learn_together, shared_base
from retrim.adapt.updates import PolicyUpdate, Rejection, Skip
from retrim.adapt.worker import Worker
from retrim.adapt.workers import PolicyWorker, ResidualWorker
from retrim.config.setup import Setup
from retrim.learn.bptt import PolicyState, policy_loss
from retrim.learn.residuals.model import FittedResidual
from retrim.learn.stacking import stack, unstack

pytestmark = pytest.mark.usefixtures("optax_promotion")
PUSH = jnp.array([1.5, -1.0, 0.5])


def push_model(x, u):
    return PUSH


@pytest.fixture(scope="module")
def fleet():
    """Return a learner, workers of two vehicles that adapted to the same push, and the vehicles' windows."""
    with jax.numpy_dtype_promotion("standard"):
        setup = Setup.from_preset(tiny_preset(adapt={"fit_steps": 100}))
        learner, low_rank = setup.learner, setup.low_rank(setup.new_policy(random.key(3)), random.key(0))
        windows = [random_field_flight(push_model, random.key(i), n=setup.preset.adapt.window) for i in (1, 2)]
        workers = []
        for i, window in enumerate(windows):
            state = learner.init(low_rank, random.key(i))
            fit_result, _ = learner.fit_residual(state.residual, window)
            workers.append(PolicyWorker(learner, type(state)(state.policy, fit_result), random.key(i)))
        return learner, workers, windows


def weights(base):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(base.policy.params)])


def test_shared_base_improves_without_delta(fleet):
    """The shared base has a lower loss than the initial base, in the first vehicle's model and without a delta."""
    learner, workers, windows = fleet
    first = base = shared_base(workers[0])
    for i in range(40):
        base = learn_base(workers, windows, base, random.key(i))
    correction = learner.view(learner.env, FittedResidual(learner.residual_model, workers[0].state.residual))
    starts = draw_starts(learner.env.task, random.key(9), 32)
    before, after = (float(policy_loss(each.policy, correction, starts)) for each in (first, base))
    assert after < before - 0.01 * abs(before)


def test_nonfinite_step_leaves_base_unchanged(fleet):
    learner, workers, windows = fleet
    base = shared_base(workers[0])
    state = workers[0].state
    sick = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), state.policy.policy.params)
    policy = PolicyState(state.policy.policy.with_params(sick), state.policy.optimiser)
    bad = PolicyWorker(learner, type(state)(policy, state.residual), random.key(0))
    after = learn_base([bad, workers[1]], windows, base, random.key(0))
    np.testing.assert_array_equal(weights(after), weights(base))


def test_deltas_start_from_shared_base(fleet):
    _, workers, windows = fleet
    base = learn_base(workers, windows, shared_base(workers[0]), random.key(0))
    updates = learn_together([*workers, workers[0]], [*windows, windows[0]], base)
    extract = [update.state.policy.base for update in updates if isinstance(update, PolicyUpdate)]
    for each in extract:
        np.testing.assert_array_equal(each.layers[0].weight, base.policy.layers[0].weight)
    assert extract


def test_batched_fit_equals_single_fits(fleet):
    learner, workers, windows = fleet
    alone = [
        ResidualWorker(learner, worker.state).learn(window) for worker, window in zip(workers, windows, strict=True)
    ]
    together = learn_together([ResidualWorker(learner, worker.state) for worker in workers], windows)
    for one, other in zip(alone, together, strict=True):
        assert one.computed_from == other.computed_from
        for a, b in zip(jax.tree.leaves(one.state), jax.tree.leaves(other.state), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-9)


class DoubleLinear(ResidualWorker):
    """A worker that overrides the computation of its base class."""

    def learn(self, window):
        return Rejection(float(window.t[-1]), "residual", "doubled")


class Renamed(PolicyWorker):
    """A worker with the computation of its base class."""


def test_worker_with_overridden_computation_is_not_batched(fleet):
    learner, workers, windows = fleet
    assert [each.batch is not None for each in (Worker, ResidualWorker, PolicyWorker, DoubleLinear, Renamed)] == [
        False, True, True, False, True
    ]  # fmt: skip
    doubled = [DoubleLinear(learner, worker.state) for worker in workers]
    assert [update.reason for update in learn_together(doubled, windows)] == ["doubled"] * 2
    with pytest.raises(ValueError, match="low-rank"):
        shared_base(doubled[0])


def test_batched_update_equals_single_updates(fleet):
    """Updates and random keys are equal, also for three workers, whose program has four rows.

    The common base is their own, so that the program is also that of a shared base.
    """
    learner, workers, windows = fleet
    make = lambda: [PolicyWorker(learner, workers[i].state, random.key(7 + k)) for k, i in enumerate((0, 1, 0))]  # noqa: E731
    some = [windows[i] for i in (0, 1, 0)]
    alone, together = make(), make()
    updates = learn_together(together, some, shared_base(workers[0]))
    for worker, window, update, other in zip(alone, some, updates, together, strict=True):
        expected = worker.learn(window)
        assert type(update) is type(expected)
        np.testing.assert_array_equal(random.key_data(worker.key), random.key_data(other.key))
        if isinstance(update, PolicyUpdate):
            np.testing.assert_allclose(update.cost, expected.cost, rtol=1e-6)
            for a, b in zip(jax.tree.leaves(update.state), jax.tree.leaves(expected.state), strict=True):
                np.testing.assert_allclose(a, b, atol=1e-8)


def test_unstack_inverts_stack():
    trees = [{"a": jnp.arange(3.0) + i, "key": random.key(i), "name": "same"} for i in range(2)]
    whole = stack(trees)
    assert whole["name"] == "same"
    for i, tree in enumerate(trees):
        part = unstack({"a": whole["a"], "key": whole["key"]}, i)
        np.testing.assert_array_equal(part["a"], tree["a"])
        np.testing.assert_array_equal(random.key_data(part["key"]), random.key_data(tree["key"]))


def test_refused_by_all(fleet):
    better = PolicyUpdate(0.0, 1.0, 2.0, fleet[1][0].state.policy)
    assert all_refuse([Rejection(0.0, "policy", "worse"), Skip(0.0, "policy")])
    assert not all_refuse([Rejection(0.0, "policy", "worse"), better])
