"""An exported policy has the results of JAX in every format; a file with different results is refused."""

import ast
import dataclasses
import shutil
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import tiny_preset
from retrim.config.setup import Setup
from retrim.control.controller import PolicyController
from retrim.control.lora import LoraPolicy
from retrim.errors import CheckpointError, ConfigError
from retrim.export import runner
from retrim.export.checking import FLAGS, Parity
from retrim.export.export import FORMATS, PARITY, export
from retrim.export.portable import commands, observations, portable_of
from retrim.export.runner import Runner
from retrim.io.checkpoint import save_delta
from retrim.io.policies import save_policy
from retrim.physics import Command, State
from retrim.physics.so3 import exp
from retrim.runkit.reporter import Silent

HAS_C = pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no C compiler")
NEEDS = {"npz": (), "onnx": ("onnx", "onnxruntime"), "c": ()}


@pytest.fixture(scope="module")
def setup():
    return Setup.from_preset(tiny_preset(command_history=2))


@pytest.fixture(scope="module")
def policy(setup):
    """Return a policy with large weights, so that commands reach their limits."""
    fresh = setup.new_policy(random.key(0))
    growth = jax.tree.map(lambda leaf: jnp.asarray(6.0 * np.asarray(leaf)), fresh.layers)
    return fresh.with_params(growth)


@pytest.fixture(scope="module")
def policy_file(policy, setup, tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    save_policy(path, policy, setup.preset)
    return path


class LineReporter(Silent):
    def __init__(self):
        self.lines = []

    def say(self, text):
        self.lines.append(text)


@pytest.mark.parametrize("to", FORMATS)
def test_every_format_equals_jax(to, policy, setup, policy_file, tmp_path):
    for name in NEEDS[to]:
        pytest.importorskip(name)
    if to == "c" and shutil.which("gcc") is None:
        pytest.skip("there is no C compiler")
    reporter = LineReporter()
    paths = export(policy_file, to, tmp_path / f"p{FORMATS[to].suffix}", None, reporter)
    assert "µs a step" in reporter.lines[0]
    portable = portable_of(policy, setup)
    rows = 2.0 * observations(portable.sizes[0], 500, seed=3)
    expected = commands(policy, rows)
    assert np.all(np.ptp(expected, axis=0) > 0.1 * (portable.high - portable.low))  # commands of all sizes
    result = FORMATS[to].check(paths[0], portable, rows, expected)
    assert result.worst <= PARITY
    shifted_result = FORMATS[to].check(paths[0], portable, rows, expected + 1e-3 * (portable.high - portable.low))
    assert shifted_result.worst > 9e-4


def test_file_with_different_results_is_refused(policy_file, tmp_path):
    export(policy_file, "npz", tmp_path / "p.npz", None, Silent())
    with np.load(tmp_path / "p.npz") as file:
        arrays = dict(file)
    arrays["w1"] = arrays["w1"] * 1.01
    np.savez(tmp_path / "changed.npz", **arrays)
    with pytest.raises(ValueError, match="results deviate from the test vectors by"):
        Runner(tmp_path / "changed.npz")


@pytest.fixture(scope="module")
def states():
    """Return positions, attitudes and velocities of twelve ticks."""
    rng = np.random.default_rng(5)
    p, v, phi = (0.5 * rng.normal(size=(12, 3)) for _ in range(3))
    return p + np.array([[0.0, 0.0, 1.0]]), np.asarray(jax.jit(jax.vmap(exp))(phi)), v


@pytest.fixture(scope="module")
def sample_flight(policy, setup, states):
    """Return the commands of the controller, tick by tick."""

    @eqx.filter_jit
    def fly(controller, p, R, v):
        def tick(memory, now):
            t, *x = now
            u, memory = controller(memory, t, State(*x))
            return memory, u.vector()

        t = 0.02 * jnp.arange(float(len(p)))
        return lax.scan(tick, controller.init(State(p[0], R[0], v[0])), (t, p, R, v))[1]

    return np.asarray(fly(PolicyController(setup.env.task.observation, policy), *map(jnp.asarray, states)))


def test_runner_equals_controller(setup, policy_file, states, sample_flight, tmp_path):
    export(policy_file, "npz", tmp_path / "p.npz", None, Silent())
    loaded_policy = Runner(tmp_path / "p.npz")
    for _ in range(2):  # the second flight begins like the first
        result = np.array([loaded_policy.step(*(x[k] for x in states)) for k in range(12)])
        np.testing.assert_allclose(result, sample_flight, atol=2e-4)
        loaded_policy.reset()
    assert loaded_policy.dt == setup.preset.dt


@HAS_C
def test_c_equals_controller(policy_file, states, sample_flight, tmp_path):
    export(policy_file, "c", tmp_path / "my-quad.h", None, Silent())
    p, R, v = (x.astype(np.float32) for x in states)
    rows = np.concatenate([p, R.reshape(12, 9), v], axis=1)
    (tmp_path / "main.c").write_text("""
#include <stdio.h>
#include "my-quad.h"
int main(void) {
    my_quad_memory memory; float x[15], u[4];
    if (my_quad_check() > 1e-5f) return 2;
    my_quad_reset(&memory);
    while (fread(x, sizeof x, 1, stdin) == 1) {
        my_quad_step(&memory, x, x + 3, x + 12, u);
        fwrite(u, sizeof u, 1, stdout);
    }
    return 0;
}
""")
    subprocess.run(["gcc", *FLAGS, "main.c", "-o", "main", "-lm"], cwd=tmp_path, check=True)
    process = subprocess.run([tmp_path / "main"], input=rows.tobytes(), capture_output=True, check=True)
    result = np.frombuffer(process.stdout, np.float32).reshape(-1, 4)
    np.testing.assert_allclose(result, sample_flight, atol=2e-4)
    text = (tmp_path / "my-quad.h").read_text()
    assert not any(word in text for word in ("malloc", "double", "static float"))


def test_runner_needs_only_numpy(policy_file, tmp_path):
    tree = ast.parse(Path(runner.__file__).read_text())
    imports = {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    imports |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert imports == {"json", "numpy", "pathlib", "typing"}
    export(policy_file, "npz", tmp_path / "p.npz", None, Silent())
    code = "import sys; sys.modules['jax'] = sys.modules['retrim'] = None; import runner, numpy as np\n" \
        "print(*runner.Runner('p.npz').step(np.zeros(3), np.eye(3), np.zeros(3)))"  # fmt: skip
    process = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert len(process.stdout.split()) == 4


def test_delta_is_exported_separately_or_merged(policy, setup, policy_file, tmp_path):
    low = LoraPolicy.of(policy, key=random.key(1), ranks=(2, 2, 1))
    low = low.with_params(jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf) + 0.1), low.delta)).shifted(
        jnp.array([0.1, 0.0, -0.1, 0.0])
    )
    save_delta(tmp_path / "delta.safetensors", low)
    export(policy_file, "npz", tmp_path / "p.npz", None, Silent())
    export(policy_file, "delta", tmp_path / "d.npz", tmp_path / "delta.safetensors", Silent())
    rows = observations(portable_of(policy, setup).sizes[0], 500, seed=2)
    expected = commands(low.merged(), rows)
    np.testing.assert_allclose(Runner(tmp_path / "p.npz", tmp_path / "d.npz").command(rows), expected, atol=5e-4)
    assert np.abs(Runner(tmp_path / "p.npz").command(rows) - expected).max() > 0.1
    export(policy_file, "npz", tmp_path / "merged.npz", tmp_path / "delta.safetensors", Silent())
    np.testing.assert_allclose(Runner(tmp_path / "merged.npz").command(rows), expected, atol=5e-4)
    with pytest.raises(ValueError, match="made for a different policy"):
        Runner(tmp_path / "merged.npz", tmp_path / "d.npz")


