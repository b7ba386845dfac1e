"""Messages of updates: each kind survives a round trip bit for bit, and other data is refused."""

import contextlib
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jax import random

from helpers import tiny_preset
from retrim import MessageError
from retrim.adapt import PolicyUpdate, Rejection, ResidualUpdate, Skip, pack_update, unpack_update
from retrim.adapt.learner_state import LearnerState
from retrim.config import Setup
from retrim.transport import wire

METHODS = ("full", "lora")
KINDS = ("residual", "policy", "rejected", "skipped")
SMALL = {"pretrain": {"hidden_sizes": (12, 12)}}


def make_learner_state(method):
    """Return a learner state with numbers in every leaf: weights, moments and counters."""
    with jax.numpy_dtype_promotion("standard"):
        setup = Setup.from_preset(tiny_preset(**SMALL))
        policy = setup.new_policy(random.key(0))
        state = setup.learner.init(setup.low_rank(policy, random.key(1)) if method == "lora" else policy, random.key(2))

    def fill(leaf):
        numbers = np.random.default_rng(leaf.size).normal(size=leaf.shape)
        return jnp.asarray(numbers if jnp.issubdtype(leaf.dtype, jnp.floating) else 37 + leaf, dtype=leaf.dtype)

    return jax.tree.map(fill, state)


@pytest.fixture(scope="module")
def states():
    return {method: make_learner_state(method) for method in METHODS}


def updates(state):
    return {
        "residual": ResidualUpdate(1.0 / 3.0, 0.1, state.residual),
        "policy": PolicyUpdate(7.0 / 3.0, 0.2, 0.3, state.policy),
        "rejected": Rejection(2.2, "policy", "worse: 0,5 ≥ 0,4 “quoted”\n"),
        "skipped": Skip(0.1 + 0.2, "residual"),
    }


def assert_identical(result, expected):
    """Assert that values and types are equal, bit for bit."""
    assert type(result) is type(expected)
    assert result.computed_from == expected.computed_from
    for name in set(expected.__dataclass_fields__) - {"state"}:
        assert getattr(result, name) == getattr(expected, name)
    if hasattr(expected, "state"):
        assert jax.tree.structure(result.state) == jax.tree.structure(expected.state)
        for a, b in zip(jax.tree.leaves(result.state), jax.tree.leaves(expected.state), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", KINDS)
def test_round_trip_is_exact(states, method, kind):
    update = updates(states[method])[kind]
    assert_identical(unpack_update(pack_update(update), states[method], source="test"), update)


@pytest.mark.parametrize("method", METHODS)
def test_optimiser_counters_stay_integers(states, method):
    state = states[method]
    update = unpack_update(pack_update(updates(state)["policy"]), state, source="test")
    counters = [leaf for leaf in jax.tree.leaves(update.state.optimiser) if jnp.issubdtype(leaf.dtype, jnp.integer)]
    assert counters
    assert all(int(leaf) == 37 for leaf in counters)


def test_nonfinite_incumbent_cost_is_allowed(states):
    """A policy may replace one that diverged."""
    update = PolicyUpdate(1.0, 0.2, float("nan"), states["full"].policy)
    result = unpack_update(pack_update(update), states["full"], source="test")
    assert np.isnan(result.incumbent_cost)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("keep", [0, 5, 100, -1])
def test_truncated_message_is_refused(states, kind, keep):
    data = pack_update(updates(states["full"])[kind])[:keep]
    with pytest.raises(MessageError, match="mailbox: not a whole safetensors file"):
        unpack_update(data, states["full"], source="mailbox")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), kind=st.sampled_from(KINDS))
def test_flipped_byte_is_refused_or_harmless(states, data, kind):
    """A damaged byte leads to a refusal or to an equal update."""
    update = updates(states["lora"])[kind]
    whole = bytearray(pack_update(update))
    header = 8 + int.from_bytes(whole[:8], "little")
    place = data.draw(st.one_of(st.integers(0, min(header, len(whole)) - 1), st.integers(0, len(whole) - 1)))
    whole[place] ^= data.draw(st.integers(1, 255))
    with contextlib.suppress(MessageError):
        assert_identical(unpack_update(bytes(whole), states["lora"], source="test"), update)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nonfinite_states_are_refused(states, value):
    state = states["full"]
    policy = eqx.tree_at(lambda s: s.policy.layers[0].bias, state.policy, jnp.full(12, value))
    with pytest.raises(
        MessageError, match=r"test: tensor 'policy\.layers\.0\.bias' has 12 weights that are not finite"
    ):
        unpack_update(pack_update(PolicyUpdate(1.0, 0.1, 0.2, policy)), state, source="test")
    layer = state.residual.residual.layers[0][0]
    residual = eqx.tree_at(lambda s: s.residual.layers[0][0].bias, state.residual, layer.bias.at[3].set(value))
    with pytest.raises(MessageError, match="1 weights that are not finite"):
        unpack_update(pack_update(ResidualUpdate(1.0, 0.1, residual)), state, source="test")


