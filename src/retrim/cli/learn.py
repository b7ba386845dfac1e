"""``retrim learn``."""

import signal
import threading
from collections.abc import Callable

import tyro

from ..live.ground import Ground
from ..transport.remote import Address
from .console import RichReporter, console


def learn(address: tyro.conf.Positional[str]) -> Callable[[threading.Event], int]:
    """Learn for a flight on another machine: `retrim live --learners ADDRESS` flies it.

    Ctrl-C ends it; the flight goes on with the last policy.

    Args:
        address: Where the flight is: zenoh:HOST:PORT of the machine that flies, or ros:HOST:PORT of a rosmaster.
    """

    def ordered(stop: threading.Event) -> int:
        signal.signal(signal.SIGTERM, lambda *_: stop.set())
        with Ground(Address.of(address)) as ground, RichReporter().progress(address) as advance:
            for _ in ground.wait():
                advance(0.0, "waiting for a flight")
                if stop.is_set():
                    return 0
            last = ""
            for last in ground.learn():
                advance(0.5, last)
                if stop.is_set():
                    break
        console.print(last, markup=False, soft_wrap=True)
        return 0

    return ordered
