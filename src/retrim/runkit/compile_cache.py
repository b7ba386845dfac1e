"""Manages JAX's persistent cache of compiled programs, in the user's cache folder."""

import gc
import os
import sys
import warnings
from pathlib import Path

import jax

MAPS = Path("/proc/self/maps")
MOST_MAPS = 30_000  # Linux allows a process 65,530 memory maps; at the limit the process crashes


def release_programs(above: int = MOST_MAPS) -> bool:
    """Release compiled programs if the process has more than ``above`` memory maps; they are reloaded when needed.

    Each program occupies several maps. Making a long table compiles thousands of programs, one set for each condition.

    Returns:
        Whether the programs were released.
    """
    try:
        many = MAPS.read_bytes().count(b"\n") > above
    except OSError:  # the system has no such file
        return False
    if many:
        jax.clear_caches()
        gc.collect()
    return many


def enable_compile_cache() -> Path | None:
    """Keep compiled programs in the user's cache folder, unless JAX already has a cache folder.

    Each version of jax has its own folder. ``RETRIM_COMPILE_CACHE=0`` switches the cache off. A cache error does not
    stop a program; the program is compiled again. A folder that cannot be written is only read.

    Returns:
        The folder; None if there is no cache.
    """
    if jax.config.values["jax_compilation_cache_dir"] or os.environ.get("RETRIM_COMPILE_CACHE") == "0":
        return None
    try:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = home / "retrim" / f"jax-{jax.__version__}"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError) as error:  # RuntimeError: neither HOME nor an entry of the user exists
        warnings.warn(f"no compile cache: {error}", stacklevel=2)
        return None
    # JAX warns of each program that it fails to write; no program takes so long to compile that it writes this one.
    shortest = 0.0 if os.access(folder, os.W_OK) else sys.float_info.max
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", shortest)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    jax.config.update("jax_raise_persistent_cache_errors", False)
    return folder
