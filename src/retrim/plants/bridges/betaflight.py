"""Betaflight as a plant: the real firmware is the rate controller of a simulated vehicle, in real time."""

import math
import time

import jax
import jax.numpy as jnp
import numpy as np

from ...errors import ConfigError, PlantError
from ...physics.bem import BemQuadrotor
from ...physics.disturbance import Disturbance
from ...physics.so3 import rotz
from ...physics.state import STANDARD_GRAVITY, State
from ..entry import PlantEntry, PlantRequest
from .betaflight_firmware import Firmware, find_firmware
from .betaflight_wire import IDLE, throttle_of
from .betaflight_world import World
from .polling import KeepOn
from .vehicle_plant import VehiclePlant
from .vehicle_state import VehicleState

RECEIVER_S, ARMING_S, SPIN_UP_S = 2.0, 6.0, 0.4  # [s]: start of the receiver; arming; motors reach hover
MARGIN = 1.05  # ratio of the body rate at full stick to the fastest command
LEAST_MOTOR = 0.8 * IDLE  # smallest motor command of an armed board


class BetaflightPlant(VehiclePlant):
    """A simulated vehicle whose motors are commanded by Betaflight; the firmware runs in its own process.

    There is no autopilot for take-off and landing. Instead, the vehicle rests on a stand with spinning motors until the
    first command releases it, and it is removed when the flight is over. A real board holds the companion's last
    command forever; here, the simulated world ends with the process that flies the vehicle.
    """

    def __init__(self, model: BemQuadrotor, disturbance: Disturbance, low: np.ndarray, high: np.ndarray) -> None:
        """Build a plant; it does not start the firmware until it connects.

        Args:
            model: The vehicle; of its rate controller, only the thrust map is used, to compute the throttle.
            disturbance: External effects, as a function of the time since the release and the state.
            low: Smallest command [c, omega].
            high: Largest command [c, omega].
        """
        super().__init__(model.dt, low, high)
        self._model, self._disturbance = model, disturbance
        self._steps = math.ceil(math.degrees(MARGIN * float(np.abs(high[1:]).max())) / 10.0)
        self._firmware: Firmware | None = None
        self._world: World | None = None
        self._flies = False
        vehicle, thrust_map = model.vehicle, model.loop.thrust_map
        self._motor = jax.jit(lambda c: vehicle.esc.throttle(jnp.sqrt(c * vehicle.mass / (4.0 * thrust_map))))

    def connect(self, keep_on: KeepOn = lambda: True) -> None:
        """Start the firmware, and arm it."""
        if self._world is not None:
            return
        if not keep_on():
            raise PlantError("the flight was aborted before the hand-over")
        # before the world, since firmware that receives a state too early crashes
        self._firmware = Firmware(find_firmware(), self._steps)
        try:
            world = self._world = World(self._model, self._disturbance, math.radians(10.0 * self._steps))
            self.until(lambda: False, RECEIVER_S, keep_on)
            world.tell(0.0, np.zeros(3), armed=True)
            if not self.until(lambda: bool(world.motors.min() > LEAST_MOTOR), ARMING_S, keep_on):
                raise PlantError(f"the firmware does not arm within {ARMING_S:g} s")
        except BaseException:
            self.land()
            raise

    def take_off(self, p: np.ndarray | None, yaw: float | None, keep_on: KeepOn = lambda: True) -> None:
        """Put the vehicle on the stand with its motors at hover."""
        world = self._running()
        place = jnp.array([0.0, 0.0, 1.0]) if p is None else jnp.asarray(p, dtype=float)
        world.place(State(place, rotz(jnp.asarray(yaw or 0.0, dtype=place.dtype)), jnp.zeros_like(place)))
        self._flies = False
        world.tell(self._throttle(STANDARD_GRAVITY), np.zeros(3))
        self.until(lambda: False, SPIN_UP_S, keep_on)

    def read(self) -> VehicleState:
        """Return the vehicle's state."""
        world = self._running()
        now, self.lost_time = world.state(), world.slip
        if now.p[2] < 0.0 or not np.isfinite(now.p).all():
            raise PlantError("the vehicle is on the ground")
        return now

    def transmit(self, u: np.ndarray) -> np.ndarray:
        """Move the sticks; the first command releases the vehicle."""
        world = self._running()
        world.tell(self._throttle(float(u[0])), u[1:])
        if not self._flies:
            self._flies = True
            world.release()
        return u

    def wait(self, until: float) -> None:
        """Wait; the world runs in its own thread."""
        time.sleep(max(0.0, until - time.monotonic()))

    def land(self) -> None:
        """Remove the vehicle, and stop the firmware."""
        world, self._world = self._world, None
        firmware, self._firmware = self._firmware, None
        if world is not None:
            world.close()
        if firmware is not None:
            firmware.stop()

    def _running(self) -> World:
        if self._world is None or self._firmware is None:
            raise PlantError("the firmware does not run; call connect or reset first")
        if not self._firmware.runs:
            raise PlantError("the firmware has ended")
        return self._world

    def _throttle(self, c: float) -> float:
        """Return the throttle for the thrust per mass ``c``, from the thrust map that the companion assumes."""
        return max(1e-3, throttle_of(float(self._motor(jnp.asarray(max(c, 0.0))))))


def _make(request: PlantRequest) -> BetaflightPlant:
    model = BemQuadrotor.of(request.vehicle, request.dt, thrust_error=request.thrust_error)
    return BetaflightPlant(model, request.disturbance, *request.limits)


def _check_address(address: str) -> None:
    if address:
        raise ConfigError(f"plant 'betaflight' has no address, and {address!r} was given")


entry = PlantEntry(
    _make,
    "Betaflight's firmware as the rate controller of blade-element rotors, in real time",
    has_thrust_error=True,
    is_vehicle=True,
    has_world=True,
    check_address=_check_address,
    needs=find_firmware,
)
