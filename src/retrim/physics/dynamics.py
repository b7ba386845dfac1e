"""Define motion models: x_{t+1} = f(x_t, u_t) for one control tick.

With rotors = LinearDragQuadrotor.of(...), the configurations of the paper's runtime study (Sec. IV-C) are::

    Hybrid(PointMass(dt), r)                                    # the paper's choice
    Hybrid(PointMass(dt), r, backprop=True)
    Hybrid(rotors, r)
    Hybrid(rotors, r, backprop=True)
    StraightThrough(Hybrid(rotors, r), PointMass(dt))
    StraightThrough(Hybrid(rotors, r), Hybrid(PointMass(dt), r, backprop=True))
"""

import abc
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from . import so3
from .actuator_response import ActuatorState
from .state import STANDARD_GRAVITY, Command, State, StateDot

X = TypeVar("X")


class AbstractDynamics(eqx.Module, Generic[X]):
    """A model that advances its own state ``X`` by control ticks, and relates ``X`` to a :class:`State`."""

    if TYPE_CHECKING:  # a type checker would treat an abstract variable as a dataclass field

        @property
        def dt(self) -> float:
            """Control tick [s]; static."""
    else:
        dt: eqx.AbstractVar[float]

    @property
    def settling_ticks(self) -> int | Float[Array, ""]:
        """Number of ticks after :meth:`init` until the hidden state no longer depends on the assumed hover."""
        return 0

    @abc.abstractmethod
    def init(self, x: State) -> X:
        """Return the model's state for a vehicle that hovers at ``x``."""

    @abc.abstractmethod
    def state(self, s: X) -> State:
        """Return the vehicle's state."""

    @abc.abstractmethod
    def with_state(self, s: X, x: State) -> X:
        """Return ``s`` with (p, R, v) replaced; the hidden state is kept."""

    def actuators(self, s: X) -> ActuatorState | None:
        """Return the present thrust and body rates; None for a model that follows commands immediately."""
        del s
        return None

    @abc.abstractmethod
    def step(self, s: X, u: Command, a_ext: Float[Array, "3"]) -> X:
        """Advance one control tick.

        Args:
            s: The model's state.
            u: Command, held over the tick.
            a_ext: External acceleration, world [m/s^2], held over the tick.

        Returns:
            The model's state at the end of the tick.
        """


def f_a(x: State, u: Command, a_ext: Float[Array, "3"]) -> StateDot:
    """Evaluate Eq. (1) of the paper: p' = v, R' = R [omega_cmd]x, v' = R c + g + ``a_ext`` [m/s^2]."""
    thrust = x.R[:, 2] * u.c  # R @ [0, 0, c]
    gravity = jnp.array([0.0, 0.0, -STANDARD_GRAVITY], dtype=x.p.dtype)
    return StateDot(p=x.v, omega=u.omega, v=thrust + gravity + a_ext)


class PointMass(AbstractDynamics[State]):
    """The low-fidelity model: Eq. (1), integrated by Runge-Kutta 4 over the coupled p, R, v (paper, Sec. III-E).

    Within a tick, the body rates are constant, so each stage's attitude ``R exp([omega] tau)`` is exact and on SO(3).
    """

    dt: float = eqx.field(static=True)

    def init(self, x: State) -> State:
        """Return the state itself."""
        return x

    def state(self, s: State) -> State:
        """Return the state itself."""
        return s

    def with_state(self, s: State, x: State) -> State:
        """Return the new state, since the model has no hidden state."""
        return x

    def step(self, s: State, u: Command, a_ext: Float[Array, "3"]) -> State:
        """Advance by one Runge-Kutta step of ``dt`` seconds."""
        return runge_kutta(s, u, a_ext, self.dt)


def runge_kutta(s: State, u: Command, a_ext: Float[Array, "3"], h: float | Float[Array, ""]) -> State:
    """Return the state after one step of Eq. (1); see :class:`PointMass`.

    Args:
        s: State.
        u: Command, held over the step.
        a_ext: External acceleration, world [m/s^2].
        h: Length of the step [s]; zero is allowed.
    """
    middle = so3.mul(s.R, so3.exp(0.5 * h * u.omega))
    end = so3.mul(s.R, so3.exp(h * u.omega))
    a1 = f_a(s, u, a_ext).v
    a2 = f_a(State(s.p, middle, s.v), u, a_ext).v  # = a3, since the acceleration depends on R, c and a_ext alone
    a4 = f_a(State(s.p, end, s.v), u, a_ext).v
    p = s.p + h * s.v + h**2 / 6.0 * (a1 + 2.0 * a2)
    v = s.v + h / 6.0 * (a1 + 4.0 * a2 + a4)
    return State(p, end, v)


