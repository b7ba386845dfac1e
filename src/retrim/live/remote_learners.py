"""The flight's interface to learners on another machine."""

import time
from pathlib import Path

from ..onboard.messages import last_note
from ..transport.bus import Bus
from ..transport.network import DISTRUST, FAREWELL
from .learner_mission import LearnerMission
from .refused_notes import NETWORK
from .spec import LiveSpec
from .topics import topics

LOST = 2.0  # [s] without a message, after which learners count as lost
PARTING_TIME = 5.0  # [s], time limit for the learners to confirm the end of the flight


class RemoteLearners:
    """Publishes missions for remote learners and monitors which learners are alive."""

    def __init__(self, spec: LiveSpec, bus: Bus) -> None:
        """Initialise for a flight and its bus."""
        self._spec, self._bus = spec, bus
        self._missions, self._beat = 0, (0, 0.0)
        self._distrust: float | None = None

    def announce(self, start: Path) -> None:
        """Publish a new mission; the policy learner restarts from ``start``."""
        s, self._missions = self._spec, self._missions + 1
        message = self._bus.latest("parameters.policy")
        floor = 0 if message is None else message.version
        mission = LearnerMission.of(
            self._missions, s.reference, s.seed, s.controller.base, s.layers, floor, topics(s), start
        )
        self._bus.publish("mission", mission.pack())

    def alive(self) -> dict[str, bool]:
        """Return whether each learner is alive according to the last message from the learners' machine."""
        message, note = self._bus.latest("ground"), None
        if message is not None:
            if message.version != self._beat[0]:
                self._beat = message.version, time.monotonic()
            note = last_note(self._bus, "ground").get("alive")
        fresh = time.monotonic() - self._beat[1] < LOST
        return {layer: fresh and isinstance(note, dict) and bool(note.get(layer)) for layer in self._spec.layers}

    def ready(self, layer: str) -> bool:
        """Return whether a learner is ready for this flight rather than for an earlier one."""
        return last_note(self._bus, f"ready.{layer}", "ready").get("base") == self._spec.controller.base

    def failed(self) -> str | None:
        """Return why the learners cannot learn, e.g. a wrong key or a dead learner's last output; None if they can."""
        fault = last_note(self._bus, NETWORK).get("fault", "")
        self._distrust = (self._distrust or time.monotonic()) if fault else None
        if self._distrust is not None and time.monotonic() > self._distrust + DISTRUST:
            return f"{self._spec.learners}: {fault}"
        note = last_note(self._bus, "ground")
        words = note.get("failed")
        if note.get("base") != self._spec.controller.base or not isinstance(words, str) or not words:
            return None
        return words

    def part(self) -> None:
        """Wait until the learners confirm the end of the flight or are gone.

        The learners run until they receive the note about the end of the flight.
        """
        base, began = self._spec.controller.base, time.monotonic()
        while (waiting_time := time.monotonic() - began) < PARTING_TIME:
            note = last_note(self._bus, "ground")
            if note.get("over") and note.get("base") == base:
                return
            if waiting_time > FAREWELL and not any(self.alive().values()):  # their last message may be in transit
                return
            time.sleep(0.02)
