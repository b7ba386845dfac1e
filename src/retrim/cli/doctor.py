"""``retrim doctor``: is this installation fit to fly?"""

import threading
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from rich.table import Table

from ..experiments.provenance import commit, describe_hardware, versions
from .console import console

EXCLUDED = "0.10.2"


def doctor() -> Callable[[threading.Event], int]:
    """Print versions, device and cache, and look for the known faults of dependencies; exit code 1 if one is there."""
    return lambda stop: _doctor()


def _doctor() -> int:
    wrong = sum(wrong_rows(n, jnp.dtype("float32")) for n in (1_000, 16_385, 32_769))
    if wrong:
        verdict = f"[bold red]wrong[/]: {wrong} rows of a batched product; another version of jax is needed"
    else:
        verdict = "[green]right[/]"
    shown = Table(show_header=False)
    for name, value in (
        ("commit", commit()),
        *versions().items(),
        ("machine", describe_hardware()),
        ("compile cache", str(jax.config.values["jax_compilation_cache_dir"])),
        ("batched products (jax-ml/jax#39103)", verdict),
    ):
        shown.add_row(name, value)
    console.print(shown)
    return 1 if wrong else 0


def wrong_rows(n: int, dtype: jnp.dtype) -> int:
    """Rows that ``jit`` gets wrong of: rotate n vectors (0 ... n-1, 0, 0) by the identity, square, sum.

    jax 0.10.2 returns another row's result once the batch is large enough (jax-ml/jax#39103). Row i must be i^2,
    exactly in float64 and to rounding in float32.
    """
    rows = np.zeros((n, 3))
    rows[:, 0] = np.arange(n)
    identity = jnp.eye(3, dtype=dtype)

    def one(y: Float[Array, "3"]) -> Float[Array, ""]:
        return jnp.sum((identity @ y) ** 2)

    found = np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(rows, dtype=dtype)), dtype=np.float64)
    expected = np.arange(n, dtype=np.float64) ** 2
    tolerance = 0.0 if dtype == jnp.float64 else 1e-6
    return int(np.sum(np.abs(found - expected) > tolerance * expected))
