"""The simplified simulation in which GP-MPC and neural MPC were evaluated, as a plant.

The constants are facts from the publication (arXiv 2203.07747, Table III) and its description: 1 kg, four rotors of
20 N that follow their inputs at once, body drag, and rotors that lose a part of their input and are noisy. The
publication commands rotor thrusts. This plant takes thrust and body rates, with a fast rate loop on board.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Float, Key

from retrim.config.vehicle_file import VehicleSpec
from retrim.config.vehicles import make_vehicle
from retrim.physics.effects import ExternalEffects
from retrim.physics.state import Command, State
from retrim.physics.substep import AbstractSubstepDynamics, RotorState, check_tick, rigid_body, signs
from retrim.plants.entry import PlantEntry, PlantRequest
from retrim.plants.plant import Plant
from retrim.plants.sim import SimPlant

MASS, INERTIA, ROTOR_MAX = 1.0, (0.03, 0.03, 0.06), 20.0  # [kg], [kg m^2], [N]
ARM, TORQUE_RATIO = 0.235 / 2.0**0.5, 0.013  # [m]: rotors at the corners of a square, 0.235 m from the centre
LINEAR_DRAG, QUADRATIC_DRAG = (0.3, 0.3, 0.0), 0.08  # per mass: [1/s] and [1/m]
LOSS, LOSS_SCALE, NOISE = 0.1, 1.3, 0.02  # an input u loses LOSS (u / LOSS_SCALE)^2; its noise is NOISE sqrt(u)
RATES_MAX = (35.0, 35.0, 3.0)  # [rad/s], of the on-board rate loop; without drag, the lemniscate needs 31 at 12 m/s
RATE_GAINS = (20.0, 20.0, 5.0)  # [1/s], of the on-board rate loop; twice as fast, attitude steps exceed the torque
LEAST_AUTHORITY = 1.25  # [N] by which torque may change a rotor's thrust, even if the collective thrust is smaller


class NoisyState(eqx.Module):
    """State of the vehicle, and the random key of its rotor noise."""

    body: RotorState
    key: Key[Array, ""]


class SimplifiedQuadrotor(AbstractSubstepDynamics[NoisyState]):
    """The simplified quadrotor with a rate loop on board; loads and weak rotors act as on other plants."""

    limits: tuple[Command, Command]
    """Smallest and largest command."""
    key: Key[Array, ""]
    """Seed of the rotor noise."""
    dt: float = eqx.field(static=True)

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the tick is not a whole number of milliseconds."""
        check_tick(self.dt, "SimplifiedQuadrotor")

    @property
    def command_limits(self) -> tuple[Command, Command]:
        """The vehicle's smallest and largest commands."""
        return self.limits

    def init(self, x: State) -> NoisyState:
        """Return the state of a vehicle that hovers at ``x``, without rotation."""
        zero = jnp.zeros_like(x.p)
        return NoisyState(RotorState(x, zero, jnp.zeros(4, dtype=x.p.dtype), zero, zero, zero), self.key)

    def state(self, s: NoisyState) -> State:
        """Return (p, R, v)."""
        return s.body.x

    def with_state(self, s: NoisyState, x: State) -> NoisyState:
        """Return ``s`` with (p, R, v) replaced."""
        return NoisyState(dataclasses.replace(s.body, x=x), s.key)

    def rotor_state(self, s: NoisyState) -> RotorState:
        """Return the body rates; the rotor speeds are zero, since the model has none."""
        return s.body

    def substep(self, s: NoisyState, u: Command, effects: ExternalEffects) -> NoisyState:
        """Advance one millisecond: rate loop, rotors, drag and rigid body."""
        b, dtype = s.body, s.body.x.p.dtype
        key, draw = random.split(s.key)
        inertia, levers = jnp.array(INERTIA, dtype), jnp.array([ARM, ARM, TORQUE_RATIO], dtype)
        torque = inertia * jnp.array(RATE_GAINS, dtype) * (u.omega - b.omega) + jnp.cross(b.omega, inertia * b.omega)
        inputs = jnp.clip(mix(MASS * u.c / 4.0, torque / levers / 4.0) / ROTOR_MAX, 0.0, 1.0)
        noise = NOISE * jnp.sqrt(inputs) * random.normal(draw, (4,), dtype)
        acting = effects.gain * ROTOR_MAX * jnp.clip(inputs - LOSS * (inputs / LOSS_SCALE) ** 2 + noise, 0.0, 1.0)
        up = jnp.array([0.0, 0.0, 1.0], dtype)
        v = b.x.R.T @ (b.x.v - effects.wind)
        drag = MASS * (jnp.array(LINEAR_DRAG, dtype) * v + QUADRATIC_DRAG * v * jnp.abs(v))
        mass, whole = MASS + effects.mass, inertia + effects.inertia
        force = jnp.sum(acting) * up - drag
        turning = levers * (signs(dtype) @ acting) - jnp.cross(effects.moment / mass, force)
        return NoisyState(rigid_body(b, b.motors, b.integral, force, turning, mass, whole, effects.push), key)


def mix(mean: Float[Array, ""], change: Float[Array, "3"]) -> Float[Array, "4"]:
    """Return the thrust of each rotor [N], with torques that the rotors can produce without a change of their sum.

    Roll and pitch come first, and yaw has what remains. Without this limit, a large torque would cut off rotors at zero
    and raise the collective thrust: the inertia is large, and at hover the rotors can produce 54 rad/s^2 only.

    Args:
        mean: Mean thrust of the rotors [N].
        change: Change of a rotor's thrust for the desired torque about each axis [N].
    """
    room = jnp.minimum(jnp.maximum(mean, LEAST_AUTHORITY), ROTOR_MAX - mean)
    tilt = signs(mean.dtype)[:2].T @ change[:2]
    largest = jnp.max(jnp.abs(tilt))
    tilt = tilt * jnp.minimum(1.0, room / jnp.maximum(largest, 1e-6))
    rest = jnp.maximum(room - largest, 0.0)
    return mean + tilt + signs(mean.dtype)[2] * jnp.clip(change[2], -rest, rest)


def vehicle_file() -> VehicleSpec:
    """Return the vehicle file of the quadrotor: mass, inertia, arm and limits, without drag and losses."""
    return VehicleSpec(
        name="simplified",
        mass=MASS,
        inertia=INERTIA,
        arm=(ARM, ARM),
        thrust_max=4.0 * ROTOR_MAX,
        rates_max=RATES_MAX,
        motor_tau=0.001,
        rate_lag=(1.0 / RATE_GAINS[0], 1.0 / RATE_GAINS[1], 1.0 / RATE_GAINS[2]),
        command_delay=0.0,
    )


def _make(r: PlantRequest) -> Plant:
    own = make_vehicle(vehicle_file())
    model = SimplifiedQuadrotor((own.command_min, own.command_max), random.key(r.seed), r.dt)
    return SimPlant(model, r.disturbance, delay_s=0.0, sensors=r.sensors, fault=r.fault, seed=r.seed)


entry = PlantEntry(
    _make,
    "the simplified quadrotor of GP-MPC and neural MPC at 1 kHz: drag, rotor losses and noise, without delay",
    own_vehicle="simplified",
    has_sensors=True,
    has_faults=True,
    has_disturbance_state=True,
)
