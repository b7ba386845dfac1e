"""A plant that simulates crazyflow's identified Crazyflie."""

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..physics.disturbance import Disturbance
from ..physics.effects import ExternalEffects
from ..physics.state import STANDARD_GRAVITY
from .entry import PlantEntry
from .external import ExternalPlant, Pose, thrust_limits, whole_steps
from .extras import check_extra, import_extra

DRONE = "cf21B_500"
FREQUENCY = 500  # [Hz], rate of the dynamics and of the rate loop
ORDER = [0, 2, 1, 3]  # our rotors in crazyflow's order: front-right, back-right, back-left, front-left

_building = threading.Lock()


@contextlib.contextmanager
def _its_jax() -> Iterator[None]:
    """Within the context, set the JAX options that crazyflow needs: single precision and free promotion."""
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


class CrazyflowPlant(ExternalPlant):
    """crazyflow's first-principles model of the Crazyflie 2.1 Brushless, in single precision.

    The vehicle weighs 43 g and can lift another 38 g. The plant uses crazyflow's stages without its scene, so
    there is neither a floor nor a MuJoCo model. crazyflow's rate loop is the firmware's Mellinger controller, which
    also levels the vehicle. The controller's attitude gains are set to zero here, as crazyflow itself recommends for
    tracking body rates.

    crazyflow does not model wind. Since its body drag is linear in velocity, the effect of wind is exactly the drag at
    the velocity -wind. This drag is applied as a force at each step. External effects are constant during a tick.
    """

    def __init__(self, disturbance: Disturbance, *, dt: float = 0.02) -> None:
        steps = whole_steps(dt, 1.0 / FREQUENCY)
        with _building, _its_jax():
            self._hovering, self._step, thrusts = _simulator(steps)
        self._mass = float(self._hovering.params.mass[0])
        super().__init__(disturbance, dt, limits=thrust_limits(*(4.0 * thrusts / self._mass)))
        self._rotation = import_extra("scipy.spatial.transform", "crazyflow").Rotation

    def _launch(self, x: Pose) -> None:
        q = self._rotation.from_matrix(x.R).as_quat()  # scalar last, as in crazyflow
        with _its_jax():
            # bound to the device, since an array without one would cause a second compilation
            p, q, v = jax.device_put([a[None, None].astype(np.float32) for a in (x.p, q, x.v)], _device())
            self._data = self._hovering.replace(states=self._hovering.states.replace(pos=p, quat=q, vel=v))

    def _advance(self, u: np.ndarray, effects: ExternalEffects) -> Pose:
        command = np.append(u[1:], u[0] * self._mass)
        first = jax.tree.map(lambda leaf: np.asarray(leaf[0], dtype=np.float32), effects)
        with _its_jax():
            self._data = self._step(self._data, command.astype(np.float32), first)
        states = self._data.states
        moving = (states.pos, states.quat, states.vel, states.ang_vel)
        p, q, v, omega = (np.asarray(a, dtype=np.float64)[0, 0] for a in moving)
        return Pose(p, self._rotation.from_quat(q).as_matrix(), v, omega)


def _device() -> jax.Device:
    """Return the CPU, since one world is too small for other devices."""
    return jax.devices("cpu")[0]


@functools.cache
def _simulator(steps: int) -> tuple[Any, Callable[[Any, np.ndarray, ExternalEffects], Any], np.ndarray]:
    """Return a hovering Crazyflie, the compiled function for ``steps`` steps, and a rotor's thrust limits [N].

    All plants share these three objects.
    """
    sim = import_extra("crazyflow.sim.sim", "crazyflow")
    parts, functional = (
        import_extra("crazyflow.sim.data", "crazyflow"),
        import_extra("crazyflow.sim.functional", "crazyflow"),
    )
    rotation = import_extra("jax.scipy.spatial.transform", "crazyflow").Rotation
    to_speed = import_extra("crazyflow.control.transform", "crazyflow").motor_force2rotor_vel
    dynamics, mode = sim.Dynamics.first_principles, sim.Control.body_rate
    drone, device = sim.Drone(DRONE), _device()
    lower, upper = sim.rotor_vel_limits(dynamics, drone)
    control = [stage for _, stage in sim.build_control_fns(mode, dynamics)]
    move = sim.select_integrate_fn(sim.Integrator.default, sim.select_dynamics_fn(dynamics))

    data = parts.SimData(
        states=parts.SimState.create(1, 1, device),
        controls=parts.SimControls.create(1, 1, mode, drone, None, None, FREQUENCY, FREQUENCY, device),
        params=parts.SimParams.create(dynamics, drone, device),
        core=parts.SimCore.create(FREQUENCY, 1, 1, [0], 0, device),
    )
    vehicle, loop = data.params, data.controls.body_rate
    gains = loop.params | {name: jnp.zeros_like(loop.params[name]) for name in ("kR", "ki_m")}
    hover = to_speed(vehicle.mass * STANDARD_GRAVITY / 4.0, vehicle.rpm2thrust)
    data = data.replace(
        states=data.states.replace(rotor_vel=jnp.full_like(data.states.rotor_vel, hover[0])),
        controls=data.controls.replace(body_rate=loop.replace(params=gains)),
    )

    @jax.jit
    def fly(data: Any, command: jax.Array, effects: ExternalEffects) -> Any:
        inertia = vehicle.J + jnp.diag(effects.inertia)
        gain = effects.gain[jnp.array(ORDER), None]
        vehicle_with_mass = vehicle.replace(
            mass=vehicle.mass + effects.mass,
            J=inertia,
            J_inv=jnp.linalg.inv(inertia),
            rpm2thrust=gain * vehicle.rpm2thrust,
            rpm2torque=gain * vehicle.rpm2torque,
        )

        def step(data: Any, _: None) -> tuple[Any, None]:
            for stage in control:
                data = stage(data)
            data = sim.clip_rotor_vel_cmd(data, lower, upper, dynamics)
            to_world = rotation.from_quat(data.states.quat[0, 0]).as_matrix()
            blown = to_world @ (vehicle.drag_matrix @ (to_world.T @ -effects.wind))
            force = (blown + vehicle_with_mass.mass * effects.push)[None, None]
            return sim.increment_steps(move(data.replace(states=data.states.replace(force=force)))), None

        data = functional.body_rate_control(data, command[None, None])
        after, _ = jax.lax.scan(step, data.replace(params=vehicle_with_mass), length=steps)
        return after.replace(params=data.params)

    thrusts = sim.load_dynamics_params(dynamics, drone)
    return data, fly, np.array([thrusts["thrust_min"], thrusts["thrust_max"]], dtype=np.float64)


entry = PlantEntry(
    lambda request: CrazyflowPlant(request.disturbance, dt=request.dt),
    "crazyflow's identified Crazyflie, one tick of command delay",
    own_vehicle=DRONE,
    needs=lambda: check_extra("crazyflow", "crazyflow"),
)
