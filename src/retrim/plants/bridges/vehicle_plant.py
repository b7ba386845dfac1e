"""A vehicle as a plant: its time does not wait, and it cannot be put anywhere."""

import abc
import math
import time
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from ...errors import PlantError
from ...physics.state import STANDARD_GRAVITY, Command, State
from ..plant import Measurement, Plant, as_numpy, check_command, limited
from .frames import heading_of
from .patience import KeepOn, wait_until
from .vehicle_state import VehicleState

THERE, STILL, STAY_S = 0.2, 0.25, 1.0  # [m], [m/s], [s] of one who has arrived


class VehiclePlant(Plant, abc.ABC):
    """A link to one vehicle. A live flight speaks to it tick by tick; :meth:`step` makes a plant like others of it.

    A tick that is missed is missed: measurements then say so by their time.
    """

    def __init__(self, dt: float, low: np.ndarray, high: np.ndarray) -> None:
        """Build a plant.

        Args:
            dt: Control period [s].
            low: Smallest command [c, omega] that the vehicle is given.
            high: Largest one.
        """
        self.dt = dt
        self.low, self.high = low, high
        self.lost: float | None = None
        """Time that a vehicle, simulated here, did not fly because the machine was busy [s]; None for any other."""
        self._tick: int | None = None
        self._began = 0.0
        self._thrust = STANDARD_GRAVITY

    @property
    def notes(self) -> Sequence[str]:
        """Kinds of messages of the vehicle that were ignored, in words, each once."""
        return ()

    @abc.abstractmethod
    def connect(self, keep_on: KeepOn = lambda: True) -> None:
        """Return when the vehicle could be armed; at once if it was before.

        Args:
            keep_on: Asked again and again; False gives up.

        Raises:
            PlantError: It cannot be armed, with what it said of the reason.
        """

    @abc.abstractmethod
    def take_off(self, p: np.ndarray | None, yaw: float | None, keep_on: KeepOn = lambda: True) -> None:
        """Return when the vehicle hovers by its autopilot and is ready for commands.

        Args:
            p: Where, world [m]; None for where it is, or a metre above the ground.
            yaw: Its heading [rad]; None for what it is.
            keep_on: Asked again and again; False gives up.

        Raises:
            PlantError: It does not arm, or does not get there.
        """

    @abc.abstractmethod
    def read(self) -> VehicleState:
        """Return the newest state, at once.

        Raises:
            PlantError: The link is lost, or somebody else has taken over.
        """

    @abc.abstractmethod
    def hold(self, until: float) -> None:
        """Let the autopilot hold the place of the take-off until an instant of the monotonic clock [s]."""

    @abc.abstractmethod
    def transmit(self, u: np.ndarray) -> np.ndarray:
        """Send a command [c, omega] that is within the limits, at once; return what of it the vehicle takes."""

    def send(self, u: np.ndarray) -> np.ndarray:
        """Send a command [c, omega] at once, within the limits; return what of it the vehicle takes."""
        taken = self.transmit(np.clip(u, self.low, self.high))
        self._thrust = float(taken[0])
        return taken

    def now(self) -> VehicleState:
        """Return the newest state, carried on to the present; its age is what is left of that of the news.

        Raises:
            PlantError: As for :meth:`read`.
        """
        return self.read().carried_on(self._thrust)

    @abc.abstractmethod
    def wait(self, until: float) -> None:
        """Keep the link alive until an instant of the monotonic clock [s]."""

    def until(self, done: KeepOn, patience: float, keep_on: KeepOn) -> bool:
        """Keep the link alive until something is so, for ``patience`` [s] at most; return whether it is.

        Raises:
            PlantError: ``keep_on`` says no: the flight was given up.
        """
        return wait_until(done, patience, keep_on, self.wait)

    def staying(self, place: np.ndarray, meanwhile: Callable[[], object] = lambda: None) -> KeepOn:
        """Return what tells whether the vehicle has been at a place [m] for a while.

        Args:
            place: World [m].
            meanwhile: Done at each question.
        """
        since = math.inf

        def stays() -> bool:
            nonlocal since
            meanwhile()
            x = self.read()
            there = np.abs(x.p - place).max() < THERE and np.abs(x.v).max() < STILL
            since = min(since, time.monotonic()) if there else math.inf
            return time.monotonic() - since > STAY_S

        return stays

    @abc.abstractmethod
    def land(self) -> None:
        """Leave the vehicle to its autopilot, which lands it, unless somebody else has taken over. Idempotent."""

    def reset(self, x0: State | None) -> Measurement:
        """Take off if the vehicle stands, go to the place and heading of ``x0``, and begin to command there.

        Attitude and velocity of ``x0`` are left out: nobody puts a vehicle into them.
        """
        self.connect()
        if x0 is None:
            self.take_off(None, None)
        else:
            self.take_off(np.asarray(x0.p, dtype=float), heading_of(np.asarray(x0.R, dtype=float)))
        self._tick, self._began, self._thrust = 0, time.monotonic(), STANDARD_GRAVITY
        return self._measured()

    def step(self, u: Command) -> tuple[Measurement, Command]:
        """Send a command, and return what is known when the tick is over."""
        wanted = check_command(u, type(self).__name__)
        if self._tick is None:
            raise PlantError(f"{type(self).__name__}: not flying; call reset first")
        within = limited(u, wanted, self.low, self.high)
        sent = as_numpy(within).astype(float)
        taken = self.send(sent)
        accepted = within if np.allclose(taken, sent, atol=1e-6) else Command.of(jnp.asarray(taken, wanted.dtype))
        self._tick = max(self._tick + 1, int((time.monotonic() - self._began) / self.dt))
        self.wait(self._began + self._tick * self.dt)
        return self._measured(), accepted

    def stop(self) -> None:
        """Let the autopilot land the vehicle."""
        self._tick = None
        self.land()

    def _measured(self) -> Measurement:
        now = self.now()
        assert self._tick is not None
        dtype = jnp.result_type(float)
        x, truth = (
            None if each is None else State(*(jnp.asarray(a, dtype) for a in each[:3])) for each in (now, now.truth)
        )
        assert x is not None
        omega = jnp.asarray(now.omega, dtype)
        return Measurement(self._tick * self.dt, x, omega=omega, age=now.age, truth=truth)
