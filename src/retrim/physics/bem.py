"""Simulate the realistic plant at 1 kHz: blade-element rotors, body drag, the firmware's rate controller and motors."""

from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .betaflight import Betaflight
from .effects import ExternalEffects
from .propeller import AIR_DENSITY, BladeForces, Inflow, hover_coefficient, rotor
from .state import STANDARD_GRAVITY, Command, State
from .substep import SUBSTEP, AbstractSubstepDynamics, RotorState, check_tick, hub_places, rigid_body, signs
from .vehicle import Vehicle

IN_PLANE_GAIN = 3.0  # identified in flight, since blade elements alone underestimate the drag of the whole vehicle
FRAME_FACTOR = 0.9575  # share of the collective thrust that passes the frame


class BemState(eqx.Module):
    """State of the blade-element model."""

    body: RotorState
    inflow: Inflow
    """Inflow of the four rotors; each leaf has four entries."""


@runtime_checkable
class RateController(Protocol):
    """Protocol of an ``eqx.Module`` that turns commands into rotor speeds once per millisecond."""

    thrust_map: Float[Array, ""]
    """Coefficient c in Omega = sqrt(F / 4 c) that the controller assumes for its propellers [N s^2]."""

    def __call__(
        self, vehicle: Vehicle, s: RotorState, u: Command, /
    ) -> tuple[Float[Array, "4"], Float[Array, "3"], Float[Array, "3"]]:
        """Return the rotor speeds [rad/s], the integral of the rate error [rad], and the filtered command [rad/s]."""
        ...


class Loads(NamedTuple):
    """Force and torque on the body, in the body frame."""

    force: Float[Array, "3"]
    """Force [N]."""
    torque: Float[Array, "3"]
    """Torque [Nm]."""


