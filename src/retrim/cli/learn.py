"""``retrim learn``: learn for flights on other machines."""

import signal
import threading
from collections.abc import Callable
from pathlib import Path

import tyro

from ..errors import printable
from ..live.learner_server import learn_for
from ..signals import ending_signals
from ..transport.remote import flights_at
from .console import RichReporter, Trust, console


def learn(
    addresses: tyro.conf.Positional[tuple[str, ...]], key: Path | None = None, trust: Trust = ()
) -> Callable[[threading.Event], int]:
    """Learn for flights that `retrim live --learners ADDRESS` starts on other machines.

    One process can learn for several flights. Ctrl-C ends it; the flights continue with their last policies.

    Args:
        addresses: Addresses of the flights: zenoh:HOST:PORT for a flight computer, ros2:DOMAIN/quad1 for a
            domain and a vehicle, or ros:HOST:PORT/quad1 for a rosmaster and a vehicle.
        key: File with the key that the flights also have; by default the key in RETRIM_KEY. Flights on other machines
            need one.
        trust: Python name that a flight may send, e.g. mine:task; its code is run here. Repeat it for each name.
    """

    def execute(stop: threading.Event) -> int:
        for number in ending_signals()[1:]:
            signal.signal(number, lambda *_: stop.set())
        result = flights_at(addresses, key)
        with RichReporter().progress(", ".join(addresses)) as advance:
            last = learn_for(result, stop, lambda text: advance(0.5, text), trust)
        console.print(printable(last), soft_wrap=True)
        return 0

    return execute
