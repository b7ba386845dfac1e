"""A Betaflight vehicle with a companion computer as a plant, by MSP override."""

import re
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...errors import ConfigError, PlantError
from ...onboard.guard import GeometricHover, Limits
from ...physics.state import STANDARD_GRAVITY
from ...physics.vehicle import Vehicle
from ...ros2.backends import BACKENDS
from ..entry import PlantEntry, PlantRequest
from . import msp
from .endpoint import address_of, open_endpoint
from .guardian import Guardian, Phase, SafeCommands
from .msp_board import ThrustCurve
from .msp_link import MspLink, StateLink, check_installed
from .piloted_plant import APPROACH_S, PilotedPlant
from .polling import KeepOn
from .ros2 import await_states, connect_link
from .ros2_address import Ros2Address
from .ros2_address import address_of as ros2_address_of
from .vehicle_state import VehicleState

FORM = "(serial:DEVICE:BAUD|tcp:HOST:PORT),(odometry|pose)=[BACKEND[@HOST:PORT]:]/TOPIC"
ADDRESS = re.compile(
    rf"(?P<port>[^,]+),(?P<kind>odometry|pose)=((?P<backend>{'|'.join(BACKENDS)})(@(?P<router>[\w.-]+:\d+))?:)?"
    r"(?P<topic>/[\w/]+)"
)
HOVER_S = 2.0  # [s] over which the pilot's throttle at hover is averaged
ECHO_S = 0.6  # [s], limit for the board to follow our sticks
EARLY_SWITCH = "the pilot: MSP OVERRIDE is on too early, and the board ignores the sticks; turn it off, then hover"
MARK = 0.15  # [rad/s], yaw rate by which our sticks differ from those of a pilot who hovers
LATE_S = 0.3  # [s], age of a command that the board has not answered
SILENT_S = 0.5  # [s] without an answer of the board
SINK_THRUST = 0.93  # thrust while the guardian lets the vehicle sink, as a ratio to the hover
SINK_S, OFF_S, REPEAT_S = 4.0, 2.0, 0.04  # [s]: durations of the guardian's phases, and time between two packets
LOW_M = 0.35  # [m], height below which the motors may stop at the end
OFF_REPEATS = 10


class MspAddress(NamedTuple):
    """Port of the board, and topic of the state."""

    port: str
    states: Ros2Address


def msp_address_of(text: str) -> MspAddress:
    """Return the parts of an address.

    Raises:
        ConfigError: The text is not an address.
    """
    parts = ADDRESS.fullmatch(text)
    if parts is None:
        raise ConfigError(f"address {text!r}: expected msp:{FORM}, as msp:serial:/dev/ttyAMA0:115200,pose=/mocap/quad")
    address_of(parts["port"], ("serial", "tcp"))
    router = f"@{parts['router']}" if parts["router"] else ""
    backend = f"{parts['backend']}{router}:" if parts["backend"] else ""
    states = ros2_address_of(f"{backend}mavros,{parts['kind']}={parts['topic']}")
    return MspAddress(parts["port"], states)


