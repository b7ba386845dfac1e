"""Learners on another machine, as the flight sees them."""

import contextlib
import time
from pathlib import Path

from ..errors import MessageError
from ..onboard.messages import unpack_note
from ..transport.bus import Bus
from .mission import Mission
from .spec import LiveSpec
from .topics import topics

LOST = 2.0  # [s] without a word


class RemoteLearners:
    """Tells them what to learn for, and knows which of them live."""

    def __init__(self, spec: LiveSpec, bus: Bus) -> None:
        """Build it for a flight and its bus."""
        self._spec, self._bus = spec, bus
        self._missions, self._beat = 0, (0, 0.0)

    def announce(self, start: Path) -> None:
        """Publish what they have to know; the policy's learner starts again from ``start``."""
        s, self._missions = self._spec, self._missions + 1
        mission = Mission.of(self._missions, s.reference, s.seed, s.controller.base, s.layers, topics(s), start)
        self._bus.publish("mission", mission.pack())

    def alive(self) -> dict[str, bool]:
        """Return which learners live, by what their machine said last."""
        message, said = self._bus.latest("ground"), {}
        if message is not None:
            if message.version != self._beat[0]:
                self._beat = message.version, time.monotonic()
            with contextlib.suppress(MessageError):
                said = unpack_note(message.data, "ground").get("alive", {})
        fresh = time.monotonic() - self._beat[1] < LOST
        return {layer: fresh and bool(said.get(layer)) for layer in self._spec.layers}
