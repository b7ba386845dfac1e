"""Model the response of thrust and body rates to arriving commands.

Thrust follows through a gain and a first-order lag, and each body rate through a gain and a second-order loop,

    tau_c c' + c = k_c c_cmd,    (tau kappa / 2)^2 w'' + tau w' + w = k w_cmd,

with tau = 2 zeta / omega_n and kappa = 1 / zeta. For kappa = 0, the loop is of first order with the time constant tau.
All values are arrays, so a different lag or damping does not require recompilation.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .state import Command

FASTEST = 1e-6  # [s], shortest time constant of an exponential; a faster loop has settled after any step
STIFFEST = 1e-6  # smallest kappa for the fast mode of a loop; below it, that mode has decayed after any step
NEAR_CRITICAL = 0.25  # squared angle below which the functions of the angle are computed as series
SERIES = 7  # number of series terms that give double precision up to NEAR_CRITICAL


class ActuatorState(eqx.Module):
    """State of the actuators and the rate loop."""

    command: Command
    """Present thrust [m/s^2] and body rates [rad/s]."""
    slope: Float[Array, "3"]
    """Slope of the body rates times their time constant, tau w' [rad/s]."""

    @classmethod
    def at(cls, u: Command) -> "ActuatorState":
        """Return the steady state under the command ``u``."""
        return cls(u, jnp.zeros_like(u.omega))


