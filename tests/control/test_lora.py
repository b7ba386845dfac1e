"""Low-rank adaptation: a fresh delta is zero, the base is constant, gradients are exact, and sizes are as published."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import random

from helpers import draw_starts, hover_env, random_starts, tiny_preset
from retrim.adapt.buffer import RollingBuffer
from retrim.adapt.gate import judge
from retrim.adapt.starts import sample_starts
from retrim.config import Setup
from retrim.control import LoraPolicy, Policy
from retrim.control.lora import LowRankFactors
from retrim.learn import PolicyState, bptt, policy_gradient, policy_loss
from retrim.physics import Command, State, small

RANKS = (3, 4, 1)


def size(tree):
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


@eqx.filter_jit
def perturb_delta(lora, key):
    """Return the policy with a non-zero delta."""
    leaves, shape = jax.tree.flatten(lora.delta)
    keys = random.split(key, len(leaves))
    return lora.with_params(
        shape.unflatten([l + 0.2 * random.normal(k, l.shape) for k, l in zip(keys, leaves, strict=True)])
    )


def assert_identical(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


@eqx.filter_jit
def random_policy(key):
    """Return a policy whose command is not hover."""
    fresh = Policy.of(15, small(), key=key, hidden=(8, 8))
    noise = [
        0.3 * random.normal(k, layer.weight.shape) for k, layer in zip(random.split(key, 3), fresh.layers, strict=True)
    ]
    return eqx.tree_at(lambda p: [l.weight for l in p.layers], fresh, noise)


@pytest.fixture
def base(key):
    return random_policy(key)


@pytest.fixture
def lora(base, key):
    return LoraPolicy.of(base, key=key, ranks=RANKS)


def test_parameter_count_of_the_paper(key):
    lora = LoraPolicy.of(Policy.of(15, small(), key=key), key=key)
    assert [thin.down.shape[0] for thin in lora.params] == [4, 10, 1]
    assert size(lora.params) == 12_864
    assert size(lora.base.layers) == 272_900


def test_fresh_delta_is_zero(base, lora, key):
    assert_identical(lora.merged(), base)
    for k in random.split(key, 3):
        o = random.normal(k, (15,))
        np.testing.assert_array_equal(lora.merged()(o).vector(), base(o).vector())
    for thin in lora.delta:
        np.testing.assert_array_equal(thin.up, 0.0)
        bound = thin.down.shape[1] ** -0.5
        assert 0.5 * bound < float(jnp.abs(thin.down).max()) <= bound


def test_merge_equals_numpy_formula(base, lora, key):
    """The weights are W + scale up down with the same bias, and the commands are y = W x + scale B (A x) + b."""
    trained_policy = perturb_delta(lora, key)
    plain = trained_policy.merged()
    for layer, frozen, thin in zip(plain.layers, base.layers, trained_policy.delta, strict=True):
        merge_result = np.asarray(frozen.weight) + 4.0 * np.asarray(thin.up) @ np.asarray(thin.down)
        np.testing.assert_allclose(layer.weight, merge_result, rtol=1e-12, atol=1e-13)
        np.testing.assert_array_equal(layer.bias, frozen.bias)
        rank = np.linalg.matrix_rank(np.asarray(layer.weight - frozen.weight), tol=1e-9)
        assert rank == thin.down.shape[0]
    h = o = np.asarray(random.normal(key, (15,)))
    for i, (frozen, thin) in enumerate(zip(base.layers, trained_policy.delta, strict=True)):
        h = frozen.weight @ h + 4.0 * thin.up @ (thin.down @ h) + frozen.bias
        h = np.maximum(h, 0.0) if i < 2 else h
    np.testing.assert_allclose(plain(jnp.asarray(o)).vector(), base.limit(jnp.asarray(h)).vector(), rtol=1e-10)
    assert float(jnp.abs(plain(jnp.asarray(o)).vector() - base(jnp.asarray(o)).vector()).max()) > 1e-3


def test_merge_is_idempotent_and_fresh_delta_restores_base(base, lora, key):
    """A merged policy stays the same, and with a fresh delta the policy equals the base."""
    trained_policy = perturb_delta(lora, key)
    assert_identical(trained_policy.merged().merged(), trained_policy.merged())
    assert_identical(trained_policy.with_params(lora.delta).merged(), base)


def test_scale_multiplies_delta(base, key):
    one, two = (perturb_delta(LoraPolicy.of(base, key=key, ranks=RANKS, scale=s), key).merged() for s in (1.0, 2.0))
    for frozen, a, b in zip(base.layers, one.layers, two.layers, strict=True):
        np.testing.assert_allclose(b.weight - frozen.weight, 2.0 * (a.weight - frozen.weight), atol=1e-13)


@pytest.mark.parametrize("contact", [False, True])
def test_gradient_of_delta_is_exact(contact, lora, key):
    """The path of bptt, by perturbations and then through the merge, equals autodiff of the loss in the delta."""
    env = hover_env(horizon=5, delay_ticks=1)
    lora = perturb_delta(lora, key) if contact else lora
    x0 = draw_starts(env.task, key, 3)

    @eqx.filter_jit
    def gradients(lora):
        layers, pull = jax.vjp(lambda delta: lora.with_params(delta).merged().layers, lora.params)
        value, by_layers = policy_gradient(lora.merged().with_params(layers), env, x0)
        loss = lambda delta: policy_loss(lora.with_params(delta).merged(), env, x0)  # noqa: E731
        return (value, pull(by_layers)[0]), jax.value_and_grad(loss)(lora.delta)

    (value, result), (expected, target) = gradients(lora)
    assert float(value) == pytest.approx(float(expected), rel=1e-13)
    for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(target), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12 * max(1.0, float(jnp.abs(b).max())))
    assert max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(result)) > 1e-4
    if not contact:  # B is zero: A has no gradient yet, but B has
        for thin in result:
            np.testing.assert_array_equal(thin.down, 0.0)


def test_base_has_no_gradient(lora, key):
    lora = perturb_delta(lora, key)
    o = random.normal(key, (15,))
    slope = jax.jit(jax.grad(lambda p: jnp.sum(p.merged()(o).vector())))(lora)
    for leaf in jax.tree.leaves((slope.base, slope.scale)):
        np.testing.assert_array_equal(leaf, 0.0)
    assert all(float(jnp.abs(thin.up).max()) > 0.0 for thin in slope.delta)


@pytest.mark.usefixtures("optax_promotion")
def test_training_changes_only_delta_and_lowers_loss(key):
    env = hover_env(horizon=40, heading=0.3)
    base = Policy.of(15, small(), key=key, hidden=(32, 32))
    lora = LoraPolicy.of(base, key=key)
    before = jax.tree.map(np.array, base)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(3e-2))
    train = eqx.filter_jit(lambda s, x0: bptt(s, env, x0, optimiser=optimiser))
    state, losses = train(PolicyState(lora, optimiser.init(lora.params)), random_starts(env.task, key, 40, 8))
    assert losses.shape == (40,)
    trained_policy = state.policy
    assert_identical(trained_policy.base, before)
    assert_identical(trained_policy.scale, lora.scale)
    for thin, fresh in zip(trained_policy.delta, lora.delta, strict=True):
        assert float(jnp.abs(thin.up - fresh.up).max()) > 1e-3
        assert float(jnp.abs(thin.down - fresh.down).max()) > 1e-4
    x0 = draw_starts(env.task, random.key(9), 32)
    loss = eqx.filter_jit(lambda policy: policy_loss(policy, env, x0))
    assert float(loss(trained_policy.merged())) < 0.9 * float(loss(base))


@pytest.mark.usefixtures("optax_promotion")
def test_learner_accepts_low_rank_policy(key, monkeypatch):
    """An update returns a low-rank policy with the same base, and the gate receives merged policies."""
    preset = tiny_preset(pretrain={"horizon": 20, "hidden_sizes": (12, 12)})
    judgements = []

    def recording_judge(candidate, incumbent, *rest, **options):
        judgements.extend([candidate, incumbent])
        return judge(candidate, incumbent, *rest, **options)

    monkeypatch.setattr("retrim.adapt.learner.judge", recording_judge)
    setup = Setup.from_preset(preset)
    base = setup.new_policy(random.key(0))
    state = setup.learner.init(setup.low_rank(base, random.key(1)), random.key(2))
    buffer = RollingBuffer(preset.adapt.window)
    for i in range(20):
        buffer.push(0.02 * i, State.at(jnp.array([0.3, 0.0, 1.0])), Command.hover())
    k = random.key(3)
    after, verdict = setup.learner.update_policy(state.policy, state.residual, buffer.window(), k)
    assert isinstance(after.policy, LoraPolicy)
    assert_identical(after.policy.base, base)
    assert any(float(jnp.abs(thin.up).max()) > 0.0 for thin in after.policy.delta)
    assert [type(p) for p in judgements] == [Policy, Policy]
    assert bool(verdict.finite)
    assert bool(verdict.admitted) == (float(verdict.candidate) <= float(verdict.incumbent))
    # the merged weights show a broken delta
    x0 = draw_starts(setup.env.task, key, 2)
    bad = eqx.tree_at(lambda p: p.delta[0].up, after.policy, jnp.full_like(after.policy.delta[0].up, jnp.nan))
    result = judge(bad.merged(), base, setup.env, x0)
    assert result.reason() == "a weight is not finite"


def test_starts_are_drawn_from_valid_rows(key):
    """Each start is a state of the window with its own time; rows without data are not drawn."""
    buffer = RollingBuffer(5)
    for i in range(3):
        buffer.push(0.02 * (i + 1), State.at(jnp.array([float(i + 1), 0.0, 1.0])), Command.hover())
    result = eqx.filter_jit(sample_starts)(buffer.window(), key, (60,))
    np.testing.assert_allclose(result.t, 0.02 * result.x.p[:, 0])
    assert set(np.asarray(result.x.p[:, 0]).tolist()) == {1.0, 2.0, 3.0}
    assert result.x.R.shape == (60, 3, 3)


# ---- refusals


@pytest.mark.parametrize(
    ("ranks", "message"),
    [
        ((3, 4), r"2 ranks \(3, 4\) for 3 layers"),
        ((3, 4, 1, 1), "4 ranks .* for 3 layers"),
        ((0, 4, 1), "rank 0 for weights 8 x 15"),
        ((3, -1, 1), "rank -1 for weights 8 x 8"),
        ((3, 4, 5), "rank 5 for weights 4 x 8"),
        ((9, 4, 1), "rank 9 for weights 8 x 15"),
    ],
)
def test_invalid_ranks_are_refused(ranks, message, base, key):
    with pytest.raises(ValueError, match=message):
        LoraPolicy.of(base, key=key, ranks=ranks)


def test_largest_ranks_are_accepted(base, key):
    full = LoraPolicy.of(base, key=key, ranks=(8, 8, 4))
    assert size(full.delta) == 8 * 23 + 8 * 16 + 4 * 12


def test_delta_of_other_shape_is_refused(base, lora, key):
    with pytest.raises(ValueError, match="2 deltas for 3 layers"):
        LoraPolicy(base, lora.delta[:2], lora.scale, lora.shift)
    wider = LoraPolicy.of(Policy.of(15, small(), key=key, hidden=(9, 8)), key=key, ranks=RANKS)
    with pytest.raises(ValueError, match=r"layer 0 has weights \(8, 15\), the delta \(9, 3\) x \(3, 15\)"):
        LoraPolicy(base, wider.delta, lora.scale, lora.shift)
    with pytest.raises(ValueError, match="layer 0"):
        lora.with_params(wider.delta)
    with pytest.raises(TypeError, match="rank"):  # by the shape check, which the tests enable
        LowRankFactors(jnp.zeros((2, 8)), jnp.zeros((4, 1)))
