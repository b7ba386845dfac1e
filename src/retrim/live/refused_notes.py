"""Notes between processes that are none: counted, and told now and then instead of each time."""

from collections.abc import Iterable

from ..errors import MessageError
from ..onboard.messages import last_note, unpack_note
from ..transport.bus import Bus

NOTES = ("airborne", "beat.", "ended", "followed", "ground", "knobs", "learner.", "learning", "order", "ready.",
         "refusals.", "stalls", "status", "wish", "world")  # fmt: skip
"""Topics of notes, or how their names begin."""
PAGE, NETWORK = "refusals.page", "refusals.network"
"""Topics of what the page has refused of a browser, and the bridge of the network."""


class RefusedNotes:
    """Looks at each new note of a bus once. Who reads a note ignores one that is refused here, too."""

    def __init__(self, bus: Bus, topics: Iterable[str]) -> None:
        """Begin to look.

        Args:
            bus: Of the flight.
            topics: Of the bus; those that are no notes are left out.
        """
        self.count = 0
        """Notes and inputs that were refused so far."""
        self._bus, self._known = bus, {topic: 0 for topic in topics if topic.startswith(NOTES)}
        self._refused, self._told_so_far = dict.fromkeys(self._known, 0), dict[str, int]()

    def look(self) -> list[str]:
        """Return what has been refused since the last look, in words; a topic is told 1, 10, 100 times and so on."""
        said = []
        for topic, known in self._known.items():
            message = self._bus.latest(topic, known)
            if message is None:
                continue
            self._known[topic] = message.version
            try:
                unpack_note(message.data, "ready" if topic.startswith("ready.") else topic)
            except MessageError as error:
                said += self._count(topic, 1, str(error))
            else:
                said += self._told(topic) if topic in (PAGE, NETWORK) else []
        return said

    def _told(self, topic: str) -> list[str]:
        """Count what a process has refused by itself."""
        note = last_note(self._bus, topic)
        before, now = self._told_so_far.get(topic, 0), note.get("count", 0)
        self._told_so_far[topic] = now
        more = now - before if now >= before else now  # the process was started again
        return self._count(topic, more, note.get("last", "")) if more else []

    def _count(self, topic: str, more: int, why: str) -> list[str]:
        before, now = self._refused[topic], self._refused[topic] + more
        self._refused[topic], self.count = now, self.count + more
        source = topic.partition(".")[2] if topic in (PAGE, NETWORK) else f"note {topic}"
        return [f"{source}: {why}; {now} so far"] if len(str(now)) > len(str(before)) or not before else []
