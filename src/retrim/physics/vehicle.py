"""Vehicles: the constants of a quadrotor, each with its source.

The quadrotors are functions rather than constants, since an array made at import would start a JAX backend.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .state import STANDARD_GRAVITY, Command


class Vehicle(eqx.Module):
    """Constants of a quadrotor in X configuration. Every leaf is an array: a new mass never recompiles."""

    mass: Float[Array, ""]
    """[kg]"""
    inertia: Float[Array, "3"]
    """Diagonal of the inertia, body frame [kg m^2]."""
    arm: Float[Array, "2"]
    """Distance of the rotors from the centre along body x and y [m]."""
    thrust_max: Float[Array, ""]
    """Of all four rotors together [N]."""
    omega_max: Float[Array, "3"]
    """Largest body rates that the rate loop accepts [rad/s]."""
    motor_tau: Float[Array, ""]
    """Time constant of a motor [s]."""
    motor_min: Float[Array, ""]
    """Idle speed of a rotor [rad/s]."""
    thrust_coefficient: Float[Array, ""]
    """c_T in T = c_T Omega^2 of one rotor [N s^2]."""
    torque_ratio: Float[Array, ""]
    """kappa in Q = kappa T of one rotor [m]."""

    def __check_init__(self) -> None:
        """Raise ``ValueError``, naming the field, where no such vehicle can exist; traced values are not checked."""
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(self)):
            return
        for field in dataclasses.fields(self):
            value = jnp.asarray(getattr(self, field.name))
            if not bool(jnp.all(jnp.isfinite(value) & (value > 0))):
                raise ValueError(f"Vehicle.{field.name} = {value} must be positive and finite")
        if self.thrust_max <= self.mass * STANDARD_GRAVITY:
            raise ValueError(
                f"Vehicle.thrust_max = {float(self.thrust_max):.2f} N cannot lift its weight, "
                f"{float(self.mass) * STANDARD_GRAVITY:.2f} N"
            )

    @property
    def command_min(self) -> Command:
        """Smallest command: idling rotors, largest negative body rates."""
        idle = 4.0 * self.thrust_coefficient * self.motor_min**2
        return Command(idle / self.mass, -self.omega_max)

    @property
    def command_max(self) -> Command:
        """Largest command."""
        return Command(self.thrust_max / self.mass, self.omega_max)

    @property
    def hover_speed(self) -> Float[Array, ""]:
        """Rotor speed that carries the weight, by c_T [rad/s]."""
        return jnp.sqrt(self.mass * STANDARD_GRAVITY / (4.0 * self.thrust_coefficient))


def small() -> Vehicle:
    """The paper's small quadrotor.

    Mass, inertia, arm length 0.06 m, thrust and motor time constant: Table IV of the paper (inertia to three digits:
    the description published with it). Rate limits, c_T, kappa and idle speed: the same description.
    """
    return Vehicle(
        mass=jnp.array(0.19),
        inertia=jnp.array([1.42e-4, 1.65e-4, 2.13e-4]),
        arm=jnp.array([0.0424, 0.0424]),
        thrust_max=jnp.array(14.0),
        omega_max=jnp.array([6.0, 6.0, 4.0]),
        motor_tau=jnp.array(0.025),
        motor_min=jnp.array(150.0),
        thrust_coefficient=jnp.array(2.05e-7),
        torque_ratio=jnp.array(0.00804),
    )


def large() -> Vehicle:
    """The paper's large quadrotor.

    Mass, inertia, arm length 0.13 m, thrust and motor time constant: Table IV of the paper. Rate limits, c_T and idle
    speed: those of the Agilicious platform from which it was built; kappa: blade-element theory for its 5.1 in rotors.
    """
    return Vehicle(
        mass=jnp.array(0.60),
        inertia=jnp.array([2.41e-3, 1.80e-3, 3.76e-3]),
        arm=jnp.array([0.078, 0.104]),
        thrust_max=jnp.array(34.0),
        omega_max=jnp.array([10.0, 10.0, 4.0]),
        motor_tau=jnp.array(0.033),
        motor_min=jnp.array(150.0),
        thrust_coefficient=jnp.array(1.5625e-6),
        torque_ratio=jnp.array(0.0117),
    )
