"""Define the constants of quadrotors, each with its source.

The quadrotors are returned by functions, not stored as constants, since creating an array at import would start a JAX
backend.
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .propeller import Propeller, five_inch, three_inch
from .state import STANDARD_GRAVITY, Command


class Esc(eqx.Module):
    """The speed controllers' map from throttle to rotor speed: Omega = base + linear d + root sqrt(d).

    The firmware sends d = throttle (2048 - d_min) + d_min.
    """

    base: Float[Array, ""]
    """Coefficient ``base`` at the battery's nominal voltage [rad/s]."""
    linear: Float[Array, ""]
    """Coefficient ``linear`` [rad/s]."""
    root: Float[Array, ""]
    """Coefficient ``root`` [rad/s]."""
    d_min: Float[Array, ""]
    idle: Float[Array, ""]
    """Smallest throttle."""

    def speed(self, throttle: Float[Array, "*rotors"]) -> Float[Array, "*rotors"]:
        """Return the rotor speed [rad/s]."""
        d = throttle * (2048.0 - self.d_min) + self.d_min
        return self.base + self.linear * d + self.root * jnp.sqrt(d)

    def throttle(self, speed: Float[Array, "*rotors"]) -> Float[Array, "*rotors"]:
        """Return the throttle for a rotor speed, the inverse of :meth:`speed`."""
        rise = jnp.maximum(speed - self.base, 0.0)
        root_d = 2.0 * rise / (self.root + jnp.sqrt(self.root**2 + 4.0 * self.linear * rise))
        return (root_d**2 - self.d_min) / (2048.0 - self.d_min)


class Vehicle(eqx.Module):
    """Constants of a quadrotor in X configuration. Every leaf is an array, so a new mass needs no recompilation."""

    mass: Float[Array, ""]
    """Mass [kg]."""
    inertia: Float[Array, "3"]
    """Diagonal of the inertia tensor in the body frame [kg m^2]."""
    arm: Float[Array, "2"]
    """Distance of the rotors from the centre along body x and y [m]."""
    thrust_max: Float[Array, ""]
    """Static thrust of all four rotors together [N]."""
    omega_max: Float[Array, "3"]
    """Largest body rates that the rate loop accepts [rad/s]."""
    motor_tau: Float[Array, ""]
    """Motor time constant [s]."""
    motor_min: Float[Array, ""]
    """Idle rotor speed [rad/s]."""
    motor_max: Float[Array, ""]
    """Largest rotor speed [rad/s]."""
    rotor_inertia: Float[Array, ""]
    """Inertia of one motor and propeller about its axis [kg m^2]."""
    thrust_coefficient: Float[Array, ""]
    """Coefficient c_T in T = c_T Omega^2 for one rotor [N s^2]."""
    torque_ratio: Float[Array, ""]
    """Ratio kappa in Q = kappa T for one rotor [m]."""
    drag_area: Float[Array, "3"]
    """Drag area c A of the body along its axes [m^2]."""
    propeller: Propeller
    esc: Esc
    rate_lag: Float[Array, "3"] | None = None
    """Time constants with which the body rates follow their commands, if known [s]. Training models use these;
    the time constants of a plant follow from its motors and its rate loop."""
    rate_damping: Float[Array, "3"] | None = None
    """Damping ratios of the rate loops; None for first-order loops."""

    def __check_init__(self) -> None:
        """Raise a ``ValueError`` that names the field if such a vehicle cannot exist; traced values are not checked."""
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(self)):
            return
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is None or isinstance(value, eqx.Module):
                continue
            numbers = value.tolist() if value.ndim else [value.item()]  # avoids a compilation for a check
            if not all(math.isfinite(number) and number > 0 for number in numbers):
                raise ValueError(f"Vehicle.{field.name} = {value} must be positive and finite")
        if self.thrust_max <= self.mass * STANDARD_GRAVITY:
            raise ValueError(
                f"Vehicle.thrust_max = {float(self.thrust_max):.2f} N cannot lift its weight, "
                f"{float(self.mass) * STANDARD_GRAVITY:.2f} N"
            )

    @property
    def command_min(self) -> Command:
        """Smallest command: idling rotors and the largest negative body rates."""
        idle = 4.0 * self.thrust_coefficient * self.motor_min**2
        return Command(idle / self.mass, -self.omega_max)

    @property
    def command_max(self) -> Command:
        """Largest command."""
        return Command(self.thrust_max / self.mass, self.omega_max)

    @property
    def hover_speed(self) -> Float[Array, ""]:
        """Rotor speed at which the thrust carries the weight, computed from c_T [rad/s]."""
        return jnp.sqrt(self.mass * STANDARD_GRAVITY / (4.0 * self.thrust_coefficient))


