"""A plant that simulates rotorpy's Hummingbird."""

import math

import numpy as np

from ..errors import PlantError
from ..physics.disturbance import Disturbance
from ..physics.effects import ExternalEffects
from ..physics.state import STANDARD_GRAVITY
from .entry import PlantEntry
from .external import ExternalPlant, Pose, thrust_limits
from .extras import check_extra, import_extra

RATE_GAIN = 20.0  # [1/s]; with rotorpy's own default, 1 1/s, the rates lag by a second
STEPS = 2  # rotorpy's rate loop runs once per integrator step: at 100 Hz, as in its own simulations


class RotorpyPlant(ExternalPlant):
    """rotorpy's AscTec Hummingbird (0.5 kg), with its rate loop, motors (5 ms), rotor drag, body drag and integrator.

    Wind and push are constant during a tick. The push is an external acceleration, for which rotorpy does not have an
    input. The push is therefore added to the weight, which is a force in the world frame that rotorpy uses for no other
    purpose. The ground is not modelled.
    """

    def __init__(self, disturbance: Disturbance, *, dt: float = 0.02) -> None:
        params = import_extra("rotorpy.vehicles.hummingbird_params", "rotorpy").quad_params
        speeds = np.array([params["rotor_speed_min"], params["rotor_speed_max"]])
        super().__init__(disturbance, dt, limits=thrust_limits(*(4.0 * params["k_eta"] * speeds**2 / params["mass"])))
        multirotor = import_extra("rotorpy.vehicles.multirotor", "rotorpy").Multirotor
        self._rotation = import_extra("scipy.spatial.transform", "rotorpy").Rotation
        self._quad = multirotor({**params, "k_w": RATE_GAIN}, control_abstraction="cmd_ctbr", aero=True)

    def _launch(self, x: Pose) -> None:
        hover = math.sqrt(self._quad.mass * STANDARD_GRAVITY / (4.0 * self._quad.k_eta))
        q = self._rotation.from_matrix(x.R).as_quat()  # scalar last, as in rotorpy
        self._state = {"x": x.p, "v": x.v, "q": q, "w": np.zeros(3), "rotor_speeds": np.full(4, hover)}

    def _advance(self, u: np.ndarray, effects: ExternalEffects) -> Pose:
        if np.any(effects.gain != 1.0) or np.any(effects.mass != 0.0) or np.any(effects.inertia != 0.0):
            raise PlantError("RotorpyPlant: cannot carry a load or weaken rotors; it supports pushes and wind")
        quad = self._quad
        quad.weight = quad.mass * (np.asarray(effects.push[0]) - np.array([0.0, 0.0, STANDARD_GRAVITY]))
        self._state["wind"] = np.asarray(effects.wind[0])
        command = {"cmd_thrust": u[0] * quad.mass, "cmd_w": u[1:]}
        for _ in range(STEPS):
            self._state = quad.step(self._state, command, self.dt / STEPS)
        attitude = self._rotation.from_quat(self._state["q"]).as_matrix()
        return Pose(self._state["x"], attitude, self._state["v"], self._state["w"])


entry = PlantEntry(
    lambda request: RotorpyPlant(request.disturbance, dt=request.dt),
    "rotorpy's aerodynamics, motors and rate loop, one tick of command delay",
    own_vehicle="hummingbird",
    needs=lambda: check_extra("rotorpy", "rotorpy"),
)
