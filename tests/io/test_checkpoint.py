"""Policy files without a preset: round trips, and every refusal by name."""

import contextlib
import json
import os
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jax import random
from safetensors.numpy import load_file, save_file

from retrim import CheckpointError
from retrim.control import Policy
from retrim.io import read_policy, write_policy
from retrim.io.files import read_bounded, write_whole
from retrim.physics import small
from retrim.transport import message, wire


@pytest.fixture
def policy():
    return Policy.of(23, small(), key=random.key(4), hidden=(32, 32))


@pytest.fixture
def file(tmp_path, policy):
    path = tmp_path / "deep" / "policy.safetensors"
    write_policy(path, policy, {"made by": "a test", "task": "hover"})
    return path


def edit(file, change=None, **header):
    """Rewrite the file with changed tensors or header, without an update of the checksum."""
    tensors, data = load_file(file), file.read_bytes()
    save_file(change(tensors) if change else tensors, file, metadata=message._header(data, "test") | header)


def test_round_trip_is_exact(file, policy):
    for place in (file, file.parent, str(file)):
        result, header = read_policy(place)
        jax.tree.map(np.testing.assert_array_equal, result, policy)
        assert header["made by"] == "a test"
    assert not list(file.parent.glob("*.partial"))


def test_header_is_plain_json(file):
    data = file.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])["__metadata__"]
    assert header["architecture"] == "23-32-32-4"
    assert header["task"] == "hover"
    assert header["kind"] == "policy"


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match=r"nothing: no such file; `retrim pretrain hover"):
        read_policy(tmp_path / "nothing")
    with pytest.raises(CheckpointError, match=r"policy\.safetensors: no such file"):
        read_policy(tmp_path)  # a folder without a policy
    with pytest.raises(CheckpointError, match="/dev/zero: not a regular file, but a device or a pipe; `retrim"):
        read_policy("/dev/zero")


def test_reason_why_file_cannot_be_read_is_named(tmp_path):
    """An existing folder or pipe is not called missing."""
    os.mkfifo(tmp_path / "pipe")
    for name, reason in (
        (".", "not a regular file, but a folder; make it"),
        ("pipe", "not a regular file, but a device or a pipe; make it"),
        ("nothing", "no such file; make it"),
        ("x" * 300, r"cannot be read \(File name too long\)"),
    ):
        with pytest.raises(CheckpointError, match=reason):
            read_bounded(tmp_path / name, "make it")


def test_error_of_writing_names_target(tmp_path):
    """The user did not ask for the partial file, which is gone."""
    (tmp_path / "folder").mkdir()
    for path in (Path("/proc/policy.npz"), tmp_path / "folder"):
        with pytest.raises(OSError, match=path.name) as error:
            write_whole(path, b"1")
        assert (error.value.filename, error.value.filename2) == (str(path), None)
    assert [each.name for each in tmp_path.iterdir()] == ["folder"]


@pytest.mark.parametrize("keep", [0, 5, 100, 5000, -1])
def test_truncated_file_is_refused(file, keep):
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(CheckpointError, match=r"policy\.safetensors: not a whole safetensors file"):
        read_policy(file)


def test_file_of_other_kind_is_refused(file):
    file.write_bytes(b"this is not a policy at all, but a long enough line of text")
    with pytest.raises(CheckpointError, match="not a whole safetensors file"):
        read_policy(file)
    save_file({"a": np.zeros(3)}, file)
    with pytest.raises(CheckpointError, match=r"format 'none', expected 'retrim/1'"):
        read_policy(file)


def test_message_of_other_kind_is_refused(file):
    file.write_bytes(wire.pack({"a": jnp.zeros(3)}, kind="residual", about={}))
    with pytest.raises(CheckpointError, match="holds a 'residual', expected a 'policy'"):
        read_policy(file)


@pytest.mark.parametrize(
    "sizes", ["", "23-32-32", "23-4", "23-32-32-5", "23-0-32-4", "23-x-4", "-".join(["9"] * 40), "23-99999999-4"]
)
def test_invalid_architectures_are_refused(file, sizes):
    edit(file, architecture=sizes)
    with pytest.raises(CheckpointError, match=rf"architecture '{sizes}', expected sizes as 15-512-512-4"):
        read_policy(file)


