"""Describes errors in one line each, for the commands."""

import os
from collections.abc import Sequence

import jax

from ..config.registry import describe_user_error
from ..errors import RetrimError

PLATFORMS = "JAX_PLATFORMS"


def describe_error(error: Exception, words: Sequence[str]) -> str | None:
    """Return the line that describes an error; None for a fault in this package, whose traceback is needed.

    Args:
        error: Exception that was raised.
        words: Words of the command line.
    """
    if isinstance(error, RetrimError):
        return str(error)
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}"
    if isinstance(error, MemoryError):
        return "out of memory; use fewer --starts, smaller networks or a shorter horizon"
    return _describe_missing_device() or describe_user_error(error, words)


def _describe_missing_device() -> str | None:
    """Return a line if JAX has no device; JAX removes the cause from the traceback, so this asks for the devices."""
    try:
        jax.devices()
    except (AssertionError, RuntimeError) as error:
        if platforms := os.environ.get(PLATFORMS):
            return f"{PLATFORMS}={platforms}: this machine has no such device; unset it or use cpu"
        return f"JAX finds no device: {error}"
    return None
