"""The fault of jax 0.10.2 on CPU (jax-ml/jax#39103), and the constraint that keeps it out."""

import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from retrim.cli.doctor import EXCLUDED, wrong_rows

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize(
    ("dtype", "n"), [("float32", 1_000), ("float32", 16_385), ("float32", 32_769), ("float64", 16_385)]
)
def test_batched_products_are_right(dtype, n):
    assert wrong_rows(n, jnp.dtype(dtype)) == 0


def test_the_excluded_version_is_not_installed_and_cannot_be():
    assert jax.__version__ != EXCLUDED
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert f"jax>=0.8,!={EXCLUDED}" in project["dependencies"]
    assert f"jax=={EXCLUDED}" not in (ROOT / "constraints.txt").read_text()
