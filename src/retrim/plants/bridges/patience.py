"""Waiting for a vehicle, which nobody can hurry."""

import math
import time
from collections.abc import Callable

from ...errors import PlantError

KeepOn = Callable[[], bool]
"""Asked again and again."""
NAP_S = 0.01  # [s] between two questions


def wait_until(done: KeepOn, patience: float, keep_on: KeepOn, wait: Callable[[float], object]) -> bool:
    """Wait until something is so; return whether it is.

    Args:
        done: Whether it is so.
        patience: How long to wait at most [s].
        keep_on: Asked again and again; False gives up.
        wait: Keeps the link alive until an instant of the monotonic clock [s].

    Raises:
        PlantError: ``keep_on`` says no: the flight was given up.
    """
    until = time.monotonic() + patience
    while time.monotonic() < until:
        if done():
            return True
        if not keep_on():
            raise PlantError("the flight was given up before the hand-over")
        wait(time.monotonic() + NAP_S)
    return False


def insisting(order: Callable[[], object], done: KeepOn, every: float) -> KeepOn:
    """Return a question that gives an order again and again, since it may be lost, until something is so.

    Args:
        order: Gives it.
        done: Whether it is so; asked before each time.
        every: Time between two orders [s].
    """
    given = -math.inf

    def obeyed() -> bool:
        nonlocal given
        if done():
            return True
        if time.monotonic() - given > every:
            given = time.monotonic()
            order()
        return False

    return obeyed
