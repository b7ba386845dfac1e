"""Positive definite systems: solutions alone and in batches, and no deadlock of threads that solve batches at once."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from retrim.learn.residuals.linear_systems import solve_positive

BATCHES_AT_ONCE = """
import os, threading
import jax, jax.numpy as jnp
from jax import lax
from retrim.learn.residuals.linear_systems import solve_positive

@jax.jit
def solve_often(matrices, right):
    def again(_, right):
        change = 1e-6 * right[:, :1, :1]
        return 0.5 * jax.vmap(solve_positive)(matrices + change, right)[0] + 0.5
    return lax.fori_loop(0, 100, again, right)

matrices, right = jnp.eye(193)[None] + jnp.zeros((12, 1, 1)), jnp.ones((12, 193, 3))
solve_often(matrices, right).block_until_ready()
cores = len(os.sched_getaffinity(0))
threads = [threading.Thread(target=lambda: solve_often(matrices, right).block_until_ready()) for _ in range(cores)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
"""


def systems(key, n=7, count=4):
    k_root, k_vector, k_matrix = random.split(key, 3)
    roots = random.normal(k_root, (count, n, n))
    matrices = roots @ jnp.swapaxes(roots, 1, 2) + jnp.eye(n)[None]
    return matrices, random.normal(k_vector, (count, n)), random.normal(k_matrix, (count, n, 3))


def test_solutions_fulfil_their_systems(key):
    (matrix, *_), (vector, *_), (right, *_) = systems(key)
    x, y = solve_positive(matrix, vector, right)
    np.testing.assert_allclose(matrix @ x, vector, atol=1e-12)
    np.testing.assert_allclose(matrix @ y, right, atol=1e-12)


@pytest.mark.parametrize("axes", [(0, 0, 0), (0, None, 0), (None, 0, None)])
def test_batch_equals_systems_alone(key, axes):
    """Also if the systems share a matrix or a right-hand side."""
    arrays = [part if axis == 0 else part[0] for part, axis in zip(systems(key), axes, strict=True)]
    x, y = jax.jit(jax.vmap(solve_positive, in_axes=axes))(*arrays)
    for i in range(4):
        alone = solve_positive(*(part[i] if axis == 0 else part for part, axis in zip(arrays, axes, strict=True)))
        np.testing.assert_allclose(x[i], alone[0], atol=1e-12)
        np.testing.assert_allclose(y[i], alone[1], atol=1e-12)


def test_batch_of_batches(key):
    matrices, vectors, _ = systems(key)
    (x,) = jax.vmap(jax.vmap(solve_positive, in_axes=(0, None)), in_axes=(None, 0))(matrices, vectors)
    np.testing.assert_allclose(jnp.einsum("mij,vmj->vmi", matrices, x), vectors[:, None] + 0.0 * x, atol=1e-12)


def test_threads_that_solve_batches_at_once_do_not_wait_for_ever():
    """A batch of LAPACK calls waits inside a thread of JAX; one such batch per core stopped the process before."""
    subprocess.run([sys.executable, "-c", BATCHES_AT_ONCE], timeout=90.0, check=True)
