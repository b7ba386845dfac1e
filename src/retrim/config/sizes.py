"""Parse names with a size, e.g. ``wind=6``."""

from ..errors import ConfigError, excerpt


def name_and_size(text: str, kind: str) -> tuple[str, float | None]:
    """Split a name with an optional size.

    Args:
        text: Name, e.g. ``wind`` or ``wind=6``.
        kind: Kind of the named object, for error messages.

    Returns:
        The name, and the size or None.

    Raises:
        ConfigError: The size is not a number.
    """
    name, equals, size = text.partition("=")
    try:
        return name, float(size) if equals else None
    except ValueError as error:
        raise ConfigError(f"{kind} {excerpt(text)}: {excerpt(size)} is not a number") from error
