"""Wait until a vehicle satisfies a condition, with a time limit."""

import math
import time
from collections.abc import Callable

from ...errors import PlantError

KeepOn = Callable[[], bool]
"""Condition that is checked repeatedly."""
NAP_S = 0.01  # [s] between two checks


def wait_until(done: KeepOn, patience: float, keep_on: KeepOn, wait: Callable[[float], object]) -> bool:
    """Wait until a condition holds or the time is up; return whether the condition holds.

    Args:
        done: Returns whether the condition holds.
        patience: Longest time to wait [s].
        keep_on: Called repeatedly; the wait is aborted when it returns False.
        wait: Keeps the link alive until an instant on the monotonic clock [s].

    Raises:
        PlantError: ``keep_on`` returned False, so the flight was aborted.
    """
    until = time.monotonic() + patience
    while time.monotonic() < until:
        if done():
            return True
        if not keep_on():
            raise PlantError("the flight was aborted before the hand-over")
        wait(time.monotonic() + NAP_S)
    return False


def insisting(order: Callable[[], object], done: KeepOn, every: float) -> KeepOn:
    """Return a condition that repeats an order until another condition holds, since an order may be lost.

    Args:
        order: Sends the order.
        done: Returns whether the condition holds; called before each order.
        every: Time between two orders [s].
    """
    last_order = -math.inf

    def is_obedient() -> bool:
        nonlocal last_order
        if done():
            return True
        if time.monotonic() - last_order > every:
            last_order = time.monotonic()
            order()
        return False

    return is_obedient
