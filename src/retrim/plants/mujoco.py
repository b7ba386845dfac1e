"""A plant that simulates a quadrotor in MuJoCo's medium."""

import math
from typing import Any

import numpy as np

from ..physics.disturbance import Disturbance
from ..physics.effects import ExternalEffects
from ..physics.state import STANDARD_GRAVITY
from ..physics.substep import SIGNS
from ..physics.vehicle import Vehicle
from .entry import PlantEntry
from .external import ExternalPlant, Pose, whole_steps
from .extras import check_extra, import_extra
from .plant import as_numpy

STEP = 2e-3  # [s]
RATE_GAIN = 20.0  # [1/s]

MODEL = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast" gravity="0 0 -{gravity}" density="1.225" viscosity="1.8e-5">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body name="vehicle">
      <freejoint/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia}"/>
      <geom type="ellipsoid" size="{axes}" mass="0" fluidshape="ellipsoid" fluidcoef="0.5 0 0 0 0"/>
      <site name="rotors"/>
    </body>
  </worldbody>
  <actuator>
    <general site="rotors" gear="0 0 1 0 0 0" ctrlrange="{thrust}" dyntype="filterexact" dynprm="{tau}"/>
    <general site="rotors" gear="0 0 0 1 0 0"/>
    <general site="rotors" gear="0 0 0 0 1 0"/>
    <general site="rotors" gear="0 0 0 0 0 1"/>
  </actuator>
</mujoco>
"""
"""MuJoCo model in SI units. Density and viscosity are those of air. The thrust lags with the motors' time constant."""


def semi_axes(drag_area: np.ndarray) -> np.ndarray:
    """Return the semi-axes [m] of the ellipsoid whose silhouette along each axis has the area ``drag_area`` [m^2].

    The silhouettes have the areas pi b c, pi a c and pi a b. MuJoCo's drag is density k A v^2; with k = 0.5, MuJoCo's A
    is our c A.
    """
    return math.sqrt(np.prod(drag_area) / math.pi**3) / (drag_area / math.pi)


class MujocoPlant(ExternalPlant):
    """One rigid body in MuJoCo, with thrust at its centre, torques from a rate loop, and drag from the medium.

    Steps are 2 ms long. The drag follows from the vehicle's ``drag_area``. Rotor drag is not modelled, so wind moves
    this plant less than the other plants. The rate loop is proportional, so the torque from a weak rotor causes a
    steady error. The rate loop does not account for loads. Loads and weak rotors are updated once per tick; wind and
    push are updated at each step. The ground is not modelled.
    """

    def __init__(self, vehicle: Vehicle, disturbance: Disturbance, *, dt: float = 0.02) -> None:
        low, high = vehicle.command_min, vehicle.command_max
        limits = as_numpy(low).astype(np.float64), as_numpy(high).astype(np.float64)
        super().__init__(disturbance, dt, limits=limits, instants=whole_steps(dt, STEP))
        self._mass = float(vehicle.mass)
        self._inertia = np.asarray(vehicle.inertia, dtype=np.float64)
        arm = np.asarray(vehicle.arm, dtype=np.float64)
        self._levers = np.array([arm[1], arm[0], float(vehicle.torque_ratio)])
        # Torque of two rotors at full thrust and two at rest:
        self._torque_max = self._levers * float(vehicle.thrust_max) / 2.0
        self._mujoco: Any = import_extra("mujoco", "mujoco")
        text = MODEL.format(
            step=STEP,
            gravity=STANDARD_GRAVITY,
            mass=self._mass,
            inertia=_numbers(self._inertia),
            axes=_numbers(semi_axes(np.asarray(vehicle.drag_area, dtype=np.float64))),
            thrust=_numbers(self._mass * np.array([float(low.c), float(high.c)])),
            tau=float(vehicle.motor_tau),
        )
        self._model = self._mujoco.MjModel.from_xml_string(text)
        self._model.geom_fluid[0, 6:] = 0.0  # no added mass, since the ellipsoid only represents drag areas
        self._data = self._mujoco.MjData(self._model)
        self._load = np.zeros(4)

    def _launch(self, x: Pose) -> None:
        self._mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:3], self._data.qvel[:3] = x.p, x.v
        self._mujoco.mju_mat2Quat(self._data.qpos[3:], x.R.ravel())
        self._data.act[0] = self._mass * STANDARD_GRAVITY

    def _advance(self, u: np.ndarray, effects: ExternalEffects) -> Pose:
        model, data = self._model, self._data
        gain, load = np.asarray(effects.gain[0]), np.append(effects.mass[0], effects.inertia[0])
        self._carry(load)
        model.actuator_gainprm[0, 0] = gain.mean()
        uneven = self._levers * (np.array(SIGNS) @ gain) / 4.0  # torque per thrust [m]; zero for equal gains
        data.ctrl[0] = u[0] * self._mass
        for push, wind in zip(effects.push, effects.wind, strict=True):
            omega = data.qvel[3:]  # body frame
            torque = self._inertia * RATE_GAIN * (u[1:] - omega) + np.cross(omega, self._inertia * omega)
            data.ctrl[1:] = np.clip(torque, -self._torque_max, self._torque_max) + uneven * data.act[0]
            data.xfrc_applied[1, :3] = (self._mass + load[0]) * push
            model.opt.wind[:] = wind
            self._mujoco.mj_step(model, data)
        R = np.empty(9)
        self._mujoco.mju_quat2Mat(R, data.qpos[3:])
        return Pose(data.qpos[:3].copy(), R.reshape(3, 3), data.qvel[:3].copy(), data.qvel[3:].copy())

    def _carry(self, load: np.ndarray) -> None:
        """Add ``load`` = [mass [kg], inertia [kg m^2]] to the vehicle's mass and inertia."""
        if not np.array_equal(load, self._load):
            self._model.body_mass[1] = self._mass + load[0]
            self._model.body_inertia[1] = self._inertia + load[1:]
            spare = self._mujoco.MjData(self._model)  # mj_setConst changes the data that it receives
            self._mujoco.mj_setConst(self._model, spare)
            self._load = load


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in values)


entry = PlantEntry(
    lambda request: MujocoPlant(request.vehicle, request.disturbance, dt=request.dt),
    "a body in MuJoCo's medium, one tick of command delay",
    needs=lambda: check_extra("mujoco", "mujoco"),
)
