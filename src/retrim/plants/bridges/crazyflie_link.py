"""One end of a connection to a Crazyflie: what it logs, and what it is told.

Nothing here decides when to arm or who flies; :mod:`.crazyflie` does.
"""

import math
import struct
import time
from collections import deque

from ...errors import MessageError, PlantError
from . import crtp
from .clock import ArrivalClock
from .crtp import Packet
from .endpoint import Endpoint, pump
from .patience import KeepOn, insisting, wait_until
from .vehicle_state import Reading

STATES, STATUSES = 1, 2  # numbers of our blocks of the log
STATE_S, STATUS_S = 0.01, 0.05  # [s] between two of them
ECHO_S = 0.1  # [s] between two questions of how long a packet takes
AGAIN_S = 0.2  # [s] after which a question that is not answered is asked again
WRAP_MS = 1 << 24  # of its time
LATE_S, EARLY_S = 0.5, 1.0  # [s] by which its time may go back and ahead of ours, from one message to the next
LEAP, LEAPS_S, FASTEST = 1.0, 0.5, 20.0  # [m] that no state is from the last one; [s] it is believed for; [m/s]


class CrazyflieLink:
    """Listens, remembers the last of everything, and keeps the connection alive."""

    def __init__(self, endpoint: Endpoint, to: tuple[str, int]) -> None:
        """Build one end.

        Args:
            endpoint: Where packets come from and go to.
            to: Address of the Crazyflie; everybody else is ignored.
        """
        self._endpoint, self._to = endpoint, to
        self._clock, self._trips = ArrivalClock(), deque[float](maxlen=20)
        self._remote_ms, self._logged_at = 0, -math.inf
        self._echo_due = 0.0
        self._awaited: Packet | None = None
        self._answer: bytes | None = None
        self.version = 0
        """Of its protocol; 0 before it was asked."""
        self.reading: Reading | None = None
        self.status: crtp.Status | None = None
        self.thrusts: deque[float] = deque(maxlen=100)
        """What its controller commanded, 0 to 65535."""
        self.console = ""
        """The end of what it said in words."""
        self.heard = -math.inf
        """When it said anything last, monotonic clock [s]."""
        self.ignored = 0
        """Packets of strangers, and those that are damaged or make no sense."""

    def pump(self, until: float) -> None:
        """Read what comes, and say what has to be said now and then, until an instant of the monotonic clock [s]."""
        pump(self._endpoint, until, self._chores, self._take)

    def send(self, packet: Packet) -> None:
        """Send a packet; nobody says whether it arrives."""
        self._endpoint.send(packet.pack(), self._to)

    def ask(self, question: Packet, same: int, patience: float, keep_on: KeepOn) -> bytes:
        """Return the answer to a question, which is asked until it comes.

        Args:
            question: What is asked; its answer comes from the same port and channel.
            same: How many bytes of the question the answer begins with.
            patience: How long to ask [s].
            keep_on: Asked again and again; False gives up.

        Returns:
            What follows the bytes that are the same.

        Raises:
            PlantError: There is no answer, or the flight was given up.
        """
        self._awaited, self._answer = question._replace(body=question.body[:same]), None
        asking = insisting(lambda: self.send(question), lambda: self._answer is not None, AGAIN_S)
        try:
            if not wait_until(asking, patience, keep_on, self.pump) or self._answer is None:
                raise PlantError(f"the Crazyflie does not answer on port {question.port} in {patience:g} s")
            return self._answer
        finally:
            self._awaited = None

    def start_logs(self, patience: float, keep_on: KeepOn) -> None:
        """Ask for states and statuses, as long as the connection lives.

        Raises:
            PlantError: It does not answer, or does not know a variable.
        """
        self.version = self.ask(Packet(crtp.PLATFORM, 1, b"\0"), 1, patience, keep_on)[0]
        self.ask(Packet(crtp.LOG, crtp.CONTROL, bytes([crtp.RESET])), 1, patience, keep_on)
        blocks = {STATES: (crtp.STATE_LOG, STATE_S), STATUSES: (crtp.STATUS_LOG, STATUS_S)}
        numbers = self._numbers({name for log, _ in blocks.values() for name in log}, patience, keep_on)
        for block, (log, period) in blocks.items():
            made = crtp.new_block(block, [(kind, numbers[name]) for name, kind in log.items()])
            for order in (*made, crtp.start_block(block, period)):
                refused = self.ask(order, 2, patience, keep_on)[0]
                if refused:
                    raise PlantError(f"the Crazyflie refuses a block of its log: error {refused}")

    def stop_logs(self) -> None:
        """Ask it to be silent."""
        self.send(Packet(crtp.LOG, crtp.CONTROL, bytes([crtp.RESET])))

    def close(self) -> None:
        """Give the port back."""
        self._endpoint.close()

    def _numbers(self, wanted: set[str], patience: float, keep_on: KeepOn) -> dict[str, int]:
        """Return the numbers of variables, from its table of contents."""
        about = self.ask(Packet(crtp.LOG, crtp.TOC, bytes([crtp.INFO])), 1, patience, keep_on)
        length, found = int.from_bytes(about[:2], "little"), dict[str, int]()
        for number in range(length):
            asked = bytes([crtp.ITEM]) + struct.pack("<H", number)
            item = self.ask(Packet(crtp.LOG, crtp.TOC, asked), 3, patience, keep_on)
            name = item[1:].rstrip(b"\0").replace(b"\0", b".").decode(errors="replace")
            if name in wanted:
                found[name] = number
            if len(found) == len(wanted):
                return found
        raise PlantError(f"the Crazyflie logs no {', '.join(sorted(wanted - set(found)))}; its firmware is too old")

    def _chores(self, now: float) -> None:
        if now >= self._echo_due:
            self._echo_due = now + ECHO_S
            self.send(Packet(crtp.LINK, 0, struct.pack("<d", now)))

    def _take(self, data: bytes, sender: object) -> None:
        now = time.monotonic()
        if sender != self._to:
            self.ignored += 1
            return
        try:
            self._understand(crtp.unpacked(data), now)
        except MessageError:
            self.ignored += 1
            return
        self.heard = now

    def _understand(self, packet: Packet, now: float) -> None:
        port, channel, body = packet
        if port == crtp.LINK and channel == 0 and len(body) == 8:
            trip = now - struct.unpack("<d", body)[0]
            if not 0.0 <= trip < 1.0:
                raise MessageError("an echo of nothing that was said")
            self._trips.append(trip)
        elif port == crtp.LOG and channel == crtp.DATA:
            self._logged(body, now)
        elif port == crtp.CONSOLE and channel == 0:
            self.console = (self.console + body.decode(errors="replace"))[-300:]
        elif (
            (asked := self._awaited) is not None
            and (port, channel) == asked[:2]
            and body.startswith(asked.body)
            and len(body) > len(asked.body)
        ):
            self._answer = body[len(asked.body) :]

    def _logged(self, body: bytes, now: float) -> None:
        if len(body) < 4:
            raise MessageError("a log without a time")
        block, ms, values = body[0], int.from_bytes(body[1:4], "little"), body[4:]
        on = (ms - self._remote_ms + WRAP_MS // 2) % WRAP_MS - WRAP_MS // 2
        if self.reading is not None and not -LATE_S < 1e-3 * on < now - self._logged_at + EARLY_S:
            raise MessageError("a log of another time")
        if block == STATES:
            self._take_state(crtp.state_of(values), self._remote_ms + on, now)
        elif block == STATUSES:
            self.status = crtp.status_of(values)
            self.thrusts.append(self.status.thrust)
        else:
            raise MessageError("a block of a log that nobody asked for")

    def _take_state(self, x: crtp.StateRow, ms: int, now: float) -> None:
        """Take a state; one that no vehicle could have got to is not believed while others are."""
        last, since = self.reading, now - self._logged_at
        if last is not None and since < LEAPS_S and abs(x.p - last.p).max() > LEAP + FASTEST * since:
            raise MessageError("a state that is far from the last one")
        self._clock.arrived(1e-3 * ms, now)
        here = self._clock.here(1e-3 * ms)
        assert here is not None
        stamp = here - 0.5 * min(self._trips, default=0.0)
        if ms > self._remote_ms or last is None:  # and not overtaken on the way
            self._remote_ms, self._logged_at = ms, now
            self.reading = Reading(stamp, *x)

    def said(self) -> str:
        """Return what it said in words, to be put behind a reason."""
        words = " ".join(self.console.split())
        return f"; it said: {words}" if words else ""
