"""Pytrees as bytes: exact, small, with a checksum, and refused by name."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random
from safetensors.numpy import load, save

from retrim import MessageError
from retrim.control import Policy
from retrim.physics import small
from retrim.transport import message, wire

TREE = {"a": jnp.arange(6.0).reshape(2, 3), "b": (jnp.array(3), jnp.zeros(0))}
SHAPES = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), TREE)


def pack(tree=TREE, **about):
    return wire.pack(tree, kind="test", about=about)


def unpack(data, like=TREE):
    return wire.unpack(data, like, kind="test", source="somewhere")


def with_header(header):
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text


def edit(data, change=None, **header):
    """Return the message with changed tensors or header, without an update of the checksum."""
    tensors = load(data)
    return save(change(tensors) if change else tensors, metadata=message._header(data, "test") | header)


@pytest.mark.parametrize("like", [TREE, SHAPES])
def test_round_trip_is_exact(like):
    result = unpack(pack(who="me"), like)
    assert jax.tree.structure(result) == jax.tree.structure(TREE)
    for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(TREE), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    assert wire.describe(pack(who="me"), kind="test", source="test")["who"] == "me"
    assert wire.names(TREE).keys() == {"a", "b.0", "b.1"}


def test_empty_tree_survives_round_trip():
    assert unpack(pack(()), ()) == ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: {"a": t["a"], "b.0": t["b.0"]}, r"tensor 'b\.1' is missing"),
        (lambda t: t | {"c": np.zeros(1)}, r"unexpected tensor 'c'; expected a, b\.0, b\.1"),
        (lambda t: t | {"a": np.zeros((3, 2))}, r"tensor 'a' has shape \(3, 2\), expected \(2, 3\)"),
        (lambda t: t | {"a": np.zeros((2, 3), dtype=int)}, r"tensor 'a' has type int64, expected floating point"),
        (lambda t: t | {"b.0": np.array(3.0)}, r"tensor 'b\.0' has type float64, expected integers"),
        (lambda t: t | {"b.0": np.array(True)}, r"tensor 'b\.0' has type bool, expected integers"),
        (lambda t: t | {"a": np.full((2, 3), np.nan)}, r"tensor 'a' has 6 weights that are not finite"),
        (lambda t: t | {"a": t["a"] + 1e-9}, "the checksum does not match"),
        (lambda t: t | {"b.0": np.array(4)}, "the checksum does not match"),
    ],
)
def test_unsuitable_tensors_are_refused(change, message):
    with pytest.raises(MessageError, match=f"somewhere: {message}"):
        unpack(edit(pack(), change))


def test_changed_header_breaks_checksum():
    with pytest.raises(MessageError, match="the checksum does not match"):
        unpack(edit(pack(who="me"), who="you"))
    with pytest.raises(MessageError, match="the checksum does not match"):
        unpack(edit(pack(), more="fields"))


def test_other_kind_or_format_is_refused():
    with pytest.raises(MessageError, match="somewhere: holds a 'test', expected a 'policy'"):
        wire.unpack(pack(), TREE, kind="policy", source="somewhere")
    with pytest.raises(MessageError, match=r"format 'retrim/0', expected 'retrim/1'"):
        unpack(edit(pack(), format="retrim/0"))


@pytest.mark.parametrize("header", [{}, {"__metadata__": None}, {"__metadata__": {}}])
def test_header_without_fields_is_refused(header):
    with pytest.raises(MessageError, match=r"somewhere: format 'none', expected 'retrim/1'"):
        unpack(with_header(header))


@pytest.mark.parametrize("header", [[], "text", 3, {"__metadata__": {"kind": 3}}, {"a": {"dtype": "F64"}}])
def test_invalid_header_is_refused(header):
    with pytest.raises(MessageError, match="somewhere: not a whole safetensors file"):
        unpack(with_header(header))


@pytest.mark.parametrize("dtype", ["BF16", "F8_E4M3"])
def test_types_outside_numpy_are_refused(dtype):
    width = 2 if dtype == "BF16" else 1
    data = with_header(
        {"__metadata__": {"format": message.FORMAT, "kind": "test"}}
        | {"a": {"dtype": dtype, "shape": [6], "data_offsets": [0, 6 * width]}}
    ) + bytes(6 * width)
    with pytest.raises(MessageError, match="somewhere: "):
        unpack(data)


def test_too_large_message_is_refused(monkeypatch):
    monkeypatch.setattr(message, "MAX_BYTES", 100)
    with pytest.raises(MessageError, match=r"somewhere: \d+ bytes, more than the 100 that are accepted"):
        unpack(pack())


def test_single_precision_is_converted_to_expected_type():
    single = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32) if leaf.ndim else leaf, TREE)
    result = unpack(pack(single))
    assert result["a"].dtype == jnp.float64
    np.testing.assert_array_equal(result["a"], TREE["a"])


def test_size_of_a_paper_policy():
    with jax.enable_x64(False):
        shapes = eqx.filter_eval_shape(lambda key: Policy.of(15, small(), key=key), random.key(0))
        data = pack(jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes))
    assert len(data) == pytest.approx(1.09e6, rel=0.01)


def test_equal_content_has_equal_bytes():
    """The library that writes headers puts their fields in a different order each time."""
    about = {f"field{i}": str(i) for i in range(20)}
    setup = {pack(**dict(sorted(about.items(), reverse=back))) for back in (True, False) for _ in range(20)}
    assert len(setup) == 1
    (data,) = setup
    size = int.from_bytes(data[:8], "little")
    assert size % 8 == 0
    assert list(json.loads(data[8 : 8 + size])["__metadata__"]) == sorted([*about, "checksum", "format", "kind"])
    np.testing.assert_array_equal(unpack(data)["a"], TREE["a"])
    assert pack(field="ü €\n") == pack(field="ü €\n")
    assert wire.describe(pack(field="ü €\n"), kind="test", source="x")["field"] == "ü €\n"
