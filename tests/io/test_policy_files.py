"""Policies with their presets, and learner states: exact round trips; false headers are refused."""

import json
import time
from importlib.metadata import version

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import tiny_preset
from retrim import CheckpointError, load_learner_state, load_policy, save_learner_state, save_policy
from retrim.config import PRESETS, Setup, changed, load
from retrim.config.loading import dump
from retrim.control import Policy
from retrim.io import read_policy, write_policy
from retrim.io.checkpoint import architecture, load_delta, lora_header, save_delta
from retrim.io.files import npz_bytes
from retrim.physics import small
from retrim.transport import wire


@pytest.fixture(scope="module")
def setup():
    return Setup.from_preset(tiny_preset(pretrain={"hidden_sizes": (12, 12)}, adapt={"window": 30}))


@pytest.fixture(scope="module")
def states(setup):
    """Return a learner state of each method with numbers in every leaf: weights, moments and counters."""
    policy = setup.new_policy(random.key(4))

    def fill(leaf):
        numbers = np.random.default_rng(leaf.size).normal(size=leaf.shape)
        return jnp.asarray(numbers if jnp.issubdtype(leaf.dtype, jnp.floating) else 37 + leaf, dtype=leaf.dtype)

    with jax.numpy_dtype_promotion("standard"):
        each = {"full": policy, "lora": setup.low_rank(policy, random.key(5))}
        result = {k: setup.learner.init(p, random.key(6)) for k, p in each.items()}
        return {k: with_limits(policy, jax.tree.map(fill, state)) for k, state in result.items()}


def with_limits(policy, tree):
    """Return a tree whose policies have the command limits of ``policy``."""

    def limit(part):
        return policy.with_params(part.layers) if isinstance(part, Policy) else part

    return jax.tree.map(limit, tree, is_leaf=lambda part: isinstance(part, Policy))


def preset_with(preset, **values):
    """Return the JSON of a preset with unchecked values, for example ``pretrain={"horizon": 10**9}``."""
    tables = json.loads(dump(preset))
    for name, value in values.items():
        tables[name] = tables[name] | value if isinstance(value, dict) else value
    return json.dumps(tables)


LIES = [
    (
        {"pretrain": {"hidden_sizes": [64, 64]}},
        r"architecture 23-12-12-4, but its preset 'hover/fast' needs 23-64-64-4",
    ),
    ({"command_history": 3}, r"architecture 23-12-12-4, but its preset 'hover/fast' needs 27-12-12-4"),
    ({"delay_ticks": 99}, r"delay_ticks: Input should be less than or equal to 20"),
    ({"pretrain": {"horizon": 10**9}}, r"pretrain\.horizon: Input should be less than or equal to 1000000"),
    ({"pretrain": {"num_envs": "many"}}, r"pretrain\.num_envs: Input should be a valid integer"),
    ({"adapt": {"fit_every": float("inf")}}, r"adapt\.fit_every"),
    ({"vehicle": "medium"}, "no vehicle 'medium'"),
    ({"task": "somersault"}, "no task 'somersault'"),
    ({"more": 3}, "more: "),
]


# ---- policies


def test_round_trip_is_exact(tmp_path, setup):
    policy = setup.new_policy(random.key(4))
    path = tmp_path / "deep" / "policy.safetensors"
    save_policy(path, policy, setup.preset)
    for place in (path, path.parent):
        result, preset = load_policy(place)
        jax.tree.map(np.testing.assert_array_equal, result, policy)
        assert preset == setup.preset


SIZES = {"hover/fast": 23, "hover/released": 27, "hover/paper": 15, "hover/100hz": 31, "track/preview": 43}
SIZES |= {
    "hover/retrim": 23,
    "hover/any": 54,
    "track/paper": 21,
    "track/blind": 15,
    "track/retrim": 49,
    "track/any": 80,
    "track/fast": 49,
    "track/paced": 49,
    "vision/ideal": 89,
    "vision/occluded": 89,
    "vision/retrim": 89,
    "vision/paper": 89,
}


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_survives_its_file(tmp_path, name):
    preset = changed(load(name), pretrain={"hidden_sizes": (8,)})
    policy = Policy.of(SIZES[name], small(), key=random.key(0), hidden=(8,))
    save_policy(tmp_path / "policy.safetensors", policy, preset)
    assert load_policy(tmp_path)[1] == preset


def test_policy_is_read_without_its_preset(tmp_path):
    """If the preset is missing or of a different version, weights and header are still readable."""
    policy = Policy.of(15, small(), key=random.key(0), hidden=(8,))
    path = tmp_path / "policy.safetensors"
    for about in ({}, {"preset": "of another version"}):
        write_policy(path, policy, about)
        result, header = read_policy(path)
        jax.tree.map(np.testing.assert_array_equal, result, policy)
        assert header.get("preset") == about.get("preset")
        with pytest.raises(CheckpointError, match=r"policy\.safetensors, header, preset"):
            load_policy(path)


