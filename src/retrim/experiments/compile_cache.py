"""JAX's persistent cache of compiled programs, in the user's cache folder."""

import gc
import os
import warnings
from pathlib import Path

import jax

MAPS = Path("/proc/self/maps")
ENOUGH = 30_000  # of the 65,530 memory maps that Linux lets a process have; at the limit it dies of a fault


def release_programs(above: int = ENOUGH) -> bool:
    """Give compiled programs back if they hold more than so many memory maps; they are loaded again when needed.

    Each program holds some. A long table compiles thousands, one set for each of its conditions.

    Returns:
        Whether they were given back.
    """
    try:
        many = MAPS.read_bytes().count(b"\n") > above
    except OSError:  # a system that has no such file
        return False
    if many:
        jax.clear_caches()
        gc.collect()
    return many


def enable_compile_cache() -> Path | None:
    """Keep compiled programs in the user's cache folder, unless JAX was told otherwise.

    One folder per version of jax. ``RETRIM_COMPILE_CACHE=0`` switches it off. A fault of the cache never stops a
    program: it is compiled again.

    Returns:
        The folder; None if there is no cache.
    """
    if jax.config.values["jax_compilation_cache_dir"] or os.environ.get("RETRIM_COMPILE_CACHE") == "0":
        return None
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = home / "retrim" / f"jax-{jax.__version__}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        warnings.warn(f"no compile cache: {error}", stacklevel=2)
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    jax.config.update("jax_raise_persistent_cache_errors", False)
    return folder
