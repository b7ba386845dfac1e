"""``retrim learn``."""

import signal
import threading
from collections.abc import Callable
from pathlib import Path

import tyro

from ..errors import printable
from ..live.ground import learn_for
from ..signals import ending_signals
from ..transport.remote import flights_at
from .console import RichReporter, Trust, console


def learn(
    addresses: tyro.conf.Positional[tuple[str, ...]], key: Path | None = None, trust: Trust = ()
) -> Callable[[threading.Event], int]:
    """Learn for flights on other machines: `retrim live --learners ADDRESS` flies one.

    One process learns for several flights, too. Ctrl-C ends it; the flights go on with their last policies.

    Args:
        addresses: Flights: zenoh:HOST:PORT of a machine that flies, or ros:HOST:PORT/quad1 of a rosmaster and vehicle.
        key: File with the key that the flights have, too, or RETRIM_KEY; needed where they are on other machines.
        trust: Python name that a flight may name, as mine:task; its code is run here. Once for each name.
    """

    def ordered(stop: threading.Event) -> int:
        for number in ending_signals()[1:]:
            signal.signal(number, lambda *_: stop.set())
        found = flights_at(addresses, key)
        with RichReporter().progress(", ".join(addresses)) as advance:
            last = learn_for(found, stop, lambda text: advance(0.5, text), trust)
        console.print(printable(last), markup=False, soft_wrap=True)
        return 0

    return ordered
