"""Import JAX, which rejects wrong values of its environment variables with errors of its own."""

import os

from .errors import ConfigError


def import_jax() -> None:
    """Import JAX.

    Raises:
        ConfigError: An environment variable has a value that JAX does not accept.
    """
    try:
        import jax  # noqa: F401
    except ValueError as error:
        for name, value in os.environ.items():
            if name.startswith("JAX_") and name.lower() in str(error).lower():
                raise ConfigError(f"{name}={value}: JAX does not accept this value; unset or correct it") from error
        raise
