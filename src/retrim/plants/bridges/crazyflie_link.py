"""Connect to a Crazyflie, receive its logs and send packets.

This module does not decide when to arm or which controller flies; :mod:`.crazyflie` does.
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
from .guardian import Guardian, SafeCommands
from .polling import KeepOn, insisting, wait_until
from .vehicle_state import Reading

STATES, STATUSES = 1, 2  # numbers of our log blocks
STATE_S, STATUS_S = 0.01, 0.05  # [s] between two states and between two statuses
ECHO_S = 0.1  # [s] between two measurements of the round-trip time
REPEAT_S = 0.2  # [s] after which an unanswered request is repeated
WRAP_MS = 1 << 24  # [ms], period after which the Crazyflie's time wraps around
LATE_S, EARLY_S = 0.5, 1.0  # [s] by which this time may go back, and run ahead of ours, between two messages
# [m], largest plausible jump between two states; [s] for which the last state is used for this check; [m/s]
LEAP, LEAPS_S, FASTEST = 1.0, 0.5, 20.0


class CrazyflieLink:
    """Receives messages, stores the newest message of each kind, and keeps the connection alive."""

    def __init__(self, endpoint: Endpoint, to: tuple[str, int]) -> None:
        """Build one end of a connection.

        Args:
            endpoint: Endpoint for received and sent packets.
            to: Address of the Crazyflie; other senders are ignored.
        """
        self._endpoint, self._to = endpoint, to
        self._clock, self._trips = ArrivalClock(), deque[float](maxlen=20)
        self._remote_ms, self._log_time = 0, -math.inf
        self._echo_due = 0.0
        self._request: Packet | None = None
        self._answer: bytes | None = None
        self.version = 0
        """Version of the Crazyflie's protocol; 0 until it is requested."""
        self.reading: Reading | None = None
        self.status: crtp.Status | None = None
        self.thrusts: deque[float] = deque(maxlen=100)
        """Thrust commands from the Crazyflie's controller, 0 to 65535."""
        self.console = ""
        """End of the Crazyflie's console output."""
        self.last_message = -math.inf
        """Time of the last valid packet, on the monotonic clock [s]."""
        self.ignored = 0
        """Number of packets that were damaged, implausible or from other senders."""

    def pump(self, until: float) -> None:
        """Read received packets and send periodic ones until an instant on the monotonic clock [s]."""
        pump(self._endpoint, until, self._chores, self._take)

    def send(self, packet: Packet) -> None:
        """Send a packet; its arrival is not confirmed."""
        self._endpoint.send(packet.pack(), self._to)

    def guard(self, commands: SafeCommands) -> Guardian:
        """Start a guardian that sends from the same port to the same Crazyflie."""
        return Guardian(commands, self._endpoint.fileno(), self._to)

    def ask(self, question: Packet, same: int, patience: float, keep_on: KeepOn) -> bytes:
        """Send a request repeatedly until the answer arrives, and return the answer.

        Args:
            question: The request; its answer comes from the same port and channel.
            same: Number of leading bytes of the request that the answer repeats.
            patience: Time limit [s].
            keep_on: Called repeatedly; the wait is given up when it returns False.

        Returns:
            The bytes after the repeated ones.

        Raises:
            PlantError: The Crazyflie does not answer, or the flight was aborted.
        """
        self._request, self._answer = question._replace(body=question.body[:same]), None
        asking = insisting(lambda: self.send(question), lambda: self._answer is not None, REPEAT_S)
        try:
            if not wait_until(asking, patience, keep_on, self.pump) or self._answer is None:
                raise PlantError(f"the Crazyflie does not answer on port {question.port} in {patience:g} s")
            return self._answer
        finally:
            self._request = None

    def start_logs(self, patience: float, keep_on: KeepOn) -> None:
        """Request states and statuses for the duration of the connection.

        Raises:
            PlantError: The Crazyflie does not answer, or does not have a required variable.
        """
        self.version = self.ask(Packet(crtp.PLATFORM, 1, b"\0"), 1, patience, keep_on)[0]
        self.ask(Packet(crtp.LOG, crtp.CONTROL, bytes([crtp.RESET])), 1, patience, keep_on)
        blocks = {STATES: (crtp.STATE_LOG, STATE_S), STATUSES: (crtp.STATUS_LOG, STATUS_S)}
        numbers = self._numbers({name for log, _ in blocks.values() for name in log}, patience, keep_on)
        for block, (log, period) in blocks.items():
            block_request = crtp.new_block(block, [(kind, numbers[name]) for name, kind in log.items()])
            for order in (*block_request, crtp.start_block(block, period)):
                error_code = self.ask(order, 2, patience, keep_on)[0]
                if error_code:
                    raise PlantError(f"the Crazyflie refuses a block of its log: error {error_code}")

    def stop_logs(self) -> None:
        """Ask the Crazyflie to stop sending log messages."""
        self.send(Packet(crtp.LOG, crtp.CONTROL, bytes([crtp.RESET])))

    def close(self) -> None:
        """Close the port."""
        self._endpoint.close()

    def _numbers(self, names: set[str], patience: float, keep_on: KeepOn) -> dict[str, int]:
        """Return the numbers of the wanted variables from the Crazyflie's table of contents."""
        about = self.ask(Packet(crtp.LOG, crtp.TOC, bytes([crtp.INFO])), 1, patience, keep_on)
        length, result = int.from_bytes(about[:2], "little"), dict[str, int]()
        for number in range(length):
            request = bytes([crtp.ITEM]) + struct.pack("<H", number)
            item = self.ask(Packet(crtp.LOG, crtp.TOC, request), 3, patience, keep_on)
            name = item[1:].rstrip(b"\0").replace(b"\0", b".").decode(errors="replace")
            if name in names:
                result[name] = number
            if len(result) == len(names):
                return result
        raise PlantError(
            f"the Crazyflie does not log {', '.join(sorted(names - set(result)))}; its firmware is too old"
        )

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
            self._understand(crtp.unpack(data), now)
        except MessageError:
            self.ignored += 1
            return
        self.last_message = now

    def _understand(self, packet: Packet, now: float) -> None:
        port, channel, body = packet
        if port == crtp.LINK and channel == 0 and len(body) == 8:
            trip = now - struct.unpack("<d", body)[0]
            if not 0.0 <= trip < 1.0:
                raise MessageError("an echo of an unknown request")
            self._trips.append(trip)
        elif port == crtp.LOG and channel == crtp.DATA:
            self._read_log(body, now)
        elif port == crtp.CONSOLE and channel == 0:
            self.console = (self.console + body.decode(errors="replace"))[-300:]
        elif (
            (request := self._request) is not None
            and (port, channel) == request[:2]
            and body.startswith(request.body)
            and len(body) > len(request.body)
        ):
            self._answer = body[len(request.body) :]

    def _read_log(self, body: bytes, now: float) -> None:
        if len(body) < 4:
            raise MessageError("a log without a time")
        block, ms, values = body[0], int.from_bytes(body[1:4], "little"), body[4:]
        on = (ms - self._remote_ms + WRAP_MS // 2) % WRAP_MS - WRAP_MS // 2
        if self.reading is not None and not -LATE_S < 1e-3 * on < now - self._log_time + EARLY_S:
            raise MessageError("a log with an implausible time")
        if block == STATES:
            self._take_state(crtp.state_of(values), self._remote_ms + on, now)
        elif block == STATUSES:
            self.status = crtp.status_of(values)
            self.thrusts.append(self.status.thrust)
        else:
            raise MessageError("a block of a log that was not requested")

    def _take_state(self, x: crtp.StateRow, ms: int, now: float) -> None:
        """Process a state, or refuse it if it is implausibly far from a recent state."""
        last, since = self.reading, now - self._log_time
        if last is not None and since < LEAPS_S and abs(x.p - last.p).max() > LEAP + FASTEST * since:
            raise MessageError("a state that is far from the last one")
        self._clock.record_arrival(1e-3 * ms, now)
        here = self._clock.here(1e-3 * ms)
        assert here is not None
        stamp = here - 0.5 * min(self._trips, default=0.0)
        if ms > self._remote_ms or last is None:  # skip states that arrive out of order
            self._remote_ms, self._log_time = ms, now
            self.reading = Reading(stamp, *x)

    def console_text(self) -> str:
        """Return the Crazyflie's console output as a suffix for an error message."""
        words = " ".join(self.console.split())
        return f"; it said: {words}" if words else ""