def small() -> Vehicle:
    """Return the paper's small quadrotor.

    Mass, inertia, arm length (0.06 m), thrust and motor time constant are from Table IV of the paper. The description
    published with the paper gives the inertia to three digits. It also contains the rate limits, c_T, kappa, the
    speeds, the rotor inertia and the speed controllers' curve at 17 V. The propeller is :func:`three_inch`. The drag
    area is that of the kingfisher, scaled with the square of the arm length.
    """
    return Vehicle(
        mass=jnp.array(0.19),
        inertia=jnp.array([1.42e-4, 1.65e-4, 2.13e-4]),
        arm=jnp.array([0.0424, 0.0424]),
        thrust_max=jnp.array(14.0),
        omega_max=jnp.array([6.0, 6.0, 4.0]),
        motor_tau=jnp.array(0.025),
        motor_min=jnp.array(150.0),
        motor_max=jnp.array(4400.0),
        rotor_inertia=jnp.array(2.65376e-7),
        thrust_coefficient=jnp.array(2.05e-7),
        torque_ratio=jnp.array(0.00804),
        drag_area=1.04 * jnp.array([0.0035, 0.0035, 0.0069]),
        propeller=three_inch(),
        esc=Esc(
            base=jnp.array(-1658.0 + 78.325 * 17.0),
            linear=jnp.array(0.7595),
            root=jnp.array(59.673),
            d_min=jnp.array(110.0),
            idle=jnp.array(0.025),
        ),
    )


def kingfisher() -> Vehicle:
    """Return the research quadrotor of the Agilicious platform, with the constants published with that platform.

    The exception is kappa, which is computed from blade-element theory for these 5.1 in rotors (the description lists
    0.022 m).
    """
    return Vehicle(
        mass=jnp.array(0.752),
        inertia=jnp.array([2.5e-3, 2.1e-3, 4.3e-3]),
        arm=jnp.array([0.075, 0.10]),
        thrust_max=jnp.array(34.0),
        omega_max=jnp.array([10.0, 10.0, 4.0]),
        motor_tau=jnp.array(0.033),
        motor_min=jnp.array(150.0),
        motor_max=jnp.array(2800.0),
        rotor_inertia=jnp.array(9.3575e-6),
        thrust_coefficient=jnp.array(1.562522e-6),
        torque_ratio=jnp.array(0.0117),
        drag_area=1.04 * jnp.array([0.015, 0.015, 0.030]),
        propeller=five_inch(),
        esc=Esc(
            base=jnp.array(-1933.2 + 61.31 * 15.0),
            linear=jnp.array(0.04071),
            root=jnp.array(79.79),
            d_min=jnp.array(158.0),
            idle=jnp.array(0.07),
        ),
    )


def large() -> Vehicle:
    """Return the paper's large quadrotor.

    Mass, inertia, arm length (0.13 m, with the kingfisher's aspect ratio), thrust and motor time constant are from
    Table IV of the paper. All other constants are those of the kingfisher, from which this quadrotor was built.
    """
    return dataclasses.replace(
        kingfisher(),
        mass=jnp.array(0.60),
        inertia=jnp.array([2.41e-3, 1.80e-3, 3.76e-3]),
        arm=jnp.array([0.078, 0.104]),
        thrust_max=jnp.array(34.0),
        motor_tau=jnp.array(0.033),
    )


def payload_inertia(mass: float, *, side: float = 0.05, below: float = 0.03, ahead: float = 0.0) -> Float[Array, "3"]:
    """Return the inertia [kg m^2] added by a cube under the vehicle; the shift of the centre of mass is neglected.

    Args:
        mass: Mass of the cube [kg].
        side: Length of an edge [m].
        below: Distance of the cube below the centre [m].
        ahead: Distance of the cube from the centre along body x [m].
    """
    own = mass * side**2 / 6.0
    return jnp.array([own + mass * below**2, own + mass * (below**2 + ahead**2), own + mass * ahead**2])


def with_payload(vehicle: Vehicle, mass: float) -> Vehicle:
    """Return a vehicle with a load that its commands take into account.

    With a load of 0.07 kg, the paper's small quadrotor has a mass of 0.26 kg. The thrust command is normalised by the
    total mass. For a load that the commands do not take into account, see :class:`retrim.physics.Payload`.
    """
    return dataclasses.replace(vehicle, mass=vehicle.mass + mass, inertia=vehicle.inertia + payload_inertia(mass))
