"""Base class of plants that are vehicles: they run in real time, and their state cannot be set."""

import abc
import math
import time
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from ...errors import PlantError
from ...physics.state import STANDARD_GRAVITY, Command, State
from ..plant import Measurement, Plant, as_numpy, check_command, limit_command
from .frames import heading_of
from .polling import KeepOn, wait_until
from .vehicle_state import ExtraAcceleration, VehicleState

ARRIVAL_DISTANCE, ARRIVAL_SPEED, ARRIVAL_S = 0.2, 0.25, 1.0  # [m], [m/s], [s]: limits for a vehicle that has arrived


class VehiclePlant(Plant, abc.ABC):
    """A link to one vehicle.

    A live flight uses the link tick by tick; :meth:`step` makes the vehicle a plant like the others.

    Missed ticks are not repeated; the measurement times show them.
    """

    def __init__(self, dt: float, low: np.ndarray, high: np.ndarray) -> None:
        """Build a plant.

        Args:
            dt: Control period [s].
            low: Smallest command [c, omega] that is sent to the vehicle.
            high: Largest command [c, omega] that is sent to the vehicle.
        """
        self.dt = dt
        self.low, self.high = low, high
        self.lost_time: float | None = None
        """Time that a simulated vehicle lost because this machine was busy [s]; None for other vehicles."""
        self._tick: int | None = None
        self._began = 0.0
        self._thrust = STANDARD_GRAVITY
        self._extra = ExtraAcceleration()

    @property
    def notes(self) -> Sequence[str]:
        """Descriptions of the kinds of ignored messages from the vehicle, each listed once."""
        return ()

    @property
    def waits_for(self) -> str:
        """Present reason for which the take-off waits; empty for the usual one, which the plant's entry states."""
        return ""

    @abc.abstractmethod
    def connect(self, keep_on: KeepOn = lambda: True) -> None:
        """Connect, and wait until the vehicle can be armed; return immediately if this is already possible.

        Args:
            keep_on: Called repeatedly; the wait is aborted when it returns False.

        Raises:
            PlantError: The vehicle cannot be armed; the error contains the reason that the vehicle reported.
        """

    @abc.abstractmethod
    def take_off(self, p: np.ndarray | None, yaw: float | None, keep_on: KeepOn = lambda: True) -> None:
        """Take off, and wait until the vehicle hovers under its autopilot and is ready for commands.

        Args:
            p: Hover position, world [m]; None for the current position, or one metre above the ground.
            yaw: Heading at hover [rad]; None for the current heading.
            keep_on: Called repeatedly; the wait is aborted when it returns False.

        Raises:
            PlantError: The vehicle does not arm, or does not reach the position.
        """

    @abc.abstractmethod
    def read(self) -> VehicleState:
        """Return the newest state without waiting.

        Raises:
            PlantError: The link is lost, or another pilot has taken over.
        """

    def hold(self, until: float) -> None:
        """Let the autopilot or pilot hold the take-off position until an instant on the monotonic clock [s]."""
        self.wait(until)

    @abc.abstractmethod
    def transmit(self, u: np.ndarray) -> np.ndarray:
        """Immediately send a command [c, omega] within the limits, and return the command that the vehicle accepts."""

    def send(self, u: np.ndarray) -> np.ndarray:
        """Clip a command [c, omega], send it immediately, and return the command that the vehicle accepts."""
        transmission = self.transmit(np.clip(u, self.low, self.high))
        self._thrust = float(transmission[0])
        return transmission

    def now(self) -> VehicleState:
        """Return the newest state, extrapolated to the current time; its age is the time that was not extrapolated.

        Raises:
            PlantError: See :meth:`read`.
        """
        x = self.read()
        self._extra.record(x, self._thrust, time.monotonic())
        return x.extrapolate(self._thrust, self._extra.value)

    @abc.abstractmethod
    def wait(self, until: float) -> None:
        """Keep the link alive until an instant on the monotonic clock [s]."""

    def until(self, done: KeepOn, patience: float, keep_on: KeepOn) -> bool:
        """Keep the link alive for at most ``patience`` [s] until a condition holds; return whether this happened.

        Raises:
            PlantError: ``keep_on`` returned False, so the flight was aborted.
        """
        return wait_until(done, patience, keep_on, self.wait)

    def staying(self, place: np.ndarray, meanwhile: Callable[[], object] = lambda: None) -> KeepOn:
        """Return a function that checks whether the vehicle has stayed at a position for a while.

        Args:
            place: Position, world [m].
            meanwhile: Called at each check.
        """
        since = math.inf

        def stays() -> bool:
            nonlocal since
            meanwhile()
            x = self.read()
            there = np.abs(x.p - place).max() < ARRIVAL_DISTANCE and np.abs(x.v).max() < ARRIVAL_SPEED
            since = min(since, time.monotonic()) if there else math.inf
            return time.monotonic() - since > ARRIVAL_S

        return stays

    @abc.abstractmethod
    def land(self) -> None:
        """Let the autopilot land the vehicle unless another pilot has taken over; idempotent."""

    def reset(self, x0: State | None) -> Measurement:
        """Take off if necessary, fly to the position and heading of ``x0``, and begin to send commands there.

        The tilt and velocity of ``x0`` are ignored, since they cannot be set on a vehicle.
        """
        self.connect()
        if x0 is None:
            self.take_off(None, None)
        else:
            self.take_off(np.asarray(x0.p, dtype=float), heading_of(np.asarray(x0.R, dtype=float)))
        self._tick, self._began, self._thrust = 0, time.monotonic(), STANDARD_GRAVITY
        self._extra = ExtraAcceleration()
        return self._measure()

    def step(self, u: Command) -> tuple[Measurement, Command]:
        """Send a command, and return the measurement at the end of the tick."""
        command = check_command(u, type(self).__name__)
        if self._tick is None:
            raise PlantError(f"{type(self).__name__}: not flying; call reset first")
        within = limit_command(u, command, self.low, self.high)
        limited_u = as_numpy(within).astype(float)
        transmission = self.send(limited_u)
        accepted_command = (
            within
            if np.allclose(transmission, limited_u, atol=1e-6)
            else Command.of(jnp.asarray(transmission, command.dtype))
        )
        self._tick = max(self._tick + 1, int((time.monotonic() - self._began) / self.dt))
        self.wait(self._began + self._tick * self.dt)
        return self._measure(), accepted_command

    def stop(self) -> None:
        """Let the autopilot land the vehicle."""
        self._tick = None
        self.land()

    def _measure(self) -> Measurement:
        now = self.now()
        assert self._tick is not None
        dtype = jnp.result_type(float)
        x, truth = (
            None if each is None else State(*(jnp.asarray(a, dtype) for a in each[:3])) for each in (now, now.truth)
        )
        assert x is not None
        omega = jnp.asarray(now.omega, dtype)
        return Measurement(self._tick * self.dt, x, omega=omega, age=now.age, truth=truth)
