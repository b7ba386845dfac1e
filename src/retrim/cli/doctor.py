"""``retrim doctor``: check the installation."""

import threading
from collections.abc import Callable

import jax
import jax.numpy as jnp

from ..evaluation.jax_bug_check import wrong_rows
from ..runkit.document import TableSection
from ..runkit.provenance import commit, describe_hardware, versions
from .console import show_table


def doctor() -> Callable[[threading.Event], int]:
    """Print versions, devices and cache, and check dependencies for known faults; exit with code 1 if any is found."""
    return lambda stop: _doctor()


def _doctor() -> int:
    wrong = sum(wrong_rows(n, jnp.dtype("float32")) for n in (1_000, 16_385, 32_769))
    verdict = f"**wrong**: {wrong} rows of a batched product; another version of jax is needed" if wrong else "right"
    rows = (
        ("commit", commit()),
        *versions().items(),
        ("machine", describe_hardware()),
        ("devices of JAX", f"{jax.device_count()}, {jax.default_backend()}"),
        ("compile cache", str(jax.config.values["jax_compilation_cache_dir"])),
        ("batched products (jax-ml/jax#39103)", verdict),
    )
    show_table(TableSection(("part", "value"), rows))
    return 1 if wrong else 0
