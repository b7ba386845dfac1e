"""Define models that advance in substeps of one millisecond: realistic plants and high-fidelity dynamics."""

import abc
from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from . import so3
from .dynamics import AbstractDynamics
from .effects import ExternalEffects
from .state import STANDARD_GRAVITY, Command, State

SUBSTEP = 1e-3  # [s]
SIGNS = ((-1, 1, -1, 1), (-1, 1, 1, -1), (-1, -1, 1, 1))
"""Signs of the torque about x, y and z from each rotor (front-right, back-left, back-right, front-left)."""

X = TypeVar("X")


class AbstractSubstepDynamics(AbstractDynamics[X]):
    """A model whose control tick is a whole number of millisecond steps, each with its own external effects."""

    @property
    def command_limits(self) -> tuple[Command, Command] | None:
        """Smallest and largest command that the vehicle accepts; None if there are no limits."""
        return None

    def rotor_state(self, s: X) -> "RotorState | None":
        """Return the body rates and rotor speeds; None if the model does not have them."""
        return None

    def body_rates(self, s: X) -> Float[Array, "3"] | None:
        """Return the body rates [rad/s]; None if the model does not have them."""
        rotors = self.rotor_state(s)
        return None if rotors is None else rotors.omega

    @abc.abstractmethod
    def substep(self, s: X, u: Command, effects: ExternalEffects) -> X:
        """Advance one millisecond under the command ``u``."""

    def step(self, s: X, u: Command, a_ext: Float[Array, "3"]) -> X:
        """Advance one control tick in calm air, pushed by ``a_ext``."""
        effects = ExternalEffects.of(a_ext.dtype, push=a_ext)
        after, _ = lax.scan(lambda s, _: (self.substep(s, u, effects), None), s, length=round(self.dt / SUBSTEP))
        return after


def check_tick(dt: float, name: str) -> None:
    """Raise ``ValueError`` if ``dt`` is not a whole number of milliseconds."""
    if abs(dt / SUBSTEP - round(dt / SUBSTEP)) > 1e-6 or dt < SUBSTEP:
        raise ValueError(f"{name}.dt = {dt} s must be a whole number of milliseconds")


def signs(dtype: jnp.dtype) -> Float[Array, "3 4"]:
    """Return :data:`SIGNS` as an array."""
    return jnp.array(SIGNS, dtype=dtype)


def hub_places(arm: Float[Array, "2"]) -> Float[Array, "4 3"]:
    """Return the hub positions in the body frame [m].

    Args:
        arm: Distance of the rotors from the centre along body x and y [m].
    """
    turn = signs(arm.dtype)  # the lever of a rotor at (x, y) is y about the x axis, and -x about the y axis
    return jnp.stack([-arm[0] * turn[1], arm[1] * turn[0], jnp.zeros(4, dtype=arm.dtype)], axis=1)


class RotorState(eqx.Module):
    """State of a vehicle with rotors and a rate loop."""

    x: State
    omega: Float[Array, "3"]
    """Body rates [rad/s]."""
    motors: Float[Array, "4"]
    """Rotor speeds [rad/s]."""
    integral: Float[Array, "3"]
    """Integral of the rate error [rad]."""
    omega_dot: Float[Array, "3"]
    """Body angular acceleration over the last millisecond [rad/s^2], for the derivative term."""
    slow_setpoint: Float[Array, "3"] = eqx.field(default_factory=lambda: jnp.zeros(3))
    """Low-pass filtered commanded body rates [rad/s], for controllers that use the rate of change of commands."""


def rigid_body(
    s: RotorState,
    motors: Float[Array, "4"],
    integral: Float[Array, "3"],
    force: Float[Array, "3"],
    torque: Float[Array, "3"],
    mass: Float[Array, ""],
    inertia: Float[Array, "3"],
    push: Float[Array, "3"],
    slow_setpoint: Float[Array, "3"] | None = None,
) -> RotorState:
    """Advance by one semi-implicit step of a millisecond under the body-frame ``force`` [N] and ``torque`` [Nm].

    The attitude stays on SO(3).
    """
    h = SUBSTEP
    omega_dot = (torque - jnp.cross(s.omega, inertia * s.omega)) / inertia
    omega = s.omega + h * omega_dot
    gravity = jnp.array([0.0, 0.0, -STANDARD_GRAVITY], dtype=s.x.p.dtype)
    a = s.x.R @ force / mass + gravity + push
    x = State(s.x.p + h * s.x.v + 0.5 * h**2 * a, s.x.R @ so3.exp(h * omega), s.x.v + h * a)
    slow = s.slow_setpoint if slow_setpoint is None else slow_setpoint
    return RotorState(x, omega, motors, integral, omega_dot, slow)