class BemQuadrotor(AbstractSubstepDynamics[BemState]):
    """Quadrotor with blade-element rotors under a CTBR command."""

    vehicle: Vehicle
    loop: RateController
    dt: float = eqx.field(static=True)

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the tick is not a whole number of milliseconds."""
        check_tick(self.dt, "BemQuadrotor")

    @classmethod
    def of(cls, vehicle: Vehicle, dt: float, *, thrust_error: float = 0.035) -> "BemQuadrotor":
        """Return the model of a vehicle.

        Args:
            vehicle: Vehicle constants.
            dt: Control tick [s], a whole number of milliseconds.
            thrust_error: Relative thrust error: in still air, u_hover gives (1 + thrust_error) m g.

        In still air, T / Omega^2 is constant for a propeller, so one number calibrates the whole range of speeds.
        """
        blades = hover_coefficient(vehicle.propeller, vehicle.hover_speed)
        thrust_map = FRAME_FACTOR * blades / (1.0 + thrust_error)
        return cls(vehicle, Betaflight.fit_vehicle(vehicle, thrust_map, blades), dt)

    def init(self, x: State) -> BemState:
        """Return the state of a vehicle that hovers at ``x``, with the rotor speeds for u_hover and settled inflow."""
        vehicle, zero = self.vehicle, jnp.zeros_like(x.p)
        speed = jnp.sqrt(vehicle.mass * STANDARD_GRAVITY / (4.0 * self.loop.thrust_map))
        body = RotorState(x, zero, jnp.ones(4, dtype=x.p.dtype) * speed, zero, zero, zero)
        above = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (4,)), Inflow.above(x.p.dtype))
        _, inflow = self.rotors(body, body.motors, above, zero, steps=16)
        return BemState(body, inflow)

    def state(self, s: BemState) -> State:
        """Return (p, R, v)."""
        return s.body.x

    def with_state(self, s: BemState, x: State) -> BemState:
        """Return ``s`` with (p, R, v) replaced."""
        b = s.body
        return BemState(RotorState(x, b.omega, b.motors, b.integral, b.omega_dot, b.slow_setpoint), s.inflow)

    @property
    def command_limits(self) -> tuple[Command, Command]:
        """The vehicle's smallest and largest commands."""
        return self.vehicle.command_min, self.vehicle.command_max

    def rotor_state(self, s: BemState) -> RotorState:
        """Return the body rates and rotor speeds."""
        return s.body

    def substep(self, s: BemState, u: Command, effects: ExternalEffects) -> BemState:
        """Advance one millisecond under constant loads."""
        vehicle, b = self.vehicle, s.body
        speeds, integral, slow_setpoint = self.loop(vehicle, b, u)
        motors = speeds + (b.motors - speeds) * jnp.exp(-SUBSTEP / vehicle.motor_tau)
        blades, inflow = self.rotors(b, motors, s.inflow, effects.wind)
        loads = self.loads(b, motors, blades, effects)
        mass, inertia = vehicle.mass + effects.mass, vehicle.inertia + effects.inertia
        torque = loads.torque - jnp.cross(effects.moment / mass, loads.force)
        body = rigid_body(b, motors, integral, loads.force, torque, mass, inertia, effects.push, slow_setpoint)
        return BemState(body, inflow)

    def rotors(
        self,
        b: RotorState,
        motors: Float[Array, "4"],
        inflow: Inflow,
        wind: Float[Array, "3"],
        *,
        steps: int = 2,
    ) -> tuple[BladeForces, Inflow]:
        """Return the forces and the inflow of the four rotors, each at the air velocity of its own hub."""
        air = self.hub_velocities(b, wind)
        v_hor = jnp.sqrt(air[:, 0] ** 2 + air[:, 1] ** 2 + 1e-12)

        def one(
            omega: Float[Array, ""], v_hor: Float[Array, ""], v_ver: Float[Array, ""], inflow: Inflow
        ) -> tuple[BladeForces, Inflow]:
            return rotor(self.vehicle.propeller, omega, v_hor, v_ver, inflow, steps=steps)

        return jax.vmap(one)(motors, v_hor, -air[:, 2], inflow)

    def hub_velocities(self, b: RotorState, wind: Float[Array, "3"]) -> Float[Array, "4 3"]:
        """Return the velocity of each hub through the air, in the body frame [m/s]."""
        return (b.x.R.T @ (b.x.v - wind))[None] + jnp.cross(b.omega[None], self.places())

    def places(self) -> Float[Array, "4 3"]:
        """Return the hub positions in the body frame [m]."""
        return hub_places(self.vehicle.arm)

    def loads(self, b: RotorState, motors: Float[Array, "4"], blades: BladeForces, effects: ExternalEffects) -> Loads:
        """Return the force and torque from the rotors, body drag, the motors' yaw reaction and gyroscopic effects."""
        vehicle = self.vehicle
        air = self.hub_velocities(b, effects.wind)
        along = air[:, :2] / jnp.sqrt(air[:, :1] ** 2 + air[:, 1:2] ** 2 + 1e-12)
        in_plane = -IN_PLANE_GAIN * (effects.gain * blades.in_plane)[:, None] * along
        forces = jnp.concatenate([in_plane, (effects.gain * blades.thrust)[:, None]], axis=1)
        yaw = signs(motors.dtype)[2]  # against the spin
        up = jnp.array([0.0, 0.0, 1.0], dtype=motors.dtype)
        spin_up = vehicle.rotor_inertia * jnp.sum(yaw * (motors - b.motors)) / SUBSTEP
        torque = jnp.sum(jnp.cross(self.places(), forces), axis=0)
        torque = torque + (jnp.sum(yaw * effects.gain * blades.torque) + spin_up) * up
        spin = -vehicle.rotor_inertia * jnp.sum(yaw * motors) * up  # angular momentum of the rotors
        torque = torque - jnp.cross(b.omega, spin)
        obstruction = jnp.array([1.0, 1.0, FRAME_FACTOR], dtype=motors.dtype)
        return Loads(obstruction * jnp.sum(forces, axis=0) + self.body_drag(b, effects.wind), torque)

    def body_drag(self, b: RotorState, wind: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the body drag F_k = -1/2 rho (c A)_k u_k |u_k| in the body frame [N]."""
        through = b.x.R.T @ (b.x.v - wind)
        return -0.5 * AIR_DENSITY * self.vehicle.drag_area * through * jnp.abs(through)
