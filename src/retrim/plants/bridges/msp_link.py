"""A link to a Betaflight board by MSP, with the vehicle's state from ROS 2, since the board has none."""

import time
from collections import deque
from typing import Protocol, runtime_checkable

import numpy as np

from ...errors import MessageError, PlantError
from ...ros2.backends import is_installed
from ...ros2.node import Ros2Node
from . import msp
from .endpoint import Endpoint, pump
from .msp_board import PITCH, REQUIRED_ANSWERS, ROLL, THROTTLE, YAW, Board
from .polling import KeepOn, insisting, wait_until
from .ros2_address import Ros2Address
from .ros2_link import Ros2Link
from .vehicle_state import Reading

ANSWERS_S, REPEAT_S = 6.0, 0.3  # [s], limit for the answers about the settings; time between two requests
REQUEST_PERIOD_S = 0.05  # [s] between two requests, alternately for the board's modes and for its channels
MOST_PENDING, LONGEST_POSTPONEMENT_S = 2, 0.25  # packets without an answer that postpone a request, and by how long [s]
HISTORY = 50  # throttles and motor commands that are kept
ECHOES, ECHO_US = 25, 3  # last commands that an answer may echo, and the largest difference [us]


@runtime_checkable
class StateSource(Protocol):
    """Where the vehicle's state comes from."""

    notes: list[str]
    """Kinds of ignored messages, each listed once."""

    @property
    def reading(self) -> Reading | None:
        """Newest state; None until the first one arrives."""

    @property
    def last_message(self) -> float:
        """Time of the last state, on the monotonic clock [s]."""

    def close(self) -> None:
        """Leave the network."""


class StateLink(Ros2Link):
    """The state of a vehicle that motion capture or visual odometry publishes."""

    def __init__(self, node: Ros2Node, address: Ros2Address) -> None:
        """Subscribe to the state."""
        super().__init__(node, address)
        self.listen_to_states(address.odometry, address.pose)


