"""The fault of jax 0.10.2 on CPU (jax-ml/jax#39103), the version that is excluded for it, and settings of JAX."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import jax
import pytest

from retrim.evaluation.jax_bug_check import EXCLUDED_VERSION
from retrim.runkit.error_messages import describe_error

ROOT = Path(__file__).parent.parent


def test_batched_products_are_correct_with_default_flags():
    """The test uses a separate process without the flags of the test suite."""
    sizes = [("float32", 1_000), ("float32", 16_385), ("float32", 32_769), ("float64", 16_385)]
    code = (
        "import retrim, jax; jax.config.update('jax_enable_x64', True); import jax.numpy as jnp\n"
        "from retrim.evaluation.jax_bug_check import wrong_rows\n"
        f"print([wrong_rows(n, jnp.dtype(dtype)) for dtype, n in {sizes}])"
    )
    plain = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run([sys.executable, "-c", code], env=plain, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[0, 0, 0, 0]", done.stderr


@pytest.mark.parametrize("imports", ["import jax; from retrim import State", "from retrim import State; import jax"])
@pytest.mark.parametrize(("setting", "expected"), [(None, "float32"), ("tensorfloat32", "tensorfloat32")])
def test_products_have_full_single_precision_by_default(setting, expected, imports):
    """This includes GPUs, whose default is lower; the user's choice has priority, in any order of imports."""
    environment = {name: value for name, value in os.environ.items() if name != "JAX_DEFAULT_MATMUL_PRECISION"}
    environment |= {} if setting is None else {"JAX_DEFAULT_MATMUL_PRECISION": setting}
    code = f"{imports}; print(jax.config.jax_default_matmul_precision)"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == expected, done.stderr


def test_excluded_version_is_not_installed():
    assert jax.__version__ != EXCLUDED_VERSION
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert f"jax>=0.8,!={EXCLUDED_VERSION}" in project["dependencies"]
    assert f"jax=={EXCLUDED_VERSION}" not in (ROOT / "constraints.txt").read_text()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("JAX_ENABLE_X64=perhaps", "JAX does not accept this value; unset or correct it"),
        ("JAX_NUM_CPU_DEVICES=many", "JAX does not accept this value; unset or correct it"),
        ("JAX_PLATFORMS=fpga", "this machine has no such device; unset it or use cpu"),
    ],
)
def test_wrong_environment_of_jax_is_refused_in_one_line(setting, message):
    name, _, value = setting.partition("=")
    words = [sys.executable, "-m", "retrim.cli", "doctor"]
    done = subprocess.run(words, env=os.environ | {name: value}, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", f"retrim: {setting}: {message}\n")


def test_platform_without_a_reason_is_named(monkeypatch):
    """JAX raises a bare AssertionError for cuda if a plugin for GPUs is missing."""

    def fail():
        raise AssertionError

    monkeypatch.setattr(jax, "devices", fail)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    text = "JAX_PLATFORMS=cuda: this machine has no such device; unset it or use cpu"
    assert describe_error(AssertionError(), []) == text
    monkeypatch.undo()
    assert describe_error(AssertionError(), []) is None  # another fault of this package, with its traceback
