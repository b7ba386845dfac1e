"""The simulated plant: a model at 1 kHz behind a command delay, in its surroundings, seen through sensors."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random
from jaxtyping import Array, Float, Key

from ...physics.disturbance import Disturbance
from ...physics.highrate import SUBSTEP, AbstractHighRate
from ...physics.state import Command, State
from ..plant import PlantError, Sample, refuse_unsound
from ..sensing import Sensing


class SimState(eqx.Module):
    """Everything the simulation remembers."""

    model: Any
    """The model's own state."""
    queue: Command
    """Commands issued, oldest first; those that the delay still holds back, and the one acting."""
    seen: State
    """Samples, oldest first; those that the sensors' latency still holds back, and the one that has arrived."""
    t: Float[Array, ""]


def launch(model: AbstractHighRate[Any], delay: float, sensing: Sensing | None, x0: State) -> SimState:
    """Hovering at ``x0``, with hover commands under way; sensors have seen it there."""
    slots = -(-round(delay / SUBSTEP) // round(model.dt / SUBSTEP)) + 1
    queue = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (slots, *leaf.shape)), Command.hover())
    held = 1 if sensing is None else sensing.held
    seen = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (held, *leaf.shape)), x0)
    return SimState(model.init(x0), queue, seen, jnp.zeros_like(x0.p[0]))


def advance(
    model: AbstractHighRate[Any],
    disturbance: Disturbance,
    delay: float,
    sensing: Sensing | None,
    s: SimState,
    u: Command,
    key: Key[Array, ""],
) -> SimState:
    """One control tick in steps of 1 ms; a command issued at the start of a tick acts ``delay`` seconds later."""
    per_tick, late = round(model.dt / SUBSTEP), round(delay / SUBSTEP)
    queue = jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), s.queue, u)
    slots = queue.c.shape[0]
    # In the i-th millisecond, the newest command whose delay has passed is this many ticks old:
    ages = np.array([-(-max(0, late - i) // per_tick) for i in range(per_tick)])

    def millisecond(inner: Any, xs: tuple[Float[Array, ""], Command]) -> tuple[Any, State]:
        t, acting = xs
        after = model.substep(inner, acting, disturbance(t, model.state(inner)))
        return after, model.state(after)

    times = s.t + SUBSTEP * jnp.arange(per_tick, dtype=s.t.dtype)
    acting = jax.tree.map(lambda leaf: leaf[slots - 1 - ages], queue)
    inner, path = lax.scan(millisecond, s.model, (times, acting))
    if sensing is None:
        seen = jax.tree.map(lambda leaf: leaf[-1:], path)
    else:
        sampled = jax.tree.map(lambda leaf: leaf[sensing.period - 1 :: sensing.period], path)
        seen = sensing.received(s.seen, sampled, key)
    return SimState(inner, queue, seen, s.t + model.dt)


def seen_by(s: SimState) -> State:
    """What the sensors tell now."""
    return jax.tree.map(lambda leaf: leaf[0], s.seen)  # type: ignore[no-any-return]


_launch = eqx.filter_jit(launch)
_advance = eqx.filter_jit(advance)


class SimPlant:
    """A model at 1 kHz as a :class:`retrim.adapt.plant.Plant`.

    ``delay`` [s] of commands is a whole number of milliseconds. Without ``sensing`` each sample is the true state;
    with it, the samples' noise and losses are drawn from ``seed`` and the tick, so that a flight repeats.
    """

    def __init__(
        self,
        model: AbstractHighRate[Any],
        disturbance: Disturbance,
        *,
        delay: float = 0.02,
        sensing: Sensing | None = None,
        seed: int = 0,
    ) -> None:
        if delay < 0 or abs(delay / SUBSTEP - round(delay / SUBSTEP)) > 1e-6:
            raise ValueError(f"SimPlant: delay = {delay} s must be a whole, non-negative number of milliseconds")
        if sensing is not None and round(model.dt / SUBSTEP) % sensing.period:
            raise ValueError(f"SimPlant: a tick of {model.dt} s is no multiple of the {sensing.period} ms of Sensing")
        self.dt = model.dt
        self._model, self._disturbance, self._delay, self._sensing = model, disturbance, delay, sensing
        self._key = random.key(seed)
        self._state: SimState | None = None
        self._ticks = 0

    def reset(self, x0: State | None) -> Sample:
        """Hover at ``x0``; without one, 1 m above the ground."""
        start = State.at(jnp.array([0.0, 0.0, 1.0])) if x0 is None else x0
        self._state = _launch(self._model, self._delay, self._sensing, start)
        self._ticks = 0
        return Sample(0.0, start, Command.hover())

    def exchange(self, u: Command) -> Sample:
        """One tick."""
        refuse_unsound(u, "SimPlant")
        if self._state is None:
            raise PlantError("SimPlant: not flying; call reset first")
        key = random.fold_in(self._key, self._ticks) if self._sensing is not None else self._key
        self._state = _advance(self._model, self._disturbance, self._delay, self._sensing, self._state, u, key)
        self._ticks += 1
        truth = self._model.state(self._state.model)
        seen = truth if self._sensing is None else seen_by(self._state)
        return Sample(self._ticks * self.dt, seen, u, truth=truth)

    def stop(self) -> None:
        """Forget the flight."""
        self._state = None
