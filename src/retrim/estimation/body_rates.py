"""Estimate the present body rates from a gyroscope, or from commands and measured attitudes.

Without a gyroscope, the command path predicts the rates, and the rotation between two attitudes corrects them. This
rotation is noisy and late. The prediction is current, and as accurate as the known command path.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics import so3
from ..physics.actuator_response import ActuatorState
from ..physics.command_path import LONGEST_DELAY, CommandPath, PathState
from ..physics.state import Command, State

SHARE = 0.3  # share of the difference between measurement and prediction that corrects the prediction


class BodyRates(eqx.Module):
    """Predicted body rates, and the memory of the prediction."""

    R: Float[Array, "3 3"]
    """Attitude measured one tick ago."""
    before: PathState
    """State of the command path one tick ago."""
    path: PathState
    """State of the command path now."""
    mean: Float[Array, "3"]
    """Predicted mean rates over the tick that has just ended [rad/s]."""
    earlier: Float[Array, "3"]
    """Predicted mean rates over the previous tick [rad/s]."""

    @classmethod
    def start(cls, x: State, dt: float, *, longest: float = LONGEST_DELAY) -> "BodyRates":
        """Return the prediction for a vehicle that has hovered until now.

        Args:
            x: Measured state.
            dt: Control tick [s].
            longest: Longest delay of a path [s].
        """
        hover = CommandPath.of().init(Command.hover(x.p.dtype), dt, longest=longest)
        zero = jnp.zeros_like(x.p)
        return cls(x.R, hover, hover, zero, zero)

    @property
    def omega(self) -> Float[Array, "3"]:
        """Present body rates [rad/s]."""
        return self.path.actuators.command.omega

    def observe(
        self,
        x: State,
        age: Float[Array, ""],
        path: CommandPath,
        dt: float,
        omega: Float[Array, "3"] | None,
    ) -> "BodyRates":
        """Return the rates corrected by a measurement.

        Args:
            x: Measured state.
            age: Age of ``x`` [s].
            path: Command path of the vehicle.
            dt: Control tick [s].
            omega: Rates from a gyroscope [rad/s]; None without a gyroscope.
        """
        if omega is None:
            late = jnp.clip(age / dt, 0.0, 1.0).astype(x.p.dtype)
            prior = (1.0 - late) * self.mean + late * self.earlier
            error = SHARE * (so3.log(so3.mul(self.R.T, x.R)) / dt - prior)
        else:
            error = omega.astype(x.p.dtype) - self.omega
        error = jnp.where(jnp.all(jnp.isfinite(error)), error, 0.0)
        acting = self.path.actuators
        # A rate that exceeds the prediction at the end of a tick has also changed faster during the tick.
        slope = acting.slope + SHARE * (path.response.rate_lag / dt) * error
        corrected_state = ActuatorState(Command(acting.command.c, acting.command.omega + error), slope)
        return dataclasses.replace(self, R=x.R, path=dataclasses.replace(self.path, actuators=corrected_state))

    def issue(self, u: Command, path: CommandPath, dt: float) -> "BodyRates":
        """Return the prediction for the end of the tick that begins with the command ``u``.

        Args:
            u: Command.
            path: Command path of the vehicle.
            dt: Control tick [s].
        """
        mean, after = path(self.path, u, dt)
        return BodyRates(self.R, self.path, after, mean.omega, self.mean)

    def accept(self, u: Command, path: CommandPath, dt: float) -> "BodyRates":
        """Return the prediction after the plant accepted ``u`` instead of the command that was issued last."""
        mean, after = path(self.before, u, dt)
        after = jax.tree.map(lambda new, old: new.astype(old.dtype), after, self.path)
        return dataclasses.replace(self, path=after, mean=mean.omega)
