"""A simulated vehicle for PX4's firmware: rotors, body, air and sensors, in place of PX4's own simulation.

PX4 runs in lockstep: it computes one step of its rate controller for each measurement of the inertial unit.
"""

import contextlib
import math
import socket
import time
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..config.disturbances import disturbance as disturbance_named
from ..errors import PlantError
from ..physics.bem import BemQuadrotor
from ..physics.disturbance import Disturbance
from ..physics.state import STANDARD_GRAVITY, State
from ..physics.substep import SUBSTEP
from ..physics.vehicle import Vehicle
from ..plants.bridges import frames
from ..plants.bridges.rotor_world import compile_step, place_at_rest
from ..plants.bridges.vehicle_state import Reading
from ..plants.extras import import_extra

PORT = 4560  # TCP port to which PX4 connects
STEP_MS = 4  # [ms] between two measurements of the inertial unit
STEP = STEP_MS * SUBSTEP
ANSWER_S = 0.02  # [s] within which PX4 answers a measurement
LONGEST_LAG = 0.02  # [s], largest delay that the world still makes up for
GYRO, FORCE, FIELD = 3e-3, 0.05, 1e-3  # standard deviations: [rad/s], [m/s^2], [gauss]
PLACE, SPEED, TURN = 3e-4, 3e-3, 1e-3  # standard deviations of motion capture: [m], [m/s], [rad]
NORTH_DOWN = np.array([0.21, 0.0, 0.43])  # magnetic field, north-east-down [gauss]
HOME = 47.397742, 8.545594, 488.0  # latitude and longitude [deg], height [m]
METRES = 111_195.0  # [m] per degree of latitude
REST = np.array([0.0, 0.0, STANDARD_GRAVITY])  # specific force at rest
SENSORS = 0x1FFF  # HIL_SENSOR: all values are new
OUR_ROTORS = [0, 1, 3, 2]  # PX4's are front right, rear left, front left, rear right; our last two are swapped
ROTORS = ((1.0, 1.0, 1.0), (-1.0, -1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0))
"""PX4's rotors: forward, right, and the sign of the torque."""


def parameters_of(vehicle: Vehicle) -> dict[str, float | int]:
    """Return the PX4 parameters that describe the rotors of a vehicle."""
    ahead, right = (float(length) for length in vehicle.arm)
    result: dict[str, float | int] = {"CA_AIRFRAME": 0, "CA_ROTOR_COUNT": 4, "SYS_HAS_GPS": 0}
    result["THR_MDL_FAC"] = thrust_factor(vehicle)
    for n, (x, y, torque) in enumerate(ROTORS):
        result |= {f"CA_ROTOR{n}_PX": x * ahead, f"CA_ROTOR{n}_PY": y * right, f"CA_ROTOR{n}_KM": 0.05 * torque}
    return result


def thrust_factor(vehicle: Vehicle) -> float:
    """Return PX4's factor f in the thrust f s^2 + (1 - f) s for the motor signal s, fitted to the speed controllers."""
    signal = np.linspace(0.0, 1.0, 21)
    speed = np.clip(np.asarray(vehicle.esc.speed(jnp.asarray(signal))), vehicle.motor_min, vehicle.motor_max)
    thrust, bend = (speed / speed[-1]) ** 2, signal**2 - signal
    return float(np.clip((thrust - signal) @ bend / (bend @ bend), 0.0, 1.0))


