"""Receive orders from the supervisor."""

from ..errors import MessageError
from ..transport.bus import Bus
from .messages import unpack_note
from .realtime import ParentWatch


def wait_for_take_off(bus: Bus, parent: ParentWatch) -> float | None:
    """Wait for the order to take off; return the time of the first tick on the monotonic clock [s].

    Return None if the supervisor ends before it gives this order.
    """
    while not parent.has_ended(0.01):
        message = bus.latest("order")
        try:
            epoch = None if message is None else unpack_note(message.data, "order").get("epoch")
        except MessageError:
            continue
        if epoch is not None:
            return float(epoch)
    return None