class MspLink:
    """Sends sticks to a board, and asks for its modes and channels; the states come in another thread."""

    def __init__(self, endpoint: Endpoint, states: StateSource) -> None:
        """Build a link.

        Args:
            endpoint: The board's serial line; the link closes it.
            states: Source of the vehicle's state; the link closes it.
        """
        self.endpoint, self.states = endpoint, states
        self.answers: dict[int, bytes] = {}
        """Newest answer to each request."""
        self.refusals: set[int] = set()
        """Requests that the board refuses."""
        self.status: msp.Status | None = None
        """Newest modes of the board."""
        self.channels: list[int] = []
        """Newest receiver channels, in the firmware's order of the sticks [us]."""
        self.throttles: deque[float] = deque(maxlen=HISTORY)
        """Throttles of the pilot, newest last; they are kept while the pilot flies."""
        self.last_answer = time.monotonic()
        """Time of the board's last answer, on the monotonic clock [s]."""
        self.board: Board | None = None
        """Settings of the board; None until they are known."""
        self._parser = msp.Parser()
        self._faults: set[str] = set()
        self._commands: deque[list[int]] = deque(maxlen=ECHOES)
        self._pending: deque[tuple[int, float]] = deque()
        self._asked, self._next = 0.0, msp.STATUS_EX

    @property
    def reading(self) -> Reading | None:
        """Newest state."""
        return self.states.reading

    @property
    def last_message(self) -> float:
        """Time of the last state, on the monotonic clock [s]."""
        return self.states.last_message

    @property
    def lag(self) -> float:
        """Age of the oldest packet without an answer [s].

        A board reads one packet in each run of its serial task, 100 times a second by default. More packets wait in
        its buffer, so that commands would become later and later.
        """
        return time.monotonic() - self._pending[0][1] if self._pending else 0.0

    @property
    def notes(self) -> list[str]:
        """Kinds of ignored messages, each listed once."""
        damaged = ["damaged MSP packets"] if self._parser.damaged else []
        return [*self.states.notes, *damaged, *sorted(self._faults)]

    def read_board(self, keep_on: KeepOn) -> Board:
        """Ask for the settings of the board.

        Raises:
            PlantError: The board does not answer, or its settings are unsuitable.
        """

        def ask() -> None:
            for code in REQUIRED_ANSWERS:
                if code not in self.answers:
                    self.send(code)

        is_known = insisting(ask, lambda: all(code in self.answers for code in REQUIRED_ANSWERS), REPEAT_S)
        if not wait_until(is_known, ANSWERS_S, keep_on, self.pump):
            missing = [name for code, name in REQUIRED_ANSWERS.items() if code not in self.answers]
            who = (
                "the board does not answer" if len(missing) == len(REQUIRED_ANSWERS) else "the board does not answer to"
            )
            raise PlantError(f"{who} MSP requests ({', '.join(missing)}) within {ANSWERS_S:g} s; is MSP on this port?")
        self.board = Board.of(self.answers)
        return self.board

    def has_mode(self, mode: int) -> bool:
        """Return whether a mode is active."""
        return self.status is not None and mode in self.status.modes

    def fly_rates(self, thrust: float, omega: np.ndarray) -> None:
        """Send sticks.

        Args:
            thrust: Throttle, 0 to 1.
            omega: Body rates, forward-left-up [rad/s].
        """
        assert self.board is not None
        self.send_channels(self.board.channels(thrust, omega))

    def send_channels(self, channels: list[int]) -> None:
        """Send receiver channels [us]."""
        self._commands.append(channels)
        self.send(msp.SET_RAW_RC, msp.sticks_payload(channels))

    def mirror(self) -> None:
        """Send the pilot's own sticks, so that the board continues with them if the switch is turned too early."""
        if self.board is not None and len(self.channels) > THROTTLE and not self.has_mode(msp.OVERRIDE):
            channels = [0] * 4
            for axis in (ROLL, PITCH, YAW, THROTTLE):
                channels[self.board.order[axis]] = self.channels[axis]
            self.send_channels(channels)

    def forget_commands(self) -> None:
        """Compare the board's sticks with later commands only."""
        self._commands.clear()

    def is_echoing(self) -> bool:
        """Return whether the board's sticks are those of a recent command."""
        if self.board is None or len(self.channels) <= THROTTLE:
            return False
        rows = [[command[self.board.order[axis]] for axis in range(4)] for command in self._commands]
        sticks = np.array(self.channels[:4])
        return any(np.abs(sticks - row).max() <= ECHO_US for row in np.array(rows).reshape(-1, 4))

    def send(self, code: int, payload: bytes = b"") -> None:
        """Send a packet to the board, which answers each one."""
        self._pending.append((code, time.monotonic()))
        self.endpoint.send(msp.encode(code, payload), "line")

    def pump(self, until: float) -> None:
        """Exchange messages with the board until an instant on the monotonic clock [s]."""
        pump(self.endpoint, until, self._ask, lambda data, _: self._take(data))

    def close(self) -> None:
        """Disconnect from the board and from ROS 2."""
        self.endpoint.close()
        self.states.close()

    def _ask(self, now: float) -> None:
        pause = REQUEST_PERIOD_S if len(self._pending) < MOST_PENDING else LONGEST_POSTPONEMENT_S
        if self.board is not None and now - self._asked > pause:
            self._asked = now
            self.send(self._next)
            self._next = msp.RC if self._next == msp.STATUS_EX else msp.STATUS_EX

    def _take(self, data: bytes) -> None:
        for packet in self._parser.feed(data):
            self.last_answer = time.monotonic()
            self._settle(packet.code)
            if packet.refused:
                self.refusals.add(packet.code)
                continue
            self.answers[packet.code] = packet.payload
            try:
                self._read(packet)
            except MessageError as error:
                self._faults.add(str(error))

    def _settle(self, code: int) -> None:
        """Forget the packets up to the one that is answered; answers come in order, and some are lost."""
        if any(each == code for each, _ in self._pending):
            while self._pending.popleft()[0] != code:
                pass

    def _read(self, packet: msp.Packet) -> None:
        if self.board is None:
            return
        if packet.code == msp.STATUS_EX:
            self.status = msp.Status.of(packet.payload, self.board.boxes)
        elif packet.code == msp.RC:
            self.channels = msp.numbers(packet.payload)
            if len(self.channels) > THROTTLE and not self.has_mode(msp.OVERRIDE):
                self.throttles.append(self.board.throttle_at(self.channels))


def check_installed() -> None:
    """Check that the packages of the link are installed, before anything is trained.

    Raises:
        PlantError: A package is missing.
    """
    if not is_installed("rosbags"):
        raise PlantError(
            "plant 'msp' receives the state over ROS 2, which needs the package 'rosbags'; in a checkout: `uv pip "
            "install -e '.[msp]'`; elsewhere: `pip install cyclonedds rosbags pyserial`"
        )