class Px4World:
    """A vehicle on the floor or in flight, which PX4 senses and whose motors it commands."""

    def __init__(self, vehicle: Vehicle, disturbance: Disturbance) -> None:
        """Compile the vehicle, and open the port to which PX4 connects.

        Args:
            vehicle: The vehicle.
            disturbance: External effects, as a function of the time since :meth:`disturb` [s] and the state.

        Raises:
            PlantError: The port is in use, or pymavlink is not installed.
        """
        self._dialect: Any = import_extra("pymavlink.dialects.v20.common", "mavlink", package="pymavlink")
        self._messages = self._dialect.MAVLink(None, srcSystem=1, srcComponent=51)
        model = BemQuadrotor.of(vehicle, 0.02, thrust_error=0.0)
        self._advance = compile_step(model, disturbance_named("none"), substeps=STEP_MS, floor=True)
        self._disturbed_advance = compile_step(model, disturbance, substeps=STEP_MS, floor=True)
        self._s = place_at_rest(model, State.at(jnp.zeros(3)))
        self._output = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(6), REST])
        self._motors, self._rng = np.zeros(4), np.random.default_rng(0)
        self._steps, self._t, self._due = 0, 0.0, time.monotonic()
        self._server = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._server.bind(("127.0.0.1", PORT))
        except OSError as error:
            self._server.close()
            raise PlantError(f"port {PORT}, to which PX4 connects, is in use ({error.strerror})") from error
        self._server.listen(1)
        self._line: socket.socket | None = None
        self.slip = 0.0
        """Time that the world has lost [s]."""

    def connect(self, patience: float = 20.0) -> None:
        """Wait for PX4.

        Raises:
            PlantError: PX4 does not connect.
        """
        self._server.settimeout(patience)
        try:
            self._line, _ = self._server.accept()
        except TimeoutError:
            raise PlantError(f"PX4 did not connect to port {PORT} within {patience:g} s") from None
        self._line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._due = time.monotonic()

    def step(self) -> None:
        """Send the measurements, take PX4's motor commands, and advance the vehicle by 4 ms, in real time."""
        self._due += STEP
        late = time.monotonic() - self._due
        if late < 0.0:
            time.sleep(-late)
        elif late > LONGEST_LAG:
            self.slip, self._due = self.slip + late, self._due + late
        self._steps += 1
        self._send(self._sensor_message())
        if self._steps % 2 == 0:
            self._send(self._truth_message())
        self._take_motors()
        self._s, output = self._advance(self._s, self._motors, self._t)
        self._output = np.asarray(output, dtype=float)
        self._t += STEP

    def disturb(self) -> None:
        """Begin the disturbance."""
        self._advance, self._t = self._disturbed_advance, 0.0

    def capture(self) -> Reading:
        """Return the state as motion capture measures it."""
        from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

        p, _, v, omega, _ = np.split(self._output, [3, 12, 15, 18])
        draw = self._rng.normal
        turn = Rotation.from_rotvec(TURN * draw(size=3)).as_matrix()
        return Reading(
            time.monotonic(), p + PLACE * draw(size=3), self._attitude() @ turn, v + SPEED * draw(size=3), omega
        )

    def close(self) -> None:
        """Close the connection and the port."""
        if self._line is not None:
            self._line.close()
        self._server.close()

    def _sensor_message(self) -> Any:
        draw, R = self._rng.normal, self._attitude()
        omega = frames.turn_body(self._output[15:18]) + GYRO * draw(size=3)
        force = frames.turn_body(self._output[18:21]) + FORCE * draw(size=3)
        field = frames.turn_body(R.T @ frames.turn_world(NORTH_DOWN)) + FIELD * draw(size=3)
        height = HOME[2] + self._output[2]
        pressure = 1013.25 * (1.0 - 2.25577e-5 * height) ** 5.25588 + 0.01 * draw()  # [hPa]
        return self._dialect.MAVLink_hil_sensor_message(
            self._now(), *force, *omega, *field, pressure, 0.0, height, 20.0, SENSORS
        )

    def _truth_message(self) -> Any:
        p, _, v, omega, force = np.split(self._output, [3, 12, 15, 18])
        north, east, _ = frames.turn_world(p)
        place = [
            round(1e7 * (HOME[0] + north / METRES)),
            round(1e7 * (HOME[1] + east / METRES / math.cos(math.radians(HOME[0])))),
            round(1e3 * (HOME[2] + p[2])),
        ]
        velocity = [round(100.0 * float(each)) for each in frames.turn_world(v)]
        share = frames.turn_body(force) / STANDARD_GRAVITY
        milli_g = [round(1e3 * float(each)) for each in np.clip(share, -32.0, 32.0)]
        q = frames.quaternion_of(self._attitude()).tolist()
        return self._dialect.MAVLink_hil_state_quaternion_message(
            self._now(), q, *frames.turn_body(omega), *place, *velocity, 0, 0, *milli_g
        )

    def _attitude(self) -> np.ndarray:
        return self._output[3:12].reshape(3, 3)

    def _now(self) -> int:
        return round(1e6 * (1.0 + STEP * self._steps))

    def _send(self, message: Any) -> None:
        if self._line is not None:
            with contextlib.suppress(OSError):
                self._line.sendall(message.pack(self._messages))
                self._messages.seq = (self._messages.seq + 1) % 256

    def _take_motors(self) -> None:
        """Wait for PX4's answer, and read its motor commands."""
        if self._line is None:
            return
        self._line.settimeout(ANSWER_S)
        try:
            data = self._line.recv(65_535)
        except (TimeoutError, OSError):
            return
        with contextlib.suppress(self._dialect.MAVError):
            for message in self._messages.parse_buffer(data) or ():
                if message.get_type() == "HIL_ACTUATOR_CONTROLS":
                    motors = np.nan_to_num(np.array(message.controls[:4]))
                    self._motors = np.clip(motors, 0.0, 1.0)[OUR_ROTORS]
