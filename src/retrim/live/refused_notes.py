"""Count the invalid notes between processes, and report only some of them."""

from collections.abc import Iterable

from ..errors import MessageError
from ..onboard.messages import last_note, unpack_note
from ..transport.bus import Bus

NOTES = ("airborne", "beat.", "ended", "followed", "ground", "knobs", "learner.", "learning", "order", "ready.",
         "refusals.", "stalls", "status", "wish", "world")  # fmt: skip
"""Names of the topics of notes, or prefixes of these names."""
PAGE, NETWORK = "refusals.page", "refusals.network"
"""Topics with the number of browser inputs that the page refused and of network messages that the bridge refused."""


class RefusedNotes:
    """Checks each new note on a bus once. Readers of notes also ignore the notes that this class refuses."""

    def __init__(self, bus: Bus, topics: Iterable[str]) -> None:
        """Initialise for a bus.

        Args:
            bus: Bus of the flight.
            topics: Topics of the bus; topics without notes are left out.
        """
        self.count = 0
        """Number of refused notes and inputs so far."""
        self._bus, self._versions = bus, {topic: 0 for topic in topics if topic.startswith(NOTES)}
        self._refusals, self._report_counts = dict.fromkeys(self._versions, 0), dict[str, int]()

    def look(self) -> list[str]:
        """Return one line for each topic that has reached its 1st, 10th, 100th, etc. refusal since the last call."""
        lines = []
        for topic, version in self._versions.items():
            message = self._bus.latest(topic, version)
            if message is None:
                continue
            self._versions[topic] = message.version
            try:
                unpack_note(message.data, "ready" if topic.startswith("ready.") else topic)
            except MessageError as error:
                lines += self._count(topic, 1, str(error))
            else:
                lines += self._count_refusals(topic) if topic in (PAGE, NETWORK) else []
        return lines

    def _count_refusals(self, topic: str) -> list[str]:
        """Count the new refusals that a process has published."""
        note = last_note(self._bus, topic)
        before, now = self._report_counts.get(topic, 0), note.get("count", 0)
        self._report_counts[topic] = now
        more = now - before if now >= before else now  # the process was restarted
        return self._count(topic, more, note.get("last", "")) if more else []

    def _count(self, topic: str, more: int, why: str) -> list[str]:
        before, now = self._refusals[topic], self._refusals[topic] + more
        self._refusals[topic], self.count = now, self.count + more
        source = topic.partition(".")[2] if topic in (PAGE, NETWORK) else f"note {topic}"
        return [f"{source}: {why}; {now} so far"] if len(str(now)) > len(str(before)) or not before else []
