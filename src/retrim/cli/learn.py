"""``retrim learn``."""

import signal
import threading
from collections.abc import Callable

import tyro

from ..errors import ConfigError
from ..live.ground import learn_for
from ..transport.remote import Address
from .console import RichReporter, console


def learn(addresses: tyro.conf.Positional[tuple[str, ...]]) -> Callable[[threading.Event], int]:
    """Learn for flights on other machines: `retrim live --learners ADDRESS` flies one.

    For several flights one process learns for all that are due at once. Ctrl-C ends it; the flights go on with their
    last policies.

    Args:
        addresses: Where the flights are: zenoh:HOST:PORT of a machine that flies, or ros:HOST:PORT of a rosmaster;
            several vehicles at one rosmaster have a key each, as in ros:HOST:PORT/quad1.
    """

    def ordered(stop: threading.Event) -> int:
        signal.signal(signal.SIGTERM, lambda *_: stop.set())
        found = [Address.of(address) for address in addresses]
        if not found:
            raise ConfigError("no address; one is zenoh:HOST:PORT or ros:HOST:PORT")
        with RichReporter().progress(", ".join(addresses)) as advance:
            last = learn_for(found, stop, lambda text: advance(0.5, text))
        console.print(last, markup=False, soft_wrap=True)
        return 0

    return ordered