class ActuatorResponse(eqx.Module):
    """Response of thrust and body rates to arriving commands."""

    thrust_gain: Float[Array, ""]
    """Ratio of thrust to commanded thrust."""
    thrust_lag: Float[Array, ""]
    """Time constant of the thrust [s]."""
    rate_gain: Float[Array, "3"]
    """Ratio of body rates to commanded body rates: roll, pitch, yaw."""
    rate_lag: Float[Array, "3"]
    """Time constant 2 zeta / omega_n of each body rate [s]."""
    inverse_damping: Float[Array, "3"]
    """1 / zeta of each rate loop; zero means a first-order loop."""

    @classmethod
    def of(
        cls,
        thrust_lag: float | Float[Array, ""] = 0.0,
        rate_lag: float | Float[Array, "*axes"] = 0.0,
        *,
        inverse_damping: float | Float[Array, "*axes"] = 0.0,
        thrust_gain: float | Float[Array, ""] = 1.0,
        rate_gain: float | Float[Array, "*axes"] = 1.0,
    ) -> "ActuatorResponse":
        """Return a response; scalar rate parameters apply to all axes.

        Args:
            thrust_lag: Time constant of the thrust [s].
            rate_lag: Time constant 2 zeta / omega_n of the roll, pitch and yaw rates [s].
            inverse_damping: 1 / zeta of each rate loop; zero means a first-order loop.
            thrust_gain: Ratio of thrust to commanded thrust.
            rate_gain: Ratio of body rates to commanded body rates.
        """
        axes = [jnp.broadcast_to(strong_array(each), (3,)) for each in (rate_gain, rate_lag, inverse_damping)]
        return cls(strong_array(thrust_gain), strong_array(thrust_lag), *axes)

    @property
    def settling_time(self) -> Float[Array, ""]:
        """Three times the longest time constant of thrust, roll and pitch [s].

        Yaw is excluded: a turn about the thrust axis does not move the vehicle, and may take a second. For a loop that
        rings, the time constant is that of its envelope.
        """
        envelope = self.rate_lag * jnp.maximum(1.0, 0.5 * self.inverse_damping**2)
        return 3.0 * jnp.maximum(self.thrust_lag, jnp.max(envelope[:2]))

    def target(self, u: Command) -> Command:
        """Return the final thrust and body rates under a constant command."""
        return Command(self.thrust_gain.astype(u.c.dtype) * u.c, self.rate_gain.astype(u.omega.dtype) * u.omega)

    def __call__(self, s: ActuatorState, u: Command, time: float | Float[Array, ""]) -> tuple[Command, ActuatorState]:
        """Advance under a constant command; the result is exact, and differentiable with respect to all arguments.

        Args:
            s: State at the beginning.
            u: Arriving command, held constant.
            time: Duration [s]; zero is allowed.

        Returns:
            Thrust and body rates minus :meth:`target`, integrated over the duration [m/s, rad], and the
            state at the end of the duration.
        """
        dtype, target = u.c.dtype, self.target(u)
        h = jnp.asarray(time, dtype)
        thrust, c = self.thrust(s.command.c, target.c, h)
        # Computing the integral from the loop equation saves an exponential.
        rate_lag, kappa = self.rate_lag.astype(dtype), self.inverse_damping.astype(dtype)
        error, quarter = s.command.omega - target.omega, 0.25 * kappa**2
        mean, half = _modes(h / jnp.maximum(rate_lag, FASTEST), kappa)
        swing = s.slope * quarter * half
        slope = s.slope * (mean - 0.5 * half) - error * half
        turn = rate_lag * (error * (1.0 - mean - 0.5 * half) - swing - quarter * (slope - s.slope))
        omega = target.omega + error * (mean + 0.5 * half) + swing
        return Command(thrust, turn), ActuatorState(Command(c, omega), slope)

    def thrust(
        self, c: Float[Array, ""], target: Float[Array, ""], time: float | Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Advance only the thrust.

        Args:
            c: Thrust at the beginning [m/s^2].
            target: Final thrust [m/s^2].
            time: Duration [s].

        Returns:
            Integral of thrust minus target [m/s], and the thrust at the end [m/s^2].
        """
        lag, error = self.thrust_lag.astype(c.dtype), c - target
        decay = jnp.exp(-jnp.asarray(time, c.dtype) / jnp.maximum(lag, FASTEST))
        return lag * error * (1.0 - decay), target + error * decay


def strong_array(value: float | Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return a strongly typed array, since a weakly typed one would require a separate compilation."""
    return jnp.asarray(value, dtype=float)


def _modes(x: Float[Array, "3"], kappa: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Return the mean of the loop's two modes, and their difference divided by rho; both are smooth at rho = 0.

    Args:
        x: Time divided by the time constant.
        kappa: 1 / zeta.

    Returns:
        exp(-b) cosh(b rho) and 2 exp(-b) sinh(b rho) / rho, with b = 2 x / kappa^2 and rho = sqrt(1 - kappa^2).
    """
    b = 2.0 * x / jnp.maximum(kappa, STIFFEST) ** 2
    square = b**2 * (1.0 - kappa**2)
    near = jnp.abs(square) < NEAR_CRITICAL
    slow, quick = ~near & (kappa < 1.0), ~near & (kappa >= 1.0)
    # A branch that does not apply is evaluated at safe numbers, since its gradient must be finite.
    k = jnp.where(slow, kappa, 0.5)
    rho = jnp.sqrt(1.0 - k**2)
    late = jnp.exp(-2.0 * x / (1.0 + rho))
    early = jnp.exp(-2.0 * x * (1.0 + rho) / jnp.maximum(k, STIFFEST) ** 2)
    over = (0.5 * (late + early), (late - early) / rho)
    nu = jnp.sqrt(jnp.where(quick, kappa, 2.0) ** 2 - 1.0)
    envelope, angle = jnp.exp(-jnp.where(slow, 1.0, b)), jnp.where(quick, b, 1.0) * nu
    under = (envelope * jnp.cos(angle), 2.0 * envelope * jnp.sin(angle) / nu)
    w = jnp.where(near, square, 0.0)
    even, odd = jnp.ones_like(w), jnp.ones_like(w)
    for n in range(SERIES, 0, -1):
        even, odd = 1.0 + even * w / (2 * n * (2 * n - 1)), 1.0 + odd * w / (2 * n * (2 * n + 1))
    close = (envelope * even, 2.0 * jnp.where(near, b, 1.0) * envelope * odd)
    mean, half = (jnp.where(near, n, jnp.where(slow, o, u)) for n, o, u in zip(close, over, under, strict=True))
    return mean, half