@pytest.mark.parametrize(("values", "message"), LIES)
def test_false_header_with_valid_checksum_is_refused(tmp_path, setup, values, message):
    path = tmp_path / "policy.safetensors"
    write_policy(path, setup.new_policy(random.key(4)), {"preset": preset_with(setup.preset, **values)})
    with pytest.raises(CheckpointError, match=message) as error:
        load_policy(path)
    assert "\n" not in str(error.value)


# ---- learner states


@pytest.mark.parametrize("method", ["full", "lora"])
def test_learner_state_survives_bit_for_bit(tmp_path, setup, states, method):
    path = tmp_path / "deep" / "learner_state.safetensors"
    save_learner_state(path, states[method], setup.preset)
    result, preset = load_learner_state(path)
    assert preset == setup.preset
    assert jax.tree.structure(result) == jax.tree.structure(states[method])
    for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(states[method]), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def rewrite(path, setup, state, preset, **header):
    """Write a state with any header, and a valid checksum."""
    policy = state.policy.policy
    low_rank = lora_header(policy) if hasattr(policy, "delta") else {}
    about = {"preset": preset, "architecture": architecture(policy.merged()), **low_rank} | header
    path.write_bytes(wire.pack(state, kind="learnt", about=about))


@pytest.mark.parametrize(("values", "message"), LIES)
def test_false_header_of_learner_state_is_refused(tmp_path, setup, states, values, message):
    path = tmp_path / "learner_state.safetensors"
    rewrite(path, setup, states["full"], preset_with(setup.preset, **values))
    with pytest.raises(CheckpointError, match=message):
        load_learner_state(path)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({"ranks": "4-10"}, "no usable ranks and scale of a low-rank delta"),
        ({"ranks": "4-99-1"}, "no usable ranks and scale of a low-rank delta"),
        ({"ranks": "4-x-1"}, "no usable ranks and scale of a low-rank delta"),
        ({"scale": "nan"}, "no usable ranks and scale of a low-rank delta"),
        ({"ranks": "4-9-1"}, r"has shape \(10, 12\), expected \(9, 12\)"),
        ({"architecture": "23-12-13-4"}, "architecture 23-12-13-4, but its preset"),
        ({"architecture": "everything"}, "architecture everything, but its preset"),
    ],
)
def test_false_low_rank_header_is_refused(tmp_path, setup, states, header, message):
    path = tmp_path / "learner_state.safetensors"
    rewrite(path, setup, states["lora"], dump(setup.preset), **header)
    with pytest.raises(CheckpointError, match=message):
        load_learner_state(path)


def test_policy_is_not_a_learner_state(tmp_path, setup, states):
    path = tmp_path / "file.safetensors"
    save_policy(path, setup.new_policy(random.key(4)), setup.preset)
    with pytest.raises(CheckpointError, match="holds a 'policy', expected a 'learnt'"):
        load_learner_state(path)
    save_learner_state(path, states["full"], setup.preset)
    with pytest.raises(CheckpointError, match="holds a learner state; continue from it"):
        load_policy(path)
    with pytest.raises(CheckpointError, match=r"nothing: no such file; `retrim fly --out DIR`"):
        load_learner_state(tmp_path / "nothing")


# ---- numbers that are finite and unsuitable for flight


def with_leaf(tree, where, value):
    return eqx.tree_at(where, tree, replace_fn=lambda leaf: jnp.full_like(leaf, value))


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        (lambda p: p.layers[0].weight, 3e38, r"0\.weight holds 3e\+38; at most 100000 can be flown"),
        (lambda p: p.layers[1].bias, -1e9, r"1\.bias holds 1e\+09"),
        (lambda p: p.u_max.c, 3e38, r"command limits .* to \[3e\+38, .*must be within \+-1000 m/s\^2"),
        (lambda p: p.u_min.omega, -1e5, r"must be within .* \+-1000 rad/s"),
        (lambda p: p.u_max.c, 0.0, "do not enclose hover"),
    ],
)
def test_unflyable_policy_is_refused(tmp_path, setup, states, where, value, message):
    policy = setup.new_policy(random.key(4))
    save_policy(tmp_path / "p.safetensors", with_leaf(policy, where, value), setup.preset)
    with pytest.raises(CheckpointError, match=message):
        load_policy(tmp_path / "p.safetensors")
    state = eqx.tree_at(lambda s: s.policy.policy, states["full"], with_leaf(policy, where, value))
    save_learner_state(tmp_path / "l.safetensors", state, setup.preset)
    with pytest.raises(CheckpointError, match=r"holds|limits"):
        load_learner_state(tmp_path / "l.safetensors")


