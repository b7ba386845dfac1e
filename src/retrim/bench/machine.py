"""Measure the machine's own rate, so that relative figures can be compared between machines."""

import os
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

ROWS, WIDTH, STEPS = 10, 512, 1000
UNIT_FLOP = 2.0 * ROWS * WIDTH * WIDTH * STEPS
"""Number of operations in a unit: a scan of 1,000 products of 10 rows and a 512 x 512 matrix. Such products dominate a
roll-out."""


def on_core(i: int) -> None:
    """Keep this process and the threads that JAX will start on one of the cores available to the process.

    Args:
        i: Index of the core; -1 for the last core.

    Raises:
        OSError: The system does not let a process choose its core.
    """
    if not hasattr(os, "sched_setaffinity"):
        raise OSError("this system does not let a process choose its core")
    os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[i]})


def last_core() -> int:
    """Return the number of the last core available to this process.

    Raises:
        OSError: The system does not let a process choose its core.
    """
    if not hasattr(os, "sched_getaffinity"):
        raise OSError("this system does not let a process choose its core")
    return max(os.sched_getaffinity(0))


def unit() -> Callable[[], float]:
    """Return a function that measures the current time of one unit [s], as the median of three runs."""
    rows, weight = jnp.ones((ROWS, WIDTH)), jnp.full((WIDTH, WIDTH), 1.0 / WIDTH)

    @jax.jit
    def scan(x: Any, weight: Any) -> Any:  # a constant weight would get the layout of a different kind of product
        return lax.scan(lambda x, _: (x @ weight, None), x, None, length=STEPS)[0]

    jax.block_until_ready(scan(rows, weight))
    return lambda: statistics.median(seconds(lambda: scan(rows, weight)) for _ in range(3))


def rates() -> dict[str, float]:
    """Return the machine's rates for a large matrix product, the product of a roll-out, and a memory copy."""
    large, long = jnp.ones((2048, 2048)), jnp.ones(2**25)
    product, copy = jax.jit(lambda a: a @ a), jax.jit(lambda a: a + 1.0)
    return {
        "product": 2.0 * 2048.0**3 / _median(lambda: product(large), 7) / 1e9,
        "rows": UNIT_FLOP / unit()() / 1e9,
        "copy": 2.0 * long.nbytes / _median(lambda: copy(long), 7) / 1e9,
    }


def _median(run: Callable[[], Any], runs: int) -> float:
    jax.block_until_ready(run())
    return statistics.median(seconds(run) for _ in range(runs))


def seconds(run: Callable[[], Any]) -> float:
    """Return the duration of a run [s]."""
    began = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - began
