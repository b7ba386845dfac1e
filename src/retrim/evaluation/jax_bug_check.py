"""Tests for a fault in one version of JAX."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

EXCLUDED_VERSION = "0.10.2"
"""Version of JAX that computes wrong results on the CPU."""


def wrong_rows(n: int, dtype: jnp.dtype) -> int:
    """Return the number of rows that ``jit`` computes incorrectly.

    The program rotates n vectors by the identity, and sums the squares of each. Row i is the vector (i, 0, 0), and its
    result must be i^2, exactly in float64 and to rounding in float32. jax 0.10.2 returns a different row's result once
    the batch is large enough (jax-ml/jax#39103).
    """
    rows = np.zeros((n, 3))
    rows[:, 0] = np.arange(n)
    identity = jnp.eye(3, dtype=dtype)

    def one(y: Float[Array, "3"]) -> Float[Array, ""]:
        return jnp.sum((identity @ y) ** 2)

    with jax.default_matmul_precision("float32"):  # intended rounding is not a fault
        result = np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(rows, dtype=dtype)), dtype=np.float64)
    expected = np.arange(n, dtype=np.float64) ** 2
    tolerance = 0.0 if dtype == jnp.float64 else 1e-6
    return int(np.sum(np.abs(result - expected) > tolerance * expected))
