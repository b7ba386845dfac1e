"""A whole flight of a simulated plant as one program: for many flights at once, where nothing learns beside them."""

from typing import Any

import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Key

from ...control.controller import AbstractController
from ...physics.disturbance import Disturbance
from ...physics.highrate import AbstractHighRate
from ...physics.state import Command, State
from ..sensing import Sensing
from .sim import SimState, advance, launch, seen_by


def closed_loop(
    model: AbstractHighRate[Any],
    disturbance: Disturbance,
    controller: AbstractController[Any],
    x0: State,
    *,
    ticks: int,
    delay: float = 0.02,
    sensing: Sensing | None = None,
    key: Key[Array, ""] | None = None,
) -> tuple[State, Command]:
    """``ticks`` ticks from ``x0``: the true states at the end of each, and the commands issued; ticks in front.

    The same physics, tick for tick, as flying :class:`SimPlant` with a :class:`ControllerPilot`, without bounds: a
    lost vehicle flies on. For one vehicle; ``jax.vmap`` or ``lax.map`` it over starts. Raises ``ValueError`` if
    ``sensing`` comes without a ``key``.
    """
    if sensing is not None and key is None:
        raise ValueError("closed_loop: sensing needs a key")
    base = random.key(0) if key is None else key

    def tick(carry: tuple[SimState, Any], k: Array) -> tuple[tuple[SimState, Any], tuple[State, Command]]:
        s, memory = carry
        u, memory = controller(memory, s.t, seen_by(s))
        s = advance(model, disturbance, delay, sensing, s, u, random.fold_in(base, k))
        return (s, memory), (model.state(s.model), u)

    start = launch(model, delay, sensing, x0), controller.init(x0)
    _, flown = lax.scan(tick, start, jnp.arange(ticks))
    return flown
