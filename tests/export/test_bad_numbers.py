"""Exported policies treat invalid numbers like missing ticks of the policy in JAX."""

import shutil
import subprocess

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import tiny_preset
from retrim.config.setup import Setup
from retrim.control.controller import PolicyController
from retrim.export.checking import FLAGS
from retrim.export.export import export
from retrim.export.runner import LARGEST, Runner
from retrim.io.policies import save_policy
from retrim.physics import State
from retrim.physics.so3 import exp
from retrim.runkit.reporter import Silent

BEFORE, AFTER, SHARE = 6, 12, 1e-5
NUMBERS = {"nan": np.nan, "inf": np.inf, "-inf": -np.inf, "1e30": 1e30, "frozen": None}
FAST = (*FLAGS, "-ffast-math")
CAREFUL = (*FLAGS, "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
MAIN = """
#include <stdio.h>
#include "quad.h"
int main(void) {
    quad_memory memory; float x[15], u[5];
    if (!(quad_check() < 1e-5f)) return 2;
    quad_reset(&memory);
    while (fread(x, sizeof x, 1, stdin) == 1) {
        u[4] = (float)quad_step(&memory, x, x + 3, x + 12, u);
        fwrite(u, sizeof u, 1, stdout);
    }
    return 0;
}
"""


@pytest.fixture(scope="module")
def setup():
    return Setup.from_preset(tiny_preset(command_history=3))


@pytest.fixture(scope="module")
def policy(setup):
    """Return a policy with large weights, so that commands change."""
    fresh = setup.new_policy(random.key(0))
    return fresh.with_params(jax.tree.map(lambda leaf: jnp.asarray(12.0 * np.asarray(leaf)), fresh.layers))


@pytest.fixture(scope="module")
def folder(policy, setup, tmp_path_factory):
    """Return a folder with the policy in every format."""
    place = tmp_path_factory.mktemp("formats")
    save_policy(place / "policy.safetensors", policy, setup.preset)
    for to, name in (("npz", "quad.npz"), ("c", "quad.h")):
        export(place / "policy.safetensors", to, place / name, None, Silent())
    (place / "main.c").write_text(MAIN)
    return place


@pytest.fixture(scope="module")
def good():
    """Return valid rows of p, R, v."""
    rng = np.random.default_rng(5)
    p, v, phi = (0.5 * rng.normal(size=(BEFORE + AFTER, 3)) for _ in range(3))
    R = np.asarray(jax.jit(jax.vmap(exp))(phi)).reshape(-1, 9)
    return np.concatenate([p + np.array([[0.0, 0.0, 1.0]]), R, v], axis=1)


def sequence(good, kind, ticks, place):
    """Return valid, bad and again valid ticks, and a flag of validity for each."""
    bad = np.repeat(good[BEFORE - 1 : BEFORE], ticks, axis=0)
    frozen = NUMBERS[kind] is None
    if not frozen:
        bad[:, place] = NUMBERS[kind]
    fine = np.concatenate([np.full(BEFORE, True), np.full(ticks, frozen), np.full(AFTER, True)])
    return np.concatenate([good[:BEFORE], bad, good[BEFORE:]]), fine


def commands(controller, rows, fine):
    """Return a command for each row: hover before the first valid row; an invalid row repeats the last command."""
    return np.concatenate([[[9.81, 0.0, 0.0, 0.0]], scan(controller, jnp.asarray(rows[fine]))])[np.cumsum(fine)]


@eqx.filter_jit
def scan(controller, rows):
    def tick(memory, row):
        u, memory = controller(memory, jnp.array(0.0), State(row[:3], row[3:12].reshape(3, 3), row[12:]))
        return memory, u.vector()

    first = State(rows[0, :3], rows[0, 3:12].reshape(3, 3), rows[0, 12:])
    return lax.scan(tick, controller.init(first), rows)[1]


@pytest.fixture(scope="module")
def plain(policy, setup):
    return PolicyController(setup.env.task.observation, policy)


@pytest.fixture(scope="module")
def programs(folder):
    if shutil.which("gcc") is None:
        pytest.skip("there is no C compiler")
    for name, flags in (("fast", FAST), ("careful", CAREFUL)):
        subprocess.run(["gcc", *flags, "main.c", "-o", name, "-lm"], cwd=folder, check=True)
    return [folder / "fast", folder / "careful"]


CASES = [(kind, ticks, place) for kind in NUMBERS for ticks, place in ((1, 0), (50, 7))] + [("nan", 3, 14)]


@pytest.mark.parametrize(("kind", "ticks", "place"), CASES)
def test_c_and_numpy_equal_jax(kind, ticks, place, plain, good, folder, programs, setup):
    """This includes a program with -ffast-math and one with sanitizers, which report no fault."""
    rows, fine = sequence(good, kind, ticks, place)
    expected = commands(plain, rows, fine)
    low, high = (np.asarray(u.vector()) for u in (plain.policy.u_min, plain.policy.u_max))
    assert np.all(np.ptp(expected, axis=0) > 0.05 * (high - low))
    loaded_policy, counts = Runner(folder / "quad.npz"), []
    result = {"NumPy": []}
    for row in rows:
        result["NumPy"].append(loaded_policy.step(row[:3], row[3:12].reshape(3, 3), row[12:]))
        counts.append(loaded_policy.repeats)
    assert max(counts) == np.sum(~fine)
    np.testing.assert_array_equal(np.array(counts) == 0, fine)
    for program in programs:
        process = subprocess.run([program], input=rows.astype(np.float32).tobytes(), capture_output=True, check=True)
        assert process.stderr == b""
        outputs = np.frombuffer(process.stdout, np.float32).reshape(-1, 5)
        np.testing.assert_array_equal(outputs[:, 4], fine)
        result[program.name] = outputs[:, :4]
    for name, outputs in result.items():
        assert np.max(np.abs(np.array(outputs) - expected) / (high - low)) <= SHARE, name


def test_flight_may_begin_with_bad_ticks(plain, good, folder, programs):
    rows = np.concatenate([np.full((2, 15), np.nan), good[:3]])
    expected = commands(plain, rows, np.arange(5) >= 2)
    loaded_policy = Runner(folder / "quad.npz")
    numpy = [loaded_policy.step(row[:3], row[3:12].reshape(3, 3), row[12:]) for row in rows]
    np.testing.assert_allclose(numpy, expected, atol=1e-4)
    for program in programs:
        process = subprocess.run([program], input=rows.astype(np.float32).tobytes(), capture_output=True, check=True)
        np.testing.assert_allclose(np.frombuffer(process.stdout, np.float32).reshape(-1, 5)[:, :4], expected, atol=1e-4)


def test_bad_row_without_memory_gives_nan_and_flag(folder, good):
    loaded_policy = Runner(folder / "quad.npz")
    rows = np.tile(loaded_policy._arrays["test_observations"][:1], (4, 1))
    rows[1, 5], rows[2, 20], rows[3, 0] = np.nan, np.inf, LARGEST
    np.testing.assert_array_equal(np.isnan(loaded_policy.command(rows)).all(axis=1), [False, True, True, True])
    pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    export(folder / "policy.safetensors", "onnx", folder / "quad.onnx", None, Silent())
    session = runtime.InferenceSession(str(folder / "quad.onnx"), providers=["CPUExecutionProvider"])
    commands, finite = session.run(["command", "finite"], {"observation": rows})
    np.testing.assert_array_equal(finite[:, 0], [True, False, False, False])
    np.testing.assert_allclose(commands, loaded_policy.command(rows), atol=1e-4)


def test_header_has_limit_of_runner(folder):
    bits = np.float32(LARGEST).view(np.uint32)
    assert f">= 0x{bits:08x}u) return 0;" in (folder / "quad.h").read_text()


def test_check_detects_header_without_test_of_bits(folder, programs):
    text = (folder / "quad.h").read_text()
    blind = text.replace("u) return 0;", "u && 0) return 0;")
    assert blind != text
    (folder / "blind").mkdir()
    (folder / "blind" / "quad.h").write_text(blind)
    shutil.copy(folder / "main.c", folder / "blind")
    subprocess.run(["gcc", *FLAGS, "main.c", "-o", "main", "-lm"], cwd=folder / "blind", check=True)
    assert subprocess.run([folder / "blind" / "main"], input=b"", check=False).returncode == 2
