"""Sets flags for JAX's compiler, chosen by command; they must be set before JAX starts."""

import os
from importlib.metadata import entry_points, version

from .compile_cache import enable_compile_cache

LONG_COMMANDS = ("reproduce", "sweep", "gauntlet", "bench")
"""Commands that compute for minutes or hours. Cluster workers, which no command starts, use the same flags."""
QUICK = ("--xla_cpu_use_fusion_emitters=false", "--xla_backend_optimization_level=1")
KNOWN_VERSIONS = ("0.8.", "0.9.", "0.10.")
"""Tested releases of jaxlib; in later ones, the first of these flags aborts the process."""


def compile_for(command: str) -> None:
    """Enable the compile cache; for short commands, also set flags for quick compilation.

    With these flags, compilation takes half the time, and the programs run up to a sixth slower. Most commands finish
    in seconds. Existing ``XLA_FLAGS`` take precedence. The flags are not set if JAX has an accelerator plugin.

    Args:
        command: Name of the command.
    """
    if (
        command not in LONG_COMMANDS
        and version("jaxlib").startswith(KNOWN_VERSIONS)
        and not entry_points(group="jax_plugins")
    ):
        flags = os.environ.get("XLA_FLAGS", "")
        new = [flag for flag in QUICK if flag.partition("=")[0] not in flags]
        os.environ["XLA_FLAGS"] = " ".join([*flags.split(), *new])
    enable_compile_cache()