@pytest.mark.parametrize("value", [np.nan, np.inf, "1.0", True, None])
@pytest.mark.parametrize("field", ["computed_from", "rms_error"])
def test_nonfinite_fields_are_refused(states, field, value):
    plain = {"computed_from": 1.0, "rms_error": 0.1} | {field: value}
    data = wire.pack(states["full"].residual, kind="residual", about={"update": json.dumps(plain)})
    with pytest.raises(MessageError, match=rf"test: .*'residual' update.*{field}"):
        unpack_update(data, states["full"], source="test")


@pytest.mark.parametrize(
    ("kind", "plain"),
    [
        ("rejected", {"computed_from": 1.0, "layer": "kernel", "reason": "no"}),
        ("rejected", {"computed_from": 1.0, "layer": "policy", "reason": 3}),
        ("rejected", {"computed_from": 1.0, "layer": "policy"}),
        ("skipped", {"computed_from": 1.0, "layer": "policy", "more": 1}),
        ("skipped", [1.0, "policy"]),
        ("skipped", None),
    ],
)
def test_unexpected_fields_are_refused(states, kind, plain):
    data = wire.pack((), kind=kind, about={"update": json.dumps(plain)})
    with pytest.raises(MessageError, match=f"test: not the fields of a '{kind}' update"):
        unpack_update(data, states["full"], source="test")


def test_message_without_fields_is_refused(states):
    with pytest.raises(MessageError, match="not the fields of a 'skipped' update"):
        unpack_update(wire.pack((), kind="skipped", about={}), states["full"], source="test")
    nesting = "[" * 100_000 + "]" * 100_000
    with pytest.raises(MessageError, match="not the fields of a 'skipped' update"):
        unpack_update(wire.pack((), kind="skipped", about={"update": nesting}), states["full"], source="test")


def test_foreign_bytes_are_refused(states):
    like = states["full"]
    with pytest.raises(MessageError, match="not a whole safetensors file"):
        unpack_update(b"this is no update, but a long enough line of text", like, source="test")
    with pytest.raises(MessageError, match=r"holds a 'delta', expected one of residual, policy, rejected, skipped"):
        unpack_update(wire.pack({"a": jnp.zeros(3)}, kind="delta", about={}), like, source="test")


def test_state_of_different_shape_is_refused(states):
    """Examples are the state of a different network, and a low-rank state instead of all weights."""
    setup = Setup.from_preset(tiny_preset(pretrain={"hidden_sizes": (12, 14)}))
    with jax.numpy_dtype_promotion("standard"):
        other = setup.learner.init(setup.new_policy(random.key(0)), random.key(1))
    data = pack_update(PolicyUpdate(1.0, 0.1, 0.2, other.policy))
    with pytest.raises(MessageError, match=r"has shape \(14,\), expected \(12,\)"):
        unpack_update(data, states["full"], source="test")
    with pytest.raises(MessageError, match=r"tensor 'optimiser\..*' is missing|unexpected tensor"):
        unpack_update(pack_update(updates(states["lora"])["policy"]), states["full"], source="test")


def test_integer_weights_are_refused(states):
    state = states["full"]
    count = eqx.tree_at(lambda s: s.policy.layers[0].bias, state.policy, jnp.zeros(12, dtype=int))
    with pytest.raises(MessageError, match="has type int64, expected floating point"):
        unpack_update(pack_update(PolicyUpdate(1.0, 0.1, 0.2, count)), state, source="test")


def test_shapes_suffice_for_reading(states):
    """``like`` may contain shapes only; a receiver has nothing else before the first update."""
    state = states["full"]
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), state)
    update = updates(state)["policy"]
    assert_identical(
        unpack_update(pack_update(update), LearnerState(shapes.policy, shapes.residual), source="test"), update
    )
