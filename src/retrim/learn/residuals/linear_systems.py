"""Solve systems with positive definite matrices, one by one on a CPU.

On a CPU, JAX 0.10 distributes a batch of LAPACK calls to a pool of threads, one per core, and waits for them inside one
of these threads. If several programs do so at the same time, no thread is left, and all of them wait for ever. A call
for a single system needs no other thread.
"""

from collections.abc import Sequence
from typing import Any

import jax
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float


def solve_positive(matrix: Float[Array, "n n"], *right: Float[Array, "n ..."]) -> tuple[Array, ...]:
    """Solve a system for several right-hand sides; ``jax.vmap`` solves a batch without a deadlock.

    Args:
        matrix: Symmetric, positive definite matrix.
        right: Right-hand sides, each a vector or a matrix.

    Returns:
        The solution for each right-hand side.
    """
    result: tuple[Array, ...] = _solve(matrix, right)
    return result


@custom_vmap
def _solve(matrix: Array, right: tuple[Array, ...]) -> tuple[Array, ...]:
    return _factor_and_solve(matrix, right)


def _factor_and_solve(matrix: Array, right: tuple[Array, ...]) -> tuple[Array, ...]:
    factor = jax.scipy.linalg.cho_factor(matrix)
    return tuple(jax.scipy.linalg.cho_solve(factor, each) for each in right)


@_solve.def_vmap
def _solve_batch(
    size: int, is_batched: Sequence[Any], matrix: Array, right: tuple[Array, ...]
) -> tuple[tuple[Array, ...], tuple[bool, ...]]:
    """Solve a batch: as one call on an accelerator, and one system after another on a CPU."""
    parts, flags = (matrix, *right), (is_batched[0], *is_batched[1])
    batched_parts = [part if flag else lax.broadcast(part, (size,)) for part, flag in zip(parts, flags, strict=True)]
    matrices, sides = batched_parts[0], tuple(batched_parts[1:])
    if jax.default_backend() == "cpu":
        solutions = lax.map(lambda system: _solve(*system), (matrices, sides))
    else:
        solutions = jax.vmap(_factor_and_solve)(matrices, sides)
    return solutions, (True,) * len(right)