def test_wrong_shape_is_refused_with_both_shapes(file):
    edit(file, lambda t: t | {"layers.1.weight": np.zeros((32, 31))})
    with pytest.raises(CheckpointError, match=r"'layers\.1\.weight' has shape \(32, 31\), expected \(32, 32\)"):
        read_policy(file)


def test_missing_and_unexpected_tensors_are_refused(file):
    edit(file, lambda t: {k: v for k, v in t.items() if k != "layers.2.bias"})
    with pytest.raises(CheckpointError, match=r"tensor 'layers\.2\.bias' is missing"):
        read_policy(file)
    edit(file, lambda t: t | {"layers.2.bias": np.zeros(4), "layers.9.bias": np.zeros(4)})
    with pytest.raises(CheckpointError, match=r"unexpected tensor 'layers\.9\.bias'"):
        read_policy(file)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nonfinite_weights_are_refused(tmp_path, policy, value):
    bad = eqx.tree_at(lambda p: p.layers[0].bias, policy, policy.layers[0].bias.at[7].set(value))
    write_policy(tmp_path / "p.safetensors", bad, {})
    with pytest.raises(CheckpointError, match=r"'layers\.0\.bias' has 1 weights that are not finite"):
        read_policy(tmp_path / "p.safetensors")


def test_integers_are_refused(file):
    edit(file, lambda t: t | {"layers.0.bias": np.zeros(32, dtype=np.int32)})
    with pytest.raises(CheckpointError, match=r"'layers\.0\.bias' has type int32, expected floating point"):
        read_policy(file)


def test_limits_without_hover_are_refused(tmp_path, policy):
    """The file is valid, but its policy could not hover."""
    for limit, value in (("u_min", 10.0), ("u_max", 9.0)):
        wrong = eqx.tree_at(lambda p, limit=limit: getattr(p, limit).c, policy, jnp.array(value))
        write_policy(tmp_path / "p.safetensors", wrong, {})
        with pytest.raises(CheckpointError, match=r"p\.safetensors: command limits .* do not enclose hover"):
            read_policy(tmp_path / "p.safetensors")


def test_changed_weight_or_header_breaks_checksum(file):
    whole = file.read_bytes()
    edit(file, lambda t: t | {"layers.0.bias": t["layers.0.bias"] + 1e-3})
    with pytest.raises(CheckpointError, match="checksum does not match"):
        read_policy(file)
    file.write_bytes(whole)
    edit(file, task="track")
    with pytest.raises(CheckpointError, match="checksum does not match"):
        read_policy(file)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_byte_is_refused_or_harmless(file, policy, data):
    """A damaged byte leads to a refusal or to equal weights."""
    whole = bytearray(file.read_bytes())
    place = data.draw(st.integers(0, len(whole) - 1))
    whole[place] ^= data.draw(st.integers(1, 255))
    bad_file = file.with_name("damaged.safetensors")
    bad_file.write_bytes(whole)
    with contextlib.suppress(CheckpointError):
        result, header = read_policy(bad_file)
        jax.tree.map(np.testing.assert_array_equal, result, policy)
        assert header == read_policy(file)[1]


def test_float32_files_load_in_double_precision_and_back(tmp_path, policy):
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), policy)
    write_policy(tmp_path / "p.safetensors", single, {})
    result, _ = read_policy(tmp_path / "p.safetensors")
    assert result.layers[0].weight.dtype == jnp.float64
    jax.tree.map(np.testing.assert_array_equal, result, jax.tree.map(lambda leaf: leaf.astype(jnp.float64), single))


def test_interrupted_write_keeps_old_file(file, policy, monkeypatch):
    whole = file.read_bytes()
    monkeypatch.setattr("os.fsync", lambda fd: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_policy(file, policy, {})
    assert file.read_bytes() == whole
    assert not list(file.parent.glob("*.partial"))
