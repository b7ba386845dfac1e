"""How JAX's compiler works for a command: flags that must be set before JAX begins."""

import os
from importlib.metadata import entry_points, version

from .compile_cache import enable_compile_cache

LONG = ("reproduce", "sweep", "gauntlet", "bench")
"""Commands that compute for minutes or hours. Workers of a cluster, which no command starts, compile as they do."""
QUICK = ("--xla_cpu_use_fusion_emitters=false", "--xla_backend_optimization_level=1")
KNOWN = ("0.8.", "0.9.", "0.10.")
"""Releases of jaxlib that were tried: later ones end a process for the first of these flags."""


def compile_for(command: str) -> None:
    """Keep compiled programs in the user's cache, and have those of a short command compiled quickly.

    Compiling takes half the time then, and what is compiled runs up to a sixth slower; most commands are over in
    seconds. What ``XLA_FLAGS`` says already stands. Nothing changes where JAX has an accelerator's plugin.

    Args:
        command: Its name.
    """
    if command not in LONG and version("jaxlib").startswith(KNOWN) and not entry_points(group="jax_plugins"):
        given = os.environ.get("XLA_FLAGS", "")
        new = [flag for flag in QUICK if flag.partition("=")[0] not in given]
        os.environ["XLA_FLAGS"] = " ".join([*given.split(), *new])
    enable_compile_cache()