def test_delta_is_checked_with_its_base(tmp_path, setup, states):
    lora = states["lora"].policy.policy
    for value, path in ((1e39, tmp_path / "a"), (1e9, tmp_path / "b")):
        save_delta(path, eqx.tree_at(lambda p: p.scale, lora, value))
        with pytest.raises(CheckpointError, match=r"merged: 0\.weight holds .* at most 100000 can be flown"):
            load_delta(path, lora.base)
    state = eqx.tree_at(lambda s: s.policy.policy.scale, states["lora"], jnp.asarray(1e9))
    rewrite(tmp_path / "l", setup, state, dump(setup.preset))
    with pytest.raises(CheckpointError, match=r"holds .* at most 100000 can be flown"):
        load_learner_state(tmp_path / "l")


def test_excessive_residual_is_refused(tmp_path):
    setup = Setup.from_preset(tiny_preset(adapt={"residual": "regression", "frame": "gravity"}))
    state = setup.learner.init(setup.new_policy(random.key(0)), random.key(1))
    save_learner_state(tmp_path / "l.safetensors", state, setup.preset)
    load_learner_state(tmp_path / "l.safetensors")
    wild = jax.tree.map(lambda leaf: jnp.full_like(leaf, 1e30), state.residual)
    save_learner_state(tmp_path / "l.safetensors", eqx.tree_at(lambda s: s.residual, state, wild), setup.preset)
    with pytest.raises(CheckpointError, match=r"residual\..* holds 1e\+30; at most 1e\+12 can be flown"):
        load_learner_state(tmp_path / "l.safetensors")


def test_equal_content_gives_equal_file(tmp_path, setup, states, monkeypatch):
    for year, name in ((1990, "a"), (2040, "b")):
        now = time.struct_time((year, 1, 2, 3, 4, 5, 0, 2, 0))
        monkeypatch.setattr(time, "localtime", lambda *_, now=now: now)
        save_policy(tmp_path / f"{name}.p", setup.new_policy(random.key(4)), setup.preset)
        save_learner_state(tmp_path / f"{name}.l", states["lora"], setup.preset)
        save_delta(tmp_path / f"{name}.d", states["lora"].policy.policy)
        arrays = {"x": np.arange(5.0), "y": np.array("text")}
        (tmp_path / f"{name}.n").write_bytes(npz_bytes(arrays, compressed=True))
    for kind in "pldn":
        assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()
    with np.load(tmp_path / "a.n") as file:
        np.testing.assert_array_equal(file["x"], np.arange(5.0))
        assert str(file["y"]) == "text"


# ---- releases


def test_files_state_their_release(tmp_path, setup, states):
    save_policy(tmp_path / "p", setup.new_policy(random.key(4)), setup.preset)
    save_learner_state(tmp_path / "l", states["full"], setup.preset)
    save_delta(tmp_path / "d", states["lora"].policy.policy)
    for name, kind in (("p", "policy"), ("l", "learnt"), ("d", "delta")):
        header = wire.describe((tmp_path / name).read_bytes(), kind=kind, source=name)
        assert header["version"] == version("retrim")


@pytest.mark.parametrize(
    ("message", "newer"),
    [
        ("99.0", True),
        ("99.0.1rc1", True),
        ("0.0.1", False),
        ("", False),
        ("99", False),
        ("9" * 9, False),
        ("é.1", False),
    ],
)
def test_key_of_newer_release_is_reported(tmp_path, setup, message, newer):
    policy = setup.new_policy(random.key(4))
    about = {"preset": preset_with(setup.preset, more=3), "architecture": architecture(policy), "version": message}
    (tmp_path / "p").write_bytes(wire.pack(policy, kind="policy", about=about))
    expected = (
        rf"written by a newer release \({message}; this one is .*more: unknown key"
        if newer
        else "preset: more: unknown"
    )
    with pytest.raises(CheckpointError, match=expected) as error:
        load_policy(tmp_path / "p")
    assert ("newer release" in str(error.value)) == newer
    whole = about | {"preset": dump(setup.preset)}
    (tmp_path / "p").write_bytes(wire.pack(policy, kind="policy", about=whole))
    assert load_policy(tmp_path / "p")[1] == setup.preset


def test_defaults_for_missing_keys_of_older_file_are_listed(tmp_path, setup, caplog):
    policy, tables = setup.new_policy(random.key(4)), json.loads(dump(setup.preset))
    for table, key in ((tables, "jump_cost"), (tables["adapt"], "trim"), (tables, "goal")):
        del table[key]
    write_policy(tmp_path / "p", policy, {"preset": json.dumps(tables)})
    assert load_policy(tmp_path / "p")[1] == changed(setup.preset)
    (line,) = [record.getMessage() for record in caplog.records if record.name.startswith("retrim")]
    assert line.endswith(
        "missing keys have their defaults: goal = (0.0, 0.0, 1.0), jump_cost = 0.0, adapt.trim = 'free'"
    )
    caplog.clear()
    save_policy(tmp_path / "p", policy, setup.preset)
    load_policy(tmp_path / "p")
    assert not [record for record in caplog.records if record.name.startswith("retrim")]