class MspPlant(PilotedPlant[MspLink]):
    """A vehicle that a pilot takes off, and hands over by the switch of the mode MSP OVERRIDE.

    Before the hand-over, the board receives the pilot's own sticks. At the start of the flight, the pilot hovers; the
    throttle there scales the thrust. From the switch on, a position controller holds the vehicle until the flight
    begins. The pilot has the vehicle back as soon as the switch is off.

    The board holds the last command indefinitely. A guardian process therefore levels the vehicle and lets it sink if
    this process ends or is silent.
    """

    def __init__(self, address: str, dt: float, low: np.ndarray, high: np.ndarray, vehicle: Vehicle) -> None:
        """Build a plant; it opens the port when it connects.

        Args:
            address: Port of the board and topic of the state; see ``FORM``.
            dt: Control period [s].
            low: Smallest command [c, omega].
            high: Largest command [c, omega].
            vehicle: Vehicle whose motors determine the shape of the thrust curve.

        Raises:
            ConfigError: The address is invalid.
        """
        self._where, self._vehicle = msp_address_of(address), vehicle
        super().__init__(f"msp:{address}", dt, low, high)
        fence = np.full(3, 1e3)
        self._limits = Limits(-fence, fence, low, high)
        self._curve: ThrustCurve | None = None
        self._guardian: Guardian | None = None
        self._place, self._is_engaged, self._sent = np.zeros(3), False, -np.inf

    def connect(self, keep_on: KeepOn = lambda: True) -> None:
        """Read the board's settings, and wait for states."""
        if self._link is None:
            endpoint = open_endpoint(self._where.port)
            try:
                self._states = connect_link(self._where.states, StateLink)
            except BaseException:
                endpoint.close()
                raise
            self._link = MspLink(endpoint, self._states)
        board = self.link.read_board(keep_on)
        self._curve = ThrustCurve(self._vehicle, board.idle)
        self.high = np.concatenate([self.high[:1], np.minimum(self.high[1:], board.fastest())])
        self.low = np.concatenate([self.low[:1], np.maximum(self.low[1:], -board.fastest())])
        await_states(self._states, self.until, keep_on)

    def take_off(self, p: np.ndarray | None, yaw: float | None, keep_on: KeepOn = lambda: True) -> None:
        """Wait until the pilot hovers at the start; learn the throttle there; wait for the pilot's switch."""
        link = self.link
        began = time.monotonic()
        while self.curve.hover is None:
            super().take_off(p, yaw, keep_on)
            link.throttles.clear()  # they are the pilot's, since none is recorded under MSP OVERRIDE
            self.until(lambda: False, HOVER_S, keep_on)
            if link.has_mode(msp.ARM) and not link.has_mode(msp.OVERRIDE):
                self.curve.learn(list(link.throttles))
            elif time.monotonic() - began > APPROACH_S:
                raise PlantError(
                    f"{self.address}: for {APPROACH_S:g} s nobody has hovered at the start with MSP OVERRIDE off"
                )
        x = self.reading()
        self._place = x.p.copy() if p is None else np.asarray(p, dtype=float)
        hover = self._hover()

        def is_ours() -> bool:
            if not link.has_mode(msp.OVERRIDE):
                hover.integral[:] = 0.0
            self._fly_to_place(hover)
            return link.has_mode(msp.OVERRIDE)

        if not self.until(is_ours, APPROACH_S, keep_on):
            raise PlantError(f"{self.address}: MSP OVERRIDE was not switched on within {APPROACH_S:g} s")
        self._engage()
        link.forget_commands()

        def is_followed() -> bool:
            self._fly_to_place(hover, MARK)
            return link.is_echoing()

        if not self.until(is_followed, ECHO_S, keep_on):
            raise PlantError(
                f"{self.address}: MSP OVERRIDE is on, but the board does not follow our sticks; set "
                f"msp_override_channels_mask to 15, plus the bit of the channel of ANGLE, then save"
            )
        if link.has_mode(msp.ANGLE) or link.has_mode(msp.HORIZON):
            raise PlantError(f"{self.address}: the board is in ANGLE or HORIZON mode; body rates need ACRO")
        self._holder = hover

    @property
    def waits_for(self) -> str:
        """The remedy if the switch is on too early."""
        link, curve = self._link, self._curve
        is_early = link is not None and link.has_mode(msp.OVERRIDE) and curve is not None and curve.hover is None
        return EARLY_SWITCH if is_early else ""

    @property
    def curve(self) -> ThrustCurve:
        """Throttle for a thrust per mass.

        Raises:
            PlantError: The plant is not connected.
        """
        if self._curve is None:
            raise PlantError(f"{self.address}: not connected; call connect or reset first")
        return self._curve

    def hold(self, until: float) -> None:
        """Hold the place by a position controller, since the board has none."""
        while time.monotonic() < until:
            self.read()
            self._fly_to_place(self._holder)
            self.link.pump(min(until, time.monotonic() + self.dt))

    def read(self) -> VehicleState:
        """Return the newest state.

        Raises:
            PlantError: The pilot has taken over, or the board or the states are silent.
        """
        link = self.link
        link.pump(0.0)
        if link.lag > LATE_S and time.monotonic() - link.last_answer < 0.5 * LATE_S:
            raise PlantError(
                f"the board reads commands {LATE_S:g} s late; set serial_update_rate_hz = 500, or use a faster line"
            )
        if self._is_engaged:
            if time.monotonic() - link.last_answer > SILENT_S:
                raise PlantError(f"the board has been silent for {SILENT_S:g} s; it holds the last command")
            if not link.has_mode(msp.OVERRIDE):
                raise PlantError("the pilot has switched MSP OVERRIDE off, and flies")
            if not link.has_mode(msp.ARM):
                raise PlantError("the board is disarmed")
        return super().read()

    def transmit(self, u: np.ndarray) -> np.ndarray:
        """Send the sticks for a thrust and body rates."""
        throttle = self.curve.throttle(float(u[0]))
        self.link.fly_rates(throttle, u[1:])
        if self._guardian is not None:
            self._guardian.feed()
        return np.concatenate([[self.curve.per_mass(throttle)], u[1:]])

    def wait(self, until: float) -> None:
        """Exchange messages with the board."""
        link = self.link
        while True:
            if not self._is_engaged and self.curve.hover is None and self._is_due():
                link.mirror()
            step = min(until, time.monotonic() + self.dt)
            link.pump(step)
            if step >= until:
                return

    def land(self) -> None:
        """Stop the motors if the vehicle is down; otherwise let the guardian level it and let it sink."""
        link, self._link = self._link, None
        guardian, self._guardian = self._guardian, None
        if link is None:
            return
        try:
            link.pump(0.0)
            if guardian is None:
                return
            x = link.reading
            is_ours = link.has_mode(msp.OVERRIDE) and link.has_mode(msp.ARM)
            is_seen = x is not None and time.monotonic() - link.last_message < SILENT_S
            if is_ours and not (is_seen and x is not None and x.p[2] < LOW_M):
                guardian.leave()
                return
            assert link.board is not None
            for _ in range(OFF_REPEATS if is_ours else 0):
                link.send_channels(link.board.channels(0.0, np.zeros(3), level=True))
                link.pump(time.monotonic() + REPEAT_S)
            guardian.release()
        finally:
            self._is_engaged = False
            link.close()

    @property
    def notes(self) -> Sequence[str]:
        """Kinds of ignored messages."""
        return () if self._link is None else tuple(self._link.notes)

    def _hover(self) -> GeometricHover:
        return GeometricHover(self._limits, self.dt)

    def _is_due(self) -> bool:
        """Return whether a control period has passed since the last command."""
        now = time.monotonic()
        is_due = now - self._sent > 0.9 * self.dt
        self._sent = now if is_due else self._sent
        return is_due

    def _fly_to_place(self, hover: GeometricHover, yaw_rate: float = 0.0) -> None:
        if not self._is_due():
            return
        x = self.reading().at(time.monotonic()).extrapolate(STANDARD_GRAVITY)
        u = hover.command(np.concatenate([x.p, x.R.ravel(), x.v]), self._place)
        self.send(u + np.array([0.0, 0.0, 0.0, yaw_rate]))

    def _engage(self) -> None:
        """Start the guardian."""
        link, board = self.link, self.link.board
        assert board is not None
        sink, off = (
            msp.encode(msp.SET_RAW_RC, msp.sticks_payload(board.channels(throttle, np.zeros(3), level=True)))
            for throttle in (self.curve.throttle(SINK_THRUST * STANDARD_GRAVITY), 0.0)
        )
        phases = (Phase((sink,), REPEAT_S, SINK_S), Phase((off,), REPEAT_S, OFF_S))
        self._guardian = Guardian(SafeCommands(phases), link.endpoint.fileno())
        self._is_engaged = True


def _make(request: PlantRequest) -> MspPlant:
    return MspPlant(request.address, request.dt, *request.limits, request.vehicle)


entry = PlantEntry(
    _make,
    "a Betaflight board with MSP override, and its state from motion capture or odometry over ROS 2",
    is_vehicle=True,
    awaits="the pilot, who hovers at the start and then switches MSP OVERRIDE on",
    check_address=msp_address_of,
    needs=check_installed,
)