@runtime_checkable
class Residual(Protocol):
    """Any function of (x, u) that predicts the acceleration that a model misses, in the world frame [m/s^2]."""

    def __call__(self, x: State, u: Command, /) -> Float[Array, "3"]:
        """Return the missing acceleration in the state ``x`` while ``u`` acts."""
        ...


class AbstractWrapper(AbstractDynamics[X]):
    """A model that wraps another model and has the same state; subclasses differ in :meth:`step`."""

    base: eqx.AbstractVar[AbstractDynamics[X]]

    @property
    def dt(self) -> float:
        """Control tick of the base model [s]."""
        return self.base.dt

    @property
    def settling_ticks(self) -> int | Float[Array, ""]:
        """Settling time of the base model [ticks]."""
        return self.base.settling_ticks

    def init(self, x: State) -> X:
        """Return the state of the base model."""
        return self.base.init(x)

    def state(self, s: X) -> State:
        """Return the vehicle's state."""
        return self.base.state(s)

    def with_state(self, s: X, x: State) -> X:
        """Return ``s`` with (p, R, v) replaced; the hidden state is kept."""
        return self.base.with_state(s, x)

    def actuators(self, s: X) -> ActuatorState | None:
        """Return the present thrust and body rates of the base model."""
        return self.base.actuators(s)


class Hybrid(AbstractWrapper[X]):
    """A model plus a residual, which is evaluated once per tick and held over it (paper, Sec. III-E).

    With ``backprop=False``, gradients flow through the residual neither to its weights nor to its inputs, the state and
    the command. This is the paper's back-propagation "through the analytical model only".
    """

    base: AbstractDynamics[X]
    residual: Residual
    backprop: bool = eqx.field(static=True, default=False)

    def step(self, s: X, u: Command, a_ext: Float[Array, "3"]) -> X:
        """Advance the base model by one tick with the residual added to ``a_ext``."""
        a_res = self.residual(self.base.state(s), u)
        return self.base.step(s, u, a_ext + (a_res if self.backprop else lax.stop_gradient(a_res)))


class StraightThrough(AbstractDynamics[X]):
    """A model with the value of ``forward`` and the gradient of ``backward``.

    Only (p, R, v) carry a gradient; the hidden state of the forward model does not.
    """

    forward: AbstractDynamics[X]
    backward: AbstractDynamics[State]

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the two models have different ticks."""
        if self.forward.dt != self.backward.dt:
            raise ValueError(f"StraightThrough: forward.dt = {self.forward.dt} s, backward.dt = {self.backward.dt} s")

    @property
    def dt(self) -> float:
        """Control tick of both models [s]."""
        return self.forward.dt

    @property
    def settling_ticks(self) -> int | Float[Array, ""]:
        """Settling time of the forward model [ticks]."""
        return self.forward.settling_ticks

    def init(self, x: State) -> X:
        """Return the state of the forward model."""
        return self.forward.init(x)

    def state(self, s: X) -> State:
        """Return the vehicle's state."""
        return self.forward.state(s)

    def with_state(self, s: X, x: State) -> X:
        """Return ``s`` with (p, R, v) replaced; the hidden state is kept."""
        return self.forward.with_state(s, x)

    def actuators(self, s: X) -> ActuatorState | None:
        """Return the present thrust and body rates of the forward model."""
        return self.forward.actuators(s)

    def step(self, s: X, u: Command, a_ext: Float[Array, "3"]) -> X:
        """Advance the forward model, with the backward model's derivative at the same state and command."""
        ahead = self.forward.step(lax.stop_gradient(s), lax.stop_gradient(u), lax.stop_gradient(a_ext))
        back = self.backward.step(self.forward.state(s), u, a_ext)
        value = self.forward.state(ahead)
        surrogate = jax.tree.map(lambda f, b: f + (b - lax.stop_gradient(b)), value, back)
        return self.forward.with_state(ahead, surrogate)
