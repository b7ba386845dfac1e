"""Policies and presets as files: exact round trips; everything that must be refused, by name."""

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
from safetensors.numpy import load_file, save_file

from helpers import tiny_preset
from retrim import CheckpointError, ConfigError, load_policy, save_policy
from retrim.config import factory as build
from retrim.config import presets
from retrim.config import registry as testbed
from retrim.transport import wire


@pytest.fixture
def preset():
    return tiny_preset()


@pytest.fixture
def policy(preset):
    return build.policy(preset, random.key(4))


@pytest.fixture
def file(tmp_path, policy, preset):
    path = tmp_path / "deep" / "policy.safetensors"
    save_policy(path, policy, preset)
    return path


def test_round_trip_is_exact(file, policy, preset):
    for place in (file, file.parent):
        found, found_preset = load_policy(place)
        jax.tree.map(np.testing.assert_array_equal, found, policy)
        assert found_preset == preset
    assert not list(file.parent.glob("*.partial"))


@pytest.mark.parametrize("name", presets.PRESETS)
def test_every_preset_comes_back_from_its_file(tmp_path, name):
    small = presets.changed(presets.load(name), pretrain={"hidden": (8,)})
    save_policy(tmp_path / "policy.safetensors", build.policy(small, random.key(0)), small)
    assert load_policy(tmp_path)[1] == small


def edited(file, change=None, **header):
    """Rewrite the file with other tensors or another header, without our checksum's consent."""
    tensors, data = load_file(file), file.read_bytes()
    about = wire._metadata(data) | header
    save_file(change(tensors) if change else tensors, file, metadata=about)


def test_missing(tmp_path):
    with pytest.raises(CheckpointError, match=r"nothing: no such file; `retrim pretrain hover"):
        load_policy(tmp_path / "nothing")


@pytest.mark.parametrize("keep", [0, 5, 100, 5000, -1])
def test_truncated(file, keep):
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(CheckpointError, match=r"policy\.safetensors: not a whole safetensors file"):
        load_policy(file)


def test_another_kind_of_file(file):
    file.write_bytes(b"this is not a policy at all, but a long enough line of text")
    with pytest.raises(CheckpointError, match="not a whole safetensors file"):
        load_policy(file)
    save_file({"a": np.zeros(3)}, file)
    with pytest.raises(CheckpointError, match=r"format 'none', expected 'retrim/1'"):
        load_policy(file)


def test_another_kind_of_message(file):
    data = wire.pack({"a": jnp.zeros(3)}, kind="residual", about={})
    file.write_bytes(data)
    with pytest.raises(CheckpointError, match="holds a 'residual', expected a 'policy'"):
        load_policy(file)


def test_wrong_architecture(file, preset):
    wider = presets.changed(preset, pretrain={"hidden": (64, 64)})
    edited(file, preset=presets.dump(wider))
    with pytest.raises(CheckpointError, match=r"architecture 23-32-32-4, but its preset 'fast' needs 23-64-64-4"):
        load_policy(file)


def test_wrong_shape_is_named_with_both_shapes(file):
    edited(file, lambda t: t | {"layers.1.weight": np.zeros((32, 31))})
    with pytest.raises(CheckpointError, match=r"'layers\.1\.weight' has shape \(32, 31\), expected \(32, 32\)"):
        load_policy(file)


def test_missing_and_unexpected_tensors(file):
    edited(file, lambda t: {k: v for k, v in t.items() if k != "layers.2.bias"})
    with pytest.raises(CheckpointError, match=r"tensor 'layers\.2\.bias' is missing"):
        load_policy(file)
    edited(file, lambda t: t | {"layers.2.bias": np.zeros(4), "layers.9.bias": np.zeros(4)})
    with pytest.raises(CheckpointError, match=r"unexpected tensor 'layers\.9\.bias'"):
        load_policy(file)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_weights_that_are_not_finite(tmp_path, preset, policy, value):
    broken = eqx.tree_at(lambda p: p.layers[0].bias, policy, policy.layers[0].bias.at[7].set(value))
    save_policy(tmp_path / "p.safetensors", broken, preset)
    with pytest.raises(CheckpointError, match=r"'layers\.0\.bias' has 1 weights that are not finite"):
        load_policy(tmp_path / "p.safetensors")


def test_integers_are_refused(file):
    edited(file, lambda t: t | {"layers.0.bias": np.zeros(32, dtype=np.int32)})
    with pytest.raises(CheckpointError, match=r"'layers\.0\.bias' has type int32, expected floating point"):
        load_policy(file)


