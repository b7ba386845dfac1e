"""The simulated plant: a rotor-level model at 1 kHz behind a command delay, with a disturbance."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ...physics.disturbance import Disturbance
from ...physics.rotors import SUBSTEP, Rotors, RotorState
from ...physics.state import Command, State
from ..plant import PlantError, Sample, refuse_unsound


class SimState(eqx.Module):
    """Everything the simulation remembers."""

    rotors: RotorState
    queue: Command
    """Commands issued, oldest first; those that the delay still holds back, and the one acting."""
    t: Float[Array, ""]


def launch(model: Rotors, delay: float, x0: State) -> SimState:
    """Hovering at ``x0``, with hover commands under way."""
    slots = -(-round(delay / SUBSTEP) // round(model.dt / SUBSTEP)) + 1
    queue = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (slots, *leaf.shape)), Command.hover())
    return SimState(model.init(x0), queue, jnp.zeros_like(x0.p[0]))


def advance(model: Rotors, disturbance: Disturbance, delay: float, s: SimState, u: Command) -> SimState:
    """One control tick in steps of 1 ms; a command issued at the start of a tick acts ``delay`` seconds later."""
    per_tick, late = round(model.dt / SUBSTEP), round(delay / SUBSTEP)
    queue = jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), s.queue, u)
    slots = queue.c.shape[0]
    # In the i-th millisecond, the newest command whose delay has passed is this many ticks old:
    ages = np.array([-(-max(0, late - i) // per_tick) for i in range(per_tick)])

    def millisecond(rotors: RotorState, xs: tuple[Float[Array, ""], Command]) -> tuple[RotorState, None]:
        t, acting = xs
        return model.substep(rotors, acting, disturbance(t, model.state(rotors))), None

    times = s.t + SUBSTEP * jnp.arange(per_tick, dtype=s.t.dtype)
    acting = jax.tree.map(lambda leaf: leaf[slots - 1 - ages], queue)
    rotors, _ = lax.scan(millisecond, s.rotors, (times, acting))
    return SimState(rotors, queue, s.t + model.dt)


_launch = eqx.filter_jit(launch)
_advance = eqx.filter_jit(advance)


class SimPlant:
    """:class:`Rotors` as a :class:`retrim.adapt.plant.Plant`. ``delay`` [s] is a whole number of milliseconds."""

    def __init__(self, model: Rotors, disturbance: Disturbance, *, delay: float = 0.02) -> None:
        if delay < 0 or abs(delay / SUBSTEP - round(delay / SUBSTEP)) > 1e-6:
            raise ValueError(f"SimPlant: delay = {delay} s must be a whole, non-negative number of milliseconds")
        self.dt = model.dt
        self._model, self._disturbance, self._delay = model, disturbance, delay
        self._state: SimState | None = None
        self._ticks = 0

    def reset(self, x0: State | None) -> Sample:
        """Hover at ``x0``; without one, 1 m above the ground."""
        start = State.at(jnp.array([0.0, 0.0, 1.0])) if x0 is None else x0
        self._state = _launch(self._model, self._delay, start)
        self._ticks = 0
        return Sample(0.0, start, Command.hover())

    def exchange(self, u: Command) -> Sample:
        """One tick."""
        refuse_unsound(u, "SimPlant")
        if self._state is None:
            raise PlantError("SimPlant: not flying; call reset first")
        self._state = _advance(self._model, self._disturbance, self._delay, self._state, u)
        self._ticks += 1
        return Sample(self._ticks * self.dt, self._model.state(self._state.rotors), u)

    def stop(self) -> None:
        """Forget the flight."""
        self._state = None
