"""Simulate rotors at 1 kHz with a rate loop, mixer, motor lag, thrust-map error, rotor drag and a rigid body.

The model is the first realistic plant, and a high-fidelity model for :class:`StraightThrough`. Rotors are ordered
front-right, back-left, back-right, front-left; the first two turn so that their drag torque acts towards -z.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .effects import ExternalEffects
from .rate_tuning import Gains, is_damped, tune
from .state import Command, State
from .substep import SUBSTEP, AbstractSubstepDynamics, RotorState, check_tick, rigid_body, signs
from .vehicle import Vehicle


class RateLoop(eqx.Module):
    """PID controller of the body rates, in units of angular acceleration. All gains are per axis."""

    kp: Float[Array, "3"]
    """Gain of the rate error [1/s]."""
    ki: Float[Array, "3"]
    """Gain of the integral of the rate error [1/s^2]."""
    kd: Float[Array, "3"]
    """Gain of the measured angular acceleration [-]."""
    integral_max: Float[Array, ""]
    """Limit of the integral [rad]."""


def rate_loop(motor_tau: Float[Array, ""]) -> RateLoop:
    """Return gains with which both of the paper's quadrotors settle in about 0.1 s, or gains tuned for slow motors.

    Args:
        motor_tau: Motor time constant [s].
    """
    plain = Gains(jnp.array([25.0, 25.0, 12.5]), jnp.array([37.0, 37.0, 37.0]), jnp.array([0.05, 0.05, 0.0]))
    keep = is_damped(plain, jnp.zeros(3), motor_tau, least_margin=5.0)
    kp, ki, kd = (jnp.where(keep, old, new) for old, new in zip(plain, tune(plain, motor_tau), strict=True))
    return RateLoop(kp=kp, ki=ki, kd=kd, integral_max=jnp.array(0.1))


class LinearDragQuadrotor(AbstractSubstepDynamics[RotorState]):
    """Rotor-level quadrotor under a CTBR command.

    ``thrust_gain`` multiplies the true thrust, to model the error of the thrust map. ``drag`` [1/s] is the
    linear rotor drag per body axis at hover speed; the drag is proportional to the rotor speeds (blade-element theory,
    first order).
    """

    vehicle: Vehicle
    loop: RateLoop
    thrust_gain: Float[Array, ""]
    drag: Float[Array, "3"]
    dt: float = eqx.field(static=True)

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the tick is not a whole number of milliseconds."""
        check_tick(self.dt, "LinearDragQuadrotor")

    @classmethod
    def of(cls, vehicle: Vehicle, dt: float, *, thrust_error: float = 0.035) -> "LinearDragQuadrotor":
        """Return the model of a vehicle, with a rotor drag of 0.3, 0.3 and 0.37 1/s.

        Args:
            vehicle: Vehicle constants.
            dt: Control tick [s], a whole number of milliseconds.
            thrust_error: Relative thrust error; 0.1 means 10 % more thrust than commanded.
        """
        return cls(
            vehicle, rate_loop(vehicle.motor_tau), jnp.array(1.0 + thrust_error), jnp.array([0.3, 0.3, 0.37]), dt
        )

    def init(self, x: State) -> RotorState:
        """Return the state of a vehicle that hovers at ``x``, without rotation."""
        motors = jnp.ones(4, dtype=x.p.dtype) * self.vehicle.hover_speed
        return RotorState(x, jnp.zeros_like(x.p), motors, jnp.zeros_like(x.p), jnp.zeros_like(x.p), jnp.zeros_like(x.p))

    def state(self, s: RotorState) -> State:
        """Return (p, R, v)."""
        return s.x

    def with_state(self, s: RotorState, x: State) -> RotorState:
        """Return ``s`` with (p, R, v) replaced."""
        return RotorState(x, s.omega, s.motors, s.integral, s.omega_dot, s.slow_setpoint)

    @property
    def command_limits(self) -> tuple[Command, Command]:
        """The vehicle's smallest and largest commands."""
        return self.vehicle.command_min, self.vehicle.command_max

    def rotor_state(self, s: RotorState) -> RotorState:
        """Return the body rates and rotor speeds."""
        return s

    def substep(self, s: RotorState, u: Command, effects: ExternalEffects) -> RotorState:
        """Advance one millisecond: rate loop, motors, forces and rigid body."""
        vehicle = self.vehicle
        speeds, integral = self.rate_loop(s, u)
        motors = speeds + (s.motors - speeds) * jnp.exp(-SUBSTEP / vehicle.motor_tau)
        thrusts = effects.gain * vehicle.thrust_coefficient * self.thrust_gain * motors**2
        force, torque = self.wrench(s, motors, thrusts, effects.wind)
        mass, inertia = vehicle.mass + effects.mass, vehicle.inertia + effects.inertia
        torque = torque - jnp.cross(effects.moment / mass, force)
        return rigid_body(s, motors, integral, force, torque, mass, inertia, effects.push)

    def rate_loop(self, s: RotorState, u: Command) -> tuple[Float[Array, "4"], Float[Array, "3"]]:
        """Return the commanded rotor speeds [rad/s] and the integral of the rate error [rad]."""
        vehicle, loop = self.vehicle, self.loop
        low, high = vehicle.command_min, vehicle.command_max
        error = jnp.clip(u.omega, low.omega, high.omega) - s.omega
        integral = jnp.clip(s.integral + SUBSTEP * error, -loop.integral_max, loop.integral_max)
        angular_acceleration = loop.kp * error + loop.ki * integral - loop.kd * s.omega_dot
        torque = vehicle.inertia * angular_acceleration + jnp.cross(s.omega, vehicle.inertia * s.omega)
        thrusts = self.mix(vehicle.mass * jnp.clip(u.c, low.c, high.c), torque)
        idle = vehicle.thrust_coefficient * vehicle.motor_min**2
        return jnp.sqrt(jnp.clip(thrusts, idle, vehicle.thrust_max / 4.0) / vehicle.thrust_coefficient), integral

    def mix(self, thrust: Float[Array, ""], torque: Float[Array, "3"]) -> Float[Array, "4"]:
        """Return the thrust of each rotor [N] for the collective ``thrust`` [N] and the ``torque`` [Nm]."""
        arm, kappa = self.vehicle.arm, self.vehicle.torque_ratio
        levers = jnp.stack([arm[1], arm[0], kappa])
        return thrust / 4.0 + signs(thrust.dtype).T @ (torque / levers) / 4.0

    def wrench(
        self, s: RotorState, motors: Float[Array, "4"], thrusts: Float[Array, "4"], wind: Float[Array, "3"]
    ) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Return the body-frame force [N] and torque [Nm] of all rotors: the inverse of the mixer, plus rotor drag."""
        vehicle = self.vehicle
        levers = jnp.stack([vehicle.arm[1], vehicle.arm[0], vehicle.torque_ratio])
        torque = levers * (signs(thrusts.dtype) @ thrusts)
        drag = vehicle.mass * self.drag * (jnp.mean(motors) / vehicle.hover_speed) * (s.x.R.T @ (s.x.v - wind))
        up = jnp.array([0.0, 0.0, 1.0], dtype=thrusts.dtype)
        return jnp.sum(thrusts) * up - drag, torque