def test_a_changed_header_breaks_the_checksum(file, preset):
    edited(file, preset=presets.dump(presets.changed(preset, plant_delay=2)))
    with pytest.raises(CheckpointError, match="checksum does not match"):
        load_policy(file)


def test_a_header_without_preset(file):
    edited(file, preset="")
    with pytest.raises(CheckpointError, match="header, preset"):
        load_policy(file)


def test_a_changed_weight_breaks_the_checksum(file):
    edited(file, lambda t: t | {"layers.0.bias": t["layers.0.bias"] + 1e-3})
    with pytest.raises(CheckpointError, match="checksum does not match"):
        load_policy(file)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_bytes_never_load_silently(file, policy, data):
    """Whatever byte is damaged: either a clear refusal, or the very same weights."""
    whole = bytearray(file.read_bytes())
    place = data.draw(st.integers(0, len(whole) - 1))
    whole[place] ^= data.draw(st.integers(1, 255))
    damaged = file.with_name("damaged.safetensors")
    damaged.write_bytes(whole)
    with contextlib.suppress(CheckpointError):
        found, found_preset = load_policy(damaged)
        jax.tree.map(np.testing.assert_array_equal, found, policy)
        assert found_preset == load_policy(file)[1]


def test_float32_files_load_in_double_precision_and_back(tmp_path, preset, policy):
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), policy)
    save_policy(tmp_path / "p.safetensors", single, preset)
    found, _ = load_policy(tmp_path / "p.safetensors")
    assert found.layers[0].weight.dtype == jnp.float64
    jax.tree.map(np.testing.assert_array_equal, found, jax.tree.map(lambda leaf: leaf.astype(jnp.float64), single))


def test_size_of_a_paper_policy(tmp_path):
    paper = presets.load("paper")
    with jax.enable_x64(False):
        data = wire.pack(build.policy(paper, random.key(0)), kind="policy", about={})
    assert len(data) == pytest.approx(1.09e6, rel=0.01)


# ---- presets


def test_presets_survive_json():
    for preset in presets.PRESETS.values():
        assert presets.parse(presets.dump(preset), source="test") == preset


def test_the_papers_numbers():
    paper = presets.PRESETS["paper"]
    p, a = paper.pretrain, paper.adapt
    assert (p.epochs, p.envs, p.horizon, p.hidden) == (300, 100, 150, (512, 512))
    assert (a.window, a.refine_every, a.iters, a.improve_every, a.epochs, a.envs) == (100, 3.0, 100, 5.0, 30, 10)
    assert (paper.history, paper.delay) == (0, 0)
    assert build.task(paper).observation.size == 15
    assert build.task(presets.PRESETS["released"]).observation.size == 27


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("adapt.modee = 3", r"adapt\.modee: Unexpected keyword argument"),
        ("pretrain.epochs = -3", r"pretrain\.epochs: Input should be greater than 0"),
        ("pretrain.rate = 'fast'", r"pretrain\.rate: Input should be a valid number"),
        ("adapt.improve_every = 0.005", r"adapt\.improve_every: Input should be greater than or equal to 0\.02"),
        ("goal = [nan, 0.0, 1.0]", r"goal\.0: Input should be a finite number"),
        ("vehicle = 'medium'", r"vehicle: Input should be 'small', 'large' or 'kingfisher'"),
        ("= 3", r"overlay\.toml: Invalid statement"),
    ],
)
def test_bad_overlays_name_the_path(tmp_path, text, message):
    overlay = tmp_path / "overlay.toml"
    overlay.write_text(text)
    with pytest.raises(ConfigError, match=message):
        presets.load("fast", overlay)


def test_overlay(tmp_path):
    overlay = tmp_path / "overlay.toml"
    overlay.write_text("[adapt]\nepochs = 7\n")
    found = presets.load("fast", overlay)
    assert found.adapt.epochs == 7
    assert found.adapt.clip == presets.PRESETS["fast"].adapt.clip
    with pytest.raises(ConfigError, match="overlay"):
        presets.load("fast", tmp_path / "overlay")


def test_unknown_names():
    with pytest.raises(ConfigError, match="no preset 'quick'; there are paper, released, fast"):
        presets.load("quick")
    with pytest.raises(ConfigError, match="no disturbance 'huge'; there are none, small, large, reversing"):
        testbed.disturbance("huge")


def test_header_is_plain_json(file):
    data = file.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])["__metadata__"]
    assert header["architecture"] == "23-32-32-4"
    assert header["task"] == "hover"
    assert header["kind"] == "policy"