@pytest.mark.parametrize(
    ("to", "out", "delta", "text"),
    [
        ("rust", None, None, "must be npz, onnx, c or delta"),
        ("c", "policy.txt", None, "must end with .h"),
        ("delta", None, None, "give it as --delta"),
    ],
)
def test_invalid_options_are_named(to, out, delta, text, policy_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=text):
        export(policy_file, to, out and Path(out), delta, Silent())
    assert not list(tmp_path.iterdir())


def test_foreign_runner_file_is_not_overwritten(policy_file, tmp_path):
    """An existing runner of this project is written again."""
    export(policy_file, "npz", tmp_path / "p.npz", None, Silent())
    export(policy_file, "npz", tmp_path / "q.npz", None, Silent())
    (tmp_path / "runner.py").write_text("print('mine')\n")
    with pytest.raises(ConfigError, match=r"runner\.py already exists") as error:
        export(policy_file, "npz", tmp_path / "r.npz", None, Silent())
    assert "\n" not in str(error.value)
    assert (tmp_path / "runner.py").read_text() == "print('mine')\n"
    assert not (tmp_path / "r.npz").exists()


@HAS_C
@pytest.mark.parametrize(
    ("file", "name"), [("é.h", "policy__"), ("2nd.h", "policy_2nd"), ("_.h", "policy__"), ("int.h", "int")]
)
def test_every_file_name_gives_a_valid_header(file, name, policy_file, tmp_path):
    """Names that begin with two underscores or a digit are not available to a program."""
    export(policy_file, "c", tmp_path / file, None, Silent())
    assert f"static inline int {name}_finite(" in (tmp_path / file).read_text()


@pytest.mark.parametrize("fails", ["with an error", "with a deviation"])
def test_file_that_fails_its_check_replaces_nothing(fails, policy_file, tmp_path, monkeypatch):
    def check(path, *_):
        if fails == "with an error":
            raise ConfigError(f"{path.name}: does not compile")
        return Parity("gcc", 0.1, 1e-6)

    monkeypatch.setitem(FORMATS, "c", dataclasses.replace(FORMATS["c"], check=check))
    (tmp_path / "p.h").write_text("earlier")
    for path in (tmp_path / "p.h", tmp_path / "new.h"):
        with pytest.raises(ConfigError, match=r"does not compile|nothing was written"):
            export(policy_file, "c", path, None, Silent())
    assert [each.name for each in tmp_path.iterdir()] == ["p.h"]
    assert (tmp_path / "p.h").read_text() == "earlier"


def test_missing_policy_is_named(tmp_path):
    with pytest.raises(CheckpointError, match="no such file"):
        export(tmp_path / "nowhere.safetensors", "c", None, None, Silent())


def test_first_observation_contains_hover_command(policy_file, tmp_path):
    export(policy_file, "npz", tmp_path / "p.npz", None, Silent())
    loaded_policy = Runner(tmp_path / "p.npz")
    np.testing.assert_array_equal(loaded_policy.observe(np.zeros(3), np.eye(3), np.zeros(3))[15:], 0.0)
    assert Command.hover().vector()[0] == pytest.approx(loaded_policy._last[0])
