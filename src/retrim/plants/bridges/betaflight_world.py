"""Simulated world for a board with Betaflight firmware: rotors, body and air, in real time with 1 ms steps."""

import socket
import threading
import time
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ...errors import MessageError, PlantError
from ...physics.bem import BemQuadrotor
from ...physics.disturbance import Disturbance
from ...physics.state import State
from ...physics.substep import SUBSTEP
from .betaflight_firmware import in_real_time
from .betaflight_wire import MOTORS, REST, STATE, STICKS, motors_of, state_packet, sticks_packet
from .rotor_world import compile_step, place_at_rest
from .vehicle_state import VehicleState

GROUND = 0.0  # [m]
HOST = "127.0.0.1"
STICKS_EVERY = 5  # [ms] between receiver packets
LONGEST_LAG = 0.02  # [s], largest delay that the world still makes up for


class MotorListener:
    """Receives motor commands, but only from the first sender of valid commands."""

    def __init__(self, port: int = MOTORS) -> None:
        """Open the port.

        Raises:
            PlantError: The port is in use.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((HOST, port))
        except OSError as error:
            self._socket.close()
            raise PlantError(f"port {port}, on which motors are received, is in use ({error.strerror})") from error
        self._socket.setblocking(False)
        self._board: Any = None
        self.port: int = self._socket.getsockname()[1]
        self.refusals = 0
        """Number of invalid packets and packets from other senders."""

    def hear(self, motors: np.ndarray) -> np.ndarray:
        """Return the newest motor commands, or ``motors`` if there are no new ones."""
        while True:
            try:
                packet, sender = self._socket.recvfrom(256)
            except BlockingIOError:
                return motors
            try:
                result = motors_of(packet)
            except MessageError:
                self.refusals += 1
                continue
            self._board = self._board or sender
            if sender == self._board:
                motors = result
            else:
                self.refusals += 1

    def close(self) -> None:
        """Close the port."""
        self._socket.close()


class World:
    """A vehicle on a stand or in free flight, simulated in a thread; other threads may call the methods."""

    def __init__(self, model: BemQuadrotor, disturbance: Disturbance, fastest: float) -> None:
        """Build a world with the vehicle on the stand, and open the sockets.

        Args:
            model: The vehicle; the model's rate controller is not used.
            disturbance: External effects, as a function of the time since the release [s] and the state.
            fastest: Body rate at full stick [rad/s].

        Raises:
            PlantError: The port for motor commands is in use.
        """
        self._model, self._fastest = model, fastest
        self._ears = MotorListener()
        self._out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._advance = compile_step(model, disturbance)
        self._over, self._lock = threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._run, name="betaflight world", daemon=True)
        self.motors, self.slip = np.zeros(4), 0.0
        """Last motor commands, 0 to 1, and the time that the world has lost since the release [s]."""
        self._sticks, self._is_armed, self._free = (0.0, np.zeros(3)), False, False
        self._switches: tuple[int, ...] = ()
        self.place(State.at(jnp.array([0.0, 0.0, 1.0])))
        self._thread.start()

    def place(self, x: State) -> None:
        """Put the vehicle on the stand at a position and heading."""
        s = place_at_rest(self._model, x)
        with self._lock:
            self._free, self._s, self._t = False, s, 0.0
            self._output = np.concatenate(
                [np.asarray(leaf, dtype=float).ravel() for leaf in (x.p, x.R, x.v)] + [np.zeros(3), REST]
            )
            self._stamp = time.monotonic()

    def tell(self, throttle: float, omega: np.ndarray, *, armed: bool = True, switches: Sequence[int] = ()) -> None:
        """Move the sticks and the switches; see :func:`.betaflight_wire.sticks_packet`."""
        with self._lock:
            self._sticks, self._is_armed = (throttle, np.array(omega, dtype=float)), armed
            self._switches = tuple(switches)

    def release(self) -> None:
        """Release the vehicle."""
        with self._lock:
            self._free, self.slip = True, 0.0

    def state(self) -> VehicleState:
        """Return the newest state."""
        with self._lock:
            x, stamp = self._output, self._stamp if self._free else time.monotonic()
        result = VehicleState(x[:3], x[3:12].reshape(3, 3), x[12:15], x[15:18], max(0.0, time.monotonic() - stamp))
        return result._replace(truth=result)

    def close(self) -> None:
        """Stop the thread and close the sockets."""
        self._over.set()
        self._thread.join(2.0)
        self._ears.close()
        self._out.close()

    def _run(self) -> None:
        due, k, was_free = time.monotonic(), 0, True
        while not self._over.is_set():
            due, k = due + SUBSTEP, k + 1
            late = time.monotonic() - due
            if late < 0.0:
                time.sleep(-late)
            elif late > LONGEST_LAG:
                self.slip += late if self._free else 0.0
                due += late
            self.motors = self._ears.hear(self.motors)
            if was_free != self._free:  # set again at a release, because the process has since set its own priority
                was_free = self._free
                in_real_time(0)
            with self._lock:
                if self._free:
                    self._s, output = self._advance(self._s, self.motors, self._t)
                    self._t += SUBSTEP
                    self._output, self._stamp = np.asarray(output, dtype=float), time.monotonic()
                    if not np.isfinite(self._output).all() or self._output[2] < GROUND:
                        self._over.set()  # contact with the ground is not simulated
                rates = self._output[15:18] if self._free else np.zeros(3)
                specific_force = self._output[18:21] if self._free else REST
                attitude = self._output[3:12].reshape(3, 3)
                sticks, is_armed, switches = self._sticks, self._is_armed, self._switches
            self._out.sendto(state_packet(rates, specific_force, attitude), (HOST, STATE))
            if k % STICKS_EVERY == 0:
                packet = sticks_packet(*sticks, self._fastest, armed=is_armed, switches=switches)
                self._out.sendto(packet, (HOST, STICKS))
