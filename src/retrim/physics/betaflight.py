"""Simulate the rate controller of flight firmware at 1 kHz: PID in throttle units, mixer and speed controllers."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .rate_tuning import Authority, Gains, authority, is_damped, tune
from .state import Command
from .substep import SUBSTEP, RotorState, signs
from .vehicle import Vehicle

# Throttle per unit of gain, and per rad/s, rad and rad/s^2: the firmware's scaling of its P, I and D settings.
P_SCALE, I_SCALE, D_SCALE = 1.818e-3, 14.0e-3, 31.25e-6
RELAX_RATE, RELAX_CUTOFF = 0.698, 15.0  # [rad/s], [Hz]; the integral pauses if the high-passed command exceeds 40 deg/s


class Betaflight(eqx.Module):
    """Gains in the units of the firmware's settings, and the thrust map that converts a thrust to a rotor speed."""

    kp: Float[Array, "3"]
    ki: Float[Array, "3"]
    kd: Float[Array, "3"]
    integral_max: Float[Array, ""]
    """Limit of the integral [rad]."""
    thrust_map: Float[Array, ""]
    """Coefficient c in Omega = sqrt(F / 4 c) that the controller assumes for its propellers [N s^2]."""

    @classmethod
    def of(cls, thrust_map: Float[Array, ""]) -> "Betaflight":
        """Return the settings of the Agilicious platform: P 40, 40, 30; I 80, 80, 60; D 20, 20, 0.

        The integral limit is that of the firmware: 40 % of the throttle.
        """
        return cls(
            kp=jnp.array([40.0, 40.0, 30.0]),
            ki=jnp.array([80.0, 80.0, 60.0]),
            kd=jnp.array([20.0, 20.0, 0.0]),
            integral_max=jnp.array(0.36),
            thrust_map=thrust_map,
        )

    @classmethod
    @eqx.filter_jit
    def fit_vehicle(cls, vehicle: Vehicle, thrust_map: Float[Array, ""], coefficient: Float[Array, ""]) -> "Betaflight":
        """Return the settings of :meth:`of` if they damp the vehicle's step response, otherwise tuned settings.

        Args:
            vehicle: Vehicle constants.
            thrust_map: Coefficient c in Omega = sqrt(F / 4 c) that the controller assumes [N s^2].
            coefficient: True T / Omega^2 of one rotor [N s^2].
        """
        result, power = cls.of(thrust_map), authority(vehicle, coefficient)
        plain = result.gains(power)
        keep, own = is_damped(plain, power.lead, vehicle.motor_tau), tune(plain, vehicle.motor_tau)
        own_settings = (own.a / P_SCALE, own.i / I_SCALE, own.b / D_SCALE)
        kp, ki, kd = (
            jnp.where(keep, old, new / power.alpha)
            for old, new in zip((result.kp, result.ki, result.kd), own_settings, strict=True)
        )
        return dataclasses.replace(result, kp=kp, ki=ki, kd=kd)

    def gains(self, power: Authority) -> Gains:
        """Return the gains in units of angular acceleration.

        Args:
            power: The vehicle's authority.
        """
        return Gains(power.alpha * P_SCALE * self.kp, power.alpha * I_SCALE * self.ki, power.alpha * D_SCALE * self.kd)

    def __call__(
        self, vehicle: Vehicle, s: RotorState, u: Command
    ) -> tuple[Float[Array, "4"], Float[Array, "3"], Float[Array, "3"]]:
        """Return the rotor speeds [rad/s], the integral of the rate error [rad], and the filtered command [rad/s]."""
        low, high = vehicle.command_min, vehicle.command_max
        setpoint = jnp.clip(u.omega, low.omega, high.omega)
        error = setpoint - s.omega
        # The integral pauses while the command changes fast, which prevents windup in a turn.
        relaxation = jnp.maximum(0.0, 1.0 - jnp.abs(setpoint - s.slow_setpoint) / RELAX_RATE)
        new_integral = s.integral + SUBSTEP * error * relaxation
        integral = jnp.clip(new_integral, -self.integral_max, self.integral_max)
        slow_setpoint = setpoint + (s.slow_setpoint - setpoint) * jnp.exp(-2.0 * jnp.pi * RELAX_CUTOFF * SUBSTEP)
        turn = P_SCALE * self.kp * error + I_SCALE * self.ki * integral - D_SCALE * self.kd * s.omega_dot
        thrust = vehicle.mass * jnp.clip(u.c, low.c, high.c)
        throttle = vehicle.esc.throttle(jnp.sqrt(thrust / (4.0 * self.thrust_map)))
        motor_outputs = jnp.clip(throttle + signs(turn.dtype).T @ turn, vehicle.esc.idle, 1.0)
        return jnp.clip(vehicle.esc.speed(motor_outputs), vehicle.motor_min, vehicle.motor_max), integral, slow_setpoint
