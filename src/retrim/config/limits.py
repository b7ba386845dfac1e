"""Checks seeds, the number of starts and flight lengths against limits, before any training."""

from collections.abc import Sequence

from ..errors import ConfigError, excerpt

MAX_SEED, MAX_STARTS, MAX_SECONDS = 2**32 - 1, 100_000, 36_000.0


def check_seeds(seeds: Sequence[int], what: str = "seed") -> None:
    """Check the seeds of a run.

    Args:
        seeds: The seeds.
        what: What the seeds are, for the message.

    Raises:
        ConfigError: The list is empty or contains duplicates, or a seed is negative or exceeds 32 bits.
    """
    for seed in seeds:
        if not 0 <= seed <= MAX_SEED:
            raise ConfigError(f"{what} {seed}: must be 0 to {MAX_SEED}")
    if not seeds or len(set(seeds)) < len(seeds):
        raise ConfigError(f"seeds {', '.join(map(str, seeds)) or 'none'}: at least one is needed, and each only once")


def check_once(names: Sequence[str], message: str) -> None:
    """Check that each name is in a list only once, so that no flight counts twice and no row mixes different things.

    Args:
        names: The list.
        message: Text of the error, with ``{}`` for the name.

    Raises:
        ConfigError: A name is in the list more than once.
    """
    if twice := [name for i, name in enumerate(names) if name in names[:i]]:
        raise ConfigError(message.format(excerpt(twice[0])))


def check_flights(starts: int, seconds: float | None) -> None:
    """Check the number and the length of flights.

    Args:
        starts: Number of flights per scenario, method and seed.
        seconds: Length of a flight [s]; None for the task's own.

    Raises:
        ConfigError: One of the values is out of range.
    """
    if not 1 <= starts <= MAX_STARTS:
        raise ConfigError(f"{starts} starts: must be 1 to {MAX_STARTS}")
    if seconds is not None and not 1.0 <= seconds <= MAX_SECONDS:
        raise ConfigError(f"flights of {seconds:g} s: must be 1 s to {MAX_SECONDS:g} s long")
